//! What part of a volume is drawn in which way.

use chronoxel_core::UniformGrid;

use crate::{DrawItem, How};

/// Samples of the grid by how the boxes that they lie in are drawn (ellsworth2000, table 5).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Shares {
    /// In boxes that are not drawn: nothing is seen there.
    pub skipped: u64,
    /// In boxes drawn as one value or colour.
    pub constant: u64,
    /// In boxes drawn from the payload of an earlier step.
    pub reused: u64,
    /// In boxes drawn from that of the step itself.
    pub new: u64,
}

impl Shares {
    /// Of the draw list of a step.
    pub fn of(items: &[DrawItem], step: u32, grid: &UniformGrid) -> Self {
        let mut shares = Self::default();
        for item in items {
            let [low, high] = item.region;
            let along = |a: usize| (high[a].min(grid.dims[a] as f64) - low[a]).max(0.0) as u64;
            let part = match item.how {
                How::Skip => &mut shares.skipped,
                How::Constant(_) | How::ConstantColor(_) => &mut shares.constant,
                How::Payload if item.steps.start < step => &mut shares.reused,
                How::Payload => &mut shares.new,
            };
            *part += along(0) * along(1) * along(2);
        }
        shares
    }

    /// Those of several pictures together.
    pub fn with(&self, other: &Self) -> Self {
        Self {
            skipped: self.skipped + other.skipped,
            constant: self.constant + other.constant,
            reused: self.reused + other.reused,
            new: self.new + other.new,
        }
    }

    /// All samples.
    pub fn total(&self) -> u64 {
        self.skipped + self.constant + self.reused + self.new
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use chronoxel_core::NodeId;

    #[test]
    fn every_sample_of_the_grid_counts_once() {
        let grid = UniformGrid::new([20, 9, 8], [0.0; 3], [1.0; 3]).unwrap();
        let item = |brick: [u32; 3], start, how| {
            let low = brick.map(|b| f64::from(b) * 8.0);
            let region = [low, low.map(|v| v + 8.0)];
            DrawItem { node: NodeId::new(0, brick), region, steps: start..6, how }
        };
        let items = [
            item([0, 0, 0], 5, How::Skip),
            item([1, 0, 0], 5, How::Constant(1.0)),
            item([2, 0, 0], 0, How::ConstantColor([1.0; 4])),
            item([0, 1, 0], 0, How::Payload),
            item([1, 1, 0], 5, How::Payload),
            item([2, 1, 0], 5, How::Payload),
        ];
        let shares = Shares::of(&items, 5, &grid);
        assert_eq!(shares, Shares { skipped: 512, constant: 512 + 256, reused: 64, new: 64 + 32 });
        assert_eq!(shares.total(), 20 * 9 * 8);
    }
}
