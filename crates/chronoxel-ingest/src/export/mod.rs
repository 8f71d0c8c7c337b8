//! Writers of decoded steps in the formats that other programs read, one file per format.
//!
//! | extension | what is written |
//! | --- | --- |
//! | `.vti` | VTK ImageData of one step, appended raw, with its time |
//! | `.pvd` | a ParaView collection, its steps as `.vti` in a folder of the same name beside it |
//! | `.vtu` | of a store of cells ([`CellExport`]): VTK UnstructuredGrid of one step, appended raw; a `.pvd` of several |
//! | `.npy` | a NumPy array `[z, y, x]` of one step, `[t, z, y, x]` of several |
//! | `.nrrd` | a raw NRRD, 3-D of one step, 4-D of several |
//! | `.zarr` | a Zarr v3 group: the variable as `[t, z, y, x]`, and coordinates `t`, `z`, `y`, `x` |
//!
//! Output is streamed to a temporary name beside the final one, and renamed when it is complete: a failure
//! leaves nothing under the final name. Values are little endian. In integer types they are rounded (halves away
//! from zero) and clamped to what the type holds; missing samples (NaN) become the fill value, and are an error
//! where there is none.

mod error;
mod npy;
mod nrrd;
mod output;
mod pvd;
mod sample_bytes;
mod vti;
mod vtu;
mod zarr;

use std::path::Path;

use chronoxel_core::{SampleType, TimeAxis, UniformGrid};

pub use error::ExportError;
pub use vtu::CellExport;

/// What is exported: one variable at some steps.
#[derive(Debug, Clone, PartialEq)]
pub struct ExportDescription {
    /// The grid of every step.
    pub grid: UniformGrid,
    /// Times of the exported steps.
    pub times: TimeAxis,
    /// Name of the variable.
    pub name: String,
    /// Its units; empty where they are not known.
    pub units: String,
    /// The type to write.
    pub sample_type: SampleType,
    /// What stands for a missing sample in an integer type.
    pub fill_value: Option<f64>,
}

/// Writes the steps of an export in order.
pub trait StepWriter: Send {
    /// Writes the next step; missing samples are NaN.
    ///
    /// * `step`: counted within the exported ones
    /// * `samples`: `[z, y, x]`
    ///
    /// # Errors
    /// [`ExportError`] if it cannot be written, or a sample is missing and the type has no value for that.
    ///
    /// # Panics
    /// If `step` is not the next one, or the number of samples is not that of the grid.
    fn write_step(&mut self, step: usize, samples: &[f64]) -> Result<(), ExportError>;

    /// Completes the output and gives it its name.
    ///
    /// # Errors
    /// [`ExportError`] if it cannot be completed; nothing is left then.
    ///
    /// # Panics
    /// If steps are missing.
    fn finish(self: Box<Self>) -> Result<(), ExportError>;
}

/// Starts to write `path` in the format that its extension names.
///
/// # Errors
/// [`ExportError`] if the extension is not known, the format cannot hold the export, or the file cannot be made.
pub fn create(path: &Path, description: &ExportDescription) -> Result<Box<dyn StepWriter>, ExportError> {
    check_fill_value(path, description)?;
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    Ok(match extension.as_str() {
        "vti" => Box::new(vti::VtiWriter::create(path, description)?),
        "pvd" => Box::new(pvd::PvdWriter::create(path, description)?),
        "npy" => Box::new(npy::create(path, description)?),
        "nrrd" => Box::new(nrrd::create(path, description)?),
        "zarr" => Box::new(zarr::ZarrWriter::create(path, description)?),
        _ => {
            return Err(ExportError::Unsupported {
                path: path.to_owned(),
                field: "extension",
                value: if extension.is_empty() { "missing".to_owned() } else { format!(".{extension}") },
                remedy: "name the output .vti, .pvd, .npy, .nrrd or .zarr".to_owned(),
            });
        }
    })
}

/// A fill value that an integer type does not hold would be clamped to a value that is not missing.
fn check_fill_value(path: &Path, description: &ExportDescription) -> Result<(), ExportError> {
    let Some(value) = description.fill_value.filter(|_| description.sample_type.is_integer()) else {
        return Ok(());
    };
    if sample_bytes::holds(description.sample_type, value) {
        return Ok(());
    }
    Err(ExportError::Unsupported {
        path: path.to_owned(),
        field: "fill value",
        value: value.to_string(),
        remedy: format!("{} does not hold it; export f32 or f64", description.sample_type),
    })
}

/// Holds a caller to the order and the size of the steps.
fn check_step(description: &ExportDescription, next: usize, step: usize, samples: &[f64]) {
    assert!(step == next && step < description.times.num_steps(), "step {step} where {next} is next");
    assert_eq!(samples.len(), description.grid.num_samples(), "samples of a step");
}
