//! Palettes within an error bound: samples put on a lattice so coarse that the bound only just holds, and the tables
//! and indices that decode to its points.
//!
//! The lattice of a window has points `offset + scale * p`, `p` from 0 to 65,535, `scale` being twice the bound. Every
//! sample of every step becomes a point. What a span then holds is exact in points: one index per sample where the
//! points do not change from step to step, else the distinct vectors of points over the steps as the entries of a
//! table, or one static stage and the distinct vectors of what remains.

use crate::{Indices, SampleValue, Stage, Table};

/// Points `offset + scale * p`, `p` from 0 to 65,535, of which one is within the bound of every sample of a range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lattice {
    /// Value of point 0.
    pub offset: f64,
    /// Distance of two points, above 0.
    pub scale: f64,
}

impl Lattice {
    /// The coarsest lattice for samples in `[low, high]` and a bound; `None` where 65,536 points are too few, or
    /// where `f64` cannot tell them apart well.
    ///
    /// Whole numbers get whole points, `2 * floor(bound) + 1` apart, so that a bound below 1 loses nothing.
    ///
    /// * `whole_numbers`: whether every sample is an integer below 2^53 in magnitude
    pub fn within([low, high]: [f64; 2], bound: f64, whole_numbers: bool) -> Option<Self> {
        // A millionth less than twice the bound: room for the rounding of `offset + scale * p`.
        const NEARLY: f64 = 1.0 - 1e-6;
        let scale = if whole_numbers { 2.0 * bound.floor() + 1.0 } else { 2.0 * bound * NEARLY };
        let largest = (high - low) / scale;
        let precise = scale > 1e-9 * low.abs().max(high.abs()) || whole_numbers;
        (scale >= f64::MIN_POSITIVE && largest <= 65534.0 && precise && (high - low).is_finite())
            .then_some(Self { offset: low, scale })
    }

    /// The value of a point.
    pub fn value(&self, point: f64) -> f64 {
        self.offset + self.scale * point
    }

    /// The nearest point of each sample, all of them in the range for which the lattice was made.
    pub fn points<T: SampleValue>(&self, samples: &[T]) -> Vec<u16> {
        // Adding 2^52 leaves the value rounded to an integer in the lowest bits.
        const ROUND: f64 = (1u64 << 52) as f64;
        let per_scale = 1.0 / self.scale;
        samples.iter().map(|&x| ((x.into() - self.offset) * per_scale + ROUND).to_bits() as u16).collect()
    }

    /// A stage that decodes to the points at every step: 8-bit indices where they suffice, else 16-bit ones.
    pub fn affine_stage(&self, points: &[u16]) -> Stage {
        let low = points.iter().copied().min().unwrap_or(0);
        let high = points.iter().copied().max().unwrap_or(0);
        let indices = match high - low {
            0..=255 => Indices::U8(points.iter().map(|&p| (p - low) as u8).collect()),
            _ => Indices::U16(points.iter().map(|&p| p - low).collect()),
        };
        let table = Table::Affine { offset: self.value(low.into()), scale: self.scale };
        Stage { indices, table, shift: 0 }
    }
}

/// The distinct vectors that samples take over some steps.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Vectors {
    /// For each sample the number of its vector; they are numbered in order of appearance.
    pub ids: Vec<u16>,
    /// For each vector the first sample that has it.
    pub firsts: Vec<u32>,
}

impl Vectors {
    /// The distinct values of `keys`, or `None` where there are more than `limit`, at most 65,536.
    pub fn of_keys(keys: impl ExactSizeIterator<Item = u64>, limit: usize) -> Option<Self> {
        let num_slots = (4 * limit).next_power_of_two();
        // 0: free, else number + 1.
        let mut slots = vec![(0u64, 0u32); num_slots];
        let mut vectors = Self { ids: Vec::with_capacity(keys.len()), firsts: Vec::new() };
        let mut last = None;
        for (at, key) in keys.enumerate() {
            if let Some((last_key, id)) = last
                && last_key == key
            {
                vectors.ids.push(id);
                continue;
            }
            let mut slot = (key.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 32) as usize % num_slots;
            while slots[slot].1 != 0 && slots[slot].0 != key {
                slot = (slot + 1) % num_slots;
            }
            if slots[slot].1 == 0 {
                if vectors.firsts.len() == limit {
                    return None;
                }
                vectors.firsts.push(at as u32);
                slots[slot] = (key, vectors.firsts.len() as u32);
            }
            let id = (slots[slot].1 - 1) as u16;
            vectors.ids.push(id);
            last = Some((key, id));
        }
        Some(vectors)
    }

    /// The distinct vectors over the steps of two runs, one after the other.
    pub fn joined(&self, other: &Self, limit: usize) -> Option<Self> {
        if self.firsts.len().max(other.firsts.len()) > limit {
            return None;
        }
        let keys = self.ids.iter().zip(&other.ids).map(|(&a, &b)| u64::from(a) | u64::from(b) << 32);
        Self::of_keys(keys, limit)
    }

    /// The stage with a listed table of the vectors.
    ///
    /// * `lattice`: what the table's numbers mean
    /// * `num_rows`: rows of the table, at least the number of `steps`; those beyond are zero
    /// * `steps`: for each step the number of every sample, those of one vector being alike
    ///
    /// The table has 256 entries where they suffice, else 1,024.
    pub fn listed_stage(&self, lattice: &Lattice, steps: &[impl AsRef<[i32]>], num_rows: usize) -> Stage {
        let num_entries = if self.firsts.len() <= 256 { 256 } else { 1024 };
        let number = |step: &[i32], first: u32| step[first as usize];
        let all = || steps.iter().flat_map(|step| self.firsts.iter().map(|&f| number(step.as_ref(), f)));
        let low = all().min().unwrap_or(0);
        let mut entries = vec![0u16; num_rows * num_entries];
        for (row, step) in entries.chunks_exact_mut(num_entries).zip(steps) {
            let numbers = self.firsts.iter().map(|&f| (number(step.as_ref(), f) - low) as u16);
            row.iter_mut().zip(numbers).for_each(|(entry, number)| *entry = number);
        }
        let indices = match num_entries {
            256 => Indices::U8(self.ids.iter().map(|&id| id as u8).collect()),
            _ => Indices::U16(self.ids.clone()),
        };
        let offset = lattice.value(low.into());
        Stage { indices, table: Table::Listed { offset, scale: lattice.scale, num_rows, entries }, shift: 0 }
    }
}
