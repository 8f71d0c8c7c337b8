//! The codecs that turn the bytes of a Zarr chunk into the bytes of its samples.

use std::io::Read;

use flate2::read::{MultiGzDecoder, ZlibDecoder};
use flate2::{Decompress, FlushDecompress, Status};
use serde_json::Value;

use super::blosc;

/// One codec from bytes to bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BytesCodec {
    Gzip,
    Zlib,
    Zstd,
    Blosc,
    Crc32c,
    Lz4,
}

impl BytesCodec {
    /// The codec of a name, as Zarr or numcodecs give it.
    pub fn of(name: &str) -> Option<Self> {
        match name.strip_prefix("numcodecs.").unwrap_or(name) {
            "gzip" => Some(Self::Gzip),
            "zlib" => Some(Self::Zlib),
            "zstd" => Some(Self::Zstd),
            "blosc" => Some(Self::Blosc),
            "crc32c" => Some(Self::Crc32c),
            "lz4" => Some(Self::Lz4),
            _ => None,
        }
    }

    /// Undoes the codec; the result has at most `most_bytes`, exactly so many where `is_first`.
    fn decode(self, encoded: &[u8], most_bytes: usize, is_first: bool) -> Result<Vec<u8>, String> {
        match self {
            Self::Gzip => read_at_most(MultiGzDecoder::new(encoded), most_bytes),
            Self::Zlib => read_at_most(ZlibDecoder::new(encoded), most_bytes),
            Self::Zstd => {
                let decoder = zstd::stream::read::Decoder::with_buffer(encoded).map_err(|e| e.to_string())?;
                read_at_most(decoder, most_bytes)
            }
            Self::Blosc if is_first => blosc::decode(encoded, most_bytes),
            Self::Blosc => Err("Blosc before another compressor, which is not supported".to_owned()),
            Self::Crc32c => checked_crc(encoded).map(<[u8]>::to_vec),
            Self::Lz4 => decode_lz4(encoded, most_bytes),
        }
    }
}

/// Undoes a chain of codecs; the result has exactly `num_bytes`.
///
/// No step of it may become longer than the result and what an encoder adds to data that do not compress.
pub(crate) fn decode(codecs: &[BytesCodec], encoded: Vec<u8>, num_bytes: usize) -> Result<Vec<u8>, String> {
    let mut bytes = encoded;
    for (index, codec) in codecs.iter().enumerate().rev() {
        let most_bytes = if index == 0 { num_bytes } else { most_encoded_bytes(num_bytes) };
        bytes = codec.decode(&bytes, most_bytes, index == 0)?;
    }
    if bytes.len() != num_bytes {
        return Err(format!("{} bytes where the chunk needs {num_bytes}", bytes.len()));
    }
    Ok(bytes)
}

/// The most bytes that a chunk of `num_bytes` can take when encoded.
pub(crate) fn most_encoded_bytes(num_bytes: usize) -> usize {
    num_bytes + num_bytes / 8 + (64 << 10)
}

/// The most bytes that [`decode`] holds at a time for a chunk of `num_bytes`, the encoded ones included.
pub(crate) fn most_bytes_while_decoding(codecs: &[BytesCodec], num_bytes: u64) -> u64 {
    let encoded = most_encoded_bytes(num_bytes as usize) as u64;
    match codecs {
        [] => encoded,
        // A block that is shuffled may be as long as the chunk.
        [BytesCodec::Blosc] => encoded + 2 * num_bytes,
        [BytesCodec::Blosc, ..] => 2 * encoded + num_bytes,
        [_] => encoded + num_bytes,
        _ => 2 * encoded,
    }
}

/// The bytes before their CRC-32C, once it was found right.
pub(crate) fn checked_crc(encoded: &[u8]) -> Result<&[u8], String> {
    let (bytes, given) = encoded.split_last_chunk::<4>().ok_or("a chunk shorter than its checksum")?;
    let (found, given) = (crc32c::crc32c(bytes), u32::from_le_bytes(*given));
    if found == given {
        Ok(bytes)
    } else {
        Err(format!("bytes of CRC-32C {found:08x} where {given:08x} is stored: they are damaged"))
    }
}

/// Reads to the end, which must come within `most_bytes`.
fn read_at_most(input: impl Read, most_bytes: usize) -> Result<Vec<u8>, String> {
    let mut out = Vec::new();
    input.take(most_bytes as u64 + 1).read_to_end(&mut out).map_err(|e| e.to_string())?;
    if out.len() > most_bytes {
        Err(format!("more than the {most_bytes} bytes that it can have"))
    } else {
        Ok(out)
    }
}

/// Decodes LZ4 as numcodecs writes it: the length, then one block.
fn decode_lz4(encoded: &[u8], most_bytes: usize) -> Result<Vec<u8>, String> {
    let (length, block) = encoded.split_first_chunk::<4>().ok_or("an LZ4 chunk shorter than its header")?;
    let length = u32::from_le_bytes(*length) as usize;
    if length > most_bytes || length > block.len().saturating_mul(256) {
        return Err(format!("an LZ4 chunk of {length} bytes where {most_bytes} are needed"));
    }
    let mut out = vec![0; length];
    match lz4_flex::block::decompress_into(block, &mut out) {
        Ok(count) if count == length => Ok(out),
        _ => Err("a damaged LZ4 chunk".to_owned()),
    }
}

/// Inflates a zlib stream that fills `out`.
pub(crate) fn inflate_exact(stream: &[u8], out: &mut [u8]) -> Result<(), String> {
    let mut zlib = Decompress::new(true);
    let status = zlib.decompress(stream, out, FlushDecompress::Finish);
    let is_whole = status.is_ok_and(|s| s == Status::StreamEnd) && zlib.total_out() == out.len() as u64;
    if is_whole { Ok(()) } else { Err("a damaged zlib stream".to_owned()) }
}

/// Decodes a zstd frame that fills `out`.
pub(crate) fn zstd_exact(frame: &[u8], out: &mut [u8]) -> Result<(), String> {
    match zstd::bulk::decompress_to_buffer(frame, out) {
        Ok(count) if count == out.len() => Ok(()),
        Ok(count) => Err(format!("a zstd frame of {count} bytes where {} are needed", out.len())),
        Err(error) => Err(format!("a damaged zstd frame ({error})")),
    }
}

/// The name of a codec in the metadata of version 2 (`id`) or 3 (`name`).
pub(crate) fn codec_name(codec: &Value) -> &str {
    let named = codec.get("name").or_else(|| codec.get("id")).unwrap_or(codec);
    named.as_str().unwrap_or("without a name")
}
