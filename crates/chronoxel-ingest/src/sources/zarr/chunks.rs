//! The chunks of a Zarr array: their files, shards, and decoded samples.

use std::fs::File;
use std::io::{ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use chronoxel_core::Samples;

use super::codecs::{checked_crc, decode, most_bytes_while_decoding, most_encoded_bytes};
use super::metadata::{ArrayMetadata, ShardIndex};
use crate::SourceError;
use crate::sources::samples::SampleFormat;

/// What a shard's index says of a chunk that is absent.
const ABSENT: u64 = u64::MAX;

/// Reads the chunks of one array.
pub(crate) struct ChunkReader<'a> {
    array: &'a ArrayMetadata,
    format: SampleFormat,
    /// The shard that the last chunk was in, by its place in the grid of shards.
    shard: Option<(Vec<u64>, Option<Shard>)>,
}

/// A shard whose index was read.
struct Shard {
    path: PathBuf,
    file: File,
    file_bytes: u64,
    /// Position and length of each chunk.
    entries: Vec<[u64; 2]>,
}

impl<'a> ChunkReader<'a> {
    /// A reader of an array's chunks.
    pub fn new(array: &'a ArrayMetadata) -> Self {
        Self { array, format: SampleFormat::scalar(array.sample_type, array.big_endian), shard: None }
    }

    /// The most bytes that reading a chunk takes: its bytes while they are decoded, or beside its samples, and the
    /// index of its shard.
    pub fn working_bytes(&self) -> u64 {
        let chunk = self.array.chunk_bytes() as u64;
        let samples = chunk / self.array.sample_type.num_bytes() as u64 * self.format.held_bytes() as u64;
        let decoding = most_bytes_while_decoding(&self.array.codecs, chunk);
        let per_shard = self.array.file_chunk.iter().zip(&self.array.chunk).map(|(file, inner)| file / inner);
        let index = match self.array.shard_index {
            // Its bytes, and its entries.
            Some(_) => per_shard.fold(2 * 16, u64::saturating_mul),
            None => 0,
        };
        decoding.max(chunk + samples).saturating_add(index)
    }

    /// The samples of a chunk in the order in which they are stored; `None` where it is absent.
    ///
    /// * `place`: indices in the grid of chunks (of chunks within shards, where there are shards)
    pub fn read(&mut self, place: &[u64]) -> Result<Option<Samples>, SourceError> {
        let found = match self.array.shard_index {
            Some(index) => self.encoded_in_shard(place, index)?,
            None => self.encoded_in_file(place)?,
        };
        let Some((path, encoded)) = found else { return Ok(None) };
        let bytes = decode(&self.array.codecs, encoded, self.array.chunk_bytes())
            .map_err(|problem| self.damaged(&path, place, problem))?;
        let mut samples = self.format.empty();
        self.format.append(&bytes, &mut samples).map_err(|integer| {
            let remedy =
                "integers beyond 2^53 would be rounded; convert the array to f64 or narrower integers";
            SourceError::unsupported(&path, "chunk", integer, remedy)
        })?;
        Ok(Some(samples))
    }

    /// The error for a chunk that cannot be decoded.
    fn damaged(&self, path: &Path, place: &[u64], problem: String) -> SourceError {
        SourceError::corrupt(path, "chunk", format!("{place:?}"), format!("{problem}; write the array again"))
    }

    /// The most bytes that the encoded chunk may have.
    fn most_bytes(&self) -> u64 {
        most_encoded_bytes(self.array.chunk_bytes()) as u64
    }

    /// The file of a chunk or shard.
    fn file_path(&self, place: &[u64]) -> PathBuf {
        let key: Vec<String> = place.iter().map(u64::to_string).collect();
        self.array.folder.join(format!("{}{}", self.array.key_prefix, key.join(self.array.key_separator)))
    }

    /// The bytes of a chunk that has a file of its own.
    fn encoded_in_file(&self, place: &[u64]) -> Result<Option<(PathBuf, Vec<u8>)>, SourceError> {
        let path = self.file_path(place);
        let Some((file, file_bytes)) = open_if_there(&path)? else { return Ok(None) };
        if file_bytes > self.most_bytes() {
            let problem = format!("{file_bytes} bytes for a chunk of {}", self.array.chunk_bytes());
            return Err(self.damaged(&path, place, problem));
        }
        let mut encoded = Vec::with_capacity(file_bytes as usize);
        file.take(file_bytes).read_to_end(&mut encoded).map_err(|e| SourceError::io(&path, "read", e))?;
        Ok(Some((path, encoded)))
    }

    /// The bytes of a chunk in a shard.
    fn encoded_in_shard(
        &mut self,
        place: &[u64],
        index: ShardIndex,
    ) -> Result<Option<(PathBuf, Vec<u8>)>, SourceError> {
        let array = self.array;
        let per_shard: Vec<u64> =
            array.file_chunk.iter().zip(&array.chunk).map(|(file, inner)| file / inner).collect();
        let shard_place: Vec<u64> = place.iter().zip(&per_shard).map(|(at, n)| at / n).collect();
        if self.shard.as_ref().is_none_or(|(at, _)| *at != shard_place) {
            let num_chunks = per_shard.iter().product();
            let shard = open_shard(&self.file_path(&shard_place), num_chunks, index)?;
            self.shard = Some((shard_place, shard));
        }
        let Some((_, Some(shard))) = &mut self.shard else { return Ok(None) };
        let inner = place.iter().zip(&per_shard).fold(0, |all, (at, n)| all * n + at % n);
        let [position, length] = shard.entries[inner as usize];
        if position == ABSENT && length == ABSENT {
            return Ok(None);
        }
        let path = shard.path.clone();
        let is_inside = position.checked_add(length).is_some_and(|end| end <= shard.file_bytes);
        let most_bytes = most_encoded_bytes(array.chunk_bytes()) as u64;
        if !is_inside || length > most_bytes {
            let problem = format!("{length} bytes at {position} of a shard of {}", shard.file_bytes);
            return Err(self.damaged(&path, place, problem));
        }
        let mut encoded = Vec::with_capacity(length as usize);
        shard.file.seek(SeekFrom::Start(position)).map_err(|e| SourceError::io(&path, "seek in", e))?;
        let read = (&shard.file).take(length).read_to_end(&mut encoded);
        read.map_err(|e| SourceError::io(&path, "read", e))?;
        Ok(Some((path, encoded)))
    }
}

/// Opens a file and gives its length; `None` where there is none.
fn open_if_there(path: &Path) -> Result<Option<(File, u64)>, SourceError> {
    // Asked before opening: opening a pipe would wait for a writer.
    let metadata = match std::fs::metadata(path) {
        Ok(metadata) => metadata,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(SourceError::io(path, "open", error)),
    };
    if !metadata.is_file() {
        return Err(SourceError::corrupt(path, "chunk", "not a regular file", "a chunk must be a file"));
    }
    let file = File::open(path).map_err(|e| SourceError::io(path, "open", e))?;
    Ok(Some((file, metadata.len())))
}

/// Opens a shard and reads its index.
fn open_shard(path: &Path, num_chunks: u64, index: ShardIndex) -> Result<Option<Shard>, SourceError> {
    let Some((mut file, file_bytes)) = open_if_there(path)? else { return Ok(None) };
    let crc_bytes = if index.has_crc { 4 } else { 0 };
    let index_bytes = num_chunks.checked_mul(16).and_then(|n| n.checked_add(crc_bytes));
    let Some(index_bytes) = index_bytes.filter(|n| *n <= file_bytes) else {
        let problem = format!("its index has {num_chunks} entries of 16 bytes; the file is truncated");
        return Err(SourceError::corrupt(
            path,
            "length of the shard",
            format!("{file_bytes} bytes"),
            problem,
        ));
    };
    let start = if index.at_end { file_bytes - index_bytes } else { 0 };
    file.seek(SeekFrom::Start(start)).map_err(|e| SourceError::io(path, "seek in", e))?;
    let mut bytes = Vec::new();
    (&file).take(index_bytes).read_to_end(&mut bytes).map_err(|e| SourceError::io(path, "read", e))?;
    let bytes = match index.has_crc {
        true => checked_crc(&bytes)
            .map_err(|problem| SourceError::corrupt(path, "index of the shard", "damaged", problem))?,
        false => &bytes,
    };
    let integer = |b: &[u8]| u64::from_le_bytes(b.try_into().expect("a half of sixteen bytes"));
    let entries = bytes.chunks_exact(16).map(|b| [integer(&b[..8]), integer(&b[8..])]).collect();
    Ok(Some(Shard { path: path.to_owned(), file, file_bytes, entries }))
}
