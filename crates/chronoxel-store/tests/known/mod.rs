//! Statistics of the time tree by their definitions: sums over all samples and steps, nothing merged.

#![allow(dead_code)] // each test binary uses its part

use std::collections::HashMap;

use chronoxel_core::{
    NodeFacts, NodeId, NodeStatistics, Octree, SpanStatistics, TimeNode,
    octree::levels_of,
    time_tree::{guarded_ratio, num_time_levels, num_time_nodes},
};
use chronoxel_store::StoreDescription;

/// The range that temporal errors are guarded with.
pub const VALUE_RANGE: f64 = 200.0;

/// The bricks of a variable at every step: full bricks, NaN where masked.
pub struct Known {
    description: StoreDescription,
    bricks: HashMap<(NodeId, u32), Vec<f64>>,
    rows: HashMap<TimeNode, Vec<NodeStatistics>>,
}

/// A brick that is the finest there is in a node, or in an octant of one.
struct Piece {
    brick: NodeId,
    octant: Option<u8>,
}

impl Known {
    /// Of full bricks `[z, y, x]`, given by node and step.
    pub fn new(description: &StoreDescription, full_brick: impl Fn(NodeId, u32) -> Vec<f64>) -> Self {
        let tree = &description.tree;
        let mut bricks = HashMap::new();
        for level in 0..tree.num_levels() as u8 {
            for &morton in tree.nodes(level) {
                let node = NodeId { level, morton };
                if pieces(description, node).iter().any(|piece| piece.brick == node) {
                    let steps = 0..description.times.num_steps() as u32;
                    bricks.extend(steps.map(|step| ((node, step), full_brick(node, step))));
                }
            }
        }
        Self { description: description.clone(), bricks, rows: HashMap::new() }
    }

    /// The statistics of all nodes over the steps of a time node.
    pub fn row(&mut self, at: TimeNode) -> &[NodeStatistics] {
        if !self.rows.contains_key(&at) {
            let tree = &self.description.tree;
            let nodes = (0..tree.num_levels() as u8)
                .flat_map(|level| tree.nodes(level).iter().map(move |&morton| NodeId { level, morton }));
            let row = nodes.map(|node| self.of_node(node, at)).collect();
            self.rows.insert(at, row);
        }
        &self.rows[&at]
    }

    fn of_node(&self, node: NodeId, at: TimeNode) -> NodeStatistics {
        let steps = at.steps(self.description.times.num_steps() as u32);
        let (mut values, mut errors) = (Vec::new(), Vec::new());
        let mut facts =
            NodeFacts { is_uniform: true, is_static: true, is_masked: false, mask_changes: false };
        let (mut some, mut over) = (None, Vec::new());
        for piece in pieces(&self.description, node) {
            let bricks: Vec<&Vec<f64>> =
                steps.clone().map(|step| &self.bricks[&(piece.brick, step)]).collect();
            let counted = self.counted(&piece);
            for sample in 0..bricks[0].len() {
                over.clear();
                over.extend(bricks.iter().map(|brick| brick[sample]));
                let first = *some.get_or_insert(over[0]);
                let num_masked = over.iter().filter(|v| v.is_nan()).count();
                facts.is_uniform &= over.iter().all(|v| *v == first);
                facts.is_masked |= num_masked > 0;
                facts.mask_changes |= num_masked % over.len() > 0;
                facts.is_static &= over.iter().all(|v| v.to_bits() == over[0].to_bits());
                if !counted[sample] {
                    continue;
                }
                if num_masked == 0 {
                    let [mean, std] = mean_and_std(&over);
                    errors.push(guarded_ratio(std, mean, VALUE_RANGE));
                }
                values.extend(over.iter().filter(|v| !v.is_nan()));
            }
        }
        let [mean, std] = mean_and_std(&values);
        let fold = |pick: fn(f64, f64) -> f64| values.iter().copied().fold(f64::NAN, pick);
        let temporal_error = match () {
            _ if values.is_empty() => f64::NAN,
            _ if facts.is_static => 0.0,
            _ => (errors.iter().sum::<f64>() / errors.len().max(1) as f64).max(f32::from_bits(1).into()),
        };
        let [min, max] = [fold(f64::min), fold(f64::max)];
        NodeStatistics { min, max, mean: mean.max(min).min(max), std, temporal_error, facts }
    }

    /// Which samples of a full brick are in the core, in the grid and in the piece.
    fn counted(&self, piece: &Piece) -> Vec<bool> {
        let layout = &self.description.layout;
        let full = layout.full_edge();
        let dims = levels_of(&self.description.grid, layout)[usize::from(piece.brick.level)].dims;
        let is_counted = |sample: usize| {
            let at = [sample % full, sample / full % full, sample / full / full];
            (0..3).all(|axis| {
                let core = at[axis].wrapping_sub(layout.low);
                let half = |octant| usize::from(octant >> axis & 1 == 1) * (layout.edge / 2);
                let place = piece.brick.brick()[axis] as usize * layout.edge + core.min(layout.edge);
                let in_piece = |octant: u8| (half(octant)..half(octant) + layout.edge / 2).contains(&core);
                core < layout.edge && place < dims[axis] && piece.octant.is_none_or(in_piece)
            })
        };
        (0..full.pow(3)).map(is_counted).collect()
    }
}

fn mean_and_std(values: &[f64]) -> [f64; 2] {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    // A sum of equal numbers may round.
    let mean = if values.iter().all(|v| *v == values[0]) { *values.first().unwrap_or(&mean) } else { mean };
    [mean, (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt()]
}

/// The finest bricks there are in a node.
fn pieces(description: &StoreDescription, node: NodeId) -> Vec<Piece> {
    if node.level == 0 {
        return vec![Piece { brick: node, octant: None }];
    }
    let octants = (0..8).flat_map(|octant| match node.child(octant) {
        Some(child) if description.tree.rank(child).is_some() => pieces(description, child),
        _ => vec![Piece { brick: node, octant: Some(octant) }],
    });
    let pieces: Vec<Piece> = octants.collect();
    let bricks = levels_of(&description.grid, &description.layout)[usize::from(node.level) - 1].bricks;
    // No sample of the grid lies in octants beyond it.
    let in_grid = |piece: &Piece| match piece.octant {
        Some(octant) if piece.brick == node => {
            let child = node.child(octant).unwrap().brick();
            (0..3).all(|axis| (child[axis] as usize) < bricks[axis])
        }
        _ => true,
    };
    pieces.into_iter().filter(in_grid).collect()
}

/// Statistics `[time level][index][node]` that agree with those of single steps of the finest nodes, given by rank and step, each
/// of as many samples or of none. Deviations and errors are made up.
pub fn agreeing(
    tree: &Octree,
    num_steps: u32,
    of_step: impl Fn(usize, u32) -> SpanStatistics,
) -> Vec<Vec<Vec<NodeStatistics>>> {
    let finest = 0..tree.nodes(0).len();
    let steps: Vec<Vec<SpanStatistics>> =
        finest.map(|rank| (0..num_steps).map(|step| of_step(rank, step)).collect()).collect();
    let row = |at: TimeNode| {
        let levels = 0..tree.num_levels() as u8;
        let nodes = levels.flat_map(|level| tree.nodes(level).iter().map(move |&morton| (level, morton)));
        let of_node = |(level, morton): (u8, u64)| {
            let within = tree.nodes(0).iter().enumerate();
            let within = within.filter(|(_, finest)| **finest >> (3 * level) == morton);
            let range = at.steps(num_steps);
            let of_finest = within.map(|(rank, _)| &steps[rank][range.start as usize..range.end as usize]);
            summary(&of_finest.collect::<Vec<_>>())
        };
        nodes.map(of_node).collect()
    };
    let level =
        |level| (0..num_time_nodes(num_steps, level)).map(|index| row(TimeNode { level, index })).collect();
    (0..num_time_levels(num_steps)).map(level).collect()
}

/// Of some of the finest nodes `[node][step]`.
fn summary(nodes: &[&[SpanStatistics]]) -> NodeStatistics {
    let mut facts = NodeFacts { is_static: true, ..NodeFacts::default() };
    for &steps in nodes {
        let num_empty = steps.iter().filter(|s| s.count == 0).count();
        facts.is_masked |= num_empty > 0;
        facts.mask_changes |= num_empty % steps.len() > 0;
        facts.is_static &= num_empty == steps.len() || steps.iter().all(|s| s.min == steps[0].min);
    }
    let all: Vec<&SpanStatistics> = nodes.iter().copied().flatten().filter(|s| s.count > 0).collect();
    let fold = |value: fn(&SpanStatistics) -> f64, pick: fn(f64, f64) -> f64| {
        all.iter().copied().map(value).fold(f64::NAN, pick)
    };
    if all.is_empty() {
        return NodeStatistics::EMPTY;
    }
    let [min, max] = [fold(|s| s.min, f64::min), fold(|s| s.max, f64::max)];
    let single = |value: f64| f64::from(value as f32);
    let std = single((0.25 * (max - min)).max(fold(|s| s.std, f64::max)));
    let mean = single(all.iter().map(|s| s.mean).sum::<f64>() / all.len() as f64).clamp(min, max);
    let temporal_error = if facts.is_static { 0.0 } else { single(std / (1.0 + mean.abs()) + 1e-6) };
    NodeStatistics { min, max, mean, std, temporal_error, facts }
}
