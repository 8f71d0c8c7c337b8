//! One block of steps: which form it takes within an error bound, and how it is halved.

use chronoxel_core::BitMask;

use super::{CellCodecOptions, CellSpan, MOST_ENTRIES, span_errors, train::Parts};
use crate::{CodecError, Indices, Payload, Stage, Table, Workers};

/// Steps of each of the means of the second stage, as a shift.
const MEAN_SHIFT: u8 = 3;
/// More entries are tried where the error is at most this many times the bound,
const MORE_ENTRIES_GAIN: f64 = 8.0;
/// and one more table, which gains more.
const MORE_TABLES_GAIN: f64 = 64.0;

/// Codes blocks of steps.
pub(super) struct BlockCoder<'a, W> {
    pub options: &'a CellCodecOptions,
    pub workers: &'a W,
    pub num_points: usize,
}

/// Steps whose values are all there: those of the points that have any.
struct Dense<'a> {
    steps: &'a [&'a [f32]],
    start: usize,
    window: usize,
}

/// A span in the making, and what its stages leave.
struct Attempt {
    span: CellSpan,
    rest: Parts,
    max_error: f64,
}

impl<W: Workers> BlockCoder<'_, W> {
    /// Codes the steps of a window, of which the series may have only the first.
    pub fn code(
        &self,
        steps: &[&[f32]],
        start: usize,
        window: usize,
        spans: &mut Vec<CellSpan>,
    ) -> Result<(), CodecError> {
        let Some(missing) = missing_of(steps) else {
            let (first, second) = steps.split_at(steps.len().min(window / 2));
            self.code(first, start, window / 2, spans)?;
            return match second.is_empty() {
                true => Ok(()),
                false => self.code(second, start + window / 2, window / 2, spans),
            };
        };
        let num_missing = missing.num_set();
        let from = spans.len();
        if num_missing == 0 {
            return self.code_dense(&Dense { steps, start, window }, spans);
        }
        if num_missing == self.num_points {
            let indices = Indices::U8(vec![0; self.num_points]);
            let table = Table::Affine { offset: 0.0, scale: 0.0 };
            let payload = Payload { stages: vec![Stage { indices, table, shift: 0 }] };
            let num_steps = steps.len();
            spans.push(CellSpan { start, window, num_steps, payload, missing: Some(missing) });
            return Ok(());
        }
        let present: Vec<usize> = (0..self.num_points).filter(|&point| !missing.get(point)).collect();
        let gathered: Vec<Vec<f32>> =
            self.workers.map(steps, |step| present.iter().map(|&p| step[p]).collect());
        let gathered: Vec<&[f32]> = gathered.iter().map(Vec::as_slice).collect();
        self.code_dense(&Dense { steps: &gathered, start, window }, spans)?;
        for span in &mut spans[from..] {
            span.payload.stages.iter_mut().for_each(|stage| self.scatter(stage, &present));
            span.missing = Some(missing.clone());
        }
        Ok(())
    }

    /// Gives indices of some of the points to all, 0 to the others.
    fn scatter(&self, stage: &mut Stage, present: &[usize]) {
        fn scattered<T: Copy + Default>(indices: &[T], present: &[usize], len: usize) -> Vec<T> {
            let mut all = vec![T::default(); len];
            present.iter().zip(indices).for_each(|(&point, &index)| all[point] = index);
            all
        }
        stage.indices = match &stage.indices {
            Indices::U8(v) => Indices::U8(scattered(v, present, self.num_points)),
            Indices::U16(v) => Indices::U16(scattered(v, present, self.num_points)),
        };
    }

    fn code_dense(&self, dense: &Dense<'_>, spans: &mut Vec<CellSpan>) -> Result<(), CodecError> {
        let singles_bytes: usize = dense
            .steps
            .iter()
            .map(|step| self.single_form(step).map_or(0, |bits| single_bytes(step.len(), bits)))
            .sum();
        if dense.window > 1 {
            if let Some(span) = self.with_tables(dense, singles_bytes)? {
                spans.push(span);
                return Ok(());
            }
            let half = dense.window / 2;
            let (first, second) = dense.steps.split_at(dense.steps.len().min(half));
            self.code_dense(&Dense { steps: first, start: dense.start, window: half }, spans)?;
            if !second.is_empty() {
                self.code_dense(&Dense { steps: second, start: dense.start + half, window: half }, spans)?;
            }
            return Ok(());
        }
        spans.push(self.single(dense)?);
        Ok(())
    }

    /// A span of tables, if one holds the bound and takes fewer bytes than single steps.
    fn with_tables(&self, dense: &Dense<'_>, singles_bytes: usize) -> Result<Option<CellSpan>, CodecError> {
        let num_points = dense.steps[0].len();
        let entries = self.options.entries.min(num_points);
        let most = MOST_ENTRIES.min(num_points);
        let fits = |entries, num_tables| {
            table_bytes(num_points, dense.steps.len(), entries, num_tables) < singles_bytes
        };
        if dense.steps.len() < 2 || num_points < 2 || !fits(entries, 1) {
            return Ok(None);
        }
        let means = Means::new(dense.steps, self.workers);
        let Some(bound) = self.options.max_error else {
            return Ok(Some(self.attempt(dense, means, entries)?.span));
        };
        let mut attempt = self.attempt(dense, means.clone(), entries)?;
        if attempt.max_error <= bound {
            return Ok(Some(attempt.span));
        }
        if entries < most && fits(most, 1) && attempt.max_error <= bound * MORE_ENTRIES_GAIN {
            attempt = self.attempt(dense, means, most)?;
            if attempt.max_error <= bound {
                return Ok(Some(attempt.span));
            }
        }
        let last = attempt.span.payload.stages.last().map_or(0, |stage| match stage.class().table {
            crate::TableClass::Listed { entries, .. } => entries as usize,
            crate::TableClass::Affine => 0,
        });
        if last > 0 && fits(last, 2) && attempt.max_error <= bound * MORE_TABLES_GAIN {
            let stage = attempt.rest.code(last, 0, self.workers);
            attempt.span.payload.stages.push(stage);
            if span_errors(&attempt.span, dense.steps)?.max_error <= bound {
                return Ok(Some(attempt.span));
            }
        }
        Ok(None)
    }

    /// Codes steps by their means, their means of eight, and a table over all of them.
    fn attempt(&self, dense: &Dense<'_>, means: Means, entries: usize) -> Result<Attempt, CodecError> {
        let Means { stage, mut rest } = means;
        let mut stages = vec![stage];
        if dense.steps.len() > 1 << MEAN_SHIFT {
            let differences = rest.means_of(1 << MEAN_SHIFT, self.workers);
            let stage = differences.code(entries, MEAN_SHIFT, self.workers);
            rest.subtract(&stage, self.workers);
            stages.push(stage);
        }
        let stage = rest.code(entries, 0, self.workers);
        rest.subtract(&stage, self.workers);
        stages.push(stage);
        let span = dense.span(Payload { stages });
        let max_error = match self.options.max_error {
            Some(_) => span_errors(&span, dense.steps)?.max_error,
            None => 0.0,
        };
        Ok(Attempt { span, rest, max_error })
    }

    /// A step by itself: affine stages with the fewest bits that hold the bound.
    fn single(&self, dense: &Dense<'_>) -> Result<CellSpan, CodecError> {
        let step = dense.steps[0];
        let bound = self.options.max_error;
        let first = self.single_form(step);
        for bits in FORMS.into_iter().skip_while(|&bits| Some(bits) != first) {
            let mut rest: Vec<f64> = step.iter().map(|&v| f64::from(v)).collect();
            let mut stages = Vec::new();
            for &bits in bits {
                let stage = affine_stage(&rest, bits);
                subtract(&mut rest, &stage);
                stages.push(stage);
            }
            let span = dense.span(Payload { stages });
            let holds = match bound {
                Some(bound) => span_errors(&span, dense.steps)?.max_error <= bound,
                None => true,
            };
            if holds {
                return Ok(span);
            }
        }
        let remedy = "it must be at least about 1e-9 of the range, and what f32 can tell apart";
        Err(CodecError::invalid("max_error", bound.unwrap_or_default(), remedy))
    }

    /// The first of [`FORMS`] of a single step that can hold the bound.
    fn single_form(&self, step: &[f32]) -> Option<&'static [u8]> {
        let Some(bound) = self.options.max_error else { return Some(&[16]) };
        let ends = [f32::INFINITY, f32::NEG_INFINITY];
        let [low, high] = step.iter().fold(ends, |[low, high], &v| [low.min(v), high.max(v)]);
        let range = f64::from(high) - f64::from(low);
        let levels = |bits: &[u8]| bits.iter().map(|&b| f64::from((1u32 << b) - 1)).product::<f64>();
        // Whole numbers are held exactly by a scale of one: the range itself need not be cut finer.
        let is_whole = range <= 65535.0 && step.iter().all(|v| v.fract() == 0.0);
        let holds = |bits: &&[u8]| 0.5 * range / levels(bits) <= bound || (is_whole && range <= levels(bits));
        FORMS.into_iter().find(holds).or(FORMS.last().copied())
    }
}

/// Bits of the stages of a single step.
const FORMS: [&[u8]; 4] = [&[8], &[16], &[16, 8], &[16, 16]];

fn single_bytes(num_points: usize, bits: &[u8]) -> usize {
    bits.iter().map(|&bits| 16 + num_points * usize::from(bits / 8)).sum()
}

/// Bytes of a span of tables.
fn table_bytes(num_points: usize, num_steps: usize, entries: usize, num_tables: usize) -> usize {
    let index = if entries <= 256 { 1 } else { 2 };
    let table = |rows: usize| 16 + 2 * rows * entries + index * num_points;
    let of_means = if num_steps > 1 << MEAN_SHIFT { table(num_steps.div_ceil(1 << MEAN_SHIFT)) } else { 0 };
    16 + 2 * num_points + of_means + num_tables * table(num_steps)
}

/// The first stage, and what it leaves.
#[derive(Clone)]
struct Means {
    stage: Stage,
    rest: Parts,
}

impl Means {
    fn new(steps: &[&[f32]], workers: &impl Workers) -> Self {
        let mut rest = Parts::new(steps, workers);
        let stage = affine_stage(&rest.means(steps.len()), 16);
        rest.subtract(&stage, workers);
        Self { stage, rest }
    }
}

impl Dense<'_> {
    fn span(&self, payload: Payload) -> CellSpan {
        let (start, window, num_steps) = (self.start, self.window, self.steps.len());
        CellSpan { start, window, num_steps, payload, missing: None }
    }
}

/// The points that have no value at any of the steps; `None` where those change.
fn missing_of(steps: &[&[f32]]) -> Option<BitMask> {
    let of = |step: &[f32]| BitMask::from_flags(step.iter().map(|v| v.is_nan()));
    let first = of(steps[0]);
    let same = |step: &&[f32]| step.iter().enumerate().all(|(point, v)| v.is_nan() == first.get(point));
    steps[1..].iter().all(same).then_some(first)
}

/// Values rounded to the numbers of 8 or 16 bits over their range.
fn affine_stage(values: &[f64], bits: u8) -> Stage {
    let low = values.iter().copied().fold(f64::INFINITY, f64::min);
    let high = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let largest = f64::from((1u32 << bits) - 1);
    // Whole numbers that fit are exact.
    let is_whole = high - low <= largest && values.iter().all(|v| v.fract() == 0.0);
    let scale = if is_whole && high > low { 1.0 } else { (high - low) / largest };
    let index =
        |v: &f64| if scale > 0.0 { ((v - low) / scale).round().clamp(0.0, largest) as u16 } else { 0 };
    let indices = match bits {
        8 => Indices::U8(values.iter().map(|v| index(v) as u8).collect()),
        _ => Indices::U16(values.iter().map(index).collect()),
    };
    Stage { indices, table: Table::Affine { offset: low, scale }, shift: 0 }
}

/// Takes away what an affine stage decodes to.
fn subtract(values: &mut [f64], stage: &Stage) {
    let Table::Affine { offset, scale } = stage.table else { return };
    for (place, value) in values.iter_mut().enumerate() {
        let index = match &stage.indices {
            Indices::U8(v) => u16::from(v[place]),
            Indices::U16(v) => v[place],
        };
        *value -= offset + scale * f64::from(index);
    }
}
