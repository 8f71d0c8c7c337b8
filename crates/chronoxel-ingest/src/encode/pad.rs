//! Padding: masked samples get values before coding, so that they neither widen the range nor show.

use super::real::Real;

/// Replaces masked samples of a brick: next to unmasked ones by the mean of those among the 26 neighbours,
/// elsewhere by the mean of all unmasked samples.
///
/// * `samples`: `edge`³ samples, `[z, y, x]`, at least one of them unmasked
/// * `whole_numbers`: whether all samples are whole numbers, and pads must be
///
/// All values written lie within the range of the unmasked samples.
pub fn pad<T: Real>(samples: &mut [T], edge: usize, whole_numbers: bool) {
    let (sum, count) = mean_of(samples.iter().copied());
    assert!(count > 0, "a brick without data is not coded");
    let (low, high) =
        samples.iter().filter(|v| !v.is_masked()).fold((T::LARGEST, T::LARGEST.negated()), |r, &v| {
            (if v < r.0 { v } else { r.0 }, if v > r.1 { v } else { r.1 })
        });
    let within = |value: f64| {
        let value = if whole_numbers { value.round_ties_even() } else { value };
        T::from_f64(value.clamp(low.to_f64(), high.to_f64()))
    };
    let overall = within(sum);
    let pads: Vec<(usize, T)> = (0..samples.len())
        .filter(|&i| samples[i].is_masked())
        .map(|i| match mean_of(neighbours(i, edge).map(|n| samples[n])) {
            (mean, 1..) => (i, within(mean)),
            (_, 0) => (i, overall),
        })
        .collect();
    for (i, value) in pads {
        samples[i] = value;
    }
}

/// Mean and number of the unmasked ones; a running mean, which cannot overflow.
fn mean_of<T: Real>(values: impl Iterator<Item = T>) -> (f64, usize) {
    values.filter(|v| !v.is_masked()).fold((0.0, 0), |(mean, n), v| {
        let n1 = (n + 1) as f64;
        (mean * (n as f64 / n1) + v.to_f64() / n1, n + 1)
    })
}

/// Indices of the up to 26 neighbours of a sample (and of the sample itself, which is masked).
fn neighbours(index: usize, edge: usize) -> impl Iterator<Item = usize> {
    let place = [index % edge, index / edge % edge, index / (edge * edge)];
    let range = move |a: usize| place[a].saturating_sub(1)..=(place[a] + 1).min(edge - 1);
    range(2).flat_map(move |z| range(1).flat_map(move |y| range(0).map(move |x| x + edge * (y + edge * z))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbours_are_averaged_and_the_rest_gets_the_mean() {
        let mut samples = vec![f32::NAN; 125];
        samples[0] = 2.0;
        samples[1] = 4.0;
        pad(&mut samples, 5, false);
        assert_eq!(samples[5], 3.0); // (0, 1, 0) touches both
        assert_eq!(samples[2], 4.0); // (2, 0, 0) touches the second alone
        assert_eq!(samples[124], 3.0); // touches none
        assert_eq!(samples[..2], [2.0, 4.0]);
    }

    #[test]
    fn pads_stay_within_the_range_of_huge_samples() {
        let mut samples = vec![f64::NAN; 27];
        samples[3] = f64::MAX;
        samples[4] = f64::MAX;
        pad(&mut samples, 3, false);
        assert!(samples.iter().all(|&v| v == f64::MAX));
    }
}
