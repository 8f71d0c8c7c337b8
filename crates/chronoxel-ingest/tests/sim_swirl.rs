//! The test pattern for playback: what tests of playback count on.

#[path = "common/steps.rs"]
mod steps;

use std::f64::consts::{PI, TAU};

use chronoxel_core::Samples;
use chronoxel_ingest::sim;
use steps::steps_of;

const N: usize = 64;

fn cube(options: &str, steps: &[usize]) -> Vec<Vec<f32>> {
    steps_of(&format!("sim:swirl?dims={N}&steps=200{options}"), steps)
}

fn correlation(a: &[f32], b: &[f32]) -> f64 {
    let sum = |x: &[f32], y: &[f32]| x.iter().zip(y).map(|(x, y)| f64::from(x * y)).sum::<f64>();
    sum(a, b) / (sum(a, a) * sum(b, b)).sqrt()
}

/// Share of the power along each axis of waves no longer than `longest` voxels, behind a Hann window.
fn share_of_short_waves(samples: &[f32], longest: f64) -> [f64; 3] {
    [1, N, N * N].map(|stride| {
        let (mut short, mut all) = (0.0, 0.0);
        for line in (0..N * N).step_by(7) {
            let start = match stride {
                1 => line * N,
                N => line / N * N * N + line % N,
                _ => line,
            };
            for wave in 1..=N / 2 {
                let mut sum = [0.0; 2];
                for i in 0..N {
                    let window = (PI * (i as f64 + 0.5) / N as f64).sin().powi(2);
                    let (s, c) = (TAU * (wave * i) as f64 / N as f64).sin_cos();
                    let value = window * f64::from(samples[start + i * stride]);
                    sum = [sum[0] + c * value, sum[1] + s * value];
                }
                let power = sum[0] * sum[0] + sum[1] * sum[1];
                all += power;
                short += if N as f64 / wave as f64 <= longest { power } else { 0.0 };
            }
        }
        short / all
    })
}

#[test]
fn the_noise_is_band_limited_and_everywhere() {
    for (wavelength, step) in [(8.0, 0), (8.0, 10), (8.0, 33), (16.0, 20)] {
        let samples = &cube(&format!("&wavelength={wavelength}"), &[step])[0];
        // Sheared waves are shorter than the shortest of the tile, but not by half.
        let short = share_of_short_waves(samples, wavelength / 1.8);
        assert!(short.iter().all(|share| *share < 0.02), "{short:?} at step {step}");
        // Variance 1 in every eighth, and hardly any in its mean: no waves longer than two octaves above.
        for octant in 0..8 {
            let inside = (0..N * N * N).filter(|n| {
                let at = [n % N, n / N % N, n / N / N];
                (0..3).all(|a| (at[a] >= N / 2) == (octant >> a & 1 == 1))
            });
            let (mut sum, mut squares) = (0.0, 0.0);
            for n in inside {
                sum += f64::from(samples[n]);
                squares += f64::from(samples[n] * samples[n]);
            }
            let num = (N * N * N / 8) as f64;
            let (mean, variance) = (sum / num, squares / num);
            assert!((0.6..1.5).contains(&variance) && mean.abs() < 0.15, "{mean} {variance}");
        }
    }
}

#[test]
fn steps_are_coherent_and_move_on() {
    let steps = cube("", &[0, 1, 20, 21, 22, 23, 60, 61, 150]);
    for [a, b] in [[0, 1], [2, 3], [3, 4], [4, 5], [6, 7]] {
        let likeness = correlation(&steps[a], &steps[b]);
        assert!((0.75..0.995).contains(&likeness), "{likeness} between {a} and {b}");
    }
    for [a, b] in [[0, 6], [2, 8], [0, 8]] {
        assert!(correlation(&steps[a], &steps[b]).abs() < 0.3, "{a} and {b}");
    }
    let slow = cube("&speed=0.25", &[20, 21]);
    assert!(correlation(&slow[0], &slow[1]) > 0.97);
}

/// Bricks that are equal would be stored once.
#[test]
fn no_two_bricks_are_alike() {
    let samples = &cube("", &[0])[0];
    let brick = |n: usize| -> Vec<f32> {
        let [x, y, z] = [n % 2, n / 2 % 2, n / 4].map(|b| b * N / 2);
        let half = 0..N / 2;
        half.flat_map(|k| samples[((z + k) * N + y) * N + x..][..N / 2].to_vec()).collect()
    };
    for a in 0..8 {
        for b in 0..a {
            assert!(correlation(&brick(a), &brick(b)).abs() < 0.5, "{a} {b}");
        }
    }
}

#[test]
fn the_same_bits_for_any_number_of_threads_slices_and_order() {
    let spec = "sim:swirl?dims=37x20x45&steps=9&seed=7";
    let with_threads = |n: usize, steps: &[usize]| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        pool.install(|| steps_of(spec, steps))
    };
    let one = with_threads(1, &[0, 4, 8]);
    assert_eq!(one, with_threads(3, &[0, 4, 8]));
    assert_eq!([one[2].clone(), one[0].clone()], with_threads(2, &[8, 0])[..]);
    assert_ne!(one, steps_of(&spec.replace("seed=7", "seed=8"), &[0, 4, 8]));
    let mut series = sim::open(spec).unwrap();
    let mut reader = series.open_step(0, 4).unwrap();
    let mut slices = Vec::new();
    for count in [1, 20, 3, 17, 4] {
        match reader.read_slices(count).unwrap() {
            Samples::F32(samples) => slices.extend(samples),
            Samples::F64(_) => panic!("f32 was declared"),
        }
    }
    assert_eq!(slices, one[1]);
}

#[test]
fn any_shape_and_option_is_finite() {
    for options in
        ["dims=8", "dims=9x16x31&speed=64", "dims=300x8x8&wavelength=4", "dims=40&wavelength=64&speed=0.001"]
    {
        let steps = steps_of(&format!("sim:swirl?{options}&steps=300"), &[0, 299]);
        assert!(steps.iter().flatten().all(|v| v.is_finite() && v.abs() < 8.0), "{options}");
        assert_ne!(steps[0], steps[1]);
    }
}

#[test]
fn it_says_what_it_is_for() {
    let series = sim::open("sim:swirl").unwrap();
    assert_eq!(series.variables()[0].name, "playback_test_pattern");
    for wrong in ["sim:swirl?limit=3", "sim:swirl?wavelength=2", "sim:swirl?speed=0", "sim:swirl?dims=4"] {
        assert!(sim::open(wrong).is_err(), "{wrong}");
    }
}
