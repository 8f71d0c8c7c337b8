//! Palettes within an error bound: samples put on a fine lattice, and tables and indices that decode to a point so near
//! to each of them that the bound just holds.
//!
//! The points of a [`Lattice`] are `offset + scale * p`, `p` a whole number and `2 * reach + 1` points as wide as twice
//! the bound: a sample that lies at point `p` may be decoded to any of the points `p - reach ..= p + reach`. From there
//! on everything is whole numbers. One index per sample serves several steps where the points of a sample stay within
//! such a range; a table of vectors over the steps ([`Cover`]) serves where few boxes of that width hold all vectors.

use crate::{Indices, SampleValue, Stage, Table};

/// Points `offset + scale * p`, `p` from 0 to 65,535, for samples within a range and a bound.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lattice {
    /// Value of point 0.
    pub offset: f64,
    /// Distance of two points, above 0.
    pub scale: f64,
    /// How many points away from its own a sample may be decoded to.
    pub reach: u16,
}

impl Lattice {
    /// The lattice for samples in `[low, high]` and a bound; `None` where 65,536 points are too few, or where `f64`
    /// cannot tell them apart well.
    ///
    /// Whole numbers get whole points, so that a bound below 1 loses nothing.
    ///
    /// * `whole_numbers`: whether every sample is an integer below 2^53 in magnitude
    pub fn within([low, high]: [f64; 2], bound: f64, whole_numbers: bool) -> Option<Self> {
        // A millionth less than the bound: room for the rounding of `offset + scale * p`.
        const NEARLY: f64 = 1.0 - 1e-6;
        let fits = |&reach: &u16| {
            let scale = bound * NEARLY / (f64::from(reach) + 0.5);
            let precise = scale > 1e-9 * low.abs().max(high.abs());
            let enough = (high - low) / scale <= f64::from(u16::MAX - 2 * reach - 1);
            (scale >= f64::MIN_POSITIVE && precise && enough).then_some(Self { offset: low, scale, reach })
        };
        if !(high - low).is_finite() {
            return None;
        }
        // Beyond this reach whole points bring nothing, and moving the lattice takes the square of its width.
        const MOST_WHOLE: f64 = 50.0;
        let reach = bound.min(MOST_WHOLE) as u16;
        if whole_numbers && bound <= MOST_WHOLE && high - low <= f64::from(u16::MAX - 2 * reach) {
            return Some(Self { offset: low, scale: 1.0, reach });
        }
        // Points between whole numbers would not be exact.
        if whole_numbers && bound < 1.0 {
            return None;
        }
        [7, 3, 1, 0].iter().find_map(fits)
    }

    /// Points that are together as wide as twice the bound.
    pub fn width(&self) -> u16 {
        2 * self.reach + 1
    }

    /// The value of a point.
    pub fn value(&self, point: i32) -> f64 {
        self.offset + self.scale * f64::from(point)
    }

    /// The same lattice moved by less than the width of a cell, so that the samples lie near the middles of cells: where
    /// many have one value, it becomes the middle of a cell.
    ///
    /// * `samples`: some of those for which the lattice was made
    pub fn moved_to<T: SampleValue>(self, samples: impl Iterator<Item = T>) -> Self {
        let width = usize::from(self.width());
        if width == 1 {
            return self;
        }
        let mut counts = vec![0u64; width];
        let per_scale = 1.0 / self.scale;
        for x in samples {
            counts[((x.into() - self.offset) * per_scale).round_ties_even() as usize % width] += 1;
        }
        let cost = |by: usize| -> u64 {
            let squared =
                |(at, count): (usize, &u64)| ((at + by) % width).abs_diff(width / 2).pow(2) as u64 * count;
            counts.iter().enumerate().map(squared).sum()
        };
        // Where all are alike, the lowest sample is the middle of a cell.
        let first = usize::from(self.reach);
        let by = (0..width).map(|by| (by + first) % width).min_by_key(|&by| cost(by)).unwrap_or(0);
        Self { offset: self.offset - self.scale * by as f64, ..self }
    }

    /// A point within reach of both ends of a range of points, the middle of a cell if possible: tables of such have
    /// fewer distinct numbers.
    pub fn point_for(&self, [low, high]: [i32; 2]) -> i32 {
        let [width, reach] = [self.width(), self.reach].map(i32::from);
        let [least, most] = [high - reach, low + reach];
        let middle = (most - reach).div_euclid(width) * width + reach;
        if middle >= least { middle } else { (least + most).div_euclid(2) }
    }

    /// The nearest point of each sample, all of them in the range for which the lattice was made.
    pub fn points<T: SampleValue>(&self, samples: &[T]) -> Vec<u16> {
        // Adding 2^52 leaves the value rounded to an integer in the lowest bits.
        const ROUND: f64 = (1u64 << 52) as f64;
        let per_scale = 1.0 / self.scale;
        samples.iter().map(|&x| ((x.into() - self.offset) * per_scale + ROUND).to_bits() as u16).collect()
    }

    /// A stage that decodes to point `first + step * i` at index `i`: 8-bit indices where they suffice, else 16-bit ones.
    pub fn affine_stage(&self, first: i32, step: u16, indices: &[u16]) -> Stage {
        let low = indices.iter().copied().min().unwrap_or(0);
        let high = indices.iter().copied().max().unwrap_or(0);
        let indices = match high - low {
            0..=255 => Indices::U8(indices.iter().map(|&i| (i - low) as u8).collect()),
            _ => Indices::U16(indices.iter().map(|&i| i - low).collect()),
        };
        let offset = self.value(first + i32::from(step) * i32::from(low));
        Stage { indices, table: Table::Affine { offset, scale: self.scale * f64::from(step) }, shift: 0 }
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

    /// The boxes that hold one vector each.
    ///
    /// * `point`: of a step and a sample, those of one vector being alike
    pub fn into_cover(self, num_steps: usize, point: impl Fn(usize, usize) -> i32) -> Cover {
        let vector = |&first: &u32| (0..num_steps).map(|step| point(step, first as usize)).collect();
        Cover { vectors: self.firsts.iter().map(vector).collect(), ids: self.ids }
    }
}

/// Boxes of vectors of points over some steps: every sample has a box that holds its vector, no box being wider at any
/// step than the lattice allows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cover {
    /// For each sample the number of its box.
    pub ids: Vec<u16>,
    /// For each box one point within reach of all it holds, at each step.
    pub vectors: Vec<Vec<i32>>,
}

/// Comparisons for each sample, on average, beyond which boxes are not worth the time.
const MOST_COMPARED: usize = 32;

/// A box while it grows.
#[derive(Clone, Copy)]
struct Box<const W: usize> {
    low: [i32; W],
    high: [i32; W],
}

impl<const W: usize> Box<W> {
    #[inline(always)]
    fn has_room_for(&self, vector: &[i32; W], width: i32) -> bool {
        let mut fits = true;
        for ((&low, &high), &v) in self.low.iter().zip(&self.high).zip(vector) {
            fits &= high.max(v) - low.min(v) < width;
        }
        fits
    }

    fn take(&mut self, vector: &[i32; W]) {
        self.low.iter_mut().zip(vector).for_each(|(low, &v)| *low = v.min(*low));
        self.high.iter_mut().zip(vector).for_each(|(high, &v)| *high = v.max(*high));
    }
}

/// Boxes in the middle of which lies a vector that many samples have: what is still stays as it is.
fn seeds<const W: usize>(steps: &[Vec<u16>], reach: u16) -> Vec<Box<W>> {
    const SAMPLED: usize = 13;
    const MOST: usize = 16;
    let mut vectors: Vec<[i32; W]> =
        (0..steps[0].len()).step_by(SAMPLED).map(|at| vector_at(steps, at)).collect();
    vectors.sort_unstable();
    let mut runs: Vec<(usize, [i32; W])> =
        vectors.chunk_by(|a, b| a == b).map(|run| (run.len(), run[0])).collect();
    runs.retain(|(count, _)| 100 * count >= vectors.len());
    runs.sort_unstable_by_key(|&(count, vector)| (std::cmp::Reverse(count), vector));
    let reach = i32::from(reach);
    let around = |(_, v): (usize, [i32; W])| Box { low: v.map(|p| p - reach), high: v.map(|p| p + reach) };
    runs.into_iter().take(MOST).map(around).collect()
}

/// The vector of a sample; steps beyond the last are zero.
#[inline(always)]
fn vector_at<const W: usize>(steps: &[Vec<u16>], at: usize) -> [i32; W] {
    let mut vector = [0; W];
    vector.iter_mut().zip(steps).for_each(|(v, step)| *v = i32::from(step[at]));
    vector
}

impl Cover {
    /// Boxes for the vectors of all samples, in one pass; `None` where more than `limit` boxes would be needed, or neighbours
    /// have so little in common that it would take long.
    ///
    /// A sample prefers the boxes of its neighbours before it along x, y and z, since runs of one index are stored in
    /// few bytes; else it takes the first with room, else a new one.
    ///
    /// * `steps`: the points of every sample, for each of 1 to 16 steps
    /// * `edge`: samples along an edge of the brick
    pub fn of_steps(steps: &[Vec<u16>], edge: usize, lattice: &Lattice, limit: usize) -> Option<Self> {
        match steps.len() {
            1 => Self::grow::<1>(steps, edge, lattice, limit),
            2 => Self::grow::<2>(steps, edge, lattice, limit),
            3..=4 => Self::grow::<4>(steps, edge, lattice, limit),
            5..=8 => Self::grow::<8>(steps, edge, lattice, limit),
            9..=16 => Self::grow::<16>(steps, edge, lattice, limit),
            _ => None,
        }
    }

    fn grow<const W: usize>(
        steps: &[Vec<u16>],
        edge: usize,
        lattice: &Lattice,
        limit: usize,
    ) -> Option<Self> {
        let num_samples = steps[0].len();
        let width = i32::from(lattice.width());
        let mut ids: Vec<u16> = Vec::with_capacity(num_samples);
        let mut boxes: Vec<Box<W>> = seeds(steps, lattice.reach);
        let mut num_compared = 0;
        for at in 0..num_samples {
            let vector = vector_at(steps, at);
            let before = [edge * edge, edge, 1].into_iter().filter_map(|back| at.checked_sub(back));
            let near = before.map(|at| ids[at]).find(|&id| boxes[id as usize].has_room_for(&vector, width));
            let id = near.or_else(|| {
                let found = boxes.iter().position(|b| b.has_room_for(&vector, width));
                num_compared += found.unwrap_or(boxes.len());
                found.map(|id| id as u16)
            });
            if num_compared > MOST_COMPARED * num_samples {
                return None;
            }
            match id {
                Some(id) => {
                    boxes[id as usize].take(&vector);
                    ids.push(id);
                }
                None if boxes.len() == limit => return None,
                None => {
                    ids.push(boxes.len() as u16);
                    boxes.push(Box { low: vector, high: vector });
                }
            }
        }
        let vector =
            |b: &Box<W>| (0..steps.len()).map(|t| lattice.point_for([b.low[t], b.high[t]])).collect();
        Some(Self { ids, vectors: boxes.iter().map(vector).collect() })
    }

    /// The stage with a listed table of the vectors.
    ///
    /// The table has 256 entries where they suffice, else 1,024.
    ///
    /// * `num_rows`: rows of the table, at least the number of steps; those beyond are zero
    pub fn listed_stage(&self, lattice: &Lattice, num_rows: usize) -> Stage {
        let num_entries = if self.vectors.len() <= 256 { 256 } else { 1024 };
        let width = i32::from(lattice.width());
        let points = &self.vectors;
        let low = points.iter().flatten().copied().min().unwrap_or(0);
        let unit = if points.iter().flatten().all(|p| (p - low) % width == 0) { width } else { 1 };
        let mut entries = vec![0u16; num_rows * num_entries];
        for (entry, vector) in points.iter().enumerate() {
            for (row, &p) in vector.iter().enumerate() {
                entries[row * num_entries + entry] = ((p - low) / unit) as u16;
            }
        }
        let indices = match num_entries {
            256 => Indices::U8(self.ids.iter().map(|&id| id as u8).collect()),
            _ => Indices::U16(self.ids.clone()),
        };
        let table = Table::Listed {
            offset: lattice.value(low),
            scale: lattice.scale * f64::from(unit),
            num_rows,
            entries,
        };
        Stage { indices, table, shift: 0 }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use chronoxel_core::BrickLayout;

    use super::*;
    use crate::{Payload, decode_f64};

    /// SplitMix64.
    struct Random(u64);

    impl Random {
        fn next(&mut self) -> u64 {
            self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            z ^ (z >> 31)
        }

        fn unit(&mut self) -> f64 {
            (self.next() >> 11) as f64 / (1u64 << 53) as f64
        }
    }

    #[test]
    fn all_points_within_reach_are_within_the_bound() {
        let mut random = Random(1);
        for at in 0..200 {
            let low = 10f64.powf(10.0 * random.unit() - 5.0) * (random.unit() - 0.5);
            let width = 10f64.powf(6.0 * random.unit() - 3.0);
            let bound = width * 10f64.powf(-4.0 * random.unit());
            let samples: Vec<f64> = (0..500).map(|_| low + width * random.unit()).collect();
            let Some(lattice) = Lattice::within([low, low + width], bound, false) else {
                assert!(bound < width / 65_000.0 || bound < 1e-8 * low.abs(), "case {at}");
                continue;
            };
            let lattice = lattice.moved_to(samples.iter().copied());
            for (&x, p) in samples.iter().zip(lattice.points(&samples)) {
                let [p, reach] = [p, lattice.reach].map(i32::from);
                assert!((lattice.value(p - reach) - x).abs() <= bound, "case {at}");
                assert!((lattice.value(p + reach) - x).abs() <= bound, "case {at}");
            }
        }
    }

    #[test]
    fn whole_numbers_get_whole_points() {
        let lattice = Lattice::within([-300.0, 700.0], 2.9, true).unwrap();
        assert_eq!((lattice.offset, lattice.scale, lattice.reach), (-300.0, 1.0, 2));
        let exact = Lattice::within([0.0, 65535.0], 0.0, true).unwrap();
        assert_eq!(exact.points(&[0.0, 1.0, 65535.0]), [0, 1, 65535]);
        assert_eq!(Lattice::within([0.0, 65536.0], 0.5, true), None);
        assert_eq!(Lattice::within([0.0, 1.0], 0.0, false), None);
        assert_eq!(Lattice::within([-f64::MAX, f64::MAX], 1e300, false), None);
    }

    #[test]
    fn what_many_samples_have_becomes_the_middle_of_a_cell() {
        let mut samples = vec![3.21f64; 100];
        samples.extend([0.0, 1.0, 2.0, 4.0]);
        let lattice = Lattice::within([0.0, 4.0], 0.1, false).unwrap().moved_to(samples.iter().copied());
        let point = lattice.points(&samples)[0];
        assert_eq!(point % lattice.width(), lattice.reach);
        // Whole numbers lie on points.
        let whole = Lattice::within([0.0, 4.0], 1.0, true).unwrap().moved_to([0.0f64, 3.0, 3.0].into_iter());
        assert_eq!(whole.offset.fract(), 0.0);
        assert_eq!(whole.points(&[3.0f64])[0] % 3, 1);
    }

    #[test]
    fn a_point_is_found_for_every_range_that_is_narrow_enough() {
        for reach in [0, 1, 3, 7] {
            let lattice = Lattice { offset: 0.0, scale: 1.0, reach };
            for low in -40..40 {
                for high in low..low + i32::from(lattice.width()) {
                    let point = lattice.point_for([low, high]);
                    assert!(
                        (point - low).abs() <= i32::from(reach) && (high - point).abs() <= i32::from(reach)
                    );
                }
            }
        }
    }

    #[test]
    fn vectors_are_counted_and_joined() {
        let mut random = Random(2);
        let mut steps = || (0..1331).map(|_| random.next() % 6).collect::<Vec<u64>>();
        let (a, b) = (steps(), steps());
        let vectors = |keys: &[u64]| Vectors::of_keys(keys.iter().copied(), 1024).unwrap();
        let joined = vectors(&a).joined(&vectors(&b), 36).unwrap();
        let pairs: BTreeSet<(u64, u64)> = a.iter().copied().zip(b.iter().copied()).collect();
        assert_eq!((pairs.len(), joined.firsts.len()), (36, 36));
        for (at, &id) in joined.ids.iter().enumerate() {
            let first = joined.firsts[id as usize] as usize;
            assert_eq!((a[at], b[at]), (a[first], b[first]));
        }
        assert_eq!(vectors(&a).joined(&vectors(&b), 35), None);
    }

    #[test]
    fn boxes_hold_all_vectors_and_decode_within_reach() {
        let layout = BrickLayout::new(8).unwrap();
        let (edge, n) = (layout.full_edge(), layout.num_full());
        let mut random = Random(3);
        for num_steps in [1, 2, 3, 4, 7, 16] {
            // A front that moves, on a floor with a little noise.
            let point = |at: usize, t: usize, noise: u64| {
                let x = (at % edge + at / edge / edge) as u16;
                (20 * x.saturating_sub(t as u16 / 2)).min(100) + (noise % 4) as u16
            };
            let steps: Vec<Vec<u16>> =
                (0..num_steps).map(|t| (0..n).map(|at| point(at, t, random.next())).collect()).collect();
            let lattice = Lattice { offset: 5.0, scale: 0.5, reach: 3 };
            let cover = Cover::of_steps(&steps, edge, &lattice, 1024).unwrap();
            let stage = cover.listed_stage(&lattice, num_steps + 1).into_canonical(&layout).unwrap();
            let payload = Payload { stages: vec![stage] };
            for (t, step) in steps.iter().enumerate() {
                let decoded = decode_f64(&payload, &layout, t as u32).unwrap();
                for (&p, decoded) in step.iter().zip(decoded) {
                    assert!((lattice.value(p.into()) - decoded).abs() <= 1.5);
                }
            }
            assert_eq!(Cover::of_steps(&steps, edge, &lattice, cover.vectors.len() - 1), None);
        }
    }

    #[test]
    fn a_ramp_needs_one_box_for_each_width() {
        // 1,331 samples, one point apart at both steps: boxes of 7 points, 1331 / 7 = 190.1.
        let ramp: Vec<u16> = (0..1331).collect();
        let lattice = Lattice { offset: 0.0, scale: 1.0, reach: 3 };
        let cover = Cover::of_steps(&[ramp.clone(), ramp], 11, &lattice, 1024).unwrap();
        assert_eq!(cover.vectors.len(), 191);
        assert_eq!(cover.vectors[0], [3, 3]);
    }
}
