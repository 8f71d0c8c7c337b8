//! The sampling map: for every brick its tetrahedra, and for every run of its samples which of them it lies in.
//!
//! Runs are shorter than a number per sample wherever a tetrahedron holds more than two samples of a row, and are what a step is
//! computed along. The map lies in memory as far as it may, the rest in a nameless file.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use super::apply::FIELD_BYTES;
use super::records::Tetrahedron;
use crate::EncodeError;

/// In place of a tetrahedron's number: the samples lie in none.
pub const NO_TETRAHEDRON: u32 = 0xff_ffff;
/// In place of a tetrahedron's number: the samples come from elsewhere.
pub const OTHERWISE: u32 = 0xff_fffe;

/// The map of one brick.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BrickMap {
    /// Those that a sample lies in, in the order in which the runs come to them.
    pub tetrahedra: Vec<Tetrahedron>,
    /// Along rows of the full brick: the number of a tetrahedron times 256, plus how many samples.
    pub runs: Vec<u32>,
}

impl BrickMap {
    /// Samples that lie in a tetrahedron.
    pub fn num_covered(&self) -> u64 {
        let covered = self.runs.iter().filter(|run| **run >> 8 < OTHERWISE);
        covered.map(|run| u64::from(run & 255)).sum()
    }

    fn num_bytes(&self) -> u64 {
        (size_of_val(self.tetrahedra.as_slice()) + size_of_val(self.runs.as_slice())) as u64
    }
}

/// Where the map of a brick lies.
enum Place {
    Memory(BrickMap),
    File { offset: u64, num_tetrahedra: usize, num_runs: usize },
}

/// The maps of many bricks, by number.
pub struct MapStore {
    file: Mutex<File>,
    folder: PathBuf,
    places: Vec<Place>,
    memory_left: u64,
    end: u64,
    num_bytes: u64,
    memory_bytes: u64,
    largest_bytes: u64,
}

impl MapStore {
    /// Without a map yet.
    ///
    /// * `folder`: where the file may lie
    /// * `memory_bytes`: what may be held in memory
    pub fn new(folder: &Path, memory_bytes: u64) -> Result<Self, EncodeError> {
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let file = tempfile::tempfile_in(folder)
            .map_err(|source| EncodeError::Scratch { folder: folder.to_owned(), source })?;
        Ok(Self {
            file: Mutex::new(file),
            folder: folder.to_owned(),
            places: Vec::new(),
            memory_left: memory_bytes,
            end: 0,
            num_bytes: 0,
            memory_bytes: 0,
            largest_bytes: 0,
        })
    }

    /// Where the file lies.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Bytes of all maps.
    pub fn num_bytes(&self) -> u64 {
        self.num_bytes
    }

    /// Bytes of those that lie in memory.
    pub fn memory_bytes(&self) -> u64 {
        self.memory_bytes
    }

    /// Bytes of the largest, with the fields of its tetrahedra at a step.
    pub fn largest_bytes(&self) -> u64 {
        self.largest_bytes
    }

    /// Moves all maps to the file.
    pub fn spill(&mut self) -> Result<(), EncodeError> {
        self.memory_left = 0;
        self.memory_bytes = 0;
        for number in 0..self.places.len() {
            let empty = Place::File { offset: 0, num_tetrahedra: 0, num_runs: 0 };
            self.places[number] = match std::mem::replace(&mut self.places[number], empty) {
                Place::Memory(map) => self.write(&map)?,
                in_file => in_file,
            };
        }
        Ok(())
    }

    fn write(&mut self, map: &BrickMap) -> Result<Place, EncodeError> {
        let file = self.file.get_mut().expect("no one panics while holding the file");
        let written = file
            .seek(SeekFrom::Start(self.end))
            .and_then(|_| file.write_all(bytemuck::cast_slice(&map.tetrahedra)))
            .and_then(|()| file.write_all(bytemuck::cast_slice(&map.runs)));
        written.map_err(|source| self.failed(source))?;
        let offset = self.end;
        self.end += map.num_bytes();
        Ok(Place::File { offset, num_tetrahedra: map.tetrahedra.len(), num_runs: map.runs.len() })
    }

    /// Adds a map; the first has number 0.
    pub fn push(&mut self, map: BrickMap) -> Result<usize, EncodeError> {
        let bytes = map.num_bytes();
        self.num_bytes += bytes;
        self.largest_bytes = self.largest_bytes.max(bytes + FIELD_BYTES * map.tetrahedra.len() as u64);
        let place = match bytes <= self.memory_left {
            true => {
                self.memory_left -= bytes;
                self.memory_bytes += bytes;
                Place::Memory(map)
            }
            false => self.write(&map)?,
        };
        self.places.push(place);
        Ok(self.places.len() - 1)
    }

    /// Hands a map on.
    pub fn with<R>(&self, number: usize, of_map: impl FnOnce(&BrickMap) -> R) -> Result<R, EncodeError> {
        match &self.places[number] {
            Place::Memory(map) => Ok(of_map(map)),
            &Place::File { offset, num_tetrahedra, num_runs } => {
                let mut tetrahedra = vec![Tetrahedron { vertices: [0; 4] }; num_tetrahedra];
                let mut runs = vec![0; num_runs];
                let mut file = self.file.lock().expect("no one panics while holding the file");
                let read = file
                    .seek(SeekFrom::Start(offset))
                    .and_then(|_| file.read_exact(bytemuck::cast_slice_mut(&mut tetrahedra)))
                    .and_then(|()| file.read_exact(bytemuck::cast_slice_mut(&mut runs)));
                drop(file);
                read.map_err(|source| self.failed(source))?;
                Ok(of_map(&BrickMap { tetrahedra, runs }))
            }
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
    fn maps_come_back_from_memory_and_from_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let map = |k: u32| BrickMap {
            tetrahedra: (0..k).map(|i| Tetrahedron { vertices: [i, i + k, 7, k] }).collect(),
            runs: (0..10 * k).map(|i| i << 8 | 3).collect(),
        };
        let mut store = MapStore::new(folder.path(), 200).unwrap();
        for k in 0..6 {
            assert_eq!(store.push(map(k)).unwrap(), k as usize);
        }
        assert!(matches!(store.places[1], Place::Memory(_)) && matches!(store.places[5], Place::File { .. }));
        for k in [5, 0, 3, 1, 4, 2] {
            assert!(store.with(k as usize, |found| *found == map(k)).unwrap());
        }
        assert_eq!(store.num_bytes(), 15 * 56);
        store.spill().unwrap();
        assert_eq!(store.memory_bytes(), 0);
        assert!((0..6).all(|k| store.with(k as usize, |found| *found == map(k)).unwrap()));
    }
}
