//! Vector palettes: the entries of a table trained directly on the time series of a brick's samples.
//!
//! The window's samples are vectors of one component per step. A first table comes from splitting, then Lloyd's two steps alternate:
//! each vector takes its nearest entry, each entry becomes the mean of its vectors (Linde, Buzo and Gray 1980). Training
//! looks at a few thousand vectors; the last rounds look at all.

mod nearest;
pub(crate) mod split;

use std::collections::HashSet;

pub use nearest::{Entries, InstructionSet, Nearest, Vectors, nearest, nearest_with};

use crate::{Indices, Palette, ProductQuantizer, UnitWindow, product_palette};

/// Vectors that are trained on, for each entry, but at least [`LEAST_TRAINED`] in all.
const TRAINED_PER_ENTRY: usize = 24;
/// See [`TRAINED_PER_ENTRY`].
const LEAST_TRAINED: usize = 4096;
/// Most rounds of Lloyd's iteration on the vectors that are trained on.
const TRAINING_ROUNDS: usize = 8;
/// Rounds over all trained samples of the window.
const FULL_ROUNDS: usize = 1;
/// Training stops when a round gains less than this fraction of the cost.
const LEAST_GAIN: f64 = 2e-3;

/// Entries lose low bits as long as that adds less than this fraction to the squared error.
const ROUNDING_LOSS: f64 = 0.01;
/// Rounds on the vectors that are trained on, where indices have a price.
const PRICED_ROUNDS: usize = 4;

/// The palette of least squared error that splitting and Lloyd's iteration find.
///
/// Exact where the trained samples have no more than `num_entries` distinct time series. The same window gives the same
/// palette on every machine.
///
/// * `num_entries`: 1 to 65,536; with up to 256 the indices have 8 bits
pub fn vector_palette(window: &UnitWindow, num_entries: usize) -> Palette {
    VectorTable::train(window, num_entries).palette()
}

/// A table trained on a window: what palettes of several prices of a bit are made from.
#[derive(Debug, Clone)]
pub struct VectorTable<'a> {
    window: &'a UnitWindow,
    /// All trained samples, `[t, vector]`.
    core: Vec<f32>,
    /// Those that most rounds look at, `[t, vector]`.
    chosen: Vec<f32>,
    entries: Entries,
    /// Mean squared error of a vector, in the last round on the chosen ones.
    mean_cost: f64,
    /// Entries that were asked for.
    num_entries: usize,
    /// Whether every trained sample is an entry.
    exact: bool,
}

impl<'a> VectorTable<'a> {
    /// Trains a table of up to `num_entries` entries, 1 to 65,536, on a few thousand of the trained samples.
    pub fn train(window: &'a UnitWindow, num_entries: usize) -> Self {
        let num_entries = num_entries.clamp(1, 1 << 16);
        let core = gather(window, 1);
        let num_chosen = (TRAINED_PER_ENTRY * num_entries).max(LEAST_TRAINED);
        let stride = (window.trained.len() / num_chosen).max(1);
        let chosen = gather(window, stride);
        let mut table = Self {
            window,
            core,
            chosen,
            entries: Entries { values: Vec::new(), prices: Vec::new() },
            mean_cost: 0.0,
            num_entries,
            exact: false,
        };
        if let Some(values) = distinct_series(window, num_entries) {
            table.entries = Entries { prices: vec![0.0; values.len() / window.num_steps], values };
            table.exact = true;
            table.chosen.clone_from(&table.core);
        } else {
            (table.entries, table.mean_cost) = train(table.vectors(&table.chosen), num_entries);
        }
        table
    }

    /// The slope of the table, in squared error per bit: where one bit more or less for each vector would change
    /// the squared error as much as theory has it at high rate, `2 ln 2 / N` of it.
    ///
    /// Below it prices of a bit change little; above it entries fall away.
    pub fn slope(&self) -> f64 {
        2.0 * std::f64::consts::LN_2 / self.window.num_steps as f64 * self.mean_cost
    }

    /// The palette of least squared error, never above that of the product palette of as many entries.
    pub fn palette(&self) -> Palette {
        if self.exact {
            return self.assign(self.entries.clone());
        }
        let mut entries = self.entries.clone();
        for _ in 0..FULL_ROUNDS {
            refine(self.vectors(&self.core), &mut entries);
        }
        let palette = self.assign(entries);
        self.unless_product_is_better(palette)
    }

    /// The palette, or where the product palette errs less, that.
    ///
    /// It is fitted to the whole window only where it comes close on the vectors that were trained on: on noise, whose
    /// components have nothing to do with each other.
    fn unless_product_is_better(&self, palette: Palette) -> Palette {
        let bits = self.num_entries.ilog2().min(8);
        let num_steps = self.window.num_steps;
        let all: Vec<u32> = (0..(self.chosen.len() / num_steps) as u32).collect();
        let product = ProductQuantizer::fit(&self.chosen, num_steps, &all, bits);
        let indices: Vec<u16> = product.code(&self.chosen).into_iter().map(u16::from).collect();
        let table = product.table();
        let mut error = 0.0;
        for (component, row) in
            self.chosen.chunks_exact(indices.len()).zip(table.chunks_exact(product.num_entries()))
        {
            let difference = |(&x, &i): (&f32, &u16)| f64::from(x - row[usize::from(i)]);
            error += component.iter().zip(&indices).map(|pair| difference(pair).powi(2)).sum::<f64>();
        }
        if error > PRODUCT_IS_FAR * self.mean_cost * indices.len() as f64 {
            return palette;
        }
        let product = product_palette(self.window, bits);
        let better = product.squared_error(self.window) < palette.squared_error(self.window);
        if better { product } else { palette }
    }

    /// The palette of least squared error plus `slope` times the bits of its indices, these having the length of an ideal
    /// code for how often each is used (entropy-constrained vector quantisation: Chou, Lookabaugh and Gray 1989).
    ///
    /// The table goes on from what it was: ask for slopes from small to large.
    ///
    /// * `slope`: squared error in the units of the window, per bit; at least 0
    pub fn priced_palette(&mut self, slope: f64) -> Palette {
        let vectors = Vectors { values: &self.chosen, len: self.chosen.len() / self.window.num_steps };
        for _ in 0..PRICED_ROUNDS {
            refine_priced(vectors, &mut self.entries, slope);
        }
        let mut entries = self.entries.clone();
        refine_priced(self.vectors(&self.core), &mut entries, slope);
        self.assign(entries)
    }

    /// Gives every sample of the brick its entry, and each entry the mean of its trained samples.
    fn assign(&self, mut entries: Entries) -> Palette {
        let (window, core) = (self.window, self.vectors(&self.core));
        let shift = if self.exact { 0 } else { self.spare_bits() };
        round_entries(&mut entries.values, shift);
        let found = nearest(Vectors { values: &window.values, len: window.num_samples() }, &entries);
        let indices: Vec<u16> = window.trained.iter().map(|&i| found.indices[i as usize]).collect();
        set_to_means(core, &indices, &mut entries);
        round_entries(&mut entries.values, shift);
        palette(window.num_steps, found.indices, &entries)
    }

    /// Low bits of the entries that add little to the squared error when they are dropped.
    fn spare_bits(&self) -> u32 {
        let noise = self.mean_cost / self.window.num_steps as f64 * ROUNDING_LOSS * 12.0;
        (1..=MOST_SPARE_BITS).rev().find(|&bits| unit_of_entry(bits).powi(2) <= noise).unwrap_or(0)
    }

    fn vectors<'b>(&self, values: &'b [f32]) -> Vectors<'b> {
        Vectors { values, len: values.len() / self.window.num_steps }
    }
}

/// Where a product palette errs this many times as much on the vectors trained on, it errs more on all.
const PRODUCT_IS_FAR: f64 = 1.2;
/// Most low bits that entries may lose.
const MOST_SPARE_BITS: u32 = 10;

/// Distance of two neighbouring entries whose low `bits` bits are zero.
fn unit_of_entry(bits: u32) -> f64 {
    f64::from(1u32 << bits) / 65535.0
}

/// Rounds values to entries whose low `bits` bits are zero, so that they compress.
fn round_entries(values: &mut [f32], bits: u32) {
    if bits > 0 {
        let unit = unit_of_entry(bits) as f32;
        let largest = ((1u32 << (16 - bits)) - 1) as f32;
        values.iter_mut().for_each(|v| *v = (*v / unit).round_ties_even().clamp(0.0, largest) * unit);
    }
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

/// Entries trained on the vectors, and the mean cost of a vector in the last round.
fn train(vectors: Vectors, num_entries: usize) -> (Entries, f64) {
    let num_steps = vectors.num_steps();
    let mut by_vector = vec![0.0; vectors.values.len()];
    for (t, component) in vectors.values.chunks_exact(vectors.len).enumerate() {
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
        let stalled = cost >= last_cost * (1.0 - LEAST_GAIN);
        last_cost = cost;
        if stalled {
            break;
        }
    }
    (entries, last_cost / vectors.len as f64)
}

/// One round of Lloyd's iteration with a price for each bit; entries without vectors are dropped.
fn refine_priced(vectors: Vectors, entries: &mut Entries, slope: f64) {
    let found = nearest(vectors, entries);
    let counts = set_to_means(vectors, &found.indices, entries);
    let used = counts.iter().map(|&count| count > 0);
    let num_steps = vectors.num_steps();
    let mut values = Vec::with_capacity(entries.values.len());
    entries.values.chunks_exact(num_steps).zip(used).filter(|(_, used)| *used).for_each(|(entry, _)| {
        values.extend_from_slice(entry);
    });
    let price = |count: u32| (slope * libm::log2(vectors.len as f64 / f64::from(count))) as f32;
    let prices = counts.iter().filter(|&&count| count > 0).map(|&count| price(count)).collect();
    *entries = Entries { values, prices };
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
