//! Writing a store: batches of spans in, shards out, a commit every few steps.
//!
//! Digests and zstd run in parallel; look-ups and appends follow the order of the batch, so that the bytes do not
//! depend on the number of threads. Whatever is not complete lies in `.partial`, whose state is replaced at each
//! commit; the header is replaced after it, and so never speaks of what is not there.

use std::{
    collections::{BTreeMap, HashSet},
    fs::{self, File},
    io::Write,
    path::{Path, PathBuf},
};

use serde_json::Value;

use crate::arrays::{ArrayId, ShardId};
use crate::{
    SpanWrite, StoreDescription, StoreError, Totals,
    arrays::{ArrayKind, SpanChunkId},
    cache::ByteCache,
    cells,
    digest::{DigestEntry, DigestTable, MAX_DIGESTS},
    files,
    header::{self, Header},
    journal,
    kept::KeptFiles,
    put::Put,
    shard::{OpenShard, ShardFile},
    spans::OpenSpans,
    statistics_write::OpenStatistics,
};

/// Writes one store; see the crate's documentation for the order of calls.
///
/// A writer that is dropped leaves a store that opens up to the last commit and that
/// [`StoreWriter::resume`] goes on with.
#[derive(Debug)]
pub struct StoreWriter {
    pub(crate) root: PathBuf,
    pub(crate) header: Header,
    pub(crate) description_crc: u32,
    /// Steps committed, or below the one that a resume starts with.
    pub(crate) num_steps_put: u32,
    /// What the last state of the journal holds. A resume starts before: what it reads again is committed already.
    pub(crate) num_steps_committed: u32,
    /// `[variable][level][node]`: the step up to which spans were put.
    pub(crate) covered: Vec<Vec<Vec<u32>>>,
    /// In the order of `Header::each_window`.
    pub(crate) windows: BTreeMap<(u16, u8, u32), OpenWindow>,
    /// `[variable][time level]`; empty where the store has no time tree.
    pub(crate) statistics: Vec<Vec<OpenStatistics>>,
    pub(crate) kept: KeptFiles,
    pub(crate) digests: DigestTable,
    /// Digests since the last commit.
    pub(crate) new_digests: Vec<u8>,
    pub(crate) num_digests: u64,
    pub(crate) digests_crc: u32,
    pub(crate) digest_file: File,
    pub(crate) closed_shards: ByteCache<ShardId, ShardFile>,
    /// Arrays that have their folders and metadata.
    pub(crate) described: HashSet<((u16, u8, u32), Option<ArrayKind>)>,
    /// Files that may not be on disk yet, and their lengths.
    pub(crate) unsynced: Vec<(PathBuf, u64)>,
    pub(crate) unsynced_bytes: u64,
    /// What the encoder must remember for a resume.
    pub(crate) carry: Value,
    /// Set while a put or commit is under way, and left so by one that failed.
    pub(crate) failed: bool,
}

/// The open shards of one (variable, level, window).
#[derive(Debug, Default)]
pub(crate) struct OpenWindow {
    pub num_shards_closed: u32,
    pub span_chunks: BTreeMap<u32, OpenSpans>,
    pub shards: BTreeMap<(ArrayKind, u32), OpenShard>,
}

impl StoreWriter {
    /// Starts a store. The folder must not exist, or be empty, or with `overwrite` be a store.
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if the folder is in the way or the description is not sound,
    /// [`StoreError::Io`] if the system refuses.
    pub fn create(path: &Path, description: &StoreDescription, overwrite: bool) -> Result<Self, StoreError> {
        let header = Header::of_description(description)?;
        make_room(path, overwrite)?;
        let journal = path.join(journal::FOLDER);
        fs::create_dir_all(&journal).map_err(StoreError::io(&journal, "create"))?;
        for child in header.fixed_children()? {
            let folder = path.join(&child.folder);
            fs::create_dir_all(&folder).map_err(StoreError::io(&folder, "create"))?;
            files::write(&path.join(child.file()), child.text.as_bytes())?;
        }
        for level in 0..header.levels.len() as u8 {
            let mut nodes: Vec<u8> =
                description.tree.nodes(level).iter().flat_map(|morton| morton.to_le_bytes()).collect();
            nodes.extend_from_slice(&crc32c::crc32c(&nodes).to_le_bytes());
            let file = path.join(nodes_file(level));
            fs::write(&file, nodes).map_err(StoreError::io(&file, "write"))?;
        }
        let mut writer = Self::fresh(path, header)?;
        writer.write_state(Vec::new())?;
        writer.write_header()?;
        Ok(writer)
    }

    /// A writer of which nothing is put yet.
    pub(crate) fn fresh(path: &Path, header: Header) -> Result<Self, StoreError> {
        let digest_path = path.join(journal::FOLDER).join("digests");
        let digest_file = File::options()
            .append(true)
            .create(true)
            .open(&digest_path)
            .map_err(StoreError::io(&digest_path, "open"))?;
        let per_level = || header.levels.iter().map(|level| vec![0; level.num_nodes]).collect();
        let covered = header.variables.iter().map(|_| per_level()).collect();
        let windows = header.each_window().map(|key| (key, OpenWindow::default())).collect();
        let per_time_level: Vec<OpenStatistics> =
            header.time_levels().map(|_| OpenStatistics::default()).collect();
        let statistics = vec![per_time_level; header.variables.len()];
        let description_crc = crc32c::crc32c(header.to_text()?.as_bytes());
        Ok(Self {
            root: path.to_owned(),
            header,
            description_crc,
            num_steps_put: 0,
            num_steps_committed: 0,
            covered,
            windows,
            statistics,
            kept: KeptFiles::default(),
            digests: DigestTable::new(MAX_DIGESTS),
            new_digests: Vec::new(),
            num_digests: 0,
            digests_crc: 0,
            digest_file,
            closed_shards: ByteCache::new(16 << 20, 64),
            described: HashSet::new(),
            unsynced: Vec::new(),
            unsynced_bytes: 0,
            carry: Value::Null,
            failed: false,
        })
    }

    /// The header as it stands.
    pub fn header(&self) -> &Header {
        &self.header
    }

    /// Steps of the last commit: what a resume from the journal as it stands goes on after.
    pub fn steps_committed(&self) -> u32 {
        self.num_steps_committed
    }

    /// The step up to which spans of a node were put; its next span starts there.
    ///
    /// # Panics
    /// If variable, level or node is out of range.
    pub fn covered_until(&self, variable: usize, level: u8, node_rank: u32) -> u32 {
        self.covered[variable][usize::from(level)][node_rank as usize]
    }

    /// What the encoder said last with [`Self::set_carry`], or after a resume what it had said before the commit that
    /// the resume goes on from; null before that.
    pub fn carry(&self) -> &Value {
        &self.carry
    }

    /// Says what the encoder must remember for a resume, a small value. It is kept in the journal from the next commit on
    /// (every G steps, as [`Self::commit_step`] says), together with what that commit keeps; of a complete store nothing is kept.
    pub fn set_carry(&mut self, carry: Value) {
        self.carry = carry;
    }

    /// Appends a batch of spans of one variable and level. Each node's spans come in the order of time, without gaps;
    /// nodes come in any order that does not depend on threads or memory, since bytes are stored in the order of
    /// arrival. Ordered by first step, then Morton index, they read fastest; at the end of a series, where windows of all
    /// phases end at once, that matters.
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if a span does not follow the one before it or contradicts the description,
    /// [`StoreError::Io`] if the system refuses. After an error the writer is only good for
    /// [`Self::abandon`].
    pub fn put(&mut self, variable: usize, level: u8, batch: Vec<SpanWrite>) -> Result<(), StoreError> {
        self.begin()?;
        Put::new(self, variable, level, batch)?.run()?;
        self.failed = false;
        Ok(())
    }

    /// Says that nothing more will be put before step `step + 1` is read. Every G steps, and after the last, what is
    /// complete becomes part of the store, and everything put so far survives a kill of the process. (Files are synced
    /// in groups of up to 64 MiB or 100: that much may be lost where the machine itself stops, and is then found.)
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if steps are committed out of order or spans are missing at the last one,
    /// [`StoreError::Io`] if the system refuses.
    pub fn commit_step(&mut self, step: u32) -> Result<(), StoreError> {
        let (num_put, num_steps) = (step.saturating_add(1), self.header.num_steps());
        if num_put > num_steps || num_put <= self.num_steps_put {
            let remedy = format!("steps {} to {} are left", self.num_steps_put, num_steps - 1);
            return Err(StoreError::invalid("step to commit", step, remedy));
        }
        let is_due = num_put % self.header.steps_per_shard == 0 || num_put == num_steps;
        if is_due && num_put > self.num_steps_committed {
            self.begin()?;
            self.commit(num_put)?;
            self.failed = false;
        }
        self.num_steps_put = num_put;
        Ok(())
    }

    /// Completes the store once every step is committed, and removes the journal.
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if steps are missing, [`StoreError::Io`] if the system refuses.
    pub fn finish(self) -> Result<Totals, StoreError> {
        if self.num_steps_put < self.header.num_steps() {
            let remedy = format!("the series has {} steps", self.header.num_steps());
            return Err(StoreError::invalid("number of steps committed", self.num_steps_put, remedy));
        }
        let Self { root, header, digest_file, .. } = self;
        drop(digest_file);
        files::sync_all(&[root.join("zarr.json")])?;
        files::remove_folder(&root.join(journal::FOLDER))?;
        files::sync_folder(&root)?;
        Ok(header.totals)
    }

    /// Gives up after a failure. Where no step was finished the folder is removed; else it is renamed from
    /// `NAME.cxl` to `NAME.partial.cxl`, whose path is returned: it opens up to the last finished step, and
    /// [`Self::resume`] finds it.
    ///
    /// # Errors
    /// [`StoreError::Io`] if the system refuses.
    pub fn abandon(self) -> Result<Option<PathBuf>, StoreError> {
        let mut writer = self;
        if writer.header.num_steps_finished > 0 {
            writer.sync()?;
        }
        let Self { root, header, windows, digest_file, closed_shards, .. } = writer;
        drop((windows, digest_file, closed_shards));
        if header.num_steps_finished == 0 {
            files::remove_folder(&root)?;
            return Ok(None);
        }
        let partial = partial_path(&root);
        files::remove_folder(&partial)?;
        files::rename(&root, &partial)?;
        Ok(Some(partial))
    }

    pub(crate) fn begin(&mut self) -> Result<(), StoreError> {
        match std::mem::replace(&mut self.failed, true) {
            false => Ok(()),
            true => Err(StoreError::invalid("writer", "failed", "abandon it, and resume the store")),
        }
    }

    pub(crate) fn journal_path(&self, relative: &str) -> PathBuf {
        self.root.join(journal::FOLDER).join(relative.replace('/', "!"))
    }

    pub(crate) fn spans_id(&self, key: (u16, u8, u32), shard: u32) -> SpanChunkId {
        SpanChunkId { variable: key.0, level: key.1, window: key.2, shard }
    }

    pub(crate) fn shard_id(&self, key: (u16, u8, u32), kind: ArrayKind, shard: u32) -> ShardId {
        ShardId { array: ArrayId { variable: key.0, level: key.1, window: key.2, kind }, shard }
    }

    pub(crate) fn remember(&mut self, entry: DigestEntry) {
        self.digests.insert(entry);
        self.new_digests.extend_from_slice(&entry.to_bytes());
        self.num_digests += 1;
    }

    /// Makes the journal's digests as long as the state will say.
    pub(crate) fn write_digests(&mut self) -> Result<(), StoreError> {
        let path = self.journal_path("digests");
        self.digest_file.write_all(&self.new_digests).map_err(StoreError::io(&path, "write"))?;
        self.digests_crc = crc32c::crc32c_append(self.digests_crc, &self.new_digests);
        self.new_digests.clear();
        Ok(())
    }

    pub(crate) fn write_header(&self) -> Result<(), StoreError> {
        let temporary = self.journal_path("zarr.json");
        files::write(&temporary, self.header.to_text()?.as_bytes())?;
        files::rename(&temporary, &self.root.join("zarr.json"))
    }
}

/// The file of a level's nodes, relative to the store.
pub(crate) fn nodes_file(level: u8) -> String {
    format!("nodes/L{level}/c.0")
}

/// `NAME.partial.cxl` for `NAME.cxl`.
pub(crate) fn partial_path(root: &Path) -> PathBuf {
    let name = root.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let stem = name.strip_suffix(".cxl").unwrap_or(&name);
    root.with_file_name(format!("{stem}.partial.cxl"))
}

/// Removes what is in the way of a new store, if that is allowed.
pub(crate) fn make_room(path: &Path, overwrite: bool) -> Result<(), StoreError> {
    let in_the_way = |what: &str, remedy: &str| {
        Err(StoreError::invalid("output", format!("{}, {what}", path.display()), remedy))
    };
    if path.is_file() {
        return in_the_way("a file", "give the name of a folder");
    }
    let names = files::names_in(path)?;
    let is_store = names.iter().any(|name| name == journal::FOLDER)
        || fs::read_to_string(path.join("zarr.json")).is_ok_and(|text| {
            [header::ATTRIBUTE, cells::ATTRIBUTE].iter().any(|name| text.contains(&format!("\"{name}\"")))
        });
    match (names.is_empty(), is_store, overwrite) {
        (true, ..) => Ok(()),
        (false, true, true) => files::remove_folder(path),
        (false, true, false) => in_the_way("a store", "overwrite it, resume it, or give another name"),
        (false, false, _) => in_the_way("a folder that is not a store", "give another name"),
    }
}
