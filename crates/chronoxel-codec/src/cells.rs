//! Values at the points of a mesh through time (bernardon2006, section 3.1): blocks of 64 steps, each point by its mean,
//! a difference vector of 8 means, and a difference vector of 64 values, the two from tables that all points share.
//!
//! In the form of every payload, that is three stages: the mean is affine, with 16 bits; of the 8 means the row of a step
//! is `(step - start) >> 3`; of the 64 values it is the step itself. Decoding is the sum of three table look-ups.
//!
//! A stage codes what the stages before it leave, as they are decoded, so that it makes up for some of their error. Tables
//! are trained by splitting the cell of largest error across its main axis and then by Lloyd's iteration, as in Schneider and
//! Westermann 2003. Points are taken in parts of a fixed number, whose sums are added in order, so that [`Workers`] may do them at once
//! without changing a byte.

mod block;
mod train;

use chronoxel_core::BitMask;

use crate::decode::{Entries as Meaning, rows_at};
use crate::{CodecError, Indices, Payload, Stage, Workers};

pub use train::PART_POINTS;

/// Steps of a block.
pub const BLOCK_STEPS: usize = 64;
/// The most entries of a table that an error bound raises them to.
const MOST_ENTRIES: usize = 1024;

/// How values are coded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellCodecOptions {
    /// Entries of each of the two tables: 2 to 1024; above 256, indices have 16 bits. There are never more than points.
    pub entries: usize,
    /// The most by which a decoded value may differ, in data units, not negative; none holds without it.
    pub max_error: Option<f64>,
}

impl Default for CellCodecOptions {
    fn default() -> Self {
        Self { entries: 256, max_error: None }
    }
}

/// Some steps of a variable on a mesh, coded.
#[derive(Debug, Clone, PartialEq)]
pub struct CellSpan {
    /// The first of its steps, counted from the first that was coded: a multiple of its window.
    pub start: usize,
    /// A power of two, at most [`BLOCK_STEPS`].
    pub window: usize,
    /// Its steps: as many as its window, fewer only where the series ends.
    pub num_steps: usize,
    /// One index per point and stage; 0 for points without a value.
    pub payload: Payload,
    /// Points without a value, at all of its steps; absent where every point has one.
    pub missing: Option<BitMask>,
}

impl CellSpan {
    /// Bytes of its stages.
    pub fn num_bytes(&self) -> usize {
        let bytes = |stage: &Stage| stage.class().num_point_bytes(stage.indices.len());
        self.payload.stages.iter().map(bytes).sum()
    }

    /// Writes the values of one of its steps; what it writes for points without a value means nothing.
    ///
    /// # Errors
    /// As [`decode_points`].
    pub fn decode(&self, step: usize, values: &mut [f32]) -> Result<(), CodecError> {
        decode_points(&self.payload, step.wrapping_sub(self.start) as u32, values)
    }
}

/// Codes the steps of a variable on a mesh: a span for each block of 64 steps.
///
/// Where an error bound is not met, the block is coded with more entries, then with one more table, then in two halves:
/// down to single steps, each of one or two affine stages. Where the set of missing values changes within a block, it is halved too, until
/// each part has one set. Tables that would take more than single steps do are not made: of few points, single steps are coded. The same steps give the same spans whoever does the work.
///
/// * `steps`: for each step one value per point, NaN where it is missing
///
/// # Errors
/// [`CodecError::InvalidArgument`] if there is no step or point, the steps have different numbers of points, a value is infinite,
/// or an option is out of range or cannot be met.
pub fn encode_cells(
    steps: &[&[f32]],
    options: &CellCodecOptions,
    workers: &impl Workers,
) -> Result<Vec<CellSpan>, CodecError> {
    let num_points = steps.first().map_or(0, |step| step.len());
    if num_points == 0 || steps.iter().any(|step| step.len() != num_points) {
        let remedy = "give steps with one value for each point of one mesh";
        return Err(CodecError::invalid("number of values", num_points, remedy));
    }
    if let Some(at) = steps.iter().position(|step| step.iter().any(|v| v.is_infinite())) {
        let remedy = "no value may be infinite: make those NaN";
        return Err(CodecError::invalid("step with an infinite value", at, remedy));
    }
    if !(2..=MOST_ENTRIES).contains(&options.entries) {
        return Err(CodecError::invalid("entries", options.entries, "use 2 to 1024"));
    }
    if let Some(bound) = options.max_error.filter(|bound| !(bound.is_finite() && *bound >= 0.0)) {
        return Err(CodecError::invalid("max_error", bound, "it must be finite and not negative"));
    }
    let mut spans = Vec::new();
    for (number, block) in steps.chunks(BLOCK_STEPS).enumerate() {
        let coder = block::BlockCoder { options, workers, num_points };
        coder.code(block, number * BLOCK_STEPS, BLOCK_STEPS, &mut spans)?;
    }
    Ok(spans)
}

/// Decodes a step of a payload into one value per point: the sum of [`crate::decode_samples`], rounded once.
///
/// # Errors
/// As [`crate::decode_samples`].
pub fn decode_points(payload: &Payload, step_in_span: u32, values: &mut [f32]) -> Result<(), CodecError> {
    if payload.stages.is_empty() {
        return Err(CodecError::corrupt("number of stages", 0, "a payload has at least one"));
    }
    payload.stages.iter().try_for_each(|stage| stage.validate_samples(values.len()))?;
    let rows = rows_at(payload, step_in_span)?;
    // What each index means; an affine stage needs no list.
    let listed = |row: &Meaning<'_>| match row {
        Meaning::Row { row: entries, .. } => entries.iter().map(|&entry| row.value(entry)).collect(),
        Meaning::Affine { .. } => Vec::new(),
    };
    let tables: Vec<Vec<f64>> = rows.iter().map(listed).collect();
    values.chunks_mut(PART_POINTS).enumerate().for_each(|(part, values)| {
        // Negative zero plus any value is that value: the sum begins with that of the first stage.
        let mut sums = vec![-0.0; values.len()];
        let first = part * PART_POINTS;
        for ((row, stage), table) in rows.iter().zip(&payload.stages).zip(&tables) {
            match (row, &stage.indices) {
                (Meaning::Affine { .. }, Indices::U8(v)) => {
                    add(&mut sums, &v[first..], |i| row.value(i.into()))
                }
                (Meaning::Affine { .. }, Indices::U16(v)) => add(&mut sums, &v[first..], |i| row.value(i)),
                (Meaning::Row { .. }, Indices::U8(v)) => {
                    add(&mut sums, &v[first..], |i| table[usize::from(i)])
                }
                (Meaning::Row { .. }, Indices::U16(v)) => {
                    add(&mut sums, &v[first..], |i| table[usize::from(i)])
                }
            }
        }
        values.iter_mut().zip(&sums).for_each(|(value, sum)| *value = *sum as f32);
    });
    Ok(())
}

fn add<I: Copy>(sums: &mut [f64], indices: &[I], value: impl Fn(I) -> f64) {
    sums.iter_mut().zip(indices).for_each(|(sum, &i)| *sum += value(i));
}

/// How much a span differs from what it was made from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpanErrors {
    /// `10 log10` of the variance of the values over their mean squared error; infinite where there is none.
    pub snr_db: f64,
    /// Largest difference, data units.
    pub max_error: f64,
    /// Root of the mean squared difference, data units.
    pub rms_error: f64,
}

/// Compares a span with its steps, as they are decoded, where there are values.
///
/// # Errors
/// As [`decode_points`], and if there is another number of steps.
pub fn span_errors(span: &CellSpan, steps: &[&[f32]]) -> Result<SpanErrors, CodecError> {
    if steps.len() != span.num_steps {
        return Err(CodecError::invalid("number of steps", steps.len(), "give those of the span"));
    }
    let (mut sum, mut squares, mut errors, mut max_error) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
    let mut count = 0u64;
    let mut decoded = Vec::new();
    let first = steps.iter().flat_map(|step| step.iter()).find(|v| !v.is_nan());
    let first = f64::from(first.copied().unwrap_or(0.0));
    for (step, values) in steps.iter().enumerate() {
        decoded.resize(values.len(), 0.0);
        decode_points(&span.payload, step as u32, &mut decoded)?;
        for (&value, &found) in values.iter().zip(&decoded).filter(|(v, _)| !v.is_nan()) {
            // From one of the values, so that a small variance on a large mean keeps its digits.
            let value_from_first = f64::from(value) - first;
            sum += value_from_first;
            squares += value_from_first * value_from_first;
            let error = f64::from(value) - f64::from(found);
            errors += error * error;
            max_error = max_error.max(error.abs());
            count += 1;
        }
    }
    let num = count.max(1) as f64;
    let variance = (squares - sum * sum / num).max(0.0);
    let snr_db = if errors > 0.0 { 10.0 * (variance / errors).log10() } else { f64::INFINITY };
    Ok(SpanErrors { snr_db, max_error, rms_error: (errors / num).sqrt() })
}

/// The paper's ratio: 4 bytes per value, over 12 bytes per point and block (a mean and two indices) and two tables of
/// `4 · 64 · entries` and `4 · 8 · entries` bytes per block (section 4).
pub fn paper_ratio(num_points: usize, num_steps: usize, entries: usize) -> f64 {
    let blocks = num_steps.div_ceil(BLOCK_STEPS) as f64;
    let coded = blocks * (12.0 * num_points as f64 + 4.0 * 72.0 * entries as f64);
    4.0 * num_points as f64 * num_steps as f64 / coded
}
