//! The uniform quantiser of one brick: raw coding with 8 or 16 bits within the brick's own range.

use crate::{CodecError, Indices, Stage, Table};

/// A sample as it comes from a source: `f32` or `f64`.
pub trait SampleValue: Copy + PartialOrd + Into<f64> + Send + Sync {
    /// Neither infinite nor NaN.
    fn finite(self) -> bool;
}

impl SampleValue for f32 {
    fn finite(self) -> bool {
        self.is_finite()
    }
}

impl SampleValue for f64 {
    fn finite(self) -> bool {
        self.is_finite()
    }
}

/// Quantises a brick, core and apron, to indices of `bits` bits within the range of its samples.
///
/// With `n = 2^bits - 1`: `offset` is the smallest sample, `scale = (largest - smallest) / n`, but at least the
/// smallest normal number where the samples differ, and 0 where they do not; `index = round((x - offset) / scale)`,
/// ties to even. The decoded sample differs from `x` by at most `scale / 2`, plus rounding in `f64` (4 units in the
/// last place of the larger end of the range). With `whole_numbers`, where the range is at most `n`, `scale` is 1 and
/// nothing is lost.
///
/// * `samples`: masked ones padded before, all finite
/// * `whole_numbers`: whether every sample is an integer below 2^53 in magnitude
/// * `bits`: 8 or 16
///
/// # Errors
/// [`CodecError::InvalidArgument`] for no samples, a sample that is not finite, a range beyond that of `f64`, or
/// another number of bits.
pub fn quantize_affine<T: SampleValue>(
    samples: &[T],
    whole_numbers: bool,
    bits: u8,
) -> Result<Stage, CodecError> {
    let num_steps = match bits {
        8 => 255.0,
        16 => 65535.0,
        _ => return Err(CodecError::invalid("bits", bits, "use 8 or 16")),
    };
    let [low, high] = range_of(samples)?;
    let width = high - low;
    if !width.is_finite() {
        return Err(CodecError::invalid(
            "range of a brick",
            format!("{low} to {high}"),
            "its width exceeds 1.8e308: scale the samples down",
        ));
    }
    let scale = match width {
        0.0 => 0.0,
        w if whole_numbers && w <= num_steps => 1.0,
        w => (w / num_steps).max(f64::MIN_POSITIVE),
    };
    let per_scale = if scale > 0.0 { 1.0 / scale } else { 0.0 };
    // Adding 2^52 leaves the value rounded to an integer in the lowest bits: no branch, no cast per sample.
    const ROUND: f64 = (1u64 << 52) as f64;
    let index = |x: T| ((x.into() - low) * per_scale + ROUND).to_bits();
    let indices = match bits {
        8 => Indices::U8(samples.iter().map(|&x| index(x) as u8).collect()),
        _ => Indices::U16(samples.iter().map(|&x| index(x) as u16).collect()),
    };
    Ok(Stage { indices, table: Table::Affine { offset: low, scale }, shift: 0 })
}

/// Smallest and largest of finite samples; zeros are positive.
pub(crate) fn range_of<T: SampleValue>(samples: &[T]) -> Result<[f64; 2], CodecError> {
    const LANES: usize = 16;
    let Some(&first) = samples.first() else {
        return Err(CodecError::invalid("number of samples", 0, "a brick has samples"));
    };
    let (mut low, mut high, mut finite) = ([first; LANES], [first; LANES], [true; LANES]);
    let (chunks, rest) = samples.as_chunks::<LANES>();
    let mut take = |lane: usize, x: T| {
        low[lane] = if x < low[lane] { x } else { low[lane] };
        high[lane] = if x > high[lane] { x } else { high[lane] };
        finite[lane] &= x.finite();
    };
    chunks.iter().for_each(|chunk| chunk.iter().enumerate().for_each(|(lane, &x)| take(lane, x)));
    rest.iter().enumerate().for_each(|(lane, &x)| take(lane, x));
    if finite.contains(&false) {
        let at = samples.iter().position(|x| !x.finite()).unwrap_or(0);
        return Err(CodecError::invalid("sample", samples[at].into(), "pad masked samples before coding"));
    }
    let fold = |lanes: [T; LANES], pick: fn(f64, f64) -> f64| {
        lanes.into_iter().map(Into::into).reduce(pick).unwrap_or(0.0) + 0.0
    };
    Ok([fold(low, f64::min), fold(high, f64::max)])
}
