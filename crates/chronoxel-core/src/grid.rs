//! The uniform grid: where samples lie in the world.

use serde::{Deserialize, Serialize};

use crate::CoreError;

/// A regular lattice of samples; sample `(i, j, k)` lies at `origin + (i, j, k) * spacing`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct UniformGrid {
    /// Samples along x, y, z; each at least 1.
    pub dims: [usize; 3],
    /// World position of sample (0, 0, 0).
    pub origin: [f64; 3],
    /// World distance between neighbouring samples along x, y, z; finite and positive.
    pub spacing: [f64; 3],
}

impl UniformGrid {
    /// A grid that was checked.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] for a zero dimension, more than 2^31 samples along an axis or
    /// 2^48 in all, a spacing that is not finite and positive, or an origin that is not finite.
    pub fn new(dims: [usize; 3], origin: [f64; 3], spacing: [f64; 3]) -> Result<Self, CoreError> {
        if dims.contains(&0) || dims.iter().any(|&n| n > 1 << 31) {
            return Err(CoreError::invalid(
                "dimensions",
                format!("{} x {} x {}", dims[0], dims[1], dims[2]),
                "each must be between 1 and 2^31",
            ));
        }
        let num_samples = dims.iter().map(|&n| n as u128).product::<u128>();
        if num_samples > 1 << 48 {
            return Err(CoreError::invalid("number of samples", num_samples, "at most 2^48 are supported"));
        }
        if spacing.iter().any(|s| !s.is_finite() || *s <= 0.0) {
            return Err(CoreError::invalid(
                "spacing",
                format!("{spacing:?}"),
                "each must be finite and positive",
            ));
        }
        if origin.iter().any(|o| !o.is_finite()) {
            return Err(CoreError::invalid("origin", format!("{origin:?}"), "each must be finite"));
        }
        Ok(Self { dims, origin, spacing })
    }

    /// Samples in all.
    pub fn num_samples(&self) -> usize {
        self.dims.iter().product()
    }

    /// Cells in all: the boxes between neighbouring samples. A grid one sample thick has none.
    pub fn num_cells(&self) -> usize {
        self.dims.iter().map(|n| n - 1).product()
    }

    /// The world box spanned by the samples: lowest and highest corner.
    pub fn bounds(&self) -> [[f64; 3]; 2] {
        let high = std::array::from_fn(|a| self.origin[a] + (self.dims[a] - 1) as f64 * self.spacing[a]);
        [self.origin, high]
    }

    /// The smallest distance between neighbouring samples: the default unit of opacity.
    pub fn smallest_spacing(&self) -> f64 {
        self.spacing.iter().copied().fold(f64::INFINITY, f64::min)
    }

    /// The world position of a point in voxel coordinates (sample (i, j, k) at exactly (i, j, k)).
    pub fn world_from_voxel(&self, voxel: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|a| self.origin[a] + voxel[a] * self.spacing[a])
    }

    /// The inverse of [`Self::world_from_voxel`].
    pub fn voxel_from_world(&self, world: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|a| (world[a] - self.origin[a]) / self.spacing[a])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn world_and_voxel_coordinates_are_inverse() {
        let grid = UniformGrid::new([5, 6, 7], [1.0, -2.0, 3.0], [0.5, 2.0, 0.25]).unwrap();
        assert_eq!(grid.world_from_voxel([2.0, 1.0, 4.0]), [2.0, 0.0, 4.0]);
        assert_eq!(grid.voxel_from_world([2.0, 0.0, 4.0]), [2.0, 1.0, 4.0]);
        assert_eq!(grid.bounds()[1], [3.0, 8.0, 4.5]);
        assert_eq!((grid.num_samples(), grid.num_cells()), (210, 120));
    }

    #[test]
    fn unusable_grids_are_refused() {
        assert!(UniformGrid::new([0, 1, 1], [0.0; 3], [1.0; 3]).is_err());
        assert!(UniformGrid::new([1 << 20; 3], [0.0; 3], [1.0; 3]).is_err());
        assert!(UniformGrid::new([2; 3], [0.0; 3], [1.0, 0.0, 1.0]).is_err());
        assert!(UniformGrid::new([2; 3], [f64::NAN, 0.0, 0.0], [1.0; 3]).is_err());
    }
}
