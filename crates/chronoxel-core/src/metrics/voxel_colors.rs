//! Colours of voxels, exactly and quickly.

use crate::ResolvedTransfer;

use super::ColorSpace;

/// A transfer function made ready to colour very many samples: exact, unlike a table, and without a binary search.
#[derive(Debug, Clone)]
pub struct VoxelColors {
    space: ColorSpace,
    xs: Vec<f64>,
    colors: Vec<[f64; 4]>,
    /// For each of equal parts of the points' range, the first point beyond its middle.
    next_of_part: Vec<u32>,
    parts_per_unit: f64,
}

/// Parts that the range of the points is cut into.
const NUM_PARTS: usize = 1024;

/// A voxel's colour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct VoxelColor {
    pub srgb: [f64; 3],
    /// In the space of distances.
    pub coordinates: [f64; 3],
    pub alpha: f64,
}

impl VoxelColors {
    /// Of a transfer function.
    pub fn new(transfer: &ResolvedTransfer, space: ColorSpace) -> Self {
        let xs: Vec<f64> = transfer.points().iter().map(|p| p.x).collect();
        let colors = transfer.points().iter().map(|p| {
            let [r, g, b] = p.color.map(f64::from);
            [r, g, b, f64::from(p.opacity)]
        });
        let (low, high) = (xs[0], xs[xs.len() - 1]);
        let middle = |part: usize| {
            let w = (part as f64 + 0.5) / NUM_PARTS as f64;
            low * (1.0 - w) + high * w
        };
        let next_of_part = (0..NUM_PARTS).map(|part| xs.partition_point(|&x| x <= middle(part)) as u32);
        Self {
            space,
            next_of_part: next_of_part.collect(),
            parts_per_unit: NUM_PARTS as f64 / (high - low),
            colors: colors.collect(),
            xs,
        }
    }

    /// Number of points at or below a value.
    fn num_points_to(&self, value: f64) -> usize {
        // The part is a guess alone: a NaN or an overflow costs steps, no more.
        let part = ((value - self.xs[0]) * self.parts_per_unit) as usize;
        let mut next = self.next_of_part[part.min(NUM_PARTS - 1)] as usize;
        while next < self.xs.len() && self.xs[next] <= value {
            next += 1;
        }
        while next > 0 && self.xs[next - 1] > value {
            next -= 1;
        }
        next
    }

    /// Colour of a value that is no NaN: [`ResolvedTransfer::evaluate`]'s to rounding; between points of one colour exactly that colour.
    pub(super) fn of(&self, value: f64) -> VoxelColor {
        let next = self.num_points_to(value);
        let [r, g, b, alpha] = if next == 0 || next == self.xs.len() {
            self.colors[next.saturating_sub(1)]
        } else {
            let (from, to) = (&self.colors[next - 1], &self.colors[next]);
            let w = (value - self.xs[next - 1]) / (self.xs[next] - self.xs[next - 1]);
            std::array::from_fn(|i| from[i] + (to[i] - from[i]) * w)
        };
        let srgb = [r, g, b];
        VoxelColor { srgb, coordinates: self.space.coordinates(srgb), alpha }
    }
}
