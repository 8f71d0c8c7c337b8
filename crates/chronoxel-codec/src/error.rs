//! What can be wrong with a payload.

use thiserror::Error;

/// A payload that cannot be decoded, or samples that cannot be coded.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum CodecError {
    /// Bytes or tables that contradict the format.
    #[error("{field} is {value}: {problem}")]
    Corrupt {
        /// Which part of the payload.
        field: &'static str,
        /// Its value.
        value: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The caller asked for something that cannot be done.
    #[error("{argument} is {value}: {remedy}")]
    InvalidArgument {
        /// Which argument.
        argument: &'static str,
        /// Its value.
        value: String,
        /// What would be right.
        remedy: &'static str,
    },
}

impl CodecError {
    pub(crate) fn corrupt(field: &'static str, value: impl ToString, problem: impl Into<String>) -> Self {
        Self::Corrupt { field, value: value.to_string(), problem: problem.into() }
    }

    pub(crate) fn invalid(argument: &'static str, value: impl ToString, remedy: &'static str) -> Self {
        Self::InvalidArgument { argument, value: value.to_string(), remedy }
    }
}
