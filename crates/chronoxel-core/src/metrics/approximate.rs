//! The approximate metrics: from the statistics of a node and the table of the transfer function alone.

use crate::{NodeStatistics, ResolvedTransfer};

use super::table::{ColorTable, LANES};
use super::{ColorSpace, ratio};

/// What the approximate spatial metric says of a node.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ColorEstimate {
    /// e_acs (eq. 19).
    pub error: f64,
    /// Mean colour: sRGB, opacity per unit length (eq. 16).
    pub mean: [f32; 4],
}

/// Whether every value between the smallest and the largest of a node looks the same: where spatial errors are 0.
///
/// So it is exactly where the node is uniform, where it is not masked and the transfer function is constant over its range, where
/// all of its range is transparent, and where it has no data. This speaks of the samples that statistics count, in the node's box;
/// what is drawn across its faces also depends on its neighbours'.
pub fn has_one_color(transfer: &ResolvedTransfer, node: &NodeStatistics) -> bool {
    let range = [node.min, node.max];
    node.is_empty()
        || node.facts.is_uniform
        || (!node.facts.is_masked && transfer.is_constant_over(range))
        || transfer.is_transparent_over(range)
}

/// Approximate spatial error and mean colour of a node (ellsworth2000, eq. 14–19).
///
/// The samples are taken as normally distributed over the entries from that of the smallest to that of the largest. The result is that of the
/// equations to 1e-11; where no entry within e^-600 of the most frequent one is visible, the error is [`f64::MIN_POSITIVE`].
///
/// The error is 0 exactly where [`has_one_color`], and there the mean is the colour of the mean sample: all zeros where there is no data.
pub fn approximate_spatial(
    table: &ColorTable,
    transfer: &ResolvedTransfer,
    node: &NodeStatistics,
) -> ColorEstimate {
    match has_one_color(transfer, node) {
        true => ColorEstimate { error: 0.0, mean: transfer.evaluate(node.mean).map(|c| c as f32) },
        false => estimate(table, &Population::new(table, node)),
    }
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
    /// The entry that the first share is of, a multiple of [`LANES`].
    start: usize,
    /// p(j) (eq. 14), its largest 1 or nearly so, 0 where the node has no samples; a multiple of [`LANES`] of them.
    shares: Vec<f64>,
}

impl Population {
    fn new(table: &ColorTable, node: &NodeStatistics) -> Self {
        let first = table.entry(node.min);
        let last = table.entry(node.max).max(first);
        let start = first / LANES * LANES;
        let position = table.position(node.mean);
        let peak = position.round().clamp(first as f64, last as f64);
        // The largest exponent is subtracted: (j − x)² − (peak − x)² = (j − peak) (j − peak + 2 (peak − x)).
        let twice_off = 2.0 * (peak - position);
        let std = table.in_entries(node.std);
        let narrowness = if std > 0.0 { (0.5 / (std * std)).min(1e300) } else { 1e300 };
        let mut shares = vec![0.0; (last + 1).next_multiple_of(LANES) - start];
        let mut from_peak = start as f64 - peak;
        for group in shares.as_chunks_mut::<LANES>().0 {
            *group = exp_of_negative(std::array::from_fn(|lane| {
                let j = from_peak + lane as f64;
                -(j * (j + twice_off)) * narrowness
            }));
            from_peak += LANES as f64;
        }
        shares[..first - start].fill(0.0);
        shares[last + 1 - start..].fill(0.0);
        Self { start, shares }
    }

    fn groups<'a>(&self, of_entries: &'a [f64]) -> &'a [[f64; LANES]] {
        of_entries[self.start..][..self.shares.len()].as_chunks().0
    }

    /// p_tot (eq. 15): at least nearly 1, the share of the entry nearest the mean sample.
    fn total(&self) -> f64 {
        let mut sums = [0.0; LANES];
        for p in self.shares.as_chunks::<LANES>().0 {
            (0..LANES).for_each(|lane| sums[lane] += p[lane]);
        }
        sums.iter().sum()
    }

    /// Sum over the entries of p(j) times a value.
    fn sum(&self, of_entries: &[f64]) -> f64 {
        let mut sums = [0.0; LANES];
        for (p, x) in self.shares.as_chunks::<LANES>().0.iter().zip(self.groups(of_entries)) {
            (0..LANES).for_each(|lane| sums[lane] += p[lane] * x[lane]);
        }
        sums.iter().sum()
    }

    /// Sum over the entries of p(j) times the distance from a colour (eq. 18): after the mean is known, so that nothing cancels.
    fn sum_of_distances(&self, table: &ColorTable, color: [f64; 3], alpha: f64) -> f64 {
        let opacity = self.groups(&table.opacity);
        let coordinates = table.coordinates().each_ref().map(|values| self.groups(values));
        let mut sums = [0.0; LANES];
        for ((i, p), a) in self.shares.as_chunks::<LANES>().0.iter().enumerate().zip(opacity) {
            let mut apart = [0.0; LANES];
            for (of_entries, mean) in coordinates.iter().zip(color) {
                let x = of_entries[i];
                (0..LANES).for_each(|lane| apart[lane] += (x[lane] - mean) * (x[lane] - mean));
            }
            for lane in 0..LANES {
                let alpha_apart = a[lane] - alpha;
                sums[lane] += p[lane] * (a[lane] * apart[lane] + alpha_apart * alpha_apart);
            }
        }
        sums.iter().sum()
    }
}

fn estimate(table: &ColorTable, population: &Population) -> ColorEstimate {
    let total = population.total();
    let mean = |of_entries: &Vec<f64>| population.sum(of_entries) / total;
    let alpha = mean(&table.opacity);
    let color = table.coordinates().each_ref().map(mean);
    let squared_deviation = population.sum_of_distances(table, color, alpha) / total;
    let [r, g, b] = match table.space() {
        ColorSpace::Rgb => color,
        ColorSpace::Luv => table.srgb.each_ref().map(mean),
    };
    ColorEstimate { error: ratio(squared_deviation, color, alpha), mean: [r, g, b, alpha].map(|c| c as f32) }
}

/// Below this, e^x is taken as 0: products with the smallest opacities stay normal numbers.
const LOWEST_EXPONENT: f64 = -600.0;

/// e^x for x ≤ 0, within 2e-14 of it relatively; 0 below −600.
///
/// The Taylor polynomial of degree 11 over ±ln 2 / 2, scaled by a power of two: plain arithmetic without branches, which compilers turn into
/// vector instructions.
#[inline]
fn exp_of_negative(x: [f64; LANES]) -> [f64; LANES] {
    const LN_2_HIGH: f64 = 0.693_147_180_369_123_8;
    const LN_2_LOW: f64 = 1.908_214_929_270_587_7e-10;
    /// 1.5 · 2^52: what is added to it is rounded to a whole number, which its lowest bits then are.
    const ROUNDER: f64 = 6_755_399_441_055_744.0;
    const INVERSE_FACTORIALS: [f64; 12] = [
        1.0 / 39_916_800.0,
        1.0 / 3_628_800.0,
        1.0 / 362_880.0,
        1.0 / 40_320.0,
        1.0 / 5040.0,
        1.0 / 720.0,
        1.0 / 120.0,
        1.0 / 24.0,
        1.0 / 6.0,
        0.5,
        1.0,
        1.0,
    ];
    let inside = x.map(|x| if x > LOWEST_EXPONENT { x } else { LOWEST_EXPONENT });
    let rounded = inside.map(|x| x * std::f64::consts::LOG2_E + ROUNDER);
    let rest: [f64; LANES] = std::array::from_fn(|lane| {
        let whole = rounded[lane] - ROUNDER;
        (inside[lane] - whole * LN_2_HIGH) - whole * LN_2_LOW
    });
    let mut polynomial = [INVERSE_FACTORIALS[0]; LANES];
    for c in &INVERSE_FACTORIALS[1..] {
        (0..LANES).for_each(|lane| polynomial[lane] = polynomial[lane] * rest[lane] + c);
    }
    let scaled: [f64; LANES] = std::array::from_fn(|lane| {
        polynomial[lane] * f64::from_bits((rounded[lane].to_bits() << 52).wrapping_add(1.0f64.to_bits()))
    });
    std::array::from_fn(|lane| if x[lane] < LOWEST_EXPONENT { 0.0 } else { scaled[lane] })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_is_that_of_the_standard_library() {
        for i in 0..100_000 {
            let x = -f64::from(i) * 0.006 + f64::from(i % 7) * -1e-4;
            let (found, expected) = (exp_of_negative([x; LANES])[3], x.exp());
            assert!((found - expected).abs() <= 2e-14 * expected, "{x}: {found:e} {expected:e}");
        }
        let ends = [0.0, -0.0, -5e-324, -600.1, f64::MIN, f64::NEG_INFINITY, -1e-17, -600.0];
        let [zero, negative_zero, tiny, below, lowest, infinite, small, last] = exp_of_negative(ends);
        assert_eq!(
            [zero, negative_zero, tiny, below, lowest, infinite, small],
            [1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        );
        assert!(last > 2.6e-261 && last < 2.7e-261);
    }
}
