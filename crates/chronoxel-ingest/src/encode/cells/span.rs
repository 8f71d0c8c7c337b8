//! What a span decodes to, held against what it was made from.

use chronoxel_codec::{CellSpan, CodecError, decode_points};
use chronoxel_core::{BitMask, SpanStatistics};
use chronoxel_store::CellSpanWrite;

/// A span with what it decodes to and how far that is from its source.
///
/// * `first_step`: of the block, whose steps are given
/// * `rounding`: the most by which rounding to `f32` changed a value
pub fn written(
    span: CellSpan,
    steps: &[&[f32]],
    first_step: usize,
    rounding: f64,
) -> Result<CellSpanWrite, CodecError> {
    let steps = &steps[span.start..span.start + span.num_steps];
    let mut decoded = vec![0.0; steps[0].len()];
    let mut sums = Sums::new(steps);
    for (step, values) in steps.iter().enumerate() {
        decode_points(&span.payload, step as u32, &mut decoded)?;
        let pairs = values.iter().zip(&decoded).filter(|(value, _)| !value.is_nan());
        pairs.for_each(|(&value, &found)| sums.take(value, found));
    }
    let missing: Option<BitMask> = span.missing;
    let errors = sums.errors(rounding);
    Ok(CellSpanWrite {
        start: (first_step + span.start) as u32,
        window: span.window as u32,
        payload: span.payload,
        missing,
        drawn_range: sums.drawn_range(),
        statistics: sums.statistics(),
        rms_error: errors[0],
        max_error: errors[1],
    })
}

/// Sums over the values of a span.
struct Sums {
    /// One of the values, from which the others are counted, so that a small deviation on a large mean keeps its digits.
    pivot: f64,
    count: u64,
    sum: f64,
    squares: f64,
    range: [f32; 2],
    drawn: [f32; 2],
    squared_errors: f64,
    max_error: f64,
}

impl Sums {
    fn new(steps: &[&[f32]]) -> Self {
        let pivot = steps.iter().flat_map(|step| step.iter()).find(|v| !v.is_nan());
        let nothing = [f32::INFINITY, f32::NEG_INFINITY];
        Self {
            pivot: f64::from(pivot.copied().unwrap_or(0.0)),
            count: 0,
            sum: 0.0,
            squares: 0.0,
            range: nothing,
            drawn: nothing,
            squared_errors: 0.0,
            max_error: 0.0,
        }
    }

    fn take(&mut self, value: f32, found: f32) {
        let from_pivot = f64::from(value) - self.pivot;
        self.count += 1;
        self.sum += from_pivot;
        self.squares += from_pivot * from_pivot;
        self.range = [self.range[0].min(value), self.range[1].max(value)];
        self.drawn = [self.drawn[0].min(found), self.drawn[1].max(found)];
        let error = f64::from(value) - f64::from(found);
        self.squared_errors += error * error;
        self.max_error = self.max_error.max(error.abs());
    }

    fn drawn_range(&self) -> [f64; 2] {
        if self.count == 0 { [f64::NAN; 2] } else { self.drawn.map(f64::from) }
    }

    fn statistics(&self) -> SpanStatistics {
        if self.count == 0 {
            let nan = f64::NAN;
            return SpanStatistics { count: 0, min: nan, max: nan, mean: nan, std: nan };
        }
        let [min, max] = self.range.map(f64::from);
        let mean = self.sum / self.count as f64;
        let variance = (self.squares / self.count as f64 - mean * mean).max(0.0);
        let mean = (self.pivot + mean).clamp(min, max);
        SpanStatistics { count: self.count, min, max, mean, std: variance.sqrt() }
    }

    /// Root mean square and largest.
    fn errors(&self, rounding: f64) -> [f64; 2] {
        if self.count == 0 {
            return [f64::NAN; 2];
        }
        [(self.squared_errors / self.count as f64).sqrt(), self.max_error + rounding]
    }
}
