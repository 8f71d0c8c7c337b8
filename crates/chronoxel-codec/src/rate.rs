//! Rate control: for each brick, ways to code a run of steps with their stored bytes and squared errors, and the choice
//! among them at equal slope.
//!
//! At a given *slope* (squared error that one stored bit must save) every brick has one best way, [`rate_points`], and
//! bricks coded at one slope together have the least squared error for the bytes they take (Shoham and
//! Gersho 1988). [`choose_points`] looks for the slopes near a budget, and [`allocate`] chooses among the points that all
//! bricks have there.

mod points;

use std::{cmp::Ordering, collections::BinaryHeap};

pub use points::{CodedPiece, Piece, RateOptions, RatePoint, Run, rate_points};

/// Slopes are tried in steps of this factor at first.
const FIRST_FACTOR: f64 = 16.0;
/// Slopes near a budget, as factors of the one that is expected to meet it.
const FACTORS_NEAR: [f64; 3] = [0.3, 1.0, 3.0];

/// Slopes around one that suited bricks alike.
const FACTORS_AROUND: [f64; 2] = [0.4, 2.5];

/// Bricks on which all rates are tried.
const NUM_PROBED: usize = 4;
/// Neighbouring slopes around a budget differ by no more than this factor.
const CLOSE: f64 = 4.0;
/// Bricks that take this part of a budget have met it.
const MET: f64 = 0.97;
/// Most rounds of looking for slopes.
const MOST_ROUNDS: usize = 12;

/// For each of a group of bricks the way to code it, so that the sum of the squared errors is small and the bytes fit the
/// budget; they exceed it only where the bricks do as constants.
///
/// All rates are tried on a few bricks, the rates that this suggests on all, and where these miss the budget, others.
///
/// * `num_bricks`: bricks of the group; the result depends on no others
/// * `range`: width of the variable's range, > 0
/// * `start`: the slope of bricks that went before, where there are any: no few are tried first then, and the budget stretches
///   towards that slope, half of the way in logarithms, so that errors are alike from group to group
/// * `most_bytes`: how far it may stretch
/// * `evaluate`: for each of the bricks named the [`rate_points`] at the slopes named
///
/// Returns the slope near the budget too, to start from with bricks like these.
///
/// # Errors
/// Those of `evaluate`.
pub fn choose_points<E>(
    num_bricks: usize,
    range: f64,
    budget_bytes: u64,
    start: Option<f64>,
    most_bytes: u64,
    mut evaluate: impl FnMut(&[usize], &[f64]) -> Result<Vec<Vec<RatePoint>>, E>,
) -> Result<(Vec<RatePoint>, f64), E> {
    let all: Vec<usize> = (0..num_bricks).collect();
    let mut slopes = match start {
        Some(slope) => FACTORS_AROUND.map(|factor| slope * factor).to_vec(),
        None => {
            let probed: Vec<usize> =
                all.iter().copied().step_by(num_bricks.div_ceil(NUM_PROBED).max(1)).collect();
            let first = first_slopes(range);
            let bytes = bytes_of(&evaluate(&probed, &first)?, first.len());
            let share = probed.len() as f64 / num_bricks.max(1) as f64;
            slopes_for(&first, &bytes, (budget_bytes as f64 * share) as u64)
        }
    };
    let mut points: Vec<Vec<RatePoint>> = vec![Vec::new(); num_bricks];
    let mut tried: Vec<(f64, u64)> = Vec::new();
    for _ in 0..MOST_ROUNDS {
        let found = evaluate(&all, &slopes)?;
        tried.extend(slopes.iter().copied().zip(bytes_of(&found, slopes.len())));
        tried.sort_by(|a, b| a.0.total_cmp(&b.0));
        points.iter_mut().zip(found).for_each(|(points, found)| points.extend(found));
        let Some(slope) = next_slope(&tried, budget_bytes, range) else { break };
        slopes = vec![slope];
    }
    let mut slope = slope_at(&tried, budget_bytes);
    let mut bytes = budget_bytes;
    if let Some(start) = start {
        slope = (start * slope).sqrt();
        bytes = bytes_at(&tried, slope).clamp(budget_bytes / 3, most_bytes.max(budget_bytes));
    }
    let chosen = allocate(&points, bytes);
    let chosen = chosen.into_iter().zip(points).map(|(at, mut points)| points.swap_remove(at));
    Ok((chosen.collect(), slope))
}

/// The bytes that bricks take at a slope, as near as those tried tell.
///
/// * `tried`: slopes, increasing, and the bytes that all bricks take there, at least one
fn bytes_at(tried: &[(f64, u64)], slope: f64) -> u64 {
    let at = tried.partition_point(|&(tried, _)| tried < slope);
    if at == 0 || at == tried.len() {
        return tried[at.min(tried.len() - 1)].1;
    }
    let [(low, more), (high, less)] = [tried[at - 1], tried[at]];
    let part = libm::log(slope / low) / libm::log(high / low);
    (more as f64 + part * (less as f64 - more as f64)) as u64
}

/// The slope at which bricks take the budget, as near as those tried tell.
///
/// * `tried`: slopes, increasing, and the bytes that all bricks take there
fn slope_at(tried: &[(f64, u64)], budget_bytes: u64) -> f64 {
    match tried.iter().position(|&(_, bytes)| bytes <= budget_bytes) {
        None => tried.last().map_or(0.0, |&(slope, _)| slope),
        Some(0) => tried[0].0,
        Some(at) => {
            let [(low, more), (high, less)] = [tried[at - 1], tried[at]];
            between(low, high, more, less, budget_bytes)
        }
    }
}

/// Bytes of all bricks together at each slope.
fn bytes_of(points: &[Vec<RatePoint>], num_slopes: usize) -> Vec<u64> {
    (0..num_slopes).map(|s| points.iter().map(|points| points[s].bytes).sum()).collect()
}

/// A slope to try beside those tried, unless they surround the budget closely.
///
/// * `tried`: slopes, increasing, and the bytes that all bricks take there
fn next_slope(tried: &[(f64, u64)], budget_bytes: u64, range: f64) -> Option<f64> {
    let (&(smallest, most), &(largest, _)) = (tried.first()?, tried.last()?);
    match tried.iter().position(|&(_, bytes)| bytes <= budget_bytes) {
        None => (largest < range * range * 1e3).then_some(largest * FIRST_FACTOR),
        Some(0) => {
            let met = most as f64 >= MET * budget_bytes as f64 || smallest < range * range * 1e-15;
            (!met).then_some(smallest / FIRST_FACTOR)
        }
        Some(at) => {
            let [(low, more), (high, less)] = [tried[at - 1], tried[at]];
            let between = || between(low, high, more, less, budget_bytes).clamp(low * 2.0, high / 2.0);
            (high > CLOSE * low && less as f64 <= MET * budget_bytes as f64).then(between)
        }
    }
}

/// The slope between two at which the bytes would be those given, both in logarithms.
fn between(low: f64, high: f64, more: u64, less: u64, bytes: u64) -> f64 {
    let log = |b: u64| libm::log(b.max(1) as f64);
    let part = if more > less { (log(more) - log(bytes)) / (log(more) - log(less)) } else { 1.0 };
    low * libm::exp(part.clamp(0.0, 1.0) * libm::log(high / low))
}

/// Slopes from that of 16 bits a sample to that of next to none, increasing.
///
/// * `range`: width of the variable's range, > 0
pub fn first_slopes(range: f64) -> Vec<f64> {
    let coarsest = range * range / 16.0;
    (0..9).rev().map(|k| coarsest / FIRST_FACTOR.powi(k)).collect()
}

/// Slopes near the one at which the bricks tried would take the budget, increasing.
///
/// * `slopes`: those tried, increasing, at least one
/// * `bytes`: what the bricks took at each, all bricks together
/// * `budget_bytes`: what they may take
fn slopes_for(slopes: &[f64], bytes: &[u64], budget_bytes: u64) -> Vec<f64> {
    let fits = bytes.iter().position(|&b| b <= budget_bytes);
    let at = match fits {
        Some(0) => slopes[0],
        None => slopes[slopes.len() - 1],
        Some(i) => between(slopes[i - 1], slopes[i], bytes[i - 1], bytes[i], budget_bytes),
    };
    FACTORS_NEAR.iter().map(|factor| at * factor).collect()
}

/// A step up the lower convex hull of a brick's points: to a point of more bytes and less error.
struct Upgrade {
    /// Squared error saved per byte.
    gain: f64,
    brick: usize,
    /// Place in the hull of the brick.
    to: usize,
}

impl Ord for Upgrade {
    /// The greatest gain first, then the first brick.
    fn cmp(&self, other: &Self) -> Ordering {
        self.gain.total_cmp(&other.gain).then(other.brick.cmp(&self.brick))
    }
}

impl PartialOrd for Upgrade {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Upgrade {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Upgrade {}

/// For each brick the point to take, so that the sum of the squared errors is small and the bytes fit the budget.
///
/// Every brick starts at its cheapest point and climbs its lower convex hull; the step that saves most squared error
/// per byte always goes first, and a brick whose next step does not fit stays where it is. The bytes exceed the
/// budget only where even the cheapest points do.
///
/// * `points`: for each brick at least one
pub fn allocate(points: &[Vec<RatePoint>], budget_bytes: u64) -> Vec<usize> {
    let hulls: Vec<Vec<usize>> = points.iter().map(|points| lower_hull(points)).collect();
    let mut chosen = vec![0usize; points.len()];
    let upgrade = |brick: usize, to: usize| {
        let (from, to_point) = (&points[brick][hulls[brick][to - 1]], &points[brick][*hulls[brick].get(to)?]);
        let gain = (from.squared_error - to_point.squared_error) / (to_point.bytes - from.bytes) as f64;
        Some(Upgrade { gain, brick, to })
    };
    let cheapest: u64 = hulls.iter().zip(points).map(|(hull, points)| points[hull[0]].bytes).sum();
    let mut left = budget_bytes.saturating_sub(cheapest);
    let mut heap: BinaryHeap<Upgrade> = (0..points.len()).filter_map(|brick| upgrade(brick, 1)).collect();
    while let Some(Upgrade { brick, to, .. }) = heap.pop() {
        let more = points[brick][hulls[brick][to]].bytes - points[brick][hulls[brick][to - 1]].bytes;
        if more <= left {
            left -= more;
            chosen[brick] = to;
            heap.extend(upgrade(brick, to + 1));
        }
    }
    chosen.iter().zip(&hulls).map(|(&at, hull)| hull[at]).collect()
}

/// Places of the points on the lower convex hull of error over bytes: bytes increase, errors and slopes decrease.
fn lower_hull(points: &[RatePoint]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by(|&a, &b| {
        let by_error = points[a].squared_error.total_cmp(&points[b].squared_error);
        points[a].bytes.cmp(&points[b].bytes).then(by_error).then(a.cmp(&b))
    });
    let slope = |a: usize, b: usize| {
        (points[a].squared_error - points[b].squared_error) / (points[b].bytes - points[a].bytes) as f64
    };
    let mut hull: Vec<usize> = Vec::with_capacity(order.len());
    for at in order {
        if hull.last().is_some_and(|&last| {
            points[last].squared_error <= points[at].squared_error || points[last].bytes == points[at].bytes
        }) {
            continue;
        }
        while let [.., before, last] = hull[..]
            && slope(before, last) <= slope(last, at)
        {
            hull.pop();
        }
        hull.push(at);
    }
    hull
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(bytes: u64, squared_error: f64) -> RatePoint {
        RatePoint { pieces: Vec::new(), bytes, squared_error }
    }

    #[test]
    fn points_above_the_hull_are_never_taken() {
        // (20, 90) lies above the chord from (10, 100) to (30, 20); (40, 30) costs more than (30, 20) and errs more.
        let points = [point(40, 30.0), point(20, 90.0), point(10, 100.0), point(30, 20.0), point(50, 15.0)];
        assert_eq!(lower_hull(&points), [2, 3, 4]);
        assert_eq!(lower_hull(&points[..1]), [0]);
        assert_eq!(lower_hull(&[point(5, 1.0), point(5, 1.0), point(5, 0.5), point(6, 0.5)]), [2]);
    }

    #[test]
    fn bits_go_where_they_save_most() {
        let points = vec![
            vec![point(0, 100.0), point(10, 20.0), point(20, 10.0)],
            vec![point(0, 50.0), point(10, 20.0), point(20, 19.0)],
        ];
        let choose = |budget| allocate(&points, budget);
        assert_eq!(choose(0), [0, 0]);
        assert_eq!(choose(9), [0, 0]);
        assert_eq!(choose(10), [1, 0]);
        assert_eq!(choose(20), [1, 1]);
        assert_eq!(choose(30), [2, 1]);
        assert_eq!(choose(1000), [2, 2]);
        // Where the cheapest exceed the budget they are taken all the same.
        assert_eq!(allocate(&[vec![point(7, 3.0), point(9, 1.0)]], 5), [0]);
        assert_eq!(allocate(&[], 5), [0usize; 0]);
    }

    /// The analytic optimum: bricks whose error is `v 4^-r` at `r` bits share a budget so that all errors are equal
    /// (reverse water-filling).
    #[test]
    fn equal_slopes_are_equal_errors_for_gaussian_bricks() {
        let variances = [1.0f64, 4.0, 16.0, 0.25];
        let points: Vec<Vec<RatePoint>> = variances
            .iter()
            .map(|v| (0..200u64).map(|r| point(r, v * 4f64.powf(-(r as f64) / 8.0))).collect())
            .collect();
        let budget = 100;
        let chosen = allocate(&points, budget);
        assert_eq!(chosen.iter().sum::<usize>() as u64, budget);
        // 25 each for the geometric mean 2 of the variances, and 4 more for each factor of 2 beyond it.
        assert_eq!(chosen, [21, 29, 37, 13]);
    }

    #[test]
    fn slopes_near_a_budget_bracket_it() {
        let slopes = first_slopes(2.0);
        assert!(slopes.is_sorted() && slopes.len() == 9);
        let bytes: Vec<u64> = (0..9u32).map(|k| 1 << (20 - k)).collect();
        // Halfway in the logarithm of the bytes is halfway in that of the slope.
        let near = slopes_for(&slopes, &bytes, ((1u64 << 18) as f64 * 0.5f64.sqrt()) as u64);
        let middle = (slopes[2] * slopes[3]).sqrt();
        assert!(near.is_sorted() && (near[1] / middle - 1.0).abs() < 1e-4, "{near:?}");
        assert_eq!(slopes_for(&slopes, &bytes, u64::MAX)[1], slopes[0]);
        assert_eq!(slopes_for(&slopes, &bytes, 0)[1], slopes[8]);
    }
}
