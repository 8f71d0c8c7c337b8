//! `info`: what a source or a store holds.

use std::path::Path;

use clap::{Args, ValueEnum};
use serde::Serialize;
use serde_json::{Map, Value, json};

use chronoxel_codec::{PayloadClass, paper_ratio};
use chronoxel_core::{Samples, TimeAxis, UniformGrid, time_tree::num_time_levels};
use chronoxel_ingest::{MeshCensus, MeshSeries, Opened, TimeSeries, Variable};
use chronoxel_store::{CellClass, CellStore, Header, Store};

use super::{
    args::{Common, SourceArgs},
    output,
};
use crate::bytes::ByteSize;

/// Say what a source or a store holds: grid, times, variables, sizes
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  chronoxel info run.cxl
  chronoxel info 'run/density_*.vti' --json")]
pub struct InfoArgs {
    #[command(flatten)]
    source: SourceArgs,
    /// Steps of a source to read for the ranges of its variables [default: all of up to 1 GiB, else the first]
    #[arg(long, value_name = "STEPS")]
    ranges: Option<Ranges>,
}

/// Which steps of a source are read for the ranges of its variables.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Ranges {
    All,
    First,
    None,
}

/// Up to this much is read without being asked for.
const READ_UNASKED_BYTES: u64 = 1 << 30;

#[derive(Serialize)]
struct InfoReport {
    kind: &'static str,
    grid: Value,
    num_steps: usize,
    times: Vec<f64>,
    time_units: String,
    variables: Map<String, Value>,
    raw_bytes: u64,
    #[serde(flatten)]
    store: Map<String, Value>,
}

/// Runs the verb.
pub fn run(common: &Common, args: &InfoArgs) -> anyhow::Result<()> {
    let report = match &args.source.source[..] {
        [one] if one.ends_with(".cxl") || one.ends_with(".cxl/") => store_report(Path::new(one))?,
        _ => source_report(common, args)?,
    };
    match common.json {
        true => output::json(&report),
        false => output::line(&text(&report)),
    }
}

fn grid_json(grid: &UniformGrid) -> Value {
    json!({
        "type": "uniform",
        "dims": grid.dims,
        "spacing": grid.spacing,
        "origin": grid.origin,
        "num_cells": grid.num_cells(),
    })
}

/// The grid of a store; of a mesh, what it was in the source and the grid of the finest level.
fn store_grid_json(header: &Header) -> Value {
    let mut grid = grid_json(&header.grid);
    if let Some(mesh) = &header.mesh {
        grid["type"] = mesh.kind.as_str().into();
        grid["num_cells"] = mesh.num_cells.into();
        grid["num_points"] = mesh.num_points.into();
    }
    grid
}

fn store_report(path: &Path) -> anyhow::Result<InfoReport> {
    let cells = CellStore::find(path).map(|_| CellStore::open(path)).transpose()?;
    match cells {
        Some(cells) if cells.path() == path => cell_report(&cells),
        cells => {
            let mut report = brick_report(path)?;
            if let Some(cells) = cells {
                report.store.insert("cells".to_owned(), cells_json(&cells)?);
            }
            Ok(report)
        }
    }
}

/// What a store of cells holds besides its variables.
fn cells_json(store: &CellStore) -> anyhow::Result<Value> {
    let header = store.header();
    let totals = &header.totals;
    let stored_bytes = store.stored_bytes()?;
    let finished = header.num_steps_finished as usize;
    let raw_bytes = header.raw_bytes() / u64::from(header.num_steps().max(1)) * finished as u64;
    let entries = header.encoder["entries"].as_u64().unwrap_or(256);
    Ok(json!({
        "num_points": header.num_points,
        "num_tetrahedra": header.num_tetrahedra,
        "num_steps_finished": finished,
        "complete": store.is_complete(),
        "entries": entries,
        "max_error": header.encoder.get("max_error"),
        "spans": totals.spans,
        "masked": totals.masked,
        "raw_bytes": raw_bytes,
        "stored_bytes": stored_bytes,
        "geometry_bytes": totals.geometry_bytes,
        "data_bytes": totals.data_bytes,
        "ratio": raw_bytes as f64 / stored_bytes.max(1) as f64,
        "data_ratio": raw_bytes as f64 / totals.data_bytes.max(1) as f64,
        "paper_ratio": paper_ratio(header.num_points as usize, header.times.num_steps(), entries as usize),
    }))
}

fn cell_report(store: &CellStore) -> anyhow::Result<InfoReport> {
    let header = store.header();
    let [low, high] = header.bounds;
    let variables = header.variables.iter().map(|v| {
        let form = |class: &CellClass| {
            let stages = PayloadClass { stages: class.stages.clone() };
            format!("{stages}, {} steps", class.window)
        };
        let entry = json!({
            "min": v.min,
            "max": v.max,
            "units": v.units,
            "sample_type": v.sample_type,
            "fill_value": v.fill_value,
            "codec": "cells",
            "payload_classes": v.classes.iter().map(form).collect::<Vec<_>>(),
        });
        (v.name.clone(), entry)
    });
    let cells = cells_json(store)?;
    let mut fields: Map<String, Value> = ["num_steps_finished", "complete", "stored_bytes", "ratio"]
        .map(|key| (key.to_owned(), cells[key].clone()))
        .into_iter()
        .collect();
    let raw_bytes = cells["raw_bytes"].as_u64().unwrap_or(0);
    fields.insert("format_version".to_owned(), header.version.into());
    fields.insert("encoder".to_owned(), header.encoder.clone());
    fields.insert("cells".to_owned(), cells);
    let totals = &header.totals;
    let payloads =
        json!({ "empty": 0, "constant": 0, "coded": totals.spans, "shared": 0, "masked": totals.masked });
    fields.insert("payloads".to_owned(), payloads);
    // No bricks, and so no levels of them.
    fields.insert("num_levels".to_owned(), 0.into());
    Ok(InfoReport {
        kind: "store",
        grid: json!({
            "type": header.kind,
            "dims": Value::Null,
            "spacing": Value::Null,
            "origin": Value::Null,
            "num_cells": header.num_tetrahedra,
            "num_points": header.num_points,
            "bounds": [low, high],
        }),
        num_steps: header.times.num_steps(),
        times: header.times.times.clone(),
        time_units: header.times.units.clone(),
        variables: variables.collect(),
        raw_bytes,
        store: fields,
    })
}

fn brick_report(path: &Path) -> anyhow::Result<InfoReport> {
    let store = Store::open(path)?;
    let header = store.header();
    let variables = header.variables.iter().map(|v| {
        let codecs: Vec<String> = v.classes.iter().map(ToString::to_string).collect();
        let entry = json!({
            "min": v.min,
            "max": v.max,
            "units": v.units,
            "sample_type": v.sample_type,
            "fill_value": v.fill_value,
            "codec": header.encoder.get("codec").cloned().unwrap_or(Value::Null),
            "payload_classes": codecs,
        });
        (v.name.clone(), entry)
    });
    let stored_bytes = store.stored_bytes()?;
    let finished = header.num_steps_finished as usize;
    let raw_bytes = header.raw_bytes() / header.num_steps().max(1) as u64 * finished as u64;
    let totals = &header.totals;
    let per_brick = if header.apron_stored { header.bricks.num_full() } else { header.bricks.num_core() };
    let levels: Vec<Value> =
        header.levels.iter().map(|l| json!({ "dims": l.dims, "num_nodes": l.num_nodes })).collect();
    let store_fields = json!({
        "num_steps_finished": finished,
        "complete": store.is_complete(),
        "format_version": header.version,
        "brick": {
            "edge": header.bricks.edge,
            "cells": header.bricks.num_core(),
            "samples_stored": per_brick,
        },
        "num_levels": header.levels.len(),
        "levels": levels,
        "time_tree": header.time_tree.map(|tree| json!({
            "levels": num_time_levels(header.num_steps()),
            "stride": tree.stride,
        })),
        "stored_bytes": stored_bytes,
        "ratio": raw_bytes as f64 / stored_bytes.max(1) as f64,
        "payloads": {
            "empty": totals.empty,
            "constant": totals.constant,
            "coded": totals.coded,
            "shared": totals.shared,
            "masked": totals.masked,
        },
        "encoder": header.encoder,
    });
    Ok(InfoReport {
        kind: "store",
        grid: store_grid_json(header),
        num_steps: header.times.num_steps(),
        times: header.times.times.clone(),
        time_units: header.times.units.clone(),
        variables: variables.collect(),
        raw_bytes,
        store: store_fields.as_object().cloned().unwrap_or_default(),
    })
}

fn source_report(common: &Common, args: &InfoArgs) -> anyhow::Result<InfoReport> {
    match args.source.hints.open_any(common, &args.source.source)? {
        Opened::Volume(series) => volume_report(series, args.ranges),
        Opened::Mesh(mesh) => mesh_report(mesh, args.ranges),
    }
}

fn volume_report(mut series: Box<dyn TimeSeries>, ranges: Option<Ranges>) -> anyhow::Result<InfoReport> {
    let grid = *series.grid();
    let (variables, times) = (series.variables().to_vec(), series.times().clone());
    let [nx, ny, nz] = grid.dims;
    let slab = (SLAB_SAMPLES / (nx * ny)).clamp(1, nz);
    let of_variables = Sampled { times, num_samples: grid.num_samples() as u64, variables, ranges };
    of_variables.report(grid_json(&grid), Map::new(), |variable, step, found| {
        let mut reader = series.open_step(variable, step)?;
        for first in (0..nz).step_by(slab) {
            found(&reader.read_slices(slab.min(nz - first))?);
        }
        Ok(())
    })
}

fn mesh_report(mut mesh: Box<dyn MeshSeries>, ranges: Option<Ranges>) -> anyhow::Result<InfoReport> {
    let census = mesh.for_each_tetrahedron(&mut |_| Ok(()))?;
    let grid = mesh_json(mesh.as_mut(), &census)?;
    let (variables, times) = (mesh.variables().to_vec(), mesh.times().clone());
    let fields = Map::from_iter([("notes".to_owned(), json!(mesh.notes()))]);
    let of_variables = Sampled { times, num_samples: mesh.num_points() as u64, variables, ranges };
    of_variables.report(grid, fields, |variable, step, found| {
        found(&mesh.read_values(variable, step)?);
        Ok(())
    })
}

/// The grid of a mesh: what a uniform one has, as far as it applies, and what is counted in it.
fn mesh_json(mesh: &mut dyn MeshSeries, census: &MeshCensus) -> anyhow::Result<Value> {
    let mut bounds = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
    for point in mesh.points()? {
        for axis in 0..3 {
            bounds[0][axis] = bounds[0][axis].min(point[axis]);
            bounds[1][axis] = bounds[1][axis].max(point[axis]);
        }
    }
    Ok(json!({
        "type": mesh.grid_type(),
        "dims": mesh.dims(),
        "spacing": Value::Null,
        "origin": Value::Null,
        "num_cells": census.cells.total(),
        "num_points": census.num_points,
        "bounds": bounds,
        "cells": census.cells,
        "cells_of_higher_order": census.num_curved,
        "tetrahedra": {
            "kept": census.num_tetrahedra,
            "flat": census.num_flat,
            "inverted": census.num_inverted,
            "volume": census.volume,
        },
        "cells_left_out": {
            "blanked": census.num_blanked,
            "duplicate": census.num_duplicate,
            "non_manifold": census.num_non_manifold,
            "without_volume": census.cells.without_volume,
        },
    }))
}

/// A source as far as its samples go.
struct Sampled {
    times: TimeAxis,
    /// Of one step.
    num_samples: u64,
    variables: Vec<Variable>,
    ranges: Option<Ranges>,
}

impl Sampled {
    /// The report, ranges being taken from the samples that `read` hands over for a variable and a step.
    fn report(
        self,
        grid: Value,
        mut fields: Map<String, Value>,
        mut read: impl FnMut(usize, usize, &mut dyn FnMut(&Samples)) -> anyhow::Result<()>,
    ) -> anyhow::Result<InfoReport> {
        let TimeAxis { times, units } = self.times;
        let point_bytes: u64 = self.variables.iter().map(|v| v.sample_type.num_bytes() as u64).sum();
        let raw_bytes = point_bytes * self.num_samples * times.len() as u64;
        let unasked = if raw_bytes <= READ_UNASKED_BYTES { Ranges::All } else { Ranges::First };
        let num_read = match self.ranges.unwrap_or(unasked) {
            Ranges::All => times.len(),
            Ranges::First => 1,
            Ranges::None => 0,
        };
        let mut variables = Map::new();
        for (index, variable) in self.variables.into_iter().enumerate() {
            let mut found = Found::default();
            for step in 0..num_read {
                read(index, step, &mut |samples| found.add(samples, variable.fill_value))?;
            }
            let entry = json!({
                "min": found.range.map(|r| r[0]),
                "max": found.range.map(|r| r[1]),
                "mean": found.mean(),
                "missing_samples": found.num_missing,
                "units": variable.units,
                "sample_type": variable.sample_type,
                "fill_value": variable.fill_value,
                "codec": Value::Null,
            });
            variables.insert(variable.name, entry);
        }
        fields.insert("range_steps".to_owned(), json!(num_read));
        Ok(InfoReport {
            kind: "source",
            grid,
            num_steps: times.len(),
            times,
            time_units: units,
            variables,
            raw_bytes,
            store: fields,
        })
    }
}

/// What a pass over some steps of a variable found.
#[derive(Default)]
struct Found {
    range: Option<[f64; 2]>,
    sum: f64,
    count: u64,
    num_missing: u64,
}

impl Found {
    /// Takes some samples in.
    fn add(&mut self, samples: &Samples, fill_value: Option<f64>) {
        for value in (0..samples.len()).map(|i| samples.get(i)) {
            if !value.is_finite() || Some(value) == fill_value {
                self.num_missing += 1;
                continue;
            }
            let [low, high] = self.range.unwrap_or([value; 2]);
            self.range = Some([low.min(value), high.max(value)]);
            self.sum += value;
            self.count += 1;
        }
    }

    fn mean(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / self.count as f64)
    }
}

/// Whether all steps are equally long, to a thousandth of the mean one.
fn is_even(times: &[f64]) -> bool {
    let (Some(first), Some(last)) = (times.first(), times.last()) else { return true };
    let mean = (last - first) / (times.len().max(2) - 1) as f64;
    times.windows(2).all(|pair| (pair[1] - pair[0] - mean).abs() <= 1e-3 * mean)
}

/// Samples that are read at once.
const SLAB_SAMPLES: usize = 1 << 22;

/// A corner of the bounds of a mesh.
fn corner(report: &InfoReport, side: usize) -> String {
    let values = report.grid["bounds"][side].as_array().into_iter().flatten();
    values.filter_map(Value::as_f64).map(output::number).collect::<Vec<_>>().join(", ")
}

/// What a mesh consists of, and what was left out; counts of nothing are not shown.
fn mesh_lines(report: &InfoReport) -> Vec<String> {
    let counts = |part: &str, names: &[&str]| {
        let counted = names.iter().filter_map(|name| Some((name, report.grid[part][name].as_u64()?)));
        let shown = counted.filter(|(_, count)| *count > 0);
        shown
            .map(|(name, count)| format!("{count} {}", name.replace('_', " ")))
            .collect::<Vec<_>>()
            .join(", ")
    };
    let kinds = ["tetrahedra", "hexahedra", "wedges", "pyramids", "without_volume"];
    let volume = report.grid["tetrahedra"]["volume"].as_f64().unwrap_or_default();
    let mut lines = vec![
        format!(
            "{:<10} {} from ({}) to ({})",
            "points",
            report.grid["num_points"],
            corner(report, 0),
            corner(report, 1)
        ),
        format!("{:<10} {}: {}", "cells", report.grid["num_cells"], counts("cells", &kinds)),
        format!(
            "{:<10} {}; volume {}",
            "tetrahedra",
            counts("tetrahedra", &["kept", "inverted", "flat"]),
            output::number(volume)
        ),
    ];
    let left_out = counts("cells_left_out", &["blanked", "duplicate", "non_manifold", "without_volume"]);
    if !left_out.is_empty() {
        lines.push(format!("{:<10} cells: {left_out}", "left out"));
    }
    let notes = report.store.get("notes").and_then(Value::as_array).into_iter().flatten();
    lines.extend(notes.filter_map(Value::as_str).map(|note| format!("{:<10} {note}", "note")));
    lines
}

fn text(report: &InfoReport) -> String {
    let numbers = |key: &str| {
        let values = report.grid[key].as_array().into_iter().flatten();
        values.filter_map(Value::as_f64).map(output::number).collect::<Vec<_>>().join(" x ")
    };
    let units = if report.time_units.is_empty() { String::new() } else { format!(" {}", report.time_units) };
    let (first, last) = (report.times.first().unwrap_or(&0.0), report.times.last().unwrap_or(&0.0));
    let grid_type = report.grid["type"].as_str().unwrap_or_default();
    let mut lines =
        vec![format!("{:<10} {grid_type} {}", report.kind, numbers("dims")).trim_end().to_owned()];
    match (report.grid.get("tetrahedra"), report.store.get("brick").or(report.grid["spacing"].get(0))) {
        (Some(_), _) => lines.extend(mesh_lines(report)),
        (None, Some(_)) => lines.push(format!(
            "{:<10} {}  origin {}",
            "spacing",
            numbers("spacing"),
            numbers("origin").replace(" x ", ", ")
        )),
        (None, None) => lines.push(bounds_line(report)),
    }
    lines.extend([
        format!(
            "{:<10} {} from {} to {}{units}{}",
            "steps",
            report.num_steps,
            output::number(*first),
            output::number(*last),
            if is_even(&report.times) { "" } else { ", unevenly spaced" }
        ),
        format!("{:<10} {}", "samples", ByteSize(report.raw_bytes)),
    ]);
    if let Some(stored) = report.store.get("stored_bytes").and_then(Value::as_u64) {
        let ratio = report.store["ratio"].as_f64().unwrap_or_default();
        lines.push(format!("{:<10} {} ({ratio:.1} : 1)", "stored", ByteSize(stored)));
        if report.store.contains_key("brick") {
            lines.extend(brick_lines(report));
        }
        if let Some(cells) = report.store.get("cells") {
            lines.extend(cell_lines(cells));
        }
        if report.store["complete"] == false {
            let finished = &report.store["num_steps_finished"];
            lines.push(format!("unfinished: {finished} steps can be read; encode --resume goes on"));
        }
    }
    if let Some(steps) = report.store.get("range_steps").and_then(Value::as_u64)
        && steps < report.num_steps as u64
    {
        lines.push(format!("ranges are those of the first {steps} steps; --ranges all reads every step"));
    }
    let heading = ["variable", "type", "min", "max", "units"].map(str::to_owned).to_vec();
    let rows = report.variables.iter().map(|(name, v)| {
        let text = |key: &str| match &v[key] {
            Value::String(text) => text.clone(),
            Value::Number(number) => output::number(number.as_f64().unwrap_or(f64::NAN)),
            _ => "-".to_owned(),
        };
        vec![name.clone(), text("sample_type"), text("min"), text("max"), text("units")]
    });
    lines.push(output::table(&std::iter::once(heading).chain(rows).collect::<Vec<_>>()));
    lines.join("\n")
}

/// Where the points lie.
fn bounds_line(report: &InfoReport) -> String {
    format!(
        "{:<10} {} from ({}) to ({})",
        "points",
        report.grid["num_points"],
        corner(report, 0),
        corner(report, 1)
    )
}

/// What a store of bricks is made of.
fn brick_lines(report: &InfoReport) -> Vec<String> {
    let payloads = &report.store["payloads"];
    vec![
        format!(
            "{:<10} {} levels of bricks with {} samples an edge",
            "tree", report.store["num_levels"], report.store["brick"]["edge"]
        ),
        match &report.store["time_tree"] {
            Value::Null => format!("{:<10} none: metrics and tolerances cannot be used", "time tree"),
            tree => format!(
                "{:<10} {} levels of statistics; temporal errors of every {}sample",
                "time tree",
                tree["levels"],
                match tree["stride"].as_u64() {
                    Some(stride @ 2..) => format!("{stride}{} ", if stride == 2 { "nd" } else { "th" }),
                    _ => String::new(),
                }
            ),
        },
        format!(
            "{:<10} {} coded, {} shared, {} constant, {} empty",
            "payloads", payloads["coded"], payloads["shared"], payloads["constant"], payloads["empty"]
        ),
    ]
}

/// What its cells are made of.
fn cell_lines(cells: &Value) -> Vec<String> {
    let bytes = |key: &str| ByteSize(cells[key].as_u64().unwrap_or(0));
    let ratio = |key: &str| cells[key].as_f64().unwrap_or_default();
    let unfinished = match cells["complete"] == false {
        true => format!("; {} steps are finished", cells["num_steps_finished"]),
        false => String::new(),
    };
    vec![
        format!(
            "{:<10} {} tetrahedra, {} points, {} spans of tables with {} entries{unfinished}",
            "cells", cells["num_tetrahedra"], cells["num_points"], cells["spans"], cells["entries"]
        ),
        format!(
            "{:<10} {} of {} ({:.1} : 1), and {} of geometry; {:.1} : 1 by the formula of bernardon2006",
            "",
            bytes("data_bytes"),
            bytes("raw_bytes"),
            ratio("data_ratio"),
            bytes("geometry_bytes"),
            ratio("paper_ratio")
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::is_even;

    #[test]
    fn uneven_steps_are_told_from_even_ones() {
        assert!(is_even(&[0.0, 0.1, 0.2, 0.30000000000000004]) && is_even(&[5.0]));
        assert!(!is_even(&[2.0, 3.0, 30.0]));
    }
}
