//! Playback on the GPU beside a plain ray caster over one whole texture that is uploaded anew each step, on one adapter, in one run and of the
//! same picture: coded volumes of several sizes, lit, a new step each frame and a still one.

use std::{path::Path, time::Instant};

use chronoxel_core::{ByteImage, ColorMap, Lighting, TransferFunction};
use chronoxel_ingest::{Codec, EncodeOptions, TimeSeries, encode};
use chronoxel_render::{GpuInfo, GpuOptions, GpuRenderer, Way};
use serde_json::{Value, json};

use super::{
    BenchReport, Column, Input, Row, Section, Size, Style, Workplace, machine, object, ripples::Ripples,
    whole_texture::WholeTexture,
};
use crate::{
    interrupt,
    session::{Moment, Session, View, orbit_camera},
};

/// Transfer functions, and whether each frame is of a new step.
const CASES: [(&str, bool); 4] = [("sparse", true), ("sparse", false), ("filled", true), ("filled", false)];
/// Steps that the whole texture takes turns with: what they hold does not matter to what it costs.
const NUM_WHOLE_STEPS: usize = 2;
const STEP_VOXELS: f64 = 0.5;

/// What there is to measure at a size.
struct Plan {
    edges: &'static [usize],
    num_steps: usize,
    size: [usize; 2],
    /// On a program on the CPU.
    size_in_software: [usize; 2],
    /// To measure a frame rate for.
    secs: f64,
}

impl Plan {
    const fn of(size: Size) -> Self {
        let (edges, num_steps, secs): (&[usize], _, _) = match size {
            Size::Tiny => (&[20], 3, 0.0),
            Size::Small => (&[128, 256], 16, 2.0),
            Size::Full => (&[512, 1024], 16, 4.0),
        };
        let (size, size_in_software) = match size {
            Size::Tiny => ([48, 32], [48, 32]),
            _ => ([1920, 1080], [320, 180]),
        };
        Self { edges, num_steps, size, size_in_software, secs }
    }
}

/// Measures fields in closed form, or the user's sources in their place. `progress` is told what is done and what there is to do.
///
/// # Errors
/// If there is no adapter, a source cannot be read or drawn, the workplace cannot be written, or Ctrl-C was pressed.
pub fn run(
    users: Vec<Input>,
    size: Size,
    place: &Workplace,
    memory_bytes: u64,
    progress: &mut dyn FnMut(u64, u64),
) -> anyhow::Result<BenchReport> {
    let plan = Plan::of(size);
    let info = GpuRenderer::adapter(&GpuOptions::default())?;
    let mut inputs = users;
    if inputs.is_empty() {
        // A program on the CPU takes minutes for the smallest.
        let num = if info.is_software { 1 } else { plan.edges.len() };
        for edge in &plan.edges[..num] {
            let ripples = Ripples::new(*edge, plan.num_steps)?;
            inputs.push(Input::of(&format!("ripples, {edge}x{edge}x{edge}"), Box::new(ripples)));
        }
    }
    let total =
        inputs.iter().map(|input| (input.num_steps() + 2 * NUM_WHOLE_STEPS + 4 * CASES.len()) as u64).sum();
    let mut done = 0;
    let mut on_part = || {
        done += 1;
        progress(done, total);
    };
    let mut sections = Vec::new();
    for mut input in inputs {
        let store = place.path("encoded.cxl");
        let options = EncodeOptions {
            codec: Codec::Auto,
            max_error: Some(1.0 / 510.0),
            memory_bytes,
            variables: vec![input.variable().name.clone()],
            ..EncodeOptions::default()
        };
        encode(&mut input.series(), &store, &options, &mut |_| ())?;
        (0..input.num_steps()).for_each(|_| on_part());
        let mut bench =
            Bench { plan: &plan, info: &info, store: &store, memory_bytes, on_part: &mut on_part };
        sections.push(bench.section(&mut input)?);
        place.remove(&store)?;
    }
    Ok(BenchReport { name: "gpu-playback", machine: machine(), sections, plots: Vec::new() })
}

/// One store, measured.
struct Bench<'a> {
    plan: &'a Plan,
    info: &'a GpuInfo,
    store: &'a Path,
    memory_bytes: u64,
    on_part: &'a mut dyn FnMut(),
}

impl Bench<'_> {
    fn section(&mut self, input: &mut Input) -> anyhow::Result<Section> {
        let mut rows: Vec<Row> = CASES
            .map(|(function, is_new)| Row {
                label: format!("{function}, {}", if is_new { "new steps" } else { "still" }),
                ..Row::default()
            })
            .to_vec();
        let mut pictures = Vec::new();
        for way in [Way::Pool, Way::Fetch] {
            self.measure_own(way, &mut rows, &mut pictures)?;
        }
        self.measure_cpu(&mut rows)?;
        let noted = self.measure_whole(input, &mut rows, &pictures)?;
        let [width, height] = self.picture_size();
        let GpuInfo { name, kind, backend, driver, .. } = self.info;
        let mut notes = vec![
            format!("{width}x{height}, lit, {STEP_VOXELS} voxels from sample to sample, on {name} ({kind}, {backend}, {driver})"),
            "all steps resident; pool: decoded once a step; fetch: at each fetch; whole: one texture of 8 bits a sample; pictures stay \
             on the GPU but for `shown`, which is read back in 8 bits; list: selection and the draw list, on the CPU"
                .to_owned(),
            format!("for a GPU of this class, {:?} is the default", Way::for_adapter(self.info)),
        ];
        notes.extend(noted);
        Ok(Section { title: format!("Playback: {}", input.name()), columns: columns(), rows, notes })
    }

    fn picture_size(&self) -> [usize; 2] {
        if self.info.is_software { self.plan.size_in_software } else { self.plan.size }
    }

    fn view(&self, session: &Session, function: &str) -> anyhow::Result<View> {
        let grid = session.store().header().grid;
        let size = self.picture_size();
        Ok(View {
            camera: orbit_camera(&grid, [30.0, 20.0], 1.0, Some(30.0), size)?,
            transfer: session.resolve(&TransferFunction::built_in(function, ColorMap::Viridis)?)?,
            size,
            step_voxels: STEP_VOXELS,
            lighting: Some(Lighting::default()),
            opacity_unit: grid.smallest_spacing(),
            level: 0,
            coherence: None,
            level_borders: Default::default(),
        })
    }

    fn measure_own(
        &mut self,
        way: Way,
        rows: &mut [Row],
        pictures: &mut Vec<ByteImage>,
    ) -> anyhow::Result<()> {
        let mut session = Session::open(self.store, None, self.memory_bytes)?;
        // As much as a pool and the payloads of all steps may take.
        let num_samples = session.store().header().grid.num_samples() as u64;
        let memory_bytes = 24 * num_samples + (256 << 20);
        session.use_gpu(&GpuOptions { way: Some(way), memory_bytes, ..GpuOptions::default() })?;
        let num_steps = session.store().header().num_steps_finished as usize;
        for ((function, is_new), row) in CASES.into_iter().zip(rows) {
            let view = self.view(&session, function)?;
            let steps = if is_new { num_steps } else { 1 };
            let mut sums = [0.0; 4];
            let fps = self.frame_rate(steps, |step, is_timed| {
                let picture = session.draw_unseen(&view, Moment::at(step))?;
                if let (true, Some(gpu)) = (is_timed, picture.on_gpu) {
                    let found = [gpu.decode_ms, picture.fetch_ms, gpu.render_ms, gpu.bytes_uploaded as f64];
                    sums.iter_mut().zip(found).for_each(|(sum, x)| *sum += x);
                }
                Ok(())
            })?;
            let (rate, frames) = fps;
            let [decode_ms, list_ms, render_ms, bytes] = sums.map(|sum| sum / frames as f64);
            let suffix = if way == Way::Pool { "pool" } else { "fetch" };
            row.here.insert(format!("fps_{suffix}"), Value::from(rate));
            row.here.insert(format!("render_ms_{suffix}"), Value::from(render_ms));
            if way == Way::Pool {
                row.here.insert("decode_ms".into(), Value::from(decode_ms));
                row.here.insert("list_ms".into(), Value::from(list_ms));
                row.here.insert("bytes_per_frame".into(), Value::from(bytes));
                let mut last = None;
                let (shown, _) = self.frame_rate(steps, |step, _| {
                    last = Some(session.draw_bytes(&view, Moment::at(step))?.image);
                    Ok(())
                })?;
                row.here.insert("fps_shown".into(), Value::from(shown));
                pictures.push(session.draw_bytes(&view, Moment::at(0))?.image);
            }
            (self.on_part)();
        }
        Ok(())
    }

    fn measure_cpu(&mut self, rows: &mut [Row]) -> anyhow::Result<()> {
        let mut session = Session::open(self.store, None, self.memory_bytes)?;
        let num_steps =
            session.num_resident_steps().clamp(1, session.store().header().num_steps_finished as usize);
        for ((function, is_new), row) in CASES.into_iter().zip(rows) {
            let view = self.view(&session, function)?;
            let steps = if is_new { num_steps } else { 1 };
            let (rate, _) =
                self.frame_rate(steps, |step, _| session.draw_unseen(&view, Moment::at(step)).map(|_| ()))?;
            row.here.insert("fps_cpu".into(), Value::from(rate));
            (self.on_part)();
        }
        Ok(())
    }

    /// Measures the whole texture; says why, where there is none.
    fn measure_whole(
        &mut self,
        input: &mut Input,
        rows: &mut [Row],
        pictures: &[ByteImage],
    ) -> anyhow::Result<Option<String>> {
        let session = Session::open(self.store, None, self.memory_bytes)?;
        let grid = session.store().header().grid;
        let range = session.variable_range();
        let mut whole = match WholeTexture::new(&self.info.name, grid, range) {
            Ok(whole) => whole,
            Err(error) => return Ok(Some(format!("no whole texture: {error:#}"))),
        };
        let num_steps = input.num_steps().min(NUM_WHOLE_STEPS);
        let mut steps = Vec::new();
        for step in 0..num_steps {
            steps.push(bytes_of_step(&mut input.series(), step, range)?);
            (self.on_part)();
        }
        for (i, ((function, is_new), row)) in CASES.into_iter().zip(rows).enumerate() {
            let view = self.view(&session, function)?;
            whole.set_colors(&view);
            whole.upload(&steps[0]);
            let mut upload_ms = 0.0;
            let (rate, frames) = self.frame_rate(num_steps, |step, is_timed| {
                if is_new {
                    let start = Instant::now();
                    whole.upload(&steps[step]);
                    whole.settle()?;
                    upload_ms += if is_timed { start.elapsed().as_secs_f64() * 1e3 } else { 0.0 };
                }
                whole.draw(&view)
            })?;
            whole.upload(&steps[0]);
            whole.draw(&view)?;
            let bytes = if is_new { grid.num_samples() as u64 } else { 0 };
            let own = row.here["fps_pool"].as_f64().unwrap_or(f64::NAN);
            row.here.extend(object(json!({
                "fps_whole": rate,
                "pool_over_whole": own / rate,
                "whole_upload_ms": upload_ms / frames as f64,
                "whole_bytes_per_frame": bytes,
                "psnr_db": psnr_db(&pictures[i], &whole.picture()?),
            })));
            (self.on_part)();
        }
        Ok(None)
    }

    /// Frames per second over steps in turn, once each of them was drawn; and how many frames were timed.
    ///
    /// * `draw`: is told the step, and whether the frame is timed
    fn frame_rate(
        &self,
        num_steps: usize,
        mut draw: impl FnMut(usize, bool) -> anyhow::Result<()>,
    ) -> anyhow::Result<(f64, usize)> {
        let start = Instant::now();
        for step in 0..num_steps {
            interrupt::check()?;
            draw(step, false)?;
            // Where frames take seconds, what the others take to become resident is lost in them.
            if start.elapsed().as_secs_f64() > 8.0 * self.plan.secs.max(1.0) {
                break;
            }
        }
        let (start, mut frames) = (Instant::now(), 0);
        while frames == 0 || start.elapsed().as_secs_f64() < self.plan.secs {
            interrupt::check()?;
            draw(frames % num_steps, true)?;
            frames += 1;
        }
        Ok((frames as f64 / start.elapsed().as_secs_f64(), frames))
    }
}

fn columns() -> Vec<Column> {
    let fixed = |key, heading, digits| Column::here(key, heading, Style::Fixed(digits));
    vec![
        fixed("fps_pool", "fps: pool", 2),
        fixed("fps_shown", "shown", 2),
        fixed("fps_fetch", "fetch", 2),
        fixed("fps_whole", "whole", 2),
        fixed("fps_cpu", "CPU", 2),
        fixed("pool_over_whole", "pool/whole", 2),
        fixed("list_ms", "list ms", 2),
        fixed("decode_ms", "decode ms", 2),
        fixed("render_ms_pool", "rays ms", 2),
        fixed("whole_upload_ms", "whole: upload ms", 2),
        fixed("bytes_per_frame", "bytes up", 0),
        fixed("whole_bytes_per_frame", "whole: bytes up", 0),
        fixed("psnr_db", "PSNR dB", 1),
    ]
}

/// A step in 8 bits over a range, read in slabs.
fn bytes_of_step(series: &mut dyn TimeSeries, step: usize, [low, high]: [f64; 2]) -> anyhow::Result<Vec<u8>> {
    const SLICES: usize = 16;
    let num_slices = series.grid().dims[2];
    let mut bytes = Vec::with_capacity(series.grid().num_samples());
    let mut reader = series.open_step(0, step)?;
    let factor = if high > low { 255.0 / (high - low) } else { 0.0 };
    for first in (0..num_slices).step_by(SLICES) {
        interrupt::check()?;
        let samples = reader.read_slices(SLICES.min(num_slices - first))?.to_f64();
        bytes.extend(samples.iter().map(|v| ((v - low) * factor + 0.5).clamp(0.0, 255.0) as u8));
    }
    Ok(bytes)
}

/// Of pictures of one size, over black; 99 where they are the same.
fn psnr_db(a: &ByteImage, b: &ByteImage) -> f64 {
    let square = |(a, b): (&[u8; 4], &[u8; 4])| -> f64 {
        (0..3).map(|i| (f64::from(a[i]) - f64::from(b[i])).powi(2)).sum()
    };
    let sum: f64 = a.pixels.iter().zip(&b.pixels).map(square).sum();
    let mse = sum / (3 * a.pixels.len()) as f64;
    (10.0 * (255.0f64.powi(2) / mse).log10()).min(99.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_of_pictures() {
        let image = |value: u8| ByteImage { width: 2, height: 1, pixels: vec![[value; 4]; 2] };
        assert_eq!(psnr_db(&image(7), &image(7)), 99.0);
        // 20 log10(255 / 5)
        assert!((psnr_db(&image(10), &image(15)) - 34.1514).abs() < 1e-3);
    }

    #[test]
    fn steps_are_quantised_over_the_range() {
        let mut ripples = Ripples::new(20, 2).unwrap();
        let bytes = bytes_of_step(&mut ripples, 1, [0.25, 0.75]).unwrap();
        assert_eq!(bytes.len(), 8000);
        let samples = ripples.open_step(0, 1).unwrap().read_slices(20).unwrap().to_f64();
        for (byte, sample) in bytes.iter().zip(samples) {
            assert!((f64::from(*byte) / 510.0 + 0.25 - sample.clamp(0.25, 0.75)).abs() < 1.0 / 1019.0);
        }
    }
}
