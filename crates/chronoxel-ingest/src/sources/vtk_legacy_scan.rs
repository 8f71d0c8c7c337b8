//! What a legacy VTK file holds and where: one pass over its lines, values being passed over.

use std::collections::HashSet;
use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};

use chronoxel_core::SampleType;

use super::volume_file::{checked_product, open_regular};
use super::vtk_arrays::{Array, GHOSTS};
use super::vtk_data::Place;
use crate::{SourceError, Variable};

/// The longest line of words.
const MAX_LINE_BYTES: u64 = 1 << 16;

/// More arrays than any field has.
const MAX_ARRAYS: u64 = 1 << 16;

/// More components than any array has.
const MAX_COMPONENTS: u64 = 256;

/// The data sets that are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DataSet {
    StructuredPoints,
    StructuredGrid,
    RectilinearGrid,
    UnstructuredGrid,
}

/// Where the cells of a file are.
pub(crate) enum LegacyCells {
    /// Each with its number of corners before them.
    Counted(Array),
    /// Ends of the corners of each cell after a zero, and the corners.
    Offsets { offsets: Array, connectivity: Array },
}

/// What was found in a file.
pub(crate) struct Legacy {
    pub path: PathBuf,
    pub data_set: DataSet,
    pub dims: Option<[usize; 3]>,
    pub origin: Option<[f64; 3]>,
    pub spacing: Option<[f64; 3]>,
    /// Positions of the points.
    pub points: Option<Array>,
    /// Coordinates along x, y, z.
    pub axes: [Option<Array>; 3],
    pub cells: Option<LegacyCells>,
    pub cell_types: Option<Array>,
    /// Points that the point data are for.
    pub num_point_data: Option<u64>,
    pub variables: Vec<Variable>,
    /// Per variable: where it is.
    pub arrays: Vec<Array>,
    pub has_cell_data: bool,
    /// Flags of points and of cells.
    pub ghosts: [Option<Array>; 2],
    /// The number in a field array `TIME` or `TimeValue`.
    pub time: Option<Array>,
    /// The number in a field array `CYCLE` or `TimeStep`.
    pub cycle: Option<Array>,
}

/// Whose attributes are being read.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Section {
    DataSet,
    Points(u64),
    Cells(u64),
}

/// Goes through a file.
struct Scanner {
    path: PathBuf,
    input: BufReader<File>,
    position: u64,
    file_bytes: u64,
    is_binary: bool,
    is_version_5: bool,
    section: Section,
    names: HashSet<String>,
}

impl Legacy {
    /// Scans a file.
    pub fn read(path: &Path) -> Result<Self, SourceError> {
        let (file, file_bytes) = open_regular(path)?;
        let mut scanner = Scanner {
            path: path.to_owned(),
            input: BufReader::with_capacity(1 << 16, file),
            position: 0,
            file_bytes,
            is_binary: false,
            is_version_5: false,
            section: Section::DataSet,
            names: HashSet::new(),
        };
        let mut legacy = scanner.preamble()?;
        while let Some(words) = scanner.words()? {
            scanner.take(&mut legacy, &words)?;
        }
        Ok(legacy)
    }
}

impl Scanner {
    fn corrupt(&self, field: impl Into<String>, value: impl ToString, problem: &str) -> SourceError {
        SourceError::corrupt(&self.path, field, value, problem)
    }

    /// The next line without its end; `None` at the end of the file.
    fn line(&mut self) -> Result<Option<String>, SourceError> {
        let mut line = Vec::new();
        let read = (&mut self.input)
            .take(MAX_LINE_BYTES)
            .read_until(b'\n', &mut line)
            .map_err(|e| SourceError::io(&self.path, "read", e))?;
        self.position += read as u64;
        if read as u64 == MAX_LINE_BYTES {
            return Err(self.corrupt("line", String::from_utf8_lossy(&line), "it has no end within 64 KiB"));
        }
        Ok((read > 0).then(|| String::from_utf8_lossy(&line).trim_end().to_owned()))
    }

    /// The words of the next line that has any.
    fn words(&mut self) -> Result<Option<Vec<String>>, SourceError> {
        while let Some(line) = self.line()? {
            let words: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
            if !words.is_empty() {
                return Ok(Some(words));
            }
        }
        Ok(None)
    }

    /// The words of a line that must be there.
    fn needed_words(&mut self, field: &str) -> Result<Vec<String>, SourceError> {
        self.words()?.ok_or_else(|| self.corrupt(field, "missing", "the file is truncated"))
    }

    /// The first lines, up to the type of the data set.
    fn preamble(&mut self) -> Result<Legacy, SourceError> {
        let first = self.line()?.unwrap_or_default();
        let version = first.strip_prefix("# vtk DataFile Version ").unwrap_or_default().trim();
        let major = version.split('.').next().and_then(|major| major.parse::<u32>().ok());
        let Some(major) = major.filter(|major| (1..=5).contains(major)) else {
            return Err(self.corrupt("first line", first, "it must be # vtk DataFile Version 1.0 to 5.1"));
        };
        self.is_version_5 = major == 5;
        self.line()?;
        let encoding = self.needed_words("ASCII or BINARY")?;
        self.is_binary = match encoding[0].to_uppercase().as_str() {
            "ASCII" => false,
            "BINARY" => true,
            _ => return Err(self.corrupt("third line", &encoding[0], "it must be ASCII or BINARY")),
        };
        let words = self.needed_words("DATASET")?;
        let name = words.get(1).map(|name| name.to_uppercase()).unwrap_or_default();
        let data_set = match (words[0].to_uppercase().as_str(), name.as_str()) {
            ("DATASET", "STRUCTURED_POINTS") => DataSet::StructuredPoints,
            ("DATASET", "STRUCTURED_GRID") => DataSet::StructuredGrid,
            ("DATASET", "RECTILINEAR_GRID") => DataSet::RectilinearGrid,
            ("DATASET", "UNSTRUCTURED_GRID") => DataSet::UnstructuredGrid,
            ("DATASET", _) => {
                let remedy = "STRUCTURED_POINTS, STRUCTURED_GRID, RECTILINEAR_GRID and UNSTRUCTURED_GRID are";
                return Err(SourceError::unsupported(&self.path, "DATASET", name, remedy));
            }
            _ => return Err(self.corrupt("fourth line", &words[0], "it must begin with DATASET")),
        };
        Ok(Legacy {
            path: self.path.clone(),
            data_set,
            dims: None,
            origin: None,
            spacing: None,
            points: None,
            axes: [const { None }; 3],
            cells: None,
            cell_types: None,
            num_point_data: None,
            variables: Vec::new(),
            arrays: Vec::new(),
            has_cell_data: false,
            ghosts: [const { None }; 2],
            time: None,
            cycle: None,
        })
    }

    /// The word at a place of a line, as a number.
    fn number<T: std::str::FromStr>(&self, words: &[String], place: usize) -> Result<T, SourceError> {
        let word = words.get(place).map_or("missing", String::as_str);
        word.parse().map_err(|_| self.corrupt(&words[0], word, "it must be a number; the file is damaged"))
    }

    /// Three numbers behind the first word of a line.
    fn three<T: std::str::FromStr>(&self, words: &[String]) -> Result<[T; 3], SourceError> {
        Ok([self.number(words, 1)?, self.number(words, 2)?, self.number(words, 3)?])
    }

    /// The type that a word of a line names.
    fn sample_type(&self, words: &[String], place: usize) -> Result<SampleType, SourceError> {
        let word = words.get(place).map_or("missing", String::as_str);
        Ok(match word.to_lowercase().as_str() {
            "unsigned_char" => SampleType::U8,
            "char" | "signed_char" => SampleType::I8,
            "unsigned_short" => SampleType::U16,
            "short" => SampleType::I16,
            "unsigned_int" => SampleType::U32,
            // Identifiers are written with 32 bits, whatever they are in memory.
            "int" | "vtkidtype" => SampleType::I32,
            "unsigned_long" | "vtktypeuint64" => SampleType::U64,
            "long" | "vtktypeint64" => SampleType::I64,
            "float" => SampleType::F32,
            "double" => SampleType::F64,
            _ => {
                let remedy = "char to unsigned_long, float and double are";
                return Err(SourceError::unsupported(
                    &self.path,
                    format!("type of {}", words[0]),
                    word,
                    remedy,
                ));
            }
        })
    }

    /// Passes over the values of an array that begin here.
    fn values(
        &mut self,
        field: &str,
        sample_type: SampleType,
        factors: [u64; 2],
    ) -> Result<Array, SourceError> {
        let num_values = checked_product(&self.path, field, factors)?;
        let num_bytes = checked_product(&self.path, field, [num_values, sample_type.num_bytes() as u64])?;
        let start = self.position;
        let range = match self.is_binary {
            true => self.skip_bytes(field, num_bytes)?,
            false => self.skip_tokens(field, num_values)?,
        };
        debug_assert_eq!(range.start, start);
        let place = if self.is_binary { Place::Bare(range) } else { Place::Ascii(range) };
        Ok(Array::in_legacy_file(place, sample_type, num_values, field.to_owned()))
    }

    /// Passes over bytes that must be there.
    fn skip_bytes(&mut self, field: &str, num_bytes: u64) -> Result<Range<u64>, SourceError> {
        let range = self.position..self.position.saturating_add(num_bytes);
        if range.end > self.file_bytes {
            let problem = format!(
                "it needs {num_bytes} bytes where {} are left; the file is truncated",
                self.file_bytes - self.position
            );
            return Err(self.corrupt(field, "too short", &problem));
        }
        self.seek(range.end)?;
        Ok(range)
    }

    fn seek(&mut self, position: u64) -> Result<(), SourceError> {
        self.input.seek(SeekFrom::Start(position)).map_err(|e| SourceError::io(&self.path, "seek in", e))?;
        self.position = position;
        Ok(())
    }

    /// Passes over words that must be there.
    fn skip_tokens(&mut self, field: &str, num_tokens: u64) -> Result<Range<u64>, SourceError> {
        let start = self.position;
        let (mut num_left, mut in_token) = (num_tokens, false);
        while num_left > 0 {
            let available = self.input.fill_buf().map_err(|e| SourceError::io(&self.path, "read", e))?;
            if available.is_empty() {
                if in_token && num_left == 1 {
                    break;
                }
                let problem =
                    format!("{num_left} of {num_tokens} numbers are missing; the file is truncated");
                return Err(self.corrupt(field, "too short", &problem));
            }
            let mut taken = 0;
            for byte in available {
                let is_blank = byte.is_ascii_whitespace();
                if in_token && is_blank {
                    num_left -= 1;
                    if num_left == 0 {
                        break;
                    }
                }
                in_token = !is_blank;
                taken += 1;
            }
            self.input.consume(taken);
            self.position += taken as u64;
        }
        Ok(start..self.position)
    }

    /// Takes what a line begins.
    fn take(&mut self, legacy: &mut Legacy, words: &[String]) -> Result<(), SourceError> {
        let keyword = words[0].to_uppercase();
        match keyword.as_str() {
            "DIMENSIONS" => legacy.dims = Some(self.three(words)?),
            "ORIGIN" => legacy.origin = Some(self.three(words)?),
            "SPACING" | "ASPECT_RATIO" => legacy.spacing = Some(self.three(words)?),
            "POINTS" => {
                let sample_type = self.sample_type(words, 2)?;
                legacy.points = Some(self.values("POINTS", sample_type, [self.number(words, 1)?, 3])?);
            }
            "X_COORDINATES" | "Y_COORDINATES" | "Z_COORDINATES" => {
                let axis = usize::from(keyword.as_bytes()[0] - b'X');
                let sample_type = self.sample_type(words, 2)?;
                legacy.axes[axis] = Some(self.values(&keyword, sample_type, [self.number(words, 1)?, 1])?);
            }
            "CELLS" => legacy.cells = Some(self.cells(words)?),
            "CELL_TYPES" => {
                let count = self.number(words, 1)?;
                legacy.cell_types = Some(self.values("CELL_TYPES", SampleType::I32, [count, 1])?);
            }
            "POINT_DATA" => {
                let count = self.number(words, 1)?;
                legacy.num_point_data = Some(count);
                self.section = Section::Points(count);
            }
            "CELL_DATA" => self.section = Section::Cells(self.number(words, 1)?),
            "METADATA" => while self.line()?.is_some_and(|line| !line.trim().is_empty()) {},
            "FIELD" => self.field(legacy, words)?,
            _ => self.attribute(legacy, &keyword, words)?,
        }
        Ok(())
    }

    /// The cells of an unstructured grid, as the version of the file writes them.
    fn cells(&mut self, words: &[String]) -> Result<LegacyCells, SourceError> {
        let [first, second] = [self.number(words, 1)?, self.number(words, 2)?];
        if !self.is_version_5 {
            return Ok(LegacyCells::Counted(self.values("CELLS", SampleType::I32, [second, 1])?));
        }
        let mut part = |name: &str, count: u64| {
            let words = self.needed_words(name)?;
            if words[0].to_uppercase() != name {
                return Err(self.corrupt(name, &words[0], "it must come here; the file is damaged"));
            }
            let sample_type = self.sample_type(&words, 1)?;
            self.values(name, sample_type, [count, 1])
        };
        let offsets = part("OFFSETS", first)?;
        Ok(LegacyCells::Offsets { offsets, connectivity: part("CONNECTIVITY", second)? })
    }

    /// An attribute of points or cells.
    fn attribute(&mut self, legacy: &mut Legacy, keyword: &str, words: &[String]) -> Result<(), SourceError> {
        let (sample_type, num_components) = match keyword {
            "SCALARS" => {
                let num_components = if words.len() > 3 { self.number(words, 3)? } else { 1 };
                (self.sample_type(words, 2)?, num_components)
            }
            "VECTORS" | "NORMALS" => (self.sample_type(words, 2)?, 3),
            "TENSORS" => (self.sample_type(words, 2)?, 9),
            "TENSORS6" => (self.sample_type(words, 2)?, 6),
            "TEXTURE_COORDINATES" => (self.sample_type(words, 3)?, self.number(words, 2)?),
            "GLOBAL_IDS" | "PEDIGREE_IDS" => (self.sample_type(words, 2)?, 1),
            "COLOR_SCALARS" | "LOOKUP_TABLE" => {
                let sample_type = if self.is_binary { SampleType::U8 } else { SampleType::F32 };
                (sample_type, if keyword == "LOOKUP_TABLE" { 4 } else { self.number(words, 2)? })
            }
            _ => return Err(self.corrupt("keyword", &words[0], "it is not known here; the file is damaged")),
        };
        let name = decoded_name(words.get(1).map_or("", String::as_str));
        if keyword == "LOOKUP_TABLE" {
            let count = self.number(words, 2)?;
            self.values(&name, sample_type, [count, num_components])?;
            return Ok(());
        }
        if keyword == "SCALARS" {
            self.skip_table_name()?;
        }
        let num_tuples = match self.section {
            Section::Points(count) | Section::Cells(count) => count,
            Section::DataSet => {
                return Err(self.corrupt(keyword, name, "it must come after POINT_DATA or CELL_DATA"));
            }
        };
        self.add_array(legacy, name, sample_type, [num_tuples, num_components])
    }

    /// Passes over the line that names the look-up table of scalars, where there is one.
    fn skip_table_name(&mut self) -> Result<(), SourceError> {
        let before = self.position;
        let is_table = self.line()?.is_some_and(|line| line.to_uppercase().starts_with("LOOKUP_TABLE"));
        if is_table { Ok(()) } else { self.seek(before) }
    }

    /// The arrays of a field.
    fn field(&mut self, legacy: &mut Legacy, words: &[String]) -> Result<(), SourceError> {
        let count: u64 = self.number(words, 2)?;
        if count > MAX_ARRAYS {
            return Err(self.corrupt("FIELD", count, "no field has as many arrays"));
        }
        for _ in 0..count {
            let mut words = self.needed_words("array of FIELD")?;
            while words[0] == "METADATA" {
                while self.line()?.is_some_and(|line| !line.trim().is_empty()) {}
                words = self.needed_words("array of FIELD")?;
            }
            if words[0] == "NULL_ARRAY" {
                continue;
            }
            let name = decoded_name(&words[0]);
            let shape = [self.number(&words, 2)?, self.number(&words, 1)?];
            let sample_type = self.sample_type(&words, 3)?;
            match self.section {
                Section::DataSet => {
                    let array = self.values(&name, sample_type, shape)?;
                    let is_number = array.num_values() == 1;
                    match name.as_str() {
                        "TIME" | "TimeValue" if is_number => legacy.time = Some(array),
                        "CYCLE" | "TimeStep" if is_number => legacy.cycle = Some(array),
                        _ => {}
                    }
                }
                Section::Points(count) | Section::Cells(count) if shape[0] != count => {
                    let problem = format!("the data are for {count} points or cells");
                    return Err(self.corrupt(format!("tuples of {name:?}"), shape[0], &problem));
                }
                _ => self.add_array(legacy, name, sample_type, shape)?,
            }
        }
        Ok(())
    }

    /// Passes over the values of points or cells, and keeps those of points: number of tuples, of components.
    fn add_array(
        &mut self,
        legacy: &mut Legacy,
        name: String,
        sample_type: SampleType,
        [num_tuples, num_components]: [u64; 2],
    ) -> Result<(), SourceError> {
        if !(1..=MAX_COMPONENTS).contains(&num_components) {
            let problem = format!("it must be between 1 and {MAX_COMPONENTS}");
            return Err(self.corrupt(format!("components of {name:?}"), num_components, &problem));
        }
        let array = self.values(&format!("array {name:?}"), sample_type, [num_tuples, num_components])?;
        let is_of_points = matches!(self.section, Section::Points(_));
        if name == GHOSTS && num_components == 1 {
            legacy.ghosts[usize::from(!is_of_points)] = Some(array);
            return Ok(());
        }
        if !is_of_points {
            legacy.has_cell_data = true;
            return Ok(());
        }
        for component in 0..num_components as usize {
            let name = if num_components == 1 { name.clone() } else { format!("{name}_{component}") };
            if !self.names.insert(name.clone()) {
                return Err(self.corrupt("name of an array", name, "two arrays have it; rename one"));
            }
            legacy.variables.push(Variable { name, units: String::new(), sample_type, fill_value: None });
            legacy.arrays.push(array.component(component, num_components as usize));
        }
        Ok(())
    }
}

/// A name with its `%20` and the like replaced.
fn decoded_name(name: &str) -> String {
    let mut out = Vec::new();
    let mut rest = name.as_bytes();
    while let Some((&byte, after)) = rest.split_first() {
        let code = after.get(..2).filter(|_| byte == b'%').and_then(|hex| std::str::from_utf8(hex).ok());
        match code.and_then(|hex| u8::from_str_radix(hex, 16).ok()) {
            Some(decoded) => {
                out.push(decoded);
                rest = &after[2..];
            }
            None => {
                out.push(byte);
                rest = after;
            }
        }
    }
    String::from_utf8_lossy(&out).into_owned()
}
