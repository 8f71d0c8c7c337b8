// The opacity of longer ways than that of one sample. Twin: `twins::log_transmittance_of`.

// ln(1 - opacity), without losing what is small.
fn log_transmittance_of(opacity: f32) -> f32 {
    let a = opacity;
    if a > 0.125 {
        return log(1.0 - a);
    }
    return -a * (1.0 + a * (1.0 / 2.0 + a * (1.0 / 3.0 + a * (1.0 / 4.0 + a * (1.0 / 5.0 + a / 6.0)))));
}
