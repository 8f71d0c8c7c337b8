//! What is to be in memory: what the frame needs, what the next ones will, and the coarsest level of all.

use std::{
    collections::{BTreeMap, HashMap, HashSet},
    sync::Arc,
};

use chronoxel_core::{NodeId, SpanRecord};
use chronoxel_store::{Header, Store};
use chronoxel_stream::{Tier, Want};

use super::{
    Player, drawn_nodes,
    nodes::{StepSpans, key_of},
};
use crate::session::{Held, HeldKey, View};

/// What frames need and will need.
impl Player {
    /// Tells the state machine what this frame needs and what the next ones will.
    ///
    /// * `of_splits`: nodes for which the cut waits, and whether the step rests: else their data of this step comes too late
    pub(super) fn want(
        &mut self,
        view: &View,
        place: usize,
        spans: &StepSpans,
        needed: &BTreeMap<HeldKey, SpanRecord>,
        (of_splits, is_at_rest): (&[NodeId], bool),
    ) {
        let mut wants =
            Wants::new(self.session.store(), self.session.variable(), self.residency.budget_bytes());
        needed.iter().for_each(|(key, record)| wants.add(*key, record, Tier::Needed));
        let tree = Arc::clone(self.session.tree());
        // The coarsest brick of the step stands in for everything that is late.
        if let Some((key, record)) =
            spans.record(&tree, tree.root()).and_then(|r| Some((key_of(tree.root().level, r)?, r)))
        {
            wants.add(key, record, Tier::Needed);
        }
        for node in of_splits.iter().filter(|_| is_at_rest || self.num_ahead == 1) {
            if let Some((key, record)) =
                spans.record(&tree, *node).and_then(|r| Some((key_of(node.level, r)?, r)))
            {
                wants.add(key, record, Tier::Coming(0));
            }
        }
        self.want_ahead(view, place, of_splits, &mut wants);
        for place in 0..self.order.len() {
            let Some(of_root) = self.spans.get(&(self.order[place], tree.root().level)) else { continue };
            if let Some(key) = key_of(tree.root().level, &of_root[0]) {
                wants.add(key, &of_root[0], Tier::Coarse);
            }
        }
        self.wanted = wants.records;
        self.residency.set_wants(wants.list);
        let withdrawn: HashSet<HeldKey> = self.residency.take_withdrawn().into_iter().collect();
        if !withdrawn.is_empty() {
            for key in self.loader.withdraw(&|key| withdrawn.contains(key)) {
                self.residency.cancelled(key);
            }
        }
    }

    /// What the nodes on the cut will need at the next steps, nearest first, as far as it fits.
    fn want_ahead(&self, view: &View, place: usize, of_splits: &[NodeId], wants: &mut Wants<'_>) {
        let tree = self.session.tree();
        let volume = self.session.view_volume(view);
        let header = self.session.store().header();
        // A split that waits is done at a later step, when its children are there.
        let nodes = drawn_nodes(&self.cut).chain(of_splits.iter().copied());
        let on_cut: Vec<NodeId> = nodes.filter(|node| volume.may_see(box_of(*node, header))).collect();
        // The span of each that was wanted last.
        let mut last: Vec<Option<SpanRecord>> = vec![None; on_cut.len()];
        for (number, place) in self.coming(place).into_iter().enumerate() {
            let step = self.step_at(place);
            let Some(spans) = self.spans_in_memory(step) else { continue };
            let record_of = |node: NodeId| spans[usize::from(node.level)].as_ref()?.get(tree.rank(node)?);
            for (node, last) in on_cut.iter().zip(&mut last) {
                if last.is_some_and(|last| (last.start..last.start + last.len).contains(&step)) {
                    continue;
                }
                let Some(record) = record_of(*node) else { continue };
                *last = Some(*record);
                let is_seen = !view.transfer.is_transparent_over(record.drawn_range);
                if let Some(key) = key_of(node.level, record).filter(|_| is_seen) {
                    wants.add(key, record, Tier::Coming(number as u32 + 1));
                }
            }
            if wants.is_full() {
                return;
            }
        }
    }
}

/// Wants of a frame, each once, at its most urgent.
struct Wants<'a> {
    store: &'a Store,
    variable: usize,
    list: Vec<Want<HeldKey>>,
    records: HashMap<HeldKey, SpanRecord>,
    left_bytes: usize,
}

impl<'a> Wants<'a> {
    fn new(store: &'a Store, variable: usize, budget_bytes: usize) -> Self {
        Self { store, variable, list: Vec::new(), records: HashMap::new(), left_bytes: budget_bytes }
    }

    /// Adds one; more urgent ones come first.
    fn add(&mut self, key: HeldKey, record: &SpanRecord, tier: Tier) {
        if self.records.insert(key, *record).is_none() {
            let num_bytes = Held::most_bytes(self.store, self.variable, record);
            self.left_bytes = self.left_bytes.saturating_sub(num_bytes);
            self.list.push(Want { key, tier, num_bytes });
        }
    }

    fn is_full(&self) -> bool {
        self.left_bytes == 0
    }
}

/// The box of a node in voxels.
fn box_of(node: NodeId, header: &Header) -> [[f64; 3]; 2] {
    let size = (header.bricks.edge << node.level) as f64;
    let low = node.brick().map(|b| f64::from(b) * size);
    [low, low.map(|v| v + size)]
}
