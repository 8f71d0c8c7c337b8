//! Sorting by depth: a radix sort in parallel, the same order for any number of threads.

use rayon::prelude::*;

/// Bits of a digit.
const DIGIT_BITS: u32 = 11;
/// Digits of a key.
const NUM_DIGITS: u32 = 2;
/// The largest key.
const LARGEST_KEY: f64 = ((1u32 << (DIGIT_BITS * NUM_DIGITS)) - 1) as f64;
/// Parts that are counted and moved on their own.
const NUM_PARTS: usize = 16;

/// The numbers of the depths in rising order; depths that differ by less than 2^-22 of their range may change places, and
/// equal ones keep theirs.
pub(super) fn order_of(depths: &[f32]) -> Vec<u32> {
    let range = depths.par_iter().with_min_len(1 << 14).fold(
        || [f32::INFINITY, f32::NEG_INFINITY],
        |[low, high], &d| [if d < low { d } else { low }, if d > high { d } else { high }],
    );
    let [low, high] =
        range.reduce(|| [f32::INFINITY, f32::NEG_INFINITY], |a, b| [a[0].min(b[0]), a[1].max(b[1])]);
    let scale = if high > low { LARGEST_KEY / f64::from(high - low) } else { 0.0 };
    let key = |d: f32| (f64::from(d - low) * scale) as u64;
    let pair = |(i, &d): (usize, &f32)| key(d) << 32 | i as u64;
    let mut pairs: Vec<u64> = depths.par_iter().enumerate().with_min_len(1 << 14).map(pair).collect();
    let mut moved = vec![0u64; pairs.len()];
    for digit in 0..NUM_DIGITS {
        sort_by_digit(&pairs, &mut moved, 32 + digit * DIGIT_BITS);
        std::mem::swap(&mut pairs, &mut moved);
    }
    pairs.into_par_iter().with_min_len(1 << 14).map(|pair| pair as u32).collect()
}

/// A slice that several threads write to, each to places of its own.
struct Places(*mut u64, usize);

// SAFETY: `sort_by_digit` gives no place to two parts.
unsafe impl Sync for Places {}

impl Places {
    /// # Safety
    /// No other thread may write to the place.
    unsafe fn write(&self, at: usize, pair: u64) {
        assert!(at < self.1);
        // SAFETY: inside the slice, which lives as long as the parts are moved.
        unsafe { self.0.add(at).write(pair) };
    }
}

fn sort_by_digit(from: &[u64], to: &mut [u64], shift: u32) {
    const NUM: usize = 1 << DIGIT_BITS;
    let digit = |pair: u64| (pair >> shift) as usize & (NUM - 1);
    let part_len = from.len().div_ceil(NUM_PARTS).max(1);
    let count = |part: &[u64]| {
        let mut counts = vec![0usize; NUM];
        part.iter().for_each(|&pair| counts[digit(pair)] += 1);
        counts
    };
    let mut starts: Vec<Vec<usize>> = from.par_chunks(part_len).map(count).collect();
    let mut next = 0;
    for d in 0..NUM {
        for part in &mut starts {
            next += std::mem::replace(&mut part[d], next);
        }
    }
    let places = Places(to.as_mut_ptr(), to.len());
    let places = &places;
    from.par_chunks(part_len).zip(starts).for_each(|(part, mut starts)| {
        for &pair in part {
            let next = &mut starts[digit(pair)];
            // SAFETY: the counts of all parts and digits give each pair a place of its own.
            unsafe { places.write(*next, pair) };
            *next += 1;
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_order_is_that_of_a_plain_sort() {
        let depths: Vec<f32> = (0..50_000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 12) as f32).collect();
        let order = order_of(&depths);
        // 2^20 depths at most: keys tell them all apart.
        let mut expected: Vec<u32> = (0..50_000).collect();
        expected.sort_by(|&a, &b| depths[a as usize].total_cmp(&depths[b as usize]));
        assert_eq!(order, expected);
        assert_eq!(order_of(&[2.0; 5]), [0, 1, 2, 3, 4]);
        assert!(order_of(&[]).is_empty());
    }
}
