//! Bits for the coefficients of a transform by their variances.

/// Bits for each coefficient, `bits` together, so that the expected square error is least.
///
/// The square error of a coefficient of variance `v` quantised with `b` bits falls as `v / 4^b` (lum2001, section 3.3, after
/// the theory of transform coding), and the sum is least over whole numbers of bits where each bit in turn goes to the
/// coefficient of largest `v / 4^b`: at equality to the first. A coefficient of variance zero gets no bits, so that fewer
/// than `bits` may be given.
///
/// * `variances`: not negative, not NaN
pub fn allocate_bits(variances: &[f64], bits: u32) -> Vec<u32> {
    let mut given = vec![0; variances.len()];
    let mut errors = variances.to_vec();
    for _ in 0..bits {
        let mut most = 0.0;
        let mut at = None;
        for (u, &error) in errors.iter().enumerate() {
            if error > most {
                (most, at) = (error, Some(u));
            }
        }
        let Some(at) = at else { break };
        given[at] += 1;
        errors[at] /= 4.0;
    }
    given
}
