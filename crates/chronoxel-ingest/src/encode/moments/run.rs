//! What is known of a finest brick over a run of steps, but for its samples.

use chronoxel_core::{BitMask, NodeFacts, NodeStatistics, SpanStatistics};
use xxhash_rust::xxh3::{xxh3_128, xxh3_128_with_seed};

use super::super::analyse::Analysis;
use super::super::real::Real;
use super::samples::ErrorSum;

/// What is known of an octree node over a run of steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Known {
    /// Over all samples.
    pub statistics: SpanStatistics,
    /// By bits.
    pub facts: NodeFacts,
    /// Of the samples of core and apron at each step, where static; of the one value, where uniform.
    pub hash: u128,
    /// Over the samples that take part.
    pub errors: ErrorSum,
}

impl Known {
    /// Of two octree nodes together, over the same steps.
    pub fn merged_in_space(self, other: Self) -> Self {
        let (a, b) = (self.facts, other.facts);
        Self {
            statistics: self.statistics.merged(other.statistics),
            facts: NodeFacts {
                is_uniform: a.is_uniform && b.is_uniform && self.hash == other.hash,
                is_static: a.is_static && b.is_static,
                is_masked: a.is_masked || b.is_masked,
                mask_changes: a.mask_changes || b.mask_changes,
            },
            hash: self.hash,
            errors: self.errors.plus(other.errors),
        }
    }

    /// In the form that a store takes.
    pub fn node_statistics(&self) -> NodeStatistics {
        let temporal_error = match (self.statistics.count, self.facts.is_static) {
            (0, _) => f64::NAN,
            (_, true) => 0.0,
            // What changes is told from what does not, however little, and by samples that are left out.
            (_, false) => self.errors.mean().max(f32::from_bits(1).into()),
        };
        NodeStatistics::of_span(&self.statistics, temporal_error, self.facts)
    }
}

/// How the means and deviations of a brick's samples are held.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Held {
    /// One mean and deviation for all of them.
    Alike([f64; 2]),
    /// A mean for each; the deviations are 0.
    Means,
    /// A mean and a deviation for each.
    Both,
}

/// What is known of a finest brick over a run of steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Run {
    /// Steps of the run.
    pub num_steps: u32,
    /// What goes into the statistics.
    pub known: Known,
    /// Of the mask at each step, where it does not change.
    pub mask_hash: u128,
    /// Where the samples are.
    pub held: Held,
}

impl Run {
    /// Of a single step.
    ///
    /// * `samples`: core and apron
    /// * `num_samples`: samples that take part in the temporal error, as far as any has data
    pub fn of_step<T: Real>(samples: &[T], analysis: &Analysis, num_samples: u64) -> Self {
        let is_uniform = analysis.is_constant && analysis.num_masked == 0;
        let is_empty = analysis.range.is_none();
        let (hash, held) = match (is_uniform, is_empty) {
            // Another seed: not to be taken for a brick of one sample.
            (true, _) => {
                let hash = xxh3_128_with_seed(bytemuck::bytes_of(&samples[0]), 1);
                (hash, Held::Alike([samples[0].to_f64(), 0.0]))
            }
            (_, true) => (ALL_MASKED, Held::Alike([f64::NAN; 2])),
            _ => (xxh3_128(bytemuck::cast_slice(samples)), Held::Means),
        };
        let mask_hash = match (analysis.num_masked, is_empty) {
            (0, _) => 0,
            (_, true) => ALL_MASKED,
            _ => xxh3_128(&BitMask::from_flags(samples.iter().map(|v| v.is_masked())).bytes),
        };
        let facts = NodeFacts {
            is_uniform,
            is_static: true,
            is_masked: analysis.num_masked > 0,
            mask_changes: false,
        };
        let errors = ErrorSum { sum: 0.0, count: if is_empty { 0 } else { num_samples } };
        let known = Known { statistics: analysis.statistics, facts, hash, errors };
        Self { num_steps: 1, known, mask_hash, held }
    }

    /// Of a run and the one that follows it, but for the errors and the place of the samples: those are the later run's.
    pub fn followed_by(&self, later: &Self) -> Self {
        let (a, b) = (self.known, later.known);
        let same = a.hash == b.hash;
        let changed = self.mask_hash != later.mask_hash;
        let facts = NodeFacts {
            is_uniform: a.facts.is_uniform && b.facts.is_uniform && same,
            is_static: a.facts.is_static && b.facts.is_static && same,
            is_masked: a.facts.is_masked || b.facts.is_masked,
            mask_changes: a.facts.mask_changes || b.facts.mask_changes || changed,
        };
        let known = Known { statistics: a.statistics.merged(b.statistics), facts, ..b };
        Self { num_steps: self.num_steps + later.num_steps, known, ..*later }
    }

    /// Largest magnitude of a sample.
    pub fn magnitude(&self) -> f64 {
        // NaN where no sample has data: then there is none.
        self.known.statistics.min.abs().max(self.known.statistics.max.abs()).max(0.0)
    }
}

/// Stands for the hash of what holds no data.
const ALL_MASKED: u128 = u128::MAX;

/// Bytes of a run in a file, checksums included.
pub const RUN_BYTES: usize = 128;

impl Run {
    /// In the form of a kept file.
    ///
    /// * `samples_crc`: CRC-32C of the samples beside it
    pub fn to_bytes(self, samples_crc: u32) -> [u8; RUN_BYTES] {
        let Known { statistics, facts, hash, errors } = self.known;
        let SpanStatistics { count, min, max, mean, std } = statistics;
        let (kind, values) = match self.held {
            Held::Alike(values) => (0, values),
            Held::Means => (1, [0.0; 2]),
            Held::Both => (2, [0.0; 2]),
        };
        let flags = [facts.is_uniform, facts.is_static, facts.is_masked, facts.mask_changes];
        let flags = (0..4).fold(0u32, |bits, i| bits | u32::from(flags[i]) << i);
        let mut bytes = Vec::with_capacity(RUN_BYTES);
        [hash, self.mask_hash].iter().for_each(|v| bytes.extend_from_slice(&v.to_le_bytes()));
        [count, errors.count].iter().for_each(|v| bytes.extend_from_slice(&v.to_le_bytes()));
        let numbers = [min, max, mean, std, errors.sum, values[0], values[1]];
        numbers.iter().for_each(|v| bytes.extend_from_slice(&v.to_le_bytes()));
        [self.num_steps, kind | flags << 8, samples_crc]
            .iter()
            .for_each(|v| bytes.extend_from_slice(&v.to_le_bytes()));
        bytes.resize(RUN_BYTES - 4, 0);
        let crc = crc32c::crc32c(&bytes);
        bytes.extend_from_slice(&crc.to_le_bytes());
        bytes.try_into().expect("of this length")
    }

    /// From a kept file: the run and the checksum of its samples, or `None` where the bytes are damaged.
    pub fn from_bytes(bytes: &[u8; RUN_BYTES]) -> Option<(Self, u32)> {
        let u32_at = |at: usize| u32::from_le_bytes(std::array::from_fn(|i| bytes[at + i]));
        let u64_at = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| bytes[at + i]));
        let u128_at = |at: usize| u128::from_le_bytes(std::array::from_fn(|i| bytes[at + i]));
        let number = |index: usize| f64::from_bits(u64_at(48 + 8 * index));
        if crc32c::crc32c(&bytes[..RUN_BYTES - 4]) != u32_at(RUN_BYTES - 4) {
            return None;
        }
        let kind = u32_at(108);
        let held = match kind & 0xff {
            0 => Held::Alike([number(5), number(6)]),
            1 => Held::Means,
            2 => Held::Both,
            _ => return None,
        };
        let flag = |bit: u32| kind >> (8 + bit) & 1 != 0;
        let facts =
            NodeFacts { is_uniform: flag(0), is_static: flag(1), is_masked: flag(2), mask_changes: flag(3) };
        let [min, max, mean, std] = [0, 1, 2, 3].map(number);
        let known = Known {
            statistics: SpanStatistics { count: u64_at(32), min, max, mean, std },
            facts,
            hash: u128_at(0),
            errors: ErrorSum { sum: number(4), count: u64_at(40) },
        };
        Some((Self { num_steps: u32_at(104), known, mask_hash: u128_at(16), held }, u32_at(112)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_comes_back_from_its_bytes_and_damage_shows() {
        let facts = NodeFacts { is_uniform: false, is_static: true, is_masked: true, mask_changes: false };
        let statistics = SpanStatistics { count: 1 << 40, min: -1.5, max: 7.25, mean: 0.1, std: 1e-300 };
        let errors = ErrorSum { sum: 17.75, count: 999 };
        let known = Known { statistics, facts, hash: u128::MAX / 3, errors };
        for held in [Held::Alike([0.25, 1e308]), Held::Means, Held::Both] {
            let run = Run { num_steps: 12, known, mask_hash: 1 << 100, held };
            let bytes = run.to_bytes(0xdead_beef);
            assert_eq!(Run::from_bytes(&bytes), Some((run, 0xdead_beef)));
            for at in 0..RUN_BYTES {
                let mut damaged = bytes;
                damaged[at] ^= 0x10;
                assert_eq!(Run::from_bytes(&damaged), None, "byte {at}");
            }
        }
    }
}
