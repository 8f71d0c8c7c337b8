//! What every source looks like once opened: a grid, a time axis, variables, and steps to read.

use chronoxel_core::{SampleType, Samples, TimeAxis, UniformGrid};

use crate::SourceError;

/// One variable of a series.
#[derive(Debug, Clone, PartialEq)]
pub struct Variable {
    /// Its name in the source, or the file's stem where the format names none.
    pub name: String,
    /// Units as the source says them; empty where it does not.
    pub units: String,
    /// Type of the samples in the source.
    pub sample_type: SampleType,
    /// The value that means "no data", where the source declares one. NaN always means it.
    pub fill_value: Option<f64>,
}

/// A time-varying volume as it lies in a source.
///
/// Steps are opened in increasing order by everything in Chronoxel; going back is allowed, and may
/// be slow (a simulation starts over).
pub trait TimeSeries: Send {
    /// The grid of every step.
    fn grid(&self) -> &UniformGrid;

    /// Times of the steps.
    fn times(&self) -> &TimeAxis;

    /// The variables, at least one.
    fn variables(&self) -> &[Variable];

    /// The most bytes held between and during reads, besides the slices handed over; small buffers do not count.
    fn working_bytes(&self) -> u64 {
        0
    }

    /// Starts to read a step of a variable from its first slice.
    ///
    /// # Errors
    /// [`SourceError`] if the file cannot be read, or is not what its header says.
    ///
    /// # Panics
    /// If `variable` or `step` is out of range.
    fn open_step<'a>(
        &'a mut self,
        variable: usize,
        step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError>;
}

/// One step of one variable, read front to back.
pub trait StepReader: Send {
    /// The next `num_slices` slices of constant z, `[z, y, x]`; never asked for more than are left.
    ///
    /// The kind of [`Samples`] follows from the variable's [`SampleType::fits_f32`].
    ///
    /// # Errors
    /// [`SourceError`] if the file is shorter than its header says, or an integer exceeds 53 bits.
    fn read_slices(&mut self, num_slices: usize) -> Result<Samples, SourceError>;
}
