//! What can keep the GPU from making a picture.

use chronoxel_codec::CodecError;
use thiserror::Error;

use crate::RenderError;

/// Why nothing was drawn on the GPU.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum GpuError {
    /// No adapter, or none of the name asked for.
    #[error(
        "no GPU adapter {wanted}; found: {found}; install a Vulkan driver, name another, or draw on the CPU"
    )]
    NoAdapter {
        /// What was asked for.
        wanted: String,
        /// The adapters that there are.
        found: String,
    },
    /// The adapter has less than the renderer is made for.
    #[error(
        "{adapter} has a {limit} of {found}, but {needed} is needed: draw on another adapter or on the CPU"
    )]
    LimitTooSmall {
        /// Which adapter.
        adapter: String,
        /// The limit.
        limit: &'static str,
        /// What it has.
        found: u64,
        /// What is needed.
        needed: u64,
    },
    /// The adapter gave no device, or the device did not take a shader.
    #[error("{adapter} cannot be used: {reason}; update its driver, name another, or draw on the CPU")]
    Setup {
        /// Which adapter.
        adapter: String,
        /// The driver's words, on one line.
        reason: String,
    },
    /// The device is gone.
    #[error("{adapter} was lost while drawing: {reason}; draw again on a new device or on the CPU")]
    Lost {
        /// Which adapter.
        adapter: String,
        /// The driver's words, on one line.
        reason: String,
    },
    /// The budget holds less than a single brick needs.
    #[error(
        "GPU memory of {given} bytes is too small for {what}, which takes {needed} bytes: allow at least {} MiB",
        least_mib(*least)
    )]
    MemoryTooSmall {
        /// The budget.
        given: u64,
        /// What does not fit.
        what: &'static str,
        /// Its bytes.
        needed: u64,
        /// A budget that would do.
        least: u64,
    },
    /// The scene or the draw list cannot be used.
    #[error(transparent)]
    Scene(#[from] RenderError),
    /// A payload cannot be decoded.
    #[error(transparent)]
    Payload(#[from] CodecError),
}

fn least_mib(least: u64) -> u64 {
    least.div_ceil(1 << 20)
}

/// A message of a driver on one line.
pub(super) fn one_line(message: &str) -> String {
    message.split_whitespace().collect::<Vec<_>>().join(" ")
}
