//! Zarr v3 groups: the variable `[t, z, y, x]` and its coordinates, as xarray reads them.
//!
//! Specification: <https://zarr-specs.readthedocs.io/en/latest/v3/core/index.html>. Codecs: `bytes` (little endian)
//! and `zstd`. A chunk is part of one step. Missing samples of integer types have the value that the attribute
//! `_FillValue` gives.

use std::path::Path;

use chronoxel_core::SampleType;
use rayon::prelude::*;
use serde_json::{Value, json};

use super::output::PendingFolder;
use super::sample_bytes::{append, sample_bytes};
use super::{ExportDescription, ExportError, StepWriter, check_step};

/// Longest edge of a chunk.
const CHUNK_EDGE: usize = 64;
const COMPRESSION_LEVEL: i32 = 3;
const AXES: [&str; 4] = ["t", "z", "y", "x"];

/// The group while its steps are written.
pub(super) struct ZarrWriter {
    description: ExportDescription,
    folder: PendingFolder,
    /// Edges of a chunk along z, y, x.
    chunk: [usize; 3],
    next_step: usize,
}

impl ZarrWriter {
    pub fn create(path: &Path, description: &ExportDescription) -> Result<Self, ExportError> {
        let name = &description.name;
        if name.is_empty()
            || name.starts_with(['.', '_'])
            || name.contains(['/', '\\', '\0'])
            || AXES.contains(&name.as_str())
        {
            return Err(ExportError::Unsupported {
                path: path.to_owned(),
                field: "name of the variable",
                value: format!("{name:?}"),
                remedy: "an array of a Zarr group cannot have this name; export to .npy, .nrrd or .vti"
                    .to_owned(),
            });
        }
        let [nx, ny, nz] = description.grid.dims;
        let chunk = [nz, ny, nx].map(|n| n.min(CHUNK_EDGE));
        let folder = PendingFolder::create(path)?;
        let writer = Self { description: description.clone(), folder, chunk, next_step: 0 };
        writer.write_metadata()?;
        Ok(writer)
    }

    fn write_metadata(&self) -> Result<(), ExportError> {
        let ExportDescription { grid, times, name, units, sample_type, fill_value } = &self.description;
        let group = json!({ "zarr_format": 3, "node_type": "group", "attributes": {} });
        self.write_json("zarr.json", &group)?;
        let mut attributes = json!({ "spacing": grid.spacing, "origin": grid.origin });
        if !units.is_empty() {
            attributes["units"] = json!(units);
        }
        if let (true, Some(value)) = (sample_type.is_integer(), fill_value) {
            attributes["_FillValue"] = as_integer(*value);
        }
        let [nx, ny, nz] = grid.dims;
        let [cz, cy, cx] = self.chunk;
        let shapes = [vec![times.num_steps(), nz, ny, nx], vec![1, cz, cy, cx]];
        let absent =
            if sample_type.is_integer() { as_integer(fill_value.unwrap_or(0.0)) } else { json!("NaN") };
        self.write_json(
            &format!("{name}/zarr.json"),
            &array(shapes, *sample_type, absent, &AXES, attributes),
        )?;
        let time_units = if times.units.is_empty() { json!({}) } else { json!({ "units": times.units }) };
        self.write_coordinate("t", &times.times, time_units)?;
        for (axis, label) in ["x", "y", "z"].into_iter().enumerate() {
            let place = |i: usize| grid.origin[axis] + i as f64 * grid.spacing[axis];
            let places: Vec<f64> = (0..grid.dims[axis]).map(place).collect();
            self.write_coordinate(label, &places, json!({}))?;
        }
        Ok(())
    }

    fn write_coordinate(&self, name: &str, values: &[f64], attributes: Value) -> Result<(), ExportError> {
        let shapes = [vec![values.len()], vec![values.len()]];
        let metadata = array(shapes, SampleType::F64, json!("NaN"), &[name], attributes);
        self.write_json(&format!("{name}/zarr.json"), &metadata)?;
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.write_chunk(&format!("{name}/c/0"), &bytes)
    }

    fn write_json(&self, name: &str, value: &Value) -> Result<(), ExportError> {
        self.folder.write(name, format!("{value:#}\n").as_bytes())
    }

    fn write_chunk(&self, name: &str, bytes: &[u8]) -> Result<(), ExportError> {
        let packed = zstd::bulk::compress(bytes, COMPRESSION_LEVEL)
            .map_err(|e| ExportError::io(&self.folder.path().join(name), "compress", e))?;
        self.folder.write(name, &packed)
    }

    /// The bytes of a chunk out of those of a step, padded where it reaches beyond the grid.
    fn chunk_bytes(&self, step: &[u8], [k0, j0, i0]: [usize; 3]) -> Vec<u8> {
        let ([nx, ny, nz], [cz, cy, cx]) = (self.description.grid.dims, self.chunk);
        let size = self.description.sample_type.num_bytes();
        let mut bytes = Vec::with_capacity(cz * cy * cx * size);
        let mut absent = Vec::new();
        let padding = if self.description.sample_type.is_integer() { 0.0 } else { f64::NAN };
        append(&mut absent, self.description.sample_type, self.description.fill_value.unwrap_or(padding));
        let inside = cx.min(nx - i0);
        for (k, j) in (k0..k0 + cz).flat_map(|k| (j0..j0 + cy).map(move |j| (k, j))) {
            let num_kept = if k < nz && j < ny { inside } else { 0 };
            if num_kept > 0 {
                let first = ((k * ny + j) * nx + i0) * size;
                bytes.extend(&step[first..first + num_kept * size]);
            }
            (num_kept..cx).for_each(|_| bytes.extend(&absent));
        }
        bytes
    }
}

impl StepWriter for ZarrWriter {
    fn write_step(&mut self, step: usize, samples: &[f64]) -> Result<(), ExportError> {
        check_step(&self.description, self.next_step, step, samples);
        let bytes = sample_bytes(self.folder.path(), &self.description, step, samples)?;
        let ([nx, ny, nz], [cz, cy, cx]) = (self.description.grid.dims, self.chunk);
        let counts = [nz.div_ceil(cz), ny.div_ceil(cy), nx.div_ceil(cx)];
        (0..counts.iter().product()).into_par_iter().try_for_each(|n: usize| {
            let at = [n / counts[2] / counts[1], n / counts[2] % counts[1], n % counts[2]];
            let chunk = self.chunk_bytes(&bytes, [at[0] * cz, at[1] * cy, at[2] * cx]);
            let name = format!("{}/c/{step}/{}/{}/{}", self.description.name, at[0], at[1], at[2]);
            self.write_chunk(&name, &chunk)
        })?;
        self.next_step += 1;
        Ok(())
    }

    fn finish(self: Box<Self>) -> Result<(), ExportError> {
        assert_eq!(self.next_step, self.description.times.num_steps(), "steps written");
        self.folder.finish()
    }
}

/// Metadata of an array, from its shape and that of its chunks.
fn array(
    [shape, chunk]: [Vec<usize>; 2],
    sample_type: SampleType,
    fill_value: Value,
    dimension_names: &[&str],
    attributes: Value,
) -> Value {
    let order = if sample_type.num_bytes() == 1 { json!({}) } else { json!({ "endian": "little" }) };
    json!({
        "zarr_format": 3,
        "node_type": "array",
        "shape": shape,
        "data_type": data_type(sample_type),
        "chunk_grid": { "name": "regular", "configuration": { "chunk_shape": chunk } },
        "chunk_key_encoding": { "name": "default", "configuration": { "separator": "/" } },
        "fill_value": fill_value,
        "codecs": [
            { "name": "bytes", "configuration": order },
            { "name": "zstd", "configuration": { "level": COMPRESSION_LEVEL, "checksum": false } },
        ],
        "dimension_names": dimension_names,
        "attributes": attributes,
    })
}

fn data_type(sample_type: SampleType) -> &'static str {
    match sample_type {
        SampleType::U8 => "uint8",
        SampleType::I8 => "int8",
        SampleType::U16 => "uint16",
        SampleType::I16 => "int16",
        SampleType::U32 => "uint32",
        SampleType::I32 => "int32",
        SampleType::U64 => "uint64",
        SampleType::I64 => "int64",
        SampleType::F32 => "float32",
        SampleType::F64 => "float64",
    }
}

/// A fill value as a JSON integer.
fn as_integer(value: f64) -> Value {
    let whole = value.round();
    if whole < 0.0 { json!(whole as i64) } else { json!(whole as u64) }
}
