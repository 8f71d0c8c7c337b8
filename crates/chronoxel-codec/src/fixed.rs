//! Sums of the stages of a step in fixed point: what is drawn, and a filter for exact extremes.

use crate::{CodecError, Indices, Payload, decode::Entries};

/// Bits of a sum below a unit of its 16-bit sample.
const FRACTION: u32 = 14;
/// Half a unit of a sample: added before the fraction is cut off.
const HALF: u32 = 1 << (FRACTION - 1);
/// The largest sample.
const LARGEST: f64 = 65535.0;
/// Added to a number below 2^52, leaves it rounded to an integer in the lowest bits.
const ROUND: f64 = (1u64 << 52) as f64;
/// Samples summed at a time: their sums stay in the nearest cache.
const BLOCK: usize = 512;

/// Sums over the stages of a payload at one step, as 16-bit samples: `value = offset + scale * sample`.
///
/// The range is the sum of the ranges that the stages have at the step. Each stage is rounded to 2^-14 of a unit, their sum to
/// a unit: a sample differs by at most half a unit, and 2^-15 for each stage, plus rounding in `f64`.
pub(crate) struct FixedSums {
    pub samples: Vec<u16>,
    /// Value of sample 0.
    pub offset: f64,
    /// Value of a unit: at least the smallest normal number.
    pub scale: f64,
    /// No decoded value, nor a part of its sum, is larger in magnitude.
    pub magnitude: f64,
}

/// What each index of a stage adds to a sum.
enum Terms<'a> {
    U8(Box<[u32; 256]>, &'a [u8]),
    U16(Vec<u32>, &'a [u16]),
    Affine(Rounding, &'a [u16]),
}

/// From an entry to what it adds to a sum.
#[derive(Clone, Copy)]
struct Rounding {
    smallest: f64,
    per_entry: f64,
}

impl Rounding {
    fn of(self, entry: u16) -> u32 {
        // The lowest 32 bits; entries outside the row's extremes are not used, and give what they give.
        ((f64::from(entry) - self.smallest) * self.per_entry + ROUND).to_bits() as u32
    }
}

impl FixedSums {
    /// * `rows`: for each stage of the validated payload, what its indices mean at the step
    ///
    /// # Errors
    /// [`CodecError::Corrupt`] if a sum might not be finite.
    pub fn of(payload: &Payload, rows: &[Entries<'_>]) -> Result<Self, CodecError> {
        let stages = || rows.iter().zip(&payload.stages);
        let extremes: Vec<[u16; 2]> = stages().map(|(row, stage)| row.extremes(&stage.indices)).collect();
        let (mut offset, mut width, mut magnitude) = (0.0, 0.0, 0.0);
        for (row, &[low, high]) in rows.iter().zip(&extremes) {
            offset += row.value(low);
            width += row.scale() * f64::from(high - low);
            magnitude += row.value(low).abs().max(row.value(high).abs());
        }
        if !(width.is_finite() && magnitude.is_finite()) {
            let problem = "the sum of the stages must be finite";
            return Err(CodecError::corrupt("range of the stages", magnitude.max(width), problem));
        }
        let scale = (width / LARGEST).max(f64::MIN_POSITIVE);
        let rounding = |row: &Entries<'_>, [low, high]: [u16; 2]| {
            let per_entry = if high > low { row.scale() / scale * f64::from(1 << FRACTION) } else { 0.0 };
            Rounding { smallest: low.into(), per_entry }
        };
        let terms = stages().zip(&extremes).map(|((row, stage), &extremes)| {
            let rounding = rounding(row, extremes);
            match (&stage.indices, row) {
                (Indices::U8(v), _) => Terms::U8(Box::new(row.padded().map(|entry| rounding.of(entry))), v),
                (Indices::U16(v), Entries::Row { row, .. }) => {
                    Terms::U16(row.iter().map(|&entry| rounding.of(entry)).collect(), v)
                }
                (Indices::U16(v), Entries::Affine { .. }) => Terms::Affine(rounding, v),
            }
        });
        let terms: Vec<Terms<'_>> = terms.collect();
        let samples = match terms.as_slice() {
            // The usual case, in one pass.
            [Terms::U8(first, a), Terms::U8(second, b)] => {
                let sum = |(&a, &b): (&u8, &u8)| {
                    let sum = first[usize::from(a)].wrapping_add(second[usize::from(b)]);
                    (sum.wrapping_add(HALF) >> FRACTION) as u16
                };
                a.iter().zip(*b).map(sum).collect()
            }
            terms => sums(terms, payload.stages[0].indices.len()),
        };
        Ok(Self { samples, offset, scale, magnitude })
    }
}

fn sums(terms: &[Terms<'_>], num_samples: usize) -> Vec<u16> {
    let mut samples = vec![0; num_samples];
    for (block, samples) in samples.chunks_mut(BLOCK).enumerate() {
        let range = block * BLOCK..block * BLOCK + samples.len();
        let mut sums = [HALF; BLOCK];
        for terms in terms {
            match terms {
                Terms::U8(table, v) => add(&mut sums, &v[range.clone()], |i| table[usize::from(i)]),
                Terms::U16(table, v) => add(&mut sums, &v[range.clone()], |i| table[usize::from(i)]),
                Terms::Affine(rounding, v) => add(&mut sums, &v[range.clone()], |i| rounding.of(i)),
            }
        }
        samples.iter_mut().zip(&sums).for_each(|(sample, sum)| *sample = (sum >> FRACTION) as u16);
    }
    samples
}

fn add<I: Copy>(sums: &mut [u32; BLOCK], indices: &[I], term: impl Fn(I) -> u32) {
    sums.iter_mut().zip(indices).for_each(|(sum, &i)| *sum = sum.wrapping_add(term(i)));
}
