//! What can go wrong while reading a source or encoding it.

use std::path::PathBuf;

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
