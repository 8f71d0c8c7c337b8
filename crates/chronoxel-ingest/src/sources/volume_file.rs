//! What one file of a source offers, whatever its format, and checks that all formats share.

use std::fs::File;
use std::io::{Seek, SeekFrom};
use std::path::{Path, PathBuf};

use chronoxel_core::UniformGrid;

use crate::{SourceError, StepReader, Variable};

/// More time steps than any series has; a header with more is wrong.
const MAX_STEPS: usize = 1 << 24;

/// The most that deflate can expand its input, rounded up.
pub(crate) const MAX_DEFLATE_RATIO: u64 = 1040;

/// What the header of one file says; `G` is what it says about the grid.
#[derive(Debug, Clone)]
pub(crate) struct FileHeader<G = UniformGrid> {
    pub path: PathBuf,
    pub grid: G,
    /// A name is empty where the format names none.
    pub variables: Vec<Variable>,
    pub num_steps: usize,
    pub times: FileTimes,
    /// Empty where the file does not say.
    pub time_units: String,
}

/// What a file says about the times of its steps.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum FileTimes {
    /// Nothing.
    Unknown,
    /// The number of its one step in a longer run; it counts where the numbers increase from file to file.
    StepNumber(f64),
    /// One time per step.
    Known(Vec<f64>),
}

/// One file (or one Zarr group) with at least one step.
pub(crate) trait VolumeFile: Send {
    /// What its header says.
    fn header(&self) -> &FileHeader;

    /// As [`crate::TimeSeries::working_bytes`].
    fn working_bytes(&self) -> u64 {
        0
    }

    /// Drops what is kept between reads, before another file is read.
    fn forget(&mut self) {}

    /// Starts to read a step of a variable; both are in range.
    fn open_step<'a>(
        &'a mut self,
        variable: usize,
        step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError>;
}

/// A grid from the numbers of a file.
pub(crate) fn checked_grid(
    path: &Path,
    dims: [usize; 3],
    origin: [f64; 3],
    spacing: [f64; 3],
) -> Result<UniformGrid, SourceError> {
    UniformGrid::new(dims, origin, spacing).map_err(|error| match error {
        chronoxel_core::CoreError::InvalidArgument { field, value, remedy } => {
            SourceError::corrupt(path, field, value, remedy)
        }
        other => SourceError::corrupt(path, "grid", other, "give another grid"),
    })
}

/// A number of steps from a file.
pub(crate) fn checked_steps(path: &Path, field: &str, num_steps: usize) -> Result<usize, SourceError> {
    match num_steps {
        0 => Err(SourceError::corrupt(path, field, 0, "a series needs at least one time step")),
        n if n > MAX_STEPS => {
            Err(SourceError::unsupported(path, field, n, format!("at most {MAX_STEPS} time steps are")))
        }
        n => Ok(n),
    }
}

/// The product of sizes from a file, where it can be a number of bytes in a file.
pub(crate) fn checked_product(
    path: &Path,
    field: &str,
    factors: impl IntoIterator<Item = u64>,
) -> Result<u64, SourceError> {
    let product = factors.into_iter().try_fold(1u64, u64::checked_mul).filter(|&p| p <= i64::MAX as u64);
    product.ok_or_else(|| {
        SourceError::corrupt(path, field, "beyond 2^63", "no file is as long; check the sizes")
    })
}

/// The text of dimensions in messages.
pub(crate) fn dims_text(dims: [usize; 3]) -> String {
    format!("{} x {} x {}", dims[0], dims[1], dims[2])
}

/// Opens a file for reading and gives its length; folders and the like are refused.
pub(crate) fn open_regular(path: &Path) -> Result<(File, u64), SourceError> {
    // Asked before opening: opening a pipe would wait for a writer.
    let metadata = std::fs::metadata(path).map_err(|e| SourceError::io(path, "open", e))?;
    if !metadata.is_file() {
        return Err(SourceError::unsupported(path, "path", "not a regular file", "give a file"));
    }
    let file = File::open(path).map_err(|e| SourceError::io(path, "open", e))?;
    if metadata.len() == 0 {
        return Err(SourceError::corrupt(path, "length", "0 bytes", "the file is empty"));
    }
    Ok((file, metadata.len()))
}

/// Opens a file at a position.
pub(crate) fn open_at(path: &Path, position: u64) -> Result<File, SourceError> {
    let mut file = File::open(path).map_err(|e| SourceError::io(path, "open", e))?;
    file.seek(SeekFrom::Start(position)).map_err(|e| SourceError::io(path, "seek in", e))?;
    Ok(file)
}
