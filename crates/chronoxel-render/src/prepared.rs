//! Resident bricks in the form that the CPU ray caster reads.

use chronoxel_core::{BitMask, BrickLayout, ResidentBrick};

use crate::RenderError;

/// Cells along an edge of a block, the unit in which transparent parts of a brick are skipped.
pub(crate) const BLOCK_EDGE: usize = 4;

/// A brick made ready once for many pictures: samples around 0, ranges of its blocks, and gradients.
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
    /// Where lit: differences of the neighbours along x, y, z in units of `samples` (all halved where one does
    /// not fit), and a 0.
    pub(crate) gradients: Option<Vec<[i16; 4]>>,
}

impl PreparedBrick {
    /// Prepares a brick.
    ///
    /// * `lit`: whether it may be drawn with lighting, which needs its gradients (8 bytes per sample)
    ///
    /// # Errors
    /// [`RenderError::InvalidArgument`] if the brick has another shape than the layout says, or a value range that is
    /// not finite.
    pub fn new(brick: ResidentBrick, layout: &BrickLayout, lit: bool) -> Result<Self, RenderError> {
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
        let range = block_ranges.iter().fold([i16::MAX, i16::MIN], |r, b| [r[0].min(b[0]), r[1].max(b[1])]);
        let gradients = lit.then(|| gradients(&samples, layout.full_edge()));
        Ok(Self {
            layout: *layout,
            samples,
            offset: brick.offset + 32768.0 * brick.scale,
            scale: brick.scale,
            mask: brick.mask,
            block_ranges,
            range,
            gradients,
        })
    }

    /// The shape it was prepared for.
    pub fn layout(&self) -> &BrickLayout {
        &self.layout
    }

    /// Whether it can be drawn with lighting.
    pub fn is_lit(&self) -> bool {
        self.gradients.is_some()
    }

    /// About how many bytes a brick without a mask takes, to plan with.
    pub fn estimated_bytes(layout: &BrickLayout, lit: bool) -> usize {
        let num_blocks = (layout.edge / BLOCK_EDGE).pow(3);
        size_of::<Self>() + 4 * num_blocks + layout.num_full() * if lit { 10 } else { 2 }
    }

    /// Bytes held in memory.
    pub fn num_bytes(&self) -> usize {
        size_of::<Self>()
            + 2 * self.samples.len()
            + 4 * self.block_ranges.len()
            + self.mask.as_ref().map_or(0, |m| m.bytes.len())
            + self.gradients.as_ref().map_or(0, |g| 8 * g.len())
    }
}

/// Ranges of the samples around the cells of each block: `BLOCK_EDGE + 1` samples along each axis.
fn block_ranges(samples: &[i16], layout: &BrickLayout) -> Vec<[i16; 2]> {
    let (edge, full) = (layout.edge, layout.full_edge());
    let num = edge / BLOCK_EDGE;
    let mut ranges = vec![[i16::MAX, i16::MIN]; num * num * num];
    let blocks_of = |i: usize| {
        let last = (i / BLOCK_EDGE).min(num - 1);
        let first = if i.is_multiple_of(BLOCK_EDGE) { (i / BLOCK_EDGE).saturating_sub(1) } else { last };
        first..=last
    };
    for z in 0..=edge {
        for y in 0..=edge {
            let start = ((z + layout.low) * full + y + layout.low) * full + layout.low;
            let row = &samples[start..=start + edge];
            for bx in 0..num {
                let part = &row[bx * BLOCK_EDGE..=(bx + 1) * BLOCK_EDGE];
                let [min, max] = part.iter().fold([i16::MAX, i16::MIN], |r, &s| [r[0].min(s), r[1].max(s)]);
                for bz in blocks_of(z) {
                    for by in blocks_of(y) {
                        let range = &mut ranges[(bz * num + by) * num + bx];
                        *range = [range[0].min(min), range[1].max(max)];
                    }
                }
            }
        }
    }
    ranges
}

/// Differences of neighbours, the outermost samples standing for those beyond the apron.
fn gradients(samples: &[i16], full: usize) -> Vec<[i16; 4]> {
    let strides = [1, full, full * full];
    let difference = |index: usize, place: usize, axis: usize| {
        let before = if place > 0 { index - strides[axis] } else { index };
        let after = if place + 1 < full { index + strides[axis] } else { index };
        i32::from(samples[after]) - i32::from(samples[before])
    };
    let at = |index: usize| {
        let place = [index % full, index / full % full, index / (full * full)];
        std::array::from_fn::<i32, 3, _>(|axis| difference(index, place[axis], axis))
    };
    let fits = (0..samples.len()).all(|i| at(i).iter().all(|&d| i16::try_from(d).is_ok()));
    let divisor = if fits { 1 } else { 2 };
    (0..samples.len())
        .map(|i| {
            let [x, y, z] = at(i).map(|d| (d / divisor) as i16);
            [x, y, z, 0]
        })
        .collect()
}
