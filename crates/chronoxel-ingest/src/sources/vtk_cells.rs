//! The cells of a VTK unstructured grid, from XML and legacy files alike.

use std::io::Read;
use std::path::Path;

use chronoxel_core::Samples;

use super::samples::SliceReader;
use crate::mesh::{CellKind, CellList};
use crate::{SourceError, StepReader};

/// Numbers that are converted at a time.
const NUM_AT_ONCE: usize = 1 << 14;

/// The numbers of an array one after the other; its slices have one sample.
pub(crate) struct Numbers<R> {
    reader: SliceReader<R>,
    num_left: u64,
    read: Samples,
    next: usize,
}

impl<R: Read + Send> Numbers<R> {
    /// The numbers of an array of a length.
    pub fn new(reader: SliceReader<R>, num_values: u64) -> Self {
        debug_assert_eq!(reader.slice_samples, 1);
        Self { reader, num_left: num_values, read: Samples::F32(Vec::new()), next: 0 }
    }

    /// The next number, which must be a whole one and not negative.
    pub fn next_whole(&mut self) -> Result<u64, SourceError> {
        if self.next == self.read.len() {
            let count = self.num_left.min(NUM_AT_ONCE as u64) as usize;
            if count == 0 {
                let problem = "it ends before the last cell; the file is damaged";
                return Err(SourceError::corrupt(
                    &self.reader.path,
                    &self.reader.field,
                    "too short",
                    problem,
                ));
            }
            self.read = self.reader.read_slices(count)?;
            self.num_left -= count as u64;
            self.next = 0;
        }
        let value = self.read.get(self.next);
        self.next += 1;
        if value >= 0.0 && value.fract() == 0.0 && value < 9e15 {
            return Ok(value as u64);
        }
        let problem = "numbers of points and cells are whole and not negative";
        Err(SourceError::corrupt(&self.reader.path, &self.reader.field, value, problem))
    }

    /// Numbers that were not asked for yet.
    pub fn num_left(&self) -> u64 {
        self.num_left + (self.read.len() - self.next) as u64
    }
}

/// Where the corners of cells end.
pub(crate) enum Runs {
    /// The number of corners of each cell stands before them.
    Counted,
    /// Per cell: the end of its corners among those of all.
    Ends(Vec<u64>),
}

impl Runs {
    /// Corners of all cells, where that is known.
    pub fn num_corners(&self) -> u64 {
        match self {
            Self::Counted => 0,
            Self::Ends(ends) => ends.last().copied().unwrap_or(0),
        }
    }
}

/// Reads cells: the type and the corners of each.
pub(crate) fn read_cells<R: Read + Send>(
    path: &Path,
    num_cells: u64,
    mut types: Numbers<R>,
    runs: &Runs,
    mut corners: Numbers<R>,
) -> Result<CellList, SourceError> {
    let mut cells = CellList::with_capacity(num_cells as usize, corners.num_left() as usize)
        .map_err(|_| too_many(path, num_cells))?;
    let mut run = Vec::new();
    let mut last_end = 0;
    for cell in 0..num_cells {
        let number = types.next_whole()?;
        let num_corners = match runs {
            Runs::Counted => corners.next_whole()?,
            Runs::Ends(ends) => {
                let end = ends[cell as usize];
                let count = end.checked_sub(last_end).ok_or_else(|| {
                    let problem = format!("the cell before it ends at {last_end}; offsets must not fall");
                    SourceError::corrupt(path, format!("offset of cell {cell}"), end, problem)
                })?;
                last_end = end;
                count
            }
        };
        if num_corners > corners.num_left() {
            let problem = format!("only {} are there; the file is damaged", corners.num_left());
            let field = format!("number of corners of cell {cell}");
            return Err(SourceError::corrupt(path, field, num_corners, problem));
        }
        run.clear();
        for _ in 0..num_corners {
            // What is beyond 32 bits is no point, and is found to be none when corners are checked.
            run.push(u32::try_from(corners.next_whole()?).unwrap_or(u32::MAX));
        }
        push_cell(path, &mut cells, cell, number, &run)?;
    }
    if corners.num_left() > 0 {
        let problem = format!("the {num_cells} cells do not use them; the file is damaged");
        return Err(SourceError::corrupt(path, "corners left over", corners.num_left(), problem));
    }
    Ok(cells)
}

/// Reads the ends of the corners of cells.
pub(crate) fn read_ends<R: Read + Send>(
    path: &Path,
    num_cells: u64,
    offsets: &mut Numbers<R>,
) -> Result<Runs, SourceError> {
    let mut ends = Vec::new();
    ends.try_reserve_exact(num_cells as usize).map_err(|_| too_many(path, num_cells))?;
    for _ in 0..num_cells {
        ends.push(offsets.next_whole()?);
    }
    Ok(Runs::Ends(ends))
}

/// The error where memory does not suffice.
fn too_many(path: &Path, num_cells: u64) -> SourceError {
    let remedy = "there is not enough memory for so many cells; use a smaller mesh";
    SourceError::unsupported(path, "number of cells", num_cells, remedy)
}

/// Adds a cell by VTK's number of its type.
fn push_cell(
    path: &Path,
    cells: &mut CellList,
    cell: u64,
    number: u64,
    corners: &[u32],
) -> Result<(), SourceError> {
    // Of cells of higher order the corners come first: quadratic ones have these numbers of points, those of Lagrange any.
    let (kind, num_points) = match number {
        10 => (CellKind::Tetrahedron, Some(4)),
        11 | 12 => (CellKind::Hexahedron, Some(8)),
        13 => (CellKind::Wedge, Some(6)),
        14 => (CellKind::Pyramid, Some(5)),
        24 => (CellKind::Tetrahedron, Some(10)),
        25 => (CellKind::Hexahedron, Some(20)),
        26 => (CellKind::Wedge, Some(15)),
        27 => (CellKind::Pyramid, Some(13)),
        29 => (CellKind::Hexahedron, Some(27)),
        31 => (CellKind::Wedge, Some(12)),
        32 => (CellKind::Wedge, Some(18)),
        33 => (CellKind::Hexahedron, Some(24)),
        37 => (CellKind::Pyramid, Some(19)),
        71 => (CellKind::Tetrahedron, None),
        72 => (CellKind::Hexahedron, None),
        73 => (CellKind::Wedge, None),
        74 => (CellKind::Pyramid, None),
        // Nothing, vertices, lines, surfaces, and their forms of higher order.
        0..=9 | 21..=23 | 28 | 30 | 34..=36 | 51 | 52 | 56 | 60..=62 | 68..=70 | 75..=77 => {
            cells.push_without_volume();
            return Ok(());
        }
        _ => {
            let field = format!("type of cell {cell}");
            let remedy = "tetrahedra (10), voxels (11), hexahedra (12), wedges (13), pyramids (14) and their forms of \
                          higher order are, and cells without volume are left out; convert it, as with \
                          vtkDataSetTriangleFilter";
            return Err(SourceError::unsupported(path, field, number, remedy));
        }
    };
    if num_points.is_some_and(|n| corners.len() != n) || corners.len() < kind.num_corners() {
        let field = format!("number of corners of cell {cell}");
        let problem = match num_points {
            Some(n) => format!("a cell of type {number} has {n}"),
            None => format!("a cell of type {number} has at least {}", kind.num_corners()),
        };
        return Err(SourceError::corrupt(path, field, corners.len(), problem));
    }
    if number > 14 {
        cells.push_curved(kind, &corners[..kind.num_corners()]);
        return Ok(());
    }
    match number {
        // The corners of a voxel lie as in a lattice, not around its faces.
        11 => cells.push(kind, &[0, 1, 3, 2, 4, 5, 7, 6].map(|corner| corners[corner])),
        _ => cells.push(kind, corners),
    }
    Ok(())
}
