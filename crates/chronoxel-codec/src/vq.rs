//! Vector palettes: the entries of a table trained directly on the time series of a brick's samples.
//!
//! The window's samples are vectors of one component per step. A first table comes from splitting, then Lloyd's two steps alternate:
//! each vector takes its nearest entry, each entry becomes the mean of its vectors (Linde, Buzo and Gray 1980). Training
//! looks at a few thousand vectors; the last rounds look at all.

mod nearest;
mod split;

use std::collections::HashSet;

pub use nearest::{Entries, InstructionSet, Nearest, Vectors, nearest, nearest_with};

use crate::{Indices, Palette, UnitWindow};

/// Vectors that are trained on, for each entry.
const TRAINED_PER_ENTRY: usize = 24;
/// Most rounds of Lloyd's iteration on the vectors that are trained on.
const TRAINING_ROUNDS: usize = 8;
/// Rounds over all trained samples of the window.
const FULL_ROUNDS: usize = 1;
/// Training stops when a round gains less than this fraction of the cost.
const LEAST_GAIN: f64 = 2e-3;

/// The palette of least squared error that splitting and Lloyd's iteration find.
///
/// Exact where the trained samples have no more than `num_entries` distinct time series. The same window gives the same
/// palette on every machine.
///
/// * `num_entries`: 1 to 65,536; with up to 256 the indices have 8 bits
pub fn vector_palette(window: &UnitWindow, num_entries: usize) -> Palette {
    let num_entries = num_entries.clamp(1, 1 << 16);
    let num_steps = window.num_steps;
    let all = Vectors { values: &window.values, len: window.num_samples() };
    let core = gather(window, 1);
    let core = Vectors { values: &core, len: window.trained.len() };
    let mut entries = match distinct_series(window, num_entries) {
        Some(values) => Entries { prices: vec![0.0; values.len() / num_steps], values },
        None => {
            let stride = (core.len / (TRAINED_PER_ENTRY * num_entries)).max(1);
            let mut entries = train(window, stride, num_entries);
            for _ in 0..FULL_ROUNDS {
                refine(core, &mut entries);
            }
            entries
        }
    };
    let found = nearest(all, &entries);
    let chosen: Vec<u16> = window.trained.iter().map(|&i| found.indices[i as usize]).collect();
    set_to_means(core, &chosen, &mut entries);
    palette(num_steps, found.indices, &entries)
}

fn palette(num_steps: usize, indices: Vec<u16>, entries: &Entries) -> Palette {
    let num_entries = entries.prices.len();
    let mut values = vec![0.0; entries.values.len()];
    for (e, entry) in entries.values.chunks_exact(num_steps).enumerate() {
        entry.iter().enumerate().for_each(|(t, &value)| values[t * num_entries + e] = value);
    }
    let indices = match num_entries {
        0..=256 => Indices::U8(indices.into_iter().map(|i| i as u8).collect()),
        _ => Indices::U16(indices),
    };
    Palette { indices, values, num_entries }
}

/// Every `stride`-th of the trained samples, `[t, vector]`.
fn gather(window: &UnitWindow, stride: usize) -> Vec<f32> {
    let chosen = || window.trained.iter().step_by(stride);
    (0..window.num_steps)
        .flat_map(|t| {
            let step = window.step(t);
            chosen().map(|&i| step[i as usize])
        })
        .collect()
}

/// The distinct time series of the trained samples as entries, and further ones of the brick while there is room; `None`
/// where those of the trained samples alone are too many.
fn distinct_series(window: &UnitWindow, num_entries: usize) -> Option<Vec<f32>> {
    let n = window.num_samples();
    let series = |i: usize| (0..window.num_steps).map(move |t| window.values[t * n + i]);
    let mut seen: HashSet<Vec<u32>> = HashSet::new();
    let mut entries = Vec::new();
    let mut key = Vec::with_capacity(window.num_steps);
    let trained = window.trained.iter().map(|&i| i as usize);
    for (is_trained, i) in trained.map(|i| (true, i)).chain((0..n).map(|i| (false, i))) {
        key.clear();
        key.extend(series(i).map(f32::to_bits));
        if !seen.contains(&key) {
            if seen.len() == num_entries {
                if is_trained {
                    return None;
                }
                break;
            }
            seen.insert(key.clone());
            entries.extend(series(i));
        }
    }
    Some(entries)
}

/// Entries trained on every `stride`-th of the trained samples.
fn train(window: &UnitWindow, stride: usize, num_entries: usize) -> Entries {
    let num_steps = window.num_steps;
    let values = gather(window, stride);
    let vectors = Vectors { values: &values, len: values.len() / num_steps };
    let mut by_vector = vec![0.0; values.len()];
    for (t, component) in values.chunks_exact(vectors.len).enumerate() {
        component.iter().enumerate().for_each(|(i, &x)| by_vector[i * num_steps + t] = x);
    }
    let mut first = split::split(&mut by_vector, num_steps, num_entries);
    // Entries that splitting has no vectors for start as copies of the first and are seeded anew.
    while first.len() < num_entries * num_steps {
        first.extend_from_within(..num_steps);
    }
    let mut entries = Entries { values: first, prices: vec![0.0; num_entries] };
    let mut last_cost = f64::INFINITY;
    for _ in 0..TRAINING_ROUNDS {
        let cost = refine(vectors, &mut entries);
        if cost >= last_cost * (1.0 - LEAST_GAIN) {
            break;
        }
        last_cost = cost;
    }
    entries
}

/// One round of Lloyd's iteration; entries without vectors move to the vectors of largest cost. Returns the cost before.
fn refine(vectors: Vectors, entries: &mut Entries) -> f64 {
    let found = nearest(vectors, entries);
    let counts = set_to_means(vectors, &found.indices, entries);
    let num_empty = counts.iter().filter(|&&count| count == 0).count();
    if num_empty > 0 {
        seed_empty(vectors, &found.costs, &counts, entries);
    }
    found.costs.iter().map(|&cost| f64::from(cost)).sum()
}

/// Makes each entry the mean of the vectors that chose it, if any did, and says how many did.
fn set_to_means(vectors: Vectors, indices: &[u16], entries: &mut Entries) -> Vec<u32> {
    let num_entries = entries.prices.len();
    let num_steps = vectors.num_steps();
    let mut counts = vec![0u32; num_entries];
    indices.iter().for_each(|&index| counts[usize::from(index)] += 1);
    let mut sums = vec![0.0f64; num_entries];
    for (t, component) in vectors.values.chunks_exact(vectors.len).enumerate() {
        sums.fill(0.0);
        component.iter().zip(indices).for_each(|(&x, &index)| sums[usize::from(index)] += f64::from(x));
        for (e, (&sum, &count)) in sums.iter().zip(&counts).enumerate() {
            if count > 0 {
                entries.values[e * num_steps + t] = (sum / f64::from(count)) as f32;
            }
        }
    }
    counts
}

/// Moves entries without vectors to the vectors of largest cost, the first of equal ones first.
fn seed_empty(vectors: Vectors, costs: &[f32], counts: &[u32], entries: &mut Entries) {
    let num_steps = vectors.num_steps();
    let empty: Vec<usize> = (0..counts.len()).filter(|&e| counts[e] == 0).collect();
    let mut worst: Vec<usize> = (0..vectors.len).collect();
    let order = |&a: &usize, &b: &usize| costs[b].total_cmp(&costs[a]).then(a.cmp(&b));
    let num_seeds = empty.len().min(worst.len());
    if num_seeds < worst.len() {
        worst.select_nth_unstable_by(num_seeds, order);
        worst.truncate(num_seeds);
    }
    worst.sort_unstable_by(order);
    for (&e, &i) in empty.iter().zip(&worst) {
        for t in 0..num_steps {
            entries.values[e * num_steps + t] = vectors.values[t * vectors.len + i];
        }
    }
}
