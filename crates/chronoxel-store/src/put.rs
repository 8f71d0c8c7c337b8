//! One batch of spans on its way into a store: checks, digests, look-ups, compression, appends.

use std::collections::HashMap;

use chronoxel_core::{PayloadAddress, SpanKind, SpanRecord};
use rayon::prelude::*;

use crate::{
    SpanContent, SpanWrite, StoreError,
    arrays::ArrayKind,
    chunk,
    digest::{DigestEntry, digest_of},
    layout,
    shard::{OpenShard, ShardFile},
    writer::StoreWriter,
};

/// A batch of spans of one variable and level.
pub(crate) struct Put<'a> {
    writer: &'a mut StoreWriter,
    variable: u16,
    level: u8,
    batch: Vec<SpanWrite>,
}

/// A payload or a mask of the batch.
#[derive(Clone, Copy)]
struct Item {
    /// Index into the batch.
    span: usize,
    /// The class of a payload; `None` for a mask.
    class: Option<u8>,
    /// Its own place.
    place: PayloadAddress,
}

/// Where the bytes of an item come to lie.
enum Placed {
    /// At the place of an earlier item with equal bytes.
    Shared(PayloadAddress),
    /// At its own place: the stored form of each stage.
    Own(Vec<Vec<u8>>),
}

/// Where equal bytes may lie.
#[derive(Clone, Copy)]
struct Candidate {
    at: PayloadAddress,
    /// The item of this batch that brings them, if they are not written yet.
    item: Option<usize>,
}

impl<'a> Put<'a> {
    pub fn new(
        writer: &'a mut StoreWriter,
        variable: usize,
        level: u8,
        batch: Vec<SpanWrite>,
    ) -> Result<Self, StoreError> {
        let header = &writer.header;
        if variable >= header.variables.len() {
            return Err(StoreError::invalid("variable", variable, "it is not one of the store's"));
        }
        if usize::from(level) >= header.levels.len() {
            return Err(StoreError::invalid("level", level, "it is not one of the store's"));
        }
        Ok(Self { writer, variable: variable as u16, level, batch })
    }

    pub fn run(mut self) -> Result<(), StoreError> {
        self.check_and_cover()?;
        let items = self.items();
        let digests: Vec<u128> = items.par_iter().map(|item| self.digest(item)).collect();
        let candidates = self.look_up(&items, &digests);
        let placed: Result<Vec<Placed>, StoreError> = (0..items.len())
            .into_par_iter()
            .map(|at| self.place(&items, &items[at], candidates[at]))
            .collect();
        self.append(&items, placed?)
    }

    fn key(&self, window: u32) -> (u16, u8, u32) {
        (self.variable, self.level, window)
    }

    /// Checks each span and moves its node's cover on.
    fn check_and_cover(&mut self) -> Result<(), StoreError> {
        let header = &self.writer.header;
        let entry = &header.variables[usize::from(self.variable)];
        let covered = &mut self.writer.covered[usize::from(self.variable)][usize::from(self.level)];
        for span in &self.batch {
            let name = |what: &str| format!("{what} of {}, level {}", entry.name, self.level);
            let wrong = |what: &str, value: String, remedy: &str| {
                let value =
                    format!("{value} ({}, node {}, step {})", name("span"), span.node_rank, span.start);
                Err(StoreError::invalid("span", format!("{what} {value}"), remedy))
            };
            let Some(covered) = covered.get_mut(span.node_rank as usize) else {
                return wrong("node", span.node_rank.to_string(), "the level has fewer nodes");
            };
            if !entry.windows.contains(&span.window) {
                return wrong("window", span.window.to_string(), "it is not one of the variable's");
            }
            if span.start != *covered || span.len == 0 || span.len > span.window {
                let remedy = "spans follow each other without gaps and are no longer than their window";
                return wrong("length", format!("{} after step {covered}", span.len), remedy);
            }
            match header.num_steps().checked_sub(span.start) {
                Some(left) if span.len <= left => *covered += span.len,
                _ => return wrong("length", span.len.to_string(), "the series is shorter"),
            }
            if let Some(problem) = content_problem(span, header, entry) {
                return wrong("content", problem, "see the format");
            }
        }
        Ok(())
    }

    fn items(&self) -> Vec<Item> {
        let mut items = Vec::with_capacity(self.batch.len());
        for (span, write) in self.batch.iter().enumerate() {
            let place = PayloadAddress { row: layout::row(write.start, write.window), node: write.node_rank };
            if let SpanContent::Coded { class, .. } = &write.content {
                items.push(Item { span, class: Some(*class), place });
            }
            if write.mask.is_some() {
                items.push(Item { span, class: None, place });
            }
        }
        items
    }

    /// The bytes of an item, stage by stage.
    fn parts(&self, item: &Item) -> Vec<&[u8]> {
        let span = &self.batch[item.span];
        match (&span.content, item.class) {
            (SpanContent::Coded { stages, .. }, Some(_)) => stages.iter().map(Vec::as_slice).collect(),
            _ => span.mask.iter().map(|mask| mask.bytes.as_slice()).collect(),
        }
    }

    fn digest(&self, item: &Item) -> u128 {
        let class = item.class.map_or(u32::MAX, u32::from);
        let window = self.batch[item.span].window;
        let scope = [u32::from(self.variable), u32::from(self.level), window, class];
        digest_of(scope, self.parts(item).into_iter())
    }

    /// For each item in order, where its digest was seen before; new digests are remembered.
    fn look_up(&mut self, items: &[Item], digests: &[u128]) -> Vec<Option<Candidate>> {
        let mut here = HashMap::new();
        let mut candidates = Vec::with_capacity(items.len());
        for (index, (item, &digest)) in items.iter().zip(digests).enumerate() {
            // Rows after the span's own may not be complete when its own is.
            let earlier = self.writer.digests.get(digest).filter(|at| at.row <= item.place.row);
            candidates.push(earlier.map(|at| Candidate { at, item: here.get(&digest).copied() }));
            if earlier.is_none() {
                self.writer.remember(DigestEntry { digest, at: item.place });
                here.insert(digest, index);
            }
        }
        candidates
    }

    fn place(&self, items: &[Item], item: &Item, candidate: Option<Candidate>) -> Result<Placed, StoreError> {
        let parts = self.parts(item);
        if let Some(candidate) = candidate {
            let equal = match candidate.item {
                Some(other) => self.parts(&items[other]) == parts,
                None => self.is_stored(item, candidate.at, &parts)?,
            };
            if equal {
                return Ok(Placed::Shared(candidate.at));
            }
        }
        let level = self.writer.header.zstd_level;
        let stored: std::io::Result<Vec<_>> = parts.iter().map(|part| chunk::encode(part, level)).collect();
        stored.map(Placed::Own).map_err(StoreError::io(&self.writer.root, "compress a brick of"))
    }

    /// Whether the stages stored at an address are these bytes.
    fn is_stored(&self, item: &Item, at: PayloadAddress, parts: &[&[u8]]) -> Result<bool, StoreError> {
        let window = self.batch[item.span].window;
        for (stage, part) in parts.iter().enumerate() {
            if self.stored_bytes(window, kind_of(item, stage), at)?.as_deref() != Some(*part) {
                return Ok(false);
            }
        }
        Ok(true)
    }

    fn stored_bytes(
        &self,
        window: u32,
        kind: ArrayKind,
        at: PayloadAddress,
    ) -> Result<Option<Vec<u8>>, StoreError> {
        let (writer, key) = (&*self.writer, self.key(window));
        let (shard, slot) = self.slot(window, at);
        if let Some(open) = writer.windows[&key].shards.get(&(kind, shard)) {
            return open.read(slot);
        }
        let id = writer.shard_id(key, kind, shard);
        let file = match writer.closed_shards.get(&id) {
            Some(file) => file,
            None => {
                let path = writer.root.join(writer.header.shard_file(&id));
                let num_slots = writer.header.num_slots(&id.array);
                let Some(file) = ShardFile::open(&path, num_slots, writer.header.chunk_bytes(&id.array))?
                else {
                    return Ok(None);
                };
                let (file, bytes) = (std::sync::Arc::new(file), 16 * num_slots);
                writer.closed_shards.insert(id, file.clone(), bytes);
                file
            }
        };
        let Some([offset, len]) = file.extent(slot) else { return Ok(None) };
        let stored = file.read_range(offset, len as usize)?;
        let decoded = file.decode(&stored);
        decoded.map(Some).map_err(|problem| StoreError::corrupt(file.path(), "inner chunk", slot, problem))
    }

    /// The shard of an address, and its slot in the shard.
    fn slot(&self, window: u32, at: PayloadAddress) -> (u32, usize) {
        let rows = self.writer.header.rows_per_shard(window);
        let num_nodes = self.writer.header.num_nodes(self.level);
        (at.row / rows, (at.row % rows) as usize * num_nodes + at.node as usize)
    }

    fn append(mut self, items: &[Item], placed: Vec<Placed>) -> Result<(), StoreError> {
        let mut payloads: Vec<Option<PayloadAddress>> = vec![None; self.batch.len()];
        let mut masks = payloads.clone();
        for (item, placed) in items.iter().zip(placed) {
            let at = match placed {
                Placed::Shared(at) => {
                    self.writer.header.totals.shared += u64::from(item.class.is_some());
                    at
                }
                Placed::Own(stored) => {
                    self.append_own(item, &stored)?;
                    item.place
                }
            };
            match item.class {
                Some(_) => payloads[item.span] = Some(at),
                None => masks[item.span] = Some(at),
            }
        }
        for (span, (payload, mask)) in
            std::mem::take(&mut self.batch).iter().zip(payloads.into_iter().zip(masks))
        {
            self.record(span, payload, mask);
        }
        let open = self.writer.windows.range_mut(self.key(0)..=self.key(u32::MAX));
        for shard in open.flat_map(|(_, window)| window.shards.values_mut()) {
            shard.flush()?;
        }
        Ok(())
    }

    fn append_own(&mut self, item: &Item, stored: &[Vec<u8>]) -> Result<(), StoreError> {
        let window = self.batch[item.span].window;
        let (key, (shard, slot)) = (self.key(window), self.slot(window, item.place));
        for (stage, stored) in stored.iter().enumerate() {
            let kind = kind_of(item, stage);
            let id = self.writer.shard_id(key, kind, shard);
            let chunk_bytes = self.writer.header.chunk_bytes(&id.array);
            let (num_slots, path) = (
                self.writer.header.num_slots(&id.array),
                self.writer.journal_path(&self.writer.header.shard_file(&id)),
            );
            let shards = &mut self.writer.windows.entry(key).or_default().shards;
            let open = match shards.entry((kind, shard)) {
                std::collections::btree_map::Entry::Occupied(open) => open.into_mut(),
                std::collections::btree_map::Entry::Vacant(place) => {
                    place.insert(OpenShard::create(path, num_slots, chunk_bytes)?)
                }
            };
            open.append(slot, stored)?;
        }
        self.count_own(item, stored);
        Ok(())
    }

    fn count_own(&mut self, item: &Item, stored: &[Vec<u8>]) {
        let stored_bytes: u64 = stored.iter().map(|s| s.len() as u64).sum();
        let header = &mut self.writer.header;
        let Some(class) = item.class else {
            header.totals.masks += 1;
            header.totals.mask_bytes += stored_bytes;
            return;
        };
        let [core, apron] = header.payload_bytes(usize::from(self.variable), class);
        header.totals.core_bytes += core;
        header.totals.apron_bytes += apron;
        header.totals.coded += 1;
        header.totals.payload_bytes += stored_bytes;
    }

    fn record(&mut self, span: &SpanWrite, payload: Option<PayloadAddress>, mask: Option<PayloadAddress>) {
        let (key, header) = (self.key(span.window), &mut self.writer.header);
        let kind = match (&span.content, payload) {
            (SpanContent::Coded { class, .. }, Some(at)) => SpanKind::Coded { class: *class, at },
            (SpanContent::Constant(value), _) => SpanKind::Constant(*value),
            _ => SpanKind::Empty,
        };
        match kind {
            SpanKind::Empty => header.totals.empty += 1,
            SpanKind::Constant(_) => header.totals.constant += 1,
            SpanKind::Coded { .. } => {}
        }
        header.totals.masked += u64::from(mask.is_some());
        if span.statistics.count > 0 {
            let entry = &mut header.variables[usize::from(self.variable)];
            let [low, high] = [span.statistics.min, span.statistics.max];
            entry.min = Some(entry.min.map_or(low, |min| min.min(low)));
            entry.max = Some(entry.max.map_or(high, |max| max.max(high)));
        }
        let record = SpanRecord {
            start: span.start,
            len: span.len,
            window: span.window,
            kind,
            mask,
            drawn_range: span.drawn_range,
            statistics: span.statistics,
        };
        let rows = header.rows_per_shard(span.window);
        let row = layout::row(span.start, span.window);
        let num_nodes = header.num_nodes(self.level);
        let chunks = &mut self.writer.windows.entry(key).or_default().span_chunks;
        let place = (row % rows) * num_nodes as u32 + span.node_rank;
        chunks.entry(row / rows).or_default().set(place, &record);
    }
}

fn kind_of(item: &Item, stage: usize) -> ArrayKind {
    item.class.map_or(ArrayKind::Mask, |class| ArrayKind::Stage { class, stage: stage as u8 })
}

/// What is wrong with what a span holds, if anything is.
fn content_problem(span: &SpanWrite, header: &crate::Header, entry: &crate::VariableEntry) -> Option<String> {
    let range = span.drawn_range;
    let sound = range.iter().all(|v| v.is_finite()) && range[0] <= range[1];
    let [count, stats] = [span.statistics.count as f64, 0.0];
    let values = [span.statistics.min, span.statistics.max, span.statistics.mean, span.statistics.std];
    if count > stats && !values.iter().all(|v| v.is_finite()) {
        return Some(format!("has statistics that are not finite: {values:?}"));
    }
    if span.mask.as_ref().is_some_and(|mask| mask.bytes.len() != header.bricks.num_full().div_ceil(8)) {
        return Some("has a mask of another size than the brick".into());
    }
    match &span.content {
        SpanContent::Empty if span.mask.is_some() => Some("is empty and has a mask".into()),
        SpanContent::Empty => {
            range.iter().any(|v| !v.is_nan()).then(|| "is empty and has a drawn range".into())
        }
        SpanContent::Constant(value) if !value.is_finite() => Some(format!("is the constant {value}")),
        SpanContent::Coded { class, stages } => {
            let Some(class) = entry.classes.get(usize::from(*class)) else {
                return Some(format!("is of class {class}, which the variable has not"));
            };
            let fits = class.fits_window(span.window)
                && class.stages.len() == stages.len()
                && class.stages.iter().zip(stages).all(|(c, s)| c.num_bytes(&header.bricks) == s.len());
            let problem = "has stages whose number or sizes are not those of its class";
            (!fits || !sound)
                .then(|| if fits { format!("has the drawn range {range:?}") } else { problem.into() })
        }
        SpanContent::Constant(_) => (!sound).then(|| format!("has the drawn range {range:?}")),
    }
}
