//! The error of a store of cells against its source: step by step, point by point.

use chronoxel_core::Samples;
use chronoxel_store::{CellStore, CellVariable};

use super::{Found, VariableErrors, index_of, other, per_width};
use crate::encode::mark::mark;
use crate::encode::same_geometry;
use crate::{EncodeError, MeshSeries};

/// Errors of one variable at the points of a mesh.
#[derive(Debug, Clone, PartialEq)]
pub struct CellErrors {
    /// On values scaled to [0, 1] by the variable's range in the store.
    pub errors: VariableErrors,
    /// For each block of 64 steps of which any were measured: `10 log10` of the variance of the source's values over their mean squared
    /// error; infinite where there is none.
    pub snr_db: Vec<f64>,
}

/// What a comparison of a store of cells with its source found.
#[derive(Debug, Clone, PartialEq)]
pub struct CellMeasurement {
    /// For each variable of the store.
    pub variables: Vec<CellErrors>,
    /// What should not be, in sentences: values that are missing on one side alone.
    pub problems: Vec<String>,
}

/// Sums over the measured steps of a block.
#[derive(Debug, Clone, Copy, Default)]
struct BlockSums {
    count: f64,
    sum: f64,
    squares: f64,
    errors: f64,
}

/// Measures the errors of `steps` of a store of cells against the mesh it was made from: of every point of each of them.
///
/// # Errors
/// [`EncodeError::InvalidArgument`] if the source is another mesh, has other times or lacks a variable; else of the
/// source or the store.
pub fn measure_cells(
    store: &CellStore,
    mesh: &mut dyn MeshSeries,
    steps: impl Iterator<Item = usize>,
) -> Result<CellMeasurement, EncodeError> {
    let header = store.header();
    check_same(store, mesh)?;
    let per_step = 8.0 * store.stored_bytes()? as f64 / header.num_points as f64;
    let num_measured = header.num_steps_finished.max(1) as usize * header.variables.len();
    let of_variable = |entry: &CellVariable| VariableErrors {
        name: entry.name.clone(),
        mse: Vec::new(),
        max_abs_error: 0.0,
        bits_per_sample: per_step / num_measured as f64,
    };
    let mut errors: Vec<VariableErrors> = header.variables.iter().map(of_variable).collect();
    let mut sums: Vec<Vec<(u32, BlockSums)>> = vec![Vec::new(); errors.len()];
    let mut problems = Vec::new();
    for step in steps {
        for variable in 0..header.variables.len() {
            let (found, of_step) = measure_step(store, mesh, variable, step as u32)?;
            let errors = &mut errors[variable];
            errors.mse.push(if found.count > 0 { found.squares / found.count as f64 } else { 0.0 });
            errors.max_abs_error = errors.max_abs_error.max(found.largest);
            if let Some([point, ..]) = found.first_mismatch {
                problems.push(format!(
                    "variable {}, step {step}: {} values are missing in the source or the store alone, the first at point {point}",
                    errors.name, found.num_mismatches
                ));
            }
            add(&mut sums[variable], step as u32 / chronoxel_store::cells::BLOCK_STEPS, of_step);
        }
    }
    let snr = |sums: &[(u32, BlockSums)]| sums.iter().map(|(_, sums)| sums.snr_db()).collect();
    let variables =
        errors.into_iter().zip(&sums).map(|(errors, sums)| CellErrors { errors, snr_db: snr(sums) });
    Ok(CellMeasurement { variables: variables.collect(), problems })
}

/// Adds the sums of a step to those of its block; steps come in order.
fn add(sums: &mut Vec<(u32, BlockSums)>, block: u32, of_step: BlockSums) {
    match sums.last_mut().filter(|(last, _)| *last == block) {
        Some((_, sums)) => {
            sums.count += of_step.count;
            sums.sum += of_step.sum;
            sums.squares += of_step.squares;
            sums.errors += of_step.errors;
        }
        None => sums.push((block, of_step)),
    }
}

impl BlockSums {
    fn snr_db(&self) -> f64 {
        let count = self.count.max(1.0);
        let variance = (self.squares / count - (self.sum / count).powi(2)).max(0.0);
        if self.errors > 0.0 { 10.0 * (variance * count / self.errors).log10() } else { f64::INFINITY }
    }
}

fn measure_step(
    store: &CellStore,
    mesh: &mut dyn MeshSeries,
    variable: usize,
    step: u32,
) -> Result<(Found, BlockSums), EncodeError> {
    let entry = &store.header().variables[variable];
    let index = index_of(mesh.variables(), &entry.name)?;
    let mut values = match mesh.read_values(index, step as usize)? {
        Samples::F32(values) => values.into_iter().map(f64::from).collect(),
        Samples::F64(values) => values,
    };
    let fill =
        entry.fill_value.map(|fill| if entry.sample_type.fits_f32() { f64::from(fill as f32) } else { fill });
    mark(&mut values, fill);
    let mut decoded = vec![0.0; values.len()];
    let span = store.read_span(variable, &store.span_at(variable, step)?)?;
    span.decode(step, &mut decoded).map_err(|source| EncodeError::Block {
        variable: entry.name.clone(),
        start: step as usize,
        num_steps: 1,
        source: Box::new(source),
    })?;
    let per_range = per_width(entry.min, entry.max);
    let middle = 0.5 * (entry.min.unwrap_or(0.0) + entry.max.unwrap_or(0.0));
    let (mut found, mut sums) = (Found::default(), BlockSums::default());
    for (point, (&value, &decoded)) in values.iter().zip(&decoded).enumerate() {
        found.compare(value, f64::from(decoded), per_range, || [point, 0, 0]);
        if !value.is_nan() {
            let from_middle = (value - middle) * per_range;
            sums.count += 1.0;
            sums.sum += from_middle;
            sums.squares += from_middle * from_middle;
        }
    }
    sums.errors = found.squares;
    Ok((found, sums))
}

/// Checks that the source can be that of the store.
fn check_same(store: &CellStore, mesh: &mut dyn MeshSeries) -> Result<(), EncodeError> {
    let header = store.header();
    if mesh.times().num_steps() != header.times.num_steps() {
        let (theirs, ours) = (mesh.times().num_steps(), header.times.num_steps());
        return Err(other("number of steps", theirs.to_string(), ours.to_string()));
    }
    if mesh.num_points() as u64 != header.num_points {
        let (theirs, ours) = (mesh.num_points(), header.num_points);
        return Err(other("number of points", theirs.to_string(), ours.to_string()));
    }
    for variable in &header.variables {
        let theirs = mesh.variables()[index_of(mesh.variables(), &variable.name)?].sample_type;
        if theirs != variable.sample_type {
            return Err(other("sample type", theirs.to_string(), variable.sample_type.to_string()));
        }
    }
    match same_geometry(mesh, header)? {
        true => Ok(()),
        false => Err(other("geometry", "of another digest".into(), header.geometry.clone())),
    }
}
