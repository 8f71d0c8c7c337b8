//! Reading a store of cells: the header at once, geometry and spans when asked for.

use std::{
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use chronoxel_codec::{CodecError, Payload, decode_points, point_stage_from_bytes};
use chronoxel_core::BitMask;

use super::{
    BLOCK_STEPS, CellGeometry, CellHeader, CellSpanRecord, NESTED_FOLDER,
    arrays::CellArray,
    geometry,
    header::{group_text, is_of_cells},
    spans::SpanBlock,
};
use crate::{StoreError, cache::ByteCache, chunk, files, header, shard::ShardFile};

/// Bytes of spans, and of indexes of shards, that a store keeps.
const CACHE_BYTES: usize = 8 << 20;
/// Files that a store keeps open.
const MAX_OPEN_FILES: usize = 64;

/// A store of cells opened for reading. Reading takes `&self`, so that any number of threads may read at once.
#[derive(Debug)]
pub struct CellStore {
    root: PathBuf,
    header: CellHeader,
    /// The spans of a variable's blocks.
    spans: ByteCache<(usize, u32), Vec<CellSpanRecord>>,
    /// By variable, array and block.
    shards: ByteCache<(usize, CellArray, u32), ShardFile>,
    /// Masks by variable and row.
    masks: ByteCache<(usize, u32), BitMask>,
    bytes_read: AtomicU64,
}

/// Some steps of a variable at all points, as they are stored.
#[derive(Debug, Clone, PartialEq)]
pub struct CellPayload {
    /// The first of its steps.
    pub start: u32,
    /// Its steps.
    pub len: u32,
    /// One index per point and stage.
    pub payload: Arc<Payload>,
    /// Points without a value, at all of its steps.
    pub missing: Option<Arc<BitMask>>,
}

impl CellPayload {
    /// Writes the values of one of its steps, NaN where there is none.
    ///
    /// # Errors
    /// As [`decode_points`], and [`CodecError::InvalidArgument`] for another step or number of points.
    pub fn decode(&self, step: u32, values: &mut [f32]) -> Result<(), CodecError> {
        decode_points(&self.payload, step.wrapping_sub(self.start), values)?;
        if let Some(mask) = &self.missing {
            let of_bytes = values.chunks_mut(8).zip(&mask.bytes).filter(|(_, byte)| **byte != 0);
            for (values, byte) in of_bytes {
                for (bit, value) in values.iter_mut().enumerate() {
                    *value = if byte >> bit & 1 != 0 { f32::NAN } else { *value };
                }
            }
        }
        Ok(())
    }

    /// Bytes held in memory.
    pub fn num_bytes(&self) -> usize {
        let stage = |stage: &chronoxel_codec::Stage| stage.class().num_point_bytes(stage.indices.len());
        let mask = self.missing.as_ref().map_or(0, |mask| mask.bytes.len());
        size_of::<Self>() + self.payload.stages.iter().map(stage).sum::<usize>() + mask
    }
}

impl CellStore {
    /// Opens a store of cells: the folder itself, or the one that lies in a store of bricks.
    ///
    /// # Errors
    /// [`StoreError`] naming the file, the field and the value, and what the store has instead of cells.
    pub fn open(path: &Path) -> Result<Self, StoreError> {
        let root = Self::locate(path)?;
        let text = group_text(&root)?.unwrap_or_default();
        let header = CellHeader::from_text(&root.join("zarr.json"), &text)?;
        Ok(Self {
            root,
            header,
            spans: ByteCache::new(CACHE_BYTES, usize::MAX),
            shards: ByteCache::new(CACHE_BYTES, MAX_OPEN_FILES),
            masks: ByteCache::new(CACHE_BYTES, usize::MAX),
            bytes_read: AtomicU64::new(0),
        })
    }

    /// The folder of the store of cells at a path, if there is one: the path itself, or the folder that lies in a store of bricks.
    pub fn find(path: &Path) -> Option<PathBuf> {
        Self::locate(path).ok()
    }

    /// The folder of the store of cells at a path or within it.
    fn locate(path: &Path) -> Result<PathBuf, StoreError> {
        let metadata = std::fs::metadata(path).map_err(StoreError::io(path, "open"))?;
        if !metadata.is_dir() {
            let problem = "a store is a folder that ends in .cxl: make one with chronoxel encode --as cells";
            return Err(StoreError::corrupt(path, "path", "a file", problem));
        }
        let text = group_text(path)?;
        if text.as_ref().is_some_and(|text| is_of_cells(text)) {
            return Ok(path.to_owned());
        }
        let nested = path.join(NESTED_FOLDER);
        if group_text(&nested)?.is_some_and(|text| is_of_cells(&text)) {
            return Ok(nested);
        }
        let has_bricks = text.is_some_and(|text| text.contains(&format!("\"{}\"", header::ATTRIBUTE)));
        let (value, problem) = match has_bricks {
            true => ("bricks", "it has no cells: encode its source with --as cells or --as both"),
            false => ("absent", "this is not a Chronoxel store, or its making was interrupted"),
        };
        Err(StoreError::corrupt(&path.join("zarr.json"), "cells", value, problem))
    }

    /// The folder of the store.
    pub fn path(&self) -> &Path {
        &self.root
    }

    /// The header.
    pub fn header(&self) -> &CellHeader {
        &self.header
    }

    /// Whether every step of the series is there.
    pub fn is_complete(&self) -> bool {
        self.header.num_steps_finished == self.header.num_steps()
    }

    /// Bytes of geometry, spans, stages and masks that were read since the store was opened.
    pub fn bytes_read(&self) -> u64 {
        self.bytes_read.load(Ordering::Relaxed)
    }

    pub(super) fn count_read(&self, num_bytes: u64) {
        self.bytes_read.fetch_add(num_bytes, Ordering::Relaxed);
    }

    /// Bytes of all files of the store.
    ///
    /// # Errors
    /// [`StoreError::Io`] if a folder cannot be listed.
    pub fn stored_bytes(&self) -> Result<u64, StoreError> {
        Ok(files::list(&self.root)?.files.iter().map(|(_, len)| len).sum())
    }

    /// Points and tetrahedra: finite points, and corners that are points.
    ///
    /// # Errors
    /// [`StoreError::Corrupt`] naming the file for what is damaged or missing.
    pub fn read_geometry(&self) -> Result<CellGeometry, StoreError> {
        let (geometry, num_bytes) = geometry::read(&self.root, &self.header)?;
        self.count_read(num_bytes);
        Ok(geometry)
    }

    /// The span of a variable that holds a step.
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if variable or step is out of range, [`StoreError::Corrupt`] for what is damaged.
    pub fn span_at(&self, variable: usize, step: u32) -> Result<CellSpanRecord, StoreError> {
        let num_finished = self.header.num_steps_finished;
        if step >= num_finished {
            let remedy = format!("the store has {num_finished} finished steps");
            return Err(StoreError::invalid("step", step, remedy));
        }
        let spans = self.spans(variable, step / BLOCK_STEPS)?;
        let after = spans.partition_point(|span| span.start <= step);
        Ok(spans[after - 1])
    }

    /// The spans of a block of 64 steps, in order.
    ///
    /// # Errors
    /// As [`Self::span_at`].
    pub fn spans(&self, variable: usize, block: u32) -> Result<Arc<Vec<CellSpanRecord>>, StoreError> {
        self.check_variable(variable)?;
        if block >= self.header.num_steps_finished.div_ceil(BLOCK_STEPS) {
            let remedy = format!("the store has {} finished steps", self.header.num_steps_finished);
            return Err(StoreError::invalid("block of 64 steps", block, remedy));
        }
        if let Some(spans) = self.spans.get(&(variable, block)) {
            return Ok(spans);
        }
        let path = self.root.join(self.header.spans_file(variable, block));
        let most = chunk::largest_stored(SpanBlock::NUM_BYTES) as u64;
        let Some(stored) = files::read_whole(&path, most)? else {
            return Err(StoreError::corrupt(&path, "file", "absent", "the spans of its steps are lost"));
        };
        self.count_read(stored.len() as u64);
        let spans = SpanBlock::decode(&stored).and_then(|b| b.records(&self.header, variable, block));
        let spans = spans.map_err(|problem| {
            StoreError::corrupt(&path, "spans", format!("{} bytes", stored.len()), problem)
        })?;
        let spans = Arc::new(spans);
        let num_bytes = spans.len() * size_of::<CellSpanRecord>();
        self.spans.insert((variable, block), spans.clone(), num_bytes);
        Ok(spans)
    }

    /// What is stored for a span.
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if the span is not of this store, [`StoreError::Corrupt`] naming the file if its bytes
    /// are damaged or missing.
    pub fn read_span(
        &self,
        variable: usize,
        record: &CellSpanRecord,
    ) -> Result<Arc<CellPayload>, StoreError> {
        self.check_variable(variable)?;
        let place = |record: &CellSpanRecord| (record.start, record.len, record.class, record.mask);
        if record.start >= self.header.num_steps_finished
            || place(&self.span_at(variable, record.start)?) != place(record)
        {
            let value = format!("{} steps from step {} on", record.len, record.start);
            return Err(StoreError::invalid("span", value, "it is not one of this store's"));
        }
        let class = &self.header.variables[variable].classes[usize::from(record.class)];
        let mut stages = Vec::with_capacity(class.stages.len());
        for (number, form) in class.stages.iter().enumerate() {
            let array = CellArray::Stage { class: record.class, stage: number as u8 };
            let bytes = self.read_chunk(variable, array, record.start)?;
            let stage = point_stage_from_bytes(form, self.header.num_points as usize, &bytes);
            stages.push(stage.map_err(|error| self.chunk_error(variable, array, record.start, error))?);
        }
        let missing = record.mask.map(|row| self.mask(variable, row)).transpose()?;
        let payload = Arc::new(Payload { stages });
        Ok(Arc::new(CellPayload { start: record.start, len: record.len, payload, missing }))
    }

    /// The mask that is stored at a step.
    pub(super) fn mask(&self, variable: usize, row: u32) -> Result<Arc<BitMask>, StoreError> {
        if let Some(mask) = self.masks.get(&(variable, row)) {
            return Ok(mask);
        }
        let bytes = self.read_chunk(variable, CellArray::Mask, row)?;
        let unused = bytes.len() as u64 * 8 - self.header.num_points;
        if bytes.last().is_some_and(|last| unused > 0 && last >> (8 - unused) != 0) {
            let problem = "bits after the mask's last are set";
            return Err(self.chunk_error(variable, CellArray::Mask, row, problem));
        }
        let mask = Arc::new(BitMask { bytes });
        self.masks.insert((variable, row), mask.clone(), mask.bytes.len());
        Ok(mask)
    }

    fn check_variable(&self, variable: usize) -> Result<(), StoreError> {
        let num_variables = self.header.variables.len();
        match variable < num_variables {
            true => Ok(()),
            false => Err(StoreError::invalid("variable", variable, format!("the store has {num_variables}"))),
        }
    }

    /// The bytes of the inner chunk of a step.
    fn read_chunk(&self, variable: usize, array: CellArray, step: u32) -> Result<Vec<u8>, StoreError> {
        let block = step / BLOCK_STEPS;
        let missing = |problem: &str| self.chunk_error(variable, array, step, problem);
        let shard = self.shard(variable, array, block)?.ok_or_else(|| missing("the file is missing"))?;
        let extent = shard.extent(self.header.slot(variable, array, step));
        let [offset, len] = extent.ok_or_else(|| missing("the bytes are missing from the shard"))?;
        let stored = shard.read_range(offset, len as usize)?;
        self.count_read(len);
        shard.decode(&stored).map_err(|problem| self.chunk_error(variable, array, step, problem))
    }

    /// An opened shard; `None` where its file is absent.
    pub(super) fn shard(
        &self,
        variable: usize,
        array: CellArray,
        block: u32,
    ) -> Result<Option<Arc<ShardFile>>, StoreError> {
        let key = (variable, array, block);
        if let Some(shard) = self.shards.get(&key) {
            return Ok(Some(shard));
        }
        let path = self.root.join(self.header.shard_file(variable, array, block));
        let num_slots = self.header.num_slots(variable, array);
        let opened = ShardFile::open(&path, num_slots, self.header.chunk_bytes(variable, array))?;
        Ok(opened.map(|shard| {
            self.count_read(16 * num_slots as u64 + 4);
            let (bytes, shard) = (shard.num_bytes(), Arc::new(shard));
            self.shards.insert(key, shard.clone(), bytes);
            shard
        }))
    }

    pub(super) fn chunk_error(
        &self,
        variable: usize,
        array: CellArray,
        step: u32,
        problem: impl ToString,
    ) -> StoreError {
        let path = self.root.join(self.header.shard_file(variable, array, step / BLOCK_STEPS));
        let field = format!("{} at step {step}", self.header.variables[variable].name);
        StoreError::corrupt(&path, field, "damaged", problem.to_string())
    }
}
