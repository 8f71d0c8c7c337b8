//! VTK UnstructuredGrid (`.vtu`): tetrahedra as they are, with a value at each point; of several steps a ParaView
//! collection (`.pvd`) of such files.
//!
//! Arrays are appended as raw bytes, each after a 64-bit length. Every file has the geometry, as the format asks for.

use std::path::{Path, PathBuf};

use super::ExportError;
use super::output::{PendingFile, PendingFolder};
use super::pvd::{collection_text, step_path};
use super::vti::escaped;

/// VTK's number of a tetrahedron.
const TETRAHEDRON: u8 = 10;

/// Writes steps of a variable on a mesh.
pub struct CellExport {
    name: String,
    units: String,
    times: Vec<f64>,
    num_points: usize,
    num_cells: usize,
    /// Points, connectivity, offsets and types with their lengths, as every file has them.
    geometry: Vec<u8>,
    /// Where each of them begins.
    offsets: [usize; 4],
    target: Target,
    next_step: usize,
}

enum Target {
    File(PendingFile),
    Collection { collection: PendingFile, folder: PendingFolder },
}

impl CellExport {
    /// Starts to write `path`, a `.vtu` of one step or a `.pvd` of any number.
    ///
    /// * `name`, `units`: of the variable
    /// * `times`: of the steps
    ///
    /// # Errors
    /// [`ExportError`] if the extension is of a format without cells, a `.vtu` is to hold several steps, or a file cannot be made.
    pub fn create(
        path: &Path,
        [name, units]: [&str; 2],
        times: &[f64],
        points: &[[f64; 3]],
        tetrahedra: &[[u32; 4]],
    ) -> Result<Self, ExportError> {
        let unsupported = |field, value: String, remedy: &str| {
            Err(ExportError::Unsupported { path: path.to_owned(), field, value, remedy: remedy.to_owned() })
        };
        let extension =
            path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
        let target = match extension.as_str() {
            "vtu" if times.len() > 1 => {
                let remedy = "a .vtu file holds one; export to .pvd, or one step";
                return unsupported("number of time steps", times.len().to_string(), remedy);
            }
            "vtu" => Target::File(PendingFile::create(path)?),
            "pvd" => {
                let folder = PendingFolder::create(&path.with_extension(""))?;
                Target::Collection { collection: PendingFile::create(path)?, folder }
            }
            _ => {
                let value = if extension.is_empty() { "missing".into() } else { format!(".{extension}") };
                let remedy = "cells are exported as .vtu or .pvd";
                return unsupported("extension", value, remedy);
            }
        };
        let mut geometry = Vec::new();
        let points_bytes = points.iter().flatten().flat_map(|x| x.to_le_bytes());
        let corners = tetrahedra.iter().flatten().flat_map(|&p| i64::from(p).to_le_bytes());
        let ends = (1..=tetrahedra.len() as i64).flat_map(|cell| (4 * cell).to_le_bytes());
        let offsets = [
            append(&mut geometry, 24 * points.len(), points_bytes),
            append(&mut geometry, 32 * tetrahedra.len(), corners),
            append(&mut geometry, 8 * tetrahedra.len(), ends),
            append(&mut geometry, tetrahedra.len(), std::iter::repeat_n(TETRAHEDRON, tetrahedra.len())),
        ];
        Ok(Self {
            name: name.to_owned(),
            units: units.to_owned(),
            times: times.to_vec(),
            num_points: points.len(),
            num_cells: tetrahedra.len(),
            geometry,
            offsets,
            target,
            next_step: 0,
        })
    }

    /// Writes the next step: a value per point, missing ones NaN.
    ///
    /// # Errors
    /// [`ExportError`] if it cannot be written.
    ///
    /// # Panics
    /// If all steps are written, or the number of values is not that of the points.
    pub fn write_step(&mut self, values: &[f32]) -> Result<(), ExportError> {
        assert!(self.next_step < self.times.len(), "all steps are written");
        assert_eq!(values.len(), self.num_points, "values of a step");
        let header = self.header(self.times[self.next_step]);
        let mut bytes = Vec::new();
        append(&mut bytes, 4 * values.len(), values.iter().flat_map(|v| v.to_le_bytes()));
        let parts = [header.as_bytes(), &self.geometry, &bytes, b"\n  </AppendedData>\n</VTKFile>\n"];
        match &mut self.target {
            Target::File(file) => parts.iter().try_for_each(|part| file.write(part))?,
            Target::Collection { folder, .. } => {
                let path = step_path(folder, self.next_step, self.times.len(), "vtu");
                let inside = path.file_name().expect("a file in a folder");
                let mut file = PendingFile::create(&folder.temporary().join(inside))?;
                parts.iter().try_for_each(|part| file.write(part))?;
                file.finish()?;
            }
        }
        self.next_step += 1;
        Ok(())
    }

    /// Completes the output and gives it its name.
    ///
    /// # Errors
    /// [`ExportError`] if it cannot be completed; nothing is left then.
    ///
    /// # Panics
    /// If steps are missing.
    pub fn finish(self) -> Result<(), ExportError> {
        assert_eq!(self.next_step, self.times.len(), "steps written");
        match self.target {
            Target::File(file) => file.finish(),
            Target::Collection { mut collection, folder } => {
                let path_of = |step| -> PathBuf { step_path(&folder, step, self.times.len(), "vtu") };
                collection.write(collection_text(&self.times, path_of).as_bytes())?;
                // The collection comes last: once it is there, everything that it names is.
                folder.finish()?;
                collection.finish()
            }
        }
    }

    fn header(&self, time: f64) -> String {
        let (name, units) = (escaped(&self.name), escaped(&self.units));
        let units = if units.is_empty() {
            String::new()
        } else {
            format!("<InformationKey name=\"UNITS_LABEL\" location=\"vtkDataArray\">{units}</InformationKey>")
        };
        let [points, connectivity, offsets, types] = self.offsets;
        let (num_points, num_cells, values) = (self.num_points, self.num_cells, self.geometry.len());
        format!(
            r#"<?xml version="1.0"?>
<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">
  <UnstructuredGrid>
    <FieldData>
      <DataArray type="Float64" Name="TimeValue" NumberOfTuples="1" format="ascii">{time:?}</DataArray>
    </FieldData>
    <Piece NumberOfPoints="{num_points}" NumberOfCells="{num_cells}">
      <PointData Scalars="{name}">
        <DataArray type="Float32" Name="{name}" format="appended" offset="{values}">{units}</DataArray>
      </PointData>
      <CellData></CellData>
      <Points>
        <DataArray type="Float64" Name="Points" NumberOfComponents="3" format="appended" offset="{points}"/>
      </Points>
      <Cells>
        <DataArray type="Int64" Name="connectivity" format="appended" offset="{connectivity}"/>
        <DataArray type="Int64" Name="offsets" format="appended" offset="{offsets}"/>
        <DataArray type="UInt8" Name="types" format="appended" offset="{types}"/>
      </Cells>
    </Piece>
  </UnstructuredGrid>
  <AppendedData encoding="raw">
   _"#
        )
    }
}

/// Appends an array after its length; gives where that begins.
fn append(bytes: &mut Vec<u8>, num_bytes: usize, array: impl Iterator<Item = u8>) -> usize {
    let offset = bytes.len();
    bytes.reserve(8 + num_bytes);
    bytes.extend((num_bytes as u64).to_le_bytes());
    bytes.extend(array);
    offset
}
