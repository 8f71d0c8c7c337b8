//! `export`: decoded steps in the formats of other programs.

use std::{path::PathBuf, sync::Arc};

use clap::Args;
use serde::Serialize;

use chronoxel_core::{SampleType, TimeAxis};
use chronoxel_ingest::{
    decode_step,
    export::{self, CellExport, ExportDescription},
};
use chronoxel_store::{CellPayload, CellSpanRecord, CellStore, Store};

use super::{
    args::{Common, StepRange},
    output,
};
use crate::bytes::ByteSize;
use crate::{
    interrupt::{self, CleanUp},
    progress::{Counted, Progress},
};

/// Write decoded steps as .vti, .pvd, .npy, .nrrd or Zarr; those of cells as .vtu or .pvd
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  chronoxel export run.cxl --steps 12 -o step12.vti
  chronoxel export run.cxl --variable pressure -o pressure.pvd
  chronoxel export run.cxl --steps 0:100:10 -o some.npy
  chronoxel export wing.cxl --steps 3 -o step3.vtu      the cells of a store that has them")]
pub struct ExportArgs {
    /// The store
    store: PathBuf,
    /// What to write; its extension says the format: .vti .pvd .npy .nrrd .zarr, of cells .vtu .pvd
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,
    /// Steps to write, as 0:100:2 [default: all]
    #[arg(long, value_name = "A:B[:S]", allow_hyphen_values = true)]
    steps: Option<StepRange>,
    /// Variable to write [default: the first]
    #[arg(long, value_name = "NAME")]
    variable: Option<String>,
}

#[derive(Serialize)]
struct ExportReport {
    output: String,
    variable: String,
    steps: Vec<usize>,
    sample_type: String,
}

/// A step is decoded whole and cast to the sample type: bytes per sample that this takes.
const BYTES_PER_SAMPLE: u64 = 12;

fn check_memory(common: &Common, num_samples: u64) -> anyhow::Result<()> {
    let needed = num_samples.saturating_mul(BYTES_PER_SAMPLE);
    anyhow::ensure!(
        needed <= common.memory.0,
        "--memory {}: exporting a step of {num_samples} samples takes {}; raise it",
        common.memory,
        ByteSize(needed)
    );
    Ok(())
}

/// Runs the verb.
pub fn run(common: &Common, args: &ExportArgs) -> anyhow::Result<()> {
    if is_of_cells(args) {
        return export_cells(common, args);
    }
    let store = Store::open(&args.store)?;
    let header = store.header();
    let index = super::variable_index(&store, args.variable.as_deref())?;
    let variable = &header.variables[index];
    let num_finished = header.num_steps_finished as usize;
    let steps = match args.steps {
        Some(range) => range.resolve(num_finished)?,
        None => (0..num_finished).collect(),
    };
    check_memory(common, header.grid.num_samples() as u64)?;
    let times = steps.iter().map(|&step| header.times.times[step]).collect();
    let description = ExportDescription {
        grid: header.grid,
        times: TimeAxis::new(times, header.times.units.clone())?,
        name: variable.name.clone(),
        units: variable.units.clone(),
        sample_type: variable.sample_type,
        fill_value: variable.fill_value,
    };
    let _clean_up = CleanUp::begin();
    let mut writer = export::create(&args.output, &description)?;
    let bar =
        Progress::new("export", steps.len() as u64, Counted::Items("steps"), common.quiet || common.json);
    for (number, &step) in steps.iter().enumerate() {
        interrupt::check()?;
        writer.write_step(number, &decode_step(&store, index, step)?)?;
        bar.advance(1);
    }
    writer.finish()?;
    bar.finish();
    print(common, args, &variable.name, description.sample_type, steps)
}

fn print(
    common: &Common,
    args: &ExportArgs,
    variable: &str,
    sample_type: SampleType,
    steps: Vec<usize>,
) -> anyhow::Result<()> {
    let report = ExportReport {
        output: args.output.display().to_string(),
        variable: variable.to_owned(),
        sample_type: sample_type.to_string(),
        steps,
    };
    match common.json {
        true => output::json(&report),
        false if common.quiet => Ok(()),
        false => output::line(&format!(
            "{}: {} steps of {} as {}",
            report.output,
            report.steps.len(),
            report.variable,
            report.sample_type
        )),
    }
}

/// Whether cells are to be written: the store has nothing else, or has them and the format is one of cells alone.
fn is_of_cells(args: &ExportArgs) -> bool {
    let is_vtu = args.output.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("vtu"));
    is_vtu || CellStore::find(&args.store).is_some_and(|root| root == args.store)
}

fn export_cells(common: &Common, args: &ExportArgs) -> anyhow::Result<()> {
    let store = CellStore::open(&args.store)?;
    let header = store.header();
    let index = super::cell_variable_index(&store, args.variable.as_deref())?;
    let variable = &header.variables[index];
    let num_finished = header.num_steps_finished as usize;
    let steps = match args.steps {
        Some(range) => range.resolve(num_finished)?,
        None => (0..num_finished).collect(),
    };
    let needed =
        header.num_points.saturating_mul(80).saturating_add(header.num_tetrahedra.saturating_mul(60));
    anyhow::ensure!(
        needed <= common.memory.0,
        "--memory {}: exporting a mesh of {} tetrahedra takes {}; raise it",
        common.memory,
        header.num_tetrahedra,
        ByteSize(needed)
    );
    let times: Vec<f64> = steps.iter().map(|&step| header.times.times[step]).collect();
    let geometry = store.read_geometry()?;
    let _clean_up = CleanUp::begin();
    let names = [variable.name.as_str(), variable.units.as_str()];
    let mut writer = CellExport::create(&args.output, names, &times, &geometry.points, &geometry.tetrahedra)?;
    let mut values = vec![0.0; geometry.points.len()];
    drop(geometry);
    let bar =
        Progress::new("export", steps.len() as u64, Counted::Items("steps"), common.quiet || common.json);
    let mut span: Option<(CellSpanRecord, Arc<CellPayload>)> = None;
    for &step in &steps {
        interrupt::check()?;
        let record = store.span_at(index, step as u32)?;
        let payload = match span.take().filter(|(held, _)| *held == record) {
            Some((_, payload)) => payload,
            None => store.read_span(index, &record)?,
        };
        payload.decode(step as u32, &mut values)?;
        writer.write_step(&values)?;
        span = Some((record, payload));
        bar.advance(1);
    }
    writer.finish()?;
    bar.finish();
    print(common, args, &variable.name, SampleType::F32, steps)
}
