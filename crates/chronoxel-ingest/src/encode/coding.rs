//! The choice of a payload for one brick: empty, constant, or coded with 8 or 16 bits.

use chronoxel_codec::{
    CodecError, Payload, PayloadClass, Stage, decoded_range, quantize_affine, stage_to_bytes,
};
use chronoxel_core::{BitMask, BrickLayout};
use chronoxel_store::SpanContent;

use super::analyse::Analysis;
use super::pad::pad;
use super::real::Real;
use crate::EncodeError;

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

impl Choice {
    /// What the store's writer takes.
    ///
    /// * `classes`: those of the variable, the payload's among them
    pub fn into_content(self, classes: &[PayloadClass], layout: &BrickLayout) -> SpanContent {
        match self {
            Self::Empty => SpanContent::Empty,
            Self::Constant(value) => SpanContent::Constant(value),
            Self::Coded(payload) => {
                let class = PayloadClass { stages: payload.stages.iter().map(Stage::class).collect() };
                let class = classes.iter().position(|known| *known == class);
                SpanContent::Coded {
                    class: class.expect("codecs give payloads of the classes they announce") as u8,
                    stages: payload.stages.iter().map(|stage| stage_to_bytes(stage, layout)).collect(),
                }
            }
        }
    }
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

impl Refusal {
    /// The error of the encoder, which names the place.
    ///
    /// * `max_error`: the bound as the user gave it, relative to the range
    pub fn into_error(
        self,
        variable: &str,
        step: usize,
        level: u8,
        brick: [usize; 3],
        max_error: f64,
    ) -> EncodeError {
        let variable = variable.to_owned();
        match self {
            Self::Bound { error, bound } => {
                EncodeError::Bound { variable, step, brick, max_error, error, bound }
            }
            Self::Codec(source) => {
                EncodeError::Brick { variable, step, level, brick, source: Box::new(source) }
            }
        }
    }
}

/// Codes a brick of one step with `bits` bits; `samples` are padded where masked.
///
/// Constant where all bits are equal.
pub fn code<T: Real>(
    samples: &mut [T],
    analysis: &Analysis,
    bits: u8,
    layout: &BrickLayout,
) -> Result<CodedBrick, Refusal> {
    if analysis.range.is_none() {
        return Ok(CodedBrick { choice: Choice::Empty, mask: None, drawn_range: [f64::NAN; 2] });
    }
    let mask = (analysis.num_masked > 0).then(|| BitMask::from_flags(samples.iter().map(|v| v.is_masked())));
    if analysis.is_constant {
        let value = samples.iter().find(|v| !v.is_masked()).map_or(0.0, |v| v.to_f64());
        return Ok(CodedBrick { choice: Choice::Constant(value), mask, drawn_range: [value; 2] });
    }
    let whole_numbers = samples.iter().all(|v| v.is_masked() || is_whole(v.to_f64()));
    if mask.is_some() {
        pad(samples, layout.full_edge(), whole_numbers);
    }
    let stage = quantize_affine(samples, whole_numbers, bits).map_err(Refusal::Codec)?;
    let payload = Payload { stages: vec![stage] };
    let drawn_range = decoded_range(&payload, layout, 1).map_err(Refusal::Codec)?;
    Ok(CodedBrick { choice: Choice::Coded(payload), mask, drawn_range })
}

/// Whether a number is whole and below 2^53: whatever type a source has, such samples can be coded without loss.
pub(super) fn is_whole(value: f64) -> bool {
    const LARGEST: f64 = (1u64 << 53) as f64;
    value.abs() < LARGEST && value as i64 as f64 == value
}
