//! Resident bricks in the form that the CPU ray caster reads.

use chronoxel_core::{BitMask, BrickLayout, ResidentBrick};

use crate::RenderError;

/// Cells along an edge of a block, the unit in which transparent parts of a brick are skipped.
pub(crate) const BLOCK_EDGE: usize = 4;

/// A brick made ready once for many pictures: samples around 0, and ranges of its blocks.
#[derive(Debug)]
pub struct PreparedBrick {
    layout: BrickLayout,
    /// `sample - 32768`, `[z, y, x]` over core and apron.
    pub(crate) samples: Vec<i16>,
    /// Value of the sample 0, and value step per unit.
    pub(crate) offset: f64,
    pub(crate) scale: f64,
    pub(crate) mask: Option<BitMask>,
    /// Smallest and largest of `samples` that touch each block of cells, `[z, y, x]`.
    pub(crate) block_ranges: Vec<[i16; 2]>,
    /// Smallest and largest of those.
    pub(crate) range: [i16; 2],
}

impl PreparedBrick {
    /// Prepares a brick.
    ///
    /// # Errors
    /// [`RenderError::InvalidArgument`] if the brick has another shape than the layout says, or a value range that is
    /// not finite.
    pub fn new(brick: ResidentBrick, layout: &BrickLayout) -> Result<Self, RenderError> {
        let num_full = layout.num_full();
        let mask_fits = brick.mask.as_ref().is_none_or(|m| m.bytes.len() == num_full.div_ceil(8));
        if brick.samples.len() != num_full || !mask_fits || layout.low < 1 || layout.high < 2 {
            let remedy = "it must have core, apron and mask of the store's brick layout";
            return Err(RenderError::invalid("brick's number of samples", brick.samples.len(), remedy));
        }
        if !(brick.offset.is_finite() && brick.scale.is_finite()) {
            let value = format!("{} + {} i", brick.offset, brick.scale);
            return Err(RenderError::invalid("brick's values", value, "they must be finite"));
        }
        let samples: Vec<i16> = brick.samples.into_iter().map(|s| (s ^ 0x8000) as i16).collect();
        let block_ranges = block_ranges(&samples, layout);
        let range = extent_of(&block_ranges);
        Ok(Self {
            layout: *layout,
            samples,
            offset: brick.offset + 32768.0 * brick.scale,
            scale: brick.scale,
            mask: brick.mask,
            block_ranges,
            range,
        })
    }

    /// The value of a sample, `[z, y, x]` over core and apron.
    pub(crate) fn value(&self, index: usize) -> f64 {
        self.offset + self.scale * f64::from(self.samples[index])
    }

    /// The same brick with other values at some samples. Where its steps cannot tell them, all samples are rounded to new steps over the
    /// wider range.
    ///
    /// * `changed`: indices of those samples
    /// * `values`: one per sample, finite where it is changed
    pub(crate) fn with_values(&self, changed: &[usize], values: &[f64]) -> Self {
        let fits = |value: f64| {
            let step = ((value - self.offset) / self.scale).round();
            step >= f64::from(i16::MIN) && step <= f64::from(i16::MAX)
        };
        let (mut offset, mut scale, mut samples) = (self.offset, self.scale, self.samples.clone());
        if !changed.iter().all(|&index| fits(values[index])) {
            let ends = [samples.iter().min(), samples.iter().max()];
            let ends = ends.map(|step| self.offset + self.scale * f64::from(*step.unwrap_or(&0)));
            let all = changed.iter().map(|&index| values[index]).chain(ends);
            let [low, high] =
                all.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)]);
            (offset, scale) = (0.5 * low + 0.5 * high, (0.5 * high - 0.5 * low) / 32767.0);
            let per_step = self.scale / scale;
            let shift = (self.offset - offset) / scale;
            samples.iter_mut().for_each(|s| *s = (shift + per_step * f64::from(*s)).round() as i16);
        }
        for &index in changed {
            samples[index] = ((values[index] - offset) / scale).round() as i16;
        }
        let block_ranges = block_ranges(&samples, &self.layout);
        let range = extent_of(&block_ranges);
        Self { layout: self.layout, samples, offset, scale, mask: self.mask.clone(), block_ranges, range }
    }

    /// The shape it was prepared for.
    pub fn layout(&self) -> &BrickLayout {
        &self.layout
    }

    /// About how many bytes a brick without a mask takes, to plan with.
    pub fn estimated_bytes(layout: &BrickLayout) -> usize {
        let num_blocks = (layout.edge / BLOCK_EDGE).pow(3);
        size_of::<Self>() + 4 * num_blocks + 2 * layout.num_full()
    }

    /// Bytes held in memory.
    pub fn num_bytes(&self) -> usize {
        size_of::<Self>()
            + 2 * self.samples.len()
            + 4 * self.block_ranges.len()
            + self.mask.as_ref().map_or(0, |m| m.bytes.len())
    }
}

/// Smallest and largest of the ranges of blocks.
fn extent_of(block_ranges: &[[i16; 2]]) -> [i16; 2] {
    block_ranges.iter().fold([i16::MAX, i16::MIN], |r, b| [r[0].min(b[0]), r[1].max(b[1])])
}

/// Ranges of the samples around the cells of each block: `BLOCK_EDGE + 1` samples along each axis.
///
/// In sweeps over whole rows and planes, which the compiler turns into vector instructions.
///
/// * `samples`: those of a brick, core and apron
fn block_ranges(samples: &[i16], layout: &BrickLayout) -> Vec<[i16; 2]> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_those_found_by_trying_all() {
        let layout = BrickLayout::new(16).unwrap();
        let full = layout.full_edge();
        // They jump about, and reach both ends of their type.
        let samples: Vec<i16> =
            (0..layout.num_full() as i64).map(|i| (i * i * 7919 + i * 104_729) as i16).collect();
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
}
