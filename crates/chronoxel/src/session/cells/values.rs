//! The values of a step, from what is stored of its span.

use anyhow::Context;
use chronoxel_store::{CellPayload, CellStore};

/// Decodes a step of a span: one value per point, NaN where there is none.
///
/// # Errors
/// If the payload is not sound, naming the store.
pub(crate) fn decode_into(
    store: &CellStore,
    payload: &CellPayload,
    step: u32,
    values: &mut Vec<f32>,
) -> anyhow::Result<()> {
    values.resize(store.header().num_points as usize, 0.0);
    payload.decode(step, values).with_context(|| format!("{}: step {step}", store.path().display()))
}

/// Values between two steps, in place of those of the first; missing where either is.
///
/// * `weight`: of the later step, in (0, 1)
pub(crate) fn values_between(values: &mut [f32], later: &[f32], weight: f64) {
    let between = |a: f32, b: f32| (f64::from(a) * (1.0 - weight) + f64::from(b) * weight) as f32;
    values.iter_mut().zip(later).for_each(|(a, b)| *a = between(*a, *b));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn between_steps_values_are_interpolated_and_missing_ones_stay_missing() {
        let mut values = [1.0, f32::NAN, 3.0];
        values_between(&mut values, &[5.0, 1.0, f32::NAN], 0.25);
        assert_eq!(values[0], 2.0);
        assert!(values[1].is_nan() && values[2].is_nan());
    }
}
