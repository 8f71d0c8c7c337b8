//! Lighting in the kernel: gradients of the samples of eight rays, and what they reflect.

use chronoxel_core::Lighting;

use super::kernel::{BrickJob, Cells, interpolate};
use super::lanes::Lanes;

/// What the kernel needs to light a brick.
#[derive(Debug, Clone, Copy)]
pub(super) struct LightJob {
    pub lighting: Lighting,
    /// From differences of samples to gradients in the world, up to a common factor.
    pub world_from_difference: [f32; 3],
    /// From `difference · step` to the gradient times the ray's unit vector, up to the same factor.
    pub unit_from_step: f32,
}

/// The two terms of `Lighting::headlight_terms`: the factor of the colour, and the highlight.
///
/// * `step`: from sample to sample, in voxels
/// * `edges`: the samples of the cells, interpolated along x
#[inline(always)]
pub(super) unsafe fn terms<L: Lanes>(
    job: &BrickJob,
    light: &LightJob,
    step: &[L::F; 3],
    cells: &Cells<L>,
    edges: [[L::I; 2]; 2],
) -> [L::F; 2] {
    // SAFETY: as the caller guarantees for L.
    unsafe {
        let difference = differences::<L>(job, cells, edges);
        let (mut square, mut product) = (L::splat(0.0), L::splat(0.0));
        for a in 0..3 {
            let gradient = L::mul(difference[a], L::splat(light.world_from_difference[a]));
            square = L::add(square, L::mul(gradient, gradient));
            // The spacings by which the gradient is divided and a step in voxels multiplied cancel.
            product = L::add(product, L::mul(difference[a], step[a]));
        }
        let is_lit = L::less(L::splat(0.0), square);
        let along = L::abs(L::mul(product, L::splat(light.unit_from_step)));
        let cosine = L::div(along, L::sqrt(square));
        let Lighting { ambient, diffuse, specular, specular_power } = light.lighting;
        let scattered = L::add(L::splat(ambient), L::mul(L::splat(diffuse), cosine));
        let highlight = L::mul(L::splat(specular), power::<L>(cosine, specular_power));
        [L::select(is_lit, scattered, L::splat(1.0)), L::and(is_lit, highlight)]
    }
}

/// The sample `by` from each of eight, interpolated along x.
#[inline(always)]
unsafe fn edge<L: Lanes>(job: &BrickJob, cells: &Cells<L>, by: isize) -> L::I {
    // SAFETY: as the caller guarantees.
    unsafe { L::sums(L::pairs(job.samples.as_ptr().wrapping_offset(by), &cells.offsets), cells.weights_x) }
}

/// The difference along x at the sample `by` from each of eight, interpolated along x.
#[inline(always)]
unsafe fn slope<L: Lanes>(job: &BrickJob, cells: &Cells<L>, by: isize) -> L::I {
    // SAFETY: as the caller guarantees.
    unsafe { L::slopes(job.samples.as_ptr().wrapping_offset(by - 1), &cells.offsets, cells.weights_x) }
}

/// Differences of the neighbours of each sample along x, y and z, interpolated as the samples are.
///
/// Subtracting after interpolating along x gives the same, and in whole numbers nothing is lost by it.
#[inline(always)]
unsafe fn differences<L: Lanes>(job: &BrickJob, cells: &Cells<L>, [near, far]: [[L::I; 2]; 2]) -> [L::F; 3] {
    let (row, plane) = (job.full_edge as isize, (job.full_edge * job.full_edge) as isize);
    // SAFETY: `Rays::place` keeps cells inside the core, so that a sample before and two after along each axis lie
    // in core and apron; the rest as the caller guarantees for L.
    unsafe {
        let slopes_near = [slope(job, cells, 0), slope(job, cells, row)];
        let slopes_far = [slope(job, cells, plane), slope(job, cells, plane + row)];
        let before_near = L::sub_int(near[1], edge(job, cells, -row));
        let after_near = L::sub_int(edge(job, cells, 2 * row), near[0]);
        let before_far = L::sub_int(far[1], edge(job, cells, plane - row));
        let after_far = L::sub_int(edge(job, cells, plane + 2 * row), far[0]);
        let from_before =
            [L::sub_int(far[0], edge(job, cells, -plane)), L::sub_int(far[1], edge(job, cells, row - plane))];
        let to_behind = [
            L::sub_int(edge(job, cells, 2 * plane), near[0]),
            L::sub_int(edge(job, cells, 2 * plane + row), near[1]),
        ];
        [
            interpolate::<L>([slopes_near, slopes_far], cells),
            interpolate::<L>([[before_near, after_near], [before_far, after_far]], cells),
            interpolate::<L>([from_before, to_behind], cells),
        ]
    }
}

#[inline(always)]
unsafe fn power<L: Lanes>(base: L::F, exponent: u32) -> L::F {
    // SAFETY: as the caller guarantees for L.
    unsafe {
        let (mut result, mut square, mut rest) = (L::splat(1.0), base, exponent);
        while rest > 0 {
            if rest & 1 == 1 {
                result = L::mul(result, square);
            }
            square = L::mul(square, square);
            rest >>= 1;
        }
        result
    }
}
