//! Bricks: their layout in samples, and the form in which they are resident for drawing.

use serde::{Deserialize, Serialize};

use crate::CoreError;

/// The shape of every brick of a store.
///
/// A brick has a core of `edge`³ samples and an apron: `low` samples before the core and `high`
/// after it along each axis, so that neither interpolation nor central differences anywhere in the
/// core's cells need a neighbour.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct BrickLayout {
    /// Samples along an edge of the core.
    pub edge: usize,
    /// Apron samples before the core.
    pub low: usize,
    /// Apron samples after the core.
    pub high: usize,
}

impl BrickLayout {
    /// The standard apron (1 before, 2 after) around a core of `edge`³.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] unless `edge` is 8, 16, 32, 64 or 128.
    pub fn new(edge: usize) -> Result<Self, CoreError> {
        if ![8, 16, 32, 64, 128].contains(&edge) {
            return Err(CoreError::invalid("brick edge", edge, "use 8, 16, 32, 64 or 128"));
        }
        Ok(Self { edge, low: 1, high: 2 })
    }

    /// Samples along an edge, apron included: 35 for a core of 32.
    pub const fn full_edge(&self) -> usize {
        self.low + self.edge + self.high
    }

    /// Samples of the core.
    pub const fn num_core(&self) -> usize {
        self.edge.pow(3)
    }

    /// Samples of core and apron together.
    pub const fn num_full(&self) -> usize {
        self.full_edge().pow(3)
    }
}

/// One bit per sample of a brick, `[z, y, x]` over core and apron: set where the sample is masked.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct BitMask {
    /// Bit `i` of the mask is bit `i % 8` (lowest first) of byte `i / 8`; unused bits are 0.
    pub bytes: Vec<u8>,
}

impl BitMask {
    /// A mask from one flag per sample.
    pub fn from_flags(flags: impl ExactSizeIterator<Item = bool>) -> Self {
        let mut bytes = vec![0u8; flags.len().div_ceil(8)];
        flags.enumerate().filter(|(_, set)| *set).for_each(|(i, _)| bytes[i / 8] |= 1 << (i % 8));
        Self { bytes }
    }

    /// Whether sample `index` is masked.
    pub fn get(&self, index: usize) -> bool {
        self.bytes[index / 8] >> (index % 8) & 1 != 0
    }

    /// Number of masked samples.
    pub fn num_set(&self) -> usize {
        self.bytes.iter().map(|byte| byte.count_ones() as usize).sum()
    }
}

/// A brick of one time step, ready to be drawn: 16-bit samples within the brick's own range.
#[derive(Debug, Clone, PartialEq)]
pub struct ResidentBrick {
    /// Core and apron, `[z, y, x]`, `layout.full_edge()` along each axis.
    pub samples: Vec<u16>,
    /// Value of index 0.
    pub offset: f64,
    /// Value step per index; `value = offset + scale * sample`.
    pub scale: f64,
    /// Masked samples, over core and apron.
    pub mask: Option<BitMask>,
}

impl ResidentBrick {
    /// Bytes held in memory.
    pub fn num_bytes(&self) -> usize {
        size_of::<Self>() + 2 * self.samples.len() + self.mask.as_ref().map_or(0, |m| m.bytes.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn apron_is_31_percent_at_32() {
        let layout = BrickLayout::new(32).unwrap();
        assert_eq!(layout.full_edge(), 35);
        let share = layout.num_full() as f64 / layout.num_core() as f64 - 1.0;
        assert!((share - 0.308).abs() < 0.001);
        assert!(BrickLayout::new(31).is_err());
    }

    #[test]
    fn mask_bits_are_lowest_first() {
        let mask = BitMask::from_flags((0..12).map(|i| i == 0 || i == 9));
        assert_eq!(mask.bytes, [0b1, 0b10]);
        assert!(mask.get(9) && !mask.get(8));
    }
}
