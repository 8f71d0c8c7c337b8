//! Where the finest bricks wait, as runs of steps, for the runs that they will be merged with.
//!
//! Of each level of the time tree one run waits at most, and every brick has its own place in the files: bricks are written
//! and read in parallel. Short runs are in memory where it suffices, else in a nameless file, gone with the program. Long ones are
//! what a resume goes on from, and are in files that the journal keeps, everything under a checksum.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};

use chronoxel_core::TimeNode;
use chronoxel_store::StoreWriter;

use super::super::real::Real;
use super::blocks::{read_at, read_samples, write_at, write_samples};
use super::run::{RUN_BYTES, Run};
use crate::EncodeError;

/// Time level from which on runs are kept for a resume.
pub const KEPT_FROM: u8 = 3;

/// Short runs of a brick that wait, by time level.
pub struct ShortRuns<T> {
    runs: [Option<Run>; KEPT_FROM as usize],
    /// Where they wait in memory: buffers that change places with those that threads use.
    samples: [Vec<T>; KEPT_FROM as usize],
}

impl<T> Default for ShortRuns<T> {
    fn default() -> Self {
        Self { runs: Default::default(), samples: Default::default() }
    }
}

/// The files of one variable.
pub struct Carried {
    variable: usize,
    num_nodes: u64,
    /// Bytes of the means and deviations of a whole brick.
    block_bytes: u64,
    /// `None` where short runs wait in memory.
    short: Option<File>,
    /// By time level: the run that waits.
    kept: BTreeMap<u8, (TimeNode, File)>,
    folder: PathBuf,
}

impl Carried {
    /// Of which nothing waits yet.
    ///
    /// * `in_memory`: whether short runs wait there
    pub fn new(
        variable: usize,
        num_nodes: usize,
        block_bytes: u64,
        folder: &Path,
        in_memory: bool,
    ) -> Result<Self, EncodeError> {
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let failed = |source| EncodeError::Scratch { folder: folder.to_owned(), source };
        Ok(Self {
            variable,
            num_nodes: num_nodes as u64,
            block_bytes,
            short: (!in_memory).then(|| tempfile::tempfile_in(folder).map_err(failed)).transpose()?,
            kept: BTreeMap::new(),
            folder: folder.to_owned(),
        })
    }

    fn name(&self, at: TimeNode) -> String {
        format!("moments-{}-{}-{}", self.variable, at.level, at.index)
    }

    /// Opens what waits before step `first`, a multiple of 8, to go on from there.
    pub fn reopen(&mut self, first: u32, writer: &StoreWriter) -> Result<(), EncodeError> {
        for level in (KEPT_FROM..32).filter(|level| first >> level & 1 != 0) {
            let at = TimeNode { level, index: (first >> level) - 1 };
            let name = self.name(at);
            let Some(file) = writer.kept_file(&name)? else {
                return Err(EncodeError::Carried { name, problem: "it is missing".into() });
            };
            self.kept.insert(level, (at, file));
        }
        Ok(())
    }

    /// Makes room for a run of all bricks.
    pub fn prepare(&mut self, at: TimeNode, writer: &mut StoreWriter) -> Result<(), EncodeError> {
        if at.level >= KEPT_FROM {
            self.kept.insert(at.level, (at, writer.keep_file(&self.name(at))?));
        }
        Ok(())
    }

    /// Forgets a long run: it has been merged.
    pub fn forget(&mut self, at: TimeNode, writer: &mut StoreWriter) {
        // No one holds the file open any more when it is removed.
        if self.kept.remove(&at.level).is_some() {
            writer.drop_file(&self.name(at));
        }
    }

    fn kept(&self, at: TimeNode) -> &File {
        let (held, file) = self.kept.get(&at.level).expect("opened before the step");
        assert_eq!(*held, at, "one run of a level waits at a time");
        file
    }

    fn failed(&self) -> impl Fn(std::io::Error) -> EncodeError {
        |source| EncodeError::Scratch { folder: self.folder.clone(), source }
    }

    fn offset(&self, at: TimeNode, rank: usize) -> u64 {
        let rank = rank as u64;
        match at.level < KEPT_FROM {
            true => (u64::from(at.level) * self.num_nodes + rank) * self.block_bytes,
            false => self.num_nodes * RUN_BYTES as u64 + rank * self.block_bytes,
        }
    }

    /// Lets a brick wait.
    ///
    /// * `samples`: what it holds of them is the first `len`; where it waits in memory they change places
    pub fn store<T: Real>(
        &self,
        at: TimeNode,
        rank: usize,
        run: Run,
        (samples, len): (&mut Vec<T>, usize),
        short: &mut ShortRuns<T>,
    ) -> Result<(), EncodeError> {
        let offset = self.offset(at, rank);
        if at.level < KEPT_FROM {
            let level = usize::from(at.level);
            short.runs[level] = Some(run);
            return match &self.short {
                Some(file) => write_samples(file, &samples[..len], offset).map_err(self.failed()),
                None if len > 0 => {
                    std::mem::swap(samples, &mut short.samples[level]);
                    Ok(())
                }
                None => Ok(()),
            };
        }
        let file = self.kept(at);
        let samples = &samples[..len];
        let bytes = run.to_bytes(crc32c::crc32c(bytemuck::cast_slice(samples)));
        write_at(file, &bytes, (rank * RUN_BYTES) as u64)
            .and_then(|()| write_samples(file, samples, offset))
            .map_err(self.failed())
    }

    /// A brick that waits, without its samples; and their checksum, where there is one.
    pub fn run<T>(
        &self,
        at: TimeNode,
        rank: usize,
        short: &mut ShortRuns<T>,
    ) -> Result<(Run, Option<u32>), EncodeError> {
        if at.level < KEPT_FROM {
            let run = short.runs[usize::from(at.level)].take().expect("every brick waits for its other half");
            return Ok((run, None));
        }
        let mut bytes = [0; RUN_BYTES];
        read_at(self.kept(at), &mut bytes, (rank * RUN_BYTES) as u64).map_err(self.unreadable(at))?;
        match Run::from_bytes(&bytes) {
            Some((run, crc)) => Ok((run, Some(crc))),
            None => Err(self.damaged(at, format!("the checksum of brick {rank} is wrong"))),
        }
    }

    /// The first `len` of its samples, more than none.
    ///
    /// * `samples`: as long as the means and deviations of the brick
    pub fn load<T: Real>(
        &self,
        at: TimeNode,
        rank: usize,
        crc: Option<u32>,
        (samples, len): (&mut Vec<T>, usize),
        short: &mut ShortRuns<T>,
    ) -> Result<(), EncodeError> {
        let offset = self.offset(at, rank);
        let Some(crc) = crc else {
            match &self.short {
                Some(file) => read_samples(file, &mut samples[..len], offset).map_err(self.failed())?,
                None => std::mem::swap(samples, &mut short.samples[usize::from(at.level)]),
            }
            return Ok(());
        };
        let samples = &mut samples[..len];
        read_samples(self.kept(at), samples, offset).map_err(self.unreadable(at))?;
        match crc32c::crc32c(bytemuck::cast_slice(samples)) == crc {
            true => Ok(()),
            false => Err(self.damaged(at, format!("the checksum of the samples of brick {rank} is wrong"))),
        }
    }

    fn unreadable(&self, at: TimeNode) -> impl Fn(std::io::Error) -> EncodeError {
        move |source| self.damaged(at, format!("it cannot be read: {source}"))
    }

    fn damaged(&self, at: TimeNode, problem: String) -> EncodeError {
        EncodeError::Carried { name: self.name(at), problem }
    }
}
