//! Means and deviations of samples through time, and the coefficients of variation that follow from them.
//!
//! Runs of steps are merged by Chan's formulas, sample by sample, in `f64`. A sample that is masked at some step of a run has
//! NaN for both and is left out of the sums.

use chronoxel_core::time_tree::guarded_ratio;

use super::super::real::Real;

/// Lanes of the reductions: fixed, so that results do not depend on the machine.
const LANES: usize = 8;

/// Coefficients of variation, summed over the samples that have data at every step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ErrorSum {
    /// Their sum.
    pub sum: f64,
    /// Number of samples.
    pub count: u64,
}

impl ErrorSum {
    /// Over the samples of both.
    pub fn plus(self, other: Self) -> Self {
        Self { sum: self.sum + other.sum, count: self.count + other.count }
    }

    /// Over `num` samples that are all alike.
    pub fn times(self, num: u64) -> Self {
        Self { sum: (self.sum * num as f64).min(f64::MAX), count: self.count * num }
    }

    /// The mean over the samples, 0 where there is none.
    pub fn mean(self) -> f64 {
        (self.sum / self.count.max(1) as f64).min(f64::MAX)
    }
}

/// How two runs are merged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Merging {
    /// Steps of each run; the first is not the shorter one.
    pub num_steps: [u32; 2],
    /// Largest minus smallest value of the variable, for the guard of small means.
    pub value_range: f64,
    /// Largest magnitude of a sample: squares are taken in a unit that keeps them within the number range.
    pub magnitude: f64,
}

/// Weights of the formulas.
struct Weights {
    left: f64,
    right: f64,
    /// Twice the right one, for half the difference of the means; at most 1, so that nothing overflows.
    twice_right: f64,
    /// 4 · left · right, for the square of half the difference.
    apart: f64,
    /// A power of two, and its inverse.
    unit: f64,
    per_unit: f64,
}

impl Merging {
    fn weights(&self) -> Weights {
        let [left, right] = self.num_steps.map(f64::from);
        let all = left + right;
        let exponent = if self.magnitude > 0.0 { self.magnitude.log2().floor() } else { 0.0 };
        // Squares of magnitudes within 2^±300 are far from either end.
        let shift = if exponent.abs() > 300.0 { exponent.clamp(-1000.0, 1000.0) as i32 } else { 0 };
        Weights {
            left: left / all,
            right: right / all,
            twice_right: 2.0 * right / all,
            apart: 4.0 * left * right / (all * all),
            unit: 2f64.powi(shift),
            per_unit: 2f64.powi(-shift),
        }
    }

    /// Merges two runs without deviations: single steps, or what does not change.
    ///
    /// * `left`: means of the first run
    /// * `means`: of the second run, replaced by those of both
    /// * `deviations`: replaced by those of both
    pub fn merge_means<T: Real>(&self, left: &[T], means: &mut [T], deviations: &mut [T]) -> ErrorSum {
        let weights = self.weights();
        let apart = weights.apart.sqrt();
        let (left, left_rest) = left.as_chunks::<LANES>();
        let (means, means_rest) = means.as_chunks_mut::<LANES>();
        let (deviations, deviations_rest) = deviations.as_chunks_mut::<LANES>();
        let mut sums = Sums::new(self);
        let mut take = |lane: usize, left: T, mean: &mut T, deviation: &mut T| {
            let half_apart = 0.5 * mean.to_f64() - 0.5 * left.to_f64();
            let merged = [left.to_f64() + weights.twice_right * half_apart, apart * half_apart.abs()];
            sums.take(lane, merged);
            [*mean, *deviation] = merged.map(T::from_f64);
        };
        for ((left, mean), deviation) in left.iter().zip(means).zip(deviations) {
            for lane in 0..LANES {
                take(lane, left[lane], &mut mean[lane], &mut deviation[lane]);
            }
        }
        let rest = left_rest.iter().zip(means_rest).zip(deviations_rest);
        for (lane, ((&left, mean), deviation)) in rest.enumerate() {
            take(lane, left, mean, deviation);
        }
        sums.total()
    }

    /// Merges two runs.
    ///
    /// * `left`: means and deviations of the first
    /// * `means`, `deviations`: of the second, replaced by those of both
    pub fn merge<T: Real>(&self, left: [&[T]; 2], means: &mut [T], deviations: &mut [T]) -> ErrorSum {
        let weights = self.weights();
        let [(left_means, means_left), (left_deviations, deviations_left)] =
            left.map(|v| v.as_chunks::<LANES>());
        let (means, means_rest) = means.as_chunks_mut::<LANES>();
        let (deviations, deviations_rest) = deviations.as_chunks_mut::<LANES>();
        let mut sums = Sums::new(self);
        let mut take = |lane: usize, left: [T; 2], mean: &mut T, deviation: &mut T| {
            let merged = weights.merged(left.map(T::to_f64), [mean.to_f64(), deviation.to_f64()]);
            sums.take(lane, merged);
            [*mean, *deviation] = merged.map(T::from_f64);
        };
        let left = left_means.iter().zip(left_deviations);
        for ((left, mean), deviation) in left.zip(means).zip(deviations) {
            for lane in 0..LANES {
                take(lane, [left.0[lane], left.1[lane]], &mut mean[lane], &mut deviation[lane]);
            }
        }
        let left = means_left.iter().zip(deviations_left);
        for (lane, ((left, mean), deviation)) in left.zip(means_rest).zip(deviations_rest).enumerate() {
            take(lane, [*left.0, *left.1], mean, deviation);
        }
        sums.total()
    }
}

impl Weights {
    /// Mean and deviation of both runs of a sample.
    #[inline(always)]
    fn merged(&self, left: [f64; 2], right: [f64; 2]) -> [f64; 2] {
        let half_apart = 0.5 * right[0] - 0.5 * left[0];
        let square = |v: f64| (v * self.per_unit) * (v * self.per_unit);
        let variance =
            self.left * square(left[1]) + self.right * square(right[1]) + self.apart * square(half_apart);
        let deviation = variance.sqrt() * self.unit;
        // Rounding may leave the number range; NaN stays.
        let deviation = if deviation > f64::MAX { f64::MAX } else { deviation };
        [left[0] + self.twice_right * half_apart, deviation]
    }
}

/// Sums of coefficients of variation by lane.
struct Sums {
    value_range: f64,
    sums: [f64; LANES],
    counts: [f64; LANES],
}

impl Sums {
    fn new(merging: &Merging) -> Self {
        Self { value_range: merging.value_range, sums: [0.0; LANES], counts: [0.0; LANES] }
    }

    #[inline(always)]
    fn take(&mut self, lane: usize, [mean, deviation]: [f64; 2]) {
        let ratio = guarded_ratio(deviation, mean, self.value_range);
        let (ratio, one) = if mean.is_nan() { (0.0, 0.0) } else { (ratio, 1.0) };
        self.sums[lane] += ratio;
        self.counts[lane] += one;
    }

    fn total(&self) -> ErrorSum {
        ErrorSum { sum: self.sums.iter().sum(), count: self.counts.iter().sum::<f64>() as u64 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn merging(num_steps: [u32; 2], value_range: f64, magnitude: f64) -> Merging {
        Merging { num_steps, value_range, magnitude }
    }

    #[test]
    fn runs_of_different_lengths_merge_to_moments_of_all_steps() {
        // Samples 1, 5, 3 and then 7: mean 4, deviation √5; with fewer samples than lanes, and more.
        for num in [1, 7, 8, 19] {
            let [mut means, mut deviations] = [vec![7.0f32; num], vec![0.0; num]];
            let left = [vec![3.0f32; num], vec![(8.0f32 / 3.0).sqrt(); num]];
            let errors = merging([3, 1], 6.0, 7.0).merge([&left[0], &left[1]], &mut means, &mut deviations);
            assert_eq!(errors.count, num as u64);
            assert!((errors.mean() - 5f64.sqrt() / 4.0).abs() < 1e-7, "{errors:?}");
            assert!(
                means.iter().all(|m| *m == 4.0) && deviations.iter().all(|d| (d - 5f32.sqrt()).abs() < 1e-6)
            );
        }
    }

    #[test]
    fn what_is_masked_at_some_step_stays_so_and_is_left_out() {
        let nan = f64::NAN;
        let left = [1.0, nan, 3.0, nan];
        let [mut means, mut deviations] = [[3.0, 1.0, nan, nan], [0.0; 4]];
        let errors = merging([1, 1], 2.0, 3.0).merge_means(&left, &mut means, &mut deviations);
        assert_eq!(errors, ErrorSum { sum: 0.5, count: 1 });
        let [mut after, mut none] = [[2.0; 4], [0.0; 4]];
        let errors = merging([2, 1], 2.0, 3.0).merge([&means, &deviations], &mut after, &mut none);
        // 1, 3, 2: mean 2, variance 2/3.
        assert_eq!(errors.count, 1);
        assert!((errors.sum - (2f64 / 3.0).sqrt() / 2.0).abs() < 1e-15);
        assert!(after[0] == 2.0 && after[1..].iter().all(|v| v.is_nan()));
    }

    #[test]
    fn the_ends_of_the_number_range_merge() {
        for size in [f64::MAX, 1e300, 1.0, 1e-300] {
            let [mut means, mut deviations] = [[-size; 2], [0.0; 2]];
            let merge = merging([1, 1], size, size);
            let errors = merge.merge_means(&[size; 2], &mut means, &mut deviations);
            assert!((errors.mean() / 1000.0 - 1.0).abs() < 1e-15);
            assert_eq!((means, deviations), ([0.0; 2], [size; 2]));
            let errors = merge.merge([&[0.0; 2], &[size; 2]], &mut means, &mut deviations);
            assert!(
                (errors.mean() / 1000.0 - 1.0).abs() < 1e-15 && (deviations[0] / size - 1.0).abs() < 1e-15
            );
        }
        // Without a range there is no guard; the ratio stays finite.
        let [mut means, mut deviations] = [[-1e-320], [0.0]];
        let errors = merging([1, 1], 0.0, 1.0).merge_means(&[1.0], &mut means, &mut deviations);
        assert_eq!(errors.mean(), 1.0);
    }
}
