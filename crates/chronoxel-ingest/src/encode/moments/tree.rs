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

#[cfg(test)]
mod tests {
    use super::super::samples::ErrorSum;
    use super::*;
    use chronoxel_core::{NodeFacts, SpanStatistics};

    fn known(value: f64, count: u64, ratio: f64) -> Known {
        let facts = NodeFacts { is_uniform: true, is_static: ratio == 0.0, ..NodeFacts::default() };
        Known {
            statistics: SpanStatistics { count, min: value, max: value, mean: value, std: 0.0 },
            facts,
            hash: u128::from(value.to_bits()),
            errors: ErrorSum { sum: ratio * count as f64, count },
        }
    }

    #[test]
    fn parents_weigh_their_children_by_samples_and_some_may_be_missing() {
        // Nodes 0, 1 and 9 of level 0; parents 0, 1 and 2, the last without children.
        let tree = Octree::from_levels(vec![vec![0, 1, 9], vec![0, 1, 2], vec![0]]).unwrap();
        let finest = vec![known(2.0, 30, 0.0), known(2.0, 10, 0.4), known(6.0, 40, 0.0)];
        let nodes = of_all_nodes(finest, &tree);
        assert_eq!(nodes.len(), 7);
        assert_eq!((nodes[3].mean, nodes[3].std, nodes[3].temporal_error), (2.0, 0.0, 0.1));
        assert!(nodes[3].facts.is_uniform && !nodes[3].facts.is_static);
        assert_eq!((nodes[4].mean, nodes[4].temporal_error, nodes[4].facts.is_static), (6.0, 0.0, true));
        assert!(nodes[5].is_empty());
        let root = nodes[6];
        assert_eq!((root.min, root.max, root.mean, root.std), (2.0, 6.0, 4.0, 2.0));
        assert!(!root.facts.is_uniform && (root.temporal_error - 0.05).abs() < 1e-15);
    }
}
