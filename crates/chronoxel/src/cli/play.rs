//! `play`: steps drawn as fast as they come, headless, and what it took.

use std::{io::Write, path::PathBuf, time::Instant};

use anyhow::Context;
use clap::Args;
use serde::Serialize;

use chronoxel_core::{Camera, Projection, UniformGrid};

use super::{
    args::{Common, StepRange, parse_finite},
    output,
    view::{Switch, ViewArgs},
};
use crate::{
    bytes::ByteSize,
    process::resource_usage,
    progress::{Counted, Progress},
    session::{Session, View},
};

/// Draw steps as fast as they come, and report what it took
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  chronoxel play run.cxl
  chronoxel play run.cxl --size 512x512 --frames 24 --steps 16 --orbit 360      a still step, turning
  chronoxel play run.cxl --temporal-tolerance 0.02 --image-cache 256MiB
  chronoxel play run.cxl --lighting off --tf sparse --json --csv frames.csv")]
pub struct PlayArgs {
    /// The store
    store: PathBuf,
    /// Steps to play, as 0:100:2 [default: all]
    #[arg(long, value_name = "A:B[:S]", allow_hyphen_values = true)]
    steps: Option<StepRange>,
    /// Number of frames; steps start over when they run out [default: one per step]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    frames: Option<u32>,
    /// Turn about the vertical axis over all frames, in degrees
    #[arg(long, value_name = "DEG", default_value_t = 0.0, allow_hyphen_values = true, value_parser = parse_finite)]
    orbit: f64,
    /// Play backwards
    #[arg(long)]
    reverse: bool,
    /// Draw the first frame once before the clock starts
    #[arg(long, value_name = "SWITCH", default_value = "on")]
    warm: Switch,
    /// Keep partial images, up to so many bytes, while the camera stands still: what does not change is not drawn again
    #[arg(long, value_name = "SIZE", default_value = "0")]
    image_cache: ByteSize,
    /// Write one line per frame
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    #[command(flatten)]
    view: ViewArgs,
}

/// One frame as it was measured.
struct FrameTime {
    step: usize,
    frame_ms: f64,
    fetch_ms: f64,
    render_ms: f64,
    cpu_ms: f64,
    samples: u64,
    new_bricks: usize,
    composited_bricks: usize,
    bytes_uploaded: u64,
    decode_ms: f64,
    gpu_bytes_peak: u64,
}

#[derive(Serialize)]
struct PlayReport {
    backend: &'static str,
    adapter: String,
    backend_reason: String,
    frames: usize,
    fps: Rates,
    frame_ms: Times,
    /// Selecting, reading and decoding: what a new step costs before it is drawn.
    step_ms: Times,
    render_ms: Times,
    /// Processor time of all threads.
    cpu_ms: Times,
    samples_per_frame: f64,
    samples_per_sec: f64,
    samples_per_cpu_sec: f64,
    bytes_from_disk: u64,
    bytes_uploaded: u64,
    /// Decoding on the GPU, by its clock.
    gpu_decode_ms: Times,
    cache: CacheReport,
    /// Boxes composited from partial images, per frame, and the most bytes that these took.
    composited_per_frame: f64,
    image_bytes_peak: usize,
    peak_rss_bytes: Option<u64>,
    gpu_bytes_peak: u64,
    mean_pixels_per_voxel: f64,
    size: [usize; 2],
    warnings: Vec<String>,
}

#[derive(Serialize)]
struct Rates {
    mean: f64,
    p50: f64,
    p5: f64,
}

#[derive(Serialize)]
struct Times {
    p50: f64,
    p95: f64,
    p99: f64,
    max: f64,
}

#[derive(Serialize)]
struct CacheReport {
    hits: u64,
    misses: u64,
}

/// Runs the verb.
pub fn run(common: &Common, args: &PlayArgs) -> anyhow::Result<()> {
    let report = args.play(common)?;
    match common.json {
        true => output::json(&report),
        false => output::line(&report.text()),
    }
}

impl PlayArgs {
    fn play(&self, common: &Common) -> anyhow::Result<PlayReport> {
        let mut session = Session::open(&self.store, self.view.variable.as_deref(), common.memory.0)?;
        session.keep_images(self.image_cache.0);
        let grid = session.store().header().grid;
        let num_finished = session.store().header().num_steps_finished as usize;
        let mut steps = match self.steps {
            Some(range) => range.resolve(num_finished)?,
            None => (0..num_finished).collect(),
        };
        if self.reverse {
            steps.reverse();
        }
        let num_frames = self.frames.map_or(steps.len(), |n| n as usize);
        let mut view = self.view.view(&session)?;
        let backend = self.view.choose_backend(&mut session)?;
        anyhow::ensure!(
            backend.name == "cpu" || self.image_cache.0 == 0,
            "--image-cache is for the CPU: add --backend cpu, or leave it out"
        );
        if self.warm == Switch::On {
            session.draw(&view, steps[0])?;
        }
        let bytes_before = session.bytes_from_disk();
        let mut warnings = Vec::new();
        let mut frames = Vec::with_capacity(num_frames);
        let mut pixels_per_voxel = 0.0;
        let bar =
            Progress::new("play", num_frames as u64, Counted::Items("frames"), common.quiet || common.json);
        for frame in 0..num_frames {
            if self.orbit != 0.0 {
                let turn = self.orbit * frame as f64 / num_frames as f64;
                view.camera = self.view.camera.turned(&grid, view.size, turn)?;
            }
            let step = steps[frame % steps.len()];
            let (time, new_warnings) = timed_frame(&mut session, &view, step)?;
            frames.push(time);
            warnings.extend(new_warnings);
            pixels_per_voxel += self::pixels_per_voxel(&view.camera, &grid, view.size) / num_frames as f64;
            bar.advance(1);
        }
        bar.finish();
        warnings.iter().for_each(|warning| output::warning(warning));
        if let Some(path) = &self.csv {
            write_csv(path, &frames).with_context(|| format!("{}: cannot write", path.display()))?;
        }
        Ok(PlayReport {
            backend: backend.name,
            adapter: backend.adapter,
            backend_reason: backend.reason,
            bytes_from_disk: session.bytes_from_disk() - bytes_before,
            cache: CacheReport { hits: session.cache_counts().hits, misses: session.cache_counts().misses },
            image_bytes_peak: session.image_bytes_peak(),
            peak_rss_bytes: resource_usage().map(|usage| usage.peak_rss_bytes),
            mean_pixels_per_voxel: pixels_per_voxel * f64::from(1u32 << view.level),
            size: view.size,
            warnings,
            ..PlayReport::of_frames(&frames)
        })
    }
}

fn timed_frame(session: &mut Session, view: &View, step: usize) -> anyhow::Result<(FrameTime, Vec<String>)> {
    let cpu_secs = || resource_usage().map_or(0.0, |usage| usage.cpu_secs);
    let (start, cpu_start) = (Instant::now(), cpu_secs());
    let picture = session.draw(view, step)?;
    let time = FrameTime {
        step,
        frame_ms: start.elapsed().as_secs_f64() * 1e3,
        fetch_ms: picture.fetch_ms,
        render_ms: picture.render_ms,
        cpu_ms: (cpu_secs() - cpu_start) * 1e3,
        samples: picture.samples,
        new_bricks: picture.bricks.new,
        composited_bricks: picture.bricks.composited,
        bytes_uploaded: picture.on_gpu.map_or(0, |gpu| gpu.bytes_uploaded),
        decode_ms: picture.on_gpu.map_or(0.0, |gpu| gpu.decode_ms),
        gpu_bytes_peak: picture.on_gpu.map_or(0, |gpu| gpu.gpu_bytes_peak),
    };
    Ok((time, picture.warnings))
}

/// Edge of a level-0 voxel in pixels, where the camera looks at.
fn pixels_per_voxel(camera: &Camera, grid: &UniformGrid, size: [usize; 2]) -> f64 {
    let distance = match camera.projection() {
        Projection::Orthographic { .. } => 1.0,
        Projection::Perspective { .. } => {
            (0..3).map(|a| (camera.position()[a] - camera.look_at()[a]).powi(2)).sum::<f64>().sqrt()
        }
    };
    grid.smallest_spacing() * size[1] as f64 / (2.0 * camera.half_height() * distance)
}

fn write_csv(path: &std::path::Path, frames: &[FrameTime]) -> std::io::Result<()> {
    let mut file = std::io::BufWriter::new(std::fs::File::create(path)?);
    writeln!(
        file,
        "frame,step,frame_ms,step_ms,render_ms,cpu_ms,samples,new_bricks,composited_bricks,bytes_uploaded,decode_ms"
    )?;
    for (number, f) in frames.iter().enumerate() {
        writeln!(
            file,
            "{number},{},{:.3},{:.3},{:.3},{:.3},{},{},{},{},{:.3}",
            f.step,
            f.frame_ms,
            f.fetch_ms,
            f.render_ms,
            f.cpu_ms,
            f.samples,
            f.new_bricks,
            f.composited_bricks,
            f.bytes_uploaded,
            f.decode_ms
        )?;
    }
    file.flush()
}

/// The value below which a share of the values lie, by the nearest rank.
fn quantile(values: &[f64], share: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let rank = (share * sorted.len() as f64).ceil() as usize;
    sorted[rank.clamp(1, sorted.len()) - 1]
}

impl Times {
    fn of(frames: &[FrameTime], time: impl Fn(&FrameTime) -> f64) -> Self {
        let values: Vec<f64> = frames.iter().map(time).collect();
        let [p50, p95, p99, max] = [0.5, 0.95, 0.99, 1.0].map(|share| quantile(&values, share));
        Self { p50, p95, p99, max }
    }
}

impl PlayReport {
    fn of_frames(frames: &[FrameTime]) -> Self {
        let sum = |value: fn(&FrameTime) -> f64| frames.iter().map(value).sum::<f64>();
        let (frame_ms, samples) = (sum(|f| f.frame_ms), sum(|f| f.samples as f64));
        let rates: Vec<f64> = frames.iter().map(|f| 1e3 / f.frame_ms).collect();
        Self {
            backend: "",
            adapter: String::new(),
            backend_reason: String::new(),
            frames: frames.len(),
            fps: Rates {
                mean: frames.len() as f64 * 1e3 / frame_ms,
                p50: quantile(&rates, 0.5),
                p5: quantile(&rates, 0.05),
            },
            frame_ms: Times::of(frames, |f| f.frame_ms),
            step_ms: Times::of(frames, |f| f.fetch_ms),
            render_ms: Times::of(frames, |f| f.render_ms),
            cpu_ms: Times::of(frames, |f| f.cpu_ms),
            samples_per_frame: samples / frames.len() as f64,
            samples_per_sec: samples / sum(|f| f.render_ms) * 1e3,
            samples_per_cpu_sec: samples / sum(|f| f.cpu_ms) * 1e3,
            bytes_from_disk: 0,
            bytes_uploaded: frames.iter().map(|f| f.bytes_uploaded).sum(),
            gpu_decode_ms: Times::of(frames, |f| f.decode_ms),
            cache: CacheReport { hits: 0, misses: 0 },
            composited_per_frame: sum(|f| f.composited_bricks as f64) / frames.len() as f64,
            image_bytes_peak: 0,
            peak_rss_bytes: None,
            gpu_bytes_peak: frames.iter().map(|f| f.gpu_bytes_peak).max().unwrap_or(0),
            mean_pixels_per_voxel: 0.0,
            size: [0; 2],
            warnings: Vec::new(),
        }
    }

    fn images_text(&self) -> String {
        match self.image_bytes_peak {
            0 => String::new(),
            bytes => format!(
                "; partial images: {:.1} boxes per frame, {}",
                self.composited_per_frame,
                crate::bytes::ByteSize(bytes as u64)
            ),
        }
    }

    fn text(&self) -> String {
        let times = |name: &str, t: &Times| {
            let values = [t.p50, t.p95, t.p99, t.max].map(|ms| format!("{ms:.1}"));
            [&[name.to_owned()], &values[..]].concat()
        };
        let heading = ["ms", "median", "95 %", "99 %", "largest"].map(str::to_owned).to_vec();
        let rows = [
            heading,
            times("frame", &self.frame_ms),
            times("  new step", &self.step_ms),
            times("  drawing", &self.render_ms),
            times("CPU time", &self.cpu_ms),
        ];
        format!(
            "{} frames of {}x{} on {} ({}): {:.1} frames per second\n{}\n\
             {:.1} million samples per frame, {:.0} million per second; {} read; cache: {} hits, {} misses",
            self.frames,
            self.size[0],
            self.size[1],
            self.backend,
            self.adapter,
            self.fps.mean,
            output::table(&rows),
            self.samples_per_frame / 1e6,
            self.samples_per_sec / 1e6,
            crate::bytes::ByteSize(self.bytes_from_disk),
            self.cache.hits,
            self.cache.misses
        ) + &self.images_text()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_by_nearest_rank() {
        let values: Vec<f64> = (1..=100).rev().map(f64::from).collect();
        assert_eq!([0.05, 0.5, 0.95, 1.0].map(|s| quantile(&values, s)), [5.0, 50.0, 95.0, 100.0]);
        assert_eq!(quantile(&[7.0], 0.05), 7.0);
    }
}
