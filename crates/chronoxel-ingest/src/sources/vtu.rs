//! VTK UnstructuredGrid files (`.vtu`): points and cells with the point data of one time step.
//!
//! Specification: <https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html>. Arrays, components and times are read
//! as those of `.vti` files are. Tetrahedra, hexahedra, voxels, wedges and pyramids are read; cells without volume are left out and counted.

use std::path::Path;
use std::sync::Arc;

use chronoxel_core::Samples;

use super::mesh_files::{MeshFile, MeshShape, Topology, checked_points, points_of};
use super::volume_file::FileHeader;
use super::vtk_arrays::{Array, ArrayReader, data_set, encoding, numbers, pieces};
use super::vtk_cells::{Numbers, read_cells, read_ends};
use super::vtk_pieces::{Piece, join};
use super::vts::point_array;
use super::xml::{Document, Element};
use crate::SourceError;
use crate::mesh::GridType;

/// A `.vtu` file whose arrays can be as long as its header needs.
struct VtuFile {
    header: FileHeader<MeshShape>,
    document: Arc<Document>,
    /// The element with the cells.
    cells_index: usize,
    points: Array,
    /// Per variable: where it is.
    arrays: Vec<Array>,
}

/// Opens a `.vtu` file.
pub(crate) fn open(path: &Path) -> Result<Box<dyn MeshFile>, SourceError> {
    join(path, open_pieces(path)?, None, None)
}

/// Opens the pieces of a `.vtu` file that have points.
pub(crate) fn open_pieces(path: &Path) -> Result<Vec<Piece>, SourceError> {
    let document = Arc::new(Document::read(path)?);
    encoding(&document, TYPE)?;
    let whole = data_set(&document, TYPE)?;
    let mut opened = Vec::new();
    let pieces = pieces(&document, whole)?;
    for &(index, piece) in &pieces {
        // A process without a part of the mesh writes an empty piece.
        if pieces.len() > 1 && count(path, piece, "NumberOfPoints")? == 0 {
            continue;
        }
        let file = open_piece(&document, whole.0, (index, piece))?;
        opened.push(Piece { file: Box::new(file), extent: None });
    }
    Ok(opened)
}

fn open_piece(
    document: &Arc<Document>,
    whole_index: usize,
    (piece_index, piece): (usize, &Element),
) -> Result<VtuFile, SourceError> {
    let path = &document.path;
    let encoding = encoding(document, TYPE)?;
    let num_points = count(path, piece, "NumberOfPoints")?;
    let num_points = checked_points(path, "NumberOfPoints", num_points)?;
    let num_cells = count(path, piece, "NumberOfCells")?;
    checked_points(path, "NumberOfCells", num_cells)?;
    let reader = ArrayReader { document, encoding };
    let points = point_array(&reader, piece_index, num_points)?;
    let (variables, arrays) = reader.point_data(piece_index, num_points as u64)?;
    let times = reader.times(whole_index)?;
    let cells_index = document.children(piece_index, "Cells").next().map(|(index, _)| index);
    let cells_index = cells_index
        .ok_or_else(|| SourceError::corrupt(path, "Cells", "missing", "it must hold the cells"))?;
    let grid = MeshShape { grid_type: GridType::Unstructured, dims: None, num_points, num_cells };
    let header =
        FileHeader { path: path.to_owned(), grid, variables, num_steps: 1, times, time_units: String::new() };
    Ok(VtuFile { header, document: Arc::clone(document), cells_index, points, arrays })
}

/// What the root and its child are called.
const TYPE: &str = "UnstructuredGrid";

/// A count among the attributes of a piece.
fn count(path: &Path, piece: &Element, attribute: &'static str) -> Result<u64, SourceError> {
    Ok(numbers::<u64, 1>(path, piece, attribute, None)?[0])
}

impl MeshFile for VtuFile {
    fn header(&self) -> &FileHeader<MeshShape> {
        &self.header
    }

    fn points(&self) -> Result<Vec<[f64; 3]>, SourceError> {
        Ok(points_of(&self.points.read_all(&self.header.path)?))
    }

    fn topology(&self) -> Result<Topology, SourceError> {
        let path = &self.header.path;
        let num_cells = self.header.grid.num_cells;
        let reader = ArrayReader { document: &self.document, encoding: encoding(&self.document, TYPE)? };
        let numbers = |array: &Array| Ok(Numbers::new(array.open(path, 1)?, array.num_values()));
        let types = reader.named_array(self.cells_index, "types", num_cells)?;
        let mut offsets = numbers(&reader.named_array(self.cells_index, "offsets", num_cells)?)?;
        let runs = read_ends(path, num_cells, &mut offsets)?;
        let corners = reader.named_array(self.cells_index, "connectivity", runs.num_corners())?;
        let cells = read_cells(path, num_cells, numbers(&types)?, &runs, numbers(&corners)?)?;
        Ok(Topology::Cells(cells))
    }

    fn read_values(&self, variable: usize) -> Result<Samples, SourceError> {
        self.arrays[variable].read_all(&self.header.path)
    }
}
