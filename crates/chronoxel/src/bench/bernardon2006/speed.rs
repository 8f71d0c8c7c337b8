//! Frame rates with one step again and again, and with a new one each frame, whose values are decoded while the one before is drawn.

use std::{sync::Arc, time::Instant};

use chronoxel_render::{CellRenderer, CellScene};
use chronoxel_store::{CellPayload, CellStore};

use crate::{interrupt, process::resource_usage};

/// What drawing costs.
pub struct Speed {
    /// Of a frame of the same step, median, seconds.
    pub still_secs: f64,
    /// Of a frame of the next step.
    pub moving_secs: f64,
    /// Of decoding a step alone.
    pub decode_secs: f64,
    /// Processor time that moving frames took beyond that of still ones, as a share of it; where the system tells.
    pub extra_cpu: Option<f64>,
}

/// Takes steps of a store one after another.
pub struct Steps<'a> {
    store: &'a CellStore,
    held: Option<Arc<CellPayload>>,
}

impl<'a> Steps<'a> {
    pub fn new(store: &'a CellStore) -> Self {
        Self { store, held: None }
    }

    /// Decodes a step of the first variable.
    ///
    /// # Errors
    /// If the store is damaged.
    pub fn decode(&mut self, step: usize, values: &mut [f32]) -> anyhow::Result<()> {
        let step = step as u32;
        let held = self.held.take().filter(|held| (held.start..held.start + held.len).contains(&step));
        let payload = match held {
            Some(payload) => payload,
            None => self.store.read_span(0, &self.store.span_at(0, step)?)?,
        };
        payload.decode(step, values)?;
        self.held = Some(payload);
        Ok(())
    }
}

/// Measures both by turns, so that what else the machine does is the same for both.
///
/// # Errors
/// If the store is damaged or Ctrl-C was pressed.
pub fn measure(
    store: &CellStore,
    renderer: &mut CellRenderer,
    scenes: &[CellScene],
    num_frames: usize,
) -> anyhow::Result<Speed> {
    let num_steps = store.header().num_steps_finished as usize;
    let num_points = store.header().num_points as usize;
    let mut steps = Steps::new(store);
    let (mut values, mut next) = (vec![0.0; num_points], vec![0.0; num_points]);
    steps.decode(0, &mut values)?;
    let [mut still, mut moving, mut decoding] = [(); 3].map(|()| Vec::new());
    let mut cpu = [0.0; 2];
    for scene in scenes {
        // Sorting and binning are of the view, not of a step.
        renderer.render(scene, &values)?;
        for frame in 0..num_frames {
            interrupt::check()?;
            // Of the same values as the moving frame, or what is opaque would differ.
            let (start, before) = (Instant::now(), cpu_secs());
            renderer.render(scene, &values)?;
            still.push(start.elapsed().as_secs_f64());
            let between = cpu_secs();
            let step = (frame + 1) % num_steps;
            let start = Instant::now();
            std::thread::scope(|scope| -> anyhow::Result<()> {
                let decoder = scope.spawn(|| steps.decode(step, &mut next));
                renderer.render(scene, &values)?;
                decoder.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
            })?;
            moving.push(start.elapsed().as_secs_f64());
            cpu = [cpu[0] + between - before, cpu[1] + cpu_secs() - between];
            std::mem::swap(&mut values, &mut next);
            let start = Instant::now();
            steps.decode(step, &mut values)?;
            decoding.push(start.elapsed().as_secs_f64());
        }
    }
    let [still_secs, moving_secs, decode_secs] = [still, moving, decoding].map(median);
    let extra_cpu = (cpu[0] > 0.0).then(|| cpu[1] / cpu[0] - 1.0);
    Ok(Speed { still_secs, moving_secs, decode_secs, extra_cpu })
}

/// Processor time so far, 0 where the system does not tell.
fn cpu_secs() -> f64 {
    resource_usage().map_or(0.0, |usage| usage.cpu_secs)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
