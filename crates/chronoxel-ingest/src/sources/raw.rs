//! Raw binary files: samples and nothing else, `[z, y, x]`, after an optional header of known length.
//!
//! The caller gives dimensions, sample type and byte order; a file holds exactly one step of one variable.

use std::path::Path;

use super::SourceOptions;
use super::samples::{SampleFormat, SliceReader};
use super::volume_file::{
    FileHeader, FileTimes, VolumeFile, checked_grid, checked_product, dims_text, open_at, open_regular,
};
use crate::{SourceError, StepReader, Variable};

/// A raw file whose length fits its dimensions.
struct RawFile {
    header: FileHeader,
    format: SampleFormat,
    header_bytes: u64,
}

/// Opens a raw file.
pub(crate) fn open(path: &Path, options: &SourceOptions) -> Result<Box<dyn VolumeFile>, SourceError> {
    let missing = |option| {
        let remedy =
            format!("{} is raw binary; say what is in it, as in --dims 64x64x64 --dtype f32", path.display());
        SourceError::argument(option, "is missing", remedy)
    };
    let dims = options.dims.ok_or_else(|| missing("--dims"))?;
    let sample_type = options.sample_type.ok_or_else(|| missing("--dtype"))?;
    let (_, file_bytes) = open_regular(path)?;
    let format = SampleFormat::scalar(sample_type, options.big_endian);
    let grid = checked_grid(path, dims, [0.0; 3], [1.0; 3])?;
    let factors = dims.map(|n| n as u64).into_iter().chain([format.point_bytes() as u64]);
    let data_bytes = checked_product(path, "size in bytes", factors)?;
    let expected = data_bytes.saturating_add(options.header_bytes);
    if file_bytes != expected {
        let dims = dims_text(dims);
        let header = match options.header_bytes {
            0 => String::new(),
            n => format!(" after a header of {n} bytes"),
        };
        let problem = format!(
            "{dims} samples of {sample_type}{header} need {expected} bytes; check --dims and --dtype"
        );
        return Err(SourceError::corrupt(path, "length", format!("{file_bytes} bytes"), problem));
    }
    let variable = Variable { name: String::new(), units: String::new(), sample_type, fill_value: None };
    let header = FileHeader {
        path: path.to_owned(),
        grid,
        variables: vec![variable],
        num_steps: 1,
        times: FileTimes::Unknown,
        time_units: String::new(),
    };
    Ok(Box::new(RawFile { header, format, header_bytes: options.header_bytes }))
}

impl VolumeFile for RawFile {
    fn header(&self) -> &FileHeader {
        &self.header
    }

    fn open_step<'a>(
        &'a mut self,
        _variable: usize,
        _step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError> {
        let [nx, ny, _] = self.header.grid.dims;
        Ok(Box::new(SliceReader {
            input: open_at(&self.header.path, self.header_bytes)?,
            path: self.header.path.clone(),
            field: "samples".to_owned(),
            format: self.format,
            slice_samples: nx * ny,
        }))
    }
}
