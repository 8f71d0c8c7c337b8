//! `info`: what a source or a store holds.

use std::path::Path;

use clap::{Args, ValueEnum};
use serde::Serialize;
use serde_json::{Map, Value, json};

use chronoxel_core::{TimeAxis, UniformGrid};
use chronoxel_ingest::{TimeSeries, sources};
use chronoxel_store::Store;

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
        _ => source_report(args)?,
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
