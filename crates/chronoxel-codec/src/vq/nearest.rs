//! The nearest entry for each of many vectors: the kernel in which a vector palette spends its time.
//!
//! There is one body, [`nearest_of_block`], compiled for several instruction sets and chosen at run time. Lanes are
//! vectors, and the sum over the components of one vector always runs in the same order without fused
//! multiply-adds, so that every instruction set gives the same bits.

/// Vectors that are compared with the entries at once.
const LANES: usize = 16;

/// Components `[t, lane]` of as many vectors as there are lanes.
type Block<const N: usize> = [[f32; LANES]; N];

/// Vectors `[t, vector]`: component after component.
#[derive(Debug, Clone, Copy)]
pub struct Vectors<'a> {
    /// `[t, vector]`.
    pub values: &'a [f32],
    /// Vectors.
    pub len: usize,
}

impl Vectors<'_> {
    /// Components of a vector.
    pub fn num_steps(&self) -> usize {
        self.values.len().checked_div(self.len).unwrap_or(0)
    }
}

/// Entries `[entry, t]`, and what each costs beyond its distance.
#[derive(Debug, Clone, PartialEq)]
pub struct Entries {
    /// `[entry, t]`.
    pub values: Vec<f32>,
    /// One per entry, at least 0: added to the squared distance.
    pub prices: Vec<f32>,
}

/// The entry of least cost, squared distance plus price, of each vector, and that cost.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Nearest {
    /// The entry, the first of several at equal cost.
    pub indices: Vec<u16>,
    /// Squared distance plus price.
    pub costs: Vec<f32>,
}

/// What the kernel is compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InstructionSet {
    /// What every processor of the target has.
    Plain,
    /// AVX2.
    Avx2,
    /// AVX-512 F, BW, DQ and VL.
    Avx512,
}

impl InstructionSet {
    /// Those of this processor, the widest last.
    pub fn available() -> Vec<Self> {
        let mut sets = vec![Self::Plain];
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") {
                sets.push(Self::Avx2);
            }
            if is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl")
            {
                sets.push(Self::Avx512);
            }
        }
        sets
    }

    /// The widest of this processor.
    pub fn widest() -> Self {
        static WIDEST: std::sync::OnceLock<InstructionSet> = std::sync::OnceLock::new();
        *WIDEST.get_or_init(|| *Self::available().last().unwrap_or(&Self::Plain))
    }
}

/// The nearest entry of each vector, by the widest instructions there are.
pub fn nearest(vectors: Vectors, entries: &Entries) -> Nearest {
    nearest_with(InstructionSet::widest(), vectors, entries)
}

/// The nearest entry of each vector, by the instructions given, which the processor must have.
pub fn nearest_with(set: InstructionSet, vectors: Vectors, entries: &Entries) -> Nearest {
    assert!(InstructionSet::available().contains(&set), "the processor lacks {set:?}");
    match vectors.num_steps() {
        0 | 1 => nearest_in::<1>(set, vectors, entries),
        2 => nearest_in::<2>(set, vectors, entries),
        3..=4 => nearest_in::<4>(set, vectors, entries),
        5..=8 => nearest_in::<8>(set, vectors, entries),
        _ => nearest_in::<16>(set, vectors, entries),
    }
}

/// Vectors of up to `N` components are padded with zeros; longer ones are summed in runs of `N`.
fn nearest_in<const N: usize>(set: InstructionSet, vectors: Vectors, entries: &Entries) -> Nearest {
    let num_steps = vectors.num_steps();
    let num_runs = num_steps.div_ceil(N).max(1);
    let entry_runs: Vec<[f32; N]> = entries
        .values
        .chunks_exact(num_steps.max(1))
        .flat_map(|entry| {
            (0..num_runs).map(|run| std::array::from_fn(|t| entry.get(run * N + t).copied().unwrap_or(0.0)))
        })
        .collect();
    let mut found = Nearest { indices: vec![0; vectors.len], costs: vec![0.0; vectors.len] };
    let mut blocks = vec![[[0.0f32; LANES]; N]; num_runs];
    for start in (0..vectors.len).step_by(LANES) {
        let len = LANES.min(vectors.len - start);
        for t in 0..num_steps {
            blocks[t / N][t % N][..len].copy_from_slice(&vectors.values[t * vectors.len + start..][..len]);
        }
        let (indices, costs) = match set {
            InstructionSet::Plain => nearest_of_block(&blocks, &entry_runs, &entries.prices),
            // SAFETY: `nearest_with` has checked that the processor has the instructions.
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2 => unsafe { nearest_avx2(&blocks, &entry_runs, &entries.prices) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512 => unsafe { nearest_avx512(&blocks, &entry_runs, &entries.prices) },
            #[cfg(not(target_arch = "x86_64"))]
            _ => nearest_of_block(&blocks, &entry_runs, &entries.prices),
        };
        found.costs[start..start + len].copy_from_slice(&costs[..len]);
        let indices = indices.iter().map(|&index| index as u16);
        found.indices[start..start + len].iter_mut().zip(indices).for_each(|(to, index)| *to = index);
    }
    found
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn nearest_avx2<const N: usize>(
    blocks: &[Block<N>],
    entries: &[[f32; N]],
    prices: &[f32],
) -> ([u32; LANES], [f32; LANES]) {
    nearest_of_block(blocks, entries, prices)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
fn nearest_avx512<const N: usize>(
    blocks: &[Block<N>],
    entries: &[[f32; N]],
    prices: &[f32],
) -> ([u32; LANES], [f32; LANES]) {
    nearest_of_block(blocks, entries, prices)
}

/// For each lane the entry of least cost, and the cost.
///
/// * `blocks`: runs of components of the vectors
/// * `entries`: `[entry, run]`
#[inline(always)]
fn nearest_of_block<const N: usize>(
    blocks: &[Block<N>],
    entries: &[[f32; N]],
    prices: &[f32],
) -> ([u32; LANES], [f32; LANES]) {
    let (mut indices, mut costs) = ([0u32; LANES], [f32::INFINITY; LANES]);
    if let [block] = blocks {
        for ((number, entry), &price) in (0u32..).zip(entries).zip(prices) {
            let mut cost = [0.0f32; LANES];
            add_squared_distance(&mut cost, block, entry);
            consider(number, &cost, price, &mut indices, &mut costs);
        }
    } else {
        for ((number, runs), &price) in (0u32..).zip(entries.chunks_exact(blocks.len())).zip(prices) {
            let mut cost = [0.0f32; LANES];
            for (block, run) in blocks.iter().zip(runs) {
                add_squared_distance(&mut cost, block, run);
            }
            consider(number, &cost, price, &mut indices, &mut costs);
        }
    }
    (indices, costs)
}

/// Takes an entry where it costs less than the best before it.
#[inline(always)]
fn consider(
    entry: u32,
    cost: &[f32; LANES],
    price: f32,
    indices: &mut [u32; LANES],
    costs: &mut [f32; LANES],
) {
    for lane in 0..LANES {
        let cost = cost[lane] + price;
        let less = cost < costs[lane];
        costs[lane] = if less { cost } else { costs[lane] };
        indices[lane] = if less { entry } else { indices[lane] };
    }
}

#[inline(always)]
fn add_squared_distance<const N: usize>(cost: &mut [f32; LANES], block: &Block<N>, entry: &[f32; N]) {
    for t in 0..N {
        for lane in 0..LANES {
            let difference = block[t][lane] - entry[t];
            cost[lane] += difference * difference;
        }
    }
}
