//! What bricks were while their windows are open: in memory as far as it goes, the rest in a scratch file.
//!
//! Where a brick waits changes memory and speed, never what comes out.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::Mutex;

use super::real::Real;
use crate::EncodeError;

/// One step of a brick, waiting.
#[derive(Debug)]
pub enum Waiting<T> {
    /// All unmasked samples have the same bits and none is masked: `Some`; all are masked: `None`.
    Uniform(Option<T>),
    /// Samples of the full brick, masked ones NaN.
    Memory(Vec<T>),
    /// In the file, at this block.
    File(u64),
}

/// A pool of blocks of one brick each.
pub struct Scratch {
    /// Without a name in any folder, so that it is gone with the program, however that ends.
    file: Mutex<File>,
    folder: std::path::PathBuf,
    block_bytes: u64,
    free: Vec<u64>,
    num_blocks: u64,
    memory_left: u64,
}

impl Scratch {
    /// A pool whose file lies in `folder`, the one of the store being written.
    ///
    /// * `brick_bytes`: bytes of the largest brick
    /// * `memory_bytes`: what may be held in memory
    pub fn new(folder: &Path, brick_bytes: u64, memory_bytes: u64) -> Result<Self, EncodeError> {
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let failed = |source| EncodeError::Scratch { folder: folder.to_owned(), source };
        let file = tempfile::tempfile_in(folder).map_err(failed)?;
        Ok(Self {
            file: Mutex::new(file),
            folder: folder.to_owned(),
            block_bytes: brick_bytes,
            free: Vec::new(),
            num_blocks: 0,
            memory_left: memory_bytes,
        })
    }

    /// Puts a brick to wait.
    pub fn keep<T: Real>(&mut self, samples: Vec<T>) -> Result<Waiting<T>, EncodeError> {
        let bytes = size_of_val(samples.as_slice()) as u64;
        if bytes <= self.memory_left {
            self.memory_left -= bytes;
            return Ok(Waiting::Memory(samples));
        }
        let block = self.free.pop().unwrap_or_else(|| {
            self.num_blocks += 1;
            self.num_blocks - 1
        });
        let mut file = self.file.lock().expect("no one panics while holding the file");
        let written = file
            .seek(SeekFrom::Start(block * self.block_bytes))
            .and_then(|_| file.write_all(bytemuck::cast_slice(&samples)));
        drop(file);
        written.map_err(|source| self.failed(source))?;
        Ok(Waiting::File(block))
    }

    /// Reads a block of `len` samples.
    pub fn read<T: Real>(&self, block: u64, len: usize) -> Result<Vec<T>, EncodeError> {
        let mut samples = vec![T::MASKED; len];
        let mut file = self.file.lock().expect("no one panics while holding the file");
        let read = file
            .seek(SeekFrom::Start(block * self.block_bytes))
            .and_then(|_| file.read_exact(bytemuck::cast_slice_mut(&mut samples)));
        drop(file);
        read.map_err(|source| self.failed(source))?;
        Ok(samples)
    }

    /// Makes room: the brick is coded.
    pub fn forget<T: Real>(&mut self, waiting: &Waiting<T>) {
        match waiting {
            Waiting::Uniform(_) => {}
            Waiting::Memory(samples) => self.memory_left += size_of_val(samples.as_slice()) as u64,
            Waiting::File(block) => self.free.push(*block),
        }
    }

    fn failed(&self, source: std::io::Error) -> EncodeError {
        EncodeError::Scratch { folder: self.folder.clone(), source }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_does_not_fit_in_memory_comes_back_from_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let brick = |k: usize| -> Vec<f32> { (0..100).map(|i| (i * k) as f32).collect() };
        let mut scratch = Scratch::new(folder.path(), 400, 900).unwrap();
        let kept: Vec<Waiting<f32>> = (0..5).map(|k| scratch.keep(brick(k)).unwrap()).collect();
        let in_memory = kept.iter().filter(|w| matches!(w, Waiting::Memory(_))).count();
        assert_eq!(in_memory, 2);
        for (k, waiting) in kept.iter().enumerate() {
            match waiting {
                Waiting::Memory(samples) => assert_eq!(*samples, brick(k)),
                Waiting::File(block) => assert_eq!(scratch.read::<f32>(*block, 100).unwrap(), brick(k)),
                Waiting::Uniform(_) => panic!("was kept as it is"),
            }
        }
        // Blocks and memory are used again.
        kept.iter().for_each(|w| scratch.forget(w));
        let again: Vec<Waiting<f32>> = (0..5).map(|k| scratch.keep(brick(k)).unwrap()).collect();
        assert_eq!(again.iter().filter(|w| matches!(w, Waiting::Memory(_))).count(), 2);
        assert_eq!(scratch.num_blocks, 3);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "the file has no name");
    }
}
