//! `verify`: whether a store is sound, and how far it is from its source.

use std::{
    path::{Path, PathBuf},
    sync::OnceLock,
};

use clap::{Args, builder::NonEmptyStringValueParser};
use serde::Serialize;
use serde_json::{Map, Value, json};

use chronoxel_ingest::{Measurement, Opened, VariableErrors, measure, measure_cells, measure_mesh};
use chronoxel_store::{CellStore, Store, verify, verify_cells};

use super::{
    args::{Common, SourceHints, StepRange},
    output,
};
use crate::progress::{Counted, Progress};

/// Check every checksum and invariant of a store; with --against, its errors
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  chronoxel verify run.cxl
  chronoxel verify run.cxl --against 'run/density_*.vti'")]
pub struct VerifyArgs {
    /// The store
    store: PathBuf,
    /// The source it was made from: files, a quoted glob, a simulation
    #[arg(long, value_name = "SOURCE", num_args = 1.., value_parser = NonEmptyStringValueParser::new())]
    against: Vec<String>,
    /// Steps to measure against the source, as 0:100:2 [default: all]
    #[arg(long, value_name = "A:B[:S]", allow_hyphen_values = true, requires = "against")]
    steps: Option<StepRange>,
    #[command(flatten)]
    hints: SourceHints,
}

/// What was found.
#[derive(Debug, Default, Serialize)]
pub struct VerifyReport {
    /// Whether there is no problem.
    pub ok: bool,
    problems: Vec<String>,
    variables: Map<String, Value>,
    /// Errors of the cells, by variable.
    #[serde(skip_serializing_if = "Map::is_empty")]
    cells: Map<String, Value>,
}

/// Runs the verb.
pub fn run(common: &Common, args: &VerifyArgs) -> anyhow::Result<()> {
    let cells = CellStore::find(&args.store).map(|_| CellStore::open(&args.store)).transpose()?;
    let mut report = match &cells {
        // A store of nothing but cells.
        Some(cells) if cells.path() == args.store => VerifyReport::default(),
        _ => {
            let store = Store::open(&args.store)?;
            let mut report = check(common, &store)?;
            if !args.against.is_empty() {
                measure_against(common, &store, args, &mut report)?;
            }
            report
        }
    };
    if let Some(cells) = &cells {
        report.problems.extend(check_cells(common, cells));
        if !args.against.is_empty() {
            measure_cells_against(common, cells, args, &mut report)?;
        }
    }
    report.ok = report.problems.is_empty();
    if common.json {
        // Of a store of nothing but cells their errors are those of the variables.
        if cells.as_ref().is_some_and(|cells| cells.path() == args.store) {
            report.variables = report.cells.clone();
        }
        output::json(&report)?;
    } else {
        output::line(&report.text(&args.store))?;
    }
    anyhow::ensure!(report.ok, "{}: {} problems found", args.store.display(), report.problems.len());
    Ok(())
}

/// Checks every checksum and invariant.
pub fn check(common: &Common, store: &Store) -> anyhow::Result<VerifyReport> {
    let problems = problems_of(common, |progress| verify(store, progress));
    Ok(VerifyReport { ok: problems.is_empty(), problems, ..VerifyReport::default() })
}

fn check_cells(common: &Common, store: &CellStore) -> Vec<String> {
    problems_of(common, |progress| verify_cells(store, progress))
}

/// What a verification finds, behind a progress bar.
fn problems_of(
    common: &Common,
    verify: impl FnOnce(&(dyn Fn(u64, u64) + Sync)) -> chronoxel_store::VerifyReport,
) -> Vec<String> {
    let bar: OnceLock<Progress> = OnceLock::new();
    let found = verify(&|done, total| {
        let quiet = common.quiet || common.json;
        bar.get_or_init(|| Progress::new("verify", total, Counted::Items("parts"), quiet)).set(done);
    });
    if let Some(bar) = bar.get() {
        bar.finish();
    }
    let mut problems = found.problems;
    if found.num_problems > problems.len() as u64 {
        problems.push(format!("and {} more", found.num_problems - problems.len() as u64));
    }
    problems
}

fn measure_cells_against(
    common: &Common,
    store: &CellStore,
    args: &VerifyArgs,
    report: &mut VerifyReport,
) -> anyhow::Result<()> {
    let Opened::Mesh(mut mesh) = args.hints.open_any(common, &args.against)? else {
        anyhow::bail!(
            "--against: the source is a uniform grid, which the cells of this store are not made of"
        );
    };
    let num_finished = store.header().num_steps_finished as usize;
    let steps = match args.steps {
        Some(range) => range.resolve(num_finished)?,
        None => (0..num_finished).collect(),
    };
    let bar = measure_bar(common, &steps);
    let found = measure_cells(store, mesh.as_mut(), steps.iter().copied().inspect(|_| bar.advance(1)))?;
    bar.finish();
    for of_variable in found.variables {
        let mut entry = errors_json(&of_variable.errors);
        let finite = |snr: f64| Some(snr).filter(|snr| snr.is_finite());
        entry["snr_db"] = of_variable.snr_db.iter().map(|&snr| finite(snr)).collect::<Vec<_>>().into();
        entry["mse_per_step"] = of_variable.errors.mse.clone().into();
        report.cells.insert(of_variable.errors.name, entry);
    }
    report.problems.extend(found.problems);
    Ok(())
}

fn measure_against(
    common: &Common,
    store: &Store,
    args: &VerifyArgs,
    report: &mut VerifyReport,
) -> anyhow::Result<()> {
    let source = args.hints.open_any(common, &args.against)?;
    let num_finished = store.header().num_steps_finished as usize;
    let steps = match args.steps {
        Some(range) => range.resolve(num_finished)?,
        None => (0..num_finished).collect(),
    };
    match source {
        Opened::Volume(mut series) => measure_series(common, store, series.as_mut(), &steps, report),
        Opened::Mesh(mut mesh) => {
            let bar = measure_bar(common, &steps);
            let steps = steps.iter().copied().inspect(|_| bar.advance(1));
            let found = measure_mesh(store, mesh.as_mut(), common.memory.0, steps)?;
            bar.finish();
            add_errors(found, report);
            Ok(())
        }
    }
}

fn measure_bar(common: &Common, steps: &[usize]) -> Progress {
    Progress::new("measure", steps.len() as u64, Counted::Items("steps"), common.quiet || common.json)
}

/// Adds the errors of a store against a series to a report.
pub fn measure_series(
    common: &Common,
    store: &Store,
    series: &mut dyn chronoxel_ingest::TimeSeries,
    steps: &[usize],
    report: &mut VerifyReport,
) -> anyhow::Result<()> {
    let bar = measure_bar(common, steps);
    let found = measure(store, series, steps.iter().copied().inspect(|_| bar.advance(1)))?;
    bar.finish();
    add_errors(found, report);
    Ok(())
}

fn add_errors(found: Measurement, report: &mut VerifyReport) {
    for errors in found.variables {
        let entry = errors_json(&errors);
        report.variables.insert(errors.name, entry);
    }
    report.problems.extend(found.problems);
    report.ok = report.problems.is_empty();
}

fn errors_json(errors: &VariableErrors) -> Value {
    let [min, max, avg] = errors.mse_range();
    json!({
        "mse": { "min": min, "max": max, "avg": avg },
        "psnr_db": Some(errors.psnr_db()).filter(|psnr| psnr.is_finite()),
        "max_abs_error": errors.max_abs_error,
        "bits_per_sample": errors.bits_per_sample,
    })
}

impl VerifyReport {
    /// Peak signal-to-noise ratio of a variable that was measured, in dB; `None` where there is no error.
    pub fn psnr_db(&self, variable: &str) -> Option<f64> {
        self.variables.get(variable)?["psnr_db"].as_f64()
    }

    fn text(&self, store: &Path) -> String {
        let mut lines = self.problems.clone();
        if self.ok {
            lines.push(format!("{}: sound", store.display()));
        }
        if !self.variables.is_empty() {
            lines.push(errors_table(&self.variables));
            lines
                .push("errors on values scaled to [0, 1] by the variable's range; mse over steps".to_owned());
        }
        if !self.cells.is_empty() {
            lines.push(errors_table(&self.cells));
            for (name, v) in &self.cells {
                lines.push(format!("{name}: SNR of blocks of 64 steps {}", snr_text(&v["snr_db"])));
            }
            let what = "errors of the cells at their points, on values scaled to [0, 1]; SNR against the variance of a block";
            lines.push(what.to_owned());
        }
        lines.join("\n")
    }
}

/// The smallest and the largest of the blocks that have errors.
fn snr_text(snr_db: &Value) -> String {
    let blocks: Vec<Option<f64>> = snr_db.as_array().into_iter().flatten().map(Value::as_f64).collect();
    let finite = || blocks.iter().flatten().copied();
    match finite().next() {
        None => "without bound: no error".to_owned(),
        Some(first) => {
            let (low, high) = (finite().fold(first, f64::min), finite().fold(first, f64::max));
            let exact = blocks.iter().filter(|snr| snr.is_none()).count();
            let rest = if exact > 0 { format!(", {exact} without error") } else { String::new() };
            format!("{low:.1} to {high:.1} dB{rest}")
        }
    }
}

fn errors_table(variables: &Map<String, Value>) -> String {
    let heading = ["variable", "mse min", "max", "avg", "PSNR dB", "largest error", "bits/sample"];
    let mut rows = vec![heading.map(str::to_owned).to_vec()];
    for (name, v) in variables {
        let small = |value: &Value| format!("{:.2e}", value.as_f64().unwrap_or(f64::NAN));
        rows.push(vec![
            name.clone(),
            small(&v["mse"]["min"]),
            small(&v["mse"]["max"]),
            small(&v["mse"]["avg"]),
            v["psnr_db"].as_f64().map_or("lossless".to_owned(), |psnr| format!("{psnr:.2}")),
            small(&v["max_abs_error"]),
            format!("{:.3}", v["bits_per_sample"].as_f64().unwrap_or(f64::NAN)),
        ]);
    }
    output::table(&rows)
}
