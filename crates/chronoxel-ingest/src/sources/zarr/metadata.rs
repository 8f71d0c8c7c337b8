//! The metadata of a Zarr array, version 2 or 3, in one form.

use std::io::Read;
use std::path::{Path, PathBuf};

use chronoxel_core::SampleType;
use serde_json::{Map, Value};

use super::codecs::{BytesCodec, codec_name};
use crate::SourceError;
use crate::sources::npy::sample_type_of;
use crate::sources::volume_file::{checked_product, open_regular};
use crate::sources::vtk_data::decode_base64;

/// The longest metadata that are read.
const MAX_METADATA_BYTES: u64 = 64 << 20;

/// The longest chunk that is read, decoded.
const MAX_CHUNK_BYTES: u64 = 2 << 30;

/// What an array is and how its chunks are written.
#[derive(Debug, Clone)]
pub(crate) struct ArrayMetadata {
    /// The folder of the array.
    pub folder: PathBuf,
    /// The file that says so, for messages.
    pub path: PathBuf,
    pub shape: Vec<u64>,
    /// Shape of the files' chunks; of whole shards where there are shards.
    pub file_chunk: Vec<u64>,
    /// Shape of what is decoded as one piece.
    pub chunk: Vec<u64>,
    pub sample_type: SampleType,
    pub big_endian: bool,
    /// Order of the axes in a decoded chunk, slowest first.
    pub axis_order: Vec<usize>,
    pub codecs: Vec<BytesCodec>,
    pub shard_index: Option<ShardIndex>,
    /// The value of samples whose chunk is absent.
    pub absent_value: f64,
    pub key_prefix: &'static str,
    pub key_separator: &'static str,
    pub dimension_names: Vec<String>,
    pub attributes: Map<String, Value>,
    /// The `fill_value` of version 2 stands for missing data too, where xarray wrote it.
    absent_is_missing: bool,
}

/// How the index of a shard is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ShardIndex {
    pub at_end: bool,
    pub has_crc: bool,
}

/// What a folder is.
pub(crate) enum Node {
    Array(Box<ArrayMetadata>),
    Group { path: PathBuf, attributes: Map<String, Value> },
    Neither,
}

/// Reads a JSON file that must hold an object; `None` where there is no such file.
fn read_json(path: &Path) -> Result<Option<Map<String, Value>>, SourceError> {
    if !path.exists() {
        return Ok(None);
    }
    let (file, _) = open_regular(path)?;
    let mut text = Vec::new();
    file.take(MAX_METADATA_BYTES).read_to_end(&mut text).map_err(|e| SourceError::io(path, "read", e))?;
    match serde_json::from_slice(&with_quoted_words(&text)) {
        Ok(Value::Object(object)) => Ok(Some(object)),
        Ok(other) => Err(SourceError::corrupt(path, "metadata", other, "they must be a JSON object")),
        Err(error) => {
            Err(SourceError::corrupt(path, "metadata", error, "they must be JSON; they may be truncated"))
        }
    }
}

/// JSON in which the words `NaN`, `Infinity` and `-Infinity`, which Python writes bare, are strings.
fn with_quoted_words(text: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(text.len());
    let (mut in_string, mut at) = (false, 0);
    while at < text.len() {
        let words: [&[u8]; 3] = [b"NaN", b"-Infinity", b"Infinity"];
        match words.iter().find(|word| !in_string && text[at..].starts_with(word)) {
            Some(word) => {
                out.extend([b"\"", *word, b"\""].concat());
                at += word.len();
            }
            None => {
                let is_escape = in_string && text[at] == b'\\';
                in_string ^= text[at] == b'"';
                let end = text.len().min(at + 1 + usize::from(is_escape));
                out.extend_from_slice(&text[at..end]);
                at = end;
            }
        }
    }
    out
}

impl Node {
    /// Reads the metadata of a folder.
    pub fn read(folder: &Path) -> Result<Self, SourceError> {
        let path = folder.join("zarr.json");
        if let Some(json) = read_json(&path)? {
            let kind = json.get("node_type").and_then(Value::as_str).unwrap_or("missing");
            return match kind {
                "array" => {
                    Fields { path: &path, json: &json }.version_3(folder).map(|a| Self::Array(Box::new(a)))
                }
                "group" => {
                    let attributes =
                        json.get("attributes").and_then(Value::as_object).cloned().unwrap_or_default();
                    Ok(Self::Group { path, attributes })
                }
                other => Err(SourceError::corrupt(&path, "node_type", other, "it must be array or group")),
            };
        }
        let attributes = read_json(&folder.join(".zattrs"))?.unwrap_or_default();
        let path = folder.join(".zarray");
        if let Some(json) = read_json(&path)? {
            let array = Fields { path: &path, json: &json }.version_2(folder, attributes)?;
            return Ok(Self::Array(Box::new(array)));
        }
        let path = folder.join(".zgroup");
        match read_json(&path)? {
            Some(_) => Ok(Self::Group { path, attributes }),
            None => Ok(Self::Neither),
        }
    }
}

impl ArrayMetadata {
    /// Bytes of a decoded chunk.
    pub fn chunk_bytes(&self) -> usize {
        self.chunk.iter().product::<u64>() as usize * self.sample_type.num_bytes()
    }

    /// Samples between neighbours along each axis of a decoded chunk.
    pub fn chunk_strides(&self) -> Vec<usize> {
        let mut strides = vec![0; self.chunk.len()];
        let mut stride = 1;
        for &axis in self.axis_order.iter().rev() {
            strides[axis] = stride;
            stride *= self.chunk[axis] as usize;
        }
        strides
    }

    /// The text of an attribute.
    pub fn text_attribute(&self, name: &str) -> Option<&str> {
        self.attributes.get(name).and_then(Value::as_str)
    }

    /// The value that means "no data": the attributes `_FillValue` or `missing_value`.
    pub fn fill_value(&self) -> Result<Option<f64>, SourceError> {
        for name in ["_FillValue", "missing_value"] {
            let Some(value) = self.attributes.get(name) else { continue };
            let value = value.as_array().and_then(|one| one.first()).unwrap_or(value);
            let number = number_of(value, self.sample_type).or_else(|| {
                // xarray writes a double in base64.
                let bytes = decode_base64(value.as_str()?)?;
                Some(f64::from_le_bytes(bytes.try_into().ok()?))
            });
            return match number {
                Some(number) => Ok(Some(number)),
                None => Err(SourceError::corrupt(&self.path, name, value, "it must be a number")),
            };
        }
        Ok(self.absent_is_missing.then_some(self.absent_value))
    }

    /// Refuses packed numbers, which would be drawn as they are stored.
    pub fn check_not_packed(&self) -> Result<(), SourceError> {
        for (name, neutral) in [("scale_factor", 1.0), ("add_offset", 0.0)] {
            if let Some(value) = self.attributes.get(name).filter(|v| v.as_f64() != Some(neutral)) {
                let remedy = "numbers that are not packed are; unpack it, with xarray for example";
                return Err(SourceError::unsupported(&self.path, name, value, remedy));
            }
        }
        Ok(())
    }
}

/// A number in JSON, or one of the words and bit patterns that Zarr has for floats.
fn number_of(value: &Value, sample_type: SampleType) -> Option<f64> {
    match value {
        Value::Number(number) => number.as_f64(),
        Value::Bool(truth) => Some(f64::from(u8::from(*truth))),
        Value::String(text) => match text.as_str() {
            "NaN" | "nan" => Some(f64::NAN),
            "Infinity" => Some(f64::INFINITY),
            "-Infinity" => Some(f64::NEG_INFINITY),
            _ => {
                let bits = u64::from_str_radix(text.strip_prefix("0x")?, 16).ok()?;
                match sample_type {
                    SampleType::F32 => Some(f64::from(f32::from_bits(u32::try_from(bits).ok()?))),
                    SampleType::F64 => Some(f64::from_bits(bits)),
                    _ => None,
                }
            }
        },
        _ => None,
    }
}

/// The fields of an array's metadata.
struct Fields<'a> {
    path: &'a Path,
    json: &'a Map<String, Value>,
}

impl Fields<'_> {
    fn corrupt(&self, field: &str, problem: &str) -> SourceError {
        let value = self.json.get(field).map_or("missing".to_owned(), Value::to_string);
        SourceError::corrupt(self.path, field, value, problem)
    }

    fn unsupported(&self, field: &str, value: impl ToString, remedy: &str) -> SourceError {
        SourceError::unsupported(self.path, field, value, remedy)
    }

    /// A shape.
    fn shape(&self, field: &str, value: Option<&Value>) -> Result<Vec<u64>, SourceError> {
        let numbers = value.and_then(Value::as_array).map(|all| all.iter().map(Value::as_u64).collect());
        numbers.flatten().ok_or_else(|| self.corrupt(field, "it must be a list of whole numbers"))
    }

    /// Refuses chunks that no memory should be asked for, and shapes that do not go together.
    fn checked(&self, array: ArrayMetadata) -> Result<ArrayMetadata, SourceError> {
        let num_axes = array.shape.len();
        if array.chunk.len() != num_axes
            || array.file_chunk.len() != num_axes
            || array.axis_order.len() != num_axes
        {
            return Err(self.corrupt("shape", "chunks must have as many axes"));
        }
        if array.file_chunk.contains(&0) || array.chunk.contains(&0) {
            return Err(self.corrupt("shape", "no axis of a chunk may be 0"));
        }
        if array.file_chunk.iter().zip(&array.chunk).any(|(file, inner)| !file.is_multiple_of(*inner)) {
            return Err(self.corrupt("codecs", "the chunks of a shard must fill it"));
        }
        let mut order = array.axis_order.clone();
        order.sort_unstable();
        if order.iter().enumerate().any(|(i, axis)| i != *axis) {
            return Err(self.corrupt("codecs", "the order of a transpose must name every axis once"));
        }
        let bytes = array.sample_type.num_bytes() as u64;
        checked_product(self.path, "shape", array.file_chunk.iter().copied())?;
        checked_product(self.path, "shape", array.shape.iter().copied().chain([bytes]))?;
        let chunk_bytes =
            checked_product(self.path, "chunk shape", array.chunk.iter().copied().chain([bytes]))?;
        if chunk_bytes > MAX_CHUNK_BYTES {
            let remedy =
                format!("chunks of at most {MAX_CHUNK_BYTES} bytes are; write it with smaller chunks");
            return Err(self.unsupported("chunk size in bytes", chunk_bytes, &remedy));
        }
        Ok(array)
    }

    /// The value of absent chunks.
    fn absent_value(&self, sample_type: SampleType) -> Result<f64, SourceError> {
        match self.json.get("fill_value") {
            None | Some(Value::Null) => Ok(0.0),
            Some(value) => {
                number_of(value, sample_type).ok_or_else(|| self.corrupt("fill_value", "it must be a number"))
            }
        }
    }

    /// Version 2: <https://zarr-specs.readthedocs.io/en/latest/v2/v2.0.html>.
    fn version_2(&self, folder: &Path, attributes: Map<String, Value>) -> Result<ArrayMetadata, SourceError> {
        if self.json.get("zarr_format").and_then(Value::as_u64) != Some(2) {
            return Err(self.corrupt("zarr_format", "a .zarray must have 2"));
        }
        let dtype = self.json.get("dtype");
        let (sample_type, big_endian) =
            dtype.and_then(Value::as_str).and_then(sample_type_of).ok_or_else(|| {
                let shown = dtype.map_or("missing".to_owned(), Value::to_string);
                self.unsupported("dtype", shown, "integers of 1 to 8 bytes and floats of 4 and 8 are")
            })?;
        if let Some(filters) =
            self.json.get("filters").filter(|f| f.as_array().is_some_and(|f| !f.is_empty()))
        {
            return Err(self.unsupported("filters", filters, "arrays without filters are; write it without"));
        }
        let codecs = match self.json.get("compressor") {
            None | Some(Value::Null) => Vec::new(),
            Some(compressor) => vec![self.bytes_codec("compressor", compressor)?],
        };
        let chunk = self.shape("chunks", self.json.get("chunks"))?;
        let axes = 0..chunk.len();
        let axis_order = match self.json.get("order").and_then(Value::as_str) {
            Some("C") | None => axes.collect(),
            Some("F") => axes.rev().collect(),
            Some(_) => return Err(self.corrupt("order", "it must be C or F")),
        };
        let key_separator = match self.json.get("dimension_separator").and_then(Value::as_str) {
            Some("/") => "/",
            Some(".") | None => ".",
            Some(_) => return Err(self.corrupt("dimension_separator", "it must be . or /")),
        };
        let has_fill = self.json.get("fill_value").is_some_and(|v| !v.is_null());
        let names = names_of(attributes.get("_ARRAY_DIMENSIONS"));
        self.checked(ArrayMetadata {
            folder: folder.to_owned(),
            path: self.path.to_owned(),
            shape: self.shape("shape", self.json.get("shape"))?,
            file_chunk: chunk.clone(),
            chunk,
            sample_type,
            big_endian,
            axis_order,
            codecs,
            shard_index: None,
            absent_value: self.absent_value(sample_type)?,
            key_prefix: "",
            key_separator,
            absent_is_missing: has_fill && !names.is_empty(),
            dimension_names: names,
            attributes,
        })
    }

    /// Version 3: <https://zarr-specs.readthedocs.io/en/latest/v3/core/index.html>.
    fn version_3(&self, folder: &Path) -> Result<ArrayMetadata, SourceError> {
        if self.json.get("zarr_format").and_then(Value::as_u64) != Some(3) {
            return Err(self.corrupt("zarr_format", "a zarr.json must have 3"));
        }
        let data_type = self.json.get("data_type").unwrap_or(&Value::Null);
        let sample_type = data_type.as_str().and_then(type_of_version_3).ok_or_else(|| {
            self.unsupported("data_type", data_type, "int8 to uint64, float32 and float64 are")
        })?;
        if let Some(other) =
            self.json.get("storage_transformers").filter(|t| t.as_array().is_some_and(|t| !t.is_empty()))
        {
            return Err(self.unsupported("storage_transformers", other, "arrays without them are"));
        }
        let (key_prefix, key_separator) = self.chunk_keys()?;
        let grid = self.json.get("chunk_grid").unwrap_or(&Value::Null);
        if codec_name(grid) != "regular" {
            return Err(self.unsupported("chunk_grid", grid, "a regular one is"));
        }
        let file_chunk = self.shape("chunk_grid", grid.pointer("/configuration/chunk_shape"))?;
        let attributes = self.json.get("attributes").and_then(Value::as_object).cloned().unwrap_or_default();
        let mut array = ArrayMetadata {
            folder: folder.to_owned(),
            path: self.path.to_owned(),
            shape: self.shape("shape", self.json.get("shape"))?,
            chunk: file_chunk.clone(),
            axis_order: (0..file_chunk.len()).collect(),
            file_chunk,
            sample_type,
            big_endian: false,
            codecs: Vec::new(),
            shard_index: None,
            absent_value: self.absent_value(sample_type)?,
            key_prefix,
            key_separator,
            dimension_names: names_of(self.json.get("dimension_names")),
            attributes,
            absent_is_missing: false,
        };
        let codecs = self.json.get("codecs").and_then(Value::as_array);
        self.add_codecs(
            &mut array,
            codecs.ok_or_else(|| self.corrupt("codecs", "it must be a list"))?,
            true,
        )?;
        self.checked(array)
    }

    /// What the file of a chunk is called.
    fn chunk_keys(&self) -> Result<(&'static str, &'static str), SourceError> {
        let encoding = self.json.get("chunk_key_encoding").unwrap_or(&Value::Null);
        let separator = encoding.pointer("/configuration/separator").and_then(Value::as_str);
        match (codec_name(encoding), separator) {
            ("default", Some("/") | None) => Ok(("c/", "/")),
            ("default", Some(".")) => Ok(("c.", ".")),
            ("v2", Some(".") | None) => Ok(("", ".")),
            ("v2", Some("/")) => Ok(("", "/")),
            _ => Err(self.unsupported("chunk_key_encoding", encoding, "default and v2 are")),
        }
    }

    /// Takes the codecs of version 3, of a chunk or of the chunks in a shard.
    fn add_codecs(
        &self,
        array: &mut ArrayMetadata,
        codecs: &[Value],
        may_shard: bool,
    ) -> Result<(), SourceError> {
        for (index, codec) in codecs.iter().enumerate() {
            let configuration = codec.get("configuration").unwrap_or(&Value::Null);
            match codec_name(codec) {
                "transpose" => {
                    let order = self.shape("codecs", configuration.get("order"))?;
                    let before = array.axis_order.clone();
                    let axes = order.iter().map(|&axis| before.get(axis as usize).copied());
                    array.axis_order = axes.collect::<Option<_>>().ok_or_else(|| {
                        self.corrupt("codecs", "the order of a transpose must name every axis once")
                    })?;
                }
                "bytes" => match configuration.get("endian").and_then(Value::as_str) {
                    Some("big") => array.big_endian = true,
                    Some("little") => array.big_endian = false,
                    _ if array.sample_type.num_bytes() == 1 => {}
                    _ => {
                        return Err(self.corrupt("codecs", "the codec bytes must have endian: little or big"));
                    }
                },
                "sharding_indexed" => {
                    if !may_shard || codecs.len() != 1 || index != 0 {
                        let remedy = "a shard is read where it is the only codec and holds no shards";
                        return Err(self.unsupported("codecs", "sharding_indexed with others", remedy));
                    }
                    self.add_sharding(array, configuration)?;
                }
                _ => array.codecs.push(self.bytes_codec("codecs", codec)?),
            }
        }
        Ok(())
    }

    /// Takes the configuration of shards.
    fn add_sharding(&self, array: &mut ArrayMetadata, configuration: &Value) -> Result<(), SourceError> {
        array.chunk = self.shape("codecs", configuration.get("chunk_shape"))?;
        let list = |field: &str| configuration.get(field).and_then(Value::as_array).cloned();
        let codecs =
            list("codecs").ok_or_else(|| self.corrupt("codecs", "sharding_indexed must have codecs"))?;
        self.add_codecs(array, &codecs, false)?;
        let index_codecs = list("index_codecs").unwrap_or_default();
        let names: Vec<&str> = index_codecs.iter().map(codec_name).collect();
        let is_big =
            index_codecs.first().and_then(|c| c.pointer("/configuration/endian")).and_then(Value::as_str);
        let has_crc = match (names.as_slice(), is_big) {
            (["bytes"], Some("little")) => false,
            (["bytes", "crc32c"], Some("little")) => true,
            _ => {
                let remedy = "little-endian bytes with or without crc32c are";
                return Err(self.unsupported("index_codecs", names.join(", "), remedy));
            }
        };
        let at_end = match configuration.get("index_location").and_then(Value::as_str) {
            Some("end") | None => true,
            Some("start") => false,
            Some(_) => return Err(self.corrupt("codecs", "index_location must be start or end")),
        };
        array.shard_index = Some(ShardIndex { at_end, has_crc });
        Ok(())
    }

    /// A codec from bytes to bytes.
    fn bytes_codec(&self, field: &str, codec: &Value) -> Result<BytesCodec, SourceError> {
        BytesCodec::of(codec_name(codec)).ok_or_else(|| {
            self.unsupported(
                field,
                codec_name(codec),
                "blosc, gzip, lz4, zlib, zstd and crc32c are; write it with one of them",
            )
        })
    }
}

/// The names of the dimensions; none unless all have one.
fn names_of(value: Option<&Value>) -> Vec<String> {
    let names = value
        .and_then(Value::as_array)
        .map(|all| all.iter().map(|n| n.as_str().map(str::to_owned)).collect());
    names.flatten().unwrap_or_default()
}

/// The sample type that version 3 names so.
fn type_of_version_3(name: &str) -> Option<SampleType> {
    Some(match name {
        "int8" => SampleType::I8,
        "uint8" => SampleType::U8,
        "int16" => SampleType::I16,
        "uint16" => SampleType::U16,
        "int32" => SampleType::I32,
        "uint32" => SampleType::U32,
        "int64" => SampleType::I64,
        "uint64" => SampleType::U64,
        "float32" => SampleType::F32,
        "float64" => SampleType::F64,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_that_python_writes_become_strings() {
        let text = br#"{"a": NaN, "b\"NaN": [-Infinity, Infinity], "c": "NaN"}"#;
        let quoted = String::from_utf8(with_quoted_words(text)).unwrap();
        assert_eq!(quoted, r#"{"a": "NaN", "b\"NaN": ["-Infinity", "Infinity"], "c": "NaN"}"#);
        assert_eq!(with_quoted_words(b"\"\\"), b"\"\\");
    }

    #[test]
    fn numbers_are_read_in_every_form() {
        let number = |text: &str, sample_type| number_of(&serde_json::from_str(text).unwrap(), sample_type);
        assert_eq!(number("3", SampleType::U8), Some(3.0));
        assert_eq!(number("\"-Infinity\"", SampleType::F32), Some(f64::NEG_INFINITY));
        assert_eq!(number("\"0x3fc00000\"", SampleType::F32), Some(1.5));
        assert_eq!(number("\"0x3ff8000000000000\"", SampleType::F64), Some(1.5));
        assert!(number("\"NaN\"", SampleType::F64).unwrap().is_nan());
        assert!(number("\"x\"", SampleType::F64).is_none() && number("[]", SampleType::F64).is_none());
    }
}
