//! `encode`: from source files to a store.

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde::Serialize;

use chronoxel_ingest::{
    CellOptions, CellReport, EncodeReport, MeshCensus, MeshSeries, Opened, TimeSeries, VoxelOptions,
    VoxelReport,
    encode::{self, Codec, EncodeOptions, encode, encode_cells, encode_mesh},
};

use super::{
    WrongUsage,
    args::{Common, SourceArgs, parse_not_negative, parse_range, parse_store_path},
    output,
    view::Switch,
};
use crate::{
    bytes::ByteSize,
    interrupt::Advice,
    process::{resource_usage, return_large_blocks},
    progress::{Counted, Progress},
};

/// Read a series of volumes once, and write it as a store
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  chronoxel encode 'run/density_*.vti' -o run.cxl
  chronoxel encode series.pvd -o run.cxl --variable pressure --max-error 0.001
  chronoxel encode 'scan_*.raw' --dims 512x512x300 --dtype u16 --spacing 0.5,0.5,1 -o scan.cxl
  chronoxel encode 'sim:vortex?dims=128&steps=32' -o vortex.cxl --bits 1      one bit per sample and step
  chronoxel encode 'sim:shockbubble?steps=64' -o shock.cxl --codec vq --window 8
  chronoxel encode 'run/frames_*.vti' -o run.cxl --max-error 0      without loss: integers of up to 16 bits
  chronoxel encode 'run/density_*.vti' -o run.cxl --resume      go on after an interruption
  chronoxel encode 'wing_*.vtu' -o wing.cxl --max-depth 7 --field-threshold 0.01      a mesh, resampled to bricks
  chronoxel encode 'wing_*.vtu' -o wing.cxl --as cells --max-error 0.001      its tetrahedra as they are")]
pub struct EncodeArgs {
    #[command(flatten)]
    source: SourceArgs,
    /// The store to write; must end in .cxl
    #[arg(short, long, value_name = "STORE", value_parser = parse_store_path)]
    output: PathBuf,
    /// How samples are coded
    #[arg(long, value_name = "CODEC", default_value = "auto")]
    codec: CodecName,
    /// Largest error of any sample, in units of the variable's range, such as 0.001
    #[arg(long, value_name = "E", value_parser = parse_not_negative)]
    max_error: Option<f64>,
    /// Bits per sample and step: with auto what the store takes on average; with raw 8 or 16
    #[arg(long, value_name = "B", value_parser = parse_not_negative, conflicts_with = "max_error")]
    bits: Option<f64>,
    /// Time steps coded as one: 1, 2, 4, 8 or 16 [default: 8 for palettes, at most 16 for auto]
    #[arg(long, value_name = "N")]
    window: Option<u32>,
    /// Stages of a palette, each coding what those before leave: 1, 2 or 3 [default: 1]
    #[arg(long, value_name = "N")]
    stages: Option<u8>,
    /// Begin the windows of different bricks at different steps, so that no step of playing replaces many bricks at once
    #[arg(long, value_name = "SWITCH", default_value = "on")]
    interleave: Switch,
    /// Samples along the edge of a brick's core: 8, 16, 32, 64 or 128
    #[arg(long, value_name = "N", default_value_t = 32, value_parser = parse_brick)]
    brick: usize,
    /// Range of values that --max-error refers to [default: the range seen so far]
    #[arg(long, value_name = "MIN:MAX", value_parser = parse_range, allow_hyphen_values = true)]
    range: Option<[f64; 2]>,
    /// What a mesh becomes [default: bricks]
    #[arg(long = "as", value_name = "FORM")]
    form: Option<Form>,
    /// Of cells: entries of each table of the coder, 2 to 1024, more for fields that change much; --max-error takes more where it needs
    /// them [default: 256]
    #[arg(long, value_name = "N")]
    entries: Option<usize>,
    /// Of a mesh: points around which the field differs by more than this share of its range, at any step, get a voxel of their
    /// own [default: 0: wherever it differs]
    #[arg(long, value_name = "E", value_parser = parse_not_negative)]
    field_threshold: Option<f64>,
    /// Of a mesh: most levels below the root, which is one brick [default: 5]
    #[arg(long, value_name = "N")]
    max_depth: Option<u8>,
    /// Go on with a store that was interrupted
    #[arg(long, conflicts_with = "overwrite")]
    resume: bool,
    /// Replace a store that exists
    #[arg(long)]
    overwrite: bool,
}

/// Names of the codecs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum CodecName {
    /// Per brick, the fewest bytes within --max-error, or the least error at --bits; without either as raw
    Auto,
    /// 8 or 16 bits for every sample, within the brick's range
    Raw,
    /// One byte for every sample and window of time steps: DCT and Lloyd-Max quantisers (lum2001)
    Palette,
    /// The same, one quantiser for each slice of the volume (lum2001): to compare with
    PaletteSlice,
    /// One byte for every sample and window of time steps: tables trained on the brick's time series
    Vq,
}

/// What a mesh can become.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Form {
    /// An octree of bricks, deeper where the mesh is finer (leven2002)
    Bricks,
    /// Its tetrahedra as they are, and values at its points in blocks of 64 steps (bernardon2006), for --method cells
    Cells,
    /// Bricks, and cells in the same store; the source is read once more for them
    Both,
}

fn parse_brick(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(edge @ (8 | 16 | 32 | 64 | 128)) => Ok(edge),
        _ => Err(format!("{text:?} samples are not an edge of bricks; use 8, 16, 32, 64 or 128")),
    }
}

/// What was encoded, as it is printed.
#[derive(Debug, Serialize)]
pub struct EncodeSummary {
    store: PathBuf,
    raw_bytes: u64,
    stored_bytes: u64,
    /// Raw over stored.
    pub ratio: f64,
    bits_per_sample: f64,
    wall_secs: f64,
    bytes_per_sec: f64,
    peak_rss_bytes: Option<u64>,
    steps_read: usize,
    steps_resumed: usize,
    masked_samples: u64,
    infinite_samples: u64,
    threads: usize,
    /// What became of a mesh.
    #[serde(skip_serializing_if = "Option::is_none")]
    mesh: Option<VoxelReport>,
    /// The cells, where the store has any.
    #[serde(skip_serializing_if = "Option::is_none")]
    cells: Option<CellReport>,
}

/// Runs the verb.
pub fn run(common: &Common, args: &EncodeArgs) -> anyhow::Result<()> {
    let defaults = VoxelOptions::default();
    let voxels = VoxelOptions {
        field_threshold: args.field_threshold.unwrap_or(defaults.field_threshold),
        max_depth: args.max_depth.unwrap_or(defaults.max_depth),
    };
    let options = EncodeOptions {
        voxels,
        codec: match args.codec {
            CodecName::Auto => Codec::Auto,
            CodecName::Raw => Codec::Raw,
            CodecName::Palette => Codec::Palette,
            CodecName::PaletteSlice => Codec::PaletteSlice,
            CodecName::Vq => Codec::Vq,
        },
        bits: args.bits,
        window: args.window,
        stages: args.stages,
        interleaved: args.interleave == Switch::On,
        max_error: args.max_error,
        range: args.range,
        brick_edge: args.brick,
        fill_value: args.source.hints.fill_value,
        source_name: args.source.source.join(" "),
        variables: args.source.hints.variable.clone(),
        resume: args.resume,
        overwrite: args.overwrite,
        ..options_of(common)
    };
    options.check().map_err(|error| WrongUsage(error.to_string()))?;
    let summary = match args.source.hints.open_any(common, &args.source.source)? {
        Opened::Volume(mut series) => {
            args.check_no_mesh_options()?;
            encode_series(common, series.as_mut(), &args.output, &options)?
        }
        Opened::Mesh(mut mesh) => args.encode_mesh(common, mesh.as_mut(), &options)?,
    };
    match common.json {
        true => output::json(&summary),
        false if common.quiet => Ok(()),
        false => output::line(&summary.text()),
    }
}

impl EncodeArgs {
    /// Encodes a mesh in the form that was asked for.
    fn encode_mesh(
        &self,
        common: &Common,
        mesh: &mut dyn MeshSeries,
        options: &EncodeOptions,
    ) -> anyhow::Result<EncodeSummary> {
        let form = self.form.unwrap_or(Form::Bricks);
        self.check_form(form)?;
        let entries = self.entries.unwrap_or(CellOptions::default().entries);
        if form == Form::Cells {
            let cells = CellOptions { entries, nested: false };
            let report = encode_cell_series(common, mesh, &self.output, options, &cells)?;
            return Ok(EncodeSummary::of_cells(&self.output, report));
        }
        let mut summary = encode_mesh_series(common, mesh, &self.output, options)?;
        if form == Form::Both {
            let cells = CellOptions { entries, nested: true };
            summary.cells = Some(encode_cell_series(common, mesh, &self.output, options, &cells)?);
        }
        Ok(summary)
    }

    /// Refuses options of another form than that which was asked for.
    fn check_form(&self, form: Form) -> anyhow::Result<()> {
        let refuse = |options: &[(bool, &str)], of: &str| match options.iter().find(|(is_given, _)| *is_given)
        {
            Some((_, option)) => {
                let name = format!("{form:?}").to_lowercase();
                Err(WrongUsage(format!("{option} is of {of}: leave it out with --as {name}")).into())
            }
            None => Ok(()),
        };
        match form {
            Form::Bricks => refuse(&[(self.entries.is_some(), "--entries")], "cells"),
            Form::Cells => {
                let given = [
                    (self.codec != CodecName::Auto, "--codec"),
                    (self.bits.is_some(), "--bits"),
                    (self.window.is_some(), "--window"),
                    (self.stages.is_some(), "--stages"),
                    (self.field_threshold.is_some(), "--field-threshold"),
                    (self.max_depth.is_some(), "--max-depth"),
                ];
                refuse(&given, "bricks")
            }
            Form::Both => Ok(()),
        }
    }

    /// Refuses what only a mesh takes.
    fn check_no_mesh_options(&self) -> anyhow::Result<()> {
        if matches!(self.form, Some(Form::Cells | Form::Both)) {
            anyhow::bail!(
                "--as: the source is a uniform grid: it has no cells to keep, leave --as out for bricks"
            );
        }
        let given = [
            (self.form.is_some(), "--as"),
            (self.field_threshold.is_some(), "--field-threshold"),
            (self.max_depth.is_some(), "--max-depth"),
            (self.entries.is_some(), "--entries"),
        ];
        match given.iter().find(|(is_given, _)| *is_given) {
            Some((_, option)) => {
                anyhow::bail!("{option}: the source is a uniform grid, which is bricks already: leave it out")
            }
            None => Ok(()),
        }
    }
}

/// Default options within the memory that the user gave.
pub fn options_of(common: &Common) -> EncodeOptions {
    EncodeOptions { memory_bytes: common.memory.0, ..EncodeOptions::default() }
}

/// Below this, what the allocator keeps matters.
const TIGHT_MEMORY: ByteSize = ByteSize(1 << 30);

/// Encodes a series behind a progress bar.
pub fn encode_series(
    common: &Common,
    series: &mut dyn TimeSeries,
    store: &Path,
    options: &EncodeOptions,
) -> anyhow::Result<EncodeSummary> {
    let num_variables = series.variables().len();
    let num_samples = series.grid().num_samples() as u64 * series.times().num_steps() as u64;
    behind_bar(common, store, options, [num_samples, num_variables as u64], |progress| {
        Ok(encode(series, store, options, progress)?)
    })
}

/// Encodes a mesh behind a progress bar.
fn encode_mesh_series(
    common: &Common,
    mesh: &mut dyn MeshSeries,
    store: &Path,
    options: &EncodeOptions,
) -> anyhow::Result<EncodeSummary> {
    let num_variables = mesh.variables().len();
    let num_samples = mesh.num_points() as u64 * mesh.times().num_steps() as u64;
    behind_bar(common, store, options, [num_samples, num_variables as u64], |progress| {
        Ok(encode_mesh(mesh, store, options, progress)?)
    })
}

/// Encodes the cells of a mesh behind a progress bar.
fn encode_cell_series(
    common: &Common,
    mesh: &mut dyn MeshSeries,
    store: &Path,
    options: &EncodeOptions,
    cells: &CellOptions,
) -> anyhow::Result<CellReport> {
    let report =
        with_bar(common, store, |progress| Ok(encode_cells(mesh, store, options, cells, progress)?))?;
    warn_of_infinite(report.num_infinite);
    Ok(report)
}

/// Runs an encoding behind a progress bar, with advice for who interrupts it.
fn with_bar<R>(
    common: &Common,
    store: &Path,
    run: impl FnOnce(&mut dyn FnMut(encode::Progress)) -> anyhow::Result<R>,
) -> anyhow::Result<R> {
    if common.memory < TIGHT_MEMORY {
        return_large_blocks();
    }
    let _advice = Advice::begin(format!(
        "{} opens up to the last finished step; encode again with --resume to go on",
        store.display()
    ));
    let mut bar: Option<Progress> = None;
    let report = run(&mut |done| {
        let bar = bar.get_or_insert_with(|| {
            Progress::new("encode", done.raw_bytes, Counted::Bytes, common.quiet || common.json)
        });
        bar.set(done.done_bytes);
    })?;
    if let Some(bar) = bar {
        bar.finish();
    }
    Ok(report)
}

fn warn_of_infinite(num_infinite: u64) {
    if num_infinite > 0 {
        output::warning(&format!("{num_infinite} infinite samples were masked, as NaN is"));
    }
}

/// * `numbers`: of source samples of a variable, and of variables in the source
fn behind_bar(
    common: &Common,
    store: &Path,
    options: &EncodeOptions,
    [num_samples, num_variables]: [u64; 2],
    run: impl FnOnce(&mut dyn FnMut(encode::Progress)) -> anyhow::Result<EncodeReport>,
) -> anyhow::Result<EncodeSummary> {
    let report = with_bar(common, store, run)?;
    warn_of_infinite(report.num_infinite);
    let num_variables = match options.variables.len() {
        0 => num_variables,
        n => n as u64,
    };
    let num_steps = (report.steps_read + report.steps_resumed).max(1);
    let read_bytes = report.raw_bytes as f64 * report.steps_read as f64 / num_steps as f64;
    Ok(EncodeSummary {
        store: store.to_owned(),
        raw_bytes: report.raw_bytes,
        stored_bytes: report.stored_bytes,
        ratio: report.raw_bytes as f64 / report.stored_bytes as f64,
        bits_per_sample: report.stored_bytes as f64 * 8.0 / (num_samples * num_variables) as f64,
        wall_secs: report.wall_secs,
        bytes_per_sec: read_bytes / report.wall_secs,
        peak_rss_bytes: resource_usage().map(|usage| usage.peak_rss_bytes),
        steps_read: report.steps_read,
        steps_resumed: report.steps_resumed,
        masked_samples: report.num_masked,
        infinite_samples: report.num_infinite,
        threads: rayon::current_num_threads(),
        mesh: report.voxels,
        cells: None,
    })
}

impl EncodeSummary {
    /// Of a store that is cells alone.
    fn of_cells(store: &Path, report: CellReport) -> Self {
        let num_steps = (report.steps_read + report.steps_resumed).max(1);
        let read_bytes = report.raw_bytes as f64 * report.steps_read as f64 / num_steps as f64;
        let num_values = report.num_points * num_steps as u64;
        Self {
            store: store.to_owned(),
            raw_bytes: report.raw_bytes,
            stored_bytes: report.stored_bytes,
            ratio: report.ratio,
            bits_per_sample: report.stored_bytes as f64 * 8.0
                / num_values as f64
                / report.num_variables as f64,
            wall_secs: report.wall_secs,
            bytes_per_sec: read_bytes / report.wall_secs,
            peak_rss_bytes: resource_usage().map(|usage| usage.peak_rss_bytes),
            steps_read: report.steps_read,
            steps_resumed: report.steps_resumed,
            masked_samples: report.num_masked,
            infinite_samples: report.num_infinite,
            threads: rayon::current_num_threads(),
            mesh: None,
            cells: Some(report),
        }
    }

    /// One line for people.
    pub fn text(&self) -> String {
        let done = match (self.steps_read, self.steps_resumed) {
            (0, _) => "all steps were there already".to_owned(),
            (read, resumed) => {
                let more = if resumed > 0 { " more" } else { "" };
                let (secs, rate) = (self.wall_secs, ByteSize(self.bytes_per_sec as u64));
                format!("{read}{more} steps in {secs:.1} s ({rate}/s, {} threads)", self.threads)
            }
        };
        let mut mesh = self.mesh.map_or(String::new(), |mesh| format!("\n{}", mesh_text(&mesh)));
        if let Some(cells) = &self.cells {
            mesh += &format!("\n{}", cells_text(cells));
        }
        format!(
            "{}: {} of samples in {} ({:.1} : 1, {:.2} bits per sample), {done}{mesh}",
            self.store.display(),
            ByteSize(self.raw_bytes),
            ByteSize(self.stored_bytes),
            self.ratio,
            self.bits_per_sample,
        )
    }
}

/// What became of a mesh, for people.
fn mesh_text(mesh: &VoxelReport) -> String {
    let census = &mesh.census;
    let mut text = format!(
        "{} tetrahedra from {} cells in {} leaves of mean depth {:.2}, at most {}, in {:.1} s",
        census.num_tetrahedra,
        census.cells.total(),
        mesh.num_leaves,
        mesh.mean_depth,
        mesh.max_depth,
        mesh.secs[0] + mesh.secs[1],
    );
    if mesh.num_cut_off > 0 {
        text += &format!(
            "; {} leaves of depth {} have voxels with several points (--max-depth)",
            mesh.num_cut_off, mesh.max_depth
        );
    }
    text + &left_out_text(census)
}

/// What became of the cells of a mesh, for people.
fn cells_text(cells: &CellReport) -> String {
    let text = format!(
        "{} tetrahedra and {} points as cells in {}: {} of them geometry ({:.1} : 1 without it, {:.1} : 1 by the \
         formula of bernardon2006), {} spans, in {:.1} s",
        cells.num_tetrahedra,
        cells.num_points,
        ByteSize(cells.stored_bytes),
        ByteSize(cells.totals.geometry_bytes),
        cells.raw_bytes as f64 / cells.totals.data_bytes as f64,
        cells.paper_ratio,
        cells.totals.spans,
        cells.wall_secs,
    );
    text + &left_out_text(&cells.census)
}

fn left_out_text(census: &MeshCensus) -> String {
    let mut text = String::new();
    let left_out = [
        (census.num_flat, "flat tetrahedra"),
        (census.num_blanked, "blanked cells"),
        (census.num_duplicate, "duplicate cells"),
        (census.num_non_manifold, "non-manifold cells"),
    ];
    for (count, what) in left_out.into_iter().filter(|(count, _)| *count > 0) {
        text += &format!("; {count} {what} left out");
    }
    if census.num_curved > 0 {
        text += &format!("; {} cells of higher order taken by their corners", census.num_curved);
    }
    text
}
