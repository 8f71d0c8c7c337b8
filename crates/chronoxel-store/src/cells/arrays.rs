//! The arrays of a store of cells: their folders, files and Zarr metadata, all of which follow from the header.

use serde_json::{Value, json};

use super::{BLOCK_STEPS, CellHeader, spans};
use crate::{
    StoreError,
    arrays::{Child, array, crc32c, group, little_endian, zstd},
};

/// Most points, or tetrahedra, of a chunk of geometry.
const GEOMETRY_ROWS: u64 = 1 << 16;
/// Level of zstd for geometry, which is written once,
pub(crate) const GEOMETRY_ZSTD_LEVEL: i32 = 9;
/// and for spans, which are small.
pub(crate) const SPANS_ZSTD_LEVEL: i32 = 19;

/// A sharded array of bytes of a variable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum CellArray {
    /// Bit planes `[step, bytes]`.
    Mask,
    /// A stage of the spans of a class, `[row, bytes]`; the row of a span is its start over the class's window.
    Stage { class: u8, stage: u8 },
}

/// One of the two arrays of the geometry.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum GeometryArray {
    /// `f64` `[point, 3]`.
    Points,
    /// `u32` `[cell, 4]`.
    Tetrahedra,
}

impl GeometryArray {
    pub const ALL: [Self; 2] = [Self::Points, Self::Tetrahedra];

    pub fn folder(self) -> &'static str {
        match self {
            Self::Points => "points",
            Self::Tetrahedra => "tetrahedra",
        }
    }

    /// Numbers of a row.
    pub fn width(self) -> usize {
        match self {
            Self::Points => 3,
            Self::Tetrahedra => 4,
        }
    }

    pub fn num_rows(self, header: &CellHeader) -> u64 {
        match self {
            Self::Points => header.num_points,
            Self::Tetrahedra => header.num_tetrahedra,
        }
    }

    /// Rows of a chunk: the last is filled up.
    pub fn chunk_rows(self, header: &CellHeader) -> u64 {
        self.num_rows(header).min(GEOMETRY_ROWS)
    }

    pub fn num_chunks(self, header: &CellHeader) -> u64 {
        self.num_rows(header).div_ceil(GEOMETRY_ROWS)
    }

    /// The file of a chunk, relative to the store.
    pub fn file(self, chunk: u64) -> String {
        format!("{}/c.{chunk}.0", self.folder())
    }

    fn metadata(self, header: &CellHeader) -> Value {
        let (data_type, axes, fill_value) = match self {
            Self::Points => ("float64", json!(["point", "axis"]), json!(0.0)),
            Self::Tetrahedra => ("uint32", json!(["cell", "corner"]), json!(0)),
        };
        // Column after column: neighbouring points share their high bytes.
        let transpose = json!({ "configuration": { "order": [1, 0] }, "name": "transpose" });
        array(
            json!({}),
            json!([self.chunk_rows(header), self.width()]),
            json!([transpose, little_endian(), zstd(GEOMETRY_ZSTD_LEVEL), crc32c()]),
            data_type,
            axes,
            fill_value,
            json!([self.num_rows(header), self.width()]),
        )
    }
}

impl CellHeader {
    fn array_folder(&self, variable: usize, array: CellArray) -> String {
        let folder = &self.variables[variable].folder;
        match array {
            CellArray::Mask => format!("{folder}/mask"),
            CellArray::Stage { class, stage } => format!("{folder}/C{class}/S{stage}"),
        }
    }

    /// The file of the shard of a block, relative to the store.
    pub(crate) fn shard_file(&self, variable: usize, array: CellArray, block: u32) -> String {
        format!("{}/c.{block}.0", self.array_folder(variable, array))
    }

    /// The file of the spans of a block, relative to the store.
    pub(crate) fn spans_file(&self, variable: usize, block: u32) -> String {
        format!("{}/spans/c.{block}.0", self.variables[variable].folder)
    }

    /// Steps between two rows of an array.
    pub(crate) fn row_steps(&self, variable: usize, array: CellArray) -> u32 {
        match array {
            CellArray::Mask => 1,
            CellArray::Stage { class, .. } => self.variables[variable].classes[usize::from(class)].window,
        }
    }

    /// Inner chunks of a shard: the rows of a block.
    pub(crate) fn num_slots(&self, variable: usize, array: CellArray) -> usize {
        (BLOCK_STEPS / self.row_steps(variable, array)) as usize
    }

    /// The inner chunk of a span, or of a mask, in the shard of its block.
    pub(crate) fn slot(&self, variable: usize, array: CellArray, step: u32) -> usize {
        (step % BLOCK_STEPS / self.row_steps(variable, array)) as usize
    }

    /// Bytes of one inner chunk of an array.
    pub(crate) fn chunk_bytes(&self, variable: usize, array: CellArray) -> usize {
        let num_points = self.num_points as usize;
        match array {
            CellArray::Mask => num_points.div_ceil(8),
            CellArray::Stage { class, stage } => {
                let class = &self.variables[variable].classes[usize::from(class)];
                class.stages[usize::from(stage)].num_point_bytes(num_points)
            }
        }
    }

    /// The arrays of bytes of a variable.
    pub(crate) fn arrays_of(&self, variable: usize) -> Vec<CellArray> {
        let mut arrays = vec![CellArray::Mask];
        for (class, form) in self.variables[variable].classes.iter().enumerate() {
            let stages = 0..form.stages.len() as u8;
            arrays.extend(stages.map(|stage| CellArray::Stage { class: class as u8, stage }));
        }
        arrays
    }

    /// Every folder below the store, parents before children; those of masks only where there are any.
    pub(crate) fn children(&self) -> Result<Vec<Child>, StoreError> {
        let mut children = Vec::new();
        for geometry in GeometryArray::ALL {
            children.push(child(geometry.folder().to_owned(), &geometry.metadata(self), false)?);
        }
        for (variable, entry) in self.variables.iter().enumerate() {
            children.push(child(entry.folder.clone(), &group(), false)?);
            children.push(child(format!("{}/spans", entry.folder), &self.spans_array(), false)?);
            for array in self.arrays_of(variable) {
                if let CellArray::Stage { class, stage: 0 } = array {
                    children.push(child(format!("{}/C{class}", entry.folder), &group(), false)?);
                }
                let (folder, document) =
                    (self.array_folder(variable, array), self.bytes_array(variable, array));
                children.push(child(folder, &document, array == CellArray::Mask)?);
            }
        }
        Ok(children)
    }

    fn spans_array(&self) -> Value {
        let fields = spans::FIELDS.len();
        let transpose = json!({ "configuration": { "order": [1, 0] }, "name": "transpose" });
        array(
            json!({ "fields": spans::FIELDS }),
            json!([BLOCK_STEPS, fields]),
            json!([transpose, little_endian(), zstd(SPANS_ZSTD_LEVEL), crc32c()]),
            "float64",
            json!(["step", "field"]),
            json!("NaN"),
            json!([self.num_steps(), fields]),
        )
    }

    fn bytes_array(&self, variable: usize, id: CellArray) -> Value {
        let bytes = self.chunk_bytes(variable, id);
        let rows = self.num_steps().div_ceil(self.row_steps(variable, id));
        let sharding = json!({
            "configuration": {
                "chunk_shape": [1, bytes],
                "codecs": [{ "name": "bytes" }, zstd(self.zstd_level), crc32c()],
                "index_codecs": [little_endian(), crc32c()],
                "index_location": "end",
            },
            "name": "sharding_indexed",
        });
        array(
            json!({}),
            json!([self.num_slots(variable, id), bytes]),
            json!([sharding]),
            "uint8",
            json!(["row", "byte"]),
            json!(0),
            json!([rows, bytes]),
        )
    }
}

fn child(folder: String, document: &Value, if_used: bool) -> Result<Child, StoreError> {
    let text = serde_json::to_string(document);
    let text = text.map_err(|e| StoreError::invalid("metadata", e, "it must be plain JSON"))?;
    Ok(Child { folder, text: text + "\n", if_used })
}
