//! The text header of a NRRD file: its fields, and the grid they describe.

use std::collections::HashMap;
use std::io::{BufRead, Read};
use std::path::{Path, PathBuf};

use chronoxel_core::SampleType;

use super::volume_file::open_regular;
use crate::SourceError;

/// The longest header that is read.
const MAX_HEADER_BYTES: u64 = 4 << 20;

/// The largest number of data files.
const MAX_DATA_FILES: usize = 1 << 20;

/// How far a direction may lean from its axis, relative to its length.
const AXIS_TOLERANCE: f64 = 1e-6;

/// The fields of a header.
pub(crate) struct Fields {
    pub path: PathBuf,
    values: HashMap<String, String>,
    /// The lines after `data file: LIST`.
    listed_files: Vec<String>,
    /// Where the header ends: the data of an attached file begin here.
    pub header_bytes: u64,
}

impl Fields {
    /// Reads the header of a file.
    pub fn read(path: &Path) -> Result<Self, SourceError> {
        let (file, file_bytes) = open_regular(path)?;
        let mut input = std::io::BufReader::new(file.take(MAX_HEADER_BYTES));
        let mut fields =
            Self { path: path.to_owned(), values: HashMap::new(), listed_files: Vec::new(), header_bytes: 0 };
        let mut line = Vec::new();
        loop {
            line.clear();
            let read = input.read_until(b'\n', &mut line).map_err(|e| SourceError::io(path, "read", e))?;
            fields.header_bytes += read as u64;
            let text = String::from_utf8_lossy(&line);
            let text = text.trim_end_matches(['\n', '\r']);
            if read == 0 || text.is_empty() {
                break;
            }
            fields.add_line(text)?;
        }
        if fields.header_bytes >= MAX_HEADER_BYTES {
            let problem =
                format!("no empty line within {MAX_HEADER_BYTES} bytes ends it; the file has {file_bytes}");
            return Err(SourceError::corrupt(path, "header", "too long", problem));
        }
        Ok(fields)
    }

    /// Takes one line of the header: a magic, a comment, a field, a key, or the name of a data file.
    fn add_line(&mut self, line: &str) -> Result<(), SourceError> {
        if line.starts_with('#') || line.starts_with("NRRD0") {
            return Ok(());
        }
        if self.values.get("data file").is_some_and(|v| v.starts_with("LIST")) {
            self.listed_files.push(line.to_owned());
            return Ok(());
        }
        let Some((name, value)) = line.split_once(':') else {
            return Err(SourceError::corrupt(&self.path, "header line", line, "it must read field: value"));
        };
        if value.starts_with('=') {
            return Ok(());
        }
        let name = match name.trim().to_lowercase().as_str() {
            "datafile" => "data file".to_owned(),
            "byteskip" => "byte skip".to_owned(),
            "lineskip" => "line skip".to_owned(),
            "sampleunits" => "sample units".to_owned(),
            "axismins" => "axis mins".to_owned(),
            "centerings" => "centers".to_owned(),
            name => name.to_owned(),
        };
        if self.values.contains_key(&name) {
            return Err(SourceError::corrupt(&self.path, name, value, "the field is given twice"));
        }
        self.values.insert(name, value.trim().to_owned());
        Ok(())
    }

    /// The text of a field.
    pub fn get(&self, field: &str) -> Option<&str> {
        self.values.get(field).map(String::as_str)
    }

    /// The text of a field that must be there.
    pub fn required(&self, field: &'static str) -> Result<&str, SourceError> {
        self.get(field)
            .ok_or_else(|| SourceError::corrupt(&self.path, field, "missing", "the header must have it"))
    }

    /// The whole number of a field.
    pub fn integer(&self, field: &'static str) -> Result<Option<i64>, SourceError> {
        let wrong = |text: &str| SourceError::corrupt(&self.path, field, text, "it must be a whole number");
        self.get(field).map(|text| text.parse().map_err(|_| wrong(text))).transpose()
    }

    /// The sizes of the axes, fastest first; as many as the dimension.
    pub fn sizes(&self) -> Result<Vec<usize>, SourceError> {
        let dimension = self.required("dimension")?;
        let text = self.required("sizes")?;
        let wrong = |problem: &str| SourceError::corrupt(&self.path, "sizes", text, problem);
        let sizes: Vec<usize> = text
            .split_whitespace()
            .map(|n| n.parse().map_err(|_| wrong("they must be whole numbers")))
            .collect::<Result<_, _>>()?;
        if dimension.parse() != Ok(sizes.len()) {
            return Err(wrong(&format!("there must be as many as the dimension, {dimension}")));
        }
        if sizes.contains(&0) {
            return Err(wrong("every axis must have at least one sample"));
        }
        Ok(sizes)
    }

    /// One number per axis; `None` where the field is missing, NaN where an entry is.
    pub fn per_axis(&self, field: &'static str, num_axes: usize) -> Result<Option<Vec<f64>>, SourceError> {
        let Some(text) = self.get(field) else { return Ok(None) };
        let wrong = || {
            SourceError::corrupt(
                &self.path,
                field,
                text,
                format!("there must be {num_axes} numbers, one per axis"),
            )
        };
        let numbers: Vec<f64> =
            text.split_whitespace().map(|n| n.parse().map_err(|_| wrong())).collect::<Result<_, _>>()?;
        if numbers.len() == num_axes { Ok(Some(numbers)) } else { Err(wrong()) }
    }

    /// One word per axis; empty where the field is missing.
    pub fn words(&self, field: &str) -> Vec<String> {
        let unquoted = |word: &str| word.trim_matches('"').to_owned();
        match self.get(field) {
            // Words in quotes may hold spaces.
            Some(text) if text.contains('"') => text
                .split('"')
                .enumerate()
                .filter(|(i, part)| i % 2 == 1 || !part.trim().is_empty())
                .map(|(_, part)| unquoted(part))
                .collect(),
            Some(text) => text.split_whitespace().map(unquoted).collect(),
            None => Vec::new(),
        }
    }

    /// The sample type.
    pub fn sample_type(&self) -> Result<SampleType, SourceError> {
        let text = self.required("type")?;
        Ok(match text {
            "signed char" | "int8" | "int8_t" => SampleType::I8,
            "uchar" | "unsigned char" | "uint8" | "uint8_t" => SampleType::U8,
            "short" | "short int" | "signed short" | "signed short int" | "int16" | "int16_t" => {
                SampleType::I16
            }
            "ushort" | "unsigned short" | "unsigned short int" | "uint16" | "uint16_t" => SampleType::U16,
            "int" | "signed int" | "int32" | "int32_t" => SampleType::I32,
            "uint" | "unsigned int" | "uint32" | "uint32_t" => SampleType::U32,
            "longlong"
            | "long long"
            | "long long int"
            | "signed long long"
            | "signed long long int"
            | "int64"
            | "int64_t" => SampleType::I64,
            "ulonglong" | "unsigned long long" | "unsigned long long int" | "uint64" | "uint64_t" => {
                SampleType::U64
            }
            "float" => SampleType::F32,
            "double" => SampleType::F64,
            _ => {
                return Err(SourceError::unsupported(
                    &self.path,
                    "type",
                    text,
                    "numbers of 8 to 64 bits are",
                ));
            }
        })
    }

    /// Whether the samples are big-endian; of no meaning for single bytes.
    pub fn big_endian(&self) -> Result<Option<bool>, SourceError> {
        match self.get("endian").map(str::to_lowercase).as_deref() {
            None => Ok(None),
            Some("little") => Ok(Some(false)),
            Some("big") => Ok(Some(true)),
            Some(text) => Err(SourceError::corrupt(&self.path, "endian", text, "it must be little or big")),
        }
    }

    /// Origin and spacing along the three axes that start at `first_axis`.
    pub fn placement(&self, num_axes: usize, first_axis: usize) -> Result<[[f64; 3]; 2], SourceError> {
        let at = |numbers: &Option<Vec<f64>>, axis: usize| {
            numbers.as_ref().map_or(f64::NAN, |n| n[first_axis + axis])
        };
        let or = |number: f64, other: f64| if number.is_nan() { other } else { number };
        if self.get("space directions").is_some() {
            let spacing = self.directions(num_axes, first_axis)?;
            let origin = match self.get("space origin") {
                Some(text) => self.vector("space origin", text)?,
                None => [0.0; 3],
            };
            return Ok([origin, spacing]);
        }
        let (spacings, mins) = (self.per_axis("spacings", num_axes)?, self.per_axis("axis mins", num_axes)?);
        let spacing: [f64; 3] = std::array::from_fn(|axis| or(at(&spacings, axis), 1.0));
        let centers = self.words("centers");
        let origin = match self.get("space origin") {
            Some(text) => self.vector("space origin", text)?,
            None => std::array::from_fn(|axis| {
                let is_cell = centers.get(first_axis + axis).is_some_and(|c| c == "cell");
                or(at(&mins, axis), 0.0) + if is_cell && mins.is_some() { spacing[axis] / 2.0 } else { 0.0 }
            }),
        };
        Ok([origin, spacing])
    }

    /// Spacings from `space directions`, which must lie along x, y and z.
    fn directions(&self, num_axes: usize, first_axis: usize) -> Result<[f64; 3], SourceError> {
        let text = self.get("space directions").unwrap_or_default();
        let vectors = split_vectors(text);
        if vectors.len() != num_axes {
            let problem = format!("there must be {num_axes} vectors, one per axis, or none");
            return Err(SourceError::corrupt(&self.path, "space directions", text, problem));
        }
        let mut spacing = [0.0; 3];
        for axis in 0..3 {
            let vector = self.vector("space directions", &vectors[first_axis + axis])?;
            let leans = (0..3).any(|a| a != axis && vector[a].abs() > AXIS_TOLERANCE * vector[axis].abs());
            if leans || vector[axis] < 0.0 {
                let remedy =
                    "axes along x, y and z in this order and direction are; resample or flip the volume";
                return Err(SourceError::unsupported(&self.path, "space directions", text, remedy));
            }
            spacing[axis] = vector[axis];
        }
        Ok(spacing)
    }

    /// A vector written as `(1,2,3)`.
    fn vector(&self, field: &str, text: &str) -> Result<[f64; 3], SourceError> {
        let inner = text.trim().strip_prefix('(').and_then(|t| t.strip_suffix(')'));
        let numbers: Option<Vec<f64>> =
            inner.and_then(|inner| inner.split(',').map(|n| n.trim().parse().ok()).collect());
        numbers.and_then(|n| n.try_into().ok()).ok_or_else(|| {
            SourceError::corrupt(
                &self.path,
                field,
                text,
                "vectors must be written as (x,y,z), in three dimensions",
            )
        })
    }

    /// The files that hold the data; none where they are attached.
    pub fn data_files(&self) -> Result<Vec<PathBuf>, SourceError> {
        let Some(text) = self.get("data file") else { return Ok(Vec::new()) };
        let folder = self.path.parent().unwrap_or(Path::new(""));
        let names = if text.starts_with("LIST") {
            self.listed_files.clone()
        } else if text.contains('%') && text.split_whitespace().count() >= 4 {
            self.numbered_files(text)?
        } else {
            vec![text.to_owned()]
        };
        if names.is_empty() {
            return Err(SourceError::corrupt(&self.path, "data file", text, "no file is listed"));
        }
        Ok(names.iter().map(|name| folder.join(name.trim())).collect())
    }

    /// The names that `FORMAT MIN MAX STEP [SUBDIM]` stands for.
    fn numbered_files(&self, text: &str) -> Result<Vec<String>, SourceError> {
        let wrong = |problem: &str| SourceError::corrupt(&self.path, "data file", text, problem);
        let words: Vec<&str> = text.split_whitespace().collect();
        let numbers: Option<Vec<i64>> = words[1..4].iter().map(|n| n.parse().ok()).collect();
        let Some([min, max, step]) = numbers.and_then(|n| <[i64; 3]>::try_from(n).ok()) else {
            return Err(wrong("it must read FORMAT MIN MAX STEP, with whole numbers"));
        };
        if step == 0 || (max < min) != (step < 0) {
            return Err(wrong("the step must lead from the first number to the last"));
        }
        let count = (i128::from(max) - i128::from(min)) / i128::from(step) + 1;
        if count > MAX_DATA_FILES as i128 {
            return Err(wrong(&format!("at most {MAX_DATA_FILES} data files are read")));
        }
        let name = |index: i64| formatted(words[0], min + index * step);
        (0..count as i64)
            .map(|i| name(i).ok_or_else(|| wrong("the format must hold one %d, as in step%03d.raw")))
            .collect()
    }
}

/// The parts of `(1,0,0) none (0,1,0)`.
fn split_vectors(text: &str) -> Vec<String> {
    let mut parts: Vec<String> = Vec::new();
    let mut in_vector = false;
    for word in text.replace('(', " (").replace(')', ") ").split_whitespace() {
        match parts.last_mut().filter(|_| in_vector) {
            Some(last) => last.push_str(word),
            None => parts.push(word.to_owned()),
        }
        in_vector = (in_vector || word.starts_with('(')) && !word.ends_with(')');
    }
    parts
}

/// A name from a format with one `%d`, `%5d` or `%05d`.
fn formatted(format: &str, number: i64) -> Option<String> {
    let (before, rest) = format.split_once('%')?;
    let (width, after) = rest.split_once(['d', 'u'])?;
    if after.contains('%') {
        return None;
    }
    let columns: usize = if width.is_empty() { 0 } else { width.parse().ok()? };
    if columns > 64 {
        return None;
    }
    Some(match width.starts_with('0') {
        true => format!("{before}{number:0columns$}{after}"),
        false => format!("{before}{number:columns$}{after}"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_of_printf_give_names() {
        assert_eq!(formatted("a%03d.raw", 7).unwrap(), "a007.raw");
        assert_eq!(formatted("a%d", 12).unwrap(), "a12");
        assert_eq!(formatted("%4d", 12).unwrap(), "  12");
        assert!(
            formatted("a%s", 1).is_none()
                && formatted("a%d%d", 1).is_none()
                && formatted("a%999d", 1).is_none()
        );
    }

    #[test]
    fn vectors_are_split_with_and_without_spaces() {
        assert_eq!(split_vectors("(1,0,0) none (0, 1, 0)(0,0,1)"), ["(1,0,0)", "none", "(0,1,0)", "(0,0,1)"]);
    }
}
