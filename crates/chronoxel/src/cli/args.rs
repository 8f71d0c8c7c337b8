//! Arguments that several verbs share, from text to checked values.

use std::{path::PathBuf, str::FromStr};

use chronoxel_ingest::{
    Opened,
    sources::{self, SourceOptions},
};
use clap::{Args, builder::NonEmptyStringValueParser};

use crate::bytes::ByteSize;

/// What every verb takes.
#[derive(Debug, Clone, Args)]
pub struct Common {
    /// Print one JSON object on stdout, and nothing else there
    #[arg(long, global = true, help_heading = "Common options")]
    pub json: bool,
    /// Number of threads [default: one per core]
    #[arg(long, global = true, value_name = "N", value_parser = parse_threads, help_heading = "Common options")]
    pub threads: Option<usize>,
    /// Memory that may be used, such as 512MiB or 4GiB
    #[arg(long, global = true, value_name = "SIZE", default_value = "2GiB", help_heading = "Common options")]
    pub memory: ByteSize,
    /// Say more about what is done
    #[arg(short, long, global = true, help_heading = "Common options")]
    pub verbose: bool,
    /// Say nothing but errors
    #[arg(short, long, global = true, conflicts_with = "verbose", help_heading = "Common options")]
    pub quiet: bool,
}

/// Where samples come from, and what their files do not say themselves.
#[derive(Debug, Clone, Args)]
pub struct SourceArgs {
    /// Files, a quoted glob, a .pvd, a Zarr group or array, a PLOT3D grid and its solutions, or a simulation such as
    /// 'sim:plume?dims=64'
    #[arg(required = true, value_name = "SOURCE", value_parser = NonEmptyStringValueParser::new())]
    pub source: Vec<String>,
    #[command(flatten)]
    pub hints: SourceHints,
}

/// What a file does not say itself, or says wrongly.
#[derive(Debug, Clone, Args)]
pub struct SourceHints {
    /// Variable to take; may be repeated [default: all]
    #[arg(long, value_name = "NAME")]
    pub variable: Vec<String>,
    /// Samples along x, y and z of a raw file, as 512x512x256
    #[arg(long, value_name = "NXxNYxNZ", value_parser = parse_dims)]
    pub dims: Option<[usize; 3]>,
    /// Type of the samples of a raw file, or of PLOT3D where several fit: u8 i8 u16 i16 u32 i32 u64 i64 f32 f64
    #[arg(long, value_name = "TYPE", value_parser = parse_sample_type)]
    pub dtype: Option<chronoxel_core::SampleType>,
    /// The samples of a raw file have their highest byte first; so does PLOT3D, where either fits
    #[arg(long)]
    pub big_endian: bool,
    /// Bytes to skip at the start of a raw file
    #[arg(long, value_name = "BYTES", default_value_t = 0)]
    pub header_bytes: u64,
    /// World distance between samples, as 1,1,2.5 [default: what the file says, else 1,1,1]
    #[arg(long, value_name = "SX,SY,SZ", value_parser = parse_triple)]
    pub spacing: Option<[f64; 3]>,
    /// World position of the first sample [default: what the file says, else 0,0,0]
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_triple, allow_hyphen_values = true)]
    pub origin: Option<[f64; 3]>,
    /// Time between steps [default: what the files say, else 1]
    #[arg(long, value_name = "T", value_parser = parse_positive)]
    pub dt: Option<f64>,
    /// Value that means "no data", besides NaN [default: what the file says]
    #[arg(long, value_name = "VALUE", allow_hyphen_values = true)]
    pub fill_value: Option<f64>,
    /// Leave out tetrahedra of a mesh whose volume is at most this share of their cubed longest edge [default: 1.8e-7]
    #[arg(long, value_name = "SHARE")]
    pub flat_threshold: Option<f64>,
}

impl SourceHints {
    /// Opens a source with these hints, whatever its grid.
    ///
    /// # Errors
    /// Whatever keeps it from being read.
    pub fn open_any(&self, common: &Common, source: &[String]) -> anyhow::Result<Opened> {
        Ok(sources::open_any(source, &self.options(common))?)
    }

    /// The hints, as readers take them.
    pub fn options(&self, common: &Common) -> SourceOptions {
        SourceOptions {
            dims: self.dims,
            sample_type: self.dtype,
            big_endian: self.big_endian,
            header_bytes: self.header_bytes,
            spacing: self.spacing,
            origin: self.origin,
            dt: self.dt,
            variables: self.variable.clone(),
            fill_value: self.fill_value,
            flat_threshold: self.flat_threshold,
            memory_bytes: Some(common.memory.0),
        }
    }
}

/// A range of steps `A:B[:S]`, the end left out as in Python.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StepRange {
    start: Option<usize>,
    end: Option<usize>,
    stride: usize,
}

impl StepRange {
    /// The steps of a series of `num_steps` that the range names.
    ///
    /// # Errors
    /// A message if it names none, or one past the last.
    pub fn resolve(self, num_steps: usize) -> anyhow::Result<Vec<usize>> {
        self.resolve_for("--steps", num_steps)
    }

    /// As [`Self::resolve`], for an option of another name.
    ///
    /// # Errors
    /// As [`Self::resolve`].
    pub fn resolve_for(self, option: &str, num_steps: usize) -> anyhow::Result<Vec<usize>> {
        let (start, end) = (self.start.unwrap_or(0), self.end.unwrap_or(num_steps));
        anyhow::ensure!(
            end <= num_steps,
            "{option} ends at {end}, but the series has {num_steps} steps (0 to {})",
            num_steps.saturating_sub(1)
        );
        let steps: Vec<usize> = (start..end).step_by(self.stride).collect();
        anyhow::ensure!(!steps.is_empty(), "{option} {start}:{end} names no step of the series' {num_steps}");
        Ok(steps)
    }
}

impl FromStr for StepRange {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong =
            || format!("{text:?} is not a range of steps; write A:B or A:B:S, as 0:10:2, or one step");
        let number = |part: &str| match part {
            "" => Ok(None),
            _ => part.parse::<usize>().map(Some).map_err(|_| wrong()),
        };
        let parts: Vec<&str> = text.split(':').collect();
        match parts[..] {
            [one] => {
                let step = number(one)?.ok_or_else(wrong)?;
                let end = step.checked_add(1).ok_or_else(wrong)?;
                Ok(Self { start: Some(step), end: Some(end), stride: 1 })
            }
            [a, b] => Ok(Self { start: number(a)?, end: number(b)?, stride: 1 }),
            [a, b, s] => match number(s)? {
                Some(stride) if stride > 0 => Ok(Self { start: number(a)?, end: number(b)?, stride }),
                _ => Err(wrong()),
            },
            _ => Err(wrong()),
        }
    }
}

/// A range of values `MIN:MAX`.
pub fn parse_range(text: &str) -> Result<[f64; 2], String> {
    let wrong = || format!("{text:?} is not a range; write MIN:MAX, as 0:1.5");
    let (low, high) = text.split_once(':').ok_or_else(wrong)?;
    let range = [low, high].map(|part| part.trim().parse::<f64>().ok().filter(|v| v.is_finite()));
    match range {
        [Some(low), Some(high)] if low < high => Ok([low, high]),
        _ => Err(wrong()),
    }
}

/// A picture size `WxH`.
pub fn parse_picture_size(text: &str) -> Result<[usize; 2], String> {
    let wrong = || format!("{text:?} is not a picture size; write WxH, as 1024x768, each from 1 to 16384");
    let (width, height) = text.split_once(['x', 'X']).ok_or_else(wrong)?;
    match [width, height].map(|part| part.trim().parse::<usize>().ok().filter(|n| (1..=16384).contains(n))) {
        [Some(width), Some(height)] => Ok([width, height]),
        _ => Err(wrong()),
    }
}

/// A finite number above zero.
pub fn parse_positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        _ => Err(format!("{text:?} is not a number above zero")),
    }
}

/// A finite number, zero or above.
pub fn parse_not_negative(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value >= 0.0 => Ok(value),
        _ => Err(format!("{text:?} is not a number of zero or above")),
    }
}

/// A finite number.
pub fn parse_finite(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => Err(format!("{text:?} is not a number")),
    }
}

/// Three numbers, separated by commas.
pub fn parse_triple(text: &str) -> Result<[f64; 3], String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|part| parse_finite(part.trim()).ok()).collect();
    match numbers[..] {
        [x, y, z] if text.split(',').count() == 3 => Ok([x, y, z]),
        _ => Err(format!("{text:?} is not three numbers; write X,Y,Z, as 1,1,2.5")),
    }
}

/// A time step.
pub fn parse_step(text: &str) -> Result<usize, String> {
    text.parse().map_err(|_| format!("{text:?} is not a time step; steps are whole numbers from 0"))
}

fn parse_dims(text: &str) -> Result<[usize; 3], String> {
    let numbers: Vec<usize> =
        text.split(['x', 'X', ',']).filter_map(|part| part.trim().parse().ok()).collect();
    match numbers[..] {
        [x, y, z] if text.split(['x', 'X', ',']).count() == 3 && x > 0 && y > 0 && z > 0 => Ok([x, y, z]),
        _ => Err(format!("{text:?} are not dimensions; write NXxNYxNZ, as 512x512x256")),
    }
}

fn parse_sample_type(text: &str) -> Result<chronoxel_core::SampleType, String> {
    text.parse().map_err(|e: chronoxel_core::CoreError| e.to_string())
}

fn parse_threads(text: &str) -> Result<usize, String> {
    match text.parse::<usize>() {
        Ok(n) if (1..=1024).contains(&n) => Ok(n),
        _ => Err(format!("{text:?} is not a number of threads from 1 to 1024")),
    }
}

/// An output path that must not be a folder name by accident.
pub fn parse_store_path(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match path.extension() {
        Some(extension) if extension == "cxl" => Ok(path),
        _ => Err(format!("{text:?} is not the name of a store; it must end in .cxl")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn step_ranges() {
        let steps = |text: &str| text.parse::<StepRange>().unwrap().resolve(10);
        assert_eq!(steps("2:8:3").unwrap(), [2, 5]);
        assert_eq!(steps(":3").unwrap(), [0, 1, 2]);
        assert_eq!(steps("8:").unwrap(), [8, 9]);
        assert_eq!(steps("4").unwrap(), [4]);
        assert!(steps("0:11").is_err());
        assert!(steps("5:5").is_err());
        for text in ["", "a:b", "1:2:0", "1:2:3:4", "-1:3"] {
            assert!(text.parse::<StepRange>().is_err(), "{text}");
        }
    }

    #[test]
    fn dimensions_and_sizes() {
        assert_eq!(parse_dims("4x5x6"), Ok([4, 5, 6]));
        assert!(["4x5", "4x5x0", "4x5xq", "1x2x3x4"].iter().all(|t| parse_dims(t).is_err()));
        assert_eq!(parse_picture_size("640x480"), Ok([640, 480]));
        assert!(["640", "0x4", "99999x4"].iter().all(|t| parse_picture_size(t).is_err()));
        assert_eq!(parse_triple("1,-2,3.5"), Ok([1.0, -2.0, 3.5]));
        assert!(parse_triple("1,2,x,3").is_err());
        assert_eq!(parse_range("-1:2"), Ok([-1.0, 2.0]));
        assert!(["2:1", "1", "nan:2"].iter().all(|t| parse_range(t).is_err()));
    }
}
