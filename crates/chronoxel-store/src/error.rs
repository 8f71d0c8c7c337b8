//! What can go wrong with a store.

use std::path::{Path, PathBuf};

use thiserror::Error;

/// A store that cannot be written, opened or read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum StoreError {
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
    /// A file of the store contradicts itself, its checksum or the header.
    #[error("{}: {field} is {value}: {problem}", path.display())]
    Corrupt {
        /// The file.
        path: PathBuf,
        /// What is wrong in it.
        field: String,
        /// Its value, shortened.
        value: String,
        /// What it should be, or what to do.
        problem: String,
    },
    /// The bytes of one brick are damaged.
    #[error(
        "{}: {variable}, level {level}, brick ({}, {}, {}), step {step}: {problem}",
        path.display(), brick[0], brick[1], brick[2]
    )]
    CorruptBrick {
        /// The file.
        path: PathBuf,
        /// The variable.
        variable: String,
        /// The level.
        level: u8,
        /// The brick whose place in the arrays the bytes are stored at: x, y, z.
        brick: [u32; 3],
        /// The step asked for, or the first step of the span that uses the bytes.
        step: u32,
        /// What is wrong.
        problem: String,
    },
    /// The store is sound but of a kind that this version does not read.
    #[error("{}: {field} is {value}, which is not supported: {remedy}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// The field of the header.
        field: &'static str,
        /// Its value.
        value: String,
        /// What would be.
        remedy: &'static str,
    },
    /// The caller asked for something that cannot be done.
    #[error("{argument} is {value}: {remedy}")]
    InvalidArgument {
        /// The argument, in the user's words.
        argument: &'static str,
        /// Its value.
        value: String,
        /// What would be right.
        remedy: String,
    },
}

impl StoreError {
    pub(crate) fn io(path: &Path, action: &'static str) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { path, action, source }
    }

    pub(crate) fn corrupt(
        path: &Path,
        field: impl Into<String>,
        value: impl ToString,
        problem: impl Into<String>,
    ) -> Self {
        let mut value: String = value.to_string().chars().take(120).collect();
        value.retain(|c| !c.is_control());
        Self::Corrupt { path: path.to_owned(), field: field.into(), value, problem: problem.into() }
    }

    /// What went wrong, for a message that names the file itself.
    pub(crate) fn without_path(&self) -> String {
        match self {
            Self::Io { action, source, .. } => format!("cannot {action}: {source}"),
            Self::Corrupt { field, value, problem, .. } => format!("{field} is {value}: {problem}"),
            other => other.to_string(),
        }
    }

    pub(crate) fn invalid(argument: &'static str, value: impl ToString, remedy: impl Into<String>) -> Self {
        Self::InvalidArgument { argument, value: value.to_string(), remedy: remedy.into() }
    }
}
