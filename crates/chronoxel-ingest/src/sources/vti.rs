//! VTK ImageData files (`.vti`): the point data of one time step.
//!
//! Specification: <https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html>. Data ascii, base64 or
//! appended (raw or base64), plain or compressed by zlib or LZ4. Each component of an array with several is a variable
//! of its own, `NAME_x` after its component's name or `NAME_0`, `NAME_1`, …. The time is that of the field data array
//! `TimeValue`; where there is none, `TimeStep` gives the number of the step.

use std::path::Path;

use chronoxel_core::UniformGrid;

use super::volume_file::{FileHeader, VolumeFile, checked_grid};
use super::vtk_arrays::{Array, ArrayReader, data_set, dims_of, encoding, extent, numbers, only_piece};
use super::xml::{Document, Element};
use crate::{SourceError, StepReader};

/// A `.vti` file whose arrays can be as long as its extent needs.
struct VtiFile {
    header: FileHeader,
    /// Per variable: where it is.
    arrays: Vec<Array>,
}

/// Opens a `.vti` file.
pub(crate) fn open(path: &Path) -> Result<Box<dyn VolumeFile>, SourceError> {
    let document = Document::read(path)?;
    let encoding = encoding(&document, "ImageData")?;
    let (image_index, image) = data_set(&document, "ImageData")?;
    let (piece_index, piece) = only_piece(&document, (image_index, image))?;
    let grid = grid(path, image, piece)?;
    let reader = ArrayReader { document: &document, encoding };
    let (variables, arrays) = reader.point_data(piece_index, grid.num_samples() as u64)?;
    let times = reader.times(image_index)?;
    let header =
        FileHeader { path: path.to_owned(), grid, variables, num_steps: 1, times, time_units: String::new() };
    Ok(Box::new(VtiFile { header, arrays }))
}

/// The grid of an image.
fn grid(path: &Path, image: &Element, piece: &Element) -> Result<UniformGrid, SourceError> {
    let extent = extent(path, image, piece)?;
    let dims = dims_of(extent);
    let origin = numbers::<f64, 3>(path, image, "Origin", Some([0.0; 3]))?;
    let spacing = numbers::<f64, 3>(path, image, "Spacing", Some([1.0; 3]))?;
    const IDENTITY: [f64; 9] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let direction = numbers::<f64, 9>(path, image, "Direction", Some(IDENTITY))?;
    if direction != IDENTITY {
        let remedy = "images along x, y and z are; resample it with vtkImageReslice";
        return Err(SourceError::unsupported(
            path,
            "Direction",
            image.get("Direction").unwrap_or_default(),
            remedy,
        ));
    }
    let first = |axis: usize| origin[axis] + extent[2 * axis] as f64 * spacing[axis];
    checked_grid(path, dims, [first(0), first(1), first(2)], spacing)
}

impl VolumeFile for VtiFile {
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
