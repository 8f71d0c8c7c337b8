//! Compositing of samples front to back: opacity for a step, accumulation, runs of equal samples.

/// Opacity of a ray segment of length `dt`, given the opacity for the reference length.
///
/// `1 - (1 - opacity)^(dt / unit)`. Assumes constant extinction along the segment.
///
/// * `opacity`: that of one `unit` of path, in [0, 1]
/// * `dt`, `unit`: lengths in world units, > 0
///
/// Exact at both ends: 0 stays 0, and 1 stays 1.
pub fn correct_opacity(opacity: f64, dt: f64, unit: f64) -> f64 {
    if opacity >= 1.0 { 1.0 } else { -(f64::ln_1p(-opacity) * dt / unit).exp_m1() }
}

/// Puts a sample behind what `pixel` already holds.
///
/// * `pixel`: premultiplied colour and opacity accumulated so far
/// * `sample`: premultiplied colour and opacity of the next sample along the ray
pub fn accumulate(pixel: &mut [f64; 4], sample: [f64; 4]) {
    let transmittance = 1.0 - pixel[3];
    for (p, s) in pixel.iter_mut().zip(sample) {
        *p += transmittance * s;
    }
}

/// What `num_samples` equal samples of premultiplied `sample` add up to, in closed form: the weight of
/// the sample's colour, and the transmittance of the whole run.
///
/// The geometric series `1 + q + … + q^(n-1) = (1 - q^n) / (1 - q)` with `q = 1 - opacity`. Where the
/// opacity is 0 the sample adds nothing, as everywhere in compositing: a weight of 0.
pub fn accumulate_constant(opacity: f32, num_samples: f32) -> (f32, f32) {
    if opacity <= 0.0 || num_samples <= 0.0 {
        return (0.0, 1.0);
    }
    if opacity >= 1.0 {
        return (1.0, 0.0);
    }
    let log_transmittance = f64::ln_1p(-f64::from(opacity)) * f64::from(num_samples);
    let covered = -log_transmittance.exp_m1();
    ((covered / f64::from(opacity)) as f32, log_transmittance.exp() as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn opacity_of_two_halves_is_that_of_the_whole() {
        let half = correct_opacity(0.3, 0.5, 1.0);
        assert!((1.0 - (1.0 - half).powi(2) - 0.3).abs() < 1e-15);
        assert_eq!(correct_opacity(0.0, 0.5, 1.0), 0.0);
        assert_eq!(correct_opacity(1.0, 0.5, 1.0), 1.0);
        // Beer-Lambert: extinction 0.2 over a length of 3.
        assert!((correct_opacity(1.0 - (-0.2f64).exp(), 3.0, 1.0) - (1.0 - (-0.6f64).exp())).abs() < 1e-15);
    }

    #[test]
    fn a_run_of_equal_samples_is_its_samples_one_by_one() {
        for (opacity, n) in [(0.02f32, 37), (0.5, 3), (1e-6, 1000), (1.0, 2), (0.0, 9)] {
            let sample = [0.7, 0.2, 0.1, 1.0].map(|c| c * f64::from(opacity));
            let mut pixel = [0.0; 4];
            (0..n).for_each(|_| accumulate(&mut pixel, sample));
            let (weight, transmittance) = accumulate_constant(opacity, n as f32);
            for i in 0..4 {
                assert!((pixel[i] - f64::from(weight) * sample[i]).abs() < 1e-6, "{opacity} {n}");
            }
            assert!((1.0 - pixel[3] - f64::from(transmittance)).abs() < 1e-6);
        }
    }
}
