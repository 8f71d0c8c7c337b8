//! Sums of the stages of a step as whole numbers: what drawing rounds from, and a filter for exact extremes.

use crate::{CodecError, Indices, Payload, decode::Entries};

/// Units of the widest range of a sum.
const NUM_UNITS: f64 = (1u32 << 30) as f64;
/// Added to a number below 2^23, or 2^52, leaves it rounded to an integer in the lowest bits.
const ROUND: f32 = (1 << 23) as f32;
const ROUND_F64: f64 = (1u64 << 52) as f64;
/// The largest 16-bit sample.
const LARGEST: f32 = 65535.0;

/// Sums over the stages of a payload at one step: `value = low + unit * sum`.
///
/// Each stage is rounded to a whole number of units, so that a sum differs by at most half a unit for each stage, plus
/// rounding in `f64`.
pub(crate) struct FixedSums {
    /// Value of sum 0.
    pub low: f64,
    /// 2^-30 of the sum of the widths of the rows of all stages, at least the smallest normal number.
    pub unit: f64,
    /// No decoded value, nor a part of its sum, is larger in magnitude.
    pub magnitude: f64,
    /// One per sample, 0 to 2^30 but for rounding.
    pub sums: Vec<i32>,
}

impl FixedSums {
    /// * `rows`: for each stage of the payload, what its indices mean at the step
    ///
    /// # Errors
    /// [`CodecError::Corrupt`] if the sum might not be finite.
    pub fn of(payload: &Payload, rows: &[Entries<'_>]) -> Result<Self, CodecError> {
        let (mut low, mut width, mut magnitude) = (0.0, 0.0, 0.0);
        let mut extremes = Vec::with_capacity(rows.len());
        for (row, stage) in rows.iter().zip(&payload.stages) {
            let [smallest, largest] = row.extremes(&stage.indices);
            let values = [smallest, largest].map(|entry| row.offset() + row.scale() * f64::from(entry));
            low += values[0];
            width += row.scale() * f64::from(largest - smallest);
            magnitude += values[0].abs().max(values[1].abs());
            extremes.push([smallest, largest]);
        }
        if !(width.is_finite() && magnitude.is_finite()) {
            let problem = "the sum of the stages must be finite";
            return Err(CodecError::corrupt("range of the stages", magnitude.max(width), problem));
        }
        let unit = (width / NUM_UNITS).max(f64::MIN_POSITIVE);
        let mut sums = Vec::new();
        for ((row, stage), [smallest, largest]) in rows.iter().zip(&payload.stages).zip(extremes) {
            let per_entry = if largest > smallest { row.scale() / unit } else { 0.0 };
            let fixed = |entry: u16| {
                let units = (f64::from(entry) - f64::from(smallest)).max(0.0) * per_entry;
                (units + ROUND_F64).to_bits() as i32
            };
            match (row, &stage.indices) {
                (_, Indices::U8(v)) => {
                    let table = row.padded().map(fixed);
                    add(&mut sums, v.iter().map(|&i| table[usize::from(i)]));
                }
                (Entries::Affine { .. }, Indices::U16(v)) => add(&mut sums, v.iter().map(|&i| fixed(i))),
                (Entries::Row { row, .. }, Indices::U16(v)) => {
                    let table: Vec<i32> = row.iter().map(|&entry| fixed(entry)).collect();
                    add(&mut sums, v.iter().map(|&i| table[usize::from(i)]));
                }
            }
        }
        Ok(Self { low, unit, magnitude, sums })
    }

    /// Smallest and largest sum.
    pub fn range(&self) -> [i32; 2] {
        let low = self.sums.iter().fold(i32::MAX, |low, &sum| low.min(sum));
        let high = self.sums.iter().fold(i32::MIN, |high, &sum| high.max(sum));
        [low, high]
    }

    /// The sums as 16-bit samples of their own range: samples, offset and scale.
    pub fn to_samples(&self) -> (Vec<u16>, f64, f64) {
        let [low, high] = self.range();
        let width = high - low;
        let per_unit = if width > 0 { LARGEST / width as f32 } else { 0.0 };
        let sample = |&sum: &i32| ((sum - low) as f32 * per_unit + ROUND).to_bits() as u16;
        let samples = self.sums.iter().map(sample).collect();
        let offset = self.low + self.unit * f64::from(low);
        (samples, offset, self.unit * (f64::from(width) / f64::from(LARGEST)))
    }
}

/// Adds to the sums, or makes them where there are none yet.
fn add(sums: &mut Vec<i32>, terms: impl ExactSizeIterator<Item = i32>) {
    if sums.is_empty() {
        sums.extend(terms);
    } else {
        sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
    }
}
