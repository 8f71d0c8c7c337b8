//! Files of a block per brick, which threads read and write at the same time, each at its own places.

use std::fs::File;
use std::io;

use super::super::real::Real;

/// Reads samples at a place of a file.
pub fn read_samples<T: Real>(file: &File, samples: &mut [T], offset: u64) -> io::Result<()> {
    read_at(file, bytemuck::cast_slice_mut(samples), offset)
}

/// Writes samples at a place of a file.
pub fn write_samples<T: Real>(file: &File, samples: &[T], offset: u64) -> io::Result<()> {
    write_at(file, bytemuck::cast_slice(samples), offset)
}

/// Fills `bytes` from a place of a file.
#[cfg(unix)]
pub fn read_at(file: &File, bytes: &mut [u8], offset: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, bytes, offset)
}

/// Writes `bytes` at a place of a file.
#[cfg(unix)]
pub fn write_at(file: &File, bytes: &[u8], offset: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::write_all_at(file, bytes, offset)
}

/// Fills `bytes` from a place of a file.
#[cfg(windows)]
pub fn read_at(file: &File, mut bytes: &mut [u8], mut offset: u64) -> io::Result<()> {
    while !bytes.is_empty() {
        let num = std::os::windows::fs::FileExt::seek_read(file, bytes, offset)?;
        if num == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        bytes = &mut bytes[num..];
        offset += num as u64;
    }
    Ok(())
}

/// Writes `bytes` at a place of a file.
#[cfg(windows)]
pub fn write_at(file: &File, mut bytes: &[u8], mut offset: u64) -> io::Result<()> {
    while !bytes.is_empty() {
        let num = std::os::windows::fs::FileExt::seek_write(file, bytes, offset)?;
        bytes = &bytes[num..];
        offset += num as u64;
    }
    Ok(())
}
