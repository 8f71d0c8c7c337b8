//! The transfer function as the kernel reads it: a table of premultiplied, opacity-corrected colours.

use chronoxel_core::{ResolvedTransfer, compositing::correct_opacity};

use crate::PreparedBrick;

use super::lanes::WEIGHT_ONE;

/// Entries of a table; the first and the last stand for everything below and above the transfer function's points.
pub(crate) const NUM_ENTRIES: usize = 4096;

/// Colours of the values between the first and the last point of a transfer function, for one step length.
#[derive(Debug)]
pub(crate) struct Table {
    /// Red, green and blue multiplied by alpha, and alpha.
    pub entries: Vec<[f32; 4]>,
    /// How many of the entries before each are not transparent.
    num_visible_before: Vec<u16>,
    first_value: f64,
    entries_per_value: f64,
}

impl Table {
    pub fn new(transfer: &ResolvedTransfer, dt: f64, unit: f64) -> Self {
        let points = transfer.points();
        let (low, high) = (points[0].x, points[points.len() - 1].x);
        // A function that is one step still has two sides.
        let width = if high > low { high - low } else { low.abs().max(1.0) * 1e-6 };
        let entry_width = width / (NUM_ENTRIES - 3) as f64;
        let first_value = low - entry_width;
        let entries: Vec<[f32; 4]> = (0..NUM_ENTRIES)
            .map(|i| premultiplied(transfer.evaluate(first_value + i as f64 * entry_width), dt, unit))
            .collect();
        let mut num_visible = 0;
        let mut num_visible_before = vec![0];
        for entry in &entries {
            num_visible += u16::from(entry[3] > 0.0);
            num_visible_before.push(num_visible);
        }
        Self { entries, num_visible_before, first_value, entries_per_value: 1.0 / entry_width }
    }

    /// Factor and offset from a number to the index of its entry, to be clamped and cut to a whole number.
    ///
    /// * `offset`, `scale`: `value = offset + scale * number`
    pub fn index_from_number(&self, offset: f64, scale: f64) -> [f32; 2] {
        let factor = scale * self.entries_per_value;
        let offset = (offset - self.first_value) * self.entries_per_value + 0.5;
        // Beyond this the index is clamped at either end, and the product of the two must stay finite.
        [factor, offset].map(|x| x.clamp(-1e25, 1e25) as f32)
    }

    /// Whether no value of a closed range can be seen, though each be off by 1/1024 of the range.
    #[cfg(feature = "gpu")]
    pub fn is_transparent_between(&self, [low, high]: [f64; 2]) -> bool {
        let margin = (high - low) / 1024.0;
        let index = |value: f64| (value - self.first_value) * self.entries_per_value + 0.5;
        let last = (NUM_ENTRIES - 1) as f64;
        let [low, high] = [index(low - margin) - 1.0, index(high + margin) + 1.0];
        let [low, high] = [low, high].map(|i| i.max(0.0).min(last) as usize);
        self.num_visible_before[high + 1] == self.num_visible_before[low]
    }

    /// Factor and offset from an interpolated sample of a brick (in units of `1 / WEIGHT_ONE`) to the index of
    /// its entry, to be clamped and cut to a whole number.
    pub fn index_from_sample(&self, brick: &PreparedBrick) -> [f32; 2] {
        self.index_from_number(brick.offset, brick.scale / f64::from(WEIGHT_ONE))
    }

    /// The index of a sample's entry, as the kernel finds it.
    fn index(&self, sample: f32, [factor, offset]: [f32; 2]) -> usize {
        (sample * WEIGHT_ONE * factor + offset).max(0.0).min((NUM_ENTRIES - 1) as f32) as usize
    }

    /// Whether no sample between two of a brick can be seen.
    pub fn is_transparent_over(&self, range: [i16; 2], index_from_sample: [f32; 2]) -> bool {
        // Rounding while interpolating may leave the range by less than one unit.
        let low = self.index(f32::from(range[0]) - 1.0, index_from_sample);
        let high = self.index(f32::from(range[1]) + 1.0, index_from_sample);
        let (low, high) = (low.min(high), low.max(high));
        self.num_visible_before[high + 1] == self.num_visible_before[low]
    }
}

/// A colour and opacity per unit as the colour of one sample.
pub(crate) fn premultiplied([r, g, b, opacity]: [f64; 4], dt: f64, unit: f64) -> [f32; 4] {
    let alpha = correct_opacity(opacity, dt, unit);
    [r * alpha, g * alpha, b * alpha, alpha].map(|c| c as f32)
}
