//! The choice of a payload for one brick: empty, constant, or coded with 8 or 16 bits.

use chronoxel_codec::{
    CodecError, Indices, Payload, SampleValue, Stage, Table, decoded_range, quantize_affine,
};
use chronoxel_core::{BitMask, BrickLayout};

use super::analyse::{Analysis, range_of};
use super::pad::pad;
use super::real::Real;

/// What is asked of the bricks of one level of one variable.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Demand {
    /// Bits per index where no error bound is given.
    pub bits: u8,
    /// Largest absolute error allowed; `None`: whatever `bits` give.
    pub bound: Option<f64>,
    /// Whether a bound that 16 bits cannot hold is an error: on source samples, so level 0 alone. Elsewhere 16
    /// bits are taken as the best there is.
    pub bound_is_binding: bool,
}

/// What was chosen for a brick.
#[derive(Debug, Clone, PartialEq)]
pub enum Choice {
    /// All samples are masked.
    Empty,
    /// One value for all samples.
    Constant(f64),
    /// A payload.
    Coded(Payload),
}

/// A brick as it will be stored.
#[derive(Debug, Clone, PartialEq)]
pub struct CodedBrick {
    /// The payload.
    pub choice: Choice,
    /// Masked samples over core and apron, if there are any, and the brick is not empty.
    pub mask: Option<BitMask>,
    /// Range of the decoded samples; NaN where there are none.
    pub drawn_range: [f64; 2],
}

/// Why a brick cannot be coded.
#[derive(Debug, Clone, PartialEq)]
pub enum Refusal {
    /// 16 bits leave this error, and it exceeds the bound.
    Bound {
        /// Largest error found.
        error: f64,
        /// Largest error allowed.
        bound: f64,
    },
    /// The quantiser refused.
    Codec(CodecError),
}

/// Chooses the payload of a brick; `samples` are padded where masked.
///
/// With a bound the fewest bytes that hold it: constant, 8 bits, 16 bits, each checked sample by sample on what would
/// be decoded (masked samples excepted). Without: constant where all bits are equal, else `demand.bits`.
pub fn code<T: Real + SampleValue>(
    samples: &mut [T],
    analysis: &Analysis,
    demand: &Demand,
    layout: &BrickLayout,
) -> Result<CodedBrick, Refusal> {
    let Some([low, high]) = analysis.range else {
        return Ok(CodedBrick { choice: Choice::Empty, mask: None, drawn_range: [f64::NAN; 2] });
    };
    let mask = (analysis.num_masked > 0).then(|| BitMask::from_flags(samples.iter().map(|v| v.is_masked())));
    let middle = 0.5 * low + 0.5 * high;
    let constant = match demand.bound {
        _ if analysis.is_constant => {
            Some(samples.iter().find(|v| !v.is_masked()).map_or(low, |v| v.to_f64()))
        }
        Some(bound) if middle - low <= bound && high - middle <= bound => Some(middle),
        _ => None,
    };
    if let Some(value) = constant {
        return Ok(CodedBrick { choice: Choice::Constant(value), mask, drawn_range: [value; 2] });
    }
    let whole_numbers = samples.iter().all(|v| v.is_masked() || is_whole(v.to_f64()));
    if mask.is_some() {
        pad(samples, layout.full_edge(), whole_numbers);
    }
    let payload = Payload { stages: vec![stage(samples, mask.as_ref(), whole_numbers, demand)?] };
    let drawn_range = decoded_range(&payload, layout, 1).map_err(Refusal::Codec)?;
    Ok(CodedBrick { choice: Choice::Coded(payload), mask, drawn_range })
}

/// Whether a number is whole and below 2^53: whatever type a source has, such samples can be coded without loss.
fn is_whole(value: f64) -> bool {
    const LARGEST: f64 = (1u64 << 53) as f64;
    value.abs() < LARGEST && value as i64 as f64 == value
}

fn stage<T: Real + SampleValue>(
    samples: &[T],
    mask: Option<&BitMask>,
    whole_numbers: bool,
    demand: &Demand,
) -> Result<Stage, Refusal> {
    let quantize = |bits| quantize_affine(samples, whole_numbers, bits).map_err(Refusal::Codec);
    let Some(bound) = demand.bound else {
        return quantize(demand.bits);
    };
    let (low, high) = range_of(samples);
    let width = high.to_f64() - low.to_f64();
    // A step of more than twice the bound cannot hold it but by luck: not worth a try.
    if width <= 255.0 * 2.0 * bound || whole_numbers && width <= 255.0 {
        let stage = quantize(8)?;
        if largest_error(samples, mask, &stage) <= bound {
            return Ok(stage);
        }
    }
    let stage = quantize(16)?;
    let error = if demand.bound_is_binding { largest_error(samples, mask, &stage) } else { 0.0 };
    if error > bound { Err(Refusal::Bound { error, bound }) } else { Ok(stage) }
}

/// The largest difference between an unmasked sample and its decoded value.
fn largest_error<T: Real>(samples: &[T], mask: Option<&BitMask>, stage: &Stage) -> f64 {
    let Table::Affine { offset, scale } = stage.table else { return f64::INFINITY };
    match &stage.indices {
        Indices::U8(v) => largest_difference(samples, mask, v, |i| offset + scale * f64::from(i)),
        Indices::U16(v) => largest_difference(samples, mask, v, |i| offset + scale * f64::from(i)),
    }
}

fn largest_difference<T: Real, I: Copy>(
    samples: &[T],
    mask: Option<&BitMask>,
    indices: &[I],
    decoded: impl Fn(I) -> f64,
) -> f64 {
    let mut largest = 0.0f64;
    for (at, (&sample, &index)) in samples.iter().zip(indices).enumerate() {
        let difference = (decoded(index) - sample.to_f64()).abs();
        if difference > largest && mask.is_none_or(|mask| !mask.get(at)) {
            largest = difference;
        }
    }
    largest
}
