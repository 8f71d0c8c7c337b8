//! From the finest bricks up the octree: what is known of all nodes.

use chronoxel_core::{NodeStatistics, Octree};

use super::run::Known;

/// Statistics of all nodes, levels finest first, by rank within a level.
///
/// * `finest`: of the nodes of level 0
pub fn of_all_nodes(finest: Vec<Known>, tree: &Octree) -> Vec<NodeStatistics> {
    let mut of_nodes = Vec::new();
    let mut level: Vec<Option<Known>> = finest.into_iter().map(Some).collect();
    for above in 1..=tree.num_levels() as u8 {
        let statistics = |known: &Option<Known>| known.map_or(NodeStatistics::EMPTY, |k| k.node_statistics());
        of_nodes.extend(level.iter().map(statistics));
        if usize::from(above) < tree.num_levels() {
            level = parents(&level, tree.nodes(above - 1), tree.nodes(above));
        }
    }
    of_nodes
}

/// Of the nodes one level up, from those of their children that exist, in Morton order.
fn parents(children: &[Option<Known>], mortons: &[u64], above: &[u64]) -> Vec<Option<Known>> {
    let mut children = mortons.iter().zip(children).peekable();
    let of_parent = |parent: &u64| {
        let mut merged: Option<Known> = None;
        while let Some((_, child)) = children.next_if(|(morton, _)| **morton >> 3 == *parent) {
            merged = match (merged, *child) {
                (Some(a), Some(b)) => Some(a.merged_in_space(b)),
                (a, b) => a.or(b),
            };
        }
        merged
    };
    above.iter().map(of_parent).collect()
}
