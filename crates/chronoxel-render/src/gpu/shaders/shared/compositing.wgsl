// Compositing of runs of equal samples. Twins: `twins::exp_m1`, `twins::accumulate_constant`.

// e^x - 1 for x <= 0, without losing what is small.
fn exp_m1(x: f32) -> f32 {
    if x < -0.25 {
        return exp(x) - 1.0;
    }
    return x * (1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0 * (1.0 + x / 5.0 * (1.0 + x / 6.0)))));
}

// What a number of equal samples add up to: the weight of the sample's colour, and the transmittance of the run.
//
// opacity: above 0
// log_transmittance: of one sample; not used where it is opaque
fn accumulate_constant(opacity: f32, log_transmittance: f32, num_samples: f32) -> vec2<f32> {
    if opacity >= 1.0 {
        return vec2<f32>(1.0, 0.0);
    }
    let x = max(log_transmittance * num_samples, -80.0);
    return vec2<f32>(-exp_m1(x) / opacity, exp(x));
}
