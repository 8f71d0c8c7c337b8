//! Legacy VTK files (`.vtk`): structured points, structured, rectilinear and unstructured grids, with the point data of one
//! time step.
//!
//! Specification: <https://docs.vtk.org/en/latest/vtk_file_formats/vtk_legacy_file_format.html>, versions 1 to 5.1, ascii and binary
//! (big-endian). Structured points are a uniform grid, everything else is a mesh. Each component of an array with several is a
//! variable of its own, `NAME_0`, `NAME_1`, …. The time is that of a field array `TIME` or `TimeValue`; where there is none,
//! `CYCLE` or `TimeStep` gives the number of the step.

use std::path::Path;

use chronoxel_core::Samples;

use super::OpenedFile;
use super::mesh_files::{MeshFile, MeshShape, Topology, checked_points, lattice, points_of};
use super::volume_file::{FileHeader, FileTimes, VolumeFile, checked_grid};
use super::vtk_arrays::Array;
use super::vtk_cells::{Numbers, Runs, read_cells, read_ends};
use super::vtk_legacy_scan::{DataSet, Legacy, LegacyCells};
use super::vtr::{product_of_axes, uniform_note};
use super::vts::lattice_shape;
use crate::mesh::{CheckedCells, GridType};
use crate::{SourceError, StepReader};

/// A file with a uniform grid.
struct LegacyVolume {
    header: FileHeader,
    arrays: Vec<Array>,
}

/// A file with a mesh.
struct LegacyMesh {
    header: FileHeader<MeshShape>,
    legacy: Legacy,
}

/// Opens a `.vtk` file.
pub(crate) fn open(path: &Path) -> Result<OpenedFile, SourceError> {
    let mut legacy = Legacy::read(path)?;
    if legacy.arrays.is_empty() {
        return Err(no_point_data(&legacy));
    }
    let times = times(&legacy)?;
    let variables = std::mem::take(&mut legacy.variables);
    let time_units = String::new();
    if legacy.data_set == DataSet::StructuredPoints {
        let dims = needed(path, "DIMENSIONS", legacy.dims)?;
        let (origin, spacing) = (legacy.origin.unwrap_or([0.0; 3]), legacy.spacing.unwrap_or([1.0; 3]));
        let grid = checked_grid(path, dims, origin, spacing)?;
        check_num_points(&legacy, grid.num_samples() as u64)?;
        let header = FileHeader { path: path.to_owned(), grid, variables, num_steps: 1, times, time_units };
        return Ok(OpenedFile::Volume(Box::new(LegacyVolume { header, arrays: legacy.arrays })));
    }
    let grid = shape(&legacy)?;
    check_num_points(&legacy, grid.num_points as u64)?;
    let header = FileHeader { path: path.to_owned(), grid, variables, num_steps: 1, times, time_units };
    Ok(OpenedFile::Mesh(Box::new(LegacyMesh { header, legacy })))
}

/// The error for a file without values at points.
fn no_point_data(legacy: &Legacy) -> SourceError {
    if legacy.has_cell_data {
        let remedy =
            "point data are; convert it with vtkCellDataToPointData (ParaView: Cell Data to Point Data)";
        return SourceError::unsupported(&legacy.path, "data", "cell data only", remedy);
    }
    SourceError::corrupt(&legacy.path, "POINT_DATA", "empty", "it must have at least one array")
}

/// The time in the field data.
fn times(legacy: &Legacy) -> Result<FileTimes, SourceError> {
    if let Some(time) = &legacy.time {
        return Ok(FileTimes::Known(vec![time.read_all(&legacy.path)?.get(0)]));
    }
    Ok(match &legacy.cycle {
        Some(cycle) => FileTimes::StepNumber(cycle.read_all(&legacy.path)?.get(0)),
        None => FileTimes::Unknown,
    })
}

/// A part that a file must have.
fn needed<T>(path: &Path, field: &str, part: Option<T>) -> Result<T, SourceError> {
    part.ok_or_else(|| SourceError::corrupt(path, field, "missing", "the file is truncated or damaged"))
}

/// The point data are for all points.
fn check_num_points(legacy: &Legacy, num_points: u64) -> Result<(), SourceError> {
    match legacy.num_point_data {
        Some(given) if given != num_points => {
            let problem = format!("the grid has {num_points} points");
            Err(SourceError::corrupt(&legacy.path, "POINT_DATA", given, problem))
        }
        _ => Ok(()),
    }
}

/// The shape of a mesh, its parts being as long as each other needs.
fn shape(legacy: &Legacy) -> Result<MeshShape, SourceError> {
    let path = &legacy.path;
    let check = |field: &str, array: &Array, num_values: u64| match array.num_values() == num_values {
        true => Ok(()),
        false => {
            let problem = format!("the grid needs {num_values} numbers");
            Err(SourceError::corrupt(path, field, array.num_values(), problem))
        }
    };
    match legacy.data_set {
        DataSet::RectilinearGrid => {
            let dims = needed(path, "DIMENSIONS", legacy.dims)?;
            for (axis, name) in ["X_COORDINATES", "Y_COORDINATES", "Z_COORDINATES"].iter().enumerate() {
                check(name, needed(path, name, legacy.axes[axis].as_ref())?, dims[axis] as u64)?;
            }
            lattice_shape(path, GridType::Rectilinear, dims)
        }
        DataSet::UnstructuredGrid => {
            let num_values = needed(path, "POINTS", legacy.points.as_ref())?.num_values();
            let num_points = checked_points(path, "POINTS", num_values / 3)?;
            let num_cells = needed(path, "CELL_TYPES", legacy.cell_types.as_ref())?.num_values();
            checked_points(path, "CELL_TYPES", num_cells)?;
            if let LegacyCells::Offsets { offsets, .. } = needed(path, "CELLS", legacy.cells.as_ref())? {
                check("OFFSETS", offsets, num_cells + 1)?;
            }
            Ok(MeshShape { grid_type: GridType::Unstructured, dims: None, num_points, num_cells })
        }
        _ => {
            let dims = needed(path, "DIMENSIONS", legacy.dims)?;
            let shape = lattice_shape(path, GridType::Curvilinear, dims)?;
            let points = needed(path, "POINTS", legacy.points.as_ref())?;
            check("POINTS", points, 3 * shape.num_points as u64)?;
            Ok(shape)
        }
    }
}

impl VolumeFile for LegacyVolume {
    fn header(&self) -> &FileHeader {
        &self.header
    }

    fn open_step<'a>(
        &'a mut self,
        variable: usize,
        _step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError> {
        let [nx, ny, _] = self.header.grid.dims;
        Ok(Box::new(self.arrays[variable].open(&self.header.path, nx * ny)?))
    }
}

impl LegacyMesh {
    /// Coordinates of a rectilinear grid.
    fn coordinates(&self) -> Result<[Vec<f64>; 3], SourceError> {
        let read = |axis: &Option<Array>| match axis {
            Some(axis) => Ok(axis.read_all(&self.legacy.path)?.to_f64()),
            None => Ok(Vec::new()),
        };
        let [x, y, z] = &self.legacy.axes;
        Ok([read(x)?, read(y)?, read(z)?])
    }
}

impl MeshFile for LegacyMesh {
    fn header(&self) -> &FileHeader<MeshShape> {
        &self.header
    }

    fn points(&self) -> Result<Vec<[f64; 3]>, SourceError> {
        match &self.legacy.points {
            Some(points) if self.header.grid.grid_type != GridType::Rectilinear => {
                Ok(points_of(&points.read_all(&self.legacy.path)?))
            }
            _ => product_of_axes(&self.legacy.path, &self.coordinates()?),
        }
    }

    fn topology(&self) -> Result<Topology, SourceError> {
        let path = &self.legacy.path;
        if let Some(dims) = self.header.grid.dims {
            let [points, cells] = &self.legacy.ghosts;
            return lattice(path, dims, [points.as_ref(), cells.as_ref()]);
        }
        let numbers = |array: &Array| Ok(Numbers::new(array.open(path, 1)?, array.num_values()));
        let types = numbers(needed(path, "CELL_TYPES", self.legacy.cell_types.as_ref())?)?;
        let num_cells = self.header.grid.num_cells;
        let cells = match needed(path, "CELLS", self.legacy.cells.as_ref())? {
            LegacyCells::Counted(corners) => {
                read_cells(path, num_cells, types, &Runs::Counted, numbers(corners)?)?
            }
            LegacyCells::Offsets { offsets, connectivity } => {
                let mut offsets = numbers(offsets)?;
                let first = offsets.next_whole()?;
                if first != 0 {
                    return Err(SourceError::corrupt(path, "OFFSETS", first, "the first one must be 0"));
                }
                let runs = read_ends(path, num_cells, &mut offsets)?;
                read_cells(path, num_cells, types, &runs, numbers(connectivity)?)?
            }
        };
        Ok(Topology::Cells(CheckedCells::new(path, cells, self.header.grid.num_points)?))
    }

    fn read_values(&self, variable: usize) -> Result<Samples, SourceError> {
        self.legacy.arrays[variable].read_all(&self.legacy.path)
    }

    fn notes(&self) -> Result<Vec<String>, SourceError> {
        match self.header.grid.grid_type {
            GridType::Rectilinear => Ok(uniform_note(&self.coordinates()?)),
            _ => Ok(Vec::new()),
        }
    }
}
