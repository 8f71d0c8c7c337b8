//! What can go wrong while reading a source or encoding it.

use std::path::{Path, PathBuf};

use chronoxel_codec::CodecError;
use chronoxel_core::CoreError;
use chronoxel_store::StoreError;
use thiserror::Error;

/// A source that cannot be read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SourceError {
    /// The operating system refused.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What was tried: `open`, `read`, ….
        action: &'static str,
        /// Why.
        source: std::io::Error,
    },
    /// The file contradicts itself or its format.
    #[error("{}: {field} is {value}: {problem}", path.display())]
    Corrupt {
        /// The file.
        path: PathBuf,
        /// The field of the file, as its format names it.
        field: String,
        /// Its value, shortened.
        value: String,
        /// What is wrong with it, and what to do.
        problem: String,
    },
    /// The file is sound but uses something that is not read.
    #[error("{}: {field} is {value}, which is not supported: {remedy}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// The field of the file.
        field: String,
        /// Its value, shortened.
        value: String,
        /// What would be.
        remedy: String,
    },
    /// The caller asked for something that cannot be done.
    #[error("{argument} {value}: {remedy}")]
    InvalidArgument {
        /// The argument, in the user's words.
        argument: &'static str,
        /// Its value.
        value: String,
        /// What would be right.
        remedy: String,
    },
}

/// A series that cannot be encoded.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// The source cannot be read.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The store cannot be written.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A grid or brick layout that cannot be used.
    #[error(transparent)]
    Core(#[from] CoreError),
    /// The caller asked for something that cannot be done.
    #[error("{argument} {value}: {remedy}")]
    InvalidArgument {
        /// The argument, in the user's words.
        argument: &'static str,
        /// Its value.
        value: String,
        /// What would be right.
        remedy: String,
    },
    /// The output is already there.
    #[error("{}: already exists: use --overwrite to replace it{}", path.display(), if *is_unfinished { ", or --resume to continue it" } else { "" })]
    OutputExists {
        /// The output.
        path: PathBuf,
        /// Whether it is a store that a resume could continue.
        is_unfinished: bool,
    },
    /// The working set does not fit.
    #[error("--memory {given} bytes: this grid needs at least {needed} bytes ({} MiB{}): raise it, or use smaller bricks", needed.div_ceil(1 << 20), source_part(*source_bytes))]
    Memory {
        /// Bytes allowed.
        given: u64,
        /// Bytes needed at least.
        needed: u64,
        /// How many of them the source needs, besides the slices that it hands over.
        source_bytes: u64,
    },
    /// A mesh, or a block of its steps, does not fit.
    #[error("--memory {given} bytes: {what} needs {needed} bytes ({} MiB): raise it, or use --as bricks", needed.div_ceil(1 << 20))]
    CellMemory {
        /// Bytes allowed.
        given: u64,
        /// Bytes needed.
        needed: u64,
        /// For what.
        what: String,
    },
    /// A block of steps of a mesh that cannot be coded.
    #[error("variable {variable}, steps {start} to {}: {source}", start + num_steps - 1)]
    Block {
        /// The variable.
        variable: String,
        /// The first step.
        start: usize,
        /// Steps.
        num_steps: usize,
        /// Why.
        source: Box<CodecError>,
    },
    /// 16 bits cannot hold the error bound.
    #[error(
        "--max-error {max_error}: variable {variable}, step {step}, brick ({}, {}, {}): 16 bits leave an error of {error:e} and {bound:e} is allowed: raise it, or give a wider --range",
        brick[0], brick[1], brick[2]
    )]
    Bound {
        /// The variable.
        variable: String,
        /// The step.
        step: usize,
        /// The brick of level 0, along x, y, z.
        brick: [usize; 3],
        /// The bound, relative to the range.
        max_error: f64,
        /// The error found, in the variable's units.
        error: f64,
        /// The bound, in the variable's units.
        bound: f64,
    },
    /// A brick that no payload can hold.
    #[error("variable {variable}, step {step}, level {level}, brick ({}, {}, {}): {source}", brick[0], brick[1], brick[2])]
    Brick {
        /// The variable.
        variable: String,
        /// The step.
        step: usize,
        /// The level.
        level: u8,
        /// The brick, along x, y, z.
        brick: [usize; 3],
        /// Why.
        source: Box<CodecError>,
    },
    /// A variable of which no sample has a value.
    #[error(
        "variable {variable}: every sample of all {num_steps} steps is NaN, infinite or the fill value: leave it out, or check the fill value"
    )]
    NoData {
        /// The variable.
        variable: String,
        /// Steps of the series.
        num_steps: usize,
    },
    /// The scratch file, which holds what memory does not, cannot be written or read.
    #[error("scratch file in {}: {source}: free some space there, or raise --memory", folder.display())]
    Scratch {
        /// The folder of the store.
        folder: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// What the journal keeps of the time tree for a resume cannot be used.
    #[error("cannot resume: {name} in the journal of the store: {problem}: encode anew with --overwrite")]
    Carried {
        /// The file of the journal.
        name: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The store to resume was made otherwise.
    #[error("{}: cannot resume: {field} was {was} and is {is}: give the same source and options, or --overwrite", path.display())]
    ResumeDiffers {
        /// The store.
        path: PathBuf,
        /// What differs.
        field: String,
        /// In the store.
        was: String,
        /// Now.
        is: String,
    },
    /// Encoding ended early; what was finished is kept.
    #[error("{source}; {num_steps} finished steps are kept in {}: encode again with --resume to continue", path.display())]
    Interrupted {
        /// Where they are kept.
        path: PathBuf,
        /// How many.
        num_steps: usize,
        /// What happened.
        source: Box<EncodeError>,
    },
}

/// What the source needs of the memory, as a message may add it.
fn source_part(bytes: u64) -> String {
    if bytes == 0 {
        return String::new();
    }
    format!("; {bytes} of them for the source, less where its chunks or dimensions are smaller")
}

/// Longest piece of a file that a message repeats, in characters.
const MAX_QUOTED_CHARS: usize = 80;

impl SourceError {
    /// The operating system refused `action` on `path`.
    pub(crate) fn io(path: &Path, action: &'static str, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), action, source }
    }

    /// The file contradicts itself or its format.
    pub(crate) fn corrupt(
        path: &Path,
        field: impl Into<String>,
        value: impl ToString,
        problem: impl Into<String>,
    ) -> Self {
        Self::Corrupt {
            path: path.to_owned(),
            field: on_one_line(&field.into()),
            value: quoted(&value.to_string()),
            problem: on_one_line(&problem.into()),
        }
    }

    /// The file uses something that is not read.
    pub(crate) fn unsupported(
        path: &Path,
        field: impl Into<String>,
        value: impl ToString,
        remedy: impl Into<String>,
    ) -> Self {
        Self::Unsupported {
            path: path.to_owned(),
            field: on_one_line(&field.into()),
            value: quoted(&value.to_string()),
            remedy: on_one_line(&remedy.into()),
        }
    }

    /// The caller asked for something that cannot be done.
    pub(crate) fn argument(argument: &'static str, value: impl ToString, remedy: impl Into<String>) -> Self {
        Self::InvalidArgument {
            argument,
            value: quoted(&value.to_string()),
            remedy: on_one_line(&remedy.into()),
        }
    }

    /// What failed while bytes came through a [`std::io::Read`]: the operating system, or a decoder
    /// that found the bytes to be wrong.
    pub(crate) fn from_read(path: &Path, field: &str, source: std::io::Error) -> Self {
        if source.raw_os_error().is_some() {
            return Self::io(path, "read", source);
        }
        match source.downcast::<Self>() {
            Ok(inner) => inner,
            Err(other) => {
                Self::corrupt(path, field, other, "the data cannot be decoded; write the file again")
            }
        }
    }
}

/// Longest part of a message that is not a path, in characters.
const MAX_PART_CHARS: usize = 400;

/// Part of a message, which may repeat names from a file, without what would break its line.
fn on_one_line(text: &str) -> String {
    text.chars().take(MAX_PART_CHARS).map(|c| if c.is_control() { ' ' } else { c }).collect()
}

/// Text from a file as a message may show it: on one line, not too long, never empty.
fn quoted(text: &str) -> String {
    let trimmed = text.trim();
    if trimmed.is_empty() {
        return "empty".to_owned();
    }
    let mut shown: String =
        trimmed.chars().take(MAX_QUOTED_CHARS).map(|c| if c.is_control() { ' ' } else { c }).collect();
    if trimmed.chars().nth(MAX_QUOTED_CHARS).is_some() {
        shown.push('…');
    }
    shown
}
