//! The arrays of a store: their names, shapes and Zarr metadata. Everything follows from the header, so
//! that `verify` can compare the metadata byte for byte.

use serde_json::{Value, json};

use crate::{
    Header, StoreError, layout,
    spans::{self, SpanChunk, SpanOrder},
    statistics,
};

/// Chunks of spans and statistics of so many bytes or less are small,
const SMALL_BYTES: usize = 128 << 10;
/// and compressed with this level of zstd;
const SMALL_ZSTD_LEVEL: i32 = 19;
/// larger ones with this.
const LARGE_ZSTD_LEVEL: i32 = 6;
/// Statistics are hardly smaller at higher levels than at this.
pub(crate) const STATISTICS_ZSTD_LEVEL: i32 = 9;

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

/// A folder below the store, and the text of its `zarr.json`.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Child {
    pub folder: String,
    pub text: String,
    /// Whether it exists only where there is data in it.
    pub if_used: bool,
}

impl Child {
    /// The file of the text, relative to the store.
    pub fn file(&self) -> String {
        format!("{}/zarr.json", self.folder)
    }
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

    /// The folder of an array that holds data: bytes of a kind, or spans.
    pub(crate) fn data_folder(&self, key: (u16, u8, u32), kind: Option<ArrayKind>) -> String {
        let (variable, level, window) = key;
        match kind {
            None => format!("{}/spans", self.window_folder(variable, level, window)),
            Some(kind) => self.array_folder(&ArrayId { variable, level, window, kind }),
        }
    }

    /// The arrays that hold data of one window length of one level of one variable: spans, and bytes of each kind.
    pub(crate) fn data_kinds(&self, (variable, level, window): (u16, u8, u32)) -> Vec<Option<ArrayKind>> {
        let arrays = self.arrays_of(variable, level, window).into_iter().map(|array| Some(array.kind));
        std::iter::once(None).chain(arrays).collect()
    }

    /// The folders that an array with data lies in, below its level, and its own, outermost first.
    pub(crate) fn data_children(
        &self,
        key: (u16, u8, u32),
        kind: Option<ArrayKind>,
    ) -> Result<Vec<Child>, StoreError> {
        let (variable, level, window) = key;
        let folder = self.window_folder(variable, level, window);
        let mut children = vec![self.child(folder.clone(), &group(), true)?];
        if let Some(ArrayKind::Stage { class, .. }) = kind {
            children.push(self.child(format!("{folder}/C{class}"), &group(), true)?);
        }
        let document = match kind {
            None => self.spans_array(level, window),
            Some(kind) => self.bytes_array(&ArrayId { variable, level, window, kind }),
        };
        children.push(self.child(self.data_folder(key, kind), &document, true)?);
        Ok(children)
    }

    /// The folders below the store that exist whatever is stored, parents before children.
    pub(crate) fn fixed_children(&self) -> Result<Vec<Child>, StoreError> {
        let mut children = vec![self.child("nodes".to_owned(), &group(), false)?];
        for (level, entry) in self.levels.iter().enumerate() {
            children.push(self.child(format!("nodes/L{level}"), &nodes_array(entry.num_nodes), false)?);
        }
        for (variable, entry) in self.variables.iter().enumerate() {
            children.push(self.child(entry.folder.clone(), &group(), false)?);
            if self.time_tree.is_some() {
                children.push(self.child(format!("{}/time", entry.folder), &group(), false)?);
            }
            for time_level in self.time_levels() {
                let folder = self.statistics_folder(variable as u16, time_level);
                children.push(self.child(folder, &self.statistics_array(time_level), false)?);
            }
            for level in 0..self.levels.len() {
                children.push(self.child(format!("{}/L{level}", entry.folder), &group(), false)?);
            }
        }
        Ok(children)
    }

    /// Every folder there can be below the store.
    pub(crate) fn children(&self) -> Result<Vec<Child>, StoreError> {
        let mut children = self.fixed_children()?;
        for key in self.each_window() {
            for kind in self.data_kinds(key) {
                children.extend(self.data_children(key, kind)?);
            }
        }
        children.sort_by(|a, b| a.folder.cmp(&b.folder));
        children.dedup_by(|a, b| a.folder == b.folder);
        Ok(children)
    }

    fn child(&self, folder: String, document: &Value, if_used: bool) -> Result<Child, StoreError> {
        let text = match self.sparse {
            true => serde_json::to_string(document),
            false => serde_json::to_string_pretty(document),
        };
        let text = text.map_err(|e| StoreError::invalid("metadata", e, "it must be plain JSON"))?;
        Ok(Child { folder, text: text + "\n", if_used: if_used && self.sparse })
    }

    fn spans_array(&self, level: u8, window: u32) -> Value {
        let (rows, nodes) = (self.num_rows(window), self.num_nodes(level));
        let fields = spans::FIELDS.len();
        let zstd = zstd(self.span_zstd_level(level, window));
        let codecs = match self.sparse {
            // Field after field: equal numbers lie beside each other.
            true => json!([transpose(), little_endian(), zstd, crc32c()]),
            false => json!([little_endian(), zstd, crc32c()]),
        };
        array(
            json!({ "fields": spans::FIELDS }),
            json!([self.rows_per_shard(window), nodes, fields]),
            codecs,
            "float64",
            json!(["row", "node", "field"]),
            json!("NaN"),
            json!([rows, nodes, fields]),
        )
    }

    fn statistics_array(&self, time_level: u8) -> Value {
        let (rows, nodes) = (self.num_statistics_rows(time_level), self.num_tree_nodes());
        let fields = statistics::FIELDS.len();
        array(
            json!({ "fields": statistics::FIELDS }),
            json!([self.statistics_rows_per_chunk(time_level), nodes, fields]),
            json!([transpose(), little_endian(), zstd(STATISTICS_ZSTD_LEVEL), crc32c()]),
            "float64",
            json!(["index", "node", "field"]),
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
                "codecs": [{ "name": "bytes" }, zstd(self.zstd_level), crc32c()],
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

    /// In which order the numbers of a chunk of spans are stored.
    pub(crate) fn span_order(&self) -> SpanOrder {
        if self.sparse { SpanOrder::ByField } else { SpanOrder::BySpan }
    }

    /// Level of zstd for a level's chunks of spans.
    pub(crate) fn span_zstd_level(&self, level: u8, window: u32) -> i32 {
        match self.sparse {
            false => self.zstd_level,
            true => number_zstd_level(SpanChunk::size(self.rows_per_shard(window), self.num_nodes(level))),
        }
    }
}

/// Level of zstd for a chunk of numbers of so many bytes. Small ones are worth the time.
pub(crate) fn number_zstd_level(num_bytes: usize) -> i32 {
    if num_bytes <= SMALL_BYTES { SMALL_ZSTD_LEVEL } else { LARGE_ZSTD_LEVEL }
}

pub(crate) fn zstd(level: i32) -> Value {
    json!({ "configuration": { "checksum": false, "level": level }, "name": "zstd" })
}

fn transpose() -> Value {
    json!({ "configuration": { "order": [2, 0, 1] }, "name": "transpose" })
}

fn nodes_array(num_nodes: usize) -> Value {
    let codecs = json!([little_endian(), crc32c()]);
    array(json!({}), json!([num_nodes]), codecs, "uint64", json!(["node"]), json!(0), json!([num_nodes]))
}

// Keys are in alphabetical order, so that the text does not depend on how maps are ordered.
pub(crate) fn array(
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

pub(crate) fn group() -> Value {
    json!({ "attributes": {}, "node_type": "group", "zarr_format": 3 })
}

pub(crate) fn little_endian() -> Value {
    json!({ "configuration": { "endian": "little" }, "name": "bytes" })
}

pub(crate) fn crc32c() -> Value {
    json!({ "name": "crc32c" })
}
