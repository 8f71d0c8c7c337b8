//! Three-dimensional real Fourier transforms that keep only the modes a dealiased solver needs.
//!
//! A field on `[z, y, x]` has modes `0 ≤ kx ≤ m`, `|ky| ≤ m`, `|kz| ≤ m` with `m = (n − 1) / 3` along each axis of
//! n samples (the 2/3 rule), the rest being zero. Spectra lie as `[kx, field, ky, kz]`; negative wave numbers
//! follow the positive ones. Transforms pass through columns (z done) and slabs (y and x done), so that no whole
//! field need exist. Two real rows share one complex transform along x, which works for every length.
//!
//! Arithmetic is `f32`, by rustfft's scalar algorithms: one result on every machine.

use std::sync::Arc;

use rayon::prelude::*;
use rustfft::{Fft, FftDirection, FftPlannerScalar, num_complex::Complex};

/// A mode or a sample in a transform.
pub(super) type Complex32 = Complex<f32>;

const ZERO: Complex32 = Complex32 { re: 0.0, im: 0.0 };

/// Transforms of one shape.
pub(super) struct Fourier {
    dims: [usize; 3],
    modes: [usize; 3],
    to_modes: [Arc<dyn Fft<f32>>; 3],
    to_samples: [Arc<dyn Fft<f32>>; 3],
}

/// Buffers that a thread reuses from slab to slab.
#[derive(Default)]
pub(super) struct Scratch {
    plane: Vec<Complex32>,
    pencil: Vec<Complex32>,
    fft: Vec<Complex32>,
}

impl Fourier {
    /// Plans for fields of these dimensions, each at least 4.
    pub fn new(dims: [usize; 3]) -> Self {
        let mut planner = FftPlannerScalar::new();
        Self {
            dims,
            modes: modes_of(dims),
            to_modes: dims.map(|n| planner.plan_fft(n, FftDirection::Forward)),
            to_samples: dims.map(|n| planner.plan_fft(n, FftDirection::Inverse)),
        }
    }

    /// Modes kept along x, y, z.
    pub fn modes(&self) -> [usize; 3] {
        self.modes
    }

    /// The wave number of mode `index` along an axis.
    pub fn wave_number(&self, axis: usize, index: usize) -> f32 {
        let cut = cutoff(self.dims[axis]);
        if index <= cut { index as f32 } else { index as f32 - self.modes[axis] as f32 }
    }

    /// Inverse transforms along z; `make([ikx, iky], pencils)` gives the modes `[field, kz]` of every pencil.
    ///
    /// Returns `[kx, field, ky, z]`.
    pub fn columns(
        &self,
        num_fields: usize,
        make: impl Fn([usize; 2], &mut [Complex32]) + Sync,
    ) -> Vec<Complex32> {
        let ([_, _, nz], [_, my, mz]) = (self.dims, self.modes);
        let mut columns = vec![ZERO; self.modes[0] * num_fields * my * nz];
        columns.par_chunks_mut(num_fields * my * nz).enumerate().for_each_init(
            Scratch::default,
            |scratch, (ikx, out)| {
                scratch.pencil.resize(num_fields * mz, ZERO);
                for iky in 0..my {
                    make([ikx, iky], &mut scratch.pencil);
                    for (field, modes) in scratch.pencil.chunks_exact(mz).enumerate() {
                        let column = &mut out[(field * my + iky) * nz..][..nz];
                        spread(modes, column);
                        run(&self.to_samples[2], column, &mut scratch.fft);
                    }
                }
            },
        );
        columns
    }

    /// Samples `[y, x]` of one field in slice `k`, from its columns.
    pub fn slab(
        &self,
        columns: &[Complex32],
        [num_fields, field, k]: [usize; 3],
        samples: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let ([nx, ny, nz], [mx, my, _]) = (self.dims, self.modes);
        let Scratch { plane, pencil, fft } = scratch;
        plane.resize(mx * ny, ZERO);
        pencil.resize(my, ZERO);
        for (ikx, row) in plane.chunks_exact_mut(ny).enumerate() {
            let first = (ikx * num_fields + field) * my * nz + k;
            pencil.iter_mut().enumerate().for_each(|(iky, p)| *p = columns[first + iky * nz]);
            spread(pencil, row);
            run(&self.to_samples[1], row, fft);
        }
        pencil.resize(nx, ZERO);
        for (j, rows) in (0..).step_by(2).zip(samples.chunks_mut(2 * nx)) {
            let (low, high) = rows.split_at_mut(nx);
            pencil.fill(ZERO);
            for ikx in 0..mx {
                let a = plane[ikx * ny + j];
                let b = if high.is_empty() { ZERO } else { plane[ikx * ny + j + 1] };
                if ikx == 0 {
                    pencil[0] = Complex32::new(a.re, b.re);
                } else {
                    pencil[ikx] = Complex32::new(a.re - b.im, a.im + b.re);
                    pencil[nx - ikx] = Complex32::new(a.re + b.im, b.re - a.im);
                }
            }
            run(&self.to_samples[0], pencil, fft);
            low.iter_mut().zip(&*pencil).for_each(|(s, z)| *s = z.re);
            high.iter_mut().zip(&*pencil).for_each(|(s, z)| *s = z.im);
        }
    }

    /// The way back of [`Self::slab`]: modes `[kx, ky]` of samples `[y, x]`, not yet normalised.
    pub fn slab_modes(&self, samples: &[f32], modes: &mut [Complex32], scratch: &mut Scratch) {
        let ([nx, ny, _], [mx, my, _]) = (self.dims, self.modes);
        let Scratch { plane, pencil, fft } = scratch;
        plane.resize(mx * ny, ZERO);
        pencil.resize(nx, ZERO);
        for (j, rows) in (0..).step_by(2).zip(samples.chunks(2 * nx)) {
            let (low, high) = rows.split_at(nx);
            pencil.iter_mut().zip(low).for_each(|(z, &a)| *z = Complex32::new(a, 0.0));
            pencil.iter_mut().zip(high).for_each(|(z, &b)| z.im = b);
            run(&self.to_modes[0], pencil, fft);
            for ikx in 0..mx {
                let (z, mirror) = (pencil[ikx], pencil[(nx - ikx) % nx].conj());
                plane[ikx * ny + j] = (z + mirror) * 0.5;
                if !high.is_empty() {
                    let twice = z - mirror;
                    plane[ikx * ny + j + 1] = Complex32::new(0.5 * twice.im, -0.5 * twice.re);
                }
            }
        }
        for (row, out) in plane.chunks_exact_mut(ny).zip(modes.chunks_exact_mut(my)) {
            run(&self.to_modes[1], row, fft);
            gather(row, out);
        }
    }

    /// Forward transforms along z and normalisation: slab modes `[z, field, kx, ky]` to spectra.
    pub fn spectra(&self, slabs: &[Complex32], num_fields: usize, spectra: &mut [Complex32]) {
        let ([nx, ny, nz], [mx, my, mz]) = (self.dims, self.modes);
        let scale = 1.0 / (nx * ny * nz) as f32;
        spectra.par_chunks_mut(num_fields * my * mz).enumerate().for_each_init(
            Scratch::default,
            |scratch, (ikx, out)| {
                let Scratch { plane, fft, .. } = scratch;
                plane.resize(my * nz, ZERO);
                for (field, out) in out.chunks_exact_mut(my * mz).enumerate() {
                    for k in 0..nz {
                        let row = &slabs[((k * num_fields + field) * mx + ikx) * my..][..my];
                        row.iter().enumerate().for_each(|(iky, z)| plane[iky * nz + k] = *z);
                    }
                    for (column, modes) in plane.chunks_exact_mut(nz).zip(out.chunks_exact_mut(mz)) {
                        run(&self.to_modes[2], column, fft);
                        gather(column, modes);
                        modes.iter_mut().for_each(|z| *z *= scale);
                    }
                }
            },
        );
    }
}

/// Modes kept along x, y, z.
pub(super) fn modes_of([nx, ny, nz]: [usize; 3]) -> [usize; 3] {
    [cutoff(nx) + 1, 2 * cutoff(ny) + 1, 2 * cutoff(nz) + 1]
}

/// The largest wave number kept of n samples: products of two kept modes alias onto none of them.
pub(super) fn cutoff(n: usize) -> usize {
    (n - 1) / 3
}

fn run(fft: &Arc<dyn Fft<f32>>, pencil: &mut [Complex32], scratch: &mut Vec<Complex32>) {
    let needed = fft.get_inplace_scratch_len();
    if scratch.len() < needed {
        scratch.resize(needed, ZERO);
    }
    fft.process_with_scratch(pencil, &mut scratch[..needed]);
}

/// Puts kept modes where a full transform expects them, zeros between.
fn spread(modes: &[Complex32], pencil: &mut [Complex32]) {
    let (num_low, n) = (modes.len().div_ceil(2), pencil.len());
    let num_high = modes.len() - num_low;
    pencil[..num_low].copy_from_slice(&modes[..num_low]);
    pencil[num_low..n - num_high].fill(ZERO);
    pencil[n - num_high..].copy_from_slice(&modes[num_low..]);
}

/// Takes the kept modes out of a full transform.
fn gather(pencil: &[Complex32], modes: &mut [Complex32]) {
    let (num_low, n) = (modes.len().div_ceil(2), pencil.len());
    let num_high = modes.len() - num_low;
    modes[..num_low].copy_from_slice(&pencil[..num_low]);
    modes[num_low..].copy_from_slice(&pencil[n - num_high..]);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A cosine has two modes of half its amplitude; the pair (k, −k) with kx = 0 must both be there.
    #[test]
    fn modes_of_cosines_on_odd_and_even_lattices() {
        for dims in [[12, 10, 8], [9, 11, 13]] {
            let fourier = Fourier::new(dims);
            let [mx, my, mz] = fourier.modes();
            let mut scratch = Scratch::default();
            let mut slabs = vec![ZERO; dims[2] * mx * my];
            let turn = |i: usize, axis: usize| std::f32::consts::TAU * i as f32 / dims[axis] as f32;
            for (k, out) in slabs.chunks_exact_mut(mx * my).enumerate() {
                let at = |c: usize| {
                    let (x, y, z) = (turn(c % dims[0], 0), turn(c / dims[0], 1), turn(k, 2));
                    3.0 * (2.0 * x - y + z).cos() + 4.0 * (y + 2.0 * z).sin()
                };
                let samples: Vec<f32> = (0..dims[0] * dims[1]).map(at).collect();
                fourier.slab_modes(&samples, out, &mut scratch);
            }
            let mut spectra = vec![ZERO; mx * my * mz];
            fourier.spectra(&slabs, 1, &mut spectra);
            let mut expected = vec![ZERO; mx * my * mz];
            expected[(2 * my + my - 1) * mz + 1].re = 1.5;
            expected[mz + 2].im = -2.0;
            expected[(my - 1) * mz + mz - 2].im = 2.0;
            let error = spectra.iter().zip(&expected).map(|(a, b)| (a - b).norm()).fold(0.0, f32::max);
            assert!(error < 2e-6, "{dims:?}: {error}");
        }
    }

    #[test]
    fn samples_come_back_from_their_modes() {
        let dims = [14, 9, 10];
        let fourier = Fourier::new(dims);
        let [_, my, mz] = fourier.modes();
        let one_mode = |[ikx, iky]: [usize; 2], pencil: &mut [Complex32]| {
            pencil.fill(ZERO);
            if (ikx, iky) == (3, my - 2) {
                pencil[mz - 1] = Complex32::new(0.5, -1.0);
            }
        };
        let columns = fourier.columns(1, one_mode);
        let mut samples = vec![0.0; dims[0] * dims[1]];
        fourier.slab(&columns, [1, 0, 7], &mut samples, &mut Scratch::default());
        for (c, &s) in samples.iter().enumerate() {
            let [i, j] = [c % dims[0], c / dims[0]].map(|n| n as f32);
            let phase = std::f32::consts::TAU * (3.0 * i / 14.0 - 2.0 * j / 9.0 - 0.7);
            let exact = phase.cos() + 2.0 * phase.sin();
            assert!((s - exact).abs() < 3e-6, "{s} {exact}");
        }
    }
}
