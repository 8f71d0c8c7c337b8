//! Decoding of Blosc 1 buffers, the compressor of most Zarr v2 arrays.
//!
//! Format: <https://github.com/Blosc/c-blosc/blob/main/README_CHUNK_FORMAT.rst>. A header of 16 bytes, the start of
//! each block, the blocks; a block is one or several compressed streams, whose bytes or bits may be shuffled. Streams of
//! BloscLZ, LZ4, zlib and zstd are read; those of snappy are not.

use super::codecs::{inflate_exact, zstd_exact};

/// Bytes of the header.
const HEADER_BYTES: usize = 16;

/// Types wider than this are never split into one stream per byte.
const MAX_SPLITS: usize = 16;

/// Streams shorter than this are never split off.
const MIN_STREAM_BYTES: usize = 128;

/// How far back a short match of BloscLZ reaches.
const MAX_SHORT_DISTANCE: usize = 8191;

/// What the header says.
struct Header {
    flags: u8,
    type_size: usize,
    num_bytes: usize,
    block_bytes: usize,
}

/// Decodes a buffer that stands for exactly `num_bytes`.
pub(crate) fn decode(encoded: &[u8], num_bytes: usize) -> Result<Vec<u8>, String> {
    let header = read_header(encoded, num_bytes)?;
    let mut out = vec![0; num_bytes];
    if header.flags & 0x02 != 0 {
        let stored =
            encoded.get(HEADER_BYTES..HEADER_BYTES + num_bytes).ok_or("a Blosc buffer that is truncated")?;
        out.copy_from_slice(stored);
        return Ok(out);
    }
    let mut shuffled = Vec::new();
    for (index, block) in out.chunks_mut(header.block_bytes.max(1)).enumerate() {
        let start = read_u32(encoded, HEADER_BYTES + 4 * index)?;
        let is_short = block.len() < header.block_bytes;
        if header.flags & 0x05 == 0 {
            decode_block(&header, encoded, start, is_short, block)?;
            continue;
        }
        shuffled.resize(block.len(), 0);
        decode_block(&header, encoded, start, is_short, &mut shuffled)?;
        if header.flags & 0x01 != 0 {
            unshuffle_bytes(&shuffled, block, header.type_size);
        } else {
            unshuffle_bits(&shuffled, block, header.type_size);
        }
    }
    Ok(out)
}

/// Reads the header and checks it.
fn read_header(encoded: &[u8], num_bytes: usize) -> Result<Header, String> {
    let head = encoded.get(..HEADER_BYTES).ok_or("a Blosc buffer shorter than its header")?;
    let header = Header {
        flags: head[2],
        type_size: usize::from(head[3]).max(1),
        num_bytes: read_u32(head, 4)?,
        block_bytes: read_u32(head, 8)?,
    };
    if header.num_bytes != num_bytes {
        return Err(format!("a Blosc buffer of {} bytes where {num_bytes} are needed", header.num_bytes));
    }
    if header.block_bytes == 0 && num_bytes > 0 {
        return Err("a Blosc buffer with blocks of no length".to_owned());
    }
    Ok(header)
}

/// A little-endian integer.
fn read_u32(bytes: &[u8], at: usize) -> Result<usize, String> {
    let four =
        at.checked_add(4).and_then(|end| bytes.get(at..end)).ok_or("a Blosc buffer that is truncated")?;
    Ok(u32::from_le_bytes([four[0], four[1], four[2], four[3]]) as usize)
}

/// Decodes the streams of a block.
fn decode_block(
    header: &Header,
    encoded: &[u8],
    start: usize,
    is_short: bool,
    block: &mut [u8],
) -> Result<(), String> {
    let may_split = header.flags & 0x10 == 0 && header.type_size <= MAX_SPLITS && !is_short;
    let num_streams = match may_split && block.len() / header.type_size >= MIN_STREAM_BYTES {
        true => header.type_size,
        false => 1,
    };
    let stream_bytes = block.len() / num_streams;
    if stream_bytes * num_streams != block.len() {
        return Err("a Blosc block that its streams do not fill".to_owned());
    }
    let mut position = start;
    for stream in block.chunks_exact_mut(stream_bytes) {
        let length = read_u32(encoded, position)?;
        position += 4;
        let end = position.checked_add(length).filter(|end| *end <= encoded.len());
        let compressed = &encoded[position..end.ok_or("a Blosc stream beyond the end of its buffer")?];
        position += length;
        if length == stream_bytes {
            stream.copy_from_slice(compressed);
            continue;
        }
        match header.flags >> 5 {
            0 => decode_blosclz(compressed, stream).ok_or("a damaged BloscLZ stream")?,
            1 => match lz4_flex::block::decompress_into(compressed, stream) {
                Ok(count) if count == stream_bytes => {}
                _ => return Err("a damaged LZ4 stream".to_owned()),
            },
            3 => inflate_exact(compressed, stream)?,
            4 => zstd_exact(compressed, stream)?,
            2 => {
                return Err("Blosc with snappy, which is not supported: write it with lz4 or zstd".to_owned());
            }
            other => return Err(format!("an unknown Blosc compressor, {other}")),
        }
    }
    Ok(())
}

/// Puts the bytes of each element together: stream `b` holds byte `b` of every element.
fn unshuffle_bytes(shuffled: &[u8], out: &mut [u8], type_size: usize) {
    let num_elements = out.len() / type_size;
    for (element, bytes) in out.chunks_exact_mut(type_size).enumerate() {
        for (b, byte) in bytes.iter_mut().enumerate() {
            *byte = shuffled[b * num_elements + element];
        }
    }
    let whole = num_elements * type_size;
    out[whole..].copy_from_slice(&shuffled[whole..]);
}

/// Puts the bits of each element together: row `8 b + k` holds bit `k` of byte `b` of every element.
fn unshuffle_bits(shuffled: &[u8], out: &mut [u8], type_size: usize) {
    let num_elements = out.len() / type_size;
    if !num_elements.is_multiple_of(8) {
        out.copy_from_slice(shuffled);
        return;
    }
    let row_bytes = num_elements / 8;
    let whole = num_elements * type_size;
    for (index, byte) in out[..whole].iter_mut().enumerate() {
        let (element, b) = (index / type_size, index % type_size);
        *byte = (0..8).fold(0, |bits, k| {
            let row = &shuffled[(8 * b + k) * row_bytes..];
            bits | (row[element / 8] >> (element % 8) & 1) << k
        });
    }
    out[whole..].copy_from_slice(&shuffled[whole..]);
}

/// Decodes a BloscLZ stream that fills `out`; `None` if it is damaged.
fn decode_blosclz(stream: &[u8], out: &mut [u8]) -> Option<()> {
    let mut input = stream.iter().copied();
    let mut filled = 0usize;
    let mut control = usize::from(input.next()? & 31);
    loop {
        if control >= 32 {
            let mut length = (control >> 5) - 1;
            let mut distance = (control & 31) << 8;
            if length == 6 {
                loop {
                    let more = usize::from(input.next()?);
                    length += more;
                    if more != 255 {
                        break;
                    }
                }
            }
            let low = usize::from(input.next()?);
            if low == 255 && distance == 31 << 8 {
                let (high, low) = (usize::from(input.next()?), usize::from(input.next()?));
                distance = (high << 8) + low + MAX_SHORT_DISTANCE;
            } else {
                distance += low;
            }
            let from = filled.checked_sub(distance + 1)?;
            let end = filled.checked_add(length + 3).filter(|end| *end <= out.len())?;
            // A match may overlap what it writes, so that bytes repeat.
            for at in filled..end {
                out[at] = out[at - filled + from];
            }
            filled = end;
        } else {
            let end = filled.checked_add(control + 1).filter(|end| *end <= out.len())?;
            for byte in &mut out[filled..end] {
                *byte = input.next()?;
            }
            filled = end;
        }
        match input.next() {
            Some(next) => control = usize::from(next),
            None => break,
        }
    }
    (filled == out.len()).then_some(())
}
