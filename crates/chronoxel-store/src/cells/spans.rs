//! Spans of a mesh on disk: thirteen numbers each, `[step, field]`, all NaN where no span begins.

use chronoxel_codec::Payload;
use chronoxel_core::{BitMask, SpanStatistics};

use super::{BLOCK_STEPS, CellClass, CellHeader};
use crate::chunk;

/// Names of the fields, in order.
pub(crate) const FIELDS: [&str; NUM_FIELDS] = [
    "start",
    "len",
    "class",
    "mask_row",
    "drawn_min",
    "drawn_max",
    "count",
    "min",
    "max",
    "mean",
    "std",
    "rms_error",
    "max_error",
];
/// Number of fields of a span.
const NUM_FIELDS: usize = 13;

/// A span as the table has it: the whole mesh over some steps of a variable.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellSpanRecord {
    /// Its first step.
    pub start: u32,
    /// Its steps.
    pub len: u32,
    /// Its class: an index into those of the variable.
    pub class: u8,
    /// The step at which the mask of its missing values is stored, if it has any; not after `start`.
    pub mask: Option<u32>,
    /// Smallest decoded value over all its points and steps, missing ones left out; NaN where there is no other.
    pub drawn_min: f64,
    /// Largest.
    pub drawn_max: f64,
    /// Statistics of the source's values.
    pub statistics: SpanStatistics,
    /// Root of the mean squared difference between source and decoded values; NaN where there are none.
    pub rms_error: f64,
    /// Largest difference.
    pub max_error: f64,
}

/// A span to be written.
#[derive(Debug, Clone, PartialEq)]
pub struct CellSpanWrite {
    /// Its first step.
    pub start: u32,
    /// Its class's length in steps: a power of two; the span is shorter only where the series ends.
    pub window: u32,
    /// One index per point and stage.
    pub payload: Payload,
    /// Points whose values are missing, at all of its steps.
    pub missing: Option<BitMask>,
    /// Smallest and largest decoded value; NaN where all are missing.
    pub drawn_range: [f64; 2],
    /// Statistics of the source's values.
    pub statistics: SpanStatistics,
    /// Root of the mean squared error; NaN where all values are missing.
    pub rms_error: f64,
    /// Largest error.
    pub max_error: f64,
}

/// The spans of a block of steps, at the step at which each begins.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SpanBlock {
    fields: Vec<[f64; NUM_FIELDS]>,
}

impl SpanBlock {
    pub const NUM_BYTES: usize = 8 * NUM_FIELDS * BLOCK_STEPS as usize;

    pub fn of(records: &[CellSpanRecord]) -> Self {
        let mut fields = vec![[f64::NAN; NUM_FIELDS]; BLOCK_STEPS as usize];
        for record in records {
            fields[(record.start % BLOCK_STEPS) as usize] = fields_of(record);
        }
        Self { fields }
    }

    pub fn encode(&self, zstd_level: i32) -> std::io::Result<Vec<u8>> {
        chunk::encode_by_field(&self.fields, zstd_level)
    }

    pub fn decode(stored: &[u8]) -> Result<Self, String> {
        Ok(Self { fields: chunk::decode_by_field(stored, BLOCK_STEPS as usize)? })
    }

    /// The spans of the block, which must partition its steps; else what is wrong.
    pub fn records(
        &self,
        header: &CellHeader,
        variable: usize,
        block: u32,
    ) -> Result<Vec<CellSpanRecord>, String> {
        let first = block * BLOCK_STEPS;
        let end = first.saturating_add(BLOCK_STEPS).min(header.num_steps());
        let mut next = first;
        let mut records = Vec::new();
        for (step, fields) in (first..).zip(&self.fields) {
            match record_of(fields, header, variable)? {
                None if step < end && step == next => return Err(format!("no span begins at step {step}")),
                None => {}
                Some(record) if record.start != step || step != next || step >= end => {
                    return Err(format!("a span of step {} lies at step {step}", record.start));
                }
                Some(record) => {
                    next += record.len;
                    records.push(record);
                }
            }
        }
        Ok(records)
    }
}

fn fields_of(record: &CellSpanRecord) -> [f64; NUM_FIELDS] {
    let SpanStatistics { count, min, max, mean, std } = record.statistics;
    let fields = [
        f64::from(record.start),
        f64::from(record.len),
        f64::from(record.class),
        record.mask.map_or(f64::NAN, f64::from),
        record.drawn_min,
        record.drawn_max,
        count as f64,
        min,
        max,
        mean,
        std,
        record.rms_error,
        record.max_error,
    ];
    // One NaN of the many, so that equal spans have equal bytes.
    fields.map(|v| if v.is_nan() { f64::NAN } else { v })
}

/// A whole number below a limit, from a number of a table.
fn whole(name: &str, value: f64, limit: u64) -> Result<u64, String> {
    match value >= 0.0 && value.fract() == 0.0 && value < limit as f64 {
        true => Ok(value as u64),
        false => Err(format!("{name} is {value}")),
    }
}

fn record_of(
    fields: &[f64; NUM_FIELDS],
    header: &CellHeader,
    variable: usize,
) -> Result<Option<CellSpanRecord>, String> {
    if fields.iter().all(|v| v.is_nan()) {
        return Ok(None);
    }
    let &[start, len, class, mask, drawn_min, drawn_max, count, min, max, mean, std, rms_error, max_error] =
        fields;
    let classes = &header.variables[variable].classes;
    let start = whole("start", start, u64::from(header.num_steps()))? as u32;
    let class = whole("class", class, classes.len() as u64)? as u8;
    let CellClass { window, .. } = &classes[usize::from(class)];
    let len = whole("len", len, u64::from(BLOCK_STEPS) + 1)? as u32;
    let due = header.span_len(start, *window);
    if !start.is_multiple_of(*window) || len != due || !classes[usize::from(class)].fits(len) {
        return Err(format!("{len} steps from step {start} on are no span of class {class}"));
    }
    let mask = match mask.is_nan() {
        true => None,
        false => Some(whole("mask_row", mask, u64::from(start) + 1)? as u32),
    };
    let most = u128::from(header.num_points) * u128::from(len);
    let count = whole("count", count, most.min(1 << 53) as u64 + 1)?;
    let in_order = |low: f64, high: f64| low.is_finite() && high.is_finite() && low <= high;
    let errors_are_sound =
        rms_error >= 0.0 && rms_error.is_finite() && max_error >= 0.0 && max_error.is_finite();
    let statistics = SpanStatistics { count, min, max, mean, std };
    let sound = match count {
        0 => [drawn_min, drawn_max, min, max, mean, std, rms_error, max_error].iter().all(|v| v.is_nan()),
        _ => {
            in_order(drawn_min, drawn_max)
                && in_order(min, max)
                && (min..=max).contains(&mean)
                && std >= 0.0
                && std.is_finite()
                && errors_are_sound
        }
    };
    if !sound || (mask.is_none() && u128::from(count) != most) {
        return Err(format!("the numbers of the span at step {start} contradict each other"));
    }
    Ok(Some(CellSpanRecord {
        start,
        len,
        class,
        mask,
        drawn_min,
        drawn_max,
        statistics,
        rms_error,
        max_error,
    }))
}
