//! Reading a store: the header and nodes at once, spans and payloads when asked for.
//!
//! Reading takes `&self` and no cursor, so that any number of threads may read at once. What is kept in memory, spans
//! and indexes of shards, is bounded in bytes.

use std::{
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use chronoxel_codec::{Payload, stage_from_bytes};
use chronoxel_core::{BitMask, BrickLayout, NodeId, Octree, PayloadAddress, SpanKind, SpanRecord};
use rayon::prelude::*;

use crate::{
    StoreError,
    arrays::{ArrayId, ArrayKind, ShardId, SpanChunkId},
    cache::ByteCache,
    cells::{self, NESTED_FOLDER},
    files,
    header::{Header, MAX_BYTES},
    layout,
    shard::ShardFile,
    spans::{SpanChunk, SpanContext, record_of},
    statistics::{Fields, StatisticsChunkId},
    writer::nodes_file,
};

/// Bytes of spans, of shard indexes and of statistics that a store keeps, unless told otherwise.
const CACHE_BYTES: usize = 144 << 20;
/// What remembering which folders of spans there are may take.
const FOLDER_BYTES: usize = 1 << 20;
/// What remembering that something is absent may take.
const ABSENT_BYTES: usize = 64;
/// Files that a store keeps open.
const MAX_OPEN_FILES: usize = 200;
/// Two reads of a shard become one where no more than this lies between them: a page, since windows out of phase lie
/// between each other, and playing them must not read the neighbours again at every step.
const COALESCE_BYTES: u64 = 4 << 10;
/// Longest single read of a shard.
const MAX_READ_BYTES: u64 = 8 << 20;

/// A store opened for reading.
#[derive(Debug)]
pub struct Store {
    pub(crate) root: PathBuf,
    header: Header,
    tree: Octree,
    /// Chunks of spans read so far; `None` for those that do not exist.
    spans: ByteCache<SpanChunkId, Option<SpanChunk>>,
    /// Whether there is a folder of spans of a variable, level and window length.
    span_folders: ByteCache<(u16, u8, u32), bool>,
    shards: ByteCache<ShardId, ShardFile>,
    pub(crate) statistics: ByteCache<StatisticsChunkId, Vec<Fields>>,
    /// Bytes of shards, spans and statistics read so far.
    bytes_read: AtomicU64,
}

impl Store {
    /// Opens a store: reads its header and its nodes.
    ///
    /// # Errors
    /// [`StoreError`] naming the file, the field and the value.
    pub fn open(path: &Path) -> Result<Self, StoreError> {
        Self::open_within(path, CACHE_BYTES)
    }

    /// [`Self::open`], keeping at most `cache_bytes` of what it read of spans, shard indexes and statistics.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn open_within(path: &Path, cache_bytes: usize) -> Result<Self, StoreError> {
        let share = |ninths: usize| cache_bytes.min(CACHE_BYTES) / 9 * ninths;
        let header = read_header(path)?;
        let mut levels = Vec::new();
        for (level, geometry) in header.geometry().iter().enumerate() {
            levels.push(read_nodes(path, level as u8, header.levels[level].num_nodes, geometry.bricks)?);
        }
        let tree = Octree::from_levels(levels)
            .map_err(|e| StoreError::corrupt(&path.join("nodes"), "octree", e, "the nodes are no tree"))?;
        Ok(Self {
            root: path.to_owned(),
            header,
            tree,
            spans: ByteCache::new(share(4), usize::MAX),
            span_folders: ByteCache::new(FOLDER_BYTES, usize::MAX),
            shards: ByteCache::new(share(4), MAX_OPEN_FILES),
            statistics: ByteCache::new(share(1), usize::MAX),
            bytes_read: AtomicU64::new(0),
        })
    }

    /// The folder of the store.
    pub fn path(&self) -> &Path {
        &self.root
    }

    /// The header.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// The nodes.
    pub fn tree(&self) -> &Octree {
        &self.tree
    }

    /// The shape of bricks.
    pub fn layout(&self) -> &BrickLayout {
        &self.header.bricks
    }

    /// Whether every step of the series is there.
    pub fn is_complete(&self) -> bool {
        self.header.num_steps_finished == self.header.num_steps()
    }

    /// Bytes of payloads, masks, shard indexes, spans and statistics that were read since the store was opened.
    pub fn bytes_read(&self) -> u64 {
        self.bytes_read.load(Ordering::Relaxed)
    }

    pub(crate) fn count_read(&self, num_bytes: u64) {
        self.bytes_read.fetch_add(num_bytes, Ordering::Relaxed);
    }

    /// Bytes of all files of the store, but for those of a store of cells within it.
    ///
    /// # Errors
    /// [`StoreError::Io`] if a folder cannot be listed.
    pub fn stored_bytes(&self) -> Result<u64, StoreError> {
        let listed = files::list(&self.root)?.without(&self.root.join(NESTED_FOLDER));
        Ok(listed.files.iter().map(|(_, len)| len).sum())
    }

    /// The span of every node of a level that holds a step, in node order.
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if variable, level or step is out of range,
    /// [`StoreError::Corrupt`] and [`StoreError::CorruptBrick`] for what is damaged.
    pub fn spans(&self, variable: usize, level: u8, step: u32) -> Result<Vec<SpanRecord>, StoreError> {
        self.check(variable, level)?;
        if step >= self.header.num_steps_finished {
            let remedy = format!("the store has {} finished steps", self.header.num_steps_finished);
            return Err(StoreError::invalid("step", step, remedy));
        }
        let num_nodes = self.header.num_nodes(level);
        let mut found: Vec<Option<SpanRecord>> = vec![None; num_nodes];
        for (window, row) in self.rows_of(variable, step) {
            self.add_row(variable as u16, level, window, row, step, &mut found)?;
        }
        match found.iter().position(Option::is_none) {
            Some(node) => Err(self.missing_span(variable, level, node as u32, step)),
            None => Ok(found.into_iter().flatten().collect()),
        }
    }

    /// Window lengths and rows of the spans that can hold a step.
    fn rows_of(&self, variable: usize, step: u32) -> impl Iterator<Item = (u32, u32)> + '_ {
        self.header.variables[variable].windows.iter().flat_map(move |&window| {
            let first = layout::row((step + 1).saturating_sub(window), window);
            (first..=layout::row(step, window)).map(move |row| (window, row))
        })
    }

    fn missing_span(&self, variable: usize, level: u8, node: u32, step: u32) -> StoreError {
        let mut problem = format!("no span holds step {step}");
        let files = self.rows_of(variable, step).filter_map(|(window, row)| {
            let shard = row / self.header.rows_per_shard(window);
            let id = SpanChunkId { variable: variable as u16, level, window, shard };
            let is_absent = self.span_chunk(&id).is_ok_and(|chunk| chunk.is_none());
            is_absent.then(|| self.header.span_file(&id))
        });
        let mut files: Vec<String> = files.collect();
        files.dedup();
        if !files.is_empty() {
            problem += &format!(": lost is {}", files.join(" or "));
        }
        self.brick_error(&self.root, variable, level, node, step, problem)
    }

    /// Adds the spans of one row that hold a step.
    fn add_row(
        &self,
        variable: u16,
        level: u8,
        window: u32,
        row: u32,
        step: u32,
        found: &mut [Option<SpanRecord>],
    ) -> Result<(), StoreError> {
        let rows = self.header.rows_per_shard(window);
        let id = SpanChunkId { variable, level, window, shard: row / rows };
        let chunk = self.span_chunk(&id)?;
        let Some(chunk) = chunk.as_ref() else {
            if self.header.sparse || !self.is_complete() {
                return Ok(());
            }
            let path = self.root.join(self.header.span_file(&id));
            return Err(StoreError::corrupt(&path, "file", "absent", "the spans of its rows are lost"));
        };
        let context = SpanContext {
            variable: &self.header.variables[usize::from(variable)],
            window,
            row,
            num_nodes: found.len(),
            num_steps: self.header.num_steps(),
        };
        for (node, found) in found.iter_mut().enumerate() {
            let problem = match record_of(chunk.fields(row % rows, node), &context) {
                Ok(Some(record)) if !(record.start..record.start + record.len).contains(&step) => continue,
                Ok(None) => continue,
                Ok(Some(record)) if found.is_none() => {
                    *found = Some(record);
                    continue;
                }
                Ok(Some(_)) => format!("two spans hold step {step}"),
                Err(problem) => problem,
            };
            let path = self.root.join(self.header.span_file(&id));
            return Err(self.brick_error(&path, usize::from(variable), level, node as u32, step, problem));
        }
        Ok(())
    }

    /// A chunk of spans; `None` where its file is absent.
    ///
    /// Of a store that is still written, too, what is absent may stay so: chunks that appear after the header was read hold
    /// no span of the steps that it calls finished.
    pub(crate) fn span_chunk(&self, id: &SpanChunkId) -> Result<Arc<Option<SpanChunk>>, StoreError> {
        if let Some(chunk) = self.spans.get(id) {
            return Ok(chunk);
        }
        let chunk = match self.has_span_folder(id) {
            true => self.read_span_chunk(id)?,
            false => None,
        };
        let bytes = ABSENT_BYTES + chunk.as_ref().map_or(0, SpanChunk::num_bytes);
        let chunk = Arc::new(chunk);
        self.spans.insert(*id, chunk.clone(), bytes);
        Ok(chunk)
    }

    /// Whether any chunk of spans of a window length can be there: most windows of a variable are not used at most levels.
    fn has_span_folder(&self, id: &SpanChunkId) -> bool {
        let key = (id.variable, id.level, id.window);
        if let Some(found) = self.span_folders.get(&key) {
            return *found;
        }
        let found = self.root.join(self.header.data_folder(key, None)).is_dir();
        self.span_folders.insert(key, Arc::new(found), ABSENT_BYTES);
        found
    }

    fn read_span_chunk(&self, id: &SpanChunkId) -> Result<Option<SpanChunk>, StoreError> {
        let path = self.root.join(self.header.span_file(id));
        let (rows, num_nodes) = (self.header.rows_per_shard(id.window), self.header.num_nodes(id.level));
        let most = crate::chunk::largest_stored(SpanChunk::size(rows, num_nodes));
        let Some(stored) = files::read_whole(&path, most as u64)? else { return Ok(None) };
        self.bytes_read.fetch_add(stored.len() as u64, Ordering::Relaxed);
        let chunk = SpanChunk::decode(self.header.span_order(), rows, num_nodes, &stored);
        chunk.map(Some).map_err(|problem| {
            StoreError::corrupt(&path, "spans", format!("{} bytes", stored.len()), problem)
        })
    }

    /// The payload of a coded span.
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if the span is not coded or not of this store,
    /// [`StoreError::CorruptBrick`] naming file, brick and row if its bytes are damaged or missing.
    pub fn read_payload(&self, variable: usize, level: u8, span: &SpanRecord) -> Result<Payload, StoreError> {
        let mut payloads = self.read_payloads(variable, level, std::slice::from_ref(span));
        match payloads.pop() {
            Some(Ok(Some(payload))) => Ok(payload),
            Some(Err(error)) => Err(error),
            _ => Err(StoreError::invalid(
                "span",
                format!("{:?}", span.kind),
                "only coded spans have a payload",
            )),
        }
    }

    /// The payloads of many spans of one variable and level, `Ok(None)` for those that are not coded. Neighbouring
    /// ones are read in one go, and decoding uses the current thread pool. Memory is that of the result and of the
    /// stored bytes: hand over as many spans as that allows.
    pub fn read_payloads(
        &self,
        variable: usize,
        level: u8,
        spans: &[SpanRecord],
    ) -> Vec<Result<Option<Payload>, StoreError>> {
        let mut wanted = Vec::new();
        let mut results: Vec<Result<Vec<Vec<u8>>, StoreError>> = Vec::with_capacity(spans.len());
        for (index, span) in spans.iter().enumerate() {
            results
                .push(self.check_span(variable, level, span).map(|num_stages| vec![Vec::new(); num_stages]));
            if let (Ok(stages), SpanKind::Coded { class, at }) = (&results[index], span.kind) {
                for stage in 0..stages.len() as u8 {
                    let kind = ArrayKind::Stage { class, stage };
                    let array = ArrayId { variable: variable as u16, level, window: span.window, kind };
                    wanted.push((self.place(array, at, span.start), index, usize::from(stage)));
                }
            }
        }
        for Chunk { index, stage, bytes } in self.read_chunks(wanted) {
            match (&mut results[index], bytes) {
                (Ok(stages), Ok(bytes)) => stages[stage] = bytes,
                (result @ Ok(_), Err(error)) => *result = Err(error),
                (Err(_), _) => {}
            }
        }
        results
            .into_par_iter()
            .zip(spans)
            .map(|(stages, span)| match span.kind {
                SpanKind::Coded { .. } => self.payload(variable, level, span, &stages?).map(Some),
                _ => stages.map(|_| None),
            })
            .collect()
    }

    /// The mask of a span, if it has one.
    ///
    /// # Errors
    /// As [`Self::read_payload`].
    pub fn read_mask(
        &self,
        variable: usize,
        level: u8,
        span: &SpanRecord,
    ) -> Result<Option<BitMask>, StoreError> {
        self.check_span(variable, level, span)?;
        let Some(at) = span.mask else { return Ok(None) };
        let array = ArrayId { variable: variable as u16, level, window: span.window, kind: ArrayKind::Mask };
        let place = self.place(array, at, span.start);
        let Some(Chunk { bytes, .. }) = self.read_chunks(vec![(place, 0, 0)]).pop() else { return Ok(None) };
        let bytes = bytes?;
        let unused = bytes.len() * 8 - self.header.bricks.num_full();
        if bytes.last().is_some_and(|last| unused > 0 && last >> (8 - unused) != 0) {
            let path = self.root.join(self.header.shard_file(&place.shard));
            let problem = "bits after the mask's last are set".to_owned();
            return Err(self.brick_error(&path, variable, level, at.node, at.row, problem));
        }
        Ok(Some(BitMask { bytes }))
    }

    /// An opened shard; `None` where its file is absent.
    pub(crate) fn shard(&self, id: &ShardId) -> Result<Option<Arc<ShardFile>>, StoreError> {
        if let Some(shard) = self.shards.get(id) {
            return Ok(Some(shard));
        }
        let path = self.root.join(self.header.shard_file(id));
        let num_slots = self.header.num_slots(&id.array);
        let opened = ShardFile::open(&path, num_slots, self.header.chunk_bytes(&id.array))?;
        Ok(opened.map(|shard| {
            self.bytes_read.fetch_add(16 * num_slots as u64 + 4, Ordering::Relaxed);
            let (bytes, shard) = (shard.num_bytes(), Arc::new(shard));
            self.shards.insert(*id, shard.clone(), bytes);
            shard
        }))
    }

    pub(crate) fn check(&self, variable: usize, level: u8) -> Result<(), StoreError> {
        if variable >= self.header.variables.len() {
            let remedy = format!("the store has {}", self.header.variables.len());
            return Err(StoreError::invalid("variable", variable, remedy));
        }
        if usize::from(level) >= self.header.levels.len() {
            let remedy = format!("the store has {}", self.header.levels.len());
            return Err(StoreError::invalid("level", level, remedy));
        }
        Ok(())
    }

    /// Checks that a record can be of this store; gives the number of stages of its payload.
    fn check_span(&self, variable: usize, level: u8, span: &SpanRecord) -> Result<usize, StoreError> {
        self.check(variable, level)?;
        let foreign = |what: &str| Err(StoreError::invalid("span", what, "it is not one of this store's"));
        let entry = &self.header.variables[variable];
        if !entry.windows.contains(&span.window) {
            return foreign(&format!("of window {}", span.window));
        }
        let outside = |at: &PayloadAddress| {
            at.row >= self.header.num_rows(span.window) || at.node as usize >= self.header.num_nodes(level)
        };
        if let Some(at) = span.mask.as_ref().filter(|at| outside(at)) {
            return foreign(&format!("with a mask at row {}, node {}", at.row, at.node));
        }
        let SpanKind::Coded { class, at } = span.kind else { return Ok(0) };
        match entry.classes.get(usize::from(class)) {
            _ if outside(&at) => foreign(&format!("with a payload at row {}, node {}", at.row, at.node)),
            Some(found) if found.fits_window(span.window) => Ok(found.stages.len()),
            _ => foreign(&format!("of class {class}")),
        }
    }

    fn place(&self, array: ArrayId, at: PayloadAddress, step: u32) -> Place {
        let rows = self.header.rows_per_shard(array.window);
        let slot = (at.row % rows) as usize * self.header.num_nodes(array.level) + at.node as usize;
        Place { shard: ShardId { array, shard: at.row / rows }, slot, node: at.node, step }
    }

    fn payload(
        &self,
        variable: usize,
        level: u8,
        span: &SpanRecord,
        stages: &[Vec<u8>],
    ) -> Result<Payload, StoreError> {
        let SpanKind::Coded { class, at } = span.kind else { return Ok(Payload { stages: Vec::new() }) };
        let classes = &self.header.variables[variable].classes[usize::from(class)].stages;
        let stages =
            classes.iter().zip(stages).map(|(class, bytes)| stage_from_bytes(class, self.layout(), bytes));
        stages.collect::<Result<_, _>>().map(|stages| Payload { stages }).map_err(|error| {
            self.brick_error(&self.root, variable, level, at.node, span.start, error.to_string())
        })
    }

    /// Reads inner chunks, those of a shard in the order in which they lie in it.
    fn read_chunks(&self, mut wanted: Vec<(Place, usize, usize)>) -> Vec<Chunk> {
        wanted.sort_unstable_by_key(|(place, ..)| (place.shard, place.slot));
        let mut results = Vec::with_capacity(wanted.len());
        for same_shard in wanted.chunk_by(|a, b| a.0.shard == b.0.shard) {
            let shard = self.shard(&same_shard[0].0.shard);
            let mut extents = Vec::with_capacity(same_shard.len());
            for &(place, index, stage) in same_shard {
                let extent = match &shard {
                    Ok(Some(shard)) => {
                        shard.extent(place.slot).ok_or("the bytes are missing from the shard".into())
                    }
                    Ok(None) => Err("the file is missing".to_owned()),
                    Err(error) => Err(error.without_path()),
                };
                match extent {
                    Ok(extent) => extents.push((extent, place, index, stage)),
                    Err(problem) => {
                        let bytes = Err(self.place_error(&place, problem));
                        results.push(Chunk { index, stage, bytes });
                    }
                }
            }
            extents.sort_unstable_by_key(|(extent, ..)| *extent);
            if let Ok(Some(shard)) = shard {
                self.read_extents(&shard, &extents, &mut results);
            }
        }
        results
    }

    /// Reads extents of one shard, sorted by offset, in as few reads as their gaps allow.
    fn read_extents(
        &self,
        shard: &ShardFile,
        extents: &[([u64; 2], Place, usize, usize)],
        results: &mut Vec<Chunk>,
    ) {
        let mut rest = extents;
        while let Some(&([start, first_len], ..)) = rest.first() {
            let (mut end, mut num) = (start + first_len, 1);
            while let Some(&([offset, len], ..)) = rest.get(num) {
                if offset > end + COALESCE_BYTES || offset + len - start > MAX_READ_BYTES {
                    break;
                }
                end = end.max(offset + len);
                num += 1;
            }
            let (run, after) = rest.split_at(num);
            rest = after;
            let bytes = shard.read_range(start, (end - start) as usize);
            self.bytes_read.fetch_add(end - start, Ordering::Relaxed);
            let decoded = run.par_iter().map(|&([offset, len], place, index, stage)| {
                let bytes = bytes.as_ref().map_err(|error| self.place_error(&place, error.without_path()));
                let from = (offset - start) as usize;
                let decoded = bytes.and_then(|bytes| {
                    let stored = &bytes[from..from + len as usize];
                    shard.decode(stored).map_err(|problem| self.place_error(&place, problem))
                });
                Chunk { index, stage, bytes: decoded }
            });
            results.par_extend(decoded);
        }
    }

    fn place_error(&self, place: &Place, problem: String) -> StoreError {
        let path = self.root.join(self.header.shard_file(&place.shard));
        let array = &place.shard.array;
        self.brick_error(&path, usize::from(array.variable), array.level, place.node, place.step, problem)
    }

    pub(crate) fn brick_error(
        &self,
        path: &Path,
        variable: usize,
        level: u8,
        node: u32,
        step: u32,
        problem: String,
    ) -> StoreError {
        let morton = self.tree.nodes(level).get(node as usize).copied().unwrap_or(0);
        StoreError::CorruptBrick {
            path: path.to_owned(),
            variable: self.header.variables[variable].name.clone(),
            level,
            brick: NodeId { level, morton }.brick(),
            step,
            problem,
        }
    }
}

/// The bytes of a stage or a mask that was asked for.
struct Chunk {
    /// Which of the spans asked for.
    index: usize,
    /// Which of its stages.
    stage: usize,
    bytes: Result<Vec<u8>, StoreError>,
}

/// Where an inner chunk is looked for.
#[derive(Debug, Clone, Copy)]
struct Place {
    shard: ShardId,
    slot: usize,
    node: u32,
    /// First step of the span that wants it.
    step: u32,
}

/// The header of a store.
pub(crate) fn read_header(root: &Path) -> Result<Header, StoreError> {
    let metadata = std::fs::metadata(root).map_err(StoreError::io(root, "open"))?;
    if !metadata.is_dir() {
        let problem = "a store is a folder that ends in .cxl: make one with chronoxel encode";
        return Err(StoreError::corrupt(root, "path", "a file", problem));
    }
    let problem = "this is not a Chronoxel store, or its making was interrupted";
    if cells::is_cell_store(root)? {
        let problem =
            "it has no bricks: use --method cells, or encode its source with --as bricks or --as both";
        return Err(StoreError::corrupt(&root.join("zarr.json"), "store", "of cells", problem));
    }
    find_header(root)?.ok_or_else(|| StoreError::corrupt(&root.join("zarr.json"), "file", "absent", problem))
}

/// The header of a store, if the folder has one.
pub(crate) fn find_header(root: &Path) -> Result<Option<Header>, StoreError> {
    let file = root.join("zarr.json");
    let Some(bytes) = files::read_whole(&file, MAX_BYTES)? else { return Ok(None) };
    let text = String::from_utf8(bytes)
        .map_err(|_| StoreError::corrupt(&file, "text", "not UTF-8", "this is not a Chronoxel store"))?;
    Header::from_text(&file, &text).map(Some)
}

/// The Morton indices of a level, checked against its bricks.
pub(crate) fn read_nodes(
    root: &Path,
    level: u8,
    num_nodes: usize,
    bricks: [usize; 3],
) -> Result<Vec<u64>, StoreError> {
    let path = root.join(nodes_file(level));
    let due = 8 * num_nodes as u64 + 4;
    let Some(bytes) = files::read_whole(&path, due)? else {
        return Err(StoreError::corrupt(&path, "file", "absent", "the nodes of the level are lost"));
    };
    if bytes.len() as u64 != due {
        return Err(StoreError::corrupt(&path, "size in bytes", bytes.len(), format!("{due} are due")));
    }
    let (numbers, crc) = bytes.split_at(8 * num_nodes);
    let computed = crc32c::crc32c(numbers).to_le_bytes();
    if crc != computed {
        let problem = format!("it should be {computed:02x?}: the file is damaged");
        return Err(StoreError::corrupt(&path, "checksum", format!("{crc:02x?}"), problem));
    }
    let nodes: Vec<u64> = numbers.as_chunks().0.iter().map(|&b| u64::from_le_bytes(b)).collect();
    let outside = |morton: &&u64| {
        let brick = NodeId { level, morton: **morton }.brick();
        **morton >> 63 != 0 || brick.iter().zip(bricks).any(|(&b, n)| b as usize >= n)
    };
    match nodes.iter().find(outside) {
        Some(morton) => {
            Err(StoreError::corrupt(&path, "node", morton, format!("the level has {bricks:?} bricks")))
        }
        None => Ok(nodes),
    }
}
