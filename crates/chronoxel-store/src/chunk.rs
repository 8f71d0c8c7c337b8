//! One inner chunk: zstd, then CRC-32C of the compressed bytes, little-endian.

use std::cell::RefCell;

use zstd::bulk::{Compressor, Decompressor};

/// Bytes that a stored byte can stand for: a block of 128 KiB takes at least four.
const MOST_RATIO: usize = 1 << 15;

thread_local! {
    static COMPRESSOR: RefCell<Option<(i32, Compressor<'static>)>> = const { RefCell::new(None) };
    static SCRATCH: RefCell<Vec<u8>> = const { RefCell::new(Vec::new()) };
    static DECOMPRESSOR: RefCell<Option<Decompressor<'static>>> = const { RefCell::new(None) };
}

/// Most bytes that `num_bytes` can take when stored.
pub(crate) fn largest_stored(num_bytes: usize) -> usize {
    zstd::zstd_safe::compress_bound(num_bytes) + 4
}

/// Bytes that a stage of a payload takes on disk: a zstd frame and its checksum, as [`crate::StoreWriter::put`] writes
/// them. Each thread keeps its compressor and its buffer, so that many may ask at once.
///
/// * `zstd_level`: that of the store, [`crate::StoreDescription::zstd_level`]
///
/// # Panics
/// If there is no memory for the compressor.
pub fn stored_len(bytes: &[u8], zstd_level: i32) -> usize {
    let len = SCRATCH.with_borrow_mut(|scratch| {
        scratch.clear();
        encode_to(bytes, zstd_level, scratch).map(|()| scratch.len())
    });
    len.expect("zstd fails for want of memory only")
}

/// The stored form of a chunk's bytes.
pub(crate) fn encode(bytes: &[u8], level: i32) -> std::io::Result<Vec<u8>> {
    let mut stored = Vec::new();
    encode_to(bytes, level, &mut stored)?;
    // It is kept until it is written: not with the room that the worst case asked for.
    stored.shrink_to_fit();
    Ok(stored)
}

/// As [`encode`], for a level of zstd that is not that of the payloads: the thread keeps its compressor for those.
pub(crate) fn encode_once(bytes: &[u8], level: i32) -> std::io::Result<Vec<u8>> {
    let mut stored = zstd::bulk::compress(bytes, level)?;
    stored.extend_from_slice(&crc32c::crc32c(&stored).to_le_bytes());
    Ok(stored)
}

fn encode_to(bytes: &[u8], level: i32, stored: &mut Vec<u8>) -> std::io::Result<()> {
    COMPRESSOR.with_borrow_mut(|slot| {
        let compressor = match slot {
            Some((at, compressor)) if *at == level => compressor,
            _ => &mut slot.insert((level, Compressor::new(level)?)).1,
        };
        stored.reserve(largest_stored(bytes.len()));
        compressor.compress_to_buffer(bytes, stored)?;
        let crc = crc32c::crc32c(stored);
        stored.extend_from_slice(&crc.to_le_bytes());
        Ok(())
    })
}

/// The bytes of a stored chunk, which must be `num_bytes`; else what is wrong.
pub(crate) fn decode(stored: &[u8], num_bytes: usize) -> Result<Vec<u8>, String> {
    let Some((compressed, crc)) = stored.split_last_chunk::<4>() else {
        return Err(format!("{} stored bytes are too few for a checksum", stored.len()));
    };
    let (stated, computed) = (u32::from_le_bytes(*crc), crc32c::crc32c(compressed));
    if stated != computed {
        return Err(format!(
            "the checksum is {computed:08x} where {stated:08x} is stored: bytes are damaged"
        ));
    }
    if num_bytes / MOST_RATIO > stored.len() {
        return Err(format!("{} stored bytes cannot hold {num_bytes}", stored.len()));
    }
    DECOMPRESSOR.with_borrow_mut(|slot| {
        let decompressor = match slot {
            Some(decompressor) => decompressor,
            None => slot.insert(Decompressor::new().map_err(|e| e.to_string())?),
        };
        let mut bytes = Vec::with_capacity(num_bytes);
        decompressor.decompress_to_buffer(compressed, &mut bytes).map_err(|e| format!("zstd: {e}"))?;
        match bytes.len() == num_bytes {
            true => Ok(bytes),
            false => Err(format!("{} bytes where {num_bytes} are due", bytes.len())),
        }
    })
}

/// The stored form of numbers `[place, field]`, field after field: equal ones lie beside each other.
pub(crate) fn encode_by_field<const N: usize>(places: &[[f64; N]], level: i32) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::with_capacity(8 * N * places.len());
    for field in 0..N {
        places.iter().for_each(|place| bytes.extend_from_slice(&place[field].to_le_bytes()));
    }
    encode_once(&bytes, level)
}

/// The numbers that [`encode_by_field`] stored, of `num_places` places; else what is wrong.
pub(crate) fn decode_by_field<const N: usize>(
    stored: &[u8],
    num_places: usize,
) -> Result<Vec<[f64; N]>, String> {
    let bytes = decode(stored, 8 * N * num_places)?;
    let (values, _) = bytes.as_chunks();
    let value = |at: usize| f64::from_le_bytes(values[at]);
    let place = |place: usize| std::array::from_fn(|field| value(field * num_places + place));
    Ok((0..num_places).map(place).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_damaged_or_oversized_chunk_is_an_error() {
        let bytes: Vec<u8> = (0..5000u32).map(|i| ((i * i) >> 7) as u8).collect();
        let stored = encode(&bytes, 1).unwrap();
        assert!(stored.len() <= largest_stored(bytes.len()));
        assert_eq!(decode(&stored, 5000).unwrap(), bytes);
        assert!(decode(&stored, 4999).is_err() && decode(&stored, 5001).is_err());
        for at in 0..stored.len() {
            let mut damaged = stored.clone();
            damaged[at] ^= 0x40;
            assert!(decode(&damaged, 5000).is_err(), "byte {at}");
        }
        assert!(decode(&[], 0).is_err());
        let bomb = encode(&vec![0; 1 << 24], 1).unwrap();
        assert!(decode(&bomb, 64).is_err());
    }
}
