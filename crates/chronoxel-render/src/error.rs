//! What can keep a picture from being made.

use chronoxel_core::CoreError;
use thiserror::Error;

/// Why nothing was rendered.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum RenderError {
    /// A value of the scene cannot be used.
    #[error("{field} is {value}: {remedy}")]
    InvalidArgument {
        /// Which value it is, in the user's words.
        field: &'static str,
        /// The value as given.
        value: String,
        /// What would be right.
        remedy: &'static str,
    },
    /// The grid has no cells.
    #[error(
        "the grid's dimensions are {} x {} x {}: a volume needs at least 2 samples along every axis to be drawn",
        dims[0], dims[1], dims[2]
    )]
    FlatGrid {
        /// Samples along x, y, z.
        dims: [usize; 3],
    },
    /// The camera, the size or the lighting cannot be used.
    #[error(transparent)]
    Scene(#[from] CoreError),
}

impl RenderError {
    /// An invalid-argument error from anything printable.
    pub(crate) fn invalid(field: &'static str, value: impl ToString, remedy: &'static str) -> Self {
        Self::InvalidArgument { field, value: value.to_string(), remedy }
    }
}
