//! Rate control: for each brick, ways to code a run of steps with their stored bytes and squared errors, and the choice
//! among them at equal slope.
//!
//! At a given *slope* (squared error that one stored bit must save) every brick has one best way, [`rate_points`], and
//! bricks coded at one slope together have the least squared error for the bytes they take (Shoham and
//! Gersho 1988). [`first_slopes`] cover all rates coarsely; after trying them on a few bricks, [`slopes_for`] names those
//! near a budget, and [`allocate`] chooses among the points that all bricks of a group have there.

mod points;

use std::{cmp::Ordering, collections::BinaryHeap};

pub use points::{CodedPiece, Piece, RateOptions, RatePoint, Run, rate_points};

/// Slopes are tried in steps of this factor at first.
const FIRST_FACTOR: f64 = 16.0;
/// Slopes near a budget, as factors of the one that is expected to meet it.
const FACTORS_NEAR: [f64; 3] = [0.3, 1.0, 3.0];

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
pub fn slopes_for(slopes: &[f64], bytes: &[u64], budget_bytes: u64) -> Vec<f64> {
    let fits = bytes.iter().position(|&b| b <= budget_bytes);
    let at = match fits {
        Some(0) => slopes[0],
        None => slopes[slopes.len() - 1],
        Some(i) => {
            let log = |b: u64| libm::log(b.max(1) as f64);
            let (more, less) = (log(bytes[i - 1]), log(bytes[i]));
            let part = if more > less { (more - log(budget_bytes)) / (more - less) } else { 1.0 };
            let exponent = part.clamp(0.0, 1.0) * libm::log(slopes[i] / slopes[i - 1]);
            slopes[i - 1] * libm::exp(exponent)
        }
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
