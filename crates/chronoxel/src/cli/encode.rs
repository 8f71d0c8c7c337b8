//! `encode`: from source files to a store.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use serde::Serialize;

use chronoxel_ingest::encode::{Codec, EncodeOptions, encode};

use super::{
    args::{Common, SourceArgs, parse_not_negative, parse_range, parse_store_path},
    output,
};
use crate::{bytes::ByteSize, process::resource_usage, progress::Progress};

/// Read a series of volumes once, and write it as a store
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  chronoxel encode 'run/density_*.vti' -o run.cxl
  chronoxel encode series.pvd -o run.cxl --variable pressure --max-error 0.001
  chronoxel encode 'scan_*.raw' --dims 512x512x300 --dtype u16 --spacing 0.5,0.5,1 -o scan.cxl
  chronoxel encode 'sim:vortex?dims=128&steps=32' -o vortex.cxl
  chronoxel encode 'run/density_*.vti' -o run.cxl --resume      go on after an interruption")]
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
    /// Bits per sample and step: 8 or 16 [default: 16; 8 where the samples are 8-bit integers]
    #[arg(long, value_name = "B", value_parser = parse_bits, conflicts_with = "max_error")]
    bits: Option<u8>,
    /// Samples along the edge of a brick's core: 8, 16, 32, 64 or 128
    #[arg(long, value_name = "N", default_value_t = 32)]
    brick: usize,
    /// Range of values that errors refer to and pictures show [default: that of the data]
    #[arg(long, value_name = "MIN:MAX", value_parser = parse_range, allow_hyphen_values = true)]
    range: Option<[f64; 2]>,
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
    /// Per brick, the fewest bytes that keep within --max-error
    Auto,
    /// 8 or 16 bits for every sample, within the brick's range
    Raw,
}

fn parse_bits(text: &str) -> Result<u8, String> {
    match text {
        "8" => Ok(8),
        "16" => Ok(16),
        _ => Err(format!("{text:?} bits are not available; use 8 or 16")),
    }
}
