//! The settings that a user hands over as JSON: transfer functions and cameras.
#![no_main]

use chronoxel_core::{Camera, TransferFunction};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    if let Ok(transfer) = TransferFunction::from_json(text) {
        for range in [[0.0, 1.0], [-1e300, 1e300], [5.0, 5.0], [0.0, 5e-324]] {
            let Ok(resolved) = transfer.resolve(range) else { continue };
            for value in [range[0], range[1], range[0] / 2.0 + range[1] / 2.0, f64::NAN, f64::MAX] {
                let color = resolved.evaluate(value);
                assert!(
                    value.is_nan() || color.iter().all(|c| (0.0..=1.0).contains(c)),
                    "{color:?} at {value} in {range:?}"
                );
            }
            resolved.is_transparent_over(range);
        }
    }
    if let Ok(camera) = Camera::from_json(text) {
        let ray = camera.rays([64, 48]).ray([31.5, 2.5]);
        assert!(ray.direction.iter().all(|d| d.is_finite()), "{ray:?}");
        camera.project([1.0, 2.0, 3.0], [64, 48]);
    }
});
