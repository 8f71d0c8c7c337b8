//! How a PLOT3D file lies in its bytes: found from its length and first numbers, as nothing in it says so.
//!
//! A file is one of many forms: numbers of 4 or 8 bytes, in either byte order, with or without the record marks of Fortran, one block or several
//! after their number, positions with or without IBLANK. Each form needs a length of its own for the dimensions that it begins with,
//! so that as a rule one alone fits. Zeros after the data, up to the end of a disk block, are let pass.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use chronoxel_core::SampleType;

use super::SourceOptions;
use super::volume_file::{dims_text, open_regular};
use crate::SourceError;
use crate::mesh::MAX_POINTS;

/// More blocks than any grid has.
const MAX_BLOCKS: u64 = 1 << 16;

/// The most zeros after the data.
const MAX_PADDING: u64 = 4096;

/// Numbers before the flow of a block: Mach number, angle of attack, Reynolds number, time.
pub(crate) const NUM_CONDITIONS: u64 = 4;

/// What a file holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Content {
    /// Positions: x, y, z of all points of a block, and perhaps IBLANK.
    Grid,
    /// Density, momentum along x, y, z and energy of all points of a block, after four numbers.
    Solution,
}

impl Content {
    fn name(self) -> &'static str {
        match self {
            Self::Grid => "grid",
            Self::Solution => "solution",
        }
    }
}

/// How a file lies in its bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Layout {
    pub path: PathBuf,
    pub big_endian: bool,
    /// Of positions and flow; dimensions and IBLANK have 4 bytes always.
    pub sample_type: SampleType,
    /// Whether every record stands between marks with its length.
    pub has_records: bool,
    /// Whether the number of blocks comes first.
    pub is_counted: bool,
    /// Only in grids.
    pub has_iblank: bool,
    /// Points of each block along its axes.
    pub blocks: Vec<[usize; 3]>,
    /// Per block: where its positions or its flow begin; a solution's conditions lie before.
    pub starts: Vec<u64>,
}

impl Layout {
    /// Finds the layout of a file with a content.
    ///
    /// Where several fit, `--dtype` and `--big-endian` choose.
    pub fn find(path: &Path, content: Content, options: &SourceOptions) -> Result<Self, SourceError> {
        let (mut file, file_bytes) = open_regular(path)?;
        let mut seen = Vec::new();
        let mut found: Vec<(u64, Self)> = Vec::new();
        for (big_endian, has_records, is_counted) in forms() {
            let head = Head { path, file: &mut file, file_bytes, big_endian, has_records };
            let Some(blocks) = head.blocks(is_counted)? else { continue };
            for (sample_type, has_iblank) in numbers_of(content) {
                let layout = Self {
                    path: path.to_owned(),
                    big_endian,
                    sample_type,
                    has_records,
                    is_counted,
                    has_iblank,
                    blocks: blocks.clone(),
                    starts: Vec::new(),
                };
                let (layout, expected) = layout.placed(content);
                if seen.len() < 4 && !seen.iter().any(|(dims, _)| *dims == blocks[0]) {
                    seen.push((blocks[0], expected));
                }
                let padding = file_bytes.checked_sub(expected).filter(|p| *p <= MAX_PADDING);
                if let Some(padding) = padding
                    && layout.marks_fit(&mut file, content)?
                    && is_zero(path, &mut file, expected)?
                {
                    found.push((padding, layout));
                }
            }
        }
        let least = found.iter().map(|(padding, _)| *padding).min();
        found.retain(|(padding, layout)| Some(*padding) == least && layout.is_wanted(options));
        match &found[..] {
            [_] => Ok(found.remove(0).1),
            [] => Err(fits_none(path, content, file_bytes, &seen)),
            _ => Err(fits_several(path, content, &found)),
        }
    }

    /// Whether the layout is what the caller says.
    fn is_wanted(&self, options: &SourceOptions) -> bool {
        options.sample_type.is_none_or(|wanted| wanted == self.sample_type)
            && (self.big_endian || !options.big_endian)
    }

    /// Bytes of a record mark.
    fn mark(&self) -> u64 {
        if self.has_records { 4 } else { 0 }
    }

    /// Bytes of one number.
    fn width(&self) -> u64 {
        self.sample_type.num_bytes() as u64
    }

    /// Points of a block.
    pub fn num_points(&self, block: usize) -> u64 {
        self.blocks[block].iter().map(|&n| n as u64).product()
    }

    /// The records of the file in order: bytes of each.
    fn records(&self, content: Content) -> Vec<u64> {
        let mut records = Vec::new();
        if self.is_counted {
            records.push(4);
        }
        records.push(12 * self.blocks.len() as u64);
        for block in 0..self.blocks.len() {
            let num_points = self.num_points(block);
            match content {
                Content::Grid => {
                    records.push(num_points * (3 * self.width() + if self.has_iblank { 4 } else { 0 }));
                }
                Content::Solution => {
                    records.push(NUM_CONDITIONS * self.width());
                    records.push(num_points * 5 * self.width());
                }
            }
        }
        records
    }

    /// Fills in where the blocks begin; also gives the bytes of the whole file.
    fn placed(mut self, content: Content) -> (Self, u64) {
        let per_block = if content == Content::Grid { 1 } else { 2 };
        let num_before = 1 + usize::from(self.is_counted);
        let mut position = 0;
        for (index, bytes) in self.records(content).into_iter().enumerate() {
            let is_last_of_block = index >= num_before && (index - num_before) % per_block == per_block - 1;
            if is_last_of_block {
                self.starts.push(position + self.mark());
            }
            position += bytes + 2 * self.mark();
        }
        (self, position)
    }

    /// Whether every record has its length before and behind it.
    fn marks_fit(&self, file: &mut File, content: Content) -> Result<bool, SourceError> {
        if !self.has_records {
            return Ok(true);
        }
        let mut position = 0;
        for bytes in self.records(content) {
            for place in [position, position + 4 + bytes] {
                let mark = integer_at(&self.path, file, place, self.big_endian)?;
                if u64::from(mark) != bytes {
                    return Ok(false);
                }
            }
            position += bytes + 8;
        }
        Ok(true)
    }

    /// The form in words.
    fn text(&self) -> String {
        format!(
            "{}, {}, {}{}{}",
            self.sample_type,
            if self.big_endian { "big-endian" } else { "little-endian" },
            if self.is_counted { "with a number of blocks" } else { "one block" },
            if self.has_records { ", with record marks" } else { "" },
            if self.has_iblank { ", with IBLANK" } else { "" },
        )
    }
}

/// Every byte order, with and without records, with and without a number of blocks.
fn forms() -> impl Iterator<Item = (bool, bool, bool)> {
    (0..8).map(|bits| (bits & 1 != 0, bits & 2 != 0, bits & 4 != 0))
}

/// Types of numbers, with and without IBLANK where there may be some.
fn numbers_of(content: Content) -> impl Iterator<Item = (SampleType, bool)> {
    let num_forms = if content == Content::Grid { 4 } else { 2 };
    (0..num_forms).map(|bits| (if bits & 1 == 0 { SampleType::F32 } else { SampleType::F64 }, bits & 2 != 0))
}

/// The first numbers of a file in some form.
struct Head<'a> {
    path: &'a Path,
    file: &'a mut File,
    file_bytes: u64,
    big_endian: bool,
    has_records: bool,
}

impl Head<'_> {
    fn integer(&mut self, position: u64) -> Result<Option<u64>, SourceError> {
        if position.saturating_add(4) > self.file_bytes {
            return Ok(None);
        }
        Ok(Some(u64::from(integer_at(self.path, self.file, position, self.big_endian)?)))
    }

    /// The dimensions of the blocks; `None` if the numbers cannot be that.
    fn blocks(mut self, is_counted: bool) -> Result<Option<Vec<[usize; 3]>>, SourceError> {
        let mark = if self.has_records { 4 } else { 0 };
        let (mut position, mut num_blocks) = (mark, 1);
        if is_counted {
            match self.integer(position)? {
                Some(count @ 1..=MAX_BLOCKS) if count * 12 <= self.file_bytes => num_blocks = count,
                _ => return Ok(None),
            }
            position += 4 + 2 * mark;
        }
        let (mut blocks, mut num_points) = (Vec::new(), 0u64);
        for _ in 0..num_blocks {
            let mut dims = [0; 3];
            for n in &mut dims {
                match self.integer(position)? {
                    // A point takes more than a byte.
                    Some(count) if (1..=self.file_bytes).contains(&count) => *n = count as usize,
                    _ => return Ok(None),
                }
                position += 4;
            }
            let points = dims.iter().try_fold(1u64, |product, &n| product.checked_mul(n as u64));
            match points.and_then(|points| points.checked_add(num_points)) {
                Some(total) if total <= self.file_bytes.min(MAX_POINTS) => num_points = total,
                _ => return Ok(None),
            }
            blocks.push(dims);
        }
        Ok(Some(blocks))
    }
}

/// Four bytes of a file as an integer.
fn integer_at(path: &Path, file: &mut File, position: u64, big_endian: bool) -> Result<u32, SourceError> {
    let mut bytes = [0; 4];
    file.seek(SeekFrom::Start(position)).map_err(|e| SourceError::io(path, "seek in", e))?;
    file.read_exact(&mut bytes).map_err(|e| SourceError::io(path, "read", e))?;
    Ok(if big_endian { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) })
}

/// Whether nothing but zeros comes from a position on; few bytes are left there.
fn is_zero(path: &Path, file: &mut File, position: u64) -> Result<bool, SourceError> {
    let mut bytes = Vec::new();
    file.seek(SeekFrom::Start(position)).map_err(|e| SourceError::io(path, "seek in", e))?;
    file.take(MAX_PADDING).read_to_end(&mut bytes).map_err(|e| SourceError::io(path, "read", e))?;
    Ok(bytes.iter().all(|byte| *byte == 0))
}

/// The error for a file whose length fits no form; `seen` are dimensions it could begin with, and what they would need.
fn fits_none(path: &Path, content: Content, file_bytes: u64, seen: &[([usize; 3], u64)]) -> SourceError {
    let candidates: Vec<String> =
        seen.iter().map(|(dims, bytes)| format!("{} would need {bytes} as f32", dims_text(*dims))).collect();
    let begins = match candidates.is_empty() {
        true => "its first numbers are no dimensions of a 3-D grid in binary".to_owned(),
        false => candidates.join(", "),
    };
    let problem = format!(
        "no binary PLOT3D {} in whole format has this length: {begins}; check --dtype and --big-endian where given, or write it again",
        content.name()
    );
    SourceError::corrupt(path, "length", format!("{file_bytes} bytes"), problem)
}

/// The error for a file that fits several forms.
fn fits_several(path: &Path, content: Content, found: &[(u64, Layout)]) -> SourceError {
    let forms: Vec<String> = found.iter().map(|(_, layout)| layout.text()).collect();
    let problem = format!(
        "the length of this {} fits them all; choose with --dtype f32, --dtype f64 or --big-endian",
        content.name()
    );
    SourceError::corrupt(path, "PLOT3D form", forms.join(" or "), problem)
}
