//! The colour metrics against ellsworth2000's equations written down plainly, and against each other.

use chronoxel_core::{
    BrickColors, ColorEstimate, ColorMap, ColorSpace, ColorSums, ColorTable, NodeFacts, NodeStatistics,
    ResolvedTransfer, TimeNode, TransferDomain, TransferFunction, TransferPoint, VoxelColors,
    approximate_spatial, approximate_temporal,
};

const SPACES: [ColorSpace; 2] = [ColorSpace::Rgb, ColorSpace::Luv];

/// Pseudo-random numbers in [0, 1): a linear congruential generator (Knuth's MMIX constants).
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Normally distributed, by Box and Muller.
    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.next()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.next()).cos()
    }
}

/// L\*u\*v\* / 100 as in its definition (CIE 15), from the sRGB of IEC 61966-2-1 and its D65.
fn luv(srgb: [f64; 3]) -> [f64; 3] {
    let [r, g, b] = srgb.map(|c| if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) });
    let x = 0.4124564 * r + 0.3575761 * g + 0.1804375 * b;
    let y = 0.2126729 * r + 0.7151522 * g + 0.0721750 * b;
    let z = 0.0193339 * r + 0.1191920 * g + 0.9503041 * b;
    if y == 0.0 {
        return [0.0; 3];
    }
    let lightness = if y > 216.0 / 24389.0 { 116.0 * y.cbrt() - 16.0 } else { y * 24389.0 / 27.0 };
    let chroma =
        |x: f64, y: f64, z: f64| [4.0 * x / (x + 15.0 * y + 3.0 * z), 9.0 * y / (x + 15.0 * y + 3.0 * z)];
    let ([u, v], [un, vn]) = (chroma(x, y, z), chroma(0.95047, 1.0, 1.08883));
    [lightness / 100.0, 0.13 * lightness * (u - un), 0.13 * lightness * (v - vn)]
}

/// Three coordinates, opacity, and a weight.
type Weighed = ([f64; 4], f64);

fn colored(transfer: &ResolvedTransfer, space: ColorSpace, value: f64) -> [f64; 4] {
    let [r, g, b, alpha] = transfer.evaluate(value);
    let [x, y, z] = if space == ColorSpace::Luv { luv([r, g, b]) } else { [r, g, b] };
    [x, y, z, alpha]
}

/// Equation 7.
fn d(c1: [f64; 4], c2: [f64; 4]) -> f64 {
    c1[3] * (0..3).map(|i| (c1[i] - c2[i]).powi(2)).sum::<f64>() + (c1[3] - c2[3]).powi(2)
}

/// Mean colour, and deviation over mean (equations 8–10 and 16–19), in two passes.
fn plainly(colors: &[Weighed]) -> ([f64; 4], f64) {
    let total: f64 = colors.iter().map(|c| c.1).sum();
    let mean = [0, 1, 2, 3].map(|i| colors.iter().map(|c| c.1 * c.0[i]).sum::<f64>() / total);
    let sigma = (colors.iter().map(|c| c.1 * d(c.0, mean)).sum::<f64>() / total).sqrt();
    let mu = d(mean, [0.0; 4]).sqrt();
    (mean, if sigma == 0.0 { 0.0 } else { sigma / mu })
}

fn assert_close(found: f64, expected: f64, tolerance: f64, what: &str) {
    assert!(
        (found - expected).abs() <= tolerance * expected.abs(),
        "{what}: {found:e} against {expected:e}, {:e} apart",
        (found - expected).abs() / expected.abs()
    );
}

fn built_in(name: &str, range: [f64; 2]) -> ResolvedTransfer {
    TransferFunction::built_in(name, ColorMap::Turbo).unwrap().resolve(range).unwrap()
}

/// Opacity and gray by value.
fn gray(points: &[(f64, f32, f32)]) -> ResolvedTransfer {
    let point = |&(x, gray, opacity)| TransferPoint { x, color: [gray; 3], opacity };
    let points = points.iter().map(point).collect();
    TransferFunction::new(points, TransferDomain::Data).unwrap().resolve([0.0, 1.0]).unwrap()
}

fn node(min: f64, max: f64, mean: f64, std: f64) -> NodeStatistics {
    NodeStatistics { min, max, mean, std, temporal_error: 0.25, facts: NodeFacts::default() }
}

fn spatial(transfer: &ResolvedTransfer, range: [f64; 2], node: &NodeStatistics) -> ColorEstimate {
    let table = ColorTable::new(transfer, range, 256, ColorSpace::Rgb);
    approximate_spatial(&table, transfer, node)
}

#[test]
fn the_approximate_spatial_error_is_that_of_its_equations() {
    let mut random = Random(1);
    let range = [-3.0, 5.0];
    let x = |j: usize, n: usize| -3.0 + 8.0 * (j as f64 + 0.5) / n as f64;
    for i in 0..300 {
        let (name, space, n) = (["ramp", "filled", "sparse"][i % 3], SPACES[i % 2], [256, 100, 5][i % 5 % 3]);
        let transfer = built_in(name, range);
        let table = ColorTable::new(&transfer, range, n, space);
        let mut ends = [0, 1].map(|_| 8.0 * random.next() - 3.0);
        ends.sort_by(f64::total_cmp);
        let mean = ends[0] + (ends[1] - ends[0]) * random.next();
        let std = (0.05 + 0.5 * random.next()) * (ends[1] - ends[0]);
        let found = approximate_spatial(&table, &transfer, &node(ends[0], ends[1], mean, std));
        let entry = |v: f64| (((v + 3.0) / 8.0 * n as f64).floor() as usize).min(n - 1);
        let population = |j: usize| (-(x(j, n) - mean).powi(2) / (2.0 * std * std)).exp();
        let colors: Vec<Weighed> = (entry(ends[0])..=entry(ends[1]))
            .map(|j| (colored(&transfer, space, x(j, n)), population(j)))
            .collect();
        if colors.len() == 1 || colors.iter().all(|c| c.0[3] == 0.0) {
            continue;
        }
        let (mean, error) = plainly(&colors);
        assert_close(found.error, error, 1e-11, name);
        assert_close(found.mean[3].into(), mean[3], 1e-6, name);
        if space == ColorSpace::Rgb {
            (0..3).for_each(|c| assert_close(found.mean[c].into(), mean[c], 1e-6, name));
        }
    }
}

#[test]
fn two_entries_by_hand() {
    // Transparent black and opaque white, as likely as each other: mean (½ ½ ½ ½), μ² = ½ · ¾ + ¼ = 5/8,
    // σ² = ½ (0 + ¼) + ½ (¾ + ¼) = 5/8.
    let transfer = gray(&[(0.5, 0.0, 0.0), (0.5, 1.0, 1.0)]);
    let table = ColorTable::new(&transfer, [0.0, 1.0], 2, ColorSpace::Rgb);
    assert_eq!(table.color(0), [0.0; 4]);
    assert_eq!(table.color(1), [1.0; 4]);
    let found = approximate_spatial(&table, &transfer, &node(0.0, 1.0, 0.5, 0.3));
    assert_eq!(found.mean, [0.5; 4]);
    assert!((found.error - 1.0).abs() < 1e-15);
    // d(black, white) = 0 · 3 + 1; the other way round d = 1 · 3 + 1.
    assert_eq!(table.temporal_scale(), 1.0);
    assert_eq!(approximate_temporal(&table, &node(0.0, 1.0, 0.5, 0.3)), 0.25);
    let turned = gray(&[(0.5, 1.0, 1.0), (0.5, 0.0, 0.0)]);
    let table = ColorTable::new(&turned, [0.0, 1.0], 2, ColorSpace::Rgb);
    assert_eq!(approximate_temporal(&table, &node(0.0, 1.0, 0.5, 0.3)), 0.5);
    // White has L* = 100, u* = v* = 0: d = 1 + 1.
    let table = ColorTable::new(&turned, [0.0, 1.0], 2, ColorSpace::Luv);
    assert!((table.temporal_scale() - 2f64.sqrt()).abs() < 1e-4);
}

#[test]
fn the_approximate_spatial_error_is_zero_exactly_where_one_colour_is_seen() {
    let transfer =
        gray(&[(0.0, 0.2, 0.0), (0.3, 0.9, 0.0), (0.4, 0.5, 0.1), (0.6, 0.5, 0.1), (1.0, 0.5, 0.9)]);
    let of = |node: &NodeStatistics| spatial(&transfer, [0.0, 1.0], node);
    let error = |min: f64, max: f64| of(&node(min, max, 0.5 * (min + max), 0.3 * (max - min))).error;
    // Constant, transparent though the colour varies, beyond the ends.
    assert_eq!([error(0.4, 0.6), error(0.45, 0.5), error(0.0, 0.3), error(1.0, 7.0)], [0.0; 4]);
    assert_eq!(of(&node(0.45, 0.55, 0.5, 0.1)).mean, [0.5, 0.5, 0.5, 0.1]);
    // Otherwise more, also within one entry, or where no entry sees it.
    for (min, max) in [(0.0, 1.0), (0.4, 0.6 + 1e-9), (0.7, 0.7 + 1e-9), (0.0, 0.3 + 1e-12)] {
        assert!(error(min, max) >= f64::MIN_POSITIVE, "{min} {max}");
    }
    let uniform = NodeFacts { is_uniform: true, ..NodeFacts::default() };
    let found = of(&NodeStatistics { facts: uniform, ..node(0.8, 0.8, 0.8, 0.0) });
    assert_eq!((found.error, found.mean), (0.0, transfer.evaluate(0.8).map(|c| c as f32)));
    let masked = NodeFacts { is_masked: true, ..NodeFacts::default() };
    let masked = |min, max| NodeStatistics { facts: masked, ..node(min, max, min, 0.0) };
    assert!(of(&masked(0.4, 0.6)).error > 0.0, "what is masked is not seen, what is not is");
    assert_eq!(of(&masked(0.0, 0.3)).error, 0.0);
}

#[test]
fn every_node_has_an_error() {
    let transfer = built_in("sparse", [0.0, 1.0]);
    let ends = [0.0, 1e-300, 0.3, 0.52, 1.0, 1e300, f64::MAX, -1.0, f64::MIN, 5e-324];
    for range in [[0.0, 1.0], [0.5, 0.5], [1.0, 0.0], [f64::NAN; 2], [f64::MIN, f64::MAX], [0.0, 5e-324]] {
        for space in SPACES {
            let table = ColorTable::new(&transfer, range, 256, space);
            assert!(table.temporal_scale().is_finite());
            for (min, max) in ends.iter().flat_map(|&a| ends.iter().map(move |&b| (a.min(b), a.max(b)))) {
                for std in [0.0, 5e-324, 1e-9, 0.2, f64::MAX, f64::NAN] {
                    let node = node(min, max, 0.5 * min + 0.5 * max, std);
                    let found = approximate_spatial(&table, &transfer, &node);
                    assert!(found.error.is_finite() && found.error >= 0.0, "{range:?} {node:?}: {found:?}");
                    assert!(found.mean.iter().all(|c| (0.0..=1.0).contains(c)), "{found:?}");
                    let temporal = approximate_temporal(&table, &node);
                    assert!(temporal.is_finite() && temporal >= 0.0);
                }
            }
            let found = approximate_spatial(&table, &transfer, &NodeStatistics::EMPTY);
            assert_eq!((found.error, found.mean), (0.0, [0.0; 4]));
            assert_eq!(approximate_temporal(&table, &NodeStatistics::EMPTY), 0.0);
        }
    }
}

#[test]
fn the_approximate_temporal_error_is_zero_exactly_where_nothing_changes() {
    let one = gray(&[(0.0, 0.4, 0.1), (1.0, 0.4, 0.1)]);
    // Between the centres of the only two entries, 1/4 and 3/4.
    let spike = gray(&[(0.0, 0.4, 0.1), (0.4, 0.4, 0.1), (0.5, 0.4, 0.9), (0.6, 0.4, 0.1), (1.0, 0.4, 0.1)]);
    let none = gray(&[(0.0, 0.1, 0.0), (1.0, 0.9, 0.0)]);
    let table = |transfer: &ResolvedTransfer| ColorTable::new(transfer, [0.0, 1.0], 2, ColorSpace::Rgb);
    let all = node(0.0, 1.0, 0.5, 0.3);
    let facts = |change: fn(&mut NodeFacts)| {
        let mut facts = NodeFacts::default();
        change(&mut facts);
        NodeStatistics { facts, ..all }
    };
    let moving_mask = facts(|f| f.mask_changes = true);
    assert_eq!(
        approximate_temporal(&table(&built_in("filled", [0.0, 1.0])), &facts(|f| f.is_static = true)),
        0.0
    );
    assert_eq!(approximate_temporal(&table(&one), &all), 0.0);
    assert!(approximate_temporal(&table(&one), &moving_mask) > 0.0);
    assert_eq!(approximate_temporal(&table(&none), &moving_mask), 0.0);
    assert_eq!(approximate_temporal(&table(&spike), &all), f64::MIN_POSITIVE);
    let tiny = NodeStatistics { temporal_error: f64::from(f32::MIN_POSITIVE), ..all };
    assert!(approximate_temporal(&table(&built_in("ramp", [0.0, 1.0])), &tiny) > 0.0);
    let no_voxel = NodeStatistics { temporal_error: f64::NAN, ..all };
    assert!(approximate_temporal(&table(&built_in("ramp", [0.0, 1.0])), &no_voxel) > 0.0);
}

/// Samples of a brick, `[step][voxel]`.
type Steps = Vec<Vec<f64>>;

fn sums_of(transfer: &ResolvedTransfer, space: ColorSpace, steps: &Steps) -> Vec<(TimeNode, ColorSums)> {
    let colors = VoxelColors::new(transfer, space);
    let mut brick = BrickColors::new(steps[0].len(), steps.len() as u32);
    steps.iter().flat_map(|samples| brick.push(&colors, samples.iter().copied())).collect()
}

/// e_rcs, e_rct and the mean colour (equations 7–13): voxels without data left out.
fn reference_plainly(
    transfer: &ResolvedTransfer,
    space: ColorSpace,
    steps: &[Vec<f64>],
) -> (f64, f64, [f64; 4]) {
    let weighed = |space, value: f64| (colored(transfer, space, value), 1.0);
    let of = |space| {
        steps.iter().flatten().filter(|v| !v.is_nan()).map(|&v| weighed(space, v)).collect::<Vec<_>>()
    };
    let voxels = (0..steps[0].len()).map(|i| steps.iter().map(|step| step[i]).collect::<Vec<_>>());
    let whole: Vec<Vec<f64>> = voxels.filter(|voxel| voxel.iter().all(|v| !v.is_nan())).collect();
    let ratio = |voxel: &Vec<f64>| plainly(&voxel.iter().map(|&v| weighed(space, v)).collect::<Vec<_>>()).1;
    let temporal = whole.iter().map(ratio).sum::<f64>() / whole.len() as f64;
    (plainly(&of(space)).1, temporal, plainly(&of(ColorSpace::Rgb)).0)
}

#[test]
fn the_reference_errors_are_those_of_their_equations() {
    let mut random = Random(2);
    for i in 0..60 {
        let (name, space) = (["ramp", "filled", "sparse"][i % 3], SPACES[i % 2]);
        let (num_steps, masked) = ([1, 2, 5, 7, 8, 13][i % 6], if i % 4 == 3 { 0.03 } else { 0.0 });
        // From wide to a hundred-thousandth of the range: sums about 0 would lose all digits but four.
        let spread = 10f64.powi(-((i % 5) as i32) * 5 / 4);
        let sample = |random: &mut Random| match random.next() < masked {
            true => f64::NAN,
            false => 0.86 + 0.13 * spread * (2.0 * random.next() - 1.0),
        };
        let steps: Steps = (0..num_steps).map(|_| (0..40).map(|_| sample(&mut random)).collect()).collect();
        let transfer = built_in(name, [0.0, 1.0]);
        let found = sums_of(&transfer, space, &steps);
        let expected: Vec<TimeNode> =
            (0..num_steps).flat_map(|step| TimeNode::closed_by(step, num_steps)).collect();
        assert_eq!(found.iter().map(|f| f.0).collect::<Vec<_>>(), expected);
        for (node, sums) in found {
            let range = node.steps(num_steps);
            let steps = &steps[range.start as usize..range.end as usize];
            let (spatial, temporal, mean) = reference_plainly(&transfer, space, steps);
            assert_close(sums.spatial_error(), spatial, 1e-9, name);
            assert_close(sums.temporal_error(), temporal, 1e-9, name);
            (0..4).for_each(|c| assert_close(sums.mean()[c].into(), mean[c], 1e-6, name));
        }
    }
}

#[test]
fn two_voxels_by_hand() {
    // Steps: transparent black and opaque white; then both white. Over space and time: mean (¾ ¾ ¾ ¾),
    // μ² = ¾ · 27/16 + 9/16 = 117/64, σ² = ¼ · 9/16 + ¾ (3/16 + 1/16) = 21/64.
    // The first voxel has a ratio of 1 (see two_entries_by_hand), the second of 0.
    let transfer = gray(&[(0.5, 0.0, 0.0), (0.5, 1.0, 1.0)]);
    let found = sums_of(&transfer, ColorSpace::Rgb, &vec![vec![0.0, 1.0], vec![1.0, 1.0]]);
    let all = found[2].1;
    assert!((all.spatial_error() - (21f64 / 117.0).sqrt()).abs() < 1e-15);
    assert!((all.temporal_error() - 0.5).abs() < 1e-15);
    assert_eq!(all.mean(), [0.75; 4]);
    assert_eq!([found[0].1, found[1].1].map(|sums| sums.temporal_error()), [0.0; 2]);
    assert_eq!(found[1].1.spatial_error(), 0.0);
}

#[test]
fn merging_over_space_is_the_whole() {
    let mut random = Random(3);
    let transfer = built_in("sparse", [0.0, 1.0]);
    let mut value = || if random.next() < 0.05 { f64::NAN } else { random.next() };
    let steps: Steps = (0..6).map(|_| (0..90).map(|_| value()).collect()).collect();
    for space in SPACES {
        let part = |range: std::ops::Range<usize>| {
            sums_of(&transfer, space, &steps.iter().map(|step| step[range.clone()].to_vec()).collect())
        };
        let (a, b, c, whole) = (part(0..1), part(1..37), part(37..90), part(0..90));
        for (((a, b), c), whole) in a.iter().zip(&b).zip(&c).zip(&whole) {
            let found = ColorSums::default().merged(&a.1).merged(&b.1.merged(&c.1));
            assert_close(found.spatial_error(), whole.1.spatial_error(), 1e-12, "spatial");
            assert_close(found.temporal_error(), whole.1.temporal_error(), 1e-12, "temporal");
            (0..4).for_each(|i| assert!((found.mean()[i] - whole.1.mean()[i]).abs() < 1e-6));
        }
    }
}

#[test]
fn the_reference_errors_are_zero_exactly_where_nothing_differs() {
    let filled = gray(&[(0.0, 0.3, 0.7), (0.4, 0.3, 0.7), (0.6, 0.3, 0.7), (1.0, 0.9, 0.7)]);
    let errors = |transfer: &ResolvedTransfer, steps: [[f64; 3]; 3]| {
        let found = sums_of(transfer, ColorSpace::Luv, &steps.map(Vec::from).to_vec());
        let root = found.last().unwrap().1;
        (root.spatial_error(), root.temporal_error())
    };
    // One colour from several values, over several segments.
    assert_eq!(errors(&filled, [[0.1, 0.3, 0.45], [0.0, 0.6, 0.123], [-1.0, 0.6, 0.59]]), (0.0, 0.0));
    let (spatial, temporal) = errors(&filled, [[0.7, 0.8, 0.9]; 3]);
    assert!(spatial > 0.0 && temporal == 0.0);
    // The least change of a sample that changes its colour.
    let (spatial, temporal) = errors(&filled, [[0.7; 3], [0.7; 3], [0.7, 0.7, 0.7 + 1e-15]]);
    assert!(spatial > 0.0 && temporal > 0.0);
    // What cannot be seen does not differ, masked or not.
    let hidden = gray(&[(0.0, 0.0, 0.0), (0.5, 1.0, 0.0), (1.0, 0.5, 0.5)]);
    assert_eq!(
        errors(&hidden, [[0.1, f64::NAN, 0.5], [0.2, 0.1, f64::NAN], [0.3, f64::NAN, 0.4]]),
        (0.0, 0.0)
    );
    assert_eq!(errors(&hidden, [[f64::NAN; 3]; 3]), (0.0, 0.0));
    // What is masked differs from what is seen.
    let (spatial, temporal) = errors(&filled, [[0.1, f64::NAN, 0.1]; 3]);
    assert!(spatial > 0.0 && temporal == 0.0);
    let (spatial, temporal) = errors(&filled, [[0.1; 3], [0.1; 3], [0.1, f64::NAN, 0.1]]);
    assert!(spatial > 0.0 && temporal > 0.0);
    assert_eq!(ColorSums::default().spatial_error(), 0.0);
}

/// Both metrics, of samples in [0, 1].
fn both(name: &str, space: ColorSpace, samples: Vec<f64>) -> (ColorEstimate, ColorSums) {
    let transfer = built_in(name, [0.0, 1.0]);
    let n = samples.len() as f64;
    let (min, max) =
        (samples.iter().copied().fold(1.0, f64::min), samples.iter().copied().fold(0.0, f64::max));
    let mean = samples.iter().sum::<f64>() / n;
    let std = (samples.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
    let table = ColorTable::new(&transfer, [0.0, 1.0], 256, space);
    let found = approximate_spatial(&table, &transfer, &node(min, max, mean, std));
    (found, sums_of(&transfer, space, &vec![samples])[0].1)
}

#[test]
fn of_normal_populations_both_metrics_agree() {
    let mut random = Random(4);
    let populations =
        [("ramp", 0.5, 0.15), ("ramp", 0.3, 0.05), ("filled", 0.6, 0.12), ("filled", 0.8, 0.02)];
    for (name, mean, std) in populations.into_iter().chain([("sparse", 0.5, 0.15)]) {
        for space in SPACES {
            let samples = (0..40_000).map(|_| mean + std * random.normal());
            let (found, reference) = both(name, space, samples.filter(|v| (0.0..=1.0).contains(v)).collect());
            assert_close(found.error, reference.spatial_error(), 0.02, name);
            (0..4).for_each(|i| assert!((found.mean[i] - reference.mean()[i]).abs() < 0.01, "{name}"));
        }
    }
}

#[test]
fn of_other_populations_the_metrics_differ_as_told() {
    let mut random = Random(6);
    let ratio = |name, samples: Vec<f64>| {
        let (found, reference) = both(name, ColorSpace::Rgb, samples);
        (found.error / reference.spatial_error(), found.mean[3] / reference.mean()[3])
    };
    let even: Vec<f64> = (0..30_000).map(|_| random.next()).collect();
    for name in ["ramp", "filled", "sparse"] {
        assert!((0.84..0.95).contains(&ratio(name, even.clone()).0));
    }
    let two: Vec<f64> = (0..1000).map(|i| 0.2 + 0.2 * f64::from(i % 2)).collect();
    assert!((0.55..0.6).contains(&ratio("ramp", two.clone()).0));
    let plume: Vec<f64> = (0..30_000).map(|i| if i % 100 == 0 { random.next() } else { 0.0 }).collect();
    let (error, opacity) = ratio("ramp", plume);
    assert!((0.12..0.18).contains(&error) && (6.0..11.0).contains(&opacity), "{error} {opacity}");
    // Voxels on either side of what is visible.
    let (found, reference) = both("sparse", ColorSpace::Rgb, (0..1000).map(|i| f64::from(i % 2)).collect());
    assert!(found.error > 0.5 && reference.spatial_error() == 0.0);
}

#[test]
fn voxels_have_the_colours_of_the_transfer_function() {
    let mut random = Random(5);
    let steps = gray(&[(0.0, 0.1, 0.2), (0.2, 0.4, 0.3), (0.2, 0.9, 0.5), (0.2, 0.8, 0.6), (0.9, 0.0, 1.0)]);
    let single = gray(&[(0.4, 0.1, 0.2)]);
    let crowded = gray(&[(0.0, 0.0, 0.0), (1e-300, 0.5, 0.5), (1e-9, 1.0, 0.3), (1e9, 0.0, 1.0)]);
    for transfer in [steps, single, crowded, built_in("sparse", [0.0, 1.0])] {
        let special = [0.0, 0.2, 0.9, 1e-300, 1e-9, 1e9, -1.0, f64::INFINITY, f64::NEG_INFINITY, f64::MAX];
        let values = special.into_iter().chain((0..2000).map(|_| 1.2 * random.next() - 0.1));
        for value in values {
            let found = sums_of(&transfer, ColorSpace::Rgb, &vec![vec![value]])[0].1.mean();
            let expected = transfer.evaluate(value).map(|c| c as f32);
            (0..4).for_each(|i| {
                assert!((found[i] - expected[i]).abs() < 1e-7, "{value}: {found:?} {expected:?}")
            });
        }
    }
}

#[test]
fn luv_coordinates_of_known_colours() {
    // Published for sRGB and D65: red (53.24, 175.01, 37.76), green (87.73, −83.08, 107.40), blue (32.30, −9.40, −130.34).
    let known = [
        ([1.0, 0.0, 0.0], [53.24, 175.01, 37.76]),
        ([0.0, 1.0, 0.0], [87.73, -83.08, 107.40]),
        ([0.0, 0.0, 1.0], [32.30, -9.40, -130.34]),
        ([1.0, 1.0, 1.0], [100.0, 0.0, 0.0]),
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
    ];
    for (srgb, luv) in known {
        let found = ColorSpace::Luv.coordinates(srgb);
        (0..3).for_each(|i| assert!((100.0 * found[i] - luv[i]).abs() < 0.02, "{srgb:?}: {found:?}"));
        assert_eq!(ColorSpace::Rgb.coordinates(srgb), srgb);
    }
}
