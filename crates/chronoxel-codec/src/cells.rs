//! Values at the points of a mesh through time (bernardon2006, section 3.1): blocks of 64 steps, each point by its mean,
//! a difference vector of 8 means, and a difference vector of 64 values, the two from tables that all points share.
//!
//! In the form of every payload, that is three stages: the mean is affine, with 16 bits; of the 8 means the row of a step
//! is `(step - start) >> 3`; of the 64 values it is the step itself. Decoding is the sum of three table look-ups.
//!
//! A stage codes what the stages before it leave, as they are decoded, so that it makes up for some of their error. Tables
//! are trained by splitting the cell of largest error across its main axis and then by Lloyd's iteration, as in Schneider and
//! Westermann 2003. Points are taken in parts of a fixed number, whose sums are added in order, so that a caller with threads may come to do them in
//! parallel without changing a byte.

mod train;

use crate::decode::{Entries as Meaning, rows_at};
use crate::{CodecError, Indices, Payload, Stage, Table};

pub use train::PART_POINTS;

/// Steps of a block.
pub const BLOCK_STEPS: usize = 64;
/// Steps of each of the means of the second stage, as a shift.
const MEAN_SHIFT: u8 = 3;
/// The most entries of a table that an error bound raises them to.
const MOST_ENTRIES: usize = 1024;

/// How values are coded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellCodecOptions {
    /// Entries of each of the two tables: 2 to 1024; above 256, indices have 16 bits.
    pub entries: usize,
    /// The most by which a decoded value may differ, in data units; none holds without it.
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
    /// The first of its steps, counted from the first that was coded.
    pub start: usize,
    /// Its steps, at most [`BLOCK_STEPS`].
    pub num_steps: usize,
    /// One index per point and stage.
    pub payload: Payload,
}

impl CellSpan {
    /// Bytes of its stages.
    pub fn num_bytes(&self) -> usize {
        let bytes = |stage: &Stage| stage.class().num_point_bytes(stage.indices.len());
        self.payload.stages.iter().map(bytes).sum()
    }

    /// Writes the values of one of its steps.
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
/// down to single steps, where a second affine stage codes what the first leaves.
///
/// * `steps`: for each step one finite value per point
///
/// # Errors
/// [`CodecError::InvalidArgument`] if there is no step or point, the steps have different numbers of points, a value is not finite,
/// or an option is out of range or cannot be met.
pub fn encode_cells(steps: &[&[f32]], options: &CellCodecOptions) -> Result<Vec<CellSpan>, CodecError> {
    let num_points = steps.first().map_or(0, |step| step.len());
    if num_points == 0 || steps.iter().any(|step| step.len() != num_points) {
        let remedy = "give steps with one value for each point of one mesh";
        return Err(CodecError::invalid("number of values", num_points, remedy));
    }
    if let Some(at) = steps.iter().position(|step| step.iter().any(|v| !v.is_finite())) {
        let remedy = "every value must be finite: fill in missing ones and keep a mask";
        return Err(CodecError::invalid("step with a value that is not finite", at, remedy));
    }
    if !(2..=MOST_ENTRIES).contains(&options.entries) {
        return Err(CodecError::invalid("entries", options.entries, "use 2 to 1024"));
    }
    if let Some(bound) = options.max_error.filter(|bound| !(bound.is_finite() && *bound > 0.0)) {
        return Err(CodecError::invalid("max_error", bound, "it must be finite and positive"));
    }
    let mut spans = Vec::new();
    for (number, block) in steps.chunks(BLOCK_STEPS).enumerate() {
        encode_bounded(block, number * BLOCK_STEPS, options, &mut spans)?;
    }
    Ok(spans)
}

/// Codes steps so that the error bound, if there is one, holds for what is decoded.
fn encode_bounded(
    steps: &[&[f32]],
    start: usize,
    options: &CellCodecOptions,
    spans: &mut Vec<CellSpan>,
) -> Result<(), CodecError> {
    let span = |payload| CellSpan { start, num_steps: steps.len(), payload };
    let mut attempts = vec![(options.entries, 1)];
    if options.max_error.is_some() {
        if options.entries < MOST_ENTRIES {
            attempts.push((MOST_ENTRIES, 1));
        }
        attempts.push((MOST_ENTRIES, 2));
    }
    for (entries, num_tables) in attempts {
        let span = span(encode_block(steps, entries, num_tables));
        let holds = match options.max_error {
            Some(bound) => span_errors(&span, steps)?.max_error <= bound,
            None => true,
        };
        if holds {
            spans.push(span);
            return Ok(());
        }
    }
    if steps.len() == 1 {
        let value = options.max_error.unwrap_or_default();
        let remedy = "it must be at least about 1e-9 of the range, and what f32 can tell apart";
        return Err(CodecError::invalid("max_error", value, remedy));
    }
    let (first, second) = steps.split_at(steps.len().div_ceil(2));
    encode_bounded(first, start, options, spans)?;
    encode_bounded(second, start + first.len(), options, spans)
}

/// Codes steps by their means, their means of eight, and tables over all of them.
fn encode_block(steps: &[&[f32]], entries: usize, num_tables: usize) -> Payload {
    let mut rest = train::Parts::new(steps);
    let means = rest.means(steps.len());
    let mut stages = vec![affine_stage(&means)];
    rest.subtract(&stages[0]);
    if steps.len() == 1 {
        if num_tables > 1 {
            stages.push(affine_stage(&rest.means(1)));
        }
        return Payload { stages };
    }
    if steps.len() > 1 << MEAN_SHIFT {
        let differences = rest.means_of(1 << MEAN_SHIFT);
        let stage = differences.code(entries, MEAN_SHIFT);
        rest.subtract(&stage);
        stages.push(stage);
    }
    for _ in 0..num_tables {
        let stage = rest.code(entries, 0);
        rest.subtract(&stage);
        stages.push(stage);
    }
    Payload { stages }
}

/// Values rounded to 65,536 numbers over their range.
fn affine_stage(values: &[f64]) -> Stage {
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let scale = (high - low) / 65535.0;
    let index =
        |v: &f64| if scale > 0.0 { ((v - low) / scale).round().clamp(0.0, 65535.0) as u16 } else { 0 };
    Stage {
        indices: Indices::U16(values.iter().map(index).collect()),
        table: Table::Affine { offset: low, scale },
        shift: 0,
    }
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
}

/// Compares a span with its steps, as they are decoded.
///
/// # Errors
/// As [`decode_points`], and if there is another number of steps.
pub fn span_errors(span: &CellSpan, steps: &[&[f32]]) -> Result<SpanErrors, CodecError> {
    if steps.len() != span.num_steps {
        return Err(CodecError::invalid("number of steps", steps.len(), "give those of the span"));
    }
    let (mut sum, mut squares, mut errors, mut max_error) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
    let mut decoded = Vec::new();
    let first = f64::from(steps.first().and_then(|step| step.first()).copied().unwrap_or(0.0));
    for (step, values) in steps.iter().enumerate() {
        decoded.resize(values.len(), 0.0);
        decode_points(&span.payload, step as u32, &mut decoded)?;
        for (&value, &found) in values.iter().zip(&decoded) {
            // From one of the values, so that a small variance on a large mean keeps its digits.
            let value_from_first = f64::from(value) - first;
            sum += value_from_first;
            squares += value_from_first * value_from_first;
            let error = f64::from(value) - f64::from(found);
            errors += error * error;
            max_error = max_error.max(error.abs());
        }
    }
    let num = (steps.len() * steps.first().map_or(0, |s| s.len())).max(1) as f64;
    let variance = (squares - sum * sum / num).max(0.0);
    let snr_db = if errors > 0.0 { 10.0 * (variance / errors).log10() } else { f64::INFINITY };
    Ok(SpanErrors { snr_db, max_error })
}

/// The paper's ratio: 4 bytes per value, over 12 bytes per point and block (a mean and two indices) and two tables of
/// `4 · 64 · entries` and `4 · 8 · entries` bytes per block (section 4).
pub fn paper_ratio(num_points: usize, num_steps: usize, entries: usize) -> f64 {
    let blocks = num_steps.div_ceil(BLOCK_STEPS) as f64;
    let coded = blocks * (12.0 * num_points as f64 + 4.0 * 72.0 * entries as f64);
    4.0 * num_points as f64 * num_steps as f64 / coded
}
