//! The bytes of a VTK XML data array: ascii, base64 or raw; plain, or in blocks compressed by zlib or LZ4.
//!
//! An array that is not ascii begins with a header of little unsigned integers, of 32 or 64 bits: its length, or where
//! blocks are compressed, their number, their length, that of a short last one (or 0), and their compressed lengths.

use std::fs::File;
use std::io::{BufRead, BufReader, Error, ErrorKind, Read, Result, Take};
use std::ops::Range;
use std::path::Path;

use chronoxel_core::SampleType;
use flate2::{Decompress, FlushDecompress, Status};

use super::number_text::NumberText;
use super::volume_file::{MAX_DEFLATE_RATIO, open_at};
use crate::SourceError;

/// Bytes of encoded data read at a time.
const READ_BYTES: usize = 1 << 17;

/// The most that LZ4 can expand its input.
const MAX_LZ4_RATIO: u64 = 256;

/// What blocks are compressed with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Compressor {
    Zlib,
    Lz4,
}

/// What is the same for all arrays of a file.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Encoding {
    pub big_endian: bool,
    /// Bytes of an integer in the header of an array: 4 or 8.
    pub header_width: usize,
    pub compressor: Option<Compressor>,
}

/// Where the data of one array are.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Place {
    Ascii(Range<u64>),
    Base64(Range<u64>),
    Raw(Range<u64>),
    /// Bytes without a header before them, never compressed.
    Bare(Range<u64>),
}

impl Place {
    /// Bytes of the file.
    fn range(&self) -> Range<u64> {
        match self {
            Self::Ascii(range) | Self::Base64(range) | Self::Raw(range) | Self::Bare(range) => range.clone(),
        }
    }

    /// The largest number of bytes of samples that can be there.
    pub fn most_bytes(&self, encoding: Encoding, sample_type: SampleType) -> u64 {
        let range = self.range();
        let available = range.end.saturating_sub(range.start);
        let decoded = match self {
            // A number takes a digit and a blank.
            Self::Ascii(_) => return (available / 2 + 1).saturating_mul(sample_type.num_bytes() as u64),
            Self::Bare(_) => return available,
            Self::Base64(_) => available / 4 * 3 + 3,
            Self::Raw(_) => available,
        };
        match encoding.compressor {
            None => decoded.saturating_sub(encoding.header_width as u64),
            Some(Compressor::Zlib) => decoded.saturating_mul(MAX_DEFLATE_RATIO),
            Some(Compressor::Lz4) => decoded.saturating_mul(MAX_LZ4_RATIO),
        }
    }

    /// Opens the bytes of the samples, little-endian if ascii, else in the file's order.
    pub fn open(
        &self,
        path: &Path,
        encoding: Encoding,
        sample_type: SampleType,
        num_bytes: u64,
    ) -> std::result::Result<Box<dyn Read + Send>, SourceError> {
        let range = self.range();
        let file = open_at(path, range.start)?;
        let limited = |file: File| file.take(range.end.saturating_sub(range.start));
        let buffered = |file| BufReader::with_capacity(READ_BYTES, limited(file));
        let opened: Result<Box<dyn Read + Send>> = match (self, encoding.compressor) {
            (Self::Ascii(_), _) => {
                let numbers = NumberText::<BufReader<Take<File>>>::new(buffered(file), sample_type);
                Ok(Box::new(ExactLength { input: numbers, num_left: num_bytes }))
            }
            (Self::Bare(_), _) => Ok(Box::new(limited(file))),
            (Self::Base64(_), None) => plain(Base64::new(buffered(file)), encoding, num_bytes),
            (Self::Base64(_), Some(c)) => blocks(Base64::new(buffered(file)), encoding, c, num_bytes),
            (Self::Raw(_), None) => plain(limited(file), encoding, num_bytes),
            (Self::Raw(_), Some(c)) => blocks(buffered(file), encoding, c, num_bytes),
        };
        opened.map_err(|e| SourceError::from_read(path, "header of a data array", e))
    }
}

/// An error about the bytes themselves.
fn invalid(text: impl Into<String>) -> Error {
    Error::new(ErrorKind::InvalidData, text.into())
}

/// One integer of a header.
fn read_integer(input: &mut impl Read, encoding: Encoding) -> Result<u64> {
    let mut bytes = [0; 8];
    input.read_exact(&mut bytes[..encoding.header_width])?;
    if encoding.big_endian {
        bytes[..encoding.header_width].reverse();
    }
    Ok(u64::from_le_bytes(bytes))
}

/// Checks the length of an array that is not compressed; its bytes follow.
fn plain<R: Read + Send + 'static>(
    mut input: R,
    encoding: Encoding,
    num_bytes: u64,
) -> Result<Box<dyn Read + Send>> {
    let given = read_integer(&mut input, encoding)?;
    if given != num_bytes {
        return Err(invalid(format!("a length of {given} bytes where the extent needs {num_bytes}")));
    }
    Ok(Box::new(input))
}

/// Reads the header of compressed blocks and checks it.
fn blocks<R: Read + Send + 'static>(
    mut input: R,
    encoding: Encoding,
    compressor: Compressor,
    num_bytes: u64,
) -> Result<Box<dyn Read + Send>> {
    let mut integer = || read_integer(&mut input, encoding);
    let (num_blocks, block_bytes, last_bytes) = (integer()?, integer()?, integer()?);
    let full_blocks = if last_bytes > 0 { num_blocks.saturating_sub(1) } else { num_blocks };
    let given = full_blocks.checked_mul(block_bytes).and_then(|full| full.checked_add(last_bytes));
    if given != Some(num_bytes) || num_blocks > num_bytes {
        return Err(invalid(format!(
            "{num_blocks} blocks of {block_bytes} bytes, the last of {last_bytes}, where the extent needs {num_bytes} bytes"
        )));
    }
    let mut compressed_bytes = Vec::new();
    for _ in 0..num_blocks {
        compressed_bytes.push(integer()?);
    }
    let blocks = compressed_bytes.into_iter();
    let last_bytes = if last_bytes > 0 { last_bytes } else { block_bytes };
    Ok(Box::new(Blocks {
        input,
        compressor,
        blocks,
        block_bytes,
        last_bytes,
        block: Vec::new(),
        next: 0,
        compressed: Vec::new(),
    }))
}

/// Decompresses block by block.
struct Blocks<R> {
    input: R,
    compressor: Compressor,
    /// Compressed lengths of the blocks to come.
    blocks: std::vec::IntoIter<u64>,
    block_bytes: u64,
    last_bytes: u64,
    /// The current block, and how much of it was given away.
    block: Vec<u8>,
    next: usize,
    compressed: Vec<u8>,
}

impl<R: Read> Blocks<R> {
    /// Decompresses the next block; `false` if there is none.
    fn next_block(&mut self) -> Result<bool> {
        let Some(compressed_bytes) = self.blocks.next() else { return Ok(false) };
        let num_bytes = if self.blocks.len() == 0 { self.last_bytes } else { self.block_bytes };
        let ratio = match self.compressor {
            Compressor::Zlib => MAX_DEFLATE_RATIO,
            Compressor::Lz4 => MAX_LZ4_RATIO,
        };
        self.compressed.clear();
        let read = (&mut self.input).take(compressed_bytes).read_to_end(&mut self.compressed)?;
        if (read as u64) < compressed_bytes {
            return Err(invalid(format!(
                "a block of {compressed_bytes} bytes of which {read} are there; the file is truncated"
            )));
        }
        if num_bytes > compressed_bytes.saturating_mul(ratio) {
            return Err(invalid(format!("a block of {num_bytes} bytes compressed to {compressed_bytes}")));
        }
        self.block.resize(num_bytes as usize, 0);
        self.next = 0;
        let is_whole = match self.compressor {
            Compressor::Zlib => {
                let mut zlib = Decompress::new(true);
                let status = zlib.decompress(&self.compressed, &mut self.block, FlushDecompress::Finish);
                status.is_ok_and(|s| s == Status::StreamEnd) && zlib.total_out() == num_bytes
            }
            Compressor::Lz4 => lz4_flex::block::decompress_into(&self.compressed, &mut self.block)
                .is_ok_and(|n| n as u64 == num_bytes),
        };
        if is_whole { Ok(true) } else { Err(invalid("a damaged compressed block")) }
    }
}

impl<R: Read> Read for Blocks<R> {
    fn read(&mut self, out: &mut [u8]) -> Result<usize> {
        if self.next == self.block.len() && (out.is_empty() || !self.next_block()?) {
            return Ok(0);
        }
        let count = (self.block.len() - self.next).min(out.len());
        out[..count].copy_from_slice(&self.block[self.next..self.next + count]);
        self.next += count;
        Ok(count)
    }
}

/// Fails if there is more than there should be.
struct ExactLength<R> {
    input: R,
    num_left: u64,
}

impl<R: Read> Read for ExactLength<R> {
    fn read(&mut self, out: &mut [u8]) -> Result<usize> {
        let wanted = usize::try_from(self.num_left).unwrap_or(usize::MAX).min(out.len());
        let count = self.input.read(&mut out[..wanted])?;
        self.num_left -= count as u64;
        if self.num_left == 0 && count > 0 && self.input.read(&mut [0])? > 0 {
            return Err(invalid("more numbers than the extent needs"));
        }
        Ok(count)
    }
}

/// Decodes base64; several pieces, each with its padding, may follow each other.
struct Base64<R> {
    input: R,
    /// Decoded bytes not yet given away, at the end of the three.
    decoded: [u8; 3],
    num_decoded: usize,
}

impl<R: BufRead> Base64<R> {
    fn new(input: R) -> Self {
        Self { input, decoded: [0; 3], num_decoded: 0 }
    }

    /// Four characters, white space left out; `None` at the end of the text.
    fn next_quad(&mut self) -> Result<Option<[u8; 4]>> {
        let mut quad = [0; 4];
        let mut filled = 0;
        while filled < 4 {
            let available = match self.input.fill_buf() {
                Ok(available) => available,
                Err(e) if e.kind() == ErrorKind::Interrupted => continue,
                Err(e) => return Err(e),
            };
            if available.is_empty() || available[0] == b'<' {
                break;
            }
            let mut taken = 0;
            for &byte in available {
                if filled == 4 || byte == b'<' {
                    break;
                }
                taken += 1;
                if !byte.is_ascii_whitespace() {
                    quad[filled] = byte;
                    filled += 1;
                }
            }
            self.input.consume(taken);
        }
        match filled {
            4 => Ok(Some(quad)),
            0 => Ok(None),
            _ => Err(invalid("base64 text that ends within a group of four characters")),
        }
    }
}

impl<R: BufRead> Base64<R> {
    /// Decodes whole groups without white space or padding while both buffers last; gives the number of bytes.
    fn read_plain(&mut self, out: &mut [u8]) -> Result<usize> {
        let available = match self.input.fill_buf() {
            Ok(available) => available,
            // What was decoded before must not be lost; the slow path waits.
            Err(e) if e.kind() == ErrorKind::Interrupted => return Ok(0),
            Err(e) => return Err(e),
        };
        let mut num_groups = 0;
        for (quad, bytes) in available.chunks_exact(4).zip(out.chunks_exact_mut(3)) {
            let values = [0, 1, 2, 3].map(|i| BASE64_VALUES[usize::from(quad[i])]);
            if values.iter().any(|value| *value > 63) {
                break;
            }
            let bits = values.iter().fold(0, |bits, value| bits << 6 | u32::from(*value));
            bytes.copy_from_slice(&bits.to_be_bytes()[1..]);
            num_groups += 1;
        }
        self.input.consume(4 * num_groups);
        Ok(3 * num_groups)
    }
}

impl<R: BufRead> Read for Base64<R> {
    fn read(&mut self, out: &mut [u8]) -> Result<usize> {
        let mut filled = 0;
        while filled < out.len() {
            if self.num_decoded == 0 {
                filled += self.read_plain(&mut out[filled..])?;
                if filled == out.len() {
                    break;
                }
                let Some(quad) = self.next_quad()? else { break };
                self.num_decoded = decode_quad(quad, &mut self.decoded)?;
            }
            let count = self.num_decoded.min(out.len() - filled);
            let start = 3 - self.num_decoded;
            out[filled..filled + count].copy_from_slice(&self.decoded[start..start + count]);
            self.num_decoded -= count;
            filled += count;
        }
        Ok(filled)
    }
}

/// Decodes a whole text; `None` if it is not base64.
pub(crate) fn decode_base64(text: &str) -> Option<Vec<u8>> {
    let mut out = Vec::new();
    Base64::new(text.as_bytes()).read_to_end(&mut out).ok()?;
    Some(out)
}

/// Decodes four characters to the end of three bytes; gives how many bytes they stand for.
fn decode_quad(quad: [u8; 4], decoded: &mut [u8; 3]) -> Result<usize> {
    let padding = quad.iter().rev().take_while(|&&c| c == b'=').count();
    let mut bits = 0u32;
    for &character in &quad[..4 - padding] {
        let value = BASE64_VALUES[usize::from(character)];
        if value > 63 {
            return Err(invalid(format!("{:?} in base64 text", char::from(character))));
        }
        bits = bits << 6 | u32::from(value);
    }
    let bytes = (bits << (6 * padding)).to_be_bytes();
    match padding {
        0 => *decoded = [bytes[1], bytes[2], bytes[3]],
        1 => *decoded = [0, bytes[1], bytes[2]],
        2 => *decoded = [0, 0, bytes[1]],
        _ => return Err(invalid("too much padding in base64 text")),
    }
    Ok(3 - padding)
}

/// The six bits that a character stands for; 255 for the others.
const BASE64_VALUES: [u8; 256] = {
    let alphabet = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut values = [255; 256];
    let mut i = 0;
    while i < 64 {
        values[alphabet[i] as usize] = i as u8;
        i += 1;
    }
    values
};

#[cfg(test)]
mod tests {
    use super::*;

    /// Decodes through buffers of several lengths, which must not matter.
    fn decoded(text: &str) -> Result<Vec<u8>> {
        let through = |capacity| {
            let mut out = Vec::new();
            Base64::new(BufReader::with_capacity(capacity, text.as_bytes())).read_to_end(&mut out)?;
            Ok(out)
        };
        let all: Vec<Result<Vec<u8>>> = [3, 5, 64].map(through).into();
        assert!(all.iter().all(|one| one.as_ref().ok() == all[0].as_ref().ok()), "{text}");
        all.into_iter().next().expect("there are three")
    }

    /// The vectors of RFC 4648, section 10.
    #[test]
    fn base64_of_the_standard() {
        let vectors = [
            ("", ""),
            ("Zg==", "f"),
            ("Zm8=", "fo"),
            ("Zm9v", "foo"),
            ("Zm9vYmE=", "fooba"),
            ("Zm9vYmFy", "foobar"),
        ];
        for (text, bytes) in vectors {
            assert_eq!(decoded(text).unwrap(), bytes.as_bytes());
        }
        assert_eq!(decoded(" Zm\n8=Zg==\tZm9v </x>").unwrap(), b"foffoo");
        for wrong in ["Zg=", "Z===", "====", "Zm9*", "Z"] {
            assert!(decoded(wrong).is_err(), "{wrong}");
        }
    }
}
