//! Filtering a level from the one below: weights 1 2 1 along each axis, masked samples left out.
//!
//! Sample `i` of level `l + 1` lies on sample `2 i` of level `l` and averages `2 i - 1 ..= 2 i + 1`, positions
//! clamped to the level. Where masked samples are among the 27, the remaining weights are renormalised; where
//! all are masked, so is the result.

use rayon::prelude::*;

use super::real::Real;
use super::window::{Slab, Window};

/// Filters every slice of the level above that `below` can give and `above` does not have yet.
pub fn advance<T: Real>(below: &Window<T>, above: &mut Window<T>) {
    let first = above.num_slices();
    let end = slices_ready(below, above.geometry.field_dims[2]);
    if end <= first {
        return;
    }
    let len = above.slice_len();
    let width = above.geometry.field_dims[0];
    let mut samples = vec![T::MASKED; len * (end - first)];
    // Rows are the unit of work, so that two slices already occupy all threads.
    samples.par_chunks_mut(width).with_min_len(8).enumerate().for_each_init(
        Scratch::default,
        |scratch, (r, row)| {
            let (z, y) = (first + r / (len / width), r % (len / width));
            filter_row(below, z, y, row, scratch);
        },
    );
    let masked = samples
        .chunks(len)
        .enumerate()
        .map(|(k, slice)| any_masked(below, first + k) && slice.iter().any(|v| v.is_masked()))
        .collect();
    above.push(Slab { first, samples, masked });
}

fn slices_ready<T: Real>(below: &Window<T>, depth_above: usize) -> usize {
    match below.num_slices() == below.geometry.field_dims[2] {
        true => depth_above,
        false => below.num_slices() / 2,
    }
}

fn any_masked<T: Real>(below: &Window<T>, z: usize) -> bool {
    (-1..=1).any(|d| below.slice_clamped(2 * z as isize + d).1)
}

struct Scratch<T> {
    row: Vec<T>,
    sums: Vec<f64>,
    weights: Vec<f64>,
}

impl<T> Default for Scratch<T> {
    fn default() -> Self {
        Self { row: Vec::new(), sums: Vec::new(), weights: Vec::new() }
    }
}

/// Row `y` of slice `z` of the level above.
fn filter_row<T: Real>(below: &Window<T>, z: usize, y: usize, out: &mut [T], scratch: &mut Scratch<T>) {
    let [width, height, _] = below.geometry.field_dims;
    let rows: [[&[T]; 3]; 3] = std::array::from_fn(|k| {
        let slice = below.slice_clamped(2 * z as isize + k as isize - 1).0;
        std::array::from_fn(|j| {
            let row = (2 * y + j).saturating_sub(1).min(height - 1);
            &slice[row * width..][..width]
        })
    });
    if any_masked(below, z) {
        filter_masked(&rows, out, scratch);
    } else {
        scratch.row.resize(width, T::MASKED);
        average_rows(&rows, &mut scratch.row);
        decimate(&scratch.row, out);
    }
}

/// The nine rows averaged into one: along z first, then along y.
fn average_rows<T: Real>(rows: &[[&[T]; 3]; 3], out: &mut [T]) {
    let n = out.len();
    let [low, middle, high] = rows.map(|slice| slice.map(|row| &row[..n]));
    for x in 0..n {
        let along_z = |j: usize| T::average_121(low[j][x], middle[j][x], high[j][x]);
        out[x] = T::average_121(along_z(0), along_z(1), along_z(2));
    }
}

/// Every second sample, averaged with its neighbours.
fn decimate<T: Real>(row: &[T], out: &mut [T]) {
    let (last, top) = (row.len() - 1, out.len() - 1);
    out[0] = T::average_121(row[0], row[0], row[1.min(last)]);
    if top > 0 {
        for (out, near) in out[1..top].iter_mut().zip(row[1..].windows(3).step_by(2)) {
            *out = T::average_121(near[0], near[1], near[2]);
        }
        let at = |x: usize| row[x.min(last)];
        out[top] = T::average_121(at(2 * top - 1), at(2 * top), at(2 * top + 1));
    }
}

/// The definition for rows with masked samples: sums and weights in `f64`, then one division.
fn filter_masked<T: Real>(rows: &[[&[T]; 3]; 3], out: &mut [T], scratch: &mut Scratch<T>) {
    const WEIGHTS: [f64; 3] = [0.25, 0.5, 0.25];
    let width = rows[0][0].len();
    let Scratch { sums, weights, .. } = scratch;
    for sums in [&mut *sums, &mut *weights] {
        sums.clear();
        sums.resize(width, 0.0);
    }
    for (slice, along_z) in rows.iter().zip(WEIGHTS) {
        for (row, along_y) in slice.iter().zip(WEIGHTS) {
            let weight = along_z * along_y;
            for ((value, sum), weights) in row.iter().zip(&mut *sums).zip(&mut *weights) {
                let masked = value.is_masked();
                *sum += if masked { 0.0 } else { weight * value.to_f64() };
                *weights += if masked { 0.0 } else { weight };
            }
        }
    }
    for (x, out) in out.iter_mut().enumerate() {
        let near = [(2 * x).saturating_sub(1), 2 * x, 2 * x + 1].map(|x| x.min(width - 1));
        let total = |of: &[f64]| near.iter().zip(WEIGHTS).map(|(&x, w)| w * of[x]).sum::<f64>();
        let weight = total(weights);
        let largest = T::LARGEST.to_f64();
        *out = match weight > 0.0 {
            true => T::from_f64((total(sums) / weight).clamp(-largest, largest)),
            false => T::MASKED,
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use chronoxel_core::{BrickLayout, UniformGrid, octree::levels_of};

    /// Filters `source` up one level, in slabs of `slab` slices.
    fn filtered(
        dims: [usize; 3],
        source: &dyn Fn([usize; 3]) -> f32,
        slab: usize,
    ) -> (Window<f32>, [usize; 3]) {
        let grid = UniformGrid::new(dims, [0.0; 3], [1.0; 3]).unwrap();
        let mut layout = BrickLayout::new(8).unwrap();
        layout.edge = 1; // so that there is a level above, however small the grid
        let levels = levels_of(&grid, &layout);
        let above = levels.get(1).copied().unwrap_or(levels[0]);
        let (mut below, mut up) = (Window::new(levels[0]), Window::new(above));
        let slice = |z: usize| -> Vec<f32> {
            (0..dims[1]).flat_map(|y| (0..dims[0]).map(move |x| source([x, y, z]))).collect()
        };
        for first in (0..dims[2]).step_by(slab) {
            let slices: Vec<_> = (first..dims[2].min(first + slab)).map(slice).collect();
            let masked = slices.iter().map(|s| s.iter().any(|v| v.is_nan())).collect();
            below.push(Slab { first, samples: slices.concat(), masked });
            advance(&below, &mut up);
        }
        (up, above.field_dims)
    }

    fn at(window: &Window<f32>, dims: [usize; 3], [x, y, z]: [usize; 3]) -> f32 {
        window.slice(z).0[x + dims[0] * y]
    }

    #[test]
    fn a_ramp_stays_a_ramp_inside() {
        let ramp = |[x, y, z]: [usize; 3]| (x + 4 * y + 16 * z) as f32;
        let (up, dims) = filtered([9, 7, 6], &ramp, 4);
        assert_eq!(dims, [5, 4, 4]);
        // Interior sample i lies on sample 2 i; the ends lean inwards by a quarter of a sample.
        assert_eq!(at(&up, dims, [1, 2, 1]), ramp([2, 4, 2]));
        assert_eq!(at(&up, dims, [0, 1, 1]), ramp([0, 2, 2]) + 0.25);
        assert_eq!(at(&up, dims, [4, 1, 1]), ramp([8, 2, 2]) - 0.25);
        // Of an even number of samples the last of the level lies beyond the grid: the last sample, replicated.
        assert_eq!(at(&up, dims, [1, 1, 3]), ramp([2, 2, 5]));
    }

    #[test]
    fn slabs_do_not_change_the_result() {
        let noise = |[x, y, z]: [usize; 3]| ((x * 7919 + y * 104_729 + z * 1_299_709) % 1000) as f32 / 7.0;
        let (once, dims) = filtered([13, 6, 11], &noise, 11);
        for slab in [1, 2, 3, 5] {
            let (other, _) = filtered([13, 6, 11], &noise, slab);
            assert!((0..dims[2]).all(|z| once.slice(z).0 == other.slice(z).0), "slab {slab}");
        }
    }

    #[test]
    fn masked_samples_are_left_out_and_weights_renormalised() {
        let source = |p: [usize; 3]| match p {
            [2, 2, 2] => 8.0,
            [3, 2, 2] => 5.0,
            _ => f32::NAN,
        };
        let (up, dims) = filtered([7, 7, 7], &source, 7);
        // Sample (1, 1, 1) sees both with weights 1/2 and 1/4 along x, (2, 1, 1) the second alone.
        assert_eq!(at(&up, dims, [1, 1, 1]), 7.0);
        assert_eq!(at(&up, dims, [2, 1, 1]), 5.0);
        assert!(at(&up, dims, [0, 1, 1]).is_nan());
        assert!(up.slice(1).1 && up.slice(3).1);
    }

    #[test]
    fn flat_grids_are_filtered_along_what_they_have() {
        let (up, dims) = filtered([5, 1, 1], &|[x, _, _]| x as f32, 1);
        assert_eq!(dims, [3, 1, 1]);
        assert_eq!(up.slice(0).0, [0.25, 2.0, 3.75]);
    }
}
