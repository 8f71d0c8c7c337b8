//! Means and deviations of samples through time, and the coefficients of variation that follow from them.
//!
//! Runs of steps are merged by Chan's formulas, sample by sample, in the precision of the samples: both are held in it, so that
//! more on the way would not last. Sums over samples are taken in `f64`. A sample that is masked at some step of a run has NaN
//! for both and is left out of the sums.

use chronoxel_core::time_tree::LEAST_MEAN;

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
    /// Whether samples may be NaN.
    pub is_masked: bool,
    /// Largest magnitude of a sample: squares are taken in a unit that keeps them within the number range.
    pub magnitude: f64,
}

/// What the formulas weigh with, in the precision of the samples.
struct Weights<T> {
    half: T,
    left: T,
    right: T,
    /// Twice the right one, for half the difference of the means; at most 1, so that nothing overflows.
    twice_right: T,
    /// 4 · left · right, for the square of half the difference; and its root.
    apart: T,
    apart_root: T,
    /// A power of two, and its inverse.
    unit: T,
    per_unit: T,
    /// The least denominator.
    least_mean: T,
}

impl Merging {
    fn weights<T: Real>(&self) -> Weights<T> {
        let [left, right] = self.num_steps.map(f64::from);
        let all = left + right;
        let apart = 4.0 * left * right / (all * all);
        let exponent = if self.magnitude > 0.0 { self.magnitude.log2().floor() } else { 0.0 };
        // Near 1, squares are far from either end of the number range.
        let (near, most) = if size_of::<T>() == 4 { (30.0, 120.0) } else { (300.0, 1000.0) };
        let shift = if exponent.abs() > near { exponent.clamp(-most, most) as i32 } else { 0 };
        Weights {
            half: T::from_f64(0.5),
            left: T::from_f64(left / all),
            right: T::from_f64(right / all),
            twice_right: T::from_f64(2.0 * right / all),
            apart: T::from_f64(apart),
            apart_root: T::from_f64(apart.sqrt()),
            unit: T::from_f64(2f64.powi(shift)),
            per_unit: T::from_f64(2f64.powi(-shift)),
            // Above 0, so that nothing over nothing is nothing.
            least_mean: T::from_f64(LEAST_MEAN * self.value_range).at_most(T::LARGEST).at_least(T::SMALLEST),
        }
    }

    /// Merges two runs without deviations: single steps, or what does not change.
    ///
    /// * `left`: means of the first run
    /// * `means`: of the second run, replaced by those of both
    /// * `deviations`: replaced by those of both
    pub fn merge_means<T: Real>(&self, left: &[T], means: &mut [T], deviations: &mut [T]) -> ErrorSum {
        let weights = self.weights();
        match self.is_masked {
            false => merge_means::<T, false>(&weights, left, means, deviations),
            true => merge_means::<T, true>(&weights, left, means, deviations),
        }
    }

    /// Merges two runs.
    ///
    /// * `left`: means and deviations of the first
    /// * `means`, `deviations`: of the second, replaced by those of both
    pub fn merge<T: Real>(&self, left: [&[T]; 2], means: &mut [T], deviations: &mut [T]) -> ErrorSum {
        let weights = self.weights();
        match self.is_masked {
            false => merge_both::<T, false>(&weights, left, means, deviations),
            true => merge_both::<T, true>(&weights, left, means, deviations),
        }
    }
}

fn merge_means<T: Real, const MASKED: bool>(
    weights: &Weights<T>,
    left: &[T],
    means: &mut [T],
    deviations: &mut [T],
) -> ErrorSum {
    let mut sums = Sums::<MASKED>::default();
    let num_samples = means.len();
    let (left, left_rest) = left.as_chunks::<LANES>();
    let (means, means_rest) = means.as_chunks_mut::<LANES>();
    let (deviations, deviations_rest) = deviations.as_chunks_mut::<LANES>();
    for ((left, mean), deviation) in left.iter().zip(means).zip(deviations) {
        for lane in 0..LANES {
            [mean[lane], deviation[lane]] = weights.of_means(left[lane], mean[lane]);
            sums.take(lane, mean[lane], weights.ratio(mean[lane], deviation[lane]));
        }
    }
    let rest = left_rest.iter().zip(means_rest).zip(deviations_rest);
    for (lane, ((&left, mean), deviation)) in rest.enumerate() {
        [*mean, *deviation] = weights.of_means(left, *mean);
        sums.take(lane, *mean, weights.ratio(*mean, *deviation));
    }
    sums.total(num_samples)
}

fn merge_both<T: Real, const MASKED: bool>(
    weights: &Weights<T>,
    left: [&[T]; 2],
    means: &mut [T],
    deviations: &mut [T],
) -> ErrorSum {
    let mut sums = Sums::<MASKED>::default();
    let num_samples = means.len();
    let [(left_means, means_left), (left_deviations, deviations_left)] = left.map(|v| v.as_chunks::<LANES>());
    let (means, means_rest) = means.as_chunks_mut::<LANES>();
    let (deviations, deviations_rest) = deviations.as_chunks_mut::<LANES>();
    let left = left_means.iter().zip(left_deviations);
    for ((left, mean), deviation) in left.zip(means).zip(deviations) {
        for lane in 0..LANES {
            let (earlier, later) = ([left.0[lane], left.1[lane]], [mean[lane], deviation[lane]]);
            [mean[lane], deviation[lane]] = weights.of_both(earlier, later);
            sums.take(lane, mean[lane], weights.ratio(mean[lane], deviation[lane]));
        }
    }
    let left = means_left.iter().zip(deviations_left);
    for (lane, ((left, mean), deviation)) in left.zip(means_rest).zip(deviations_rest).enumerate() {
        [*mean, *deviation] = weights.of_both([*left.0, *left.1], [*mean, *deviation]);
        sums.take(lane, *mean, weights.ratio(*mean, *deviation));
    }
    sums.total(num_samples)
}

impl<T: Real> Weights<T> {
    #[inline(always)]
    fn half_apart(&self, left: T, right: T) -> T {
        self.half.times(right).minus(self.half.times(left))
    }

    /// Mean and deviation of a sample over two runs in which it does not change.
    #[inline(always)]
    fn of_means(&self, left: T, right: T) -> [T; 2] {
        let half_apart = self.half_apart(left, right);
        let mean = left.plus(self.twice_right.times(half_apart));
        [mean, self.apart_root.times(half_apart.magnitude())]
    }

    /// Mean and deviation of a sample over two runs.
    #[inline(always)]
    fn of_both(&self, left: [T; 2], right: [T; 2]) -> [T; 2] {
        let half_apart = self.half_apart(left[0], right[0]);
        let square = |v: T| v.times(self.per_unit).times(v.times(self.per_unit));
        let within = self.left.times(square(left[1])).plus(self.right.times(square(right[1])));
        let variance = within.plus(self.apart.times(square(half_apart)));
        // Rounding may leave the number range.
        let deviation = variance.root().times(self.unit).at_most(T::LARGEST);
        [left[0].plus(self.twice_right.times(half_apart)), deviation]
    }

    /// [`chronoxel_core::time_tree::guarded_ratio`] in the precision of the samples.
    #[inline(always)]
    fn ratio(&self, mean: T, deviation: T) -> T {
        deviation.over(mean.magnitude().at_least(self.least_mean)).at_most(T::LARGEST)
    }
}

/// Sums of coefficients of variation by lane.
#[derive(Default)]
struct Sums<const MASKED: bool> {
    sums: [f64; LANES],
    num_left_out: [f64; LANES],
}

impl<const MASKED: bool> Sums<MASKED> {
    #[inline(always)]
    fn take<T: Real>(&mut self, lane: usize, mean: T, ratio: T) {
        let is_left_out = MASKED && mean.is_masked();
        self.sums[lane] += if is_left_out { 0.0 } else { ratio.to_f64() };
        if MASKED {
            self.num_left_out[lane] += if is_left_out { 1.0 } else { 0.0 };
        }
    }

    fn total(&self, num_samples: usize) -> ErrorSum {
        let num_left_out = self.num_left_out.iter().sum::<f64>() as u64;
        ErrorSum { sum: self.sums.iter().sum(), count: num_samples as u64 - num_left_out }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use chronoxel_core::time_tree::guarded_ratio;

    fn merging(num_steps: [u32; 2], value_range: f64, magnitude: f64) -> Merging {
        Merging { num_steps, value_range, is_masked: true, magnitude }
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
    fn ratios_are_those_of_the_guarded_formula_in_either_precision() {
        for (mean, deviation) in [(2.0, 0.5), (-0.7, 3.0), (0.0, 0.5), (1e-4, 0.25), (0.0, 0.0)] {
            for value_range in [0.0, 10.0] {
                let expected = guarded_ratio(deviation, mean, value_range);
                let merge = merging([1, 1], value_range, 1.0);
                let single = merge.weights::<f32>().ratio(mean as f32, deviation as f32);
                let double = merge.weights::<f64>().ratio(mean, deviation);
                assert!((double - expected).abs() <= 1e-15 * expected, "{double} {expected}");
                let expected = expected.min(f32::MAX.into());
                assert!((f64::from(single) - expected).abs() <= 2e-7 * expected, "{single} {expected}");
            }
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
