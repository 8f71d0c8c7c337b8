//! Where the samples of every depth of the tree lie: one nested lattice over the box of the mesh.

use chronoxel_core::UniformGrid;

use crate::EncodeError;

/// How far outside of a tetrahedron a sample still counts as inside, in samples of the root: some 3·10⁻¹¹ of the longest
/// side of the mesh, far below every voxel and far above the rounding of its planes.
pub const TOLERANCE: f64 = 1e-9;

/// Points nearer than this (in samples of the root, about single precision of the mesh) are one point.
pub const SAME_POINT: f64 = 4e-6;

/// The lattice: sample `i` of depth `d` lies at `i / 2^d` in samples of the root, whatever the depth of the finest level.
///
/// The root's `edge` samples span the longest side of the mesh, so that level `l` of a tree of depth `D` is depth `D - l`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lattice {
    /// The lowest corner of the mesh.
    pub origin: [f64; 3],
    /// Distance between samples of the root.
    pub spacing: f64,
    /// Size of the mesh in samples of the root: at most `edge - 1`.
    pub extent: [f64; 3],
}

impl Lattice {
    /// Over a box, for bricks of `edge` samples.
    ///
    /// # Errors
    /// [`EncodeError::InvalidArgument`] if the box is empty, not finite, or of no size.
    pub fn new([low, high]: [[f64; 3]; 2], edge: usize) -> Result<Self, EncodeError> {
        let size: [f64; 3] = std::array::from_fn(|a| high[a] - low[a]);
        let longest = size.iter().copied().fold(0.0, f64::max);
        let smallest = f64::MIN_POSITIVE * 1e20;
        if size.iter().any(|s| !(s.is_finite() && *s >= 0.0)) || longest <= smallest {
            return Err(EncodeError::InvalidArgument {
                argument: "SOURCE: box of the mesh",
                value: format!("{low:?} to {high:?}"),
                remedy: "it must be finite and have a size: check the coordinates".into(),
            });
        }
        let most = (edge - 1) as f64;
        let spacing = longest / most;
        let extent = size.map(|s| if s == longest { most } else { (s / spacing).min(most) });
        Ok(Self { origin: low, spacing, extent })
    }

    /// A place in samples of the root.
    pub fn place(&self, point: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|a| ((point[a] - self.origin[a]) / self.spacing).clamp(0.0, self.extent[a]))
    }

    /// The grid of the samples of a depth.
    ///
    /// # Errors
    /// [`EncodeError::Core`] if it has too many samples.
    pub fn grid(&self, depth: u8) -> Result<UniformGrid, EncodeError> {
        let per_root = f64::from(1u32 << depth);
        let dims = self.extent.map(|e| (e * per_root).ceil() as usize + 1);
        Ok(UniformGrid::new(dims, self.origin, [self.spacing / per_root; 3])?)
    }

    /// Whether a brick of a depth holds a sample of the grid.
    pub fn has_brick(&self, depth: u8, brick: [u32; 3], edge: usize) -> bool {
        let per_root = f64::from(1u32 << depth);
        (0..3).all(|a| f64::from(brick[a]) * edge as f64 <= self.extent[a] * per_root)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use chronoxel_core::{BrickLayout, octree::levels_of};

    #[test]
    fn every_depth_has_as_many_levels_as_its_tree() {
        let layout = BrickLayout::new(32).unwrap();
        for size in [[1.0, 0.5, 0.25], [7.3, 7.3, 1e-3], [0.1, 3.0, 2.9], [1e-9, 1e9, 3.0]] {
            let low = [0.3, -17.0, 1e3];
            let high = std::array::from_fn(|a| low[a] + size[a]);
            let lattice = Lattice::new([low, high], 32).unwrap();
            for depth in 0..=10 {
                let grid = lattice.grid(depth).unwrap();
                assert_eq!(levels_of(&grid, &layout).len(), usize::from(depth) + 1, "{size:?} {depth}");
                assert_eq!(*grid.dims.iter().max().unwrap(), (31 << depth) + 1);
            }
        }
    }

    #[test]
    fn boxes_without_a_size_are_refused() {
        for high in [[0.0; 3], [f64::NAN, 1.0, 1.0], [-1.0, 1.0, 1.0], [f64::INFINITY; 3]] {
            assert!(Lattice::new([[0.0; 3], high], 32).is_err(), "{high:?}");
        }
    }
}
