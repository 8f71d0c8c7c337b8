//! Vector palettes over bricks of every kind: exactness, order of errors, the product palette beside them, and the
//! kernel with every instruction set.

use std::f64::consts::TAU;

use chronoxel_codec::{
    Indices, Palette, Payload, UnitWindow, VectorTable, code_stages, decode_f64, product_palette,
    vector_palette,
    vq::{Entries, InstructionSet, Vectors, nearest_with},
};
use chronoxel_core::BrickLayout;

mod random;
use random::Random;

fn core_of(layout: &BrickLayout) -> Vec<u32> {
    let (full, core) = (layout.full_edge(), layout.low..layout.low + layout.edge);
    let inside = |i: usize| [i % full, i / full % full, i / full / full].iter().all(|c| core.contains(c));
    (0..layout.num_full()).filter(|&i| inside(i)).map(|i| i as u32).collect()
}

fn window_of(steps: &[Vec<f64>], trained: Vec<u32>) -> UnitWindow {
    let steps: Vec<&[f64]> = steps.iter().map(|step| &step[..]).collect();
    UnitWindow::new(&steps, trained).unwrap()
}

/// A field like the dissipation of turbulence, nearly log-normal: the exponential of waves of random direction and phase,
/// with amplitudes that fall as `k^(-5/6 - 1)` (the energy of a shell as `k^(-5/3)`), each turning at a rate of its own that
/// grows with `k`.
fn turbulence(layout: &BrickLayout, num_steps: usize) -> Vec<Vec<f64>> {
    let mut random = Random(11);
    let waves: Vec<[f64; 6]> = (0..40)
        .map(|i| {
            let k = 0.1 * 1.07f64.powi(i);
            let (z, angle) = (2.0 * random.unit() - 1.0, TAU * random.unit());
            let flat = (1.0 - z * z).sqrt();
            let rate = (random.unit() - 0.5) * k.powf(2.0 / 3.0);
            [
                k * flat * angle.cos(),
                k * flat * angle.sin(),
                k * z,
                TAU * random.unit(),
                rate,
                k.powf(-11.0 / 6.0),
            ]
        })
        .collect();
    let deviation = waves.iter().map(|w| w[5] * w[5] / 2.0).sum::<f64>().sqrt();
    let full = layout.full_edge();
    let value = |i: usize, t: usize| -> f64 {
        let [x, y, z] = [i % full, i / full % full, i / full / full].map(|c| c as f64);
        let wave = |w: &[f64; 6]| w[5] * (w[0] * x + w[1] * y + w[2] * z + w[3] + w[4] * t as f64).cos();
        (waves.iter().map(wave).sum::<f64>() / deviation).exp()
    };
    (0..num_steps).map(|t| (0..layout.num_full()).map(|i| value(i, t)).collect()).collect()
}

/// Windows of every kind that training stumbles over, with names.
fn windows() -> Vec<(&'static str, UnitWindow)> {
    let layout = BrickLayout::new(8).unwrap();
    let n = layout.num_full();
    let mut random = Random(5);
    let mut windows = Vec::new();
    let mut add = |name, steps: Vec<Vec<f64>>| windows.push((name, window_of(&steps, core_of(&layout))));
    for num_steps in [1, 2, 3, 5, 8, 16, 20] {
        let mut field = |f: &mut dyn FnMut(&mut Random) -> f64| {
            (0..num_steps).map(|_| (0..n).map(|_| f(&mut random)).collect()).collect()
        };
        add("noise", field(&mut |r| r.unit()));
        add("heavy tails", field(&mut |r| 1.0 / (1e-3 + r.unit()) - 1.0 / (1e-3 + r.unit())));
        add("two values", field(&mut |r| [-3.0, 5.0][(r.next() % 2) as usize]));
        add("rare spikes", field(&mut |r| if r.next() % 500 == 0 { 1e6 } else { r.unit() }));
        add("constant", field(&mut |_| 7.25));
        add("denormal", field(&mut |r| f64::from_bits(r.next() % 1000)));
        add("huge", field(&mut |r| r.unit() * 1e308));
        add("far from zero", field(&mut |r| 1e12 + r.unit()));
        add("turbulence", turbulence(&layout, num_steps));
    }
    let steps: Vec<Vec<f64>> = (0..4).map(|_| (0..n).map(|_| random.unit()).collect()).collect();
    windows.push(("one trained sample", window_of(&steps, vec![700])));
    windows.push(("three trained samples", window_of(&steps, vec![0, 700, 1330])));
    windows
}

fn index(palette: &Palette, at: usize) -> usize {
    match &palette.indices {
        Indices::U8(v) => usize::from(v[at]),
        Indices::U16(v) => usize::from(v[at]),
    }
}

#[test]
fn every_window_has_a_sound_palette_and_never_a_worse_one_than_the_product_palette() {
    for (name, window) in windows() {
        for num_entries in [1, 2, 7, 64, 256, 300] {
            let palette = vector_palette(&window, num_entries);
            let what = format!("{name}, {} steps, {num_entries} entries", window.num_steps);
            assert!(palette.num_entries <= num_entries, "{what}");
            assert_eq!(palette.values.len(), palette.num_entries * window.num_steps, "{what}");
            assert_eq!(palette.indices.len(), window.num_samples(), "{what}");
            assert!(usize::from(palette.indices.largest()) < palette.num_entries, "{what}");
            assert!(palette.values.iter().all(|v| (0.0..=1.0).contains(v)), "{what}");
            assert_eq!(palette.indices.bits(), if palette.num_entries <= 256 { 8 } else { 16 }, "{what}");
            let product = product_palette(&window, num_entries.ilog2().min(8)).squared_error(&window);
            let error = palette.squared_error(&window);
            assert!(error <= product, "{what}: {error} is more than {product}");
            assert_eq!(palette, vector_palette(&window.clone(), num_entries), "{what}");
        }
    }
}

#[test]
fn more_entries_err_less() {
    for (name, window) in windows() {
        let errors: Vec<f64> =
            [1, 4, 16, 64, 256].map(|n| vector_palette(&window, n).squared_error(&window)).to_vec();
        // Rounded entries may add a hundredth where more entries cannot help.
        for pair in errors.windows(2) {
            assert!(pair[1] <= pair[0] * 1.01, "{name}, {} steps: {errors:?}", window.num_steps);
        }
    }
}

#[test]
fn one_entry_is_the_mean() {
    for (name, window) in windows() {
        let palette = vector_palette(&window, 1);
        for t in 0..window.num_steps {
            let trained = window.trained.iter().map(|&i| f64::from(window.step(t)[i as usize]));
            let (values, n) = (trained.clone().collect::<Vec<_>>(), window.trained.len() as f64);
            let mean = values.iter().sum::<f64>() / n;
            let deviation = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
            // Entries lose bits that add a hundredth of the squared error: a step of a third of the deviation.
            let bound = 0.4 * deviation + 1e-6;
            assert!((f64::from(palette.values[t]) - mean).abs() <= bound, "{name} {t}");
        }
    }
}

#[test]
fn few_distinct_series_are_exact() {
    let layout = BrickLayout::new(8).unwrap();
    let mut random = Random(8);
    for (num_series, num_steps) in [(1usize, 8usize), (2, 1), (37, 3), (256, 8), (200, 16)] {
        let series: Vec<Vec<f64>> =
            (0..num_series).map(|_| (0..num_steps).map(|_| random.unit()).collect()).collect();
        // One series has a single sample.
        let which: Vec<usize> = (0..layout.num_full())
            .map(|i| if i == 700 { 0 } else { i % num_series.max(2).min(num_series) })
            .collect();
        let steps: Vec<Vec<f64>> =
            (0..num_steps).map(|t| which.iter().map(|&s| series[s][t]).collect()).collect();
        let window = window_of(&steps, core_of(&layout));
        let palette = vector_palette(&window, 256);
        for t in 0..num_steps {
            for (i, &x) in window.step(t).iter().enumerate() {
                assert_eq!(
                    palette.values[t * palette.num_entries + index(&palette, i)],
                    x,
                    "{num_series} {t} {i}"
                );
            }
        }
        let payload = Payload { stages: vec![palette.to_stage(&window, &layout, 256, 16).unwrap()] };
        for (t, step) in steps.iter().enumerate() {
            let decoded = decode_f64(&payload, &layout, t as u32).unwrap();
            assert!(decoded.iter().zip(step).all(|(a, b)| (a - b).abs() <= 0.51 * window.width / 65535.0));
        }
    }
}

#[test]
fn on_turbulence_the_error_is_forty_percent_below_the_product_palette() {
    let layout = BrickLayout::new(32).unwrap();
    let window = window_of(&turbulence(&layout, 8), core_of(&layout));
    let product = product_palette(&window, 8).squared_error(&window);
    let vector = vector_palette(&window, 256).squared_error(&window);
    assert!(vector <= 0.6 * product, "{vector} of {product}");
}

#[test]
fn a_price_for_bits_buys_entropy_for_error() {
    let layout = BrickLayout::new(16).unwrap();
    let window = window_of(&turbulence(&layout, 8), core_of(&layout));
    let mut table = VectorTable::train(&window, 256);
    let free = table.palette();
    let entropy = |palette: &Palette| {
        let mut counts = vec![0usize; palette.num_entries];
        window.trained.iter().for_each(|&i| counts[index(palette, i as usize)] += 1);
        let n = window.trained.len() as f64;
        counts.iter().filter(|&&c| c > 0).map(|&c| c as f64 * (n / c as f64).log2()).sum::<f64>()
    };
    let mut last = (entropy(&free), free.squared_error(&window));
    for factor in [4.0, 16.0, 64.0] {
        let slope = factor * table.slope();
        let palette = table.priced_palette(slope);
        let now = (entropy(&palette), palette.squared_error(&window));
        assert!(now.0 < last.0 && now.1 > last.1, "{factor}: {now:?} after {last:?}");
        // The palette has the lower sum of error and price than the free one.
        assert!(now.1 + slope * now.0 < free.squared_error(&window) + slope * entropy(&free), "{factor}");
        last = now;
    }
    // A price beyond any gain leaves one entry.
    assert_eq!(table.priced_palette(1e9).num_entries, 1);
}

#[test]
fn each_stage_lowers_the_error() {
    let layout = BrickLayout::new(16).unwrap();
    let steps = turbulence(&layout, 8);
    let window = window_of(&steps, core_of(&layout));
    let mut last = f64::INFINITY;
    for num_stages in 1..=3 {
        let payload =
            code_stages(&window, &layout, num_stages, 256, 8, |left| vector_palette(left, 256)).unwrap();
        assert_eq!(payload.stages.len(), num_stages);
        let error: f64 = (0..8)
            .map(|t| {
                let decoded = decode_f64(&payload, &layout, t).unwrap();
                let step = &steps[t as usize];
                window.trained.iter().map(|&i| (decoded[i as usize] - step[i as usize]).powi(2)).sum::<f64>()
            })
            .sum();
        assert!(error < 0.6 * last, "{num_stages}: {error} after {last}");
        last = error;
    }
    let constant = window_of(&vec![vec![3.0; layout.num_full()]; 4], core_of(&layout));
    assert_eq!(
        code_stages(&constant, &layout, 3, 256, 4, |left| vector_palette(left, 256)).unwrap().stages.len(),
        1
    );
}

#[test]
fn every_instruction_set_finds_the_same_entries_and_costs() {
    let mut random = Random(9);
    for num_steps in [1, 2, 3, 4, 7, 8, 13, 16, 17, 40] {
        for (num_vectors, num_entries) in [(1, 1), (15, 256), (16, 3), (1000, 300), (100, 1024)] {
            // Few values, so that distances tie.
            let mut value = |few: bool| match few {
                true => (random.next() % 4) as f32 / 4.0,
                false => random.unit() as f32,
            };
            for few in [false, true] {
                let values: Vec<f32> = (0..num_vectors * num_steps).map(|_| value(few)).collect();
                let entries = Entries {
                    values: (0..num_entries * num_steps).map(|_| value(few)).collect(),
                    prices: (0..num_entries).map(|_| if few { 0.0 } else { 0.1 * value(few) }).collect(),
                };
                let vectors = Vectors { values: &values, len: num_vectors };
                let plain = nearest_with(InstructionSet::Plain, vectors, &entries);
                for set in InstructionSet::available() {
                    assert_eq!(nearest_with(set, vectors, &entries), plain, "{set:?}");
                }
                for (v, (&found, &cost)) in plain.indices.iter().zip(&plain.costs).enumerate() {
                    let mut best = (0, f32::INFINITY);
                    for (e, entry) in entries.values.chunks_exact(num_steps).enumerate() {
                        let difference = |t: usize| values[t * num_vectors + v] - entry[t];
                        let distance = (0..num_steps).map(|t| difference(t) * difference(t)).sum::<f32>();
                        if distance + entries.prices[e] < best.1 {
                            best = (e, distance + entries.prices[e]);
                        }
                    }
                    assert_eq!((usize::from(found), cost), best);
                }
            }
        }
    }
}
