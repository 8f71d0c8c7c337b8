//! The parts of the product palette against closed forms and published tables, and the palette over bricks of every kind.

use std::f64::consts::PI;

use chronoxel_codec::{
    Dct, Indices, LloydMax, Palette, ProductQuantizer, UnitWindow, allocate_bits, expected_distortion,
    product_palette,
};
use chronoxel_core::BrickLayout;

mod random;
use random::Random;

const LENGTHS: [usize; 8] = [1, 2, 3, 4, 7, 8, 16, 100];

/// `C(u)` as lum2001 writes it.
fn coefficient(samples: &[f64], u: usize) -> f64 {
    let n = samples.len() as f64;
    let alpha = if u == 0 { (1.0 / n).sqrt() } else { (2.0 / n).sqrt() };
    let term = |(t, f): (usize, &f64)| f * ((2 * t + 1) as f64 * u as f64 * PI / (2.0 * n)).cos();
    alpha * samples.iter().enumerate().map(term).sum::<f64>()
}

#[test]
fn the_transform_of_constants_and_cosines_is_a_single_coefficient() {
    for n in LENGTHS {
        for k in 0..n.min(20) {
            let cosine = |t: usize| ((2 * t + 1) as f64 * k as f64 * PI / (2 * n) as f64).cos() as f32;
            let samples: Vec<f32> = (0..n).map(cosine).collect();
            let norm = if k == 0 { (n as f64).sqrt() } else { (n as f64 / 2.0).sqrt() };
            for (u, &c) in Dct::new(n).forward(&samples).iter().enumerate() {
                let expected = if u == k { norm } else { 0.0 };
                assert!((f64::from(c) - expected).abs() < 1e-5, "{n} {k} {u}: {c} is not {expected}");
            }
        }
    }
}

#[test]
fn the_transform_is_orthonormal_and_its_own_definition() {
    let mut random = Random(1);
    for n in LENGTHS {
        let num_samples = 37;
        let values: Vec<f32> = (0..n * num_samples).map(|_| random.unit() as f32).collect();
        let dct = Dct::new(n);
        let coefficients = dct.forward(&values);
        let inverse = dct.inverse(&coefficients);
        for at in 0..num_samples {
            let of = |v: &[f32]| -> Vec<f64> { (0..n).map(|t| v[t * num_samples + at].into()).collect() };
            let (samples, transformed) = (of(&values), of(&coefficients));
            let energy = |v: &[f64]| v.iter().map(|v| v * v).sum::<f64>();
            assert!((energy(&samples) / energy(&transformed) - 1.0).abs() < 1e-5);
            for (u, c) in transformed.iter().enumerate() {
                assert!((c - coefficient(&samples, u)).abs() < 1e-5);
            }
            assert!(samples.iter().zip(of(&inverse)).all(|(a, b)| (a - b).abs() < 1e-5));
        }
    }
}

#[test]
fn bits_follow_the_analytic_optimum_where_it_is_whole() {
    // b(u) = B / n + log2(v(u) / geometric mean) / 2, for many bits.
    for (variances, bits) in [
        (vec![4f64.powi(6), 4f64.powi(3), 4.0, 1.0, 1.0], 10 + 5 * 6),
        (vec![1e-6, 16e-6, 64e-6], 5 + 3 * 8),
        (vec![1.0; 4], 4 * 7),
    ] {
        let n = variances.len() as f64;
        let mean = variances.iter().map(|v| v.log2()).sum::<f64>() / n;
        let analytic = variances.iter().map(|v| bits as f64 / n + (v.log2() - mean) / 2.0);
        let given = allocate_bits(&variances, bits);
        for (given, analytic) in given.iter().zip(analytic) {
            assert!((f64::from(*given) - analytic).abs() < 1e-9, "{given} for {analytic}");
        }
    }
}

#[test]
fn no_other_allocation_has_less_error() {
    let mut random = Random(2);
    for _ in 0..200 {
        let variances: Vec<f64> = (0..4).map(|_| (random.unit() * 12.0 - 6.0).exp()).collect();
        let error = |bits: &[u32]| -> f64 {
            variances.iter().zip(bits).map(|(v, &b)| v * expected_distortion(b)).sum()
        };
        let given = allocate_bits(&variances, 8);
        assert_eq!(given.iter().sum::<u32>(), 8);
        for other in (0..9 * 9 * 9).map(|at: u32| [at % 9, at / 9 % 9, at / 81]) {
            if let Some(rest) = 8u32.checked_sub(other.iter().sum()) {
                let other = [other[0], other[1], other[2], rest];
                assert!(error(&given) <= error(&other) * (1.0 + 1e-12), "{given:?} {other:?}");
            }
        }
    }
}

#[test]
fn bits_go_to_the_first_of_equals_and_none_to_what_does_not_vary() {
    assert_eq!(allocate_bits(&[1.0; 3], 8), [3, 3, 2]);
    assert_eq!(allocate_bits(&[0.0, 2.0, 0.0], 8), [0, 8, 0]);
    assert_eq!(allocate_bits(&[0.0, 0.0], 8), [0, 0]);
    assert_eq!(allocate_bits(&[1.0, 1.0], 0), [0, 0]);
    assert_eq!(allocate_bits(&[], 8), [0; 0]);
}

fn mean_square_error(quantizer: &LloydMax, values: &[f32]) -> f64 {
    let error = |&v: &f32| f64::from(v - quantizer.levels()[usize::from(quantizer.code(v))]).powi(2);
    values.iter().map(error).sum::<f64>() / values.len() as f64
}

fn fit(values: &[f32], num_levels: usize) -> LloydMax {
    LloydMax::fit(values, std::slice::from_ref(&(0..values.len())), num_levels)
}

/// The quantiles of a unit Gaussian at the middles of `n` equal shares.
fn gaussian(n: usize) -> Vec<f32> {
    let quantile = |p: f64| {
        let [mut low, mut high] = [-9.0, 9.0];
        for _ in 0..50 {
            let middle = (low + high) / 2.0;
            let below = 0.5 * libm::erfc(-middle / 2f64.sqrt());
            if below < p { low = middle } else { high = middle }
        }
        low as f32
    };
    (0..n).map(|i| quantile((i as f64 + 0.5) / n as f64)).collect()
}

#[test]
fn a_gaussian_has_the_distortions_and_levels_of_max_1960() {
    let values = gaussian(50_000);
    for (num_levels, distortion) in [(2, 0.3634), (4, 0.1175), (8, 0.03454), (16, 0.009497)] {
        let quantizer = fit(&values, num_levels);
        let error = mean_square_error(&quantizer, &values);
        assert!((error / distortion - 1.0).abs() < 4e-3, "{num_levels} levels: {error}, not {distortion}");
    }
    for (num_levels, expected) in
        [(2, &[0.798][..]), (4, &[0.4528, 1.510]), (8, &[0.2451, 0.7560, 1.344, 2.152])]
    {
        let quantizer = fit(&values, num_levels);
        let upper = &quantizer.levels()[num_levels / 2..];
        for (level, expected) in upper.iter().zip(expected) {
            assert!((level - expected).abs() < 4e-3, "{:?}, not {expected:?}", quantizer.levels());
        }
    }
}

#[test]
fn many_levels_reach_the_distortion_of_panter_and_dite() {
    // sqrt(3) pi / 2 / levels^2 for a Gaussian; the bins of the histogram add range^2 / 12 / 4096^2.
    let values = gaussian(200_000);
    for num_levels in [64, 128, 256] {
        let limit = 3f64.sqrt() * PI / 2.0 / (num_levels * num_levels) as f64;
        let error = mean_square_error(&fit(&values, num_levels), &values);
        assert!((0.9..1.02).contains(&(error / limit)), "{num_levels} levels: {error}, not {limit}");
    }
    let uniform: Vec<f32> = (0..100_000).map(|i| i as f32 / 1e5).collect();
    for num_levels in [1, 2, 5, 8, 32, 256] {
        let limit = 1.0 / 12.0 / (num_levels * num_levels) as f64;
        let error = mean_square_error(&fit(&uniform, num_levels), &uniform);
        assert!((error / limit - 1.0).abs() < 0.02, "{num_levels} levels: {error}, not {limit}");
    }
}

/// The least mean square error of `num_levels` levels, by trying every set of thresholds.
fn least_error(sorted: &[f32], num_levels: usize) -> f64 {
    let alone = |part: &[f32]| {
        let mean = part.iter().map(|&v| f64::from(v)).sum::<f64>() / part.len().max(1) as f64;
        part.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>()
    };
    if num_levels == 1 {
        return alone(sorted);
    }
    let split = |at: usize| alone(&sorted[..at]) + least_error(&sorted[at..], num_levels - 1);
    (0..=sorted.len()).map(split).fold(f64::INFINITY, f64::min)
}

#[test]
fn clustered_samples_get_the_levels_of_an_exhaustive_search() {
    let mut random = Random(3);
    for _ in 0..300 {
        let centres: Vec<f64> = (0..5).map(|_| random.unit()).collect();
        let mut values: Vec<f32> =
            (0..16).map(|_| (centres[random.next() as usize % 5] + 0.02 * random.unit()) as f32).collect();
        values.sort_by(f32::total_cmp);
        for num_levels in [2, 4] {
            let error = mean_square_error(&fit(&values, num_levels), &values) * 16.0;
            let least = least_error(&values, num_levels);
            assert!(error <= least * 1.001 + 1e-7, "{num_levels} levels of {values:?}: {error}, not {least}");
        }
    }
}

#[test]
fn few_values_are_levels_of_their_own() {
    let values: Vec<f32> = (0..1000).map(|i| [0.125, 0.25, 0.5, 0.1875][i % 4]).collect();
    let quantizer = fit(&values, 256);
    assert_eq!(quantizer.levels().len(), 4);
    assert!(values.iter().all(|&v| (quantizer.levels()[usize::from(quantizer.code(v))] - v).abs() < 1e-4));
    assert_eq!(fit(&[], 8).levels(), [0.0]);
    assert_eq!(fit(&[0.7; 9], 8).levels(), [0.7]);
    assert_eq!(fit(&[f32::from_bits(1), 0.0], 8).levels().len(), 1);
}

fn layout() -> BrickLayout {
    BrickLayout::new(8).unwrap()
}

/// Steps of every kind that quantisers stumble over, each `[t][sample]`.
fn kinds(num_steps: usize, random: &mut Random) -> Vec<Vec<Vec<f64>>> {
    let n = layout().num_full();
    let mut of = |value: &mut dyn FnMut(usize, usize, f64) -> f64| -> Vec<Vec<f64>> {
        (0..num_steps).map(|t| (0..n).map(|i| value(t, i, random.unit())).collect()).collect()
    };
    vec![
        of(&mut |_, _, r| r),
        of(&mut |t, i, _| (i as f64 / 40.0 + t as f64).sin()),
        of(&mut |_, _, _| -7.25),
        of(&mut |_, i, _| [3.0, 4.0][i % 7 / 4]),
        of(&mut |t, i, _| [3.0, 4.0][(i + t) % 2]),
        of(&mut |t, _, _| t as f64),
        of(&mut |_, i, _| f64::from(i == 700)),
        of(&mut |_, i, _| f64::from(i == 0)),
        of(&mut |_, i, r| if i == 0 { 1.0 } else { 1e-40 * r }),
        of(&mut |_, _, r| 5e-324 * (r * 100.0).floor()),
        of(&mut |_, _, r| 1e-310 * r),
        of(&mut |_, _, r| 1e308 * (r - 0.5)),
        of(&mut |_, i, r| 1e10 + 1e-3 * r * (i % 3) as f64),
        of(&mut |_, _, r| (r * 300.0).floor()),
    ]
}

fn window(steps: &[Vec<f64>], trained: Vec<u32>) -> UnitWindow {
    let steps: Vec<&[f64]> = steps.iter().map(|step| &step[..]).collect();
    UnitWindow::new(&steps, trained).unwrap()
}

fn indices(palette: &Palette) -> &[u8] {
    match &palette.indices {
        Indices::U8(v) => v,
        Indices::U16(_) => panic!("a product palette has 8-bit indices"),
    }
}

/// What holds of any product palette: entries are means over the trained samples that have them, else over the others,
/// all in [0, 1].
fn check(window: &UnitWindow, palette: &Palette) {
    let indices = indices(palette);
    assert_eq!(indices.len(), window.num_samples());
    assert_eq!(palette.values.len(), palette.num_entries * window.num_steps);
    assert!(indices.iter().all(|&i| usize::from(i) < palette.num_entries));
    assert!(palette.values.iter().all(|v| (0.0..=1.0).contains(v)));
    let mut trained = vec![false; indices.len()];
    window.trained.iter().for_each(|&at| trained[at as usize] = true);
    for t in 0..window.num_steps {
        let mut sums = vec![[[0.0; 2]; 2]; palette.num_entries];
        for (at, &value) in window.step(t).iter().enumerate() {
            let sum = &mut sums[usize::from(indices[at])][usize::from(trained[at])];
            *sum = [sum[0] + f64::from(value), sum[1] + 1.0];
        }
        for (entry, [others, trained]) in sums.into_iter().enumerate() {
            let [sum, count] = if trained[1] > 0.0 { trained } else { others };
            let value = f64::from(palette.values[t * palette.num_entries + entry]);
            assert!(count == 0.0 || (value - sum / count).abs() < 1e-6, "step {t} entry {entry}");
        }
    }
    let stage = palette.to_stage(window, &layout(), 256, window.num_steps.max(4)).unwrap();
    stage.validate(&layout()).unwrap();
}

#[test]
fn any_brick_has_a_palette_of_means() {
    let mut random = Random(4);
    for num_steps in [1, 2, 3, 4, 8, 16] {
        for steps in kinds(num_steps, &mut random) {
            for trained in
                [(0..1331).collect(), vec![700], vec![5, 6, 7, 90], (200..1100).step_by(3).collect()]
            {
                let window = window(&steps, trained);
                for bits in [1, 5, 8] {
                    let palette = product_palette(&window, bits);
                    assert!(palette.num_entries <= 1 << bits);
                    check(&window, &palette);
                    assert_eq!(palette, product_palette(&window, bits));
                }
            }
        }
    }
}

#[test]
fn long_windows_have_palettes_too() {
    let steps: Vec<Vec<f64>> = (0..1024).map(|t| (0..1331).map(|i| (t * i % 97) as f64).collect()).collect();
    let window = window(&steps, (0..64).collect());
    check(&window, &product_palette(&window, 8));
}

#[test]
fn bricks_of_few_static_values_lose_nothing() {
    let mut random = Random(5);
    for num_steps in [1, 2, 5, 8] {
        for num_values in [1u64, 2, 3, 200] {
            let step: Vec<f64> = (0..1331).map(|_| (random.next() % num_values) as f64).collect();
            let window = window(&vec![step; num_steps], (0..1331).collect());
            let palette = product_palette(&window, 8);
            let error = palette.squared_error(&window);
            assert!(error < 1e-9, "{num_values} values over {num_steps} steps: {error}");
            let used = indices(&palette).iter().collect::<std::collections::BTreeSet<_>>();
            assert_eq!(used.len() as u64, num_values);
        }
    }
}

#[test]
fn a_gaussian_brick_has_the_distortion_of_max_1960() {
    // Independent steps of equal variance: 4 + 4 bits over two steps, 16 levels each.
    let mut random = Random(7);
    let mut normal = || (-2.0 * (1.0 - random.unit()).ln()).sqrt() * (2.0 * PI * random.unit()).cos();
    let n = 40_000;
    let steps: Vec<Vec<f64>> = (0..2).map(|_| (0..n).map(|_| normal()).collect()).collect();
    let window = window(&steps, (0..n as u32).collect());
    let error = product_palette(&window, 8).squared_error(&window) * window.width.powi(2) / (2 * n) as f64;
    assert!((error / 0.009497 - 1.0).abs() < 0.03, "{error}");
}

#[test]
fn a_quantiser_fitted_to_some_vectors_codes_others() {
    let mut random = Random(8);
    let num_steps = 4;
    let vector = |r: f64, t: usize| (0.5 + 0.4 * (6.0 * r + t as f64 * 0.3).sin()) as f32;
    let mut values = |n: usize| -> Vec<f32> {
        let at: Vec<f64> = (0..n).map(|_| random.unit()).collect();
        (0..num_steps).flat_map(|t| at.iter().map(move |&r| vector(r, t))).collect()
    };
    let (known, new) = (values(5000), values(700));
    let trained: Vec<u32> = (0..5000).collect();
    let quantizer = ProductQuantizer::fit(&known, num_steps, &trained, 8);
    let window = UnitWindow { values: known.clone(), num_steps, trained, offset: 0.0, width: 1.0 };
    let palette = product_palette(&window, 8);
    assert_eq!(quantizer.code(&known), indices(&palette));
    assert_eq!((quantizer.table(), quantizer.num_entries()), (&palette.values[..], palette.num_entries));
    let mean_square = |values: &[f32]| {
        let (codes, n) = (quantizer.code(values), values.len() / num_steps);
        let error = |t: usize, i: usize| {
            let entry = quantizer.table()[t * quantizer.num_entries() + usize::from(codes[i])];
            f64::from(values[t * n + i] - entry).powi(2)
        };
        (0..num_steps).flat_map(|t| (0..n).map(move |i| (t, i))).map(|(t, i)| error(t, i)).sum::<f64>()
            / values.len() as f64
    };
    assert!(mean_square(&new) < 1.3 * mean_square(&known) + 1e-6);
}
