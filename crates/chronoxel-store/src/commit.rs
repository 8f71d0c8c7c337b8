//! Commits: what is complete becomes part of the store, what is not goes to the journal.
//!
//! The order is what makes a kill at any moment harmless: data written under temporary names, renamed; then the
//! journal's state; then the header. A header never speaks of rows that are not there, and a state older than
//! the files is restored by taking the files back (see `resume`).
//!
//! A disk takes milliseconds to sync one file and hardly more for a hundred at once, so files are synced in groups. What a
//! machine that stops may lose is what was written since the last group; the state lists it, and a resume checks it.

use std::{
    fs,
    path::{Path, PathBuf},
};

use rayon::prelude::*;

use crate::{
    Header, StoreError,
    arrays::ArrayKind,
    files,
    journal::{self, KeptSummary, ShardSummary, StateSummary, WindowSummary},
    shard::OpenShard,
    spans::OpenSpans,
    writer::StoreWriter,
};

/// Files are synced once so many bytes of them are written,
const SYNC_BYTES: u64 = 64 << 20;
/// or so many files.
const SYNC_FILES: usize = 100;

/// A file on its way from its temporary name to its own.
struct Closing {
    key: (u16, u8, u32),
    /// Of an array of bytes; `None` for spans.
    kind: Option<ArrayKind>,
    temporary: PathBuf,
    path: PathBuf,
    content: Content,
}

/// A file that is complete under its temporary name.
struct Closed {
    key: (u16, u8, u32),
    kind: Option<ArrayKind>,
    temporary: PathBuf,
    path: PathBuf,
    len: u64,
}

enum Content {
    Spans(OpenSpans),
    Shard(OpenShard),
}

impl StoreWriter {
    pub(crate) fn commit(&mut self, num_put: u32) -> Result<(), StoreError> {
        self.check_covered(num_put)?;
        self.check_statistics(num_put)?;
        let closing = self.take_complete();
        let header = &self.header;
        let closed: Result<Vec<Closed>, StoreError> =
            closing.into_par_iter().map(|closing| closing.close(header)).collect();
        for shard in self.windows.values_mut().flat_map(|window| window.shards.values_mut()) {
            shard.flush()?;
        }
        for Closed { key, kind, temporary, path, len } in closed? {
            self.describe(key, kind)?;
            self.land(&temporary, path, len)?;
        }
        let chunks = self.take_statistics(num_put);
        let header = &self.header;
        let lens: Result<Vec<u64>, StoreError> = chunks.par_iter().map(|chunk| chunk.close(header)).collect();
        for (chunk, len) in chunks.into_iter().zip(lens?) {
            self.land(&chunk.temporary, chunk.path, len)?;
        }
        let kept = self.list_kept()?;
        self.header.num_steps_finished = self.num_steps_closed();
        let last = num_put == self.header.num_steps();
        if last || self.unsynced_bytes >= SYNC_BYTES || self.unsynced.len() >= SYNC_FILES {
            self.sync()?;
        }
        self.num_steps_committed = num_put;
        self.write_state(kept)?;
        self.remove_dropped()?;
        self.write_header()
    }

    /// Gives a complete file of data its name.
    fn land(&mut self, temporary: &Path, path: PathBuf, len: u64) -> Result<(), StoreError> {
        files::rename(temporary, &path)?;
        self.header.totals.data_bytes += len;
        self.unsynced_bytes += len;
        self.unsynced.push((path, len));
        Ok(())
    }

    /// Makes the folders of an array and their metadata before its first file comes to lie there.
    fn describe(&mut self, key: (u16, u8, u32), kind: Option<ArrayKind>) -> Result<(), StoreError> {
        if self.described.contains(&(key, kind)) {
            return Ok(());
        }
        for child in self.header.data_children(key, kind)? {
            let (folder, file) = (self.root.join(&child.folder), self.root.join(child.file()));
            if file.exists() {
                continue;
            }
            fs::create_dir_all(&folder).map_err(StoreError::io(&folder, "create"))?;
            let temporary = self.journal_path(&child.file());
            files::write(&temporary, child.text.as_bytes())?;
            files::rename(&temporary, &file)?;
            self.unsynced.push((file, child.text.len() as u64));
        }
        self.described.insert((key, kind));
        Ok(())
    }

    fn unsynced_relative(&self) -> Vec<(PathBuf, u64)> {
        let relative = |path: &PathBuf| path.strip_prefix(&self.root).unwrap_or(path).to_owned();
        self.unsynced.iter().map(|(path, len)| (relative(path), *len)).collect()
    }

    /// Waits until everything written so far is on disk.
    pub(crate) fn sync(&mut self) -> Result<(), StoreError> {
        let mut paths: Vec<PathBuf> = self.unsynced.drain(..).map(|(path, _)| path).collect();
        let open = self.windows.values().flat_map(|window| window.shards.values());
        paths.extend(open.map(|shard| shard.path().to_owned()));
        paths.push(self.journal_path("digests"));
        self.unsynced_bytes = 0;
        files::sync_all(&paths)
    }

    /// Rows of a window length that are complete: every node's cover reaches past the starts that belong to them.
    fn num_rows_complete(&self, (variable, level, window): (u16, u8, u32)) -> u32 {
        let nodes = &self.covered[usize::from(variable)][usize::from(level)];
        let covered = nodes.iter().copied().min().unwrap_or(0);
        if covered == self.header.num_steps() {
            self.header.num_rows(window)
        } else {
            covered.div_ceil(window)
        }
    }

    /// Checks that the last commit has all spans.
    fn check_covered(&self, num_put: u32) -> Result<(), StoreError> {
        if num_put < self.header.num_steps() {
            return Ok(());
        }
        for (entry, levels) in self.header.variables.iter().zip(&self.covered) {
            for (level, nodes) in levels.iter().enumerate() {
                if let Some(node) = nodes.iter().position(|&covered| covered < num_put) {
                    let value = format!("{num_put} ({}, level {level}, node {node})", entry.name);
                    let remedy = format!("the node's spans reach step {} only", nodes[node]);
                    return Err(StoreError::invalid("number of steps to commit", value, remedy));
                }
            }
        }
        Ok(())
    }

    /// Takes the shards out whose rows are complete.
    fn take_complete(&mut self) -> Vec<Closing> {
        let mut closing = Vec::new();
        let keys: Vec<(u16, u8, u32)> = self.windows.keys().copied().collect();
        for key in keys {
            let rows = self.header.rows_per_shard(key.2);
            let num_rows = self.num_rows_complete(key);
            let all = num_rows == self.header.num_rows(key.2);
            let num_done = if all { self.header.num_shards(key.2) } else { num_rows / rows };
            let Some(window) = self.windows.get_mut(&key) else { continue };
            let first = std::mem::replace(&mut window.num_shards_closed, num_done);
            let mut contents: Vec<(Option<ArrayKind>, u32, Content)> = Vec::new();
            for shard in first..num_done {
                let spans = window.span_chunks.remove(&shard);
                contents.extend(spans.map(|spans| (None, shard, Content::Spans(spans))));
            }
            while let Some(&(kind, shard)) = window.shards.keys().find(|(_, shard)| *shard < num_done) {
                let open = window.shards.remove(&(kind, shard));
                contents.extend(open.map(|open| (Some(kind), shard, Content::Shard(open))));
            }
            closing.extend(contents.into_iter().map(|(kind, shard, content)| {
                let relative = match kind {
                    None => self.header.span_file(&self.spans_id(key, shard)),
                    Some(kind) => self.header.shard_file(&self.shard_id(key, kind, shard)),
                };
                let (temporary, path) = (self.journal_path(&relative), self.root.join(relative));
                Closing { key, kind, temporary, path, content }
            }));
        }
        closing
    }

    /// Steps below which every span of every node lies in a complete shard.
    fn num_steps_closed(&self) -> u32 {
        let put = self.covered.iter().flatten().flatten().copied().min().unwrap_or(0);
        let chunks = self.windows.values().flat_map(|window| window.span_chunks.values());
        chunks.flat_map(OpenSpans::starts).map(|start| start as u32).fold(put, u32::min)
    }

    pub(crate) fn write_state(&mut self, kept: Vec<KeptSummary>) -> Result<(), StoreError> {
        self.write_digests()?;
        let mut numbers = Vec::new();
        for covered in self.covered.iter().flatten().flatten() {
            numbers.extend_from_slice(&covered.to_le_bytes());
        }
        let mut windows = Vec::new();
        for window in self.windows.values() {
            for (place, fields) in window.span_chunks.values().flat_map(|spans| &spans.0) {
                numbers.extend_from_slice(&place.to_le_bytes());
                fields.iter().for_each(|value| numbers.extend_from_slice(&value.to_le_bytes()));
            }
            for (slot, extent) in window.shards.values().flat_map(OpenShard::extents) {
                numbers.extend_from_slice(&slot.to_le_bytes());
                extent.iter().for_each(|number| numbers.extend_from_slice(&number.to_le_bytes()));
            }
            windows.push(WindowSummary {
                num_shards_closed: window.num_shards_closed,
                span_chunks: window
                    .span_chunks
                    .iter()
                    .map(|(&shard, spans)| (shard, spans.0.len()))
                    .collect(),
                shards: window
                    .shards
                    .iter()
                    .map(|(&(kind, shard), open)| ShardSummary::new(kind, shard, open))
                    .collect(),
            });
        }
        let statistics = self.statistics_summary(&mut numbers);
        let summary = StateSummary {
            description_crc: self.description_crc,
            num_steps_committed: self.num_steps_committed,
            num_steps_finished: self.header.num_steps_finished,
            totals: self.header.totals,
            ranges: self.header.variables.iter().map(|v| [v.min, v.max]).collect(),
            carry: self.carry.clone(),
            unsynced: self.unsynced_relative(),
            num_digests: self.num_digests,
            digests_crc: self.digests_crc,
            windows,
            statistics,
            kept,
        };
        let temporary = self.journal_path("state.new");
        files::write(&temporary, &journal::state_bytes(&summary, &numbers)?)?;
        files::rename(&temporary, &self.journal_path("state"))
    }
}

impl Closing {
    /// Completes the file under its temporary name.
    fn close(self, header: &Header) -> Result<Closed, StoreError> {
        let Self { key, kind, temporary, path, content } = self;
        let len = match content {
            Content::Shard(shard) => shard.close()?,
            Content::Spans(spans) => {
                let (_, level, window) = key;
                let chunk = spans.into_chunk(header.rows_per_shard(window), header.num_nodes(level));
                let stored = chunk.encode(header.span_order(), header.span_zstd_level(level, window));
                let stored = stored.map_err(StoreError::io(&path, "compress"))?;
                files::write(&temporary, &stored)?;
                stored.len() as u64
            }
        };
        Ok(Closed { key, kind, temporary, path, len })
    }
}
