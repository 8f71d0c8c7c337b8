//! What a mesh consists of, and what was left out of it.

use serde::Serialize;

/// Cells of a mesh by kind, those that are left out included.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct CellCounts {
    /// Tetrahedra.
    pub tetrahedra: u64,
    /// Hexahedra, voxels among them.
    pub hexahedra: u64,
    /// Wedges (triangular prisms).
    pub wedges: u64,
    /// Pyramids with a base of four corners.
    pub pyramids: u64,
    /// Vertices, lines and surfaces, which hold no volume and are left out.
    pub without_volume: u64,
}

impl CellCounts {
    /// Cells of all kinds.
    pub fn total(&self) -> u64 {
        self.tetrahedra + self.hexahedra + self.wedges + self.pyramids + self.without_volume
    }
}

/// A count of everything between the cells of a source and the tetrahedra that are kept.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct MeshCensus {
    /// Points of the mesh, whether a cell uses them or not.
    pub num_points: u64,
    /// Cells of the source by kind.
    pub cells: CellCounts,
    /// Cells of higher order, of which the corners alone are used.
    pub num_curved: u64,
    /// Cells left out because they, or one of their corners, are blanked.
    pub num_blanked: u64,
    /// Cells left out because an earlier one has the same corners.
    pub num_duplicate: u64,
    /// Cells left out because two earlier ones have one of their faces already.
    pub num_non_manifold: u64,
    /// Tetrahedra that the other cells were split into.
    pub num_split: u64,
    /// Tetrahedra left out as flat.
    pub num_flat: u64,
    /// Tetrahedra that are kept whose handedness is not that of most from cells of their kind; they were turned.
    pub num_inverted: u64,
    /// Tetrahedra that are kept.
    pub num_tetrahedra: u64,
    /// Sum of their volumes, in cubed world units.
    pub volume: f64,
}
