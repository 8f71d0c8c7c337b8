//! Frame rates with one step again and again, and with a new one each frame, whose values are decoded while the one before is drawn.

use std::{path::Path, sync::Arc, time::Instant};

use chronoxel_render::{CellOptions, CellRenderer, CellScene, GpuOptions, GpuRenderer, ReadBack};
use chronoxel_store::{CellPayload, CellStore};

use super::Size;
use crate::{
    interrupt,
    process::resource_usage,
    session::{CellSession, CellShot, StepValues},
};

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
        Ok(self.payload(step)?.decode(step as u32, values)?)
    }

    /// What is stored of the span of a step.
    fn payload(&mut self, step: usize) -> anyhow::Result<Arc<CellPayload>> {
        let step = step as u32;
        let held = self.held.take().filter(|held| (held.start..held.start + held.len).contains(&step));
        let payload = match held {
            Some(payload) => payload,
            None => self.store.read_span(0, &self.store.span_at(0, step)?)?,
        };
        self.held = Some(Arc::clone(&payload));
        Ok(payload)
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

/// Frames of one step and of new ones on a GPU, which decodes by itself: median seconds.
pub struct GpuSpeed {
    /// The adapter.
    pub name: String,
    pub still_secs: f64,
    pub moving_secs: f64,
}

/// Measures the same on a GPU, pictures of 8 bits read back; `None` where there is none, or one in software that would take too long.
///
/// # Errors
/// If the store is damaged, the GPU fails, or Ctrl-C was pressed.
pub fn measure_gpu(
    path: &Path,
    scenes: &[CellScene],
    num_frames: usize,
    (size, memory_bytes): (Size, u64),
) -> anyhow::Result<Option<GpuSpeed>> {
    let options = GpuOptions::default();
    let Ok(info) = GpuRenderer::adapter(&options) else { return Ok(None) };
    if info.is_software && size != Size::Tiny {
        return Ok(None);
    }
    let mut session = CellSession::open(path, None, memory_bytes, CellOptions::default().k)?;
    session.use_gpu(&options)?;
    let store = Arc::clone(session.store());
    let (num_steps, mut steps) = (store.header().num_steps_finished as usize, Steps::new(&store));
    let (mut still, mut moving) = (Vec::new(), Vec::new());
    let mut draw = |shot: &CellShot, step: usize| -> anyhow::Result<f64> {
        let start = Instant::now();
        let payload = steps.payload(step)?;
        session.draw_values(shot, StepValues::Coded(&payload, step as u32), ReadBack::Bytes)?;
        Ok(start.elapsed().as_secs_f64())
    };
    for scene in scenes {
        let shot = CellShot {
            camera: scene.camera,
            transfer: scene.transfer.clone(),
            size: scene.size,
            lighting: scene.lighting,
            opacity_unit: scene.opacity_unit,
        };
        draw(&shot, 0)?;
        for frame in 0..num_frames {
            interrupt::check()?;
            still.push(draw(&shot, frame % num_steps)?);
            moving.push(draw(&shot, (frame + 1) % num_steps)?);
        }
    }
    let name = format!("{} ({})", info.name, info.kind);
    Ok(Some(GpuSpeed { name, still_secs: median(still), moving_secs: median(moving) }))
}

/// Processor time so far, 0 where the system does not tell.
fn cpu_secs() -> f64 {
    resource_usage().map_or(0.0, |usage| usage.cpu_secs)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
