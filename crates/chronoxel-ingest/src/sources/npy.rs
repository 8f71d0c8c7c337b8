//! NumPy `.npy` files, versions 1 to 3: one variable, `[z, y, x]` or `[t, z, y, x]`, named after the file.
//!
//! Specification: <https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html>. Arrays in C order are
//! read slice by slice; those in Fortran order (`fortran_order: True`, so z or t fastest) are turned around on the
//! way, which takes a pass over the whole file for every [`MAX_TRANSPOSE_BYTES`] of a step, or less where memory is scarce.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use chronoxel_core::{SampleType, Samples};

use super::SourceOptions;
use super::samples::{CHUNK_BYTES, SampleFormat, SliceReader};
use super::volume_file::{
    FileHeader, FileTimes, VolumeFile, checked_grid, checked_product, checked_steps, open_at, open_regular,
};
use crate::{SourceError, StepReader, Variable};

/// The longest header that is read; that of a plain array has about 100 bytes.
const MAX_HEADER_BYTES: u64 = 1 << 16;

/// The most memory for the slices that are turned around in one pass over a file in Fortran order.
const MAX_TRANSPOSE_BYTES: u64 = 256 << 20;

/// Bytes read at a time from a file in Fortran order.
const READ_BYTES: usize = 1 << 18;

/// A `.npy` file whose length fits its shape.
struct NpyFile {
    header: FileHeader,
    sample_type: SampleType,
    big_endian: bool,
    fortran_order: bool,
    data_start: u64,
    transpose_bytes: u64,
}

/// Opens a `.npy` file.
pub(crate) fn open(path: &Path, options: &SourceOptions) -> Result<Box<dyn VolumeFile>, SourceError> {
    let (file, file_bytes) = open_regular(path)?;
    let (text, data_start) = read_header(path, file, file_bytes)?;
    let entries = Entries { path, text: &text };
    let (sample_type, big_endian) = entries.sample_type()?;
    let fortran_order = entries.fortran_order()?;
    let shape = entries.shape()?;
    let (num_steps, dims) = match shape[..] {
        [nz, ny, nx] => (1, [nx, ny, nz]),
        [nt, nz, ny, nx] => (nt, [nx, ny, nz]),
        _ => {
            let remedy = "arrays [z, y, x] and [t, z, y, x] are; reshape it in NumPy";
            return Err(SourceError::unsupported(path, "shape", format!("{shape:?}"), remedy));
        }
    };
    let num_steps = checked_steps(path, "shape[0]", num_steps)?;
    let grid = checked_grid(path, dims, [0.0; 3], [1.0; 3])?;
    let factors = shape.iter().map(|&n| n as u64).chain([sample_type.num_bytes() as u64]);
    let expected = checked_product(path, "size in bytes", factors)?.saturating_add(data_start);
    if expected != file_bytes {
        let problem = format!(
            "shape {shape:?} of {sample_type} needs {expected} bytes; the file is truncated or not one array"
        );
        return Err(SourceError::corrupt(path, "length", format!("{file_bytes} bytes"), problem));
    }
    let variable = Variable { name: String::new(), units: String::new(), sample_type, fill_value: None };
    let header = FileHeader {
        path: path.to_owned(),
        grid,
        variables: vec![variable],
        num_steps,
        times: FileTimes::Unknown,
        time_units: String::new(),
    };
    let transpose_bytes = options.buffer_bytes(MAX_TRANSPOSE_BYTES);
    Ok(Box::new(NpyFile { header, sample_type, big_endian, fortran_order, data_start, transpose_bytes }))
}

/// The header's text and where the data begin.
fn read_header(path: &Path, mut file: File, file_bytes: u64) -> Result<(String, u64), SourceError> {
    let truncated = |e| SourceError::from_read(path, "header", e);
    let mut magic = [0; 8];
    file.read_exact(&mut magic).map_err(truncated)?;
    let mut length = [0; 4];
    let length_bytes = match magic[6] {
        1 => 2,
        2 | 3 => 4,
        version => {
            return Err(SourceError::unsupported(
                path,
                "version",
                version,
                "versions 1, 2 and 3 of .npy are",
            ));
        }
    };
    file.read_exact(&mut length[..length_bytes]).map_err(truncated)?;
    let header_bytes = u64::from(u32::from_le_bytes(length));
    let data_start = 8 + length_bytes as u64 + header_bytes;
    if header_bytes > MAX_HEADER_BYTES || data_start > file_bytes {
        let problem = format!("the file has {file_bytes} bytes, and a header at most {MAX_HEADER_BYTES}");
        return Err(SourceError::corrupt(path, "header length", header_bytes, problem));
    }
    let mut text = vec![0; header_bytes as usize];
    file.read_exact(&mut text).map_err(truncated)?;
    let text = String::from_utf8(text)
        .map_err(|_| SourceError::corrupt(path, "header", "not text", "write it again"))?;
    Ok((text, data_start))
}

/// The header: a Python dictionary such as `{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4, 5), }`.
struct Entries<'a> {
    path: &'a Path,
    text: &'a str,
}

impl<'a> Entries<'a> {
    /// What follows a key and its colon.
    fn value(&self, key: &str) -> Result<&'a str, SourceError> {
        let find = |quote: char| self.text.split_once(&format!("{quote}{key}{quote}"));
        let rest = find('\'').or_else(|| find('"')).map(|(_, rest)| rest.trim_start());
        rest.and_then(|rest| rest.strip_prefix(':'))
            .map(str::trim_start)
            .ok_or_else(|| SourceError::corrupt(self.path, "header", self.text, format!("it has no {key:?}")))
    }

    /// `descr`: sample type and whether it is big-endian.
    fn sample_type(&self) -> Result<(SampleType, bool), SourceError> {
        let value = self.value("descr")?;
        let quoted = |quote: char| value.strip_prefix(quote).and_then(|rest| rest.split(quote).next());
        let Some(descr) = quoted('\'').or_else(|| quoted('"')) else {
            return Err(SourceError::unsupported(self.path, "descr", value, "arrays of plain numbers are"));
        };
        sample_type_of(descr).ok_or_else(|| {
            let remedy = "integers of 1 to 8 bytes and floats of 4 and 8 are; use array.astype";
            SourceError::unsupported(self.path, "descr", descr, remedy)
        })
    }

    /// `fortran_order`.
    fn fortran_order(&self) -> Result<bool, SourceError> {
        let value = self.value("fortran_order")?;
        match (value.starts_with("True"), value.starts_with("False")) {
            (true, _) => Ok(true),
            (_, true) => Ok(false),
            _ => Err(SourceError::corrupt(self.path, "fortran_order", value, "it must be True or False")),
        }
    }

    /// `shape`.
    fn shape(&self) -> Result<Vec<usize>, SourceError> {
        let value = self.value("shape")?;
        let wrong = || SourceError::corrupt(self.path, "shape", value, "it must be a tuple of whole numbers");
        let inner = value.strip_prefix('(').and_then(|rest| rest.split_once(')')).ok_or_else(wrong)?.0;
        let numbers = inner.split(',').map(|n| n.trim().trim_end_matches('L')).filter(|n| !n.is_empty());
        numbers.map(|n| n.parse().map_err(|_| wrong())).collect()
    }
}

/// The type behind a NumPy type string such as `<f4`, and whether it is big-endian.
pub(crate) fn sample_type_of(descr: &str) -> Option<(SampleType, bool)> {
    let (order, kind) = descr.split_at_checked(1)?;
    let big_endian = match order {
        "<" | "|" => false,
        ">" => true,
        "=" => cfg!(target_endian = "big"),
        _ => return None,
    };
    let sample_type = match kind {
        "u1" => SampleType::U8,
        "i1" => SampleType::I8,
        "u2" => SampleType::U16,
        "i2" => SampleType::I16,
        "u4" => SampleType::U32,
        "i4" => SampleType::I32,
        "u8" => SampleType::U64,
        "i8" => SampleType::I64,
        "f4" => SampleType::F32,
        "f8" => SampleType::F64,
        _ => return None,
    };
    Some((sample_type, big_endian))
}

impl VolumeFile for NpyFile {
    fn header(&self) -> &FileHeader {
        &self.header
    }

    fn working_bytes(&self) -> u64 {
        if !self.fortran_order {
            return 0;
        }
        let format = self.format(0);
        let [nx, ny, nz] = self.header.grid.dims;
        // The slices turned around; a row of them, and the bytes that it is read through.
        let row_samples = self.slab_slices(nz);
        let read_bytes = format.point_bytes().max(CHUNK_BYTES) + READ_BYTES;
        ((nx * ny + 1) * row_samples * format.held_bytes() + read_bytes) as u64
    }

    fn open_step<'a>(
        &'a mut self,
        _variable: usize,
        step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError> {
        let path = &self.header.path;
        let [nx, ny, nz] = self.header.grid.dims;
        let format = self.format(step);
        if self.fortran_order {
            return Ok(Box::new(TransposedReader {
                file: self,
                format,
                next_slice: 0,
                slab_start: 0,
                slab: format.empty(),
            }));
        }
        let step_bytes = (nx * ny * nz * format.point_bytes()) as u64;
        Ok(Box::new(SliceReader {
            input: open_at(path, self.data_start + step as u64 * step_bytes)?,
            path: path.clone(),
            field: "array".to_owned(),
            format,
            slice_samples: nx * ny,
        }))
    }
}

impl NpyFile {
    /// How the samples of a step lie.
    fn format(&self, step: usize) -> SampleFormat {
        let mut format = SampleFormat::scalar(self.sample_type, self.big_endian);
        if self.fortran_order {
            // t is the fastest axis of the file: the steps of one point lie side by side.
            format.num_components = self.header.num_steps;
            format.component = step;
        }
        format
    }

    /// Slices that one pass over a file in Fortran order turns around, of those left; at least one.
    fn slab_slices(&self, slices_left: usize) -> usize {
        let [nx, ny, _] = self.header.grid.dims;
        let slice_bytes = (nx * ny * self.format(0).held_bytes()) as u64;
        (self.transpose_bytes / slice_bytes).clamp(1, slices_left as u64) as usize
    }
}

/// Reads a step of an array in which z is faster than y, and y faster than x.
struct TransposedReader<'a> {
    file: &'a NpyFile,
    format: SampleFormat,
    next_slice: usize,
    /// The first slice of `slab`.
    slab_start: usize,
    /// Slices already turned around.
    slab: Samples,
}

impl StepReader for TransposedReader<'_> {
    fn read_slices(&mut self, num_slices: usize) -> Result<Samples, SourceError> {
        let [nx, ny, _] = self.file.header.grid.dims;
        let mut out = self.format.empty();
        for _ in 0..num_slices {
            if (self.next_slice - self.slab_start) * nx * ny >= self.slab.len() {
                self.read_slab()?;
            }
            let at = (self.next_slice - self.slab_start) * nx * ny;
            match (&mut out, &self.slab) {
                (Samples::F32(out), Samples::F32(slab)) => out.extend_from_slice(&slab[at..at + nx * ny]),
                (Samples::F64(out), Samples::F64(slab)) => out.extend_from_slice(&slab[at..at + nx * ny]),
                _ => unreachable!("both are of the kind that the sample type becomes"),
            }
            self.next_slice += 1;
        }
        Ok(out)
    }
}

impl TransposedReader<'_> {
    /// Turns around as many slices from the next one on as the memory allows.
    fn read_slab(&mut self) -> Result<(), SourceError> {
        let [nx, ny, nz] = self.file.header.grid.dims;
        let path = &self.file.header.path;
        let num_slices = self.file.slab_slices(nz - self.next_slice);
        self.slab_start = self.next_slice;
        // The slab before goes first: there is memory for one.
        self.slab = self.format.empty();
        let num_samples = num_slices * nx * ny;
        let mut slab = match self.format.empty() {
            Samples::F32(_) => Samples::F32(vec![0.0; num_samples]),
            Samples::F64(_) => Samples::F64(vec![0.0; num_samples]),
        };
        let point_bytes = self.format.point_bytes();
        let before = (self.next_slice * point_bytes) as i64;
        let after = ((nz - self.next_slice - num_slices) * point_bytes) as i64;
        let input = BufReader::with_capacity(READ_BYTES, open_at(path, self.file.data_start)?);
        let mut row_reader = SliceReader {
            input,
            path: path.clone(),
            field: "array".to_owned(),
            format: self.format,
            slice_samples: num_slices,
        };
        for x in 0..nx {
            for y in 0..ny {
                skip(&mut row_reader, before)?;
                let row = row_reader.read_slices(1)?;
                let places = (0..num_slices).map(|z| (z * ny + y) * nx + x);
                match (&mut slab, &row) {
                    (Samples::F32(to), Samples::F32(row)) => places.zip(row).for_each(|(at, v)| to[at] = *v),
                    (Samples::F64(to), Samples::F64(row)) => places.zip(row).for_each(|(at, v)| to[at] = *v),
                    _ => unreachable!("both are of the kind that the sample type becomes"),
                }
                skip(&mut row_reader, after)?;
            }
        }
        self.slab = slab;
        Ok(())
    }
}

/// Passes over bytes of a file.
fn skip(reader: &mut SliceReader<BufReader<File>>, num_bytes: i64) -> Result<(), SourceError> {
    reader.input.seek_relative(num_bytes).map_err(|e| SourceError::io(&reader.path, "seek in", e))
}
