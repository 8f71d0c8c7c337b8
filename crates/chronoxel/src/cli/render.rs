//! `render`: one picture.

use std::{path::PathBuf, time::Instant};

use chronoxel_stream::Shares;
use clap::Args;
use serde::Serialize;

use super::{
    args::Common,
    cells::{CellReport, ChosenMethod, legend},
    output,
    view::{Method, StepArgs, ViewArgs},
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
  chronoxel render mesh.cxl --method cells --k 16 -v -o tetrahedra.png
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
    method: &'static str,
    method_reason: &'static str,
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
    /// Where cells were drawn: then samples are their fragments.
    #[serde(skip_serializing_if = "Option::is_none")]
    cells: Option<CellReport>,
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
        let start = Instant::now();
        anyhow::ensure!(
            self.output.extension().is_some_and(|e| e.eq_ignore_ascii_case("png")),
            "{}: pictures are written as PNG; use a name that ends in .png",
            self.output.display()
        );
        let method = self.view.choose_method(&self.store)?;
        if method.method == Method::Cells {
            return self.make_of_cells(common, method, start);
        }
        let mut session = Session::open(&self.store, self.view.variable.as_deref(), common.memory.0)?;
        let moment = self.step.resolve(&session)?;
        let view = self.view.view(&session)?;
        let backend = self.view.choose_backend(&mut session)?;
        let picture = session.draw_moment(&view, moment)?;
        picture.warnings.iter().for_each(|warning| output::warning(warning));
        write_png(&self.output, &self.view.show(&session, &view, &picture, moment)?)?;

        let header = session.store().header();
        Ok(RenderReport {
            method: method.name,
            method_reason: method.reason,
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
            cells: None,
            warnings: picture.warnings,
        })
    }

    fn make_of_cells(
        &self,
        common: &Common,
        method: ChosenMethod,
        start: Instant,
    ) -> anyhow::Result<RenderReport> {
        let (mut session, backend, mut cells) = self.view.open_cells(&self.store, common, false)?;
        let store = std::sync::Arc::clone(session.store());
        let header = store.header();
        let moment = self.step.among(&self.store, &header.times, header.num_steps_finished as usize)?;
        let shot = self.view.cell_shot(&session)?;
        let picture = session.draw_moment(&shot, moment)?;
        cells.add(&picture, session.detail());
        let warnings: Vec<String> = cells.warning().into_iter().collect();
        warnings.iter().for_each(|warning| output::warning(warning));
        write_png(&self.output, &self.view.show_with(&legend(&session, &shot), &picture.image, moment)?)?;
        Ok(RenderReport {
            method: method.name,
            method_reason: method.reason,
            backend: backend.name,
            adapter: backend.adapter,
            backend_reason: backend.reason,
            wall_secs: start.elapsed().as_secs_f64(),
            fetch_ms: picture.fetch_ms,
            render_ms: picture.render_ms,
            samples: cells.num_fragments(),
            bricks: BrickCounts::default().into(),
            samples_of_grid: Shares::default().into(),
            opacity_unit: shot.opacity_unit,
            size: shot.size,
            step: moment.step,
            time: moment.time(&header.times.times),
            time_units: header.times.units.clone(),
            level: 0,
            cells: Some(cells),
            warnings,
        })
    }
}

impl RenderReport {
    fn text(&self, path: &std::path::Path, verbose: bool) -> String {
        let time = format!("t = {} {}", output::number(self.time), self.time_units);
        // What was not asked for is said in any case.
        let method = match self.cells.is_some() && self.method_reason != "asked for" {
            true => ", as cells",
            false => "",
        };
        let line = format!(
            "{}: step {}, {}, {:.0} ms{method}",
            path.display(),
            self.step,
            time.trim_end(),
            self.wall_secs * 1e3
        );
        if !verbose {
            return line;
        }
        if let Some(cells) = &self.cells {
            return format!(
                "{line}\n  method cells ({}); back end {} ({}): {}\n  reading {:.1} ms, drawing {:.1} ms\n  {}\n  \
                 opacities are those of a path of {} world units",
                self.method_reason,
                self.backend,
                self.adapter,
                self.backend_reason,
                self.fetch_ms,
                self.render_ms,
                cells.text(),
                self.opacity_unit
            );
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
