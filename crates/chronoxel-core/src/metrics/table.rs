//! The transfer function as a table of entries: what the approximate metrics sum over.

use crate::ResolvedTransfer;

use super::{ColorSpace, distance};

/// Entries are padded to a multiple of this, so that sums run over whole groups.
pub(super) const LANES: usize = 8;

/// A transfer function in entries of equal width over the range of a variable, each with the colour at its centre.
#[derive(Debug, Clone, PartialEq)]
pub struct ColorTable {
    space: ColorSpace,
    num_entries: usize,
    low: f64,
    width: f64,
    /// Red, green and blue in sRGB, one array each, padded with zeros, as are those below.
    pub(super) srgb: [Vec<f64>; 3],
    /// Opacity per unit length.
    pub(super) opacity: Vec<f64>,
    /// Coordinates in the space of distances; none where that is sRGB.
    coordinates: Option<[Vec<f64>; 3]>,
    temporal_scale: f64,
    uniform_over: [f64; 2],
    is_transparent: bool,
}

impl ColorTable {
    /// The table of a transfer function.
    ///
    /// * `range`: smallest and largest value of the variable; values outside fall into the first and the last entry.
    ///   Where the two are equal, reversed or not finite the table has one entry, at the first of them
    /// * `num_entries`: at least 1 is made; 256 in ellsworth2000
    pub fn new(transfer: &ResolvedTransfer, range: [f64; 2], num_entries: usize, space: ColorSpace) -> Self {
        let [low, high] = range;
        let is_wide = low.is_finite() && high.is_finite() && low < high;
        let num_entries = if is_wide { num_entries.max(1) } else { 1 };
        let width = if is_wide { high / num_entries as f64 - low / num_entries as f64 } else { 1.0 };
        let center = |j: usize| if is_wide { low + (j as f64 + 0.5) * width } else { low };
        let colors: Vec<[f64; 4]> = (0..num_entries).map(|j| transfer.evaluate(center(j))).collect();
        let points: Vec<[f64; 3]> = colors.iter().map(|&[r, g, b, _]| space.coordinates([r, g, b])).collect();
        let squared: f64 = (1..num_entries)
            .map(|j| distance(points[j - 1], colors[j - 1][3], points[j], colors[j][3]))
            .sum();
        let padded = |values: &mut dyn Iterator<Item = f64>| {
            let mut all: Vec<f64> = values.collect();
            all.resize(num_entries.next_multiple_of(LANES), 0.0);
            all
        };
        let is_transparent = transfer.is_transparent_over(range);
        let is_uniform = is_transparent || transfer.is_constant_over(range);
        Self {
            space,
            num_entries,
            low,
            width,
            srgb: [0, 1, 2].map(|i| padded(&mut colors.iter().map(|c| c[i]))),
            opacity: padded(&mut colors.iter().map(|c| c[3])),
            coordinates: (space != ColorSpace::Rgb)
                .then(|| [0, 1, 2].map(|i| padded(&mut points.iter().map(|c| c[i])))),
            temporal_scale: squared.sqrt(),
            uniform_over: if is_uniform { range } else { [f64::NAN; 2] },
            is_transparent,
        }
    }

    /// Number of entries.
    pub fn num_entries(&self) -> usize {
        self.num_entries
    }

    /// Where distances are measured.
    pub fn space(&self) -> ColorSpace {
        self.space
    }

    /// sRGB and opacity of an entry.
    ///
    /// # Panics
    /// Where there is no such entry.
    pub fn color(&self, entry: usize) -> [f64; 4] {
        assert!(entry < self.num_entries, "entry {entry} of {}", self.num_entries);
        let [r, g, b] = [0, 1, 2].map(|i| self.srgb[i][entry]);
        [r, g, b, self.opacity[entry]]
    }

    /// What turns the scalar temporal error into the approximate colour one: the root of the sum of distances of successive
    /// entries (eq. 20).
    pub fn temporal_scale(&self) -> f64 {
        self.temporal_scale
    }

    /// Place of a value, in entries: the centre of entry `j` is at `j`.
    pub(super) fn position(&self, value: f64) -> f64 {
        // Halves, since a difference may overflow.
        ((0.5 * value - 0.5 * self.low) / (0.5 * self.width) - 0.5).clamp(-1e15, 1e15)
    }

    /// A difference of values, in entries.
    pub(super) fn in_entries(&self, length: f64) -> f64 {
        length / self.width
    }

    /// The entry that holds a value.
    pub(super) fn entry(&self, value: f64) -> usize {
        // The cast takes what is below 0, and NaN, to 0.
        ((self.position(value) + 0.5) as usize).min(self.num_entries - 1)
    }

    /// Coordinates of the entries in the space of distances.
    pub(super) fn coordinates(&self) -> &[Vec<f64>; 3] {
        self.coordinates.as_ref().unwrap_or(&self.srgb)
    }

    /// Whether every value of a range has one colour, as far as that is known of the whole range of the variable.
    pub(super) fn is_known_uniform_over(&self, [min, max]: [f64; 2]) -> bool {
        self.uniform_over[0] <= min && max <= self.uniform_over[1]
    }

    /// Whether nothing in the range of the variable is visible.
    pub(super) fn is_transparent(&self) -> bool {
        self.is_transparent
    }
}
