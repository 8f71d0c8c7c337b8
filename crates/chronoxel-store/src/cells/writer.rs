//! Writing a store of cells: geometry first, then block after block of 64 steps.
//!
//! The files of a block are written under their own names before the header speaks of them; what a killed writer left
//! behind beyond the header is removed by a resume, which begins with that block.

use std::{
    fs,
    path::{Path, PathBuf},
};

use chronoxel_core::BitMask;
use rayon::prelude::*;

use super::{
    BLOCK_STEPS, CellClass, CellDescription, CellGeometry, CellHeader, CellSpanRecord, CellSpanWrite,
    CellStore, CellTotals,
    arrays::{CellArray, SPANS_ZSTD_LEVEL},
    geometry,
    header::{group_text, is_of_cells},
    spans::SpanBlock,
};
use crate::{
    StoreError, chunk, files, journal, layout,
    shard::OpenShard,
    writer::{make_room, partial_path},
};

/// Writes one store of cells; see the module for the order of calls.
///
/// A writer that is dropped leaves a store that opens up to the last committed block, if any, and that [`Self::resume`] goes on with.
#[derive(Debug)]
pub struct CellStoreWriter {
    root: PathBuf,
    header: CellHeader,
    /// The header as it will be once the open block is committed.
    open: CellHeader,
    /// For each variable, whether its spans of the open block were put.
    has_block: Vec<bool>,
    /// For each variable, the mask that was stored last, and its row.
    last_masks: Vec<Option<(u32, BitMask)>>,
    unsynced: Vec<PathBuf>,
}

/// The stored form of a chunk, and where it goes.
struct Encoded {
    array: CellArray,
    start: u32,
    num_bytes: u64,
    stored: Vec<u8>,
}

impl CellStoreWriter {
    /// Starts a store and writes its geometry. The folder must not exist, or be empty, or with `overwrite` be a store.
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if the folder is in the way or description or geometry is not sound,
    /// [`StoreError::Io`] if the system refuses.
    pub fn create(
        path: &Path,
        description: &CellDescription,
        geometry: &CellGeometry,
        overwrite: bool,
    ) -> Result<Self, StoreError> {
        let header = CellHeader::of_description(description, &geometry.summary()?)?;
        make_room(path, overwrite)?;
        let journal = path.join(journal::FOLDER);
        fs::create_dir_all(&journal).map_err(StoreError::io(&journal, "create"))?;
        let mut writer = Self::fresh(path, header);
        writer.write_children()?;
        let (paths, num_bytes) = geometry::write(path, &writer.header, geometry)?;
        writer.unsynced.extend(paths);
        writer.open.totals.geometry_bytes = num_bytes;
        writer.commit(0)?;
        Ok(writer)
    }

    /// Goes on with a store that was interrupted, or starts it where there is none; also gives the first step that must be
    /// put. Where the folder is absent and `NAME.partial.cxl` is there, that is taken. The finished store is byte
    /// for byte the one that an uninterrupted run makes.
    ///
    /// # Errors
    /// As [`Self::create`], and if the store was begun with another geometry, description or options.
    pub fn resume(
        path: &Path,
        description: &CellDescription,
        geometry: &CellGeometry,
    ) -> Result<(Self, u32), StoreError> {
        let partial = partial_path(path);
        if !path.exists() && partial.is_dir() {
            files::rename(&partial, path)?;
        }
        if !group_text(path)?.is_some_and(|text| is_of_cells(&text)) {
            // A writer that was killed before its first commit left nothing but its own.
            let is_begun = path.join(journal::FOLDER).is_dir();
            return Ok((Self::create(path, description, geometry, is_begun)?, 0));
        }
        let store = CellStore::open(path)?;
        let header = CellHeader::of_description(description, &geometry.summary()?)?;
        if without_progress(store.header()) != header {
            let remedy = "it was begun with another source or other options: use the same, or overwrite it";
            return Err(StoreError::invalid("store to resume", path.display(), remedy));
        }
        let num_finished = store.header().num_steps_finished;
        let mut writer = Self::fresh(path, store.header().clone());
        let journal = path.join(journal::FOLDER);
        fs::create_dir_all(&journal).map_err(StoreError::io(&journal, "create"))?;
        writer.remove_unfinished()?;
        for variable in 0..header.variables.len() {
            writer.last_masks[variable] = last_mask(&store, variable)?;
        }
        Ok((writer, num_finished))
    }

    fn fresh(path: &Path, header: CellHeader) -> Self {
        let num_variables = header.variables.len();
        Self {
            root: path.to_owned(),
            open: header.clone(),
            header,
            has_block: vec![false; num_variables],
            last_masks: vec![None; num_variables],
            unsynced: Vec::new(),
        }
    }

    /// The header as of the last commit.
    pub fn header(&self) -> &CellHeader {
        &self.header
    }

    /// Writes the spans of the next block of a variable: they partition its steps, in order.
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if they do not, or contradict the description, [`StoreError::Io`] if the system refuses.
    pub fn put(&mut self, variable: usize, spans: &[CellSpanWrite]) -> Result<(), StoreError> {
        if self.has_block.get(variable) != Some(&false) {
            return Err(StoreError::invalid("variable", variable, "each is put once for each block"));
        }
        let records = self.records_of(variable, spans)?;
        self.write_children()?;
        self.write_bytes(variable, spans, &records)?;
        let block = self.header.num_steps_finished / BLOCK_STEPS;
        let stored = SpanBlock::of(&records).encode(SPANS_ZSTD_LEVEL);
        let path = self.root.join(self.open.spans_file(variable, block));
        let stored = stored.map_err(StoreError::io(&path, "compress"))?;
        self.write_whole(&path, &stored)?;
        let entry = &mut self.open.variables[variable];
        for statistics in spans.iter().map(|span| span.statistics).filter(|s| s.count > 0) {
            entry.min = Some(entry.min.map_or(statistics.min, |min| min.min(statistics.min)));
            entry.max = Some(entry.max.map_or(statistics.max, |max| max.max(statistics.max)));
        }
        self.has_block[variable] = true;
        Ok(())
    }

    /// Makes the block that was put for all variables part of the store.
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if a variable was not put, [`StoreError::Io`] if the system refuses.
    pub fn commit_block(&mut self) -> Result<(), StoreError> {
        if let Some(variable) = self.has_block.iter().position(|has| !has) {
            let name = &self.open.variables[variable].name;
            return Err(StoreError::invalid("variable", name, "its spans of the block are missing"));
        }
        let finished = self.header.num_steps_finished.saturating_add(BLOCK_STEPS);
        self.commit(finished.min(self.header.num_steps()))?;
        self.has_block.fill(false);
        Ok(())
    }

    /// Completes the store once every block is committed.
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if steps are missing, [`StoreError::Io`] if the system refuses.
    pub fn finish(self) -> Result<CellTotals, StoreError> {
        if self.header.num_steps_finished < self.header.num_steps() {
            let remedy = format!("the series has {} steps", self.header.num_steps());
            return Err(StoreError::invalid("number of steps", self.header.num_steps_finished, remedy));
        }
        files::sync_all(&[self.root.join("zarr.json")])?;
        files::remove_folder(&self.root.join(journal::FOLDER))?;
        files::sync_folder(&self.root)?;
        Ok(self.header.totals)
    }

    /// Gives up after a failure. Where no block was committed the folder is removed; else it is renamed from `NAME.cxl` to
    /// `NAME.partial.cxl`, whose path is returned, and of which a resume goes on.
    ///
    /// # Errors
    /// [`StoreError::Io`] if the system refuses.
    pub fn abandon(self) -> Result<Option<PathBuf>, StoreError> {
        if self.header.num_steps_finished == 0 {
            files::remove_folder(&self.root)?;
            return Ok(None);
        }
        if self.root.ends_with(super::NESTED_FOLDER) {
            return Ok(Some(self.root));
        }
        let partial = partial_path(&self.root);
        files::remove_folder(&partial)?;
        files::rename(&self.root, &partial)?;
        Ok(Some(partial))
    }

    /// The records of spans, which must be those of the open block; gives each its class and the place of its mask.
    fn records_of(
        &mut self,
        variable: usize,
        spans: &[CellSpanWrite],
    ) -> Result<Vec<CellSpanRecord>, StoreError> {
        let mut next = self.header.num_steps_finished;
        let end = next.saturating_add(BLOCK_STEPS).min(self.header.num_steps());
        let mut records = Vec::with_capacity(spans.len());
        for span in spans {
            let foreign = |remedy: &str| {
                let value = format!("window {} from step {} on", span.window, span.start);
                Err(StoreError::invalid("span", value, remedy))
            };
            if span.start != next || next >= end || span.window == 0 || !next.is_multiple_of(span.window) {
                return foreign("spans follow each other, at multiples of their window");
            }
            let len = self.header.span_len(span.start, span.window);
            let class = CellClass {
                window: span.window,
                stages: span.payload.stages.iter().map(|s| s.class()).collect(),
            };
            let num_points = self.header.num_points as usize;
            let is_full = |stage: &chronoxel_codec::Stage| stage.indices.len() == num_points;
            let mask_is_full =
                span.missing.as_ref().is_none_or(|mask| mask.bytes.len() == num_points.div_ceil(8));
            if !class.fits(len) || !span.payload.stages.iter().all(is_full) || !mask_is_full {
                return foreign("it must have a value for each point and a row for each of its steps");
            }
            next += len;
            let mask = span.missing.as_ref().map(|mask| self.mask_row(variable, span.start, mask));
            records.push(CellSpanRecord {
                start: span.start,
                len,
                class: self.class_index(variable, class)?,
                mask,
                drawn_min: span.drawn_range[0],
                drawn_max: span.drawn_range[1],
                statistics: span.statistics,
                rms_error: span.rms_error,
                max_error: span.max_error,
            });
        }
        match next == end {
            true => Ok(records),
            false => Err(StoreError::invalid("spans of a block", next, format!("they end at step {end}"))),
        }
    }

    fn class_index(&mut self, variable: usize, class: CellClass) -> Result<u8, StoreError> {
        let classes = &mut self.open.variables[variable].classes;
        let index = classes.iter().position(|found| *found == class).unwrap_or(classes.len());
        if index == classes.len() {
            classes.push(class);
        }
        u8::try_from(index)
            .ok()
            .filter(|&index| index < u8::MAX)
            .ok_or_else(|| StoreError::invalid("number of classes", index + 1, "use at most 255"))
    }

    /// Where a mask is stored: at the step at which it was put first, if nothing but it was put since.
    fn mask_row(&mut self, variable: usize, start: u32, mask: &BitMask) -> u32 {
        match &self.last_masks[variable] {
            Some((row, last)) if last == mask => *row,
            _ => {
                self.last_masks[variable] = Some((start, mask.clone()));
                start
            }
        }
    }

    /// Writes the shards of stages and masks of a block.
    fn write_bytes(
        &mut self,
        variable: usize,
        spans: &[CellSpanWrite],
        records: &[CellSpanRecord],
    ) -> Result<(), StoreError> {
        let level = self.header.zstd_level;
        let failed = StoreError::io(&self.root, "compress a part of");
        let encode = |(span, record): (&CellSpanWrite, &CellSpanRecord)| {
            let encode = |array, bytes: &[u8]| -> std::io::Result<Encoded> {
                let stored = chunk::encode(bytes, level)?;
                Ok(Encoded { array, start: span.start, num_bytes: bytes.len() as u64, stored })
            };
            let mut encoded = Vec::new();
            for (number, stage) in span.payload.stages.iter().enumerate() {
                let array = CellArray::Stage { class: record.class, stage: number as u8 };
                encoded.push(encode(array, &chronoxel_codec::point_stage_to_bytes(stage))?);
            }
            if let Some(mask) = span.missing.as_ref().filter(|_| record.mask == Some(record.start)) {
                encoded.push(encode(CellArray::Mask, &mask.bytes)?);
            }
            Ok(encoded)
        };
        let pairs: Vec<_> = spans.iter().zip(records).collect();
        let encoded: std::io::Result<Vec<Vec<Encoded>>> = pairs.into_par_iter().map(encode).collect();
        let mut encoded: Vec<Encoded> = encoded.map_err(failed)?.into_iter().flatten().collect();
        encoded.sort_by_key(|chunk| (chunk.array, chunk.start));
        for chunks in encoded.chunk_by(|a, b| a.array == b.array) {
            self.write_shard(variable, chunks)?;
        }
        let totals = &mut self.open.totals;
        totals.spans += records.len() as u64;
        totals.masked += records.iter().filter(|record| record.mask.is_some()).count() as u64;
        for chunk in &encoded {
            let stored = chunk.stored.len() as u64;
            match chunk.array {
                CellArray::Mask => {
                    (totals.masks, totals.mask_bytes) = (totals.masks + 1, totals.mask_bytes + stored)
                }
                CellArray::Stage { .. } => {
                    totals.stage_bytes += chunk.num_bytes;
                    totals.payload_bytes += stored;
                }
            }
        }
        Ok(())
    }

    fn write_shard(&mut self, variable: usize, chunks: &[Encoded]) -> Result<(), StoreError> {
        let (array, start) = (chunks[0].array, chunks[0].start);
        let path = self.root.join(self.open.shard_file(variable, array, start / BLOCK_STEPS));
        let temporary = self.temporary();
        let num_slots = self.open.num_slots(variable, array);
        let mut shard =
            OpenShard::create(temporary.clone(), num_slots, self.open.chunk_bytes(variable, array))?;
        for chunk in chunks {
            shard.append(self.open.slot(variable, array, chunk.start), &chunk.stored)?;
        }
        self.open.totals.data_bytes += shard.close()?;
        files::rename(&temporary, &path)?;
        self.unsynced.push(path);
        Ok(())
    }

    fn write_whole(&mut self, path: &Path, bytes: &[u8]) -> Result<(), StoreError> {
        let temporary = self.temporary();
        files::write(&temporary, bytes)?;
        files::rename(&temporary, path)?;
        self.open.totals.data_bytes += bytes.len() as u64;
        self.unsynced.push(path.to_owned());
        Ok(())
    }

    fn temporary(&self) -> PathBuf {
        self.root.join(journal::FOLDER).join("next")
    }

    /// Makes the folders and the metadata of all arrays that the open header speaks of, where they are not yet.
    fn write_children(&mut self) -> Result<(), StoreError> {
        let masks = |variable: usize| self.last_masks[variable].is_some();
        let has_masks: Vec<bool> = (0..self.has_block.len()).map(masks).collect();
        for child in self.open.children()? {
            let of_masks = |(variable, has): (usize, &bool)| {
                *has && child.folder == format!("{}/mask", self.open.variables[variable].folder)
            };
            let is_due = !child.if_used || has_masks.iter().enumerate().any(of_masks);
            let (folder, file) = (self.root.join(&child.folder), self.root.join(child.file()));
            if is_due && !file.is_file() {
                fs::create_dir_all(&folder).map_err(StoreError::io(&folder, "create"))?;
                let temporary = self.temporary();
                files::write(&temporary, child.text.as_bytes())?;
                files::rename(&temporary, &file)?;
                self.unsynced.push(file);
            }
        }
        Ok(())
    }

    /// Writes the header, once what it speaks of is on disk.
    fn commit(&mut self, num_steps_finished: u32) -> Result<(), StoreError> {
        files::sync_all(&self.unsynced)?;
        self.unsynced.clear();
        self.open.num_steps_finished = num_steps_finished;
        let temporary = self.temporary();
        files::write(&temporary, self.open.to_text()?.as_bytes())?;
        files::sync_all(std::slice::from_ref(&temporary))?;
        files::rename(&temporary, &self.root.join("zarr.json"))?;
        self.header = self.open.clone();
        Ok(())
    }

    /// Removes what lies beyond the blocks of the header: files of values, and folders of classes and masks that no header speaks of.
    fn remove_unfinished(&self) -> Result<(), StoreError> {
        let num_blocks = self.header.num_steps_finished.div_ceil(BLOCK_STEPS);
        for (variable, entry) in self.header.variables.iter().enumerate() {
            let folder = self.root.join(&entry.folder);
            for name in files::names_in(&folder)? {
                let class = name.strip_prefix('C').and_then(|digits| digits.parse::<usize>().ok());
                if class.is_some_and(|class| class >= entry.classes.len()) {
                    files::remove_folder(&folder.join(name))?;
                }
            }
            let mut last_files: Vec<String> = vec![self.header.spans_file(variable, num_blocks)];
            let arrays = self.header.arrays_of(variable).into_iter();
            last_files.extend(arrays.map(|array| self.header.shard_file(variable, array, num_blocks)));
            for file in last_files {
                files::remove_file(&self.root.join(file))?;
            }
            self.remove_unused_masks(variable)?;
        }
        Ok(())
    }

    /// Removes the folder of masks of a variable if it holds none.
    fn remove_unused_masks(&self, variable: usize) -> Result<(), StoreError> {
        let folder = self.root.join(format!("{}/mask", self.header.variables[variable].folder));
        let has_shards = files::names_in(&folder)?.iter().any(|name| layout::block_of(name).is_some());
        if has_shards { Ok(()) } else { files::remove_folder(&folder) }
    }
}

/// The mask that a variable's spans were put with last, and its row.
fn last_mask(store: &CellStore, variable: usize) -> Result<Option<(u32, BitMask)>, StoreError> {
    for block in (0..store.header().num_steps_finished.div_ceil(BLOCK_STEPS)).rev() {
        let spans = store.spans(variable, block)?;
        if let Some(row) = spans.iter().rev().find_map(|span| span.mask) {
            return Ok(Some((row, BitMask::clone(&*store.mask(variable, row)?))));
        }
    }
    Ok(None)
}

/// A header as it was before the first block.
fn without_progress(header: &CellHeader) -> CellHeader {
    let mut header = header.clone();
    header.num_steps_finished = 0;
    header.totals = CellTotals::default();
    for variable in &mut header.variables {
        (variable.min, variable.max) = (None, None);
        variable.classes.clear();
    }
    header
}
