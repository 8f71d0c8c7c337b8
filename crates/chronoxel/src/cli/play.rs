//! `play`: steps drawn as fast as they come, headless, and what it took.

mod cells;

use std::{
    io::Write,
    path::PathBuf,
    time::{Duration, Instant},
};

use anyhow::Context;
use clap::{Args, ValueEnum};
use serde::Serialize;

use chronoxel_core::Camera;
use chronoxel_render::ReadBack;

use super::{
    args::{Common, StepRange, parse_finite},
    cells::CellReport,
    output,
    view::{Method, Switch, ViewArgs, parse_fps},
};
use crate::{
    bytes::ByteSize,
    player::{CameraPath, Late, Player, PlayerOptions},
    process::resource_usage,
    progress::{Counted, Progress},
    session::{Session, View},
};

/// Draw steps as fast as they come, and report what it took
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  chronoxel play run.cxl
  chronoxel play run.cxl --size 512x512 --frames 24 --steps 16 --orbit 360      a still step, turning
  chronoxel play run.cxl --memory 512MiB --frames 400 --reverse                 larger than memory, backwards
  chronoxel play run.cxl --target-fps 20 --path flight.json --late drop         at 20 frames per second
  chronoxel play run.cxl --temporal-tolerance 0.02 --image-cache 256MiB
  chronoxel play mesh.cxl --method cells --lod 0.25 --frames 200 --orbit 360
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
    /// Hold this frame rate, by drawing coarser bricks or fewer faces where need be [default: full quality, as fast as it comes]
    #[arg(long, value_name = "F", value_parser = parse_fps)]
    target_fps: Option<f64>,
    /// What to do about a step whose data is not there in time
    #[arg(long, value_enum, value_name = "WHAT", default_value = "wait")]
    late: LateArg,
    /// The most bytes sent to the GPU per frame; coarser bricks stand in for what is still to come
    #[arg(long, value_name = "SIZE")]
    upload_limit: Option<ByteSize>,
    /// Read no more than so many bytes per second, such as 34MB: to see what a slower disk would do
    #[arg(long, value_name = "BYTES/S")]
    throttle: Option<ByteSize>,
    /// Fly along the cameras of a file {"keys": [camera, ...]} over all frames, each as a camera file has it, with its place from 0 to 1 as "at"
    #[arg(long, value_name = "FILE", conflicts_with_all = ["orbit", "camera"])]
    path: Option<PathBuf>,
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

/// What to do about steps that are late.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum LateArg {
    /// Leave them out.
    Drop,
    /// Wait for them.
    Wait,
}

/// One frame as it was measured.
#[derive(Default)]
struct FrameTime {
    step: u32,
    frame_ms: f64,
    /// Part of it that was spent waiting for data.
    wait_ms: f64,
    hits: u64,
    misses: u64,
    num_dropped: u64,
    is_late: bool,
    num_stand_ins: usize,
    num_drawn: usize,
    num_coarse: usize,
    pixels_per_voxel: f64,
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
    method: &'static str,
    method_reason: &'static str,
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
    /// Time that frames waited for data.
    wait_ms: Times,
    /// Steps left out because they were late, and boxes drawn coarser because their own data was.
    dropped_steps: u64,
    /// Frames that showed a step again because the next one was not there.
    late_frames: usize,
    stand_ins: usize,
    /// Nodes drawn from samples, per frame.
    nodes_per_frame: f64,
    /// The most bytes of payloads in memory at once, and those allowed.
    payload_bytes_peak: usize,
    payload_bytes_budget: usize,
    peak_rss_bytes: Option<u64>,
    gpu_bytes_peak: u64,
    mean_pixels_per_voxel: f64,
    size: [usize; 2],
    /// Where cells were drawn, over all frames: then samples are their fragments and nodes their faces.
    #[serde(skip_serializing_if = "Option::is_none")]
    cells: Option<CellReport>,
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
        let method = self.view.choose_method(&self.store)?;
        if method.method == Method::Cells {
            return self.play_cells(common, method);
        }
        let mut session = Session::open(&self.store, self.view.variable.as_deref(), common.memory.0)?;
        session.keep_images(self.image_cache.0);
        let bounds = session.store().header().grid.bounds();
        let steps = self.order_of_steps(session.store().header().num_steps_finished as usize)?;
        let num_frames = self.frames.map_or(steps.len(), |n| n as usize);
        let view = self.view.view(&session)?;
        let backend = self.view.choose_backend(&mut session)?;
        anyhow::ensure!(
            backend.name == "cpu" || self.image_cache.0 == 0,
            "--image-cache is for the CPU: add --backend cpu, or leave it out"
        );
        let cameras = match &self.path {
            Some(path) => Cameras::Path(CameraPath::read(path)?),
            None if self.orbit != 0.0 => Cameras::Orbit(self, bounds),
            None => Cameras::Still,
        };
        let order = steps.iter().map(|step| *step as u32).collect();
        let options = PlayerOptions {
            target_fps: self.target_fps,
            late: if self.late == LateArg::Drop { Late::Drop } else { Late::Wait },
            throttle: self.throttle.map(|rate| rate.0 as f64),
            upload_limit: self.upload_limit.map(|limit| limit.0),
            redraws: true,
            read_back: ReadBack::Bytes,
            loops: num_frames > steps.len(),
        };
        let mut player = Player::new(session, order, options)?;
        if self.warm == Switch::On {
            player.frame(&cameras.view(&view, 0, num_frames)?, 0)?;
            player.rewind();
        }
        let bytes_before = player.session().bytes_from_disk();
        let mut warnings = Vec::new();
        let mut frames = Vec::with_capacity(num_frames);
        let bar =
            Progress::new("play", num_frames as u64, Counted::Items("frames"), common.quiet || common.json);
        for frame in 0..num_frames {
            let view = cameras.view(&view, frame, num_frames)?;
            let (time, place) = self.timed_frame(&mut player, &view, &mut warnings)?;
            frames.push(FrameTime { step: steps[place % steps.len()] as u32, ..time });
            bar.advance(1);
        }
        bar.finish();
        let coarse = frames.iter().map(|f| f.num_coarse).max().unwrap_or(0);
        if self.target_fps.is_none() && coarse > 0 {
            warnings.push(format!(
                "--memory {} holds no more: up to {coarse} bricks of a frame are drawn coarser than the store has them; raise it",
                common.memory
            ));
        }
        warnings.iter().for_each(|warning| output::warning(warning));
        if let Some(path) = &self.csv {
            write_csv(path, &frames).with_context(|| format!("{}: cannot write", path.display()))?;
        }
        Ok(PlayReport {
            method: method.name,
            method_reason: method.reason,
            backend: backend.name,
            adapter: backend.adapter,
            backend_reason: backend.reason,
            bytes_from_disk: player.session().bytes_from_disk() - bytes_before,
            image_bytes_peak: player.session().image_bytes_peak(),
            payload_bytes_peak: player.payload_bytes()[0],
            payload_bytes_budget: player.payload_bytes()[1],
            peak_rss_bytes: resource_usage().map(|usage| usage.peak_rss_bytes),
            size: view.size,
            warnings,
            ..PlayReport::of_frames(&frames)
        })
    }
}

/// Cameras of the frames.
enum Cameras<'a> {
    Still,
    Orbit(&'a PlayArgs, [[f64; 3]; 2]),
    Path(CameraPath),
}

impl Cameras<'_> {
    /// The view of a frame.
    fn view(&self, view: &View, frame: usize, num_frames: usize) -> anyhow::Result<View> {
        Ok(View { camera: self.camera(view.camera, view.size, frame, num_frames)?, ..view.clone() })
    }

    /// The camera of a frame.
    fn camera(
        &self,
        still: Camera,
        size: [usize; 2],
        frame: usize,
        num_frames: usize,
    ) -> anyhow::Result<Camera> {
        match self {
            Self::Still => Ok(still),
            Self::Orbit(args, bounds) => {
                let turn = args.orbit * frame as f64 / num_frames as f64;
                args.view.camera.around(*bounds, size, turn)
            }
            Self::Path(path) => path.camera(frame as f64 / (num_frames - 1).max(1) as f64),
        }
    }
}

impl PlayArgs {
    /// The steps in the order of play.
    fn order_of_steps(&self, num_finished: usize) -> anyhow::Result<Vec<usize>> {
        let mut steps = match self.steps {
            Some(range) => range.resolve(num_finished)?,
            None => (0..num_finished).collect(),
        };
        if self.reverse {
            steps.reverse();
        }
        Ok(steps)
    }

    /// Plays the next frame; also gives its place.
    fn timed_frame(
        &self,
        player: &mut Player,
        view: &View,
        warnings: &mut Vec<String>,
    ) -> anyhow::Result<(FrameTime, usize)> {
        let cpu_secs = || resource_usage().map_or(0.0, |usage| usage.cpu_secs);
        let (start, cpu_start) = (Instant::now(), cpu_secs());
        let played = player.next(view)?;
        let picture = played.picture.context("every frame is drawn")?;
        warnings.extend(picture.warnings);
        let cpu_ms = (cpu_secs() - cpu_start) * 1e3;
        if let Some(fps) = self.target_fps {
            // A frame that is ready early is shown on time.
            let left = Duration::from_secs_f64(1.0 / fps).saturating_sub(start.elapsed());
            std::thread::sleep(left);
        }
        let time = FrameTime {
            step: 0,
            frame_ms: start.elapsed().as_secs_f64() * 1e3,
            wait_ms: played.wait_ms,
            hits: played.hits,
            misses: played.misses,
            num_dropped: played.num_dropped,
            is_late: played.is_late,
            num_stand_ins: played.num_stand_ins,
            num_drawn: played.num_drawn,
            num_coarse: played.num_coarse,
            pixels_per_voxel: played.pixels_per_voxel,
            fetch_ms: picture.fetch_ms,
            render_ms: picture.render_ms,
            cpu_ms,
            samples: picture.samples,
            new_bricks: picture.bricks.new,
            composited_bricks: picture.bricks.composited,
            bytes_uploaded: picture.on_gpu.map_or(0, |gpu| gpu.bytes_uploaded),
            decode_ms: picture.on_gpu.map_or(0.0, |gpu| gpu.decode_ms),
            gpu_bytes_peak: picture.on_gpu.map_or(0, |gpu| gpu.gpu_bytes_peak),
        };
        Ok((time, played.place))
    }
}

fn write_csv(path: &std::path::Path, frames: &[FrameTime]) -> std::io::Result<()> {
    let mut file = std::io::BufWriter::new(std::fs::File::create(path)?);
    writeln!(
        file,
        "frame,step,frame_ms,step_ms,render_ms,cpu_ms,samples,new_bricks,composited_bricks,bytes_uploaded,decode_ms,\
         wait_ms,hits,misses,dropped_steps,is_late,stand_ins,nodes,pixels_per_voxel"
    )?;
    for (number, f) in frames.iter().enumerate() {
        writeln!(
            file,
            "{number},{},{:.3},{:.3},{:.3},{:.3},{},{},{},{},{:.3},{:.3},{},{},{},{},{},{},{:.4}",
            f.step,
            f.frame_ms,
            f.fetch_ms,
            f.render_ms,
            f.cpu_ms,
            f.samples,
            f.new_bricks,
            f.composited_bricks,
            f.bytes_uploaded,
            f.decode_ms,
            f.wait_ms,
            f.hits,
            f.misses,
            f.num_dropped,
            u8::from(f.is_late),
            f.num_stand_ins,
            f.num_drawn,
            f.pixels_per_voxel
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
            method: "",
            method_reason: "",
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
            cache: CacheReport {
                hits: frames.iter().map(|f| f.hits).sum(),
                misses: frames.iter().map(|f| f.misses).sum(),
            },
            wait_ms: Times::of(frames, |f| f.wait_ms),
            dropped_steps: frames.last().map_or(0, |f| f.num_dropped),
            late_frames: frames.iter().filter(|f| f.is_late).count(),
            stand_ins: frames.iter().map(|f| f.num_stand_ins).sum(),
            nodes_per_frame: sum(|f| f.num_drawn as f64) / frames.len() as f64,
            payload_bytes_peak: 0,
            payload_bytes_budget: 0,
            composited_per_frame: sum(|f| f.composited_bricks as f64) / frames.len() as f64,
            image_bytes_peak: 0,
            peak_rss_bytes: None,
            gpu_bytes_peak: frames.iter().map(|f| f.gpu_bytes_peak).max().unwrap_or(0),
            mean_pixels_per_voxel: sum(|f| f.pixels_per_voxel) / frames.len() as f64,
            size: [0; 2],
            cells: None,
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
            times("  waiting", &self.wait_ms),
            times("  new step", &self.step_ms),
            times("  drawing", &self.render_ms),
            times("CPU time", &self.cpu_ms),
        ];
        let samples = if self.cells.is_some() { "fragments" } else { "samples" };
        format!(
            "{} frames of {}x{} on {} ({}): {:.1} frames per second\n{}\n\
             {:.1} million {samples} per frame, {:.0} million per second; {} read; cache: {} hits, {} misses",
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
            + &self.late_text()
            + &self.cells.as_ref().map_or(String::new(), |cells| format!("\nall frames: {}", cells.text()))
    }

    fn late_text(&self) -> String {
        match (self.dropped_steps, self.late_frames, self.stand_ins) {
            (0, 0, 0) => String::new(),
            (steps, frames, boxes) => format!(
                "; late: {steps} steps left out, {frames} frames showed a step again, {boxes} boxes drawn coarser"
            ),
        }
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
