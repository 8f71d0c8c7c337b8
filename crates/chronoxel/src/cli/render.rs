//! `render`: one picture.

use std::path::PathBuf;

use chronoxel_stream::Shares;
use clap::Args;
use serde::Serialize;

use super::{
    args::Common,
    output,
    view::{StepArgs, ViewArgs},
};
use crate::{
    movie::write_png,
    session::{BrickCounts, Session},
};

/// Draw one picture of a time step
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  chronoxel render run.cxl -t 12 -o step12.png
  chronoxel render run.cxl --time 3.5 --tf sparse --colormap inferno --axes --colorbar -o picture.png
  chronoxel render run.cxl --time 3.72 --blend-steps -o between.png
  chronoxel render run.cxl --azimuth 120 --elevation 45 --zoom 2 --size 1920x1080 -o picture.png
  chronoxel render run.cxl -t 12 --spatial-tolerance 0.05 --temporal-tolerance 0.02 -v -o quick.png
  chronoxel render run.cxl --tf function.json --background white --lighting off -o figure.png")]
pub struct RenderArgs {
    /// The store
    store: PathBuf,
    /// The picture to write
    #[arg(short, long, value_name = "OUT.png")]
    output: PathBuf,
    #[command(flatten)]
    step: StepArgs,
    #[command(flatten)]
    view: ViewArgs,
}

/// What was drawn, and what it took.
#[derive(Serialize)]
pub struct RenderReport {
    backend: &'static str,
    adapter: String,
    backend_reason: String,
    wall_secs: f64,
    fetch_ms: f64,
    render_ms: f64,
    samples: u64,
    bricks: BrickReport,
    samples_of_grid: ShareReport,
    opacity_unit: f64,
    size: [usize; 2],
    step: usize,
    time: f64,
    time_units: String,
    level: u8,
    warnings: Vec<String>,
}

/// Bricks of a picture, as printed.
#[derive(Serialize)]
pub struct BrickReport {
    skipped: usize,
    constant: usize,
    composited: usize,
    reused: usize,
    new: usize,
    drawn: usize,
}

impl From<BrickCounts> for BrickReport {
    fn from(counts: BrickCounts) -> Self {
        let BrickCounts { skipped, constant, composited, reused, new } = counts;
        Self { skipped, constant, composited, reused, new, drawn: counts.drawn() }
    }
}

/// Samples of the grid by how they are drawn, as printed.
#[derive(Serialize)]
pub struct ShareReport {
    skipped: u64,
    constant: u64,
    reused: u64,
    new: u64,
}

impl From<Shares> for ShareReport {
    fn from(Shares { skipped, constant, reused, new }: Shares) -> Self {
        Self { skipped, constant, reused, new }
    }
}

/// Runs the verb.
pub fn run(common: &Common, args: &RenderArgs) -> anyhow::Result<()> {
    let report = args.make(common)?;
    match common.json {
        true => output::json(&report),
        false if common.quiet => Ok(()),
        false => output::line(&report.text(&args.output, common.verbose)),
    }
}

impl RenderArgs {
    /// Draws the picture and writes it.
    ///
    /// # Errors
    /// Whatever keeps it from being drawn or written.
    pub fn make(&self, common: &Common) -> anyhow::Result<RenderReport> {
        let start = std::time::Instant::now();
        anyhow::ensure!(
            self.output.extension().is_some_and(|e| e.eq_ignore_ascii_case("png")),
            "{}: pictures are written as PNG; use a name that ends in .png",
            self.output.display()
        );
        let mut session = Session::open(&self.store, self.view.variable.as_deref(), common.memory.0)?;
        let moment = self.step.resolve(&session)?;
        let view = self.view.view(&session)?;
        let backend = self.view.choose_backend(&mut session)?;
        let picture = session.draw_moment(&view, moment)?;
        picture.warnings.iter().for_each(|warning| output::warning(warning));
        write_png(&self.output, &self.view.show(&session, &view, &picture, moment)?)?;

        let header = session.store().header();
        Ok(RenderReport {
            backend: backend.name,
            adapter: backend.adapter,
            backend_reason: backend.reason,
            wall_secs: start.elapsed().as_secs_f64(),
            fetch_ms: picture.fetch_ms,
            render_ms: picture.render_ms,
            samples: picture.samples,
            bricks: picture.bricks.into(),
            samples_of_grid: picture.shares.into(),
            opacity_unit: view.opacity_unit,
            size: view.size,
            step: moment.step,
            time: moment.time(&header.times.times),
            time_units: header.times.units.clone(),
            level: view.level,
            warnings: picture.warnings,
        })
    }
}

impl RenderReport {
    fn text(&self, path: &std::path::Path, verbose: bool) -> String {
        let time = format!("t = {} {}", output::number(self.time), self.time_units);
        let line = format!(
            "{}: step {}, {}, {:.0} ms",
            path.display(),
            self.step,
            time.trim_end(),
            self.wall_secs * 1e3
        );
        if !verbose {
            return line;
        }
        let b = &self.bricks;
        format!(
            "{line}\n  back end {} ({}): {}; level {}\n  reading {:.1} ms, drawing {:.1} ms, {:.1} million samples\n  \
             bricks: {} new, {} constant, {} skipped\n  opacities are those of a path of {} world units",
            self.backend,
            self.adapter,
            self.backend_reason,
            self.level,
            self.fetch_ms,
            self.render_ms,
            self.samples as f64 / 1e6,
            b.new,
            b.constant,
            b.skipped,
            self.opacity_unit
        )
    }
}
