//! The time tree of an octree node: runs of steps, halved again and again, and what is known of each.
//!
//! An octree whose nodes each have such a tree is the time-space partitioning tree of ellsworth2000, section 3.

use std::ops::Range;

use crate::SpanStatistics;

/// A node of the binary time tree: the steps `index · 2^level .. (index + 1) · 2^level`, cut to the series.
///
/// Level 0 is a single step; the tree is aligned to step 0 and the same for every octree node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TimeNode {
    /// Binary logarithm of its number of steps.
    pub level: u8,
    /// Its place among those of its level.
    pub index: u32,
}

impl TimeNode {
    /// The node of a single step.
    pub fn of_step(step: u32) -> Self {
        Self { level: 0, index: step }
    }

    /// The node of a level that holds a step.
    pub fn holding(step: u32, level: u8) -> Self {
        Self { level, index: step.checked_shr(level.into()).unwrap_or(0) }
    }

    /// The node that covers a series.
    pub fn root(num_steps: u32) -> Self {
        Self { level: num_time_levels(num_steps) - 1, index: 0 }
    }

    /// Its steps, of a series of `num_steps`.
    pub fn steps(self, num_steps: u32) -> Range<u32> {
        let end = |index: u64| (index << self.level).min(num_steps.into()) as u32;
        end(self.index.into())..end(u64::from(self.index) + 1)
    }

    /// Its halves: the second has no steps where the series ends before it.
    ///
    /// # Panics
    /// At level 0.
    pub fn halves(self) -> [Self; 2] {
        let level = self.level.checked_sub(1).expect("a single step has no halves");
        [0, 1].map(|half| Self { level, index: 2 * self.index + half })
    }

    /// The nodes that are over once `step` is read, shorter ones first: those whose last step it is.
    pub fn closed_by(step: u32, num_steps: u32) -> impl Iterator<Item = Self> {
        let closes = move |node: &Self| node.steps(num_steps).end == step + 1;
        (0..num_time_levels(num_steps)).map(move |level| Self::holding(step, level)).filter(closes)
    }
}

/// Levels of the time tree of a series: the last has one node.
pub fn num_time_levels(num_steps: u32) -> u8 {
    (num_steps.max(1).next_power_of_two().ilog2() + 1) as u8
}

/// Number of time nodes of a level.
pub fn num_time_nodes(num_steps: u32, level: u8) -> u32 {
    (u64::from(num_steps).div_ceil(1 << level)) as u32
}

/// What is known of an octree node over the steps of a time node.
///
/// Of the *source's* samples at the finest level that lie in the node's box, masked ones left out, whatever the node's level.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NodeStatistics {
    /// Smallest sample, rounded down to what is stored; NaN where no sample has data, as are all numbers here.
    pub min: f64,
    /// Largest, rounded up.
    pub max: f64,
    /// Mean (ellsworth2000, eq. 1).
    pub mean: f64,
    /// Standard deviation, of the population (eq. 2).
    pub std: f64,
    /// Scalar temporal error e_st (eq. 4–6): mean over the samples of the coefficient of variation in time, guarded as
    /// [`guarded_ratio`] says. 0 exactly where `is_static`.
    pub temporal_error: f64,
    /// What is exactly so.
    pub facts: NodeFacts,
}

/// What is exactly so of an octree node over the steps of a time node, found by comparing bits, never by a computed zero.
///
/// Unlike the statistics they speak of everything that is drawn: core and apron of every finest brick in the node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct NodeFacts {
    /// All samples at all steps are the same, and none is masked.
    pub is_uniform: bool,
    /// No sample changes, nor does the mask.
    pub is_static: bool,
    /// Some sample is masked at some step.
    pub is_masked: bool,
    /// Some sample is masked at some steps only.
    pub mask_changes: bool,
}

impl NodeStatistics {
    /// Of a node without data.
    pub const EMPTY: Self = Self {
        min: f64::NAN,
        max: f64::NAN,
        mean: f64::NAN,
        std: f64::NAN,
        temporal_error: f64::NAN,
        facts: NodeFacts { is_uniform: false, is_static: true, is_masked: true, mask_changes: false },
    };

    /// Whether no sample has data.
    pub fn is_empty(&self) -> bool {
        self.mean.is_nan()
    }

    /// Scalar spatial error e_ss (ellsworth2000, eq. 3): the coefficient of variation, guarded as [`guarded_ratio`] says.
    ///
    /// 0 exactly where the node is uniform, more than 0 everywhere else.
    ///
    /// * `value_range`: largest minus smallest value of the variable
    pub fn spatial_error(&self, value_range: f64) -> f64 {
        match self.facts.is_uniform {
            true => 0.0,
            false => guarded_ratio(self.std, self.mean, value_range).max(f64::MIN_POSITIVE),
        }
    }

    /// The part of it that [`SpanStatistics`] has, of `count` samples.
    pub fn of_span(statistics: &SpanStatistics, temporal_error: f64, facts: NodeFacts) -> Self {
        let SpanStatistics { min, max, mean, std, .. } = *statistics;
        Self { min, max, mean, std, temporal_error, facts }
    }
}

/// Denominators of coefficients of variation are at least this share of the variable's range.
pub const LEAST_MEAN: f64 = 0.001;

/// Deviation over mean: the coefficient of variation of ellsworth2000 (eq. 3 and 6), finite for every mean.
///
/// `deviation / max(|mean|, 0.001 · value_range)`. Where the mean is larger in magnitude than a thousandth of the variable's range this
/// is the paper's value to rounding; below, where that explodes and at last has no value, it is the deviation in thousandths of the range.
/// Where both are 0 nothing varies, and so is the result.
///
/// * `deviation`: standard deviation, ≥ 0
/// * `value_range`: largest minus smallest value of the variable, ≥ 0
pub fn guarded_ratio(deviation: f64, mean: f64, value_range: f64) -> f64 {
    let denominator = mean.abs().max(LEAST_MEAN * value_range);
    match deviation == 0.0 {
        true => 0.0,
        false => (deviation / denominator).min(f64::MAX),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tree_halves_down_to_single_steps() {
        assert_eq!([1, 2, 3, 36, 64].map(num_time_levels), [1, 2, 3, 7, 7]);
        let root = TimeNode::root(36);
        assert_eq!(root.steps(36), 0..36);
        assert_eq!(root.halves().map(|half| half.steps(36)), [0..32, 32..36]);
        assert_eq!(TimeNode { level: 2, index: 9 }.steps(36), 36..36, "beyond the series");
        assert_eq!(TimeNode::holding(35, 3).steps(36), 32..36);
        assert_eq!([0, 1, 6].map(|level| num_time_nodes(36, level)), [36, 18, 1]);
        let all: u32 = (0..7).map(|level| num_time_nodes(36, level)).sum();
        let closed: usize = (0..36).map(|step| TimeNode::closed_by(step, 36).count()).sum();
        assert_eq!(closed, all as usize, "every node closes once");
        let last: Vec<_> = TimeNode::closed_by(35, 36).map(|node| node.steps(36)).collect();
        assert_eq!(last, [35..36, 34..36, 32..36, 32..36, 32..36, 32..36, 0..36]);
    }

    #[test]
    fn the_guard_acts_on_small_means_only() {
        // The paper's value, where the mean is more than a thousandth of the range.
        for (deviation, mean) in [(0.5, 2.0), (3.0, -0.7), (1e-9, 0.011)] {
            assert_eq!(guarded_ratio(deviation, mean, 10.0), deviation / f64::abs(mean));
        }
        // Below, the paper's value grows without bound; ours does not.
        assert_eq!(guarded_ratio(0.5, 1e-300, 10.0), 50.0);
        assert_eq!(guarded_ratio(0.5, 0.0, 10.0), 50.0);
        assert_eq!(guarded_ratio(0.0, 0.0, 10.0), 0.0);
        assert_eq!(guarded_ratio(0.0, 0.0, 0.0), 0.0);
        assert_eq!(guarded_ratio(f64::MAX, 1e-30, 0.0), f64::MAX);
    }
}
