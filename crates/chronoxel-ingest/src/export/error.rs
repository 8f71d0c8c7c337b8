//! What can go wrong while decoded steps are written for other programs.

use std::path::{Path, PathBuf};

use thiserror::Error;

/// An export that cannot be written.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ExportError {
    /// The operating system refused.
    #[error("{}: cannot {action}: {source}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What was tried: `create`, `write`, ….
        action: &'static str,
        /// Why.
        source: std::io::Error,
    },
    /// The format cannot hold what is exported.
    #[error("{}: {field} is {value}: {remedy}", path.display())]
    Unsupported {
        /// The output.
        path: PathBuf,
        /// What does not fit.
        field: &'static str,
        /// Its value.
        value: String,
        /// What would.
        remedy: String,
    },
    /// A sample is missing, and the type written has no value for that.
    #[error("{}: sample {sample} of step {step} is missing, and {sample_type} has no value for that: export f32 or f64, or give a fill value", path.display())]
    Missing {
        /// The output.
        path: PathBuf,
        /// Number of the sample, x fastest.
        sample: usize,
        /// Number of the step within the export.
        step: usize,
        /// The type written.
        sample_type: chronoxel_core::SampleType,
    },
    /// The output is a folder that is there already.
    #[error("{}: already exists: remove it or choose another name", path.display())]
    Exists {
        /// The folder.
        path: PathBuf,
    },
}

impl ExportError {
    pub(super) fn io(path: &Path, action: &'static str, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), action, source }
    }
}
