//! NumPy arrays (`.npy`), version 1.0: <https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html>.

use std::path::Path;

use chronoxel_core::SampleType;

use super::output::PendingFile;
use super::sample_bytes::sample_bytes;
use super::{ExportDescription, ExportError, StepWriter, check_step};

/// A header, then the bytes of step after step.
pub(super) struct PlainWriter {
    description: ExportDescription,
    file: PendingFile,
    next_step: usize,
}

impl PlainWriter {
    pub fn create(path: &Path, description: &ExportDescription, header: &[u8]) -> Result<Self, ExportError> {
        let mut file = PendingFile::create(path)?;
        file.write(header)?;
        Ok(Self { description: description.clone(), file, next_step: 0 })
    }
}

impl StepWriter for PlainWriter {
    fn write_step(&mut self, step: usize, samples: &[f64]) -> Result<(), ExportError> {
        check_step(&self.description, self.next_step, step, samples);
        let bytes = sample_bytes(self.file.path(), &self.description, step, samples)?;
        self.file.write(&bytes)?;
        self.next_step += 1;
        Ok(())
    }

    fn finish(self: Box<Self>) -> Result<(), ExportError> {
        assert_eq!(self.next_step, self.description.times.num_steps(), "steps written");
        self.file.finish()
    }
}

/// Starts a `.npy` file.
pub(super) fn create(path: &Path, description: &ExportDescription) -> Result<PlainWriter, ExportError> {
    PlainWriter::create(path, description, &header(description))
}

fn header(description: &ExportDescription) -> Vec<u8> {
    let [nx, ny, nz] = description.grid.dims;
    let steps = match description.times.num_steps() {
        1 => String::new(),
        n => format!("{n}, "),
    };
    let kind = match description.sample_type {
        t if !t.is_integer() => 'f',
        SampleType::I8 | SampleType::I16 | SampleType::I32 | SampleType::I64 => 'i',
        _ => 'u',
    };
    let size = description.sample_type.num_bytes();
    let order = if size == 1 { '|' } else { '<' };
    let mut text = format!(
        "{{'descr': '{order}{kind}{size}', 'fortran_order': False, 'shape': ({steps}{nz}, {ny}, {nx}), }}"
    );
    // Magic, version and length are 10 bytes; the whole is a multiple of 64 and ends in a new line.
    let padded = (10 + text.len() + 1).next_multiple_of(64) - 10;
    text.extend(std::iter::repeat_n(' ', padded - 1 - text.len()));
    text.push('\n');
    let mut header = b"\x93NUMPY\x01\x00".to_vec();
    header.extend((padded as u16).to_le_bytes());
    header.extend(text.as_bytes());
    header
}
