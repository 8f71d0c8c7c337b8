//! From the finest bricks up the octree: what is known of all nodes.

use chronoxel_core::{NodeId, NodeStatistics, Octree};

use super::run::Known;

/// The nodes without children, numbered: those of level 0 by rank, then those of the levels above.
pub struct Leaves {
    /// By level and rank: the number, or `NO_LEAF`.
    numbers: Vec<Vec<u32>>,
    len: usize,
}

const NO_LEAF: u32 = u32::MAX;

impl Leaves {
    /// Of a tree.
    pub fn new(tree: &Octree) -> Self {
        let mut len = 0;
        let mut number = |is_leaf: bool| match is_leaf {
            true => {
                len += 1;
                len as u32 - 1
            }
            false => NO_LEAF,
        };
        let numbers = (0..tree.num_levels() as u8)
            .map(|level| {
                let is_leaf = |&morton: &u64| tree.is_leaf(NodeId { level, morton });
                tree.nodes(level).iter().map(|morton| number(is_leaf(morton))).collect()
            })
            .collect();
        Self { numbers, len }
    }

    /// How many.
    pub fn len(&self) -> usize {
        self.len
    }

    /// The number of a node; `None` where it has children.
    pub fn number(&self, level: u8, rank: usize) -> Option<usize> {
        Some(self.numbers[usize::from(level)][rank]).filter(|number| *number != NO_LEAF).map(|n| n as usize)
    }
}

/// Statistics of all nodes, levels finest first, by rank within a level.
///
/// * `of_leaves`: of the nodes without children, as [`Leaves`] numbers them
pub fn of_all_nodes(of_leaves: &[Known], leaves: &Leaves, tree: &Octree) -> Vec<NodeStatistics> {
    let mut of_nodes = Vec::new();
    let mut below: Vec<Known> = Vec::new();
    for level in 0..tree.num_levels() as u8 {
        let mortons = tree.nodes(level);
        let finer: &[u64] = if level > 0 { tree.nodes(level - 1) } else { &[] };
        let mut children = finer.iter().zip(&below).peekable();
        let of_node = |(rank, parent): (usize, &u64)| match leaves.number(level, rank) {
            Some(number) => of_leaves[number],
            None => {
                let mut merged: Option<Known> = None;
                while let Some((_, child)) = children.next_if(|(morton, _)| **morton >> 3 == *parent) {
                    merged = Some(merged.map_or(*child, |known| known.merged_in_space(*child)));
                }
                merged.expect("what is no leaf has children")
            }
        };
        let of_level: Vec<Known> = mortons.iter().enumerate().map(of_node).collect();
        of_nodes.extend(of_level.iter().map(Known::node_statistics));
        below = of_level;
    }
    of_nodes
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
        // Nodes 0, 1 and 9 of level 0; parents 0, 1 and 2, the last a leaf of level 1.
        let tree = Octree::from_levels(vec![vec![0, 1, 9], vec![0, 1, 2], vec![0]]).unwrap();
        let leaves = [known(2.0, 30, 0.0), known(2.0, 10, 0.4), known(6.0, 40, 0.0), known(8.0, 20, 0.0)];
        let nodes = of_all_nodes(&leaves, &Leaves::new(&tree), &tree);
        assert_eq!(nodes.len(), 7);
        assert_eq!((nodes[3].mean, nodes[3].std, nodes[3].temporal_error), (2.0, 0.0, 0.1));
        assert!(nodes[3].facts.is_uniform && !nodes[3].facts.is_static);
        assert_eq!((nodes[4].mean, nodes[4].temporal_error, nodes[4].facts.is_static), (6.0, 0.0, true));
        assert_eq!((nodes[5].mean, nodes[5].std), (8.0, 0.0));
        let root = nodes[6];
        assert_eq!((root.min, root.max), (2.0, 8.0));
        assert!((root.mean - 4.8).abs() < 1e-6 && (root.std - 2.4).abs() < 1e-6);
        assert!(!root.facts.is_uniform && (root.temporal_error - 0.04).abs() < 1e-8);
    }
}
