//! VTK StructuredGrid files (`.vts`): a curvilinear lattice of points with the point data of one time step.
//!
//! Specification: <https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html>. Arrays, components and times are read
//! as those of `.vti` files are. Points and cells that `vtkGhostType` hides are blanked.

use std::path::Path;

use chronoxel_core::Samples;

use super::mesh_files::{MeshFile, MeshShape, Topology, checked_points, lattice, points_of};
use super::volume_file::{FileHeader, checked_product};
use super::vtk_arrays::{Array, ArrayReader, dims_of, encoding};
use super::vtk_pieces::{Piece, join, lattice_pieces};
use super::xml::Document;
use crate::SourceError;
use crate::mesh::GridType;

/// A `.vts` file whose arrays can be as long as its extent needs.
struct VtsFile {
    header: FileHeader<MeshShape>,
    points: Array,
    dims: [usize; 3],
    /// Flags of points and of cells.
    ghosts: [Option<Array>; 2],
    /// Per variable: where it is.
    arrays: Vec<Array>,
}

/// Opens a `.vts` file.
pub(crate) fn open(path: &Path) -> Result<Box<dyn MeshFile>, SourceError> {
    let (pieces, whole) = open_pieces(path)?;
    join(path, pieces, Some(whole), None)
}

/// Opens the pieces of a `.vts` file that have points; also gives the extent that they are of.
pub(crate) fn open_pieces(path: &Path) -> Result<(Vec<Piece>, [i64; 6]), SourceError> {
    lattice_pieces(path, TYPE, open_piece)
}

/// What the root and its child are called.
const TYPE: &str = "StructuredGrid";

fn open_piece(
    document: &Document,
    whole_index: usize,
    piece_index: usize,
    extent: [i64; 6],
) -> Result<VtsFile, SourceError> {
    let path = &document.path;
    let encoding = encoding(document, TYPE)?;
    let dims = dims_of(extent);
    let grid = lattice_shape(path, GridType::Curvilinear, dims)?;
    let reader = ArrayReader { document, encoding };
    let points = point_array(&reader, piece_index, grid.num_points)?;
    let (variables, arrays) = reader.point_data(piece_index, grid.num_points as u64)?;
    let ghosts = ghosts(&reader, piece_index, &grid)?;
    let times = reader.times(whole_index)?;
    let header =
        FileHeader { path: path.to_owned(), grid, variables, num_steps: 1, times, time_units: String::new() };
    Ok(VtsFile { header, points, dims, ghosts, arrays })
}

/// The shape of one structured block.
pub(crate) fn lattice_shape(
    path: &Path,
    grid_type: GridType,
    dims: [usize; 3],
) -> Result<MeshShape, SourceError> {
    let num_points = checked_product(path, "number of points", dims.map(|n| n as u64))?;
    let num_points = checked_points(path, "number of points", num_points)?;
    let num_cells = dims.iter().map(|n| n.saturating_sub(1) as u64).product();
    Ok(MeshShape { grid_type, dims: Some(dims), num_points, num_cells })
}

/// The flags of points and of cells of a piece, where there are some.
pub(crate) fn ghosts(
    reader: &ArrayReader<'_>,
    piece_index: usize,
    grid: &MeshShape,
) -> Result<[Option<Array>; 2], SourceError> {
    let points = reader.ghosts(piece_index, "PointData", grid.num_points as u64)?;
    Ok([points, reader.ghosts(piece_index, "CellData", grid.num_cells)?])
}

/// The array of positions of a piece.
pub(crate) fn point_array(
    reader: &ArrayReader<'_>,
    piece_index: usize,
    num_points: usize,
) -> Result<Array, SourceError> {
    let path = &reader.document.path;
    let element = reader
        .document
        .children(piece_index, "Points")
        .find_map(|(points, _)| reader.document.children(points, "DataArray").next());
    let Some((_, element)) = element else {
        return Err(SourceError::corrupt(path, "Points", "missing", "it must hold one array"));
    };
    if element.get("NumberOfComponents") != Some("3") {
        let value = element.get("NumberOfComponents").unwrap_or("missing");
        return Err(SourceError::corrupt(path, "NumberOfComponents of Points", value, "it must be 3"));
    }
    reader.array(element, "Points", reader.number_type(element)?, 3 * num_points as u64)
}

impl MeshFile for VtsFile {
    fn header(&self) -> &FileHeader<MeshShape> {
        &self.header
    }

    fn points(&self) -> Result<Vec<[f64; 3]>, SourceError> {
        Ok(points_of(&self.points.read_all(&self.header.path)?))
    }

    fn topology(&self) -> Result<Topology, SourceError> {
        let [points, cells] = &self.ghosts;
        lattice(&self.header.path, self.dims, [points.as_ref(), cells.as_ref()])
    }

    fn read_values(&self, variable: usize) -> Result<Samples, SourceError> {
        self.arrays[variable].read_all(&self.header.path)
    }
}
