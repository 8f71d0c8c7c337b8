//! Which faces are worth drawing, from the values of a series.

use chronoxel_render::{FaceOrder, Variation, static_importance};
use rayon::prelude::*;

use super::{CellSession, decode_into};

/// What tells how much a face matters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Importance {
    /// How much the values at its points vary over some steps, in rising order.
    Variation(Vec<usize>),
    /// The values of one step, for comparison: every class of its histogram alike.
    Static(usize),
}

/// Steps that are decoded at once are as many as there are threads, but no more than so many.
const MOST_AT_ONCE: usize = 16;
/// Part of the memory that they may take.
const VALUES_SHARE: f64 = 0.3;
/// For the order in which faces of a class of the histogram come.
const SEED: u64 = 1;

impl CellSession {
    /// Finds the order in which faces are worth drawing.
    ///
    /// * `advance`: told of each step that was looked at
    ///
    /// # Errors
    /// If steps are out of range or damaged.
    pub fn measure_importance(
        &mut self,
        importance: &Importance,
        advance: &mut dyn FnMut() -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let order = match importance {
            Importance::Static(step) => {
                let mut values = Vec::new();
                self.read_values(*step as u32, &mut values)?;
                advance()?;
                FaceOrder::by_importance(&self.mesh, &static_importance(&self.mesh, &values, SEED))
            }
            Importance::Variation(steps) => self.variation(steps, advance)?,
        };
        self.order = Some(order);
        let choice = self.choice();
        self.drawer.choose(choice);
        Ok(())
    }

    fn variation(
        &self,
        steps: &[usize],
        advance: &mut dyn FnMut() -> anyhow::Result<()>,
    ) -> anyhow::Result<FaceOrder> {
        let num_points = self.mesh.num_points();
        let fitting = (self.memory_bytes as f64 * VALUES_SHARE) as usize / (4 * num_points.max(1));
        let num_at_once = rayon::current_num_threads().min(MOST_AT_ONCE).min(fitting).max(1);
        let mut variation = Variation::new(num_points);
        let mut buffers = vec![Vec::new(); num_at_once];
        let mut rest = steps;
        while let Some(&first) = rest.first() {
            let record = self.store.span_at(self.variable, first as u32)?;
            let payload = self.store.read_span(self.variable, &record)?;
            let end = (record.start + record.len) as usize;
            let (of_span, after) = rest.split_at(rest.partition_point(|step| *step < end));
            rest = after;
            for batch in of_span.chunks(num_at_once) {
                let jobs = buffers.par_iter_mut().zip(batch).with_max_len(1);
                jobs.try_for_each(|(values, step)| decode_into(&self.store, &payload, *step as u32, values))?;
                for values in &buffers[..batch.len()] {
                    variation.push(values);
                    advance()?;
                }
            }
        }
        Ok(variation.order(&self.mesh, self.variable_range()))
    }
}
