//! Lists of tetrahedra while the tree is built: in memory where they are short, else in blocks of a nameless file.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use bytemuck::{Pod, Zeroable};

use super::overlap::Corners;
use crate::EncodeError;

/// A tetrahedron, by the numbers of its points.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Tetrahedron {
    /// Its corners.
    pub vertices: [u32; 4],
}

impl Tetrahedron {
    /// Where its corners lie.
    #[inline(always)]
    pub fn corners(&self, places: &[[f64; 3]]) -> Corners {
        self.vertices.map(|v| places[v as usize])
    }
}

/// Tetrahedra of a block.
pub const BLOCK: usize = 1 << 14;
const BLOCK_BYTES: u64 = (BLOCK * size_of::<Tetrahedron>()) as u64;

/// Some tetrahedra, in the order of the mesh.
#[derive(Debug)]
pub enum List {
    /// In memory.
    Memory(Vec<Tetrahedron>),
    /// In full blocks of the file, and a last one in memory.
    File {
        /// The blocks.
        blocks: Vec<u64>,
        /// What follows them.
        rest: Vec<Tetrahedron>,
    },
}

impl List {
    /// How many.
    pub fn num_tetrahedra(&self) -> usize {
        match self {
            Self::Memory(all) => all.len(),
            Self::File { blocks, rest } => blocks.len() * BLOCK + rest.len(),
        }
    }
}

/// Takes a block of a list; whether it wants the next.
pub type TakeBlock<'a> = dyn FnMut(&[Tetrahedron], &mut Pool) -> Result<bool, EncodeError> + 'a;

/// The file that lists share.
pub struct Pool {
    file: File,
    folder: PathBuf,
    free: Vec<u64>,
    num_blocks: u64,
}

impl Pool {
    /// In a folder.
    pub fn new(folder: &Path) -> Result<Self, EncodeError> {
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let file = tempfile::tempfile_in(folder)
            .map_err(|source| EncodeError::Scratch { folder: folder.to_owned(), source })?;
        Ok(Self { file, folder: folder.to_owned(), free: Vec::new(), num_blocks: 0 })
    }

    /// Appends to a list that may outgrow memory.
    pub fn append(&mut self, list: &mut List, more: &[Tetrahedron]) -> Result<(), EncodeError> {
        match list {
            List::Memory(all) => all.extend_from_slice(more),
            List::File { blocks, rest } => {
                rest.extend_from_slice(more);
                while rest.len() >= BLOCK {
                    let after = rest.split_off(BLOCK);
                    blocks.push(self.write(rest)?);
                    *rest = after;
                }
            }
        }
        Ok(())
    }

    fn write(&mut self, block: &[Tetrahedron]) -> Result<u64, EncodeError> {
        let at = self.free.pop().unwrap_or_else(|| {
            self.num_blocks += 1;
            self.num_blocks - 1
        });
        let written = self
            .file
            .seek(SeekFrom::Start(at * BLOCK_BYTES))
            .and_then(|_| self.file.write_all(bytemuck::cast_slice(block)));
        written.map_err(|source| self.failed(source))?;
        Ok(at)
    }

    /// Hands a list on, block by block, until one is enough.
    pub fn each(&mut self, list: &List, of_block: &mut TakeBlock<'_>) -> Result<(), EncodeError> {
        match list {
            List::Memory(all) => of_block(all, self).map(|_| ()),
            List::File { blocks, rest } => {
                let mut block = vec![Tetrahedron { vertices: [0; 4] }; BLOCK];
                for &at in blocks {
                    self.read(at, &mut block)?;
                    if !of_block(&block, self)? {
                        return Ok(());
                    }
                }
                of_block(rest, self).map(|_| ())
            }
        }
    }

    fn read(&mut self, at: u64, block: &mut [Tetrahedron]) -> Result<(), EncodeError> {
        let read = self
            .file
            .seek(SeekFrom::Start(at * BLOCK_BYTES))
            .and_then(|_| self.file.read_exact(bytemuck::cast_slice_mut(block)));
        read.map_err(|source| self.failed(source))
    }

    /// Brings a list to memory and makes room in the file.
    pub fn load(&mut self, list: List) -> Result<Vec<Tetrahedron>, EncodeError> {
        match list {
            List::Memory(all) => Ok(all),
            List::File { blocks, rest } => {
                let mut all = vec![Tetrahedron { vertices: [0; 4] }; blocks.len() * BLOCK];
                for (&at, block) in blocks.iter().zip(all.chunks_mut(BLOCK)) {
                    self.read(at, block)?;
                }
                all.extend_from_slice(&rest);
                self.free.extend(blocks);
                Ok(all)
            }
        }
    }

    /// Makes room in the file.
    pub fn forget(&mut self, list: List) {
        if let List::File { blocks, .. } = list {
            self.free.extend(blocks);
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
    fn lists_come_back_in_order_and_blocks_are_used_again() {
        let folder = tempfile::tempdir().unwrap();
        let mut pool = Pool::new(folder.path()).unwrap();
        let all: Vec<Tetrahedron> =
            (0..40_000).map(|i| Tetrahedron { vertices: [i, i + 1, i + 2, i + 3] }).collect();
        for _ in 0..3 {
            let mut list = List::File { blocks: Vec::new(), rest: Vec::new() };
            for part in all.chunks(7777) {
                pool.append(&mut list, part).unwrap();
            }
            assert_eq!(list.num_tetrahedra(), all.len());
            let mut seen = Vec::new();
            let mut take = |block: &[Tetrahedron], _: &mut Pool| {
                seen.extend_from_slice(block);
                Ok(true)
            };
            pool.each(&list, &mut take).unwrap();
            assert!(seen == all);
            assert!(pool.load(list).unwrap() == all);
        }
        assert_eq!(pool.num_blocks, 2);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "the file has no name");
    }
}
