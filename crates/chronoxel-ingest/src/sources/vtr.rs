//! VTK RectilinearGrid files (`.vtr`): coordinates along x, y and z with the point data of one time step.
//!
//! Specification: <https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html>. Arrays, components and times are read
//! as those of `.vti` files are. Coordinates must rise or fall all the way. A grid whose coordinates are evenly spaced is a mesh all the
//! same, and a note says so.

use std::path::Path;

use chronoxel_core::Samples;

use super::mesh_files::{MeshFile, MeshShape, Topology, lattice};
use super::volume_file::FileHeader;
use super::vtk_arrays::{Array, ArrayReader, dims_of, encoding};
use super::vtk_pieces::{Piece, join, lattice_pieces};
use super::vts::{ghosts, lattice_shape};
use super::xml::Document;
use crate::SourceError;
use crate::mesh::GridType;

/// Difference of spacings, relative to the mean, up to which coordinates are evenly spaced.
const EVEN_TOLERANCE: f64 = 1e-4;

/// A `.vtr` file whose arrays can be as long as its extent needs.
struct VtrFile {
    header: FileHeader<MeshShape>,
    axes: [Array; 3],
    dims: [usize; 3],
    /// Flags of points and of cells.
    ghosts: [Option<Array>; 2],
    /// Per variable: where it is.
    arrays: Vec<Array>,
}

/// Opens a `.vtr` file.
pub(crate) fn open(path: &Path) -> Result<Box<dyn MeshFile>, SourceError> {
    let (pieces, whole) = open_pieces(path)?;
    join(path, pieces, Some(whole), None)
}

/// Opens the pieces of a `.vtr` file that have points; also gives the extent that they are of.
pub(crate) fn open_pieces(path: &Path) -> Result<(Vec<Piece>, [i64; 6]), SourceError> {
    lattice_pieces(path, TYPE, open_piece)
}

/// What the root and its child are called.
const TYPE: &str = "RectilinearGrid";

fn open_piece(
    document: &Document,
    whole_index: usize,
    piece_index: usize,
    extent: [i64; 6],
) -> Result<VtrFile, SourceError> {
    let path = &document.path;
    let encoding = encoding(document, TYPE)?;
    let dims = dims_of(extent);
    let grid = lattice_shape(path, GridType::Rectilinear, dims)?;
    let reader = ArrayReader { document, encoding };
    let (variables, arrays) = reader.point_data(piece_index, grid.num_points as u64)?;
    let axes = axes(&reader, piece_index, dims)?;
    let ghosts = ghosts(&reader, piece_index, &grid)?;
    let times = reader.times(whole_index)?;
    let header =
        FileHeader { path: path.to_owned(), grid, variables, num_steps: 1, times, time_units: String::new() };
    Ok(VtrFile { header, axes, dims, ghosts, arrays })
}

/// The three arrays of coordinates.
fn axes(reader: &ArrayReader<'_>, piece_index: usize, dims: [usize; 3]) -> Result<[Array; 3], SourceError> {
    let document = reader.document;
    let elements: Vec<_> = document
        .children(piece_index, "Coordinates")
        .flat_map(|(coordinates, _)| document.children(coordinates, "DataArray"))
        .map(|(_, element)| element)
        .collect();
    let [x, y, z] = elements[..] else {
        let problem = "there must be three arrays, for x, y and z";
        return Err(SourceError::corrupt(
            &document.path,
            "number of arrays in Coordinates",
            elements.len(),
            problem,
        ));
    };
    let axis = |element, name, n: usize| reader.array(element, name, reader.number_type(element)?, n as u64);
    Ok([axis(x, "x", dims[0])?, axis(y, "y", dims[1])?, axis(z, "z", dims[2])?])
}

/// Positions of the points of a rectilinear grid; coordinates must rise or fall all the way.
pub(crate) fn product_of_axes(path: &Path, axes: &[Vec<f64>; 3]) -> Result<Vec<[f64; 3]>, SourceError> {
    for (axis, name) in axes.iter().zip(["x", "y", "z"]) {
        let rises = axis.len() < 2 || axis[1] > axis[0];
        let wrong =
            axis.windows(2).position(|pair| !(if rises { pair[0] < pair[1] } else { pair[0] > pair[1] }));
        if let Some(index) = wrong {
            let field = format!("coordinate {} along {name}", index + 1);
            let problem =
                format!("it comes after {}; coordinates must rise or fall all the way", axis[index]);
            return Err(SourceError::corrupt(path, field, axis[index + 1], problem));
        }
    }
    let [x, y, z] = axes;
    let num_points = x.len() * y.len() * z.len();
    let mut points = Vec::new();
    points.try_reserve_exact(num_points).map_err(|_| {
        let remedy = "there is not enough memory for so many points; use a smaller grid";
        SourceError::unsupported(path, "number of points", num_points, remedy)
    })?;
    for &z in z {
        for &y in y {
            points.extend(x.iter().map(|&x| [x, y, z]));
        }
    }
    Ok(points)
}

/// What is to be said about a rectilinear grid: whether it is in fact uniform.
pub(crate) fn uniform_note(axes: &[Vec<f64>; 3]) -> Vec<String> {
    let is_even = |axis: &Vec<f64>| {
        let mean = (axis[axis.len() - 1] - axis[0]) / (axis.len().max(2) - 1) as f64;
        axis.windows(2).all(|pair| (pair[1] - pair[0] - mean).abs() <= EVEN_TOLERANCE * mean.abs())
    };
    match axes.iter().all(is_even) {
        true => vec!["its coordinates are evenly spaced: as .vti it would need no resampling".to_owned()],
        false => Vec::new(),
    }
}

impl VtrFile {
    /// The coordinates.
    fn coordinates(&self) -> Result<[Vec<f64>; 3], SourceError> {
        let read = |axis: &Array| Ok(axis.read_all(&self.header.path)?.to_f64());
        Ok([read(&self.axes[0])?, read(&self.axes[1])?, read(&self.axes[2])?])
    }
}

impl MeshFile for VtrFile {
    fn header(&self) -> &FileHeader<MeshShape> {
        &self.header
    }

    fn points(&self) -> Result<Vec<[f64; 3]>, SourceError> {
        product_of_axes(&self.header.path, &self.coordinates()?)
    }

    fn topology(&self) -> Result<Topology, SourceError> {
        let [points, cells] = &self.ghosts;
        lattice(&self.header.path, self.dims, [points.as_ref(), cells.as_ref()])
    }

    fn read_values(&self, variable: usize) -> Result<Samples, SourceError> {
        self.arrays[variable].read_all(&self.header.path)
    }

    fn notes(&self) -> Result<Vec<String>, SourceError> {
        Ok(uniform_note(&self.coordinates()?))
    }
}
