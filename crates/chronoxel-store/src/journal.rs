//! The journal of a store that is being written, in its folder `.partial`: what a resume needs.
//!
//! `state` holds the writer's state at the last commit and is replaced as a whole; `digests` only grows, and `state`
//! says how much of it is good. Shards that are not complete lie beside them. All of it is gone once the
//! store is finished, so its form may change with any version.

use std::{
    io::Read,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use crate::{StoreError, Totals, arrays::ArrayKind, files, shard::OpenShard};

/// The folder of the journal.
pub(crate) const FOLDER: &str = ".partial";
const MAGIC: &[u8; 8] = b"CXLSTAT3";

/// The state's description; the numbers it counts follow it in the file, in the same order.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct StateSummary {
    /// CRC-32C of the header's text before the first step: the description must be the same.
    pub description_crc: u32,
    /// Steps below the one that was committed last, and it.
    pub num_steps_committed: u32,
    pub num_steps_finished: u32,
    pub totals: Totals,
    pub ranges: Vec<[Option<f64>; 2]>,
    /// What the encoder must remember.
    pub carry: serde_json::Value,
    /// Files that may not be on disk yet, relative to the store, and their lengths.
    pub unsynced: Vec<(PathBuf, u64)>,
    pub num_digests: u64,
    pub digests_crc: u32,
    pub windows: Vec<WindowSummary>,
    /// In the order of `Header::each_time_level`.
    pub statistics: Vec<StatisticsSummary>,
    pub kept: Vec<KeptSummary>,
}

/// The open rows of one level of the time tree of one variable; the fields of all nodes follow for each.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct StatisticsSummary {
    /// Chunks below this one are complete.
    pub num_chunks_closed: u32,
    pub rows: Vec<u32>,
}

/// A file that the encoder keeps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct KeptSummary {
    pub name: String,
    /// Which of all files that were made.
    pub number: u64,
    pub len: u64,
}

/// The open shards of one (variable, level, window), in the order of `Header::each_window`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct WindowSummary {
    /// Shards below this one are complete.
    pub num_shards_closed: u32,
    /// Shards whose spans are held open, and how many of them: place and fields of each follow.
    pub span_chunks: Vec<(u32, usize)>,
    /// Open shards of bytes; slot, offset and length of each of their chunks follow.
    pub shards: Vec<ShardSummary>,
}

/// One open shard.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct ShardSummary {
    /// -1 for the mask, else the class.
    pub class: i16,
    pub stage: u8,
    pub shard: u32,
    pub len: u64,
    pub num_chunks: usize,
}

impl ShardSummary {
    pub fn new(kind: ArrayKind, shard: u32, open: &OpenShard) -> Self {
        let (class, stage) = match kind {
            ArrayKind::Mask => (-1, 0),
            ArrayKind::Stage { class, stage } => (i16::from(class), stage),
        };
        Self { class, stage, shard, len: open.len(), num_chunks: open.extents().len() }
    }

    pub fn kind(&self) -> ArrayKind {
        match u8::try_from(self.class) {
            Ok(class) => ArrayKind::Stage { class, stage: self.stage },
            Err(_) => ArrayKind::Mask,
        }
    }
}

/// The text of a state file: checksum, summary, numbers.
pub(crate) fn state_bytes(summary: &StateSummary, numbers: &[u8]) -> Result<Vec<u8>, StoreError> {
    let summary = serde_json::to_vec(summary)
        .map_err(|e| StoreError::invalid("state of the journal", e, "it must be plain JSON"))?;
    let zipped = zstd::bulk::compress(numbers, 1)
        .map_err(|e| StoreError::invalid("state of the journal", e, "there is no memory for it"))?;
    let lengths = [summary.len() as u64, numbers.len() as u64].map(u64::to_le_bytes);
    let mut body = lengths.as_flattened().to_vec();
    body.extend_from_slice(&summary);
    body.extend_from_slice(&zipped);
    let mut bytes = MAGIC.to_vec();
    bytes.extend_from_slice(&crc32c::crc32c(&body).to_le_bytes());
    bytes.extend_from_slice(&body);
    Ok(bytes)
}

/// The state of a journal: summary and numbers; `None` where there is none.
pub(crate) fn read_state(path: &Path) -> Result<Option<(StateSummary, Vec<u8>)>, StoreError> {
    let Some(bytes) = files::read_whole(path, u64::MAX)? else { return Ok(None) };
    let damaged = |what: &str| {
        StoreError::corrupt(path, what, bytes.len(), "the store cannot be resumed: encode it anew")
    };
    let (magic, rest) = bytes.split_first_chunk::<8>().ok_or_else(|| damaged("size in bytes"))?;
    let (crc, body) = rest.split_first_chunk::<4>().ok_or_else(|| damaged("size in bytes"))?;
    if magic != MAGIC || crc32c::crc32c(body).to_le_bytes() != *crc {
        return Err(damaged("checksum of a file of this many bytes"));
    }
    let (lengths, body) = body.split_first_chunk::<16>().ok_or_else(|| damaged("size in bytes"))?;
    let number = |at: usize| {
        u64::from_le_bytes(std::array::from_fn(|i| lengths[at + i])).try_into().unwrap_or(usize::MAX)
    };
    let (summary, zipped) =
        body.split_at_checked(number(0)).ok_or_else(|| damaged("length of the summary"))?;
    let summary = serde_json::from_slice(summary).map_err(|_| damaged("summary"))?;
    let mut numbers = Vec::new();
    let unzipped = zstd::Decoder::new(zipped)
        .and_then(|unzipped| unzipped.take(number(8) as u64).read_to_end(&mut numbers));
    match unzipped.is_ok_and(|len| len == number(8)) {
        true => Ok(Some((summary, numbers))),
        false => Err(damaged("numbers")),
    }
}

/// Takes numbers off the front of what follows a summary.
pub(crate) struct Numbers<'a> {
    pub path: &'a Path,
    pub rest: &'a [u8],
}

impl<'a> Numbers<'a> {
    /// The next `num` numbers of `N` bytes each.
    pub fn take<const N: usize>(&mut self, num: usize) -> Result<&'a [[u8; N]], StoreError> {
        let bytes = num.checked_mul(N).and_then(|bytes| self.rest.split_at_checked(bytes));
        let Some((taken, rest)) = bytes else {
            let problem = format!("{num} numbers of {N} bytes are due: encode the store anew");
            return Err(StoreError::corrupt(self.path, "bytes left", self.rest.len(), problem));
        };
        self.rest = rest;
        Ok(taken.as_chunks().0)
    }
}
