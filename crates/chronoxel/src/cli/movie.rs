//! `movie`: many pictures.

use std::path::PathBuf;

use clap::{Args, builder::NonEmptyStringValueParser};
use serde::Serialize;

use super::{
    WrongUsage,
    args::{Common, StepRange, parse_finite},
    cells::{CellReport, ChosenMethod, legend},
    output,
    view::{Method, ViewArgs, parse_fps},
};
use crate::{
    bytes::ByteSize,
    interrupt,
    movie::{self, Frame, MovieOptions},
    progress::{Counted, Progress},
    session::{Moment, Session},
};

/// Draw a movie through the time steps
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  chronoxel movie run.cxl -o run.gif
  chronoxel movie run.cxl --steps 0:100:2 --orbit 90 --fps 30 -o run.mp4
  chronoxel movie run.cxl -o 'frames/{frame:04}.png'
  chronoxel movie run.cxl --steps 12 --frames 72 --orbit 360 -o turntable.apng")]
pub struct MovieArgs {
    /// The store
    store: PathBuf,
    /// What to write: .mp4 (through ffmpeg), .gif, .apng, or numbered pictures 'f/{frame:04}.png'
    #[arg(short, long, value_name = "OUT", value_parser = NonEmptyStringValueParser::new())]
    output: String,
    /// Steps to show, as 0:100:2 [default: all]
    #[arg(long, value_name = "A:B[:S]", allow_hyphen_values = true)]
    steps: Option<StepRange>,
    /// Number of pictures, the steps being shown evenly over them [default: one per step]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    frames: Option<u32>,
    /// Pictures per second
    #[arg(long, value_name = "FPS", default_value_t = 15.0, value_parser = parse_fps)]
    fps: f64,
    /// Turn about the vertical axis over the whole movie, in degrees
    #[arg(long, value_name = "DEG", default_value_t = 0.0, allow_hyphen_values = true, value_parser = parse_finite)]
    orbit: f64,
    /// Keep partial images, up to so many bytes, while the camera stands still: what does not change is not drawn again
    #[arg(long, value_name = "SIZE", default_value = "0")]
    image_cache: ByteSize,
    #[command(flatten)]
    view: ViewArgs,
}

/// What was made.
#[derive(Debug, Serialize)]
pub struct MovieReport {
    output: String,
    frames: usize,
    size: [usize; 2],
    fps: f64,
    wall_secs: f64,
    method: &'static str,
    method_reason: &'static str,
    backend: &'static str,
    adapter: String,
    /// Where cells were drawn, over all frames.
    #[serde(skip_serializing_if = "Option::is_none")]
    cells: Option<CellReport>,
    warnings: Vec<String>,
}

/// Runs the verb.
pub fn run(common: &Common, args: &MovieArgs) -> anyhow::Result<()> {
    let report = args.make(common)?;
    match common.json {
        true => output::json(&report),
        false if common.quiet => Ok(()),
        false => output::line(&format!(
            "{}: {} pictures of {}x{} in {:.1} s{}",
            report.output,
            report.frames,
            report.size[0],
            report.size[1],
            report.wall_secs,
            if report.cells.is_some() { ", as cells" } else { "" }
        )),
    }
}

impl MovieArgs {
    /// Draws the movie and writes it.
    ///
    /// # Errors
    /// Whatever keeps it from being drawn or written.
    pub fn make(&self, common: &Common) -> anyhow::Result<MovieReport> {
        let start = std::time::Instant::now();
        let method = self.view.choose_method(&self.store)?;
        if method.method == Method::Cells {
            return self.make_of_cells(common, method, start);
        }
        let mut session = Session::open(&self.store, self.view.variable.as_deref(), common.memory.0)?;
        session.keep_images(self.image_cache.0);
        let header = session.store().header().clone();
        let num_finished = header.num_steps_finished as usize;
        let steps = match self.steps {
            Some(range) => range.resolve(num_finished)?,
            None => (0..num_finished).collect(),
        };
        let num_frames = self.frames.map_or(steps.len(), |n| n as usize);
        let options = MovieOptions { size: self.view.size, fps: self.fps, num_frames };
        let mut view = self.view.view(&session)?;
        let backend = self.view.choose_backend(&mut session)?;
        anyhow::ensure!(
            backend.name == "cpu" || self.image_cache.0 == 0,
            "--image-cache is for the CPU: add --backend cpu, or leave it out"
        );
        let mut sink = movie::create(&self.output, options)?;
        let bar =
            Progress::new("movie", num_frames as u64, Counted::Items("frames"), common.quiet || common.json);
        let mut warnings = Vec::new();
        for frame in 0..num_frames {
            interrupt::check()?;
            let step = steps[frame * steps.len() / num_frames];
            let time = header.times.times[step];
            if self.orbit != 0.0 {
                let turn = self.orbit * frame as f64 / num_frames as f64;
                view.camera = self.view.camera.turned(&header.grid, view.size, turn)?;
            }
            let picture = session.draw(&view, step)?;
            for warning in &picture.warnings {
                bar.warn(&format!("chronoxel: warning: step {step}: {warning}"));
                warnings.push(warning.clone());
            }
            let image = self.view.show(&session, &view, &picture, Moment::at(step))?;
            sink.write_frame(&Frame { image: &image, step, time })?;
            bar.advance(1);
        }
        sink.finish()?;
        bar.finish();
        Ok(MovieReport {
            output: self.output.clone(),
            frames: num_frames,
            size: self.view.size,
            fps: self.fps,
            wall_secs: start.elapsed().as_secs_f64(),
            method: method.name,
            method_reason: method.reason,
            backend: backend.name,
            adapter: backend.adapter,
            cells: None,
            warnings,
        })
    }

    fn make_of_cells(
        &self,
        common: &Common,
        method: ChosenMethod,
        start: std::time::Instant,
    ) -> anyhow::Result<MovieReport> {
        if self.image_cache.0 > 0 {
            let text = "--image-cache is for bricks: leave it out with --method cells";
            return Err(WrongUsage(text.into()).into());
        }
        let (mut session, backend, mut cells) = self.view.open_cells(&self.store, common, false)?;
        let times = session.store().header().times.clone();
        let num_finished = session.store().header().num_steps_finished as usize;
        let steps = match self.steps {
            Some(range) => range.resolve(num_finished)?,
            None => (0..num_finished).collect(),
        };
        let num_frames = self.frames.map_or(steps.len(), |n| n as usize);
        let options = MovieOptions { size: self.view.size, fps: self.fps, num_frames };
        let mut shot = self.view.cell_shot(&session)?;
        let mut sink = movie::create(&self.output, options)?;
        let bar =
            Progress::new("movie", num_frames as u64, Counted::Items("frames"), common.quiet || common.json);
        for frame in 0..num_frames {
            interrupt::check()?;
            let step = steps[frame * steps.len() / num_frames];
            if self.orbit != 0.0 {
                let turn = self.orbit * frame as f64 / num_frames as f64;
                shot.camera = self.view.camera.around(session.bounds(), shot.size, turn)?;
            }
            let picture = session.draw(&shot, step)?;
            cells.add(&picture, session.detail());
            let image = self.view.show_with(&legend(&session, &shot), &picture.image, Moment::at(step))?;
            sink.write_frame(&Frame { image: &image, step, time: times.times[step] })?;
            bar.advance(1);
        }
        sink.finish()?;
        bar.finish();
        let warnings: Vec<String> = cells.warning().into_iter().collect();
        warnings.iter().for_each(|warning| output::warning(warning));
        Ok(MovieReport {
            output: self.output.clone(),
            frames: num_frames,
            size: self.view.size,
            fps: self.fps,
            wall_secs: start.elapsed().as_secs_f64(),
            method: method.name,
            method_reason: method.reason,
            backend: backend.name,
            adapter: backend.adapter,
            cells: Some(cells),
            warnings,
        })
    }
}
