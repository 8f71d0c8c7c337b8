//! The approximate metrics: from the statistics of a node and the table of the transfer function alone.

use crate::{NodeStatistics, ResolvedTransfer};

use super::table::{ColorTable, LANES};
use super::{dot, ratio};

/// What the approximate spatial metric says of a node.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColorEstimate {
    /// e_acs (eq. 19).
    pub error: f64,
    /// Mean colour: sRGB, opacity per unit length (eq. 16).
    pub mean: [f32; 4],
}

/// Approximate spatial error and mean colour of a node (ellsworth2000, eq. 14–19).
///
/// The samples are taken as normally distributed over the entries from that of the smallest to that of the largest.
/// The error is 0 exactly where the node is uniform, where it is not masked and the transfer function is constant over its range, where
/// all of its range is transparent, and where it has no data. There the mean is the colour of the mean sample, exactly.
pub fn approximate_spatial(
    table: &ColorTable,
    transfer: &ResolvedTransfer,
    node: &NodeStatistics,
) -> ColorEstimate {
    if node.is_empty() {
        return ColorEstimate { error: 0.0, mean: [0.0; 4] };
    }
    let range = [node.min, node.max];
    let is_one_color = node.facts.is_uniform
        || (!node.facts.is_masked && transfer.is_constant_over(range))
        || transfer.is_transparent_over(range);
    if is_one_color {
        return ColorEstimate { error: 0.0, mean: transfer.evaluate(node.mean).map(|c| c as f32) };
    }
    estimate(table, &Population::new(table, node))
}

/// Approximate temporal error of a node (ellsworth2000, eq. 20).
///
/// 0 exactly where the node is static, or all values of the variable have one colour and the mask does not change what is seen.
pub fn approximate_temporal(table: &ColorTable, node: &NodeStatistics) -> f64 {
    let is_one_color = table.is_known_uniform_over([node.min, node.max])
        && (table.is_transparent() || !node.facts.mask_changes);
    if node.facts.is_static || is_one_color {
        return 0.0;
    }
    // The maximum takes a NaN, of a node in which no sample has data at every step, to the smallest of all errors.
    let error = f64::MIN_POSITIVE.max(node.temporal_error * table.temporal_scale());
    error.min(f64::MAX)
}

/// How many samples of a node each entry is thought to have, up to a factor.
struct Population {
    /// The first entry of `shares`, a multiple of [`LANES`].
    start: usize,
    /// p(j) (eq. 14), 1 at its largest; a multiple of [`LANES`] of them.
    shares: Vec<f64>,
}

impl Population {
    fn new(table: &ColorTable, node: &NodeStatistics) -> Self {
        let (first, last) = (table.entry(node.min), table.entry(node.max).max(table.entry(node.min)));
        let start = first / LANES * LANES;
        let position = table.position(node.mean);
        let peak = position.round().clamp(first as f64, last as f64);
        // The exponent relative to the largest: (j − x)² − (peak − x)² = (j − peak) (j − peak + 2 (peak − x)).
        let twice_off = 2.0 * (peak - position);
        let std = table.position(node.std) - table.position(0.0);
        let narrowness = match std > 0.0 {
            true => (0.5 / (std * std)).min(1e300),
            false => 1e300,
        };
        let share = |j: usize| {
            let from_peak = j as f64 - peak;
            exp_of_negative(-(from_peak * (from_peak + twice_off)) * narrowness)
        };
        let mut shares: Vec<f64> = (start..(last + 1).next_multiple_of(LANES)).map(share).collect();
        shares[..first - start].fill(0.0);
        shares[last + 1 - start..].fill(0.0);
        Self { start, shares }
    }
}

fn estimate(table: &ColorTable, population: &Population) -> ColorEstimate {
    let shares = &population.shares;
    let window = |values: &'_ Vec<f64>| values[population.start..][..shares.len()].to_vec();
    let total: f64 = shares.iter().sum();
    let mean = |values: &Vec<f64>| window(values).iter().zip(shares).map(|(v, p)| v * p).sum::<f64>() / total;
    let alpha = mean(&table.opacity);
    let coordinates = table.coordinates();
    let color = [0, 1, 2].map(|i| mean(&coordinates[i]));
    let deviation = |k: usize| {
        let j = population.start + k;
        let apart = [0, 1, 2].map(|i| coordinates[i][j] - color[i]);
        let a = table.opacity[j];
        shares[k] * (a * dot(apart, apart) + (a - alpha) * (a - alpha))
    };
    let squared = (0..shares.len()).map(deviation).sum::<f64>() / total;
    let [r, g, b] = [0, 1, 2].map(|i| mean(&table.srgb[i]));
    ColorEstimate { error: ratio(squared, color, alpha), mean: [r, g, b, alpha].map(|c| c as f32) }
}

fn exp_of_negative(x: f64) -> f64 {
    x.min(0.0).exp()
}
