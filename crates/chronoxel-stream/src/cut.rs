//! The active cut (leven2002, section 5.1): nodes that always cover the volume, refined where the error is largest as far as the limits allow.

use std::collections::{BTreeMap, BTreeSet};

use chronoxel_core::{BrickLayout, NodeId, Octree, UniformGrid};

mod frame;
mod node_map;

use frame::Frame;

/// Rounds of [`ActiveCut::refine_fully`]; one or two are enough but for long chains of exchanges.
const MOST_ROUNDS: usize = 64;

/// What a cut may take.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CutLimits {
    /// Most cost of drawing, in the units of [`NodeView::cost`]; infinite without a target for the time of a frame.
    pub cost: f64,
    /// Most bytes of payloads.
    pub bytes: usize,
    /// The finest level to draw.
    pub finest_level: u8,
    /// Most splits in a frame, done and pending ones together.
    pub most_splits_per_frame: usize,
}

impl Default for CutLimits {
    fn default() -> Self {
        Self { cost: f64::INFINITY, bytes: usize::MAX, finest_level: 0, most_splits_per_frame: usize::MAX }
    }
}

/// What a cut must know of the nodes: answers about one frame, its view, step and transfer function.
pub trait NodeView {
    /// How wrong it is to draw the node in place of its children: its size on the screen (pixels per voxel) weighed by how much its colours differ; 0 where
    /// it is outside the picture, transparent, or accepted as it is.
    fn error(&mut self, node: NodeId) -> f64;

    /// What it costs to draw; 0 where nothing is drawn, or an ancestor is drawn as a whole in its place.
    fn cost(&mut self, node: NodeId) -> f64;

    /// Bytes of the payload that drawing it takes; 0 where it needs none.
    fn num_bytes(&mut self, node: NodeId) -> usize;

    /// Whether it can be drawn at once: its payload is in memory, or it needs none, or it can never be loaded.
    ///
    /// While time goes on, this is best asked of the step drawn and of the next one together, so that no split is done that the next frame cannot show.
    fn is_resident(&mut self, node: NodeId) -> bool;
}

/// What one frame did to a cut.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct CutChange {
    /// Nodes that gave way to their children.
    pub splits: Vec<NodeId>,
    /// Nodes that took the place of theirs.
    pub merges: Vec<NodeId>,
    /// Nodes to load so that pending splits and merges can be done in this step, most urgent first.
    pub wanted: Vec<NodeId>,
    /// Whether nothing changed and nothing is pending: the same view and limits change nothing again.
    pub is_settled: bool,
}

/// A cut through the octree that covers the volume exactly once.
///
/// Where some children of a split node do not exist, their octants are drawn from the node itself.
#[derive(Debug, Clone, PartialEq)]
pub struct ActiveCut {
    /// Bricks of level 0 along each axis, to tell an octant that does not exist from one outside the grid.
    bricks: [u32; 3],
    nodes: BTreeSet<NodeId>,
    /// Split nodes that still draw some octants, and how many.
    partial: BTreeMap<NodeId, u8>,
    pending: BTreeSet<NodeId>,
}

impl ActiveCut {
    /// The coarsest cut: the root alone.
    pub fn new(tree: &Octree, grid: &UniformGrid, layout: &BrickLayout) -> Self {
        let bricks = grid.dims.map(|n| n.div_ceil(layout.edge) as u32);
        let nodes = BTreeSet::from([tree.root()]);
        Self { bricks, nodes, partial: BTreeMap::new(), pending: BTreeSet::new() }
    }

    /// Adapts the cut to a frame.
    ///
    /// In this order: nodes finer than the finest level merge; while the cut exceeds a limit, nodes merge, the smallest error first; visible nodes without
    /// error merge where that makes drawing cheaper; nodes split, the largest error first. A split that does not fit is exchanged for merges whose
    /// errors together are smaller than its own, so that the error of all that is not split falls. Nodes that are not drawn merge only when their room
    /// is needed. A split whose children (or an exchange whose merged nodes) are not resident stays pending: its room is kept, what it needs is wanted, and it goes
    /// on in a later frame unless a better candidate comes up.
    ///
    /// Merges that a limit or the finest level forces do not wait for payloads: an ancestor stands in until the node is loaded.
    pub fn adapt(&mut self, tree: &Octree, limits: &CutLimits, view: &mut dyn NodeView) -> CutChange {
        Frame::new(self, tree, limits, view).adapt()
    }

    /// Adapts the cut as far as it goes under the limits, whether payloads are there or not: for a first frame that is waited for.
    ///
    /// The change lists every split and merge on the way.
    pub fn refine_fully(&mut self, tree: &Octree, limits: &CutLimits, view: &mut dyn NodeView) -> CutChange {
        let limits = CutLimits { most_splits_per_frame: usize::MAX, ..*limits };
        let mut all = CutChange::default();
        for _ in 0..MOST_ROUNDS {
            let change = self.adapt(tree, &limits, &mut AllResident(view));
            all.is_settled = change.is_settled;
            all.splits.extend(change.splits);
            all.merges.extend(change.merges);
            if all.is_settled {
                break;
            }
        }
        all
    }

    /// Octants of a node in which the grid has samples but no child exists.
    fn num_missing(&self, tree: &Octree, node: NodeId) -> u8 {
        let is_inside = |child: &NodeId| {
            let low = child.brick().map(|b| u64::from(b) << child.level);
            (0..3).all(|a| low[a] < u64::from(self.bricks[a]))
        };
        let inside = (0..8).filter_map(|octant| node.child(octant)).filter(is_inside);
        inside.filter(|child| tree.rank(*child).is_none()).count() as u8
    }

    /// Whether a node is on the cut.
    pub fn contains(&self, node: NodeId) -> bool {
        self.nodes.contains(&node)
    }

    /// The nodes on the cut.
    pub fn nodes(&self) -> impl Iterator<Item = NodeId> + '_ {
        self.nodes.iter().copied()
    }

    /// Split nodes of which some octants are still drawn, because no child exists there.
    pub fn partial_nodes(&self) -> impl Iterator<Item = NodeId> + '_ {
        self.partial.keys().copied()
    }

    /// Nodes whose split waits for their children: while time goes on, those are to be loaded for the coming steps, because what arrives for the step drawn
    /// arrives too late.
    pub fn pending_nodes(&self) -> impl Iterator<Item = NodeId> + '_ {
        self.pending.iter().copied()
    }
}

/// A view in which every payload is there.
struct AllResident<'a>(&'a mut dyn NodeView);

impl NodeView for AllResident<'_> {
    fn error(&mut self, node: NodeId) -> f64 {
        self.0.error(node)
    }

    fn cost(&mut self, node: NodeId) -> f64 {
        self.0.cost(node)
    }

    fn num_bytes(&mut self, node: NodeId) -> usize {
        self.0.num_bytes(node)
    }

    fn is_resident(&mut self, _: NodeId) -> bool {
        true
    }
}

#[cfg(test)]
mod tests;
