//! Difference vectors of points, and the tables that are trained on them.

use crate::vq::split::split;
use crate::vq::{Entries, Nearest, Vectors, nearest};
use crate::{Indices, Stage, Table, Workers};

/// Points of a part: what one task takes, whatever the number of threads.
pub const PART_POINTS: usize = 4096;

/// Vectors that splitting and the first rounds look at, for each entry, but at least [`LEAST_TRAINED`] in all.
const TRAINED_PER_ENTRY: usize = 24;
const LEAST_TRAINED: usize = 4096;
/// Most rounds of Lloyd's iteration on those, and rounds on all.
const TRAINING_ROUNDS: usize = 12;
const FULL_ROUNDS: usize = 3;
/// Rounds at the end, each of which moves one of so many entries to where errors are largest.
const TAIL_ROUNDS: usize = 3;
const MOVED_OF: usize = 32;
/// Training stops when a round gains less than this fraction of the cost.
const LEAST_GAIN: f64 = 2e-3;

/// One vector per point, in parts of [`PART_POINTS`], each `[t, point]`.
#[derive(Clone)]
pub(super) struct Parts {
    parts: Vec<Vec<f32>>,
    num_components: usize,
    num_points: usize,
}

impl Parts {
    /// The values of some steps.
    pub fn new(steps: &[&[f32]], workers: &impl Workers) -> Self {
        let num_points = steps[0].len();
        let part = |first: &usize| {
            let end = num_points.min(first + PART_POINTS);
            let mut part = Vec::with_capacity(steps.len() * (end - first));
            steps.iter().for_each(|step| part.extend_from_slice(&step[*first..end]));
            part
        };
        let firsts: Vec<usize> = (0..num_points).step_by(PART_POINTS).collect();
        Self { parts: workers.map(&firsts, part), num_components: steps.len(), num_points }
    }

    /// For each point the mean of its first components.
    pub fn means(&self, num: usize) -> Vec<f64> {
        let of_part = |part: &Vec<f32>| {
            let len = part.len() / self.num_components;
            let mut sums = vec![0.0; len];
            for component in part.chunks_exact(len).take(num) {
                sums.iter_mut().zip(component).for_each(|(sum, &x)| *sum += f64::from(x));
            }
            sums.iter_mut().for_each(|sum| *sum /= num as f64);
            sums
        };
        self.parts.iter().flat_map(of_part).collect()
    }

    /// Vectors of the means of every `num` components; the last may be of fewer.
    pub fn means_of(&self, num: usize, workers: &impl Workers) -> Self {
        let of_part = |part: &Vec<f32>| {
            let len = part.len() / self.num_components;
            let mut means = Vec::with_capacity(len * self.num_components.div_ceil(num));
            for group in part.chunks(len * num) {
                let mut sums = vec![0.0f64; len];
                for component in group.chunks_exact(len) {
                    sums.iter_mut().zip(component).for_each(|(sum, &x)| *sum += f64::from(x));
                }
                let count = (group.len() / len) as f64;
                means.extend(sums.iter().map(|sum| (sum / count) as f32));
            }
            means
        };
        Self {
            parts: workers.map(&self.parts, of_part),
            num_components: self.num_components.div_ceil(num),
            num_points: self.num_points,
        }
    }

    /// Takes away what a stage decodes to.
    pub fn subtract(&mut self, stage: &Stage, workers: &impl Workers) {
        let num_components = self.num_components;
        workers.for_each_mut(&mut self.parts, |number, part| {
            let len = part.len() / num_components;
            let first = number * PART_POINTS;
            for (t, component) in part.chunks_exact_mut(len).enumerate() {
                let value = |index: usize| match &stage.table {
                    Table::Affine { offset, scale } => offset + scale * index as f64,
                    Table::Listed { offset, scale, num_rows, entries } => {
                        let num_entries = entries.len() / num_rows;
                        offset + scale * f64::from(entries[(t >> stage.shift) * num_entries + index])
                    }
                };
                for (i, x) in component.iter_mut().enumerate() {
                    let index = match &stage.indices {
                        Indices::U8(v) => usize::from(v[first + i]),
                        Indices::U16(v) => usize::from(v[first + i]),
                    };
                    *x = (f64::from(*x) - value(index)) as f32;
                }
            }
        });
    }

    /// A stage with a table that is trained on the vectors.
    pub fn code(&self, num_entries: usize, shift: u8, workers: &impl Workers) -> Stage {
        let mut entries = self.train(num_entries, workers);
        let (offset, scale) = round_to_table(&mut entries.values);
        let found = self.nearest(&entries, workers);
        let mut table = vec![0; entries.values.len()];
        for (e, entry) in entries.values.chunks_exact(self.num_components).enumerate() {
            for (t, &value) in entry.iter().enumerate() {
                table[t * num_entries + e] = number_of(value, offset, scale);
            }
        }
        let indices = found.iter().flat_map(|part| part.indices.iter().copied());
        let indices = match num_entries {
            0..=256 => Indices::U8(indices.map(|i| i as u8).collect()),
            _ => Indices::U16(indices.collect()),
        };
        let table = Table::Listed { offset, scale, num_rows: self.num_components, entries: table };
        Stage { indices, table, shift }
    }

    fn train(&self, num_entries: usize, workers: &impl Workers) -> Entries {
        let num_chosen = (TRAINED_PER_ENTRY * num_entries).max(LEAST_TRAINED);
        let stride = (self.num_points / num_chosen).max(1);
        let chosen = self.every(stride);
        let mut by_vector: Vec<f32> = chosen.by_vector();
        let mut first = split(&mut by_vector, self.num_components, num_entries);
        // Entries that splitting has no vectors for start as copies of the first and are seeded anew.
        while first.len() < num_entries * self.num_components {
            first.extend_from_within(..self.num_components);
        }
        let mut entries = Entries { values: first, prices: vec![0.0; num_entries] };
        let mut last_cost = f64::INFINITY;
        for _ in 0..TRAINING_ROUNDS {
            let cost = chosen.refine(&mut entries, workers);
            let stalled = cost >= last_cost * (1.0 - LEAST_GAIN);
            last_cost = cost;
            if stalled {
                break;
            }
        }
        for _ in 0..FULL_ROUNDS {
            self.refine(&mut entries, workers);
        }
        self.reach_far(&mut entries, workers);
        entries
    }

    /// Lowers the largest error: entries that stand close to others move to the vectors that are farthest from theirs.
    fn reach_far(&self, entries: &mut Entries, workers: &impl Workers) {
        let mut found = self.nearest(entries, workers);
        for _ in 0..TAIL_ROUNDS {
            let mut moved = Entries { values: entries.values.clone(), prices: entries.prices.clone() };
            if !self.move_entries(&found, &mut moved) {
                return;
            }
            self.refine(&mut moved, workers);
            let again = self.nearest(&moved, workers);
            if largest_cost(&again) >= largest_cost(&found) {
                return;
            }
            (*entries, found) = (moved, again);
        }
    }

    /// Merges pairs of entries where that costs least, and puts the ones that are freed on the farthest vectors, one
    /// of a cell; says whether there were any.
    fn move_entries(&self, found: &[Nearest], entries: &mut Entries) -> bool {
        let num_entries = entries.prices.len();
        let mut counts = vec![0u32; num_entries];
        let mut farthest = vec![(0.0f32, 0usize); num_entries];
        let indices = found.iter().flat_map(|part| part.indices.iter().zip(&part.costs));
        for (point, (&index, &cost)) in indices.enumerate() {
            let index = usize::from(index);
            counts[index] += 1;
            if cost > farthest[index].0 {
                farthest[index] = (cost, point);
            }
        }
        let mut wide: Vec<usize> =
            (0..num_entries).filter(|&e| counts[e] > 1 && farthest[e].0 > 0.0).collect();
        wide.sort_by(|&a, &b| farthest[b].0.total_cmp(&farthest[a].0).then(a.cmp(&b)));
        wide.truncate(num_entries.div_ceil(MOVED_OF));
        let mut is_taken = vec![false; num_entries];
        wide.iter().for_each(|&e| is_taken[e] = true);
        let mut freed = wide.into_iter();
        let mut has_moved = false;
        for (a, b) in self.close_pairs(entries, &counts, &is_taken) {
            if is_taken[a] || is_taken[b] {
                continue;
            }
            let Some(from) = freed.next() else { break };
            (is_taken[a], is_taken[b], has_moved) = (true, true, true);
            let [weight_a, weight_b] =
                [a, b].map(|e| counts[e] as f32 / (counts[a] + counts[b]).max(1) as f32);
            for t in 0..self.num_components {
                let [at_a, at_b] = [a, b].map(|e| e * self.num_components + t);
                entries.values[at_a] = weight_a * entries.values[at_a] + weight_b * entries.values[at_b];
                entries.values[at_b] = self.component(farthest[from].1, t);
            }
        }
        has_moved
    }

    /// For each entry the one after it that it could be merged with at the least squared error (Ward 1963), the cheapest
    /// pair first.
    fn close_pairs(&self, entries: &Entries, counts: &[u32], is_taken: &[bool]) -> Vec<(usize, usize)> {
        let entry = |e: usize| &entries.values[e * self.num_components..(e + 1) * self.num_components];
        let cost = |a: usize, b: usize| {
            let squared: f32 = entry(a).iter().zip(entry(b)).map(|(x, y)| (x - y) * (x - y)).sum();
            let [a, b] = [a, b].map(|e| f64::from(counts[e]));
            f64::from(squared) * a * b / (a + b).max(1.0)
        };
        let free: Vec<usize> = (0..counts.len()).filter(|&e| !is_taken[e]).collect();
        let cheapest = |(place, &a): (usize, &usize)| {
            let costs = free[place + 1..].iter().map(|&b| (cost(a, b), b));
            costs.min_by(|x, y| x.0.total_cmp(&y.0)).map(|(cost, b)| (cost, a, b))
        };
        let mut pairs: Vec<(f64, usize, usize)> = free.iter().enumerate().filter_map(cheapest).collect();
        pairs.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
        pairs.into_iter().map(|(_, a, b)| (a, b)).collect()
    }

    /// Every `stride`-th vector.
    fn every(&self, stride: usize) -> Self {
        let vectors: Vec<usize> = (0..self.num_points).step_by(stride).collect();
        let part = |points: &[usize]| {
            let component = |t: usize| points.iter().map(move |&p| self.component(p, t));
            (0..self.num_components).flat_map(component).collect()
        };
        Self {
            parts: vectors.chunks(PART_POINTS).map(part).collect(),
            num_components: self.num_components,
            num_points: vectors.len(),
        }
    }

    fn component(&self, point: usize, t: usize) -> f32 {
        let part = &self.parts[point / PART_POINTS];
        part[t * (part.len() / self.num_components) + point % PART_POINTS]
    }

    /// `[vector, t]`.
    fn by_vector(&self) -> Vec<f32> {
        let vector = |p: usize| (0..self.num_components).map(move |t| self.component(p, t));
        (0..self.num_points).flat_map(vector).collect()
    }

    fn nearest(&self, entries: &Entries, workers: &impl Workers) -> Vec<Nearest> {
        let of_part = |part: &Vec<f32>| {
            nearest(Vectors { values: part, len: part.len() / self.num_components }, entries)
        };
        workers.map(&self.parts, of_part)
    }

    /// One round of Lloyd's iteration; entries without vectors move to those of largest cost. Returns the cost before.
    fn refine(&self, entries: &mut Entries, workers: &impl Workers) -> f64 {
        let found = self.nearest(entries, workers);
        let num_entries = entries.prices.len();
        let of_part = |(part, found): &(&Vec<f32>, &Nearest)| {
            let mut sums = vec![0.0f64; entries.values.len()];
            let mut counts = vec![0u32; num_entries];
            found.indices.iter().for_each(|&index| counts[usize::from(index)] += 1);
            for (t, component) in part.chunks_exact(found.indices.len()).enumerate() {
                for (&x, &index) in component.iter().zip(&found.indices) {
                    sums[usize::from(index) * self.num_components + t] += f64::from(x);
                }
            }
            (sums, counts)
        };
        let pairs: Vec<_> = self.parts.iter().zip(&found).collect();
        let of_parts = workers.map(&pairs, of_part);
        let mut sums = vec![0.0f64; entries.values.len()];
        let mut counts = vec![0u32; num_entries];
        for (of_part, count) in &of_parts {
            sums.iter_mut().zip(of_part).for_each(|(sum, x)| *sum += x);
            counts.iter_mut().zip(count).for_each(|(sum, x)| *sum += x);
        }
        for (e, &count) in counts.iter().enumerate().filter(|(_, count)| **count > 0) {
            let range = e * self.num_components..(e + 1) * self.num_components;
            for (value, sum) in entries.values[range.clone()].iter_mut().zip(&sums[range]) {
                *value = (sum / f64::from(count)) as f32;
            }
        }
        self.seed_empty(&found, &counts, entries);
        found.iter().flat_map(|part| &part.costs).map(|&cost| f64::from(cost)).sum()
    }

    /// Moves entries without vectors to the vectors of largest cost, the first of equal ones first.
    fn seed_empty(&self, found: &[Nearest], counts: &[u32], entries: &mut Entries) {
        let empty: Vec<usize> = (0..counts.len()).filter(|&e| counts[e] == 0).collect();
        if empty.is_empty() {
            return;
        }
        let mut worst: Vec<(f32, usize)> = found
            .iter()
            .flat_map(|part| &part.costs)
            .copied()
            .zip(0..)
            .filter(|(cost, _)| *cost > 0.0)
            .collect();
        worst.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        for (&e, &(_, point)) in empty.iter().zip(&worst) {
            let values = &mut entries.values[e * self.num_components..(e + 1) * self.num_components];
            values.iter_mut().enumerate().for_each(|(t, value)| *value = self.component(point, t));
        }
    }
}

fn largest_cost(found: &[Nearest]) -> f32 {
    found.iter().flat_map(|part| &part.costs).fold(0.0, |largest, &cost| largest.max(cost))
}

/// Rounds values to what a table of 16-bit numbers holds, and returns its offset and scale.
fn round_to_table(values: &mut [f32]) -> (f64, f64) {
    let low = values.iter().copied().fold(f32::INFINITY, f32::min);
    let high = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let (offset, scale) = (f64::from(low), (f64::from(high) - f64::from(low)) / 65535.0);
    for value in values {
        *value = (offset + scale * f64::from(number_of(*value, offset, scale))) as f32;
    }
    (offset, scale)
}

fn number_of(value: f32, offset: f64, scale: f64) -> u16 {
    if scale > 0.0 { ((f64::from(value) - offset) / scale).round().clamp(0.0, 65535.0) as u16 } else { 0 }
}
