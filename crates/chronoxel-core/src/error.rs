//! What can be wrong with the values that describe a volume.

use thiserror::Error;

/// An invalid grid, time axis, camera, transfer function or brick layout.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum CoreError {
    /// A value given by the caller cannot be used.
    #[error("{field} is {value}: {remedy}")]
    InvalidArgument {
        /// Which value it is, in the user's words.
        field: &'static str,
        /// The value as given.
        value: String,
        /// What would be right.
        remedy: &'static str,
    },
}

impl CoreError {
    /// An invalid-argument error from anything printable.
    pub fn invalid(field: &'static str, value: impl ToString, remedy: &'static str) -> Self {
        Self::InvalidArgument { field, value: value.to_string(), remedy }
    }
}
