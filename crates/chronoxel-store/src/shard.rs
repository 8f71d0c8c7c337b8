//! Shards: inner chunks one after the other, then the index: offset and length of each, CRC-32C.
//!
//! The writer streams chunks to a temporary file and never holds a shard in memory. The reader trusts
//! nothing: every length is checked against the file and the class before it is used.

use std::{
    collections::BTreeMap,
    fs::{File, OpenOptions},
    io::{ErrorKind, Write},
    path::{Path, PathBuf},
};

use crate::{StoreError, chunk, files};

const ABSENT: [u64; 2] = [u64::MAX; 2];
const FLUSH_BYTES: usize = 1 << 20;

/// A shard that is being written. Hundreds may be at once, so none keeps its file open, and each remembers the
/// places of its chunks only.
#[derive(Debug)]
pub(crate) struct OpenShard {
    path: PathBuf,
    num_slots: usize,
    /// Offset and length of the chunk of a slot.
    extents: BTreeMap<u32, [u64; 2]>,
    /// Bytes appended so far, those in `pending` included.
    len: u64,
    pending: Vec<u8>,
    chunk_bytes: usize,
}

impl OpenShard {
    /// A new shard of `num_slots` inner chunks of `chunk_bytes` bytes before compression.
    pub fn create(path: PathBuf, num_slots: usize, chunk_bytes: usize) -> Result<Self, StoreError> {
        File::create(&path).map_err(StoreError::io(&path, "create"))?;
        let (extents, pending) = (BTreeMap::new(), Vec::new());
        Ok(Self { path, num_slots, extents, len: 0, pending, chunk_bytes })
    }

    /// Goes on with a shard whose first `len` bytes are good and hold the chunks at `extents`.
    pub fn reopen(
        path: PathBuf,
        num_slots: usize,
        extents: BTreeMap<u32, [u64; 2]>,
        len: u64,
        chunk_bytes: usize,
    ) -> Result<Self, StoreError> {
        let file = OpenOptions::new().write(true).open(&path).map_err(StoreError::io(&path, "open"))?;
        let found = file.metadata().map_err(StoreError::io(&path, "read the size of"))?.len();
        let outside = |(slot, [offset, bytes]): (&u32, &[u64; 2])| {
            *slot as usize >= num_slots || offset.checked_add(*bytes).is_none_or(|end| end > len)
        };
        if found < len || extents.iter().any(outside) {
            let problem = format!("the journal says {len}: the store cannot be resumed, encode it anew");
            return Err(StoreError::corrupt(&path, "size in bytes", found, problem));
        }
        file.set_len(len).map_err(StoreError::io(&path, "truncate"))?;
        Ok(Self { path, num_slots, extents, len, pending: Vec::new(), chunk_bytes })
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Offset and length of the chunk of each slot that has one.
    pub fn extents(&self) -> &BTreeMap<u32, [u64; 2]> {
        &self.extents
    }

    pub fn len(&self) -> u64 {
        self.len
    }

    /// Appends a stored chunk.
    pub fn append(&mut self, slot: usize, stored: &[u8]) -> Result<(), StoreError> {
        self.extents.insert(slot as u32, [self.len, stored.len() as u64]);
        self.len += stored.len() as u64;
        self.pending.extend_from_slice(stored);
        if self.pending.len() >= FLUSH_BYTES { self.flush() } else { Ok(()) }
    }

    /// Hands everything appended so far to the system, so that it can be read back.
    pub fn flush(&mut self) -> Result<(), StoreError> {
        if self.pending.is_empty() {
            return Ok(());
        }
        let file = OpenOptions::new().append(true).open(&self.path);
        let mut file = file.map_err(StoreError::io(&self.path, "open"))?;
        file.write_all(&self.pending).map_err(StoreError::io(&self.path, "write"))?;
        self.pending = Vec::new();
        Ok(())
    }

    /// Appends the index; the file is then complete, and as long as is returned.
    pub fn close(mut self) -> Result<u64, StoreError> {
        let mut index: Vec<u8> = vec![0xff; 16 * self.num_slots];
        for (&slot, extent) in &self.extents {
            let numbers = extent.map(u64::to_le_bytes);
            index[16 * slot as usize..][..16].copy_from_slice(numbers.as_flattened());
        }
        index.extend_from_slice(&crc32c::crc32c(&index).to_le_bytes());
        self.pending.extend_from_slice(&index);
        self.flush()?;
        Ok(self.len + index.len() as u64)
    }

    /// The bytes of a chunk appended and flushed before.
    pub fn read(&self, slot: usize) -> Result<Option<Vec<u8>>, StoreError> {
        let Some(&[offset, len]) = self.extents.get(&(slot as u32)) else { return Ok(None) };
        let mut stored = vec![0; len as usize];
        let file = File::open(&self.path).map_err(StoreError::io(&self.path, "open"))?;
        files::read_at(&file, &mut stored, offset).map_err(StoreError::io(&self.path, "read"))?;
        chunk::decode(&stored, self.chunk_bytes)
            .map(Some)
            .map_err(|problem| StoreError::corrupt(&self.path, "inner chunk", slot, problem))
    }
}

/// A complete shard, opened for reading.
#[derive(Debug)]
pub(crate) struct ShardFile {
    path: PathBuf,
    file: File,
    index: Vec<[u64; 2]>,
    chunk_bytes: usize,
}

impl ShardFile {
    /// Opens a shard and checks its index; `None` where there is no such file.
    pub fn open(path: &Path, num_slots: usize, chunk_bytes: usize) -> Result<Option<Self>, StoreError> {
        let file = match File::open(path) {
            Ok(file) => file,
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(StoreError::io(path, "open")(e)),
        };
        let len = file.metadata().map_err(StoreError::io(path, "read the size of"))?.len();
        let index_bytes = 16 * num_slots as u64 + 4;
        let Some(index_start) = len.checked_sub(index_bytes) else {
            let problem = format!("its index alone has {index_bytes}: the file is cut short");
            return Err(StoreError::corrupt(path, "size in bytes", len, problem));
        };
        let mut bytes = vec![0; index_bytes as usize];
        files::read_at(&file, &mut bytes, index_start).map_err(StoreError::io(path, "read"))?;
        let (numbers, crc) = bytes.split_at(16 * num_slots);
        let computed = crc32c::crc32c(numbers).to_le_bytes();
        if crc != computed {
            let problem = format!("the checksum of the index is {computed:02x?}: the file is damaged");
            return Err(StoreError::corrupt(path, "index checksum", format!("{crc:02x?}"), problem));
        }
        let (numbers, _) = numbers.as_chunks::<8>();
        let (pairs, _) = numbers.as_chunks::<2>();
        let index: Vec<[u64; 2]> = pairs.iter().map(|pair| pair.map(u64::from_le_bytes)).collect();
        let most = chunk::largest_stored(chunk_bytes) as u64;
        for (slot, [offset, stored]) in index.iter().copied().enumerate().filter(|(_, e)| *e != ABSENT) {
            if stored > most || offset.checked_add(stored).is_none_or(|end| end > index_start) {
                let value = format!("offset {offset}, {stored} bytes");
                let problem = "it lies outside the file or is too long";
                return Err(StoreError::corrupt(path, format!("index entry {slot}"), value, problem));
            }
        }
        Ok(Some(Self { path: path.to_owned(), file, index, chunk_bytes }))
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn num_bytes(&self) -> usize {
        size_of::<Self>() + 16 * self.index.len()
    }

    /// Offset and length of a stored chunk.
    pub fn extent(&self, slot: usize) -> Option<[u64; 2]> {
        self.index.get(slot).copied().filter(|extent| *extent != ABSENT)
    }

    /// A range of the file, within extents of the index.
    pub fn read_range(&self, offset: u64, len: usize) -> Result<Vec<u8>, StoreError> {
        let mut stored = vec![0; len];
        files::read_at(&self.file, &mut stored, offset).map_err(StoreError::io(&self.path, "read"))?;
        Ok(stored)
    }

    /// The bytes of a chunk from its stored form; else what is wrong.
    pub fn decode(&self, stored: &[u8]) -> Result<Vec<u8>, String> {
        chunk::decode(stored, self.chunk_bytes)
    }

    /// What is wrong with how chunks fill the file: they must lie end to end, the index after them.
    pub fn gap(&self) -> Option<String> {
        let mut extents: Vec<[u64; 2]> = self.index.iter().copied().filter(|e| *e != ABSENT).collect();
        extents.sort_unstable();
        let mut at = 0;
        for [offset, len] in extents {
            if offset != at {
                return Some(format!("a chunk starts at byte {offset} where the one before it ends at {at}"));
            }
            at += len;
        }
        let due = at + 16 * self.index.len() as u64 + 4;
        let len = self.file.metadata().map(|m| m.len()).unwrap_or(0);
        (len != due).then(|| format!("the file has {len} bytes where chunks and index have {due}"))
    }
}
