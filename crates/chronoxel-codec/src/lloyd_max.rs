//! The Lloyd-Max quantiser of one coefficient: the levels of least mean square error for its distribution.
//!
//! The distribution is a histogram of [`NUM_BINS`] bins; thresholds lie between bins, so that a code is a look-up by
//! bin. Lloyd's iteration alternates the two conditions of an optimum (thresholds half-way between levels, levels at the
//! means of their cells) from two starts, and the better result counts: the exact optimum over the cells of a coarser
//! histogram, by dynamic programming, for few levels; and levels as dense as the third root of the density, which is the
//! optimum for many. A bin adds `1 / (12 * 4096^2)` of the squared range to the error, -83 dB.

use std::ops::Range;

/// Bins of a histogram.
pub const NUM_BINS: usize = 4096;
/// Most levels of a quantiser.
pub const MAX_LEVELS: usize = 256;
/// Most levels for which the coarse optimum is sought.
const MAX_COARSE_LEVELS: usize = 32;
/// Cells of the coarse histogram.
const NUM_COARSE: usize = 256;
/// Iterations at most; a fixed point usually comes earlier.
const MAX_ITERATIONS: usize = 200;
/// A range below this counts as one value.
const MIN_RANGE: f32 = 1e-9;
/// Added to a number below 2^23, leaves it rounded to an integer in the lowest bits.
const ROUND: f32 = (1 << 23) as f32;
/// Samples whose bins are found at a time.
const BLOCK: usize = 64;

/// Bins over a range: bin `k` holds what is nearest to `low + k / bins_per_unit`.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Bins {
    low: f32,
    high: f32,
    bins_per_unit: f32,
}

impl Bins {
    fn new(low: f32, high: f32) -> Self {
        let width = high - low;
        let bins_per_unit =
            if width >= MIN_RANGE && width.is_finite() { (NUM_BINS - 1) as f32 / width } else { 0.0 };
        Self { low, high, bins_per_unit }
    }

    /// The bin of a value; what lies outside the range counts as its nearer end.
    #[inline(always)]
    fn of(&self, value: f32) -> usize {
        let value = if value > self.low { value } else { self.low };
        let value = if value < self.high { value } else { self.high };
        ((value - self.low) * self.bins_per_unit + ROUND).to_bits() as usize % NUM_BINS
    }

    fn each(&self, values: &[f32], mut take: impl FnMut(usize, usize)) {
        let mut bins = [0u16; BLOCK];
        for (block, values) in values.chunks(BLOCK).enumerate() {
            bins.iter_mut().zip(values).for_each(|(bin, &value)| *bin = self.of(value) as u16);
            bins[..values.len()]
                .iter()
                .enumerate()
                .for_each(|(at, &bin)| take(block * BLOCK + at, usize::from(bin) % NUM_BINS));
        }
    }
}

/// A quantiser of least mean square error for the samples that it was fitted to.
#[derive(Debug, Clone, PartialEq)]
pub struct LloydMax {
    bins: Bins,
    /// For each bin the number of its level.
    level_of_bin: Box<[u8; NUM_BINS]>,
    levels: Vec<f32>,
}

impl LloydMax {
    /// The quantiser of at most `num_levels` levels, 1 to 256, for the samples that `values[run]` for each run hold.
    ///
    /// There are fewer levels than asked for where the samples fall into fewer bins, and one, 0, where there are no
    /// samples. A range of samples below 1e-9 counts as one value.
    pub fn fit(values: &[f32], runs: &[Range<usize>], num_levels: usize) -> Self {
        let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
        for &value in runs.iter().flat_map(|run| &values[run.clone()]) {
            low = if value < low { value } else { low };
            high = if value > high { value } else { high };
        }
        if low > high {
            [low, high] = [0.0; 2];
        }
        let bins = Bins::new(low, high);
        // Neighbours often fall into one bin: two counts, so that one need not wait for the other.
        let mut counts = vec![[0u32; 2]; NUM_BINS];
        for run in runs {
            bins.each(&values[run.clone()], |at, bin| counts[bin][at % 2] += 1);
        }
        let histogram = Histogram::new(counts.iter().map(|[a, b]| f64::from(a + b)));
        let cells = histogram.best_cells(num_levels.clamp(1, MAX_LEVELS));
        let mut level_of_bin = Box::new([0; NUM_BINS]);
        let mut levels = Vec::with_capacity(cells.len());
        for (level, cell) in cells.windows(2).enumerate() {
            level_of_bin[cell[0]..cell[1]].fill(level as u8);
            let bins_from_low = histogram.mean(cell[0], cell[1]) as f32;
            levels.push(match bins.bins_per_unit {
                0.0 => low,
                per_unit => low + bins_from_low / per_unit,
            });
        }
        Self { bins, level_of_bin, levels }
    }

    /// The levels, increasing: the means of the samples that have them, but for the width of a bin.
    pub fn levels(&self) -> &[f32] {
        &self.levels
    }

    /// The number of the level of a value.
    pub fn code(&self, value: f32) -> u8 {
        self.level_of_bin[self.bins.of(value)]
    }

    /// Adds the number of the level of each value, shifted left, to its code.
    pub(crate) fn add_codes(&self, values: &[f32], shift: u32, codes: &mut [u8]) {
        let mut shifted = self.level_of_bin.clone();
        shifted.iter_mut().for_each(|level| *level <<= shift);
        for (values, codes) in values.chunks(BLOCK).zip(codes.chunks_mut(BLOCK)) {
            let mut bins = [0u16; BLOCK];
            bins.iter_mut().zip(values).for_each(|(bin, &value)| *bin = self.bins.of(value) as u16);
            codes
                .iter_mut()
                .zip(&bins)
                .for_each(|(code, &bin)| *code += shifted[usize::from(bin) % NUM_BINS]);
        }
    }
}

/// Counts by bin, as sums over all bins below each.
struct Histogram {
    /// For each bin and the end: the number of samples in bins below it, the sum of their bins, and of the squares of
    /// those. Whole numbers below 2^53, so exact.
    below: Vec<[f64; 3]>,
}

impl Histogram {
    fn new(counts: impl Iterator<Item = f64>) -> Self {
        let mut sums = [0.0; 3];
        let mut below = Vec::with_capacity(NUM_BINS + 1);
        below.push(sums);
        for (bin, count) in counts.enumerate() {
            let bin = bin as f64;
            sums = [sums[0] + count, sums[1] + bin * count, sums[2] + bin * bin * count];
            below.push(sums);
        }
        Self { below }
    }

    fn count(&self, start: usize, end: usize) -> f64 {
        self.below[end][0] - self.below[start][0]
    }

    /// Mean of the bins of the samples in `start..end`; the middle of the range where there are none.
    fn mean(&self, start: usize, end: usize) -> f64 {
        match self.count(start, end) {
            0.0 => (start + end - 1) as f64 / 2.0,
            count => (self.below[end][1] - self.below[start][1]) / count,
        }
    }

    /// What the square error of the samples in `start..end` is smaller for being taken from their mean instead of 0.
    fn gain(&self, start: usize, end: usize) -> f64 {
        let [low, high] = [self.below[start], self.below[end]];
        let (count, sum) = (high[0] - low[0], high[1] - low[1]);
        sum * sum / count.max(1.0)
    }

    fn squared_error(&self, start: usize, end: usize) -> f64 {
        (self.below[end][2] - self.below[start][2] - self.gain(start, end)).max(0.0)
    }

    /// Where the cells of the quantiser start, and the end: 0 first, `NUM_BINS` last.
    fn best_cells(&self, num_levels: usize) -> Vec<usize> {
        let filled: Vec<usize> = (0..NUM_BINS).filter(|&bin| self.count(bin, bin + 1) > 0.0).collect();
        if filled.len() <= num_levels {
            // Each value has its level; thresholds half-way.
            let starts = filled.windows(2).map(|pair| (pair[0] + pair[1]) / 2 + 1);
            return [0].into_iter().chain(starts).chain([NUM_BINS]).collect();
        }
        let mut starts = vec![self.dense_cells(num_levels)];
        if num_levels <= MAX_COARSE_LEVELS {
            starts.push(self.coarse_optimum(num_levels));
        }
        let mut best = (f64::NEG_INFINITY, Vec::new());
        for start in starts {
            let cells = self.iterate(start, num_levels);
            let gain = cells.windows(2).map(|cell| self.gain(cell[0], cell[1])).sum::<f64>();
            if gain > best.0 {
                best = (gain, cells);
            }
        }
        best.1
    }

    /// Cells as narrow as the density to the power 5/16, about the third root, asks for; some may be empty.
    fn dense_cells(&self, num_cells: usize) -> Vec<usize> {
        let radius = NUM_BINS / (8 * num_cells);
        let mut below = Vec::with_capacity(NUM_BINS + 1);
        let mut sum = 0.0;
        for bin in 0..NUM_BINS {
            below.push(sum);
            let near = self.count(bin.saturating_sub(radius), (bin + radius + 1).min(NUM_BINS));
            let fourth_root = near.sqrt().sqrt();
            sum += fourth_root * fourth_root.sqrt().sqrt();
        }
        let mut cells = vec![0];
        let mut bin = 0;
        for cell in 1..num_cells {
            let share = sum * cell as f64 / num_cells as f64;
            while bin < NUM_BINS && below[bin] < share {
                bin += 1;
            }
            cells.push(bin);
        }
        cells.push(NUM_BINS);
        cells.dedup();
        cells
    }

    /// The optimum among quantisers whose thresholds are those of [`Self::dense_cells`] for 256 cells.
    ///
    /// Dynamic programming over the number of levels; the best last threshold never falls as the end rises, which
    /// halves the search at each bisection.
    fn coarse_optimum(&self, num_levels: usize) -> Vec<usize> {
        let edges = self.dense_cells(NUM_COARSE);
        let num_edges = edges.len();
        let num_levels = num_levels.min(num_edges - 1);
        let mut gains: Vec<f64> = edges.iter().map(|&end| self.gain(0, end)).collect();
        let mut starts = Vec::with_capacity(num_levels);
        for _ in 1..num_levels {
            let mut next = vec![(f64::NEG_INFINITY, 0); num_edges];
            let mut open = vec![(0..num_edges, 0..num_edges)];
            while let Some((ends, candidates)) = open.pop() {
                if ends.is_empty() {
                    continue;
                }
                let middle = ends.start + ends.len() / 2;
                let mut best = (f64::NEG_INFINITY, candidates.start);
                for start in candidates.start..candidates.end.min(middle + 1) {
                    let gain = gains[start] + self.gain(edges[start], edges[middle]);
                    if gain > best.0 {
                        best = (gain, start);
                    }
                }
                next[middle] = best;
                open.push((ends.start..middle, candidates.start..best.1 + 1));
                open.push((middle + 1..ends.end, best.1..candidates.end));
            }
            gains = next.iter().map(|best| best.0).collect();
            starts.push(next);
        }
        let mut cells = vec![NUM_BINS];
        let mut end = num_edges - 1;
        for level in starts.iter().rev() {
            end = level[end].1;
            cells.push(edges[end]);
        }
        cells.push(0);
        cells.reverse();
        cells.dedup();
        cells
    }

    /// Lloyd's iteration to a fixed point with `num_levels` cells, none of them empty.
    fn iterate(&self, mut cells: Vec<usize>, num_levels: usize) -> Vec<usize> {
        self.refill(&mut cells, num_levels);
        for _ in 0..MAX_ITERATIONS {
            let mut changed = false;
            let mut mean = self.mean(cells[0], cells[1]);
            for at in 1..cells.len() - 1 {
                let next = self.mean(cells[at], cells[at + 1]);
                // Bins at the threshold belong to the lower level.
                let start = ((mean + next) / 2.0) as usize + 1;
                changed |= start != cells[at];
                cells[at] = start;
                mean = next;
            }
            let empty = cells.windows(2).any(|cell| self.count(cell[0], cell[1]) == 0.0);
            if empty {
                self.refill(&mut cells, num_levels);
            } else if !changed {
                break;
            }
        }
        self.refill(&mut cells, num_levels);
        cells
    }

    /// Merges empty cells into their neighbours and splits those of largest error until there are `num_levels`.
    fn refill(&self, cells: &mut Vec<usize>, num_levels: usize) {
        let mut filled = vec![0];
        for cell in cells.windows(2) {
            if self.count(cell[0], cell[1]) > 0.0 {
                filled.push(cell[1]);
            }
        }
        if let Some(last) = filled.last_mut() {
            *last = NUM_BINS;
        }
        while filled.len() <= num_levels {
            let error = |at: usize| self.squared_error(filled[at], filled[at + 1]);
            let mut worst = (0.0, 0);
            for at in 0..filled.len() - 1 {
                if error(at) > worst.0 {
                    worst = (error(at), at);
                }
            }
            let (error, at) = worst;
            let middle = self.mean(filled[at], filled[at + 1]) as usize + 1;
            if error == 0.0 || middle >= filled[at + 1] || middle <= filled[at] {
                break;
            }
            filled.insert(at + 1, middle);
        }
        *cells = filled;
    }
}
