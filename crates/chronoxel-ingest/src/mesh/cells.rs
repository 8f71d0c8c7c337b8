//! Cells in any order: tetrahedra, hexahedra, wedges and pyramids by the numbers of their corners.

use std::collections::TryReserveError;
use std::path::Path;

use super::check::{Colours, Excluded};
use super::{MeshCensus, Sieve, VisitTetrahedron, split};
use crate::SourceError;

/// A kind of cell that holds a volume, with VTK's order of corners.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum CellKind {
    /// Four corners.
    Tetrahedron,
    /// Eight corners: a face around, then the one opposite.
    Hexahedron,
    /// Six corners: a triangle, then the one opposite.
    Wedge,
    /// Five corners: the base around, then the tip.
    Pyramid,
}

impl CellKind {
    /// All kinds.
    pub const ALL: [Self; 4] = [Self::Tetrahedron, Self::Hexahedron, Self::Wedge, Self::Pyramid];

    /// How many corners such a cell has.
    pub fn num_corners(self) -> usize {
        match self {
            Self::Tetrahedron => 4,
            Self::Hexahedron => 8,
            Self::Wedge => 6,
            Self::Pyramid => 5,
        }
    }

    /// Its faces; a triangle names its last corner twice.
    pub(super) fn faces(self) -> &'static [[usize; 4]] {
        match self {
            Self::Tetrahedron => &[[0, 1, 2, 2], [0, 1, 3, 3], [1, 2, 3, 3], [0, 2, 3, 3]],
            Self::Hexahedron => &split::HEXAHEDRON,
            Self::Wedge => &[[0, 1, 2, 2], [3, 4, 5, 5], [0, 1, 4, 3], [1, 2, 5, 4], [2, 0, 3, 5]],
            Self::Pyramid => &[[0, 1, 2, 3], [0, 1, 4, 4], [1, 2, 4, 4], [2, 3, 4, 4], [3, 0, 4, 4]],
        }
    }
}

/// The cells of an unstructured grid.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CellList {
    kinds: Vec<CellKind>,
    /// Corners of all cells, one after the other.
    corners: Vec<u32>,
    /// Number of each cell in its source, where some there are left out; else empty.
    numbers: Vec<u64>,
    num_without_volume: u64,
    /// Cells of higher order, of which the corners are kept.
    num_curved: u64,
}

impl CellList {
    /// An empty list with room for cells, so that it does not grow by doubling.
    ///
    /// # Errors
    /// If there is not enough memory.
    pub fn with_capacity(num_cells: usize, num_corners: usize) -> Result<Self, TryReserveError> {
        let mut list = Self::default();
        list.kinds.try_reserve_exact(num_cells)?;
        list.corners.try_reserve_exact(num_corners)?;
        Ok(list)
    }

    /// Adds a cell.
    ///
    /// # Panics
    /// If the number of corners is not that of the kind.
    pub fn push(&mut self, kind: CellKind, corners: &[u32]) {
        assert_eq!(corners.len(), kind.num_corners(), "corners of {kind:?}");
        if self.num_without_volume > 0 {
            self.numbers.push(self.kinds.len() as u64 + self.num_without_volume);
        }
        self.kinds.push(kind);
        self.corners.extend_from_slice(corners);
    }

    /// Adds a cell of higher order by its corners.
    ///
    /// # Panics
    /// If the number of corners is not that of the kind.
    pub fn push_curved(&mut self, kind: CellKind, corners: &[u32]) {
        self.push(kind, corners);
        self.num_curved += 1;
    }

    /// Adds all cells of another list.
    ///
    /// * `points`: for each point of the other list, its number here
    ///
    /// # Errors
    /// If a corner is none of the points.
    pub fn append(&mut self, path: &Path, other: &Self, points: &[u32]) -> Result<(), SourceError> {
        other.check_corners(path, points.len())?;
        let before = self.len() as u64 + self.num_without_volume;
        if self.num_without_volume + other.num_without_volume > 0 {
            if self.num_without_volume == 0 {
                self.numbers = (0..self.len() as u64).collect();
            }
            self.numbers.extend((0..other.len()).map(|cell| before + other.number(cell)));
        }
        self.kinds.extend_from_slice(&other.kinds);
        self.corners.extend(other.corners.iter().map(|corner| points[*corner as usize]));
        self.num_without_volume += other.num_without_volume;
        self.num_curved += other.num_curved;
        Ok(())
    }

    /// Counts a cell without volume: a vertex, a line, a surface.
    pub fn push_without_volume(&mut self) {
        if self.num_without_volume == 0 {
            self.numbers = (0..self.kinds.len() as u64).collect();
        }
        self.num_without_volume += 1;
    }

    /// Number of cells with a volume.
    pub fn len(&self) -> usize {
        self.kinds.len()
    }

    /// Whether no cell has a volume.
    pub fn is_empty(&self) -> bool {
        self.kinds.is_empty()
    }

    /// The cells with a volume in order: kind and corners.
    pub fn iter(&self) -> impl Iterator<Item = (CellKind, &[u32])> {
        let mut rest = &self.corners[..];
        self.kinds.iter().map(move |&kind| {
            let (corners, after) = rest.split_at(kind.num_corners());
            rest = after;
            (kind, corners)
        })
    }

    /// Bytes held.
    fn num_bytes(&self) -> u64 {
        (self.kinds.capacity() + 4 * self.corners.capacity() + 8 * self.numbers.capacity()) as u64
    }

    /// The number of a cell in its source.
    fn number(&self, cell: usize) -> u64 {
        self.numbers.get(cell).copied().unwrap_or(cell as u64)
    }

    /// Refuses corners that are no points; the error names the cell.
    fn check_corners(&self, path: &Path, num_points: usize) -> Result<(), SourceError> {
        if self.corners.iter().all(|&corner| (corner as usize) < num_points) {
            return Ok(());
        }
        for (cell, (_, corners)) in self.iter().enumerate() {
            if let Some(corner) = corners.iter().find(|corner| **corner as usize >= num_points) {
                let field = format!("corner of cell {}", self.number(cell));
                let problem = format!("the mesh has {num_points} points, numbered from 0");
                return Err(SourceError::corrupt(path, field, corner, problem));
            }
        }
        Ok(())
    }
}

/// Cells that were compared with each other, ready to be walked.
pub(crate) struct CheckedCells {
    list: CellList,
    excluded: Excluded,
    colours: Colours,
}

impl CheckedCells {
    /// Compares cells of a mesh; the error names a corner that is no point.
    pub fn new(path: &Path, list: CellList, num_points: usize) -> Result<Self, SourceError> {
        list.check_corners(path, num_points)?;
        let excluded = Excluded::of(&list);
        let colours = Colours::of(&list, &excluded, num_points);
        Ok(Self { list, excluded, colours })
    }

    /// Hands the tetrahedra of all cells to `visit`, duplicates and whatever lies behind a full face left out.
    pub fn for_each_tetrahedron(
        &self,
        path: &Path,
        points: &[[f64; 3]],
        flat_threshold: f64,
        visit: &mut VisitTetrahedron<'_>,
    ) -> Result<MeshCensus, SourceError> {
        let mut sieve = Sieve::new(points.len(), flat_threshold, visit);
        sieve.census.num_duplicate = self.excluded.num_duplicate;
        sieve.census.num_non_manifold = self.excluded.num_non_manifold;
        sieve.census.cells.without_volume = self.list.num_without_volume;
        sieve.census.num_curved = self.list.num_curved;
        for (cell, (kind, corners)) in self.list.iter().enumerate() {
            let cells = &mut sieve.census.cells;
            *match kind {
                CellKind::Tetrahedron => &mut cells.tetrahedra,
                CellKind::Hexahedron => &mut cells.hexahedra,
                CellKind::Wedge => &mut cells.wedges,
                CellKind::Pyramid => &mut cells.pyramids,
            } += 1;
            if self.excluded.contains(cell) {
                continue;
            }
            let mut take = |t: [usize; 4]| {
                let tetrahedron = t.map(|corner| corners[corner]);
                sieve.take(kind, tetrahedron, tetrahedron.map(|point| points[point as usize]))
            };
            let rank = |corner: usize| self.colours.rank(corners[corner]);
            match kind {
                CellKind::Tetrahedron => take([0, 1, 2, 3])?,
                CellKind::Hexahedron => {
                    split::hexahedron(std::array::from_fn(rank)).into_iter().try_for_each(take)?
                }
                CellKind::Wedge => split::wedge(std::array::from_fn(rank)).into_iter().try_for_each(take)?,
                CellKind::Pyramid => {
                    split::pyramid(std::array::from_fn(rank)).into_iter().try_for_each(take)?
                }
            }
        }
        sieve.finish(path)
    }

    /// The most bytes held by these cells, while they are compared and afterwards.
    pub fn most_bytes(&self, num_points: usize) -> u64 {
        let num_faces: usize = self.list.kinds.iter().map(|kind| kind.faces().len()).sum();
        let compared = Excluded::most_bytes(self.list.len(), num_faces) + Colours::most_bytes(num_points);
        self.list.num_bytes() + compared
    }
}
