//! The arrays of a store: their names, shapes and Zarr metadata. Everything follows from the header, so
//! that `verify` can compare the metadata byte for byte.

use serde_json::{Value, json};

use crate::{Header, StoreError, layout, spans};

/// What an array of payload bytes holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum ArrayKind {
    /// Masks, one bit per sample.
    Mask,
    /// One stage of the payloads of a class.
    Stage { class: u8, stage: u8 },
}

/// A sharded array of bytes `[row, node, bytes]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct ArrayId {
    pub variable: u16,
    pub level: u8,
    pub window: u32,
    pub kind: ArrayKind,
}

/// One shard of an array.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct ShardId {
    pub array: ArrayId,
    pub shard: u32,
}

/// The chunks of spans of one window length of one level of one variable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct SpanChunkId {
    pub variable: u16,
    pub level: u8,
    pub window: u32,
    pub shard: u32,
}

impl Header {
    fn window_folder(&self, variable: u16, level: u8, window: u32) -> String {
        format!("{}/L{level}/W{window}", self.variables[usize::from(variable)].folder)
    }

    fn array_folder(&self, array: &ArrayId) -> String {
        let folder = self.window_folder(array.variable, array.level, array.window);
        match array.kind {
            ArrayKind::Mask => format!("{folder}/mask"),
            ArrayKind::Stage { class, stage } => format!("{folder}/C{class}/S{stage}"),
        }
    }

    /// The file of a shard, relative to the store.
    pub(crate) fn shard_file(&self, id: &ShardId) -> String {
        format!("{}/c.{}.0.0", self.array_folder(&id.array), id.shard)
    }

    /// The file of a chunk of spans, relative to the store.
    pub(crate) fn span_file(&self, id: &SpanChunkId) -> String {
        let folder = self.window_folder(id.variable, id.level, id.window);
        format!("{folder}/spans/c.{}.0.0", id.shard)
    }

    /// Bytes of one inner chunk of an array.
    pub(crate) fn chunk_bytes(&self, array: &ArrayId) -> usize {
        match array.kind {
            ArrayKind::Mask => self.bricks.num_full().div_ceil(8),
            ArrayKind::Stage { class, stage } => {
                let class = &self.variables[usize::from(array.variable)].classes[usize::from(class)];
                class.stages[usize::from(stage)].num_bytes(&self.bricks)
            }
        }
    }

    /// Bytes of a payload before compression: without the apron's indices, and those.
    pub(crate) fn payload_bytes(&self, variable: usize, class: u8) -> [u64; 2] {
        let num_apron = self.bricks.num_full() - self.bricks.num_core();
        let stages = &self.variables[variable].classes[usize::from(class)].stages;
        let apron: usize = stages.iter().map(|stage| stage.num_index_bytes() * num_apron).sum();
        let all: usize = stages.iter().map(|stage| stage.num_bytes(&self.bricks)).sum();
        [(all - apron) as u64, apron as u64]
    }

    /// Inner chunks of a shard of an array.
    pub(crate) fn num_slots(&self, array: &ArrayId) -> usize {
        self.rows_per_shard(array.window) as usize * self.num_nodes(array.level)
    }

    pub(crate) fn num_nodes(&self, level: u8) -> usize {
        self.levels[usize::from(level)].num_nodes
    }

    pub(crate) fn rows_per_shard(&self, window: u32) -> u32 {
        layout::rows_per_shard(self.steps_per_shard, window)
    }

    pub(crate) fn num_rows(&self, window: u32) -> u32 {
        layout::num_rows(self.num_steps(), window)
    }

    pub(crate) fn num_shards(&self, window: u32) -> u32 {
        self.num_rows(window).div_ceil(self.rows_per_shard(window))
    }

    /// The arrays of bytes of one window length of one level of one variable.
    pub(crate) fn arrays_of(&self, variable: u16, level: u8, window: u32) -> Vec<ArrayId> {
        let mut kinds = vec![ArrayKind::Mask];
        for (class, stages) in self.variables[usize::from(variable)].classes.iter().enumerate() {
            if stages.fits_window(window) {
                let stages = 0..stages.stages.len() as u8;
                kinds.extend(stages.map(|stage| ArrayKind::Stage { class: class as u8, stage }));
            }
        }
        kinds.into_iter().map(|kind| ArrayId { variable, level, window, kind }).collect()
    }

    /// All (variable, level, window) of the store.
    pub(crate) fn each_window(&self) -> impl Iterator<Item = (u16, u8, u32)> + '_ {
        self.variables.iter().enumerate().flat_map(move |(variable, entry)| {
            (0..self.levels.len() as u8).flat_map(move |level| {
                entry.windows.iter().map(move |&window| (variable as u16, level, window))
            })
        })
    }

    /// Every folder below the store with the text of its `zarr.json`, parents before children.
    pub(crate) fn children(&self) -> Result<Vec<(String, String)>, StoreError> {
        let mut documents = vec![("nodes".to_owned(), group())];
        for (level, entry) in self.levels.iter().enumerate() {
            documents.push((format!("nodes/L{level}"), nodes_array(entry.num_nodes)));
        }
        for (variable, entry) in self.variables.iter().enumerate() {
            documents.push((entry.folder.clone(), group()));
            for level in 0..self.levels.len() as u8 {
                documents.push((format!("{}/L{level}", entry.folder), group()));
                for &window in &entry.windows {
                    self.window_documents(variable as u16, level, window, &mut documents);
                }
            }
        }
        documents.into_iter().map(|(folder, document)| Ok((folder, text_of(&document)?))).collect()
    }

    fn window_documents(&self, variable: u16, level: u8, window: u32, documents: &mut Vec<(String, Value)>) {
        let folder = self.window_folder(variable, level, window);
        documents.push((folder.clone(), group()));
        documents.push((format!("{folder}/spans"), self.spans_array(level, window)));
        for array in self.arrays_of(variable, level, window) {
            if let ArrayKind::Stage { class, stage: 0 } = array.kind {
                documents.push((format!("{folder}/C{class}"), group()));
            }
            documents.push((self.array_folder(&array), self.bytes_array(&array)));
        }
    }

    fn spans_array(&self, level: u8, window: u32) -> Value {
        let (rows, nodes) = (self.num_rows(window), self.num_nodes(level));
        let fields = spans::FIELDS.len();
        array(
            json!({ "fields": spans::FIELDS }),
            json!([self.rows_per_shard(window), nodes, fields]),
            json!([little_endian(), self.zstd(), crc32c()]),
            "float64",
            json!(["row", "node", "field"]),
            json!("NaN"),
            json!([rows, nodes, fields]),
        )
    }

    fn bytes_array(&self, id: &ArrayId) -> Value {
        let bytes = self.chunk_bytes(id);
        let nodes = self.num_nodes(id.level);
        let sharding = json!({
            "configuration": {
                "chunk_shape": [1, 1, bytes],
                "codecs": [{ "name": "bytes" }, self.zstd(), crc32c()],
                "index_codecs": [little_endian(), crc32c()],
                "index_location": "end",
            },
            "name": "sharding_indexed",
        });
        array(
            json!({}),
            json!([self.rows_per_shard(id.window), nodes, bytes]),
            json!([sharding]),
            "uint8",
            json!(["row", "node", "byte"]),
            json!(0),
            json!([self.num_rows(id.window), nodes, bytes]),
        )
    }

    fn zstd(&self) -> Value {
        json!({ "configuration": { "checksum": false, "level": self.zstd_level }, "name": "zstd" })
    }
}

fn nodes_array(num_nodes: usize) -> Value {
    let codecs = json!([little_endian(), crc32c()]);
    array(json!({}), json!([num_nodes]), codecs, "uint64", json!(["node"]), json!(0), json!([num_nodes]))
}

// Keys are in alphabetical order, so that the text does not depend on how maps are ordered.
fn array(
    attributes: Value,
    chunk_shape: Value,
    codecs: Value,
    data_type: &str,
    dimension_names: Value,
    fill_value: Value,
    shape: Value,
) -> Value {
    json!({
        "attributes": attributes,
        "chunk_grid": { "configuration": { "chunk_shape": chunk_shape }, "name": "regular" },
        "chunk_key_encoding": { "configuration": { "separator": "." }, "name": "default" },
        "codecs": codecs,
        "data_type": data_type,
        "dimension_names": dimension_names,
        "fill_value": fill_value,
        "node_type": "array",
        "shape": shape,
        "zarr_format": 3,
    })
}

fn group() -> Value {
    json!({ "attributes": {}, "node_type": "group", "zarr_format": 3 })
}

fn little_endian() -> Value {
    json!({ "configuration": { "endian": "little" }, "name": "bytes" })
}

fn crc32c() -> Value {
    json!({ "name": "crc32c" })
}

fn text_of(document: &Value) -> Result<String, StoreError> {
    let text = serde_json::to_string_pretty(document);
    text.map(|text| text + "\n").map_err(|e| StoreError::invalid("metadata", e, "it must be plain JSON"))
}
