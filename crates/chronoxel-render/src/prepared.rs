//! Resident bricks in the form that the CPU ray caster reads.

use chronoxel_core::{BitMask, BrickLayout, ResidentBrick};

use crate::RenderError;
use crate::sweeps::{block_ranges, gradients};

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
