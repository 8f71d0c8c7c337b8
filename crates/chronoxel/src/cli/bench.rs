//! `bench`: tables of papers, measured again.

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::Context;
use chronoxel_ingest::sources::SourceOptions;
use clap::{Args, ValueEnum, builder::NonEmptyStringValueParser};

use super::{
    args::{Common, SourceHints},
    output,
};
use crate::{
    bench::{
        BenchReport, Input, Size, Workplace, bernardon2006, binotto2003, binotto2003_speed, ellsworth2000,
        gpu_playback, leven2002, lum2001, lum2001_playback,
    },
    progress::{Counted, Progress},
};

/// Reproduce a paper's tables, or measure playback: the paper's figures beside those measured here
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  chronoxel bench lum2001
  chronoxel bench lum2001 --size full --out results
  chronoxel bench lum2001 --source 'run/density_*.vti' --source 'sim:vortex?dims=96' --json
  chronoxel bench binotto2003 --out results
  chronoxel bench ellsworth2000 --source 'isabel/*.vti'
  chronoxel bench gpu-playback --size full --memory 16GiB
  chronoxel bench leven2002 --source bluntfinxyz.bin,bluntfinq.bin --variable density
  chronoxel bench bernardon2006 --source bluntfinxyz.bin,bluntfinq.bin --source spx.vtk --source utah_torso.vtu

Benches:
  lum2001      temporal palettes: errors at 2, 4 and 8 steps in a byte, time to encode, frame rates and the cost of a new step
  lum2001-playback
               frames per second in memory and from disk at 1, 2, 4 and 8 steps in a byte, with reading throttled to the paper's disk and without
  binotto2003  index and refinement textures: sparseness, cells and compression ratio at three levels, beside what a store takes
  binotto2003-speed
               frames per second at 200 and 500 slices and three sizes of picture, on the CPU and on a GPU where there is one
  ellsworth2000
               the time-space partitioning tree: time to compute its errors, ms per frame and what is drawn how, by metric, tolerance,
               transfer function and size of brick
  gpu-playback playback on a GPU: frame rates, what a step costs and what is uploaded, beside a plain ray caster over one whole texture;
               128 and 256 samples along an edge, 512 and 1024 in full, or any data in their place
  leven2002    octrees over meshes: depth, nodes and bytes, how they fall with the threshold on the field, and a flight at 10 frames per
               second, also as a plot (figure-15.svg in --out)
  bernardon2006
               tetrahedra as they are: bytes and errors of values through time, frame rates with one step and with new ones, level of
               detail, order of fragments, and the same mesh as bricks (bricks-and-cells.svg in --out). Sources are known by their files'
               names: spx is cut into eight once and twice and fades, bluntfin fades, torso gets a dipole that turns")]
pub struct BenchArgs {
    /// The bench, named after the paper
    name: BenchName,
    /// Data to measure besides the simulations: a path, a quoted glob, or a simulation, which takes the place of the
    /// built-in one of its name; may be repeated
    #[arg(long, value_name = "SOURCE", value_parser = NonEmptyStringValueParser::new())]
    source: Vec<String>,
    /// How large the simulations are: done within a minute or two, or near the paper's
    #[arg(long, value_name = "SIZE", default_value = "small")]
    size: BenchSize,
    /// Folder to work in, and to write the report to, as text and as JSON, and plots [default: a temporary one, no files]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    hints: SourceHints,
}

/// Names of the benches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum BenchName {
    /// Texture hardware assisted rendering of time-varying volume data (Lum, Ma, Clyne, 2001)
    Lum2001,
    /// The same, its tables of frame rates
    #[value(name = "lum2001-playback")]
    Lum2001Playback,
    /// Real-time volume rendering of time-varying data using a fragment-shader compression approach (Binotto, Comba, Freitas, 2003)
    Binotto2003,
    /// The same, its table of frame rates
    #[value(name = "binotto2003-speed")]
    Binotto2003Speed,
    /// Accelerating time-varying hardware volume rendering using TSP trees and color-based error metrics (Ellsworth, Chiang, Shen, 2000)
    Ellsworth2000,
    /// Playback on a GPU, beside a ray caster over one whole texture
    GpuPlayback,
    /// Interactive visualization of unstructured grids using hierarchical 3D textures (Leven, Corso, Cohen, Kumar, 2002)
    Leven2002,
    /// Interactive volume rendering of unstructured grids with time-varying scalar fields (Bernardon, Callahan, Comba, Silva, 2006)
    Bernardon2006,
}

/// Sizes of the simulations.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum BenchSize {
    #[value(hide = true)]
    Tiny,
    Small,
    Full,
}

/// Runs the verb.
pub fn run(common: &Common, args: &BenchArgs) -> anyhow::Result<()> {
    let size = match args.size {
        BenchSize::Tiny => Size::Tiny,
        BenchSize::Small => Size::Small,
        BenchSize::Full => Size::Full,
    };
    let names = match args.name {
        BenchName::Lum2001 => lum2001::sources(&args.source, size),
        BenchName::Lum2001Playback => lum2001_playback::sources(&args.source, size),
        BenchName::Binotto2003 => binotto2003::sources(&args.source),
        BenchName::Binotto2003Speed => binotto2003_speed::sources(&args.source, size),
        BenchName::Ellsworth2000 => ellsworth2000::sources(&args.source, size),
        BenchName::GpuPlayback => args.source.clone(),
        BenchName::Leven2002 => leven2002::sources(&args.source, size),
        BenchName::Bernardon2006 => bernardon2006::sources(&args.source, size),
    };
    let are_meshes = matches!(args.name, BenchName::Leven2002 | BenchName::Bernardon2006);
    let volumes = names.iter().filter(|_| !are_meshes);
    let inputs = volumes.map(|name| open(common, &args.hints, name)).collect::<Result<Vec<_>, _>>()?;
    let parent = match &args.out {
        Some(folder) => {
            fs::create_dir_all(folder)
                .with_context(|| format!("{}: cannot make the folder", folder.display()))?;
            folder.clone()
        }
        None => std::env::temp_dir(),
    };
    let place = Workplace::within(&parent)?;
    let mut bar: Option<Progress> = None;
    let mut progress = |done, total| {
        let quiet = common.quiet || common.json;
        bar.get_or_insert_with(|| Progress::new("bench", total, Counted::Items("steps"), quiet)).set(done);
    };
    let report = match args.name {
        BenchName::Lum2001 => lum2001::run(inputs, &place, common.memory.0, &mut progress)?,
        BenchName::Lum2001Playback => lum2001_playback::run(inputs, &place, common.memory.0, &mut progress)?,
        BenchName::Binotto2003 => binotto2003::run(inputs, &place, common.memory.0, &mut progress)?,
        BenchName::Binotto2003Speed => {
            binotto2003_speed::run(inputs, &place, common.memory.0, &mut progress)?
        }
        BenchName::Ellsworth2000 => ellsworth2000::run(inputs, size, &place, common.memory.0, &mut progress)?,
        BenchName::GpuPlayback => gpu_playback::run(inputs, size, &place, common.memory.0, &mut progress)?,
        BenchName::Leven2002 => {
            let options = args.hints.options(common);
            leven2002::run(&names, &options, size, &place, common.memory.0, &mut progress)?
        }
        BenchName::Bernardon2006 => {
            let options = args.hints.options(common);
            bernardon2006::run(&names, &options, size, &place, common.memory.0, &mut progress)?
        }
    };
    if let Some(bar) = bar {
        bar.finish();
    }
    drop(place);
    if let Some(folder) = &args.out {
        write_report(folder, &report)?;
    }
    match common.json {
        true => output::json(&report),
        false if common.quiet => Ok(()),
        false => output::line(&text(&report)),
    }
}

/// Opens a source; what files do not say themselves is not said of simulations.
fn open(common: &Common, hints: &SourceHints, name: &str) -> anyhow::Result<Input> {
    let options = match name.starts_with("sim:") {
        true => SourceOptions { memory_bytes: Some(common.memory.0), ..SourceOptions::default() },
        false => hints.options(common),
    };
    Input::open(name, &options)
}

fn write_report(folder: &Path, report: &BenchReport) -> anyhow::Result<()> {
    let files = [("json", serde_json::to_string_pretty(report)?), ("txt", text(report))];
    for (extension, text) in files {
        let path = folder.join(report.name).with_extension(extension);
        fs::write(&path, text + "\n").with_context(|| format!("{}: cannot write", path.display()))?;
    }
    for plot in &report.plots {
        let path = folder.join(&plot.file).with_extension("svg");
        fs::write(&path, plot.to_svg()).with_context(|| format!("{}: cannot write", path.display()))?;
    }
    Ok(())
}

/// The tables for people.
fn text(report: &BenchReport) -> String {
    let mut text = format!("{} on {}", report.name, report.machine);
    for section in &report.sections {
        text += &format!("\n\n{}\n{}", section.title, output::table(&section.cells()));
        section.notes.iter().for_each(|note| text += &format!("\n({note})"));
    }
    text
}
