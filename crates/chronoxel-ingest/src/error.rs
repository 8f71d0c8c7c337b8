//! What can go wrong while reading a source or encoding it.

use std::path::{Path, PathBuf};

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
            field: field.into(),
            value: quoted(&value.to_string()),
            problem: problem.into(),
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
            field: field.into(),
            value: quoted(&value.to_string()),
            remedy: remedy.into(),
        }
    }

    /// The caller asked for something that cannot be done.
    pub(crate) fn argument(argument: &'static str, value: impl ToString, remedy: impl Into<String>) -> Self {
        Self::InvalidArgument { argument, value: quoted(&value.to_string()), remedy: remedy.into() }
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
