//! Meshes: grids that are not uniform, as points with one value each, and the tetrahedra between them.
//!
//! Whatever a grid's cells are, what leaves here are tetrahedra: positively oriented, in a fixed order, without the flat
//! ones. Everything left out is counted in a [`MeshCensus`]. The geometry is the same at every step of a series.

mod blocks;
mod cells;
mod census;
mod check;
mod memory;
mod selected;
mod sieve;
mod split;

use chronoxel_core::{Samples, TimeAxis};
use serde::Serialize;

pub(crate) use self::blocks::{Blanked, Block, Blocks, for_each_of_block};
pub(crate) use self::cells::CheckedCells;
pub use self::cells::{CellKind, CellList};
pub use self::census::{CellCounts, MeshCensus};
pub use self::memory::MemoryMesh;
pub(crate) use self::selected::SelectedMesh;
pub use self::sieve::DEFAULT_FLAT_THRESHOLD;
pub(crate) use self::sieve::Sieve;
pub(crate) use self::sieve::{MAX_POINTS, check_points};
use crate::{SourceError, TimeSeries, Variable};

/// What kind of grid a mesh was in its source.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum GridType {
    /// Points at every combination of given coordinates along x, y and z.
    Rectilinear,
    /// A lattice of points anywhere, in one block or several.
    Curvilinear,
    /// Points and cells in any order: tetrahedra, hexahedra, wedges, pyramids.
    #[serde(rename = "tetrahedral")]
    Unstructured,
}

impl GridType {
    /// The type as reports name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rectilinear => "rectilinear",
            Self::Curvilinear => "curvilinear",
            Self::Unstructured => "tetrahedral",
        }
    }
}

/// A function that is handed tetrahedra one by one, as indices of their points.
pub type VisitTetrahedron<'a> = dyn FnMut([u32; 4]) -> Result<(), SourceError> + 'a;

/// A time-varying field on a mesh that stays where it is.
///
/// Points are numbered from 0; there are fewer than 2^32. Reading twice gives the same.
pub trait MeshSeries: Send {
    /// What the grid was in its source.
    fn grid_type(&self) -> GridType;

    /// Points along the three axes of a grid of one structured block.
    fn dims(&self) -> Option<[usize; 3]>;

    /// Number of points: the samples of one step.
    fn num_points(&self) -> usize;

    /// Times of the steps.
    fn times(&self) -> &TimeAxis;

    /// The variables, at least one; each has one value per point.
    fn variables(&self) -> &[Variable];

    /// Positions of the points in the world, all finite.
    ///
    /// # Errors
    /// [`SourceError`] naming the file and the point if it cannot be read or a coordinate is not finite.
    fn points(&mut self) -> Result<Vec<[f64; 3]>, SourceError>;

    /// Hands over the tetrahedra that are kept, in a fixed order.
    ///
    /// Each is positively oriented: `(b - a) × (c - a) · (d - a) > 0`. Memory does not grow with their number
    /// where the grid is structured. An error of `visit` ends the walk and is passed on.
    ///
    /// # Errors
    /// [`SourceError`] naming the file and the cell for points that do not exist, kinds of cells that are not
    /// known, and where nothing is left.
    fn for_each_tetrahedron(&mut self, visit: &mut VisitTetrahedron<'_>) -> Result<MeshCensus, SourceError>;

    /// The values of one step of a variable, one per point, NaN where there is none.
    ///
    /// # Errors
    /// [`SourceError`] if the file cannot be read, or if its geometry is not that of the first step.
    ///
    /// # Panics
    /// If `variable` or `step` is out of range.
    fn read_values(&mut self, variable: usize, step: usize) -> Result<Samples, SourceError>;

    /// The most bytes held between and during calls, besides what is handed over.
    fn working_bytes(&self) -> u64;

    /// What is worth knowing about the source beyond its numbers, a line each.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }
}

/// A source that was opened: a uniform volume or a mesh.
pub enum Opened {
    /// Samples on a uniform grid.
    Volume(Box<dyn TimeSeries>),
    /// Values at the points of a mesh.
    Mesh(Box<dyn MeshSeries>),
}
