//! The palette of lum2001, section 3.3: a transform over the steps of a window, a scalar quantiser for each coefficient, and
//! the numbers of their levels packed into one index.

use std::ops::Range;

use crate::{Dct, Indices, LloydMax, Palette, UnitWindow, allocate_bits};

/// Most bits of an index.
const MAX_BITS: u32 = 8;

/// The quantiser of vectors of one length that lum2001 describes, and the table that decodes its indices.
///
/// A vector holds the samples of one place over the steps of a window. Its DCT coefficients get bits by their variances
/// ([`allocate_bits`]), those with bits are quantised by [`LloydMax`] quantisers of `2^bits` levels, and the numbers of the levels,
/// the coefficient of most bits highest, make the index. A table entry is, per step, the mean of the trained vectors that have the
/// index; where none has, of the others that have it (on the aprons of test fields, 0.36 to 0.02 of the square error of
/// moving them to the nearest trained entry); and where no vector at all has it, the inverse transform of the levels (of the mean where
/// a coefficient has no bits), clamped to [0, 1], for vectors that come later.
#[derive(Debug, Clone, PartialEq)]
pub struct ProductQuantizer {
    dct: Dct,
    /// Coefficients with bits: which, how far up its level goes in the index, and its quantiser.
    parts: Vec<Part>,
    num_entries: usize,
    /// `[t, entry]`.
    table: Vec<f32>,
}

#[derive(Debug, Clone, PartialEq)]
struct Part {
    coefficient: usize,
    shift: u32,
    bits: u32,
    quantizer: LloydMax,
}

impl ProductQuantizer {
    /// The quantiser fitted to some of the vectors.
    ///
    /// * `values`: `[t, vector]`, in [0, 1]
    /// * `num_steps`: length of the vectors, at least 1
    /// * `trained`: which vectors to fit to, increasing; the others count only for entries that none of these has
    /// * `bits`: of an index; more than 8 count as 8
    ///
    /// # Panics
    /// If `trained` names a vector that `values` does not have.
    pub fn fit(values: &[f32], num_steps: usize, trained: &[u32], bits: u32) -> Self {
        let dct = Dct::new(num_steps);
        let coefficients = dct.forward(values);
        Self::fit_coefficients(dct, values, &coefficients, &runs_of(trained), bits).0
    }

    /// Entries of the table: a power of two, at most 256.
    pub fn num_entries(&self) -> usize {
        self.num_entries
    }

    /// The decoded values, `[t, entry]`, each in [0, 1].
    pub fn table(&self) -> &[f32] {
        &self.table
    }

    /// The indices of vectors `[t, vector]`, of the length and in the units of those fitted to.
    pub fn code(&self, values: &[f32]) -> Vec<u8> {
        let num_vectors = values.len() / self.dct.num_steps();
        code(&self.parts, &self.dct.forward(values), num_vectors)
    }

    /// The quantiser, and the indices of all vectors.
    fn fit_coefficients(
        dct: Dct,
        values: &[f32],
        coefficients: &[f32],
        runs: &[Range<usize>],
        bits: u32,
    ) -> (Self, Vec<u8>) {
        let num_vectors = values.len() / dct.num_steps();
        let planes = || coefficients.chunks_exact(num_vectors.max(1));
        let moments: Vec<Moments> = planes().map(|plane| Moments::of(plane, runs)).collect();
        let variances: Vec<f64> = moments.iter().map(|m| m.variance).collect();
        let bits = allocate_bits(&variances, bits.min(MAX_BITS));
        let mut shift = bits.iter().sum();
        let num_entries = 1usize << shift;
        let mut order: Vec<usize> = (0..bits.len()).filter(|&u| bits[u] > 0).collect();
        order.sort_by_key(|&u| std::cmp::Reverse(bits[u]));
        let part = |u: usize| {
            shift -= bits[u];
            let plane = &coefficients[u * num_vectors..][..num_vectors];
            Part { coefficient: u, shift, bits: bits[u], quantizer: LloydMax::fit(plane, runs, 1 << bits[u]) }
        };
        let parts: Vec<Part> = order.into_iter().map(part).collect();
        let indices = code(&parts, coefficients, num_vectors);
        let means: Vec<f32> = moments.iter().map(|m| m.mean as f32).collect();
        let mut table = inverse_table(&dct, &parts, &means, num_entries);
        put_means(&mut table, num_entries, values, &indices, runs);
        (Self { dct, parts, num_entries, table }, indices)
    }
}

/// The palette of a window: a [`ProductQuantizer`] fitted to its trained samples, and the index of every sample.
///
/// * `bits`: of an index; more than 8 count as 8
///
/// # Panics
/// If the window's `trained` names a sample that it does not have.
pub fn product_palette(window: &UnitWindow, bits: u32) -> Palette {
    let dct = Dct::new(window.num_steps);
    let coefficients = dct.forward(&window.values);
    let runs = runs_of(&window.trained);
    let (quantizer, indices) =
        ProductQuantizer::fit_coefficients(dct, &window.values, &coefficients, &runs, bits);
    Palette { indices: Indices::U8(indices), values: quantizer.table, num_entries: quantizer.num_entries }
}

/// Runs of neighbours among the trained samples, so that inner loops are over slices.
fn runs_of(trained: &[u32]) -> Vec<Range<usize>> {
    let mut runs: Vec<Range<usize>> = Vec::new();
    for at in trained.iter().map(|&at| at as usize) {
        match runs.last_mut() {
            Some(run) if run.end == at => run.end += 1,
            _ => runs.push(at..at + 1),
        }
    }
    runs
}

/// Mean and variance of a coefficient over the trained vectors.
struct Moments {
    mean: f64,
    variance: f64,
}

impl Moments {
    fn of(plane: &[f32], runs: &[Range<usize>]) -> Self {
        const LANES: usize = 8;
        // About the first value, so that a coefficient that does not vary has a variance of exactly zero.
        let first = runs.first().map_or(0.0, |run| plane[run.start]);
        let (mut sums, mut squares, mut count) = ([0f64; LANES], [0f64; LANES], 0);
        for run in runs {
            let (chunks, rest) = plane[run.clone()].as_chunks::<LANES>();
            let mut take = |lane: usize, value: f32| {
                let value = f64::from(value - first);
                sums[lane] += value;
                squares[lane] += value * value;
            };
            chunks.iter().for_each(|c| c.iter().enumerate().for_each(|(lane, &v)| take(lane, v)));
            rest.iter().enumerate().for_each(|(lane, &v)| take(lane, v));
            count += run.len();
        }
        let count = count.max(1) as f64;
        let mean = sums.iter().sum::<f64>() / count;
        let variance = (squares.iter().sum::<f64>() / count - mean * mean).max(0.0);
        Self { mean: f64::from(first) + mean, variance }
    }
}

fn code(parts: &[Part], coefficients: &[f32], num_vectors: usize) -> Vec<u8> {
    let mut indices = vec![0; num_vectors];
    for part in parts {
        let plane = &coefficients[part.coefficient * num_vectors..][..num_vectors];
        part.quantizer.add_codes(plane, part.shift, &mut indices);
    }
    indices
}

/// The inverse transform of the levels of every index, clamped to [0, 1]: `[t, entry]`.
fn inverse_table(dct: &Dct, parts: &[Part], means: &[f32], num_entries: usize) -> Vec<f32> {
    let mut coefficients: Vec<f32> = means.iter().flat_map(|&mean| vec![mean; num_entries]).collect();
    for part in parts {
        let plane = &mut coefficients[part.coefficient * num_entries..][..num_entries];
        let levels = part.quantizer.levels();
        for (entry, coefficient) in plane.iter_mut().enumerate() {
            let level = entry >> part.shift & ((1 << part.bits) - 1);
            *coefficient = levels[level.min(levels.len() - 1)];
        }
    }
    let mut table = dct.inverse(&coefficients);
    table.iter_mut().for_each(|value| *value = value.clamp(0.0, 1.0));
    table
}

/// Replaces the entries of indices that vectors have by their means: of the trained ones, or of the others where none is
/// trained.
fn put_means(table: &mut [f32], num_entries: usize, values: &[f32], indices: &[u8], runs: &[Range<usize>]) {
    let mut counts = [0u32; 256];
    runs.iter().for_each(|run| indices[run.clone()].iter().for_each(|&i| counts[usize::from(i)] += 1));
    let trained = counts.map(|count| count > 0);
    let others = (0..indices.len()).filter(|&at| !trained[usize::from(indices[at])]);
    let others: Vec<usize> = others.inspect(|&at| counts[usize::from(indices[at])] += 1).collect();
    let per_count = counts.map(|count| 1.0 / f64::from(count.max(1)));
    for (row, values) in table.chunks_exact_mut(num_entries).zip(values.chunks_exact(indices.len().max(1))) {
        // Neighbours often have one index: two sums, so that one need not wait for the other.
        let mut sums = [[0f64; 2]; 256];
        for run in runs {
            let pairs = indices[run.clone()].iter().zip(&values[run.clone()]);
            pairs.enumerate().for_each(|(at, (&i, &value))| sums[usize::from(i)][at % 2] += f64::from(value));
        }
        others.iter().for_each(|&at| sums[usize::from(indices[at])][0] += f64::from(values[at]));
        for (entry, value) in row.iter_mut().enumerate() {
            if counts[entry] > 0 {
                *value = ((sums[entry][0] + sums[entry][1]) * per_count[entry]).clamp(0.0, 1.0) as f32;
            }
        }
    }
}
