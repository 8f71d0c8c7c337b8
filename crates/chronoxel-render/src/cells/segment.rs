//! What a stretch of a ray adds to a pixel, by definition: the value changes linearly from one end to the other.

use chronoxel_core::{ResolvedTransfer, compositing};

/// Opacities are taken as at most this, so that optical depths are finite.
pub const MOST_OPACITY: f64 = 1.0 - 1.0 / (1u64 << 20) as f64;

/// Pieces that a stretch between two corners of the transfer function is cut into.
const PIECES: usize = 32;

/// Extinction per world unit of an opacity per `unit` of path.
pub(super) fn extinction(opacity: f64, unit: f64) -> f64 {
    -f64::ln_1p(-opacity.min(MOST_OPACITY)) / unit
}

/// Premultiplied colour and opacity of a segment along which the value runs linearly from `front` to `back`.
///
/// `∫ c(s(t)) τ(s(t)) exp(-∫ τ) dt`: colours are taken piece by piece, after the corners of the transfer function have
/// cut the segment; optical depths add up, so that the opacity errs only by the midpoint rule's error.
///
/// * `length`: world units
/// * `unit`: the path length that opacities refer to
/// * `light`: factor of the colour, and the highlight added to it
pub fn integrate_segment(
    transfer: &ResolvedTransfer,
    [front, back]: [f64; 2],
    length: f64,
    unit: f64,
    light: (f64, f64),
) -> [f64; 4] {
    let mut cuts = vec![0.0];
    if front != back {
        let at = |x: f64| (x - front) / (back - front);
        cuts.extend(transfer.points().iter().map(|p| at(p.x)).filter(|t| *t > 0.0 && *t < 1.0));
        cuts.sort_by(f64::total_cmp);
    }
    cuts.push(1.0);
    let mut pixel = [0.0; 4];
    for pair in cuts.windows(2) {
        let dt = (pair[1] - pair[0]) / PIECES as f64;
        for i in 0..PIECES {
            let t = pair[0] + (i as f64 + 0.5) * dt;
            let [r, g, b, opacity] = transfer.evaluate(front + (back - front) * t);
            let alpha = -f64::exp_m1(-extinction(opacity, unit) * length * dt);
            let lit = |c: f64| alpha * (c * light.0 + light.1);
            compositing::accumulate(&mut pixel, [lit(r), lit(g), lit(b), alpha]);
        }
    }
    pixel
}

#[cfg(test)]
mod tests {
    use super::*;
    use chronoxel_core::{TransferDomain, TransferFunction, TransferPoint};

    fn transfer(points: &[(f64, f32)]) -> ResolvedTransfer {
        let point = |&(x, opacity): &(f64, f32)| TransferPoint { x, color: [1.0, 0.5, 0.25], opacity };
        let function = TransferFunction::new(points.iter().map(point).collect(), TransferDomain::Data);
        function.unwrap().resolve([0.0, 1.0]).unwrap()
    }

    #[test]
    fn a_constant_segment_is_beer_lambert() {
        let transfer = transfer(&[(0.0, 0.25)]);
        let found = integrate_segment(&transfer, [0.3, 0.3], 2.5, 0.5, (1.0, 0.0));
        let alpha = 1.0 - 0.75f64.powf(5.0);
        for (found, color) in found.into_iter().zip([1.0, 0.5, 0.25, 1.0]) {
            assert!((found - alpha * color).abs() < 1e-12);
        }
    }

    #[test]
    fn a_linear_segment_has_the_closed_form_of_its_optical_depth() {
        // Opacity a from 0.1 to 0.7: the mean of -ln(1 - a) is [(1 - a) ln(1 - a) + a] over the range.
        let transfer = transfer(&[(0.0, 0.0), (1.0, 1.0)]);
        let antiderivative = |a: f64| (1.0 - a) * (1.0 - a).ln() + a;
        let depth = (antiderivative(0.7) - antiderivative(0.1)) / 0.6 * 3.0;
        for values in [[0.1, 0.7], [0.7, 0.1]] {
            let alpha = integrate_segment(&transfer, values, 3.0, 1.0, (1.0, 0.0))[3];
            assert!((alpha - (1.0 - (-depth).exp())).abs() < 5e-5, "{alpha} {depth}");
        }
    }
}
