//! From decoded values to the little-endian bytes of a sample type.

use std::path::Path;

use chronoxel_core::SampleType;

use super::{ExportDescription, ExportError};

/// The bytes of a step; integers are rounded and clamped, NaN becomes the fill value.
pub(super) fn sample_bytes(
    path: &Path,
    description: &ExportDescription,
    step: usize,
    samples: &[f64],
) -> Result<Vec<u8>, ExportError> {
    let ExportDescription { sample_type, fill_value, .. } = *description;
    let fill_value = if sample_type.is_integer() { fill_value } else { Some(f64::NAN) };
    if fill_value.is_none()
        && let Some(sample) = samples.iter().position(|v| v.is_nan())
    {
        return Err(ExportError::Missing { path: path.to_owned(), sample, step, sample_type });
    }
    let mut bytes = Vec::with_capacity(samples.len() * sample_type.num_bytes());
    for &value in samples {
        append(&mut bytes, sample_type, if value.is_nan() { fill_value.unwrap_or(value) } else { value });
    }
    Ok(bytes)
}

/// Appends one value; `as` clamps, and a finite value beyond `f32` is clamped, too.
pub(super) fn append(bytes: &mut Vec<u8>, sample_type: SampleType, value: f64) {
    let whole = value.round();
    match sample_type {
        SampleType::U8 => bytes.push(whole as u8),
        SampleType::I8 => bytes.extend((whole as i8).to_le_bytes()),
        SampleType::U16 => bytes.extend((whole as u16).to_le_bytes()),
        SampleType::I16 => bytes.extend((whole as i16).to_le_bytes()),
        SampleType::U32 => bytes.extend((whole as u32).to_le_bytes()),
        SampleType::I32 => bytes.extend((whole as i32).to_le_bytes()),
        SampleType::U64 => bytes.extend((whole as u64).to_le_bytes()),
        SampleType::I64 => bytes.extend((whole as i64).to_le_bytes()),
        SampleType::F32 if value.is_finite() => {
            bytes.extend((value.clamp(f64::from(f32::MIN), f64::from(f32::MAX)) as f32).to_le_bytes());
        }
        SampleType::F32 => bytes.extend((value as f32).to_le_bytes()),
        SampleType::F64 => bytes.extend(value.to_le_bytes()),
    }
}

/// Whether an integer type holds a value without rounding or clamping.
pub(super) fn holds(sample_type: SampleType, value: f64) -> bool {
    let num_bits = 8 * sample_type.num_bytes() as i32;
    let is_signed =
        matches!(sample_type, SampleType::I8 | SampleType::I16 | SampleType::I32 | SampleType::I64);
    let [low, beyond] = if is_signed {
        [-libm::ldexp(1.0, num_bits - 1), libm::ldexp(1.0, num_bits - 1)]
    } else {
        [0.0, libm::ldexp(1.0, num_bits)]
    };
    value >= low && value < beyond && value.fract() == 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(sample_type: SampleType, value: f64) -> Vec<u8> {
        let mut bytes = Vec::new();
        append(&mut bytes, sample_type, value);
        bytes
    }

    #[test]
    fn integers_are_rounded_and_clamped() {
        for (value, expected) in [(1.5, 2u8), (2.4, 2), (-3.0, 0), (255.6, 255), (f64::INFINITY, 255)] {
            assert_eq!(one(SampleType::U8, value), [expected], "{value}");
        }
        assert_eq!(one(SampleType::I16, -40_000.0), i16::MIN.to_le_bytes());
        assert_eq!(one(SampleType::I32, -2.5), (-3i32).to_le_bytes());
        assert_eq!(one(SampleType::U64, 1e30), u64::MAX.to_le_bytes());
        assert_eq!(one(SampleType::F32, 1e300), f32::MAX.to_le_bytes());
        assert_eq!(one(SampleType::F32, f64::NEG_INFINITY), f32::NEG_INFINITY.to_le_bytes());
    }

    #[test]
    fn fill_values_must_be_held_exactly() {
        assert!(
            holds(SampleType::U8, 255.0) && !holds(SampleType::U8, 256.0) && !holds(SampleType::U8, -1.0)
        );
        assert!(holds(SampleType::I16, -32768.0) && !holds(SampleType::I16, 32768.0));
        assert!(!holds(SampleType::I64, 0.5) && !holds(SampleType::U64, f64::NAN));
    }
}
