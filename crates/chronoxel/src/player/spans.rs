//! Spans: what of each node is stored, step by step; read ahead like everything else.

use std::{sync::Arc, time::Instant};

use super::{COARSE_STEPS_PER_FRAME, Player, Waited, loader::Job, nodes::StepSpans};
use crate::session::Spans;

impl Player {
    pub(super) fn num_levels(&self) -> u8 {
        self.session.store().tree().num_levels() as u8
    }

    /// Spans of all levels of a step, if none is missing that can be read.
    pub(super) fn spans_in_memory(&self, step: u32) -> Option<Vec<Option<Spans>>> {
        let of_levels = (0..self.num_levels()).map(|level| match self.spans.get(&(step, level)) {
            Some(spans) => Some(Some(Arc::clone(spans))),
            None => self.spans_failed.contains(&(step, level)).then_some(None),
        });
        of_levels.collect()
    }

    /// Spans of the step to draw, waiting for them; those of the steps after it are asked for.
    pub(super) fn spans_of(&mut self, place: usize, waited: &mut Waited) -> anyhow::Result<StepSpans> {
        let places = std::iter::once(place).chain(self.coming(place));
        let ahead: Vec<u32> = places.map(|place| self.step_at(place)).collect();
        let top = self.num_levels() - 1;
        self.spans.retain(|(step, level), _| *level == top || ahead.contains(step));
        for (distance, step) in ahead.iter().enumerate() {
            for level in 0..self.num_levels() {
                self.ask_for_spans(*step, level, distance == 0);
            }
        }
        self.ask_for_coarse_spans();
        let start = Instant::now();
        loop {
            if let Some(of_levels) = self.spans_in_memory(ahead[0]) {
                waited.ms += start.elapsed().as_secs_f64() * 1e3;
                let spans = StepSpans::new(self.session.tree(), of_levels);
                self.session.give_spans(spans.of_levels(), ahead[0]);
                return Ok(spans);
            }
            self.hear()?;
        }
    }

    /// The coarsest level of all steps, a few more each frame.
    pub(super) fn ask_for_coarse_spans(&mut self) {
        let top = self.num_levels() - 1;
        let end = self.order.len().min(self.coarse_asked + COARSE_STEPS_PER_FRAME);
        for place in self.coarse_asked..end {
            self.ask_for_spans(self.step_at(place), top, false);
        }
        self.coarse_asked = end;
    }

    pub(super) fn ask_for_spans(&mut self, step: u32, level: u8, is_urgent: bool) {
        let key = (step, level);
        let is_known = self.spans.contains_key(&key) || self.spans_failed.contains(&key);
        if !is_known && self.spans_asked.insert(key) {
            self.loader.begin(Job::Spans { level, step }, is_urgent);
        }
    }
}
