//! Bits for the coefficients of a transform by their variances.

/// Mean square distortion of a Gaussian variable of variance 1 with 0 to 5 bits (Max 1960, table 1: 1, 2, 4, 8, 16 and 32
/// levels); each bit more divides it by 4, as it does for any distribution and many levels.
const DISTORTION: [f64; 6] = [1.0, 0.3634, 0.1175, 0.03454, 0.009497, 0.002499];

/// Mean square distortion to expect of a coefficient of variance 1 quantised with `bits` bits.
pub fn expected_distortion(bits: u32) -> f64 {
    let listed = bits.min(DISTORTION.len() as u32 - 1);
    DISTORTION[listed as usize] / 4f64.powi((bits - listed) as i32)
}

/// Bits for each coefficient, `bits` together, so that the square error to expect is least (lum2001, section 3.3).
///
/// The square error of a coefficient of variance `v` with `b` bits is taken to be `v * expected_distortion(b)`. That falls
/// more slowly with each bit, so the sum is least over whole numbers of bits where each bit in turn goes to the coefficient
/// that gains most by it: at equality to the first. A coefficient of variance zero gets no bits, so that fewer
/// than `bits` may be given.
///
/// * `variances`: not negative, not NaN
pub fn allocate_bits(variances: &[f64], bits: u32) -> Vec<u32> {
    let mut given = vec![0; variances.len()];
    for _ in 0..bits {
        let mut most = (0.0, None);
        for (u, &variance) in variances.iter().enumerate() {
            let gain = variance * (expected_distortion(given[u]) - expected_distortion(given[u] + 1));
            if gain > most.0 {
                most = (gain, Some(u));
            }
        }
        let Some(at) = most.1 else { break };
        given[at] += 1;
    }
    given
}
