//! The error of a store against its source: step by step, brick by brick, in bounded memory.

mod cells;

use chronoxel_core::{LevelGeometry, Samples, TimeAxis};
use chronoxel_store::{Header, Store, StoreError, VariableEntry};
use rayon::prelude::*;

use crate::decode::StepDecoder;
use crate::encode::real::Real;
use crate::encode::stream::{Layer, StreamPlan, stream};
use crate::encode::voxelised;
use crate::voxelise::{MeshStep, VoxelOptions, Voxels};
use crate::{EncodeError, MeshSeries, TimeSeries, Variable};

pub use cells::{CellErrors, CellMeasurement, measure_cells};

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
    let mut errors = Errors::new(header, bits);
    // Step by step over all variables, in the order in which a simulation gives them.
    for step in steps {
        for variable in 0..header.variables.len() {
            errors.take(variable, step, measure_step(store, series, variable, step)?);
        }
    }
    Ok(errors.finish())
}

/// Errors of all variables, as they are found.
struct Errors {
    variables: Vec<VariableErrors>,
    problems: Vec<String>,
}

impl Errors {
    /// * `bits`: of the store, for each sample of a step
    fn new(header: &Header, bits: f64) -> Self {
        let num_measured = header.num_steps_finished.max(1) as usize * header.variables.len();
        let of_variable = |name: &str| VariableErrors {
            name: name.to_owned(),
            mse: Vec::new(),
            max_abs_error: 0.0,
            bits_per_sample: bits / num_measured as f64,
        };
        let variables = header.variables.iter().map(|v| of_variable(&v.name)).collect();
        Self { variables, problems: Vec::new() }
    }

    fn take(&mut self, variable: usize, step: usize, found: Found) {
        let errors = &mut self.variables[variable];
        errors.mse.push(if found.count > 0 { found.squares / found.count as f64 } else { 0.0 });
        errors.max_abs_error = errors.max_abs_error.max(found.largest);
        if let Some((at, total)) = found.first_mismatch.map(|at| (at, found.num_mismatches)) {
            self.problems.push(format!(
                "variable {}, step {step}: {total} samples are masked in the source or the store alone, \
                 the first at ({}, {}, {})",
                errors.name, at[0], at[1], at[2]
            ));
        }
    }

    fn finish(self) -> Measurement {
        Measurement { variables: self.variables, problems: self.problems }
    }
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

/// Measures the errors of `steps` of a store against the mesh it was made from: of every core sample of every node without
/// children. Voxelises the mesh again, with the options that the store records, within `memory_bytes`.
///
/// # Errors
/// [`EncodeError::InvalidArgument`] if the source is another mesh, has other times or lacks a variable; else of the
/// source or the store.
pub fn measure_mesh(
    store: &Store,
    mesh: &mut dyn MeshSeries,
    memory_bytes: u64,
    steps: impl Iterator<Item = usize> + Clone,
) -> Result<Measurement, EncodeError> {
    let header = store.header();
    let voxels = voxels_of_store(store, mesh, memory_bytes)?;
    let bits = 8.0 * store.stored_bytes()? as f64 / voxels.num_finest_samples() as f64;
    let mut errors = Errors::new(header, bits);
    for step in steps {
        for (variable, entry) in header.variables.iter().enumerate() {
            let index = index_of(mesh.variables(), &entry.name)?;
            let values = mesh.read_values(index, step)?;
            let decoder = StepDecoder::new(store, variable, step)?;
            let per_range = per_range(entry);
            let found = match entry.sample_type.fits_f32() {
                true => compare_mesh::<f32>(&voxels, values, entry.fill_value, &decoder, per_range),
                false => compare_mesh::<f64>(&voxels, values, entry.fill_value, &decoder, per_range),
            }?;
            errors.take(variable, step, found);
        }
    }
    Ok(errors.finish())
}

fn voxels_of_store(
    store: &Store,
    mesh: &mut dyn MeshSeries,
    memory_bytes: u64,
) -> Result<Voxels, EncodeError> {
    let header = store.header();
    check_axes(store, mesh.times(), mesh.variables())?;
    let other = |what: &str| EncodeError::InvalidArgument {
        argument: "--against",
        value: format!("is a mesh with {} points", mesh.num_points()),
        remedy: format!("the store {what}: it is not the source of this store"),
    };
    let Some(entry) = &header.mesh else { return Err(other("was made from a uniform grid")) };
    if entry.num_points != mesh.num_points() as u64 {
        return Err(other(&format!("was made from one with {}", entry.num_points)));
    }
    let differs = other("has other nodes than it gives");
    let number = |name: &str| header.encoder[name].as_f64();
    let defaults = VoxelOptions::default();
    let options = VoxelOptions {
        field_threshold: number("field_threshold").unwrap_or(defaults.field_threshold),
        max_depth: number("max_depth").map_or(defaults.max_depth, |depth| depth as u8),
    };
    let indices = header.variables.iter().map(|v| Ok((index_of(mesh.variables(), &v.name)?, v.fill_value)));
    let variables = indices.collect::<Result<Vec<_>, EncodeError>>()?;
    let folder = std::env::temp_dir();
    let voxels = voxelised(mesh, &variables, &header.bricks, &options, &folder, memory_bytes)?;
    match voxels.tree() == store.tree() && *voxels.grid() == header.grid {
        true => Ok(voxels),
        false => Err(differs),
    }
}

fn compare_mesh<T: Real>(
    voxels: &Voxels,
    values: Samples,
    fill_value: Option<f64>,
    decoder: &StepDecoder<'_>,
    per_range: f64,
) -> Result<Found, EncodeError> {
    let layout = voxels.layout();
    let values = T::from_samples(values).expect("the kind of samples follows from their type");
    let mut step = MeshStep::new(voxels, values, fill_value, voxels.core_scratch::<T>(CORE_BYTES)?);
    let mut all = Found::default();
    for batch in MeshStep::<T>::batches(voxels, 4 * rayon::current_num_threads()) {
        let geometry = &voxels.levels()[usize::from(batch.level)];
        let compare = |rank: u32, brick: [usize; 3], samples: &mut Vec<T>| {
            let mut found = Found::default();
            if voxels.is_leaf(batch.level, rank as usize) {
                let decoded = decoder.full_brick(batch.level, rank as usize)?;
                for i in geometry.core_inside(brick, layout).into_iter().map(|i| i as usize) {
                    let full = layout.full_edge();
                    let place = [i % full, i / full % full, i / full / full];
                    let first = |a: usize| (brick[a] * layout.edge + place[a] - layout.low) << batch.level;
                    found.compare(samples[i].to_f64(), decoded[i], per_range, || std::array::from_fn(first));
                }
            }
            Ok(found)
        };
        all = step.make(&batch, &compare)?.into_iter().fold(all, Found::merged);
    }
    Ok(all)
}

/// What cores of nodes with children take in memory while a step is measured.
const CORE_BYTES: u64 = 64 << 20;

fn measure_step(
    store: &Store,
    series: &mut dyn TimeSeries,
    variable: usize,
    step: usize,
) -> Result<Found, EncodeError> {
    let entry = &store.header().variables[variable];
    let index = index_of(series.variables(), &entry.name)?;
    let per_range = per_range(entry);
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

fn per_range(entry: &VariableEntry) -> f64 {
    per_width(entry.min, entry.max)
}

/// What scales differences to the range of a variable.
fn per_width(min: Option<f64>, max: Option<f64>) -> f64 {
    let [low, high] = [min.unwrap_or(0.0), max.unwrap_or(0.0)];
    let width = 2.0 * (0.5 * high - 0.5 * low);
    if width > 0.0 { 1.0 / width } else { 1.0 }
}

fn index_of(variables: &[Variable], name: &str) -> Result<usize, EncodeError> {
    let names: Vec<&str> = variables.iter().map(|v| v.name.as_str()).collect();
    names.iter().position(|n| *n == name).ok_or_else(|| {
        let remedy = format!("the source has {}: it is not the source of this store", names.join(", "));
        EncodeError::InvalidArgument { argument: "--against: variable", value: name.to_owned(), remedy }
    })
}

/// Checks that the source can be that of the store.
fn check_same(store: &Store, series: &dyn TimeSeries) -> Result<(), EncodeError> {
    let header = store.header();
    let dims = |mesh: bool, dims: [usize; 3]| if mesh { "of a mesh".to_owned() } else { format!("{dims:?}") };
    if series.grid().dims != header.grid.dims || header.mesh.is_some() {
        let (theirs, ours) = (dims(false, series.grid().dims), dims(header.mesh.is_some(), header.grid.dims));
        return Err(other("dimensions", theirs, ours));
    }
    check_axes(store, series.times(), series.variables())
}

fn other(what: &str, theirs: String, ours: String) -> EncodeError {
    EncodeError::InvalidArgument {
        argument: "--against",
        value: format!("with {what} {theirs}"),
        remedy: format!("the store has {ours}: it is not the source of this store"),
    }
}

fn check_axes(store: &Store, times: &TimeAxis, variables: &[Variable]) -> Result<(), EncodeError> {
    let header = store.header();
    if times.num_steps() != header.times.num_steps() {
        let (theirs, ours) = (times.num_steps(), header.times.num_steps());
        return Err(other("number of steps", theirs.to_string(), ours.to_string()));
    }
    for variable in &header.variables {
        let theirs = variables[index_of(variables, &variable.name)?].sample_type;
        if theirs != variable.sample_type {
            return Err(other("sample type", theirs.to_string(), variable.sample_type.to_string()));
        }
    }
    Ok(())
}
