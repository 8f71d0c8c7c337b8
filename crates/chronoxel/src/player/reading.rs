//! Asking threads to read, hearing from them, and what stands in for what is late.

use std::{collections::BTreeMap, sync::Arc, time::Instant};

use chronoxel_core::{NodeId, Octree, SpanKind, SpanRecord};
use chronoxel_stream::{DrawItem, How, State};

use super::{
    BATCH, Late, PATIENCE, Player, Waited,
    loader::{Answer, Job},
    nodes::key_of,
};
use crate::session::HeldKey;

impl Player {
    /// Begins what the state machine says, and forgets what it says.
    pub(super) fn request(&mut self) {
        let mut requests = self.residency.next_requests();
        for key in self.residency.take_evicted() {
            self.session.take_back(&key);
        }
        // Urgent ones first; those of a batch in the order in which they lie in the store.
        for batch in requests.chunks_mut(BATCH) {
            batch.sort_unstable();
            for same in batch.chunk_by(|a, b| a.level() == b.level()) {
                let wanted: Vec<_> =
                    same.iter().filter_map(|key| Some((*key, *self.wanted.get(key)?))).collect();
                self.loader.begin(Job::Held { level: same[0].level(), wanted }, false);
            }
        }
    }

    /// Takes the answers that are there.
    pub(super) fn listen(&mut self) {
        while let Some(answer) = self.loader.try_answer() {
            self.take(answer);
        }
    }

    /// Waits for an answer, and begins what it makes room for.
    pub(super) fn hear(&mut self) -> anyhow::Result<()> {
        if let Some(answer) = self.loader.wait(PATIENCE)? {
            self.take(answer);
            self.listen();
            self.request();
        }
        Ok(())
    }

    pub(super) fn take(&mut self, answer: Answer) {
        match answer {
            Answer::Spans { level, step, spans } => {
                self.spans_asked.remove(&(step, level));
                match spans {
                    Ok(spans) => drop(self.spans.insert((step, level), Arc::new(spans))),
                    Err(_) => drop(self.spans_failed.insert((step, level))),
                }
            }
            Answer::Held { key, held: Ok(held) } => {
                if self.residency.loaded(key, held.num_bytes()) {
                    self.session.give(key, held);
                }
            }
            Answer::Held { key, held: Err(error) } => {
                self.residency.failed(key);
                if self.residency.state(&key) == State::Failed {
                    self.warnings.push(format!("{error}; a coarser brick is drawn instead"));
                }
            }
        }
    }

    /// Waits until a frame can be drawn as it should be, or as it may be.
    pub(super) fn wait_for(
        &mut self,
        needed: &BTreeMap<HeldKey, SpanRecord>,
        place: usize,
        waited: &mut Waited,
    ) -> anyhow::Result<()> {
        let start = Instant::now();
        let tree = Arc::clone(self.session.tree());
        let root = tree.root();
        let root_key = match self.session.record(&tree, root, self.step_at(place)) {
            Ok(record) => key_of(root.level, &record),
            Err(_) => None,
        };
        let mut missing: Vec<HeldKey> = match self.options.late {
            Late::Wait => needed.keys().copied().chain(root_key).collect(),
            Late::Drop => root_key.into_iter().collect(),
        };
        loop {
            missing.retain(|key| !matches!(self.residency.state(key), State::Resident | State::Failed));
            if missing.is_empty() {
                break;
            }
            if self.residency.num_in_flight() == 0 && self.spans_asked.is_empty() {
                // What does not fit beside the rest is stood in for.
                break;
            }
            self.hear()?;
        }
        waited.ms += start.elapsed().as_secs_f64() * 1e3;
        Ok(())
    }

    /// The list with the nearest ancestor that is in memory in place of what is not.
    pub(super) fn with_stand_ins(&mut self, mut items: Vec<DrawItem>, step: u32) -> (Vec<DrawItem>, usize) {
        let tree = Arc::clone(self.session.tree());
        let mut num_stand_ins = 0;
        for item in items.iter_mut().filter(|item| item.how == How::Payload) {
            if self.can_draw(&tree, item.node, item.steps.start) {
                continue;
            }
            let mut node = item.node;
            while node != tree.root() {
                node = node.parent();
                let Ok(record) = self.session.record(&tree, node, step) else { continue };
                let how = match (record.kind, record.mask) {
                    (SpanKind::Empty, _) => How::Skip,
                    (SpanKind::Constant(value), None) => How::Constant(value),
                    _ if self.can_draw(&tree, node, step) => How::Payload,
                    _ => continue,
                };
                num_stand_ins += 1;
                *item = DrawItem { node, region: item.region, steps: step..step + 1, how };
                break;
            }
        }
        (items, num_stand_ins)
    }

    pub(super) fn can_draw(&mut self, tree: &Octree, node: NodeId, step: u32) -> bool {
        let Ok(record) = self.session.record(tree, node, step) else { return false };
        key_of(node.level, &record).is_none_or(|key| self.session.has(&key))
    }
}
