//! Which points need a voxel of their own: those around which the field varies by more than a threshold.
//!
//! Where a point shares a voxel with others, the sample nearby is a value of the field between its neighbours: what is lost is less
//! than the variation around the point, which the threshold bounds so.

use super::records::{List, Pool};
use crate::encode::mark::mark;
use crate::encode::real::Real;
use crate::{EncodeError, MeshSeries};

/// Bytes of memory for each point: its values, the range around it, its variation.
pub const BYTES_PER_POINT: u64 = 8 + 16 + 8;

/// For each point, whether any variable at any step differs around it by more than `threshold` of the variable's range.
pub fn needs_voxel(
    mesh: &mut dyn MeshSeries,
    variables: &[(usize, Option<f64>)],
    threshold: f64,
    list: &List,
    pool: &mut Pool,
) -> Result<Vec<bool>, EncodeError> {
    let num_points = mesh.num_points();
    let mut needs = vec![false; num_points];
    if threshold >= 1.0 {
        return Ok(needs);
    }
    let is_used = used_points(num_points, list, pool)?;
    for &(variable, fill_value) in variables {
        let mut variation = Variation::new(num_points);
        for step in 0..mesh.times().num_steps() {
            let values = mesh.read_values(variable, step)?;
            match mesh.variables()[variable].sample_type.fits_f32() {
                true => variation.take::<f32>(values, fill_value, list, pool)?,
                false => variation.take::<f64>(values, fill_value, list, pool)?,
            }
            // Without a threshold nothing more can come of the rest.
            let is_decided = |point: usize| !is_used[point] || needs[point] || variation.largest[point] > 0.0;
            if threshold == 0.0 && (0..num_points).all(is_decided) {
                break;
            }
        }
        let most = threshold * crate::encode::mark::width_of(variation.range);
        for (needs, variation) in needs.iter_mut().zip(&variation.largest) {
            *needs |= *variation > most;
        }
    }
    Ok(needs)
}

fn used_points(num_points: usize, list: &List, pool: &mut Pool) -> Result<Vec<bool>, EncodeError> {
    let mut is_used = vec![false; num_points];
    pool.each(list, &mut |block, _| {
        block.iter().flat_map(|t| t.vertices).for_each(|point| is_used[point as usize] = true);
        Ok(true)
    })?;
    Ok(is_used)
}

/// The largest variation around each point over the steps so far.
struct Variation {
    largest: Vec<f64>,
    /// Of all values.
    range: [f64; 2],
}

impl Variation {
    fn new(num_points: usize) -> Self {
        Self { largest: vec![0.0; num_points], range: [f64::INFINITY, f64::NEG_INFINITY] }
    }

    fn take<T: Real>(
        &mut self,
        values: chronoxel_core::Samples,
        fill_value: Option<f64>,
        list: &List,
        pool: &mut Pool,
    ) -> Result<(), EncodeError> {
        let mut values = T::from_samples(values).expect("the kind of samples follows from their type");
        let marks = mark(&mut values, fill_value);
        self.range = [self.range[0].min(marks.range[0]), self.range[1].max(marks.range[1])];
        let mut around = vec![(T::INFINITE, T::INFINITE.negated()); values.len()];
        pool.each(list, &mut |block, _| {
            for tetrahedron in block {
                let (mut low, mut high) = (T::INFINITE, T::INFINITE.negated());
                for v in tetrahedron.vertices.map(|point| values[point as usize]) {
                    // A comparison with NaN is false: masked values change nothing.
                    low = if v < low { v } else { low };
                    high = if v > high { v } else { high };
                }
                for point in tetrahedron.vertices {
                    let around = &mut around[point as usize];
                    around.0 = if low < around.0 { low } else { around.0 };
                    around.1 = if high > around.1 { high } else { around.1 };
                }
            }
            Ok(true)
        })?;
        for (largest, (low, high)) in self.largest.iter_mut().zip(around) {
            *largest = largest.max(crate::encode::mark::width_of([low.to_f64(), high.to_f64()]));
        }
        Ok(())
    }
}
