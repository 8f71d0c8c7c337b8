//! What is found out about every sample of a brick before it is drawn: ranges of blocks, and gradients.
//!
//! Each is a sweep over whole rows or planes of samples, in loops that the compiler turns into vector instructions.

use chronoxel_core::BrickLayout;

use crate::prepared::BLOCK_EDGE;

/// Ranges of the samples around the cells of each block: `BLOCK_EDGE + 1` samples along each axis.
///
/// * `samples`: those of a brick, core and apron
pub(crate) fn block_ranges(samples: &[i16], layout: &BrickLayout) -> Vec<[i16; 2]> {
    let (edge, full) = (layout.edge, layout.full_edge());
    let num = edge / BLOCK_EDGE;
    let around = |block: usize| layout.low + block * BLOCK_EDGE..=layout.low + (block + 1) * BLOCK_EDGE;
    let mut ranges = Vec::with_capacity(num * num * num);
    // Least and largest along z of each column of samples, and of those along y.
    let [mut least_z, mut most_z] = [vec![0; full * full], vec![0; full * full]];
    let [mut least_y, mut most_y] = [vec![0; full], vec![0; full]];
    for bz in 0..num {
        extremes(around(bz).map(|z| &samples[z * full * full..][..full * full]), &mut least_z, i16::min);
        extremes(around(bz).map(|z| &samples[z * full * full..][..full * full]), &mut most_z, i16::max);
        for by in 0..num {
            extremes(around(by).map(|y| &least_z[y * full..][..full]), &mut least_y, i16::min);
            extremes(around(by).map(|y| &most_z[y * full..][..full]), &mut most_y, i16::max);
            ranges.extend((0..num).map(|bx| {
                let least = least_y[around(bx)].iter().copied().fold(i16::MAX, i16::min);
                let most = most_y[around(bx)].iter().copied().fold(i16::MIN, i16::max);
                [least, most]
            }));
        }
    }
    ranges
}

/// The extremes of several rows, place by place.
fn extremes<'a>(
    mut rows: impl Iterator<Item = &'a [i16]>,
    extreme: &mut [i16],
    of: impl Fn(i16, i16) -> i16,
) {
    if let Some(first) = rows.next() {
        extreme.copy_from_slice(first);
    }
    for row in rows {
        extreme.iter_mut().zip(row).for_each(|(e, &s)| *e = of(*e, s));
    }
}

/// Differences of the neighbours of each sample along x, y and z, and a 0; the outermost samples stand for those
/// beyond the apron. All are halved, towards zero, where one of them does not fit.
///
/// * `samples`: `full` along each axis, at least 2
pub(crate) fn gradients(samples: &[i16], full: usize) -> Vec<[i16; 4]> {
    let mut all = vec![[0; 4]; samples.len()];
    if !sweep(samples, full, &mut all, whole_difference) {
        sweep(samples, full, &mut all, half_difference);
    }
    all
}

/// A difference, and 0 if it fits.
fn whole_difference(before: i16, after: i16) -> (i16, i16) {
    let difference = after.wrapping_sub(before);
    (difference, difference ^ after.saturating_sub(before))
}

/// Half a difference, which always fits.
fn half_difference(before: i16, after: i16) -> (i16, i16) {
    (((i32::from(after) - i32::from(before)) / 2) as i16, 0)
}

/// Finds the differences of all samples; returns whether all fit.
#[inline(always)]
fn sweep(
    samples: &[i16],
    full: usize,
    all: &mut [[i16; 4]],
    difference: impl Fn(i16, i16) -> (i16, i16),
) -> bool {
    let row = |y: usize, z: usize| &samples[(z * full + y) * full..][..full];
    let (mut before, mut after) = (vec![0; full], vec![0; full]);
    let mut excess = 0;
    for (i, gradients) in all.chunks_exact_mut(full).enumerate() {
        let (y, z) = (i % full, i / full);
        // The row as seen from its neighbours, its ends standing for what is beyond them.
        let here = row(y, z);
        before[1..].copy_from_slice(&here[..full - 1]);
        before[0] = here[0];
        after[..full - 1].copy_from_slice(&here[1..]);
        after[full - 1] = here[full - 1];
        let along_y = [row(y.saturating_sub(1), z), row((y + 1).min(full - 1), z)];
        let along_z = [row(y, z.saturating_sub(1)), row(y, (z + 1).min(full - 1))];
        let along_x = before.iter().zip(&after);
        let along_y = along_y[0].iter().zip(along_y[1]);
        let along_z = along_z[0].iter().zip(along_z[1]);
        for (((to, x), y), z) in gradients.iter_mut().zip(along_x).zip(along_y).zip(along_z) {
            let (dx, excess_x) = difference(*x.0, *x.1);
            let (dy, excess_y) = difference(*y.0, *y.1);
            let (dz, excess_z) = difference(*z.0, *z.1);
            *to = [dx, dy, dz, 0];
            excess |= excess_x | excess_y | excess_z;
        }
    }
    excess == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Samples that jump about, and reach both ends of their type.
    fn noise(num: usize, amplitude: i64) -> Vec<i16> {
        (0..num as i64)
            .map(|i| ((i * i * 7919 + i * 104_729) % (2 * amplitude + 1) - amplitude) as i16)
            .collect()
    }

    #[test]
    fn ranges_are_those_found_by_trying_all() {
        let layout = BrickLayout::new(16).unwrap();
        let full = layout.full_edge();
        let samples = noise(layout.num_full(), 32_767);
        let ranges = block_ranges(&samples, &layout);
        assert_eq!(ranges.len(), 64);
        for (i, range) in ranges.iter().enumerate() {
            let first = [i % 4, i / 4 % 4, i / 16].map(|b| layout.low + 4 * b);
            let around = (0..125).map(|j| {
                let place = [first[0] + j % 5, first[1] + j / 5 % 5, first[2] + j / 25];
                samples[(place[2] * full + place[1]) * full + place[0]]
            });
            assert_eq!(Some(range[0]), around.clone().min());
            assert_eq!(Some(range[1]), around.max());
        }
    }

    #[test]
    fn gradients_are_differences_of_neighbours() {
        let full = 11;
        for (amplitude, divisor) in [(16_383, 1), (16_384, 2), (32_767, 2)] {
            let mut samples = noise(full * full * full, amplitude / 2);
            // One difference of twice the amplitude, along y, ends at the face.
            samples[4 * full * full + 9 * full + 5] = -amplitude as i16;
            samples[4 * full * full + 10 * full + 5] = amplitude as i16;
            let all = gradients(&samples, full);
            assert_eq!(all.len(), samples.len());
            for (i, gradient) in all.iter().enumerate() {
                let place = [i % full, i / full % full, i / (full * full)];
                for axis in 0..3 {
                    let at = |c: usize| {
                        let mut at = place;
                        at[axis] = c;
                        i32::from(samples[(at[2] * full + at[1]) * full + at[0]])
                    };
                    let c = place[axis];
                    let expected = (at((c + 1).min(full - 1)) - at(c.saturating_sub(1))) / divisor;
                    assert_eq!(i32::from(gradient[axis]), expected, "{place:?} axis {axis}");
                }
                assert_eq!(gradient[3], 0);
            }
        }
    }
}
