//! What the fixtures hold, by the rule that `make_fixtures.py` states.

use std::path::PathBuf;

use chronoxel_core::{SampleType, Samples};
use chronoxel_ingest::sources::{self, SourceOptions};
use chronoxel_ingest::{SourceError, TimeSeries};

/// Dimensions of nearly all fixtures.
pub const DIMS: [usize; 3] = [5, 4, 3];
/// Their origin, where the format has one.
pub const ORIGIN: [f64; 3] = [1.0, -2.0, 3.0];
/// Their spacing, where the format has one.
pub const SPACING: [f64; 3] = [0.5, 2.0, 0.25];

/// The path of a fixture.
pub fn path(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

/// Opens a fixture without options.
pub fn open(name: &str) -> Result<Box<dyn TimeSeries>, SourceError> {
    open_with(&path(name).to_string_lossy(), &SourceOptions::default())
}

/// Opens one input.
pub fn open_with(input: &str, options: &SourceOptions) -> Result<Box<dyn TimeSeries>, SourceError> {
    sources::open(&[input.to_owned()], options)
}

/// The message of a source that must be refused, checked to be one line.
pub fn refusal(opened: Result<Box<dyn TimeSeries>, SourceError>) -> String {
    let message = opened.err().expect("the source must be refused").to_string();
    assert!(!message.contains('\n'), "more than one line: {message}");
    message
}

/// The message of a fixture that must be refused.
pub fn refused(name: &str) -> String {
    let message = refusal(open(name));
    assert!(message.contains(name.rsplit('/').next().unwrap()), "the file is not named: {message}");
    message
}

/// All samples of a step, read in slabs of `slab` slices.
pub fn read_slabs(
    series: &mut dyn TimeSeries,
    variable: usize,
    step: usize,
    slab: usize,
) -> Result<Samples, SourceError> {
    let num_slices = series.grid().dims[2];
    let mut reader = series.open_step(variable, step)?;
    let mut all: Option<Samples> = None;
    let mut next = 0;
    while next < num_slices {
        let count = slab.min(num_slices - next);
        let slices = reader.read_slices(count)?;
        next += count;
        match (&mut all, slices) {
            (None, slices) => all = Some(slices),
            (Some(Samples::F32(all)), Samples::F32(slices)) => all.extend(slices),
            (Some(Samples::F64(all)), Samples::F64(slices)) => all.extend(slices),
            _ => panic!("the kind of samples changes from slab to slab"),
        }
    }
    Ok(all.expect("there is at least one slice"))
}

/// All samples of a step, after checking that slabs of any height give the same ones.
pub fn read(series: &mut dyn TimeSeries, variable: usize, step: usize) -> Vec<f64> {
    let whole = read_slabs(series, variable, step, usize::MAX).unwrap();
    assert_eq!(matches!(whole, Samples::F32(_)), series.variables()[variable].sample_type.fits_f32());
    for slab in [1, 2] {
        assert_eq!(read_slabs(series, variable, step, slab).unwrap(), whole);
    }
    whole.to_f64()
}

/// The samples that a fixture holds at a step.
pub fn expected(sample_type: SampleType, step: usize) -> Vec<f64> {
    let mut values = Vec::new();
    for z in 0..DIMS[2] {
        for y in 0..DIMS[1] {
            for x in 0..DIMS[0] {
                let value = match sample_type {
                    SampleType::U8 => x + 10 * y + 60 * z,
                    SampleType::I8 => x + 10 * y + 60 * z,
                    _ => x + 10 * y + 100 * z + 1000 * step,
                };
                values.push(value as f64 - if sample_type == SampleType::I8 { 30.0 } else { 0.0 });
            }
        }
    }
    values
}

/// Checks grid, variable and samples of a fixture with steps of one variable.
pub fn check(name: &str, sample_type: SampleType, num_steps: usize, is_placed: bool) {
    let mut series = open(name).unwrap_or_else(|e| panic!("{e}"));
    let (origin, spacing) = if is_placed { (ORIGIN, SPACING) } else { ([0.0; 3], [1.0; 3]) };
    let grid = *series.grid();
    assert_eq!((grid.dims, grid.origin, grid.spacing), (DIMS, origin, spacing), "{name}");
    assert_eq!(series.times().num_steps(), num_steps, "{name}");
    assert_eq!(series.variables()[0].sample_type, sample_type, "{name}");
    // Forward, and one back.
    for step in (0..num_steps).chain([0]) {
        assert_eq!(read(series.as_mut(), 0, step), expected(sample_type, step), "{name}, step {step}");
    }
}
