//! VTK ImageData (`.vti`): one step, its samples appended as raw bytes after a 64-bit length.

use std::path::Path;

use chronoxel_core::SampleType;

use super::output::PendingFile;
use super::sample_bytes::sample_bytes;
use super::{ExportDescription, ExportError, StepWriter, check_step};

/// A file of one step.
pub(super) struct VtiWriter {
    description: ExportDescription,
    file: PendingFile,
    is_written: bool,
}

impl VtiWriter {
    pub fn create(path: &Path, description: &ExportDescription) -> Result<Self, ExportError> {
        if description.times.num_steps() > 1 {
            return Err(ExportError::Unsupported {
                path: path.to_owned(),
                field: "number of time steps",
                value: description.times.num_steps().to_string(),
                remedy: "a .vti file holds one; export to .pvd, or one step".to_owned(),
            });
        }
        let file = PendingFile::create(path)?;
        Ok(Self { description: description.clone(), file, is_written: false })
    }
}

impl StepWriter for VtiWriter {
    fn write_step(&mut self, step: usize, samples: &[f64]) -> Result<(), ExportError> {
        check_step(&self.description, usize::from(self.is_written), step, samples);
        let bytes = sample_bytes(self.file.path(), &self.description, step, samples)?;
        self.is_written = true;
        write_image(&mut self.file, &self.description, self.description.times.times[0], &bytes)
    }

    fn finish(self: Box<Self>) -> Result<(), ExportError> {
        assert!(self.is_written, "the step was not written");
        self.file.finish()
    }
}

/// The whole of a `.vti` file.
pub(super) fn write_image(
    file: &mut PendingFile,
    description: &ExportDescription,
    time: f64,
    bytes: &[u8],
) -> Result<(), ExportError> {
    file.write(header(description, time).as_bytes())?;
    file.write(&(bytes.len() as u64).to_le_bytes())?;
    file.write(bytes)?;
    file.write(b"\n  </AppendedData>\n</VTKFile>\n")
}

fn header(description: &ExportDescription, time: f64) -> String {
    let grid = &description.grid;
    let extent: Vec<String> = grid.dims.iter().map(|n| format!("0 {}", n - 1)).collect();
    let extent = extent.join(" ");
    let three = |v: [f64; 3]| format!("{:?} {:?} {:?}", v[0], v[1], v[2]);
    let (origin, spacing) = (three(grid.origin), three(grid.spacing));
    let (name, units) = (escaped(&description.name), escaped(&description.units));
    let kind = type_name(description.sample_type);
    let units = if units.is_empty() {
        String::new()
    } else {
        format!("<InformationKey name=\"UNITS_LABEL\" location=\"vtkDataArray\">{units}</InformationKey>")
    };
    format!(
        r#"<?xml version="1.0"?>
<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">
  <ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{spacing}" Direction="1 0 0 0 1 0 0 0 1">
    <FieldData>
      <DataArray type="Float64" Name="TimeValue" NumberOfTuples="1" format="ascii">{time:?}</DataArray>
    </FieldData>
    <Piece Extent="{extent}">
      <PointData Scalars="{name}">
        <DataArray type="{kind}" Name="{name}" format="appended" offset="0">{units}</DataArray>
      </PointData>
      <CellData></CellData>
    </Piece>
  </ImageData>
  <AppendedData encoding="raw">
   _"#
    )
}

/// VTK's name of a sample type.
fn type_name(sample_type: SampleType) -> &'static str {
    match sample_type {
        SampleType::U8 => "UInt8",
        SampleType::I8 => "Int8",
        SampleType::U16 => "UInt16",
        SampleType::I16 => "Int16",
        SampleType::U32 => "UInt32",
        SampleType::I32 => "Int32",
        SampleType::U64 => "UInt64",
        SampleType::I64 => "Int64",
        SampleType::F32 => "Float32",
        SampleType::F64 => "Float64",
    }
}

/// Text inside XML; control characters, which XML cannot hold, become spaces.
pub(super) fn escaped(text: &str) -> String {
    text.chars()
        .map(|c| match c {
            '&' => "&amp;".to_owned(),
            '<' => "&lt;".to_owned(),
            '>' => "&gt;".to_owned(),
            '"' => "&quot;".to_owned(),
            c if c.is_control() => " ".to_owned(),
            c => c.to_string(),
        })
        .collect()
}
