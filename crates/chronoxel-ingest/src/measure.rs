//! The error of a store against its source: step by step, brick by brick, in bounded memory.

use chronoxel_core::LevelGeometry;
use chronoxel_store::{Store, StoreError};
use rayon::prelude::*;

use crate::decode::StepDecoder;
use crate::encode::real::Real;
use crate::encode::stream::{Layer, StreamPlan, stream};
use crate::{EncodeError, TimeSeries};

/// Errors of one variable on values scaled to [0, 1] by its range in the store.
#[derive(Debug, Clone, PartialEq)]
pub struct VariableErrors {
    /// The variable.
    pub name: String,
    /// Mean squared error of each measured step.
    pub mse: Vec<f64>,
    /// Largest absolute error over all measured steps.
    pub max_abs_error: f64,
    /// Bits stored per source sample, all of the store over all of its variables and steps.
    pub bits_per_sample: f64,
}

impl VariableErrors {
    /// Smallest, largest and average mean squared error over the steps.
    pub fn mse_range(&self) -> [f64; 3] {
        let min = self.mse.iter().copied().fold(f64::INFINITY, f64::min);
        let max = self.mse.iter().copied().fold(0.0, f64::max);
        [min, max, self.mse.iter().sum::<f64>() / self.mse.len().max(1) as f64]
    }

    /// Peak signal-to-noise ratio of the average mean squared error, in dB; infinite where there is no error.
    pub fn psnr_db(&self) -> f64 {
        -10.0 * self.mse_range()[2].log10()
    }
}

/// What a comparison of a store with its source found.
#[derive(Debug, Clone, PartialEq)]
pub struct Measurement {
    /// For each variable of the store.
    pub variables: Vec<VariableErrors>,
    /// What should not be, in sentences: samples masked on one side alone.
    pub problems: Vec<String>,
}

/// Measures the errors of `steps` of a store against the series it was made from. Reads each of them once, front to
/// back, and holds about two layers of bricks of them.
///
/// # Errors
/// [`EncodeError::InvalidArgument`] if the source has another grid, other times or lacks a variable; else of the
/// source or the store.
pub fn measure(
    store: &Store,
    series: &mut dyn TimeSeries,
    steps: impl Iterator<Item = usize> + Clone,
) -> Result<Measurement, EncodeError> {
    let header = store.header();
    check_same(store, series)?;
    let bits = 8.0 * store.stored_bytes()? as f64 / header.grid.num_samples() as f64;
    let num_measured = header.num_steps_finished.max(1) as usize * header.variables.len();
    let mut problems = Vec::new();
    let mut variables: Vec<_> = header
        .variables
        .iter()
        .map(|v| VariableErrors {
            name: v.name.clone(),
            mse: Vec::new(),
            max_abs_error: 0.0,
            bits_per_sample: bits / num_measured as f64,
        })
        .collect();
    // Step by step over all variables, in the order in which a simulation gives them.
    for step in steps {
        for (variable, errors) in variables.iter_mut().enumerate() {
            let found = measure_step(store, series, variable, step)?;
            errors.mse.push(if found.count > 0 { found.squares / found.count as f64 } else { 0.0 });
            errors.max_abs_error = errors.max_abs_error.max(found.largest);
            if let Some((at, total)) = found.first_mismatch.map(|at| (at, found.num_mismatches)) {
                problems.push(format!(
                    "variable {}, step {step}: {total} samples are masked in the source or the store alone, \
                     the first at ({}, {}, {})",
                    errors.name, at[0], at[1], at[2]
                ));
            }
        }
    }
    Ok(Measurement { variables, problems })
}

/// Sums over some samples.
#[derive(Debug, Clone, Copy, Default)]
struct Found {
    count: u64,
    squares: f64,
    largest: f64,
    num_mismatches: u64,
    first_mismatch: Option<[usize; 3]>,
}

impl Found {
    fn merged(self, other: Self) -> Self {
        Self {
            count: self.count + other.count,
            squares: self.squares + other.squares,
            largest: self.largest.max(other.largest),
            num_mismatches: self.num_mismatches + other.num_mismatches,
            first_mismatch: self.first_mismatch.or(other.first_mismatch),
        }
    }

    fn compare(&mut self, source: f64, decoded: f64, per_range: f64, at: impl Fn() -> [usize; 3]) {
        if source.is_nan() != decoded.is_nan() {
            self.num_mismatches += 1;
            self.first_mismatch.get_or_insert_with(at);
        } else if !source.is_nan() {
            let difference = decoded - source;
            let error = match difference.is_finite() {
                true => (difference * per_range).abs(),
                false => (decoded * per_range - source * per_range).abs(),
            };
            self.count += 1;
            self.squares += error * error;
            self.largest = self.largest.max(error);
        }
    }
}

fn measure_step(
    store: &Store,
    series: &mut dyn TimeSeries,
    variable: usize,
    step: usize,
) -> Result<Found, EncodeError> {
    let entry = &store.header().variables[variable];
    let index = index_of(series, &entry.name)?;
    let [low, high] = [entry.min.unwrap_or(0.0), entry.max.unwrap_or(0.0)];
    let width = 2.0 * (0.5 * high - 0.5 * low);
    let per_range = if width > 0.0 { 1.0 / width } else { 1.0 };
    let decoder = StepDecoder::new(store, variable, step)?;
    let finest: LevelGeometry = store.header().geometry()[0];
    let plan = StreamPlan { levels: vec![finest], layout: store.header().bricks, slab_slices: 4 };
    let reader = series.open_step(index, step)?;
    let mut found = Found::default();
    match entry.sample_type.fits_f32() {
        true => stream::<f32, EncodeError>(reader, &plan, entry.fill_value, &mut |layer| {
            compare_layer(&layer, &decoder, per_range, &mut found)
        })?,
        false => stream::<f64, EncodeError>(reader, &plan, entry.fill_value, &mut |layer| {
            compare_layer(&layer, &decoder, per_range, &mut found)
        })?,
    };
    Ok(found)
}

fn compare_layer<T: Real>(
    layer: &Layer<'_, T>,
    decoder: &StepDecoder<'_>,
    per_range: f64,
    found: &mut Found,
) -> Result<(), EncodeError> {
    let [nx, ny, _] = layer.window.geometry.bricks;
    let bricks: Vec<_> = (0..ny).flat_map(|y| (0..nx).map(move |x| [x, y, layer.z])).collect();
    let width = layer.window.geometry.field_dims[0];
    let compared: Vec<Result<Found, StoreError>> = bricks
        .par_iter()
        .map(|&brick| {
            let block = decoder.brick(brick)?;
            let [nx, ny, _] = block.extent;
            let mut found = Found::default();
            for (row, decoded) in block.samples.chunks(nx).enumerate() {
                let (y, z) = (block.first[1] + row % ny, block.first[2] + row / ny);
                let source = &layer.window.slice(z).0[block.first[0] + width * y..][..nx];
                for (x, (s, &d)) in source.iter().zip(decoded).enumerate() {
                    found.compare(s.to_f64(), d, per_range, || [block.first[0] + x, y, z]);
                }
            }
            Ok(found)
        })
        .collect();
    for one in compared {
        *found = found.merged(one?);
    }
    Ok(())
}

fn index_of(series: &dyn TimeSeries, name: &str) -> Result<usize, EncodeError> {
    let names: Vec<&str> = series.variables().iter().map(|v| v.name.as_str()).collect();
    names.iter().position(|n| *n == name).ok_or_else(|| {
        let remedy = format!("the source has {}: it is not the source of this store", names.join(", "));
        EncodeError::InvalidArgument { argument: "--against: variable", value: name.to_owned(), remedy }
    })
}

/// Checks that the source can be that of the store.
fn check_same(store: &Store, series: &dyn TimeSeries) -> Result<(), EncodeError> {
    let header = store.header();
    let other = |what: &str, theirs: String, ours: String| {
        Err(EncodeError::InvalidArgument {
            argument: "--against",
            value: format!("with {what} {theirs}"),
            remedy: format!("the store has {ours}: it is not the source of this store"),
        })
    };
    if series.grid().dims != header.grid.dims {
        return other("dimensions", format!("{:?}", series.grid().dims), format!("{:?}", header.grid.dims));
    }
    if series.times().num_steps() != header.times.num_steps() {
        let (theirs, ours) = (series.times().num_steps(), header.times.num_steps());
        return other("number of steps", theirs.to_string(), ours.to_string());
    }
    for variable in &header.variables {
        let index = index_of(series, &variable.name)?;
        let theirs = series.variables()[index].sample_type;
        if theirs != variable.sample_type {
            return other("sample type", theirs.to_string(), variable.sample_type.to_string());
        }
    }
    Ok(())
}
