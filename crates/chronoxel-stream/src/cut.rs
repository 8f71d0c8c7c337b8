//! The active cut (leven2002, section 5.1): nodes that always cover the volume, refined where the error is largest as far as the limits allow.

use std::collections::{BTreeMap, BTreeSet};

use chronoxel_core::{BrickLayout, NodeId, Octree, UniformGrid};

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

    /// What it costs to draw; 0 where nothing is drawn.
    fn cost(&mut self, node: NodeId) -> f64;

    /// Bytes of the payload that drawing it takes; 0 where it needs none.
    fn num_bytes(&mut self, node: NodeId) -> usize;

    /// Whether it can be drawn at once: its payload is in memory, or it needs none, or it can never be loaded.
    fn is_resident(&mut self, node: NodeId) -> bool;
}

/// What one frame did to a cut.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct CutChange {
    /// Nodes that gave way to their children.
    pub splits: Vec<NodeId>,
    /// Nodes that took the place of theirs.
    pub merges: Vec<NodeId>,
    /// Nodes to load so that pending splits and merges can be done, most urgent first.
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
    edge: usize,
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
        Self { bricks, edge: layout.edge, nodes, partial: BTreeMap::new(), pending: BTreeSet::new() }
    }

    /// Adapts the cut to a frame.
    pub fn adapt(&mut self, tree: &Octree, limits: &CutLimits, view: &mut dyn NodeView) -> CutChange {
        let mut change = CutChange::default();
        let candidates: Vec<NodeId> = self.nodes.iter().copied().collect();
        for node in candidates.into_iter().rev() {
            let children = children_of(tree, node);
            if node.level <= limits.finest_level || children.is_empty() || view.error(node) <= 0.0 {
                continue;
            }
            let absent: Vec<NodeId> = children.iter().copied().filter(|c| !view.is_resident(*c)).collect();
            if absent.is_empty() && change.splits.len() < limits.most_splits_per_frame {
                self.nodes.remove(&node);
                self.nodes.extend(&children);
                change.splits.push(node);
            }
            change.wanted.extend(absent);
        }
        change.is_settled = change.splits.is_empty() && change.wanted.is_empty();
        change
    }

    /// Adapts the cut as far as it goes under the limits, whether payloads are there or not: for a first frame that is waited for.
    pub fn refine_fully(&mut self, tree: &Octree, limits: &CutLimits, view: &mut dyn NodeView) -> CutChange {
        let mut all = CutChange::default();
        loop {
            let change = self.adapt(tree, limits, &mut AllResident(view));
            if change.splits.is_empty() && change.merges.is_empty() {
                return all;
            }
            all.splits.extend(change.splits);
            all.merges.extend(change.merges);
        }
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

    /// Nodes whose split waits for their children: while time goes on, those are worth loading for the coming steps as well.
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

/// Children of a node that exist.
fn children_of(tree: &Octree, node: NodeId) -> Vec<NodeId> {
    (0..8).filter_map(|octant| node.child(octant)).filter(|child| tree.rank(*child).is_some()).collect()
}
