//! Tolerances that make pictures differ by as much as is asked for.

/// Tolerances that are looked at.
const RANGE: [f64; 2] = [1e-5, 1e3];
/// Halvings of the range, in logarithms: to about 8 % of the tolerance.
const NUM_HALVINGS: usize = 8;

/// The tolerance whose pictures differ by `wanted`, or as nearly as any found; the largest, where none differs as much.
///
/// Distances grow with the tolerance, in steps: from one node that is drawn simpler to the next.
///
/// * `distance`: of the pictures with a tolerance from those without
pub fn tolerance(wanted: f64, mut distance: impl FnMut(f64) -> anyhow::Result<f64>) -> anyhow::Result<f64> {
    let [mut low, mut high] = RANGE;
    let most = distance(high)?;
    if most <= wanted {
        return Ok(high);
    }
    let (mut best, mut best_off) = (high, most - wanted);
    for _ in 0..NUM_HALVINGS {
        let middle = (low * high).sqrt();
        let found = distance(middle)?;
        let off = (found - wanted).abs();
        if off <= best_off {
            (best, best_off) = (middle, off);
        }
        if found <= wanted {
            low = middle;
        } else {
            high = middle;
        }
    }
    Ok(best)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tolerance_is_found() {
        let found = tolerance(0.5, |t| Ok(t * t)).unwrap();
        assert!((found - 0.5f64.sqrt()).abs() < 0.05, "{found}");
        // A distance that jumps from 0.1 to 0.6 at 3: the nearer of the two.
        let found = tolerance(0.5, |t| Ok(if t < 3.0 { 0.1 } else { 0.6 })).unwrap();
        assert!((3.0..3.3).contains(&found), "{found}");
        assert_eq!(tolerance(0.5, |_| Ok(0.2)).unwrap(), RANGE[1]);
    }
}
