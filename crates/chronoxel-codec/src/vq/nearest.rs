//! The nearest entry for each of many vectors: the kernel in which a vector palette spends its time.
//!
//! There is one body, [`nearest_of_block`], compiled for several instruction sets and chosen at run time (closures
//! would be compiled for the plain one: it has loops). Lanes are
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
        #[cfg_attr(not(target_arch = "x86_64"), allow(unused_mut))]
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

/// Entries in the order of the sums of their components, each padded with zeros to runs of `N` components.
struct Sorted<const N: usize> {
    /// `[entry, run]`.
    runs: Vec<[f32; N]>,
    num_runs: usize,
    /// Sum of the components.
    sums: Vec<f32>,
    prices: Vec<f32>,
    /// The number of the entry before sorting.
    numbers: Vec<u32>,
    /// By how much sums may be off for rounding.
    margin: f32,
    /// Square root of the number of components.
    root: f32,
}

impl<const N: usize> Sorted<N> {
    fn new(entries: &Entries, num_steps: usize, largest: f32) -> Self {
        let entry = |e: u32| &entries.values[e as usize * num_steps..][..num_steps];
        let sum = |e: u32| entry(e).iter().sum::<f32>();
        let mut numbers: Vec<u32> = (0..entries.prices.len() as u32).collect();
        numbers.sort_by(|&a, &b| sum(a).total_cmp(&sum(b)));
        let num_runs = num_steps.div_ceil(N).max(1);
        let component = |e: u32, t: usize| entry(e).get(t).copied().unwrap_or(0.0);
        let run = |e: u32, run: usize| std::array::from_fn(|t| component(e, run * N + t));
        let largest = entries.values.iter().fold(largest, |a, b| a.max(b.abs()));
        Self {
            runs: numbers.iter().flat_map(|&e| (0..num_runs).map(move |r| run(e, r))).collect(),
            num_runs,
            sums: numbers.iter().map(|&e| sum(e)).collect(),
            prices: numbers.iter().map(|&e| entries.prices[e as usize]).collect(),
            numbers,
            // Each of the additions is off by less than 2^-24 of at most `num_steps` times the largest.
            margin: (num_steps * num_steps) as f32 * largest * 2.4e-7,
            root: (num_steps as f32).sqrt(),
        }
    }
}

/// Vectors of up to `N` components are padded with zeros; longer ones are summed in runs of `N`.
fn nearest_in<const N: usize>(set: InstructionSet, vectors: Vectors, entries: &Entries) -> Nearest {
    let num_steps = vectors.num_steps();
    let mut found = Nearest { indices: vec![0; vectors.len], costs: vec![0.0; vectors.len] };
    let mut sums = vec![0.0f32; vectors.len];
    let mut largest = 0.0f32;
    for component in vectors.values.chunks_exact(vectors.len.max(1)) {
        for (sum, &x) in sums.iter_mut().zip(component) {
            *sum += x;
            largest = if x.abs() > largest { x.abs() } else { largest };
        }
    }
    let sorted = Sorted::<N>::new(entries, num_steps, largest);
    let mut blocks = vec![[[0.0f32; LANES]; N]; sorted.num_runs];
    for places in order_of(&sums).chunks(LANES) {
        for t in 0..num_steps {
            let component = &vectors.values[t * vectors.len..][..vectors.len];
            let lanes = &mut blocks[t / N][t % N];
            // Lanes too many at the end repeat the first.
            for (lane, place) in lanes.iter_mut().enumerate() {
                *place = component[places.get(lane).unwrap_or(&places[0]).to_owned() as usize];
            }
        }
        let of_places =
            |pick: fn(f32, f32) -> f32, first| places.iter().fold(first, |a, &at| pick(a, sums[at as usize]));
        let range = [of_places(f32::min, f32::INFINITY), of_places(f32::max, f32::NEG_INFINITY)];
        let (indices, costs) = match set {
            InstructionSet::Plain => nearest_of_block(&blocks, range, &sorted),
            // SAFETY: `nearest_with` has checked that the processor has the instructions.
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2 => unsafe { nearest_avx2(&blocks, range, &sorted) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512 => unsafe { nearest_avx512(&blocks, range, &sorted) },
            #[cfg(not(target_arch = "x86_64"))]
            _ => nearest_of_block(&blocks, range, &sorted),
        };
        for ((&at, index), cost) in places.iter().zip(indices).zip(costs) {
            found.indices[at as usize] = index as u16;
            found.costs[at as usize] = cost;
        }
    }
    found
}

/// Places of the numbers so that they nearly increase: by 2,048 classes between the smallest and the largest.
fn order_of(sums: &[f32]) -> Vec<u32> {
    const CLASSES: usize = 2048;
    let low = sums.iter().copied().fold(f32::INFINITY, f32::min);
    let high = sums.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let per_class = if high > low { (CLASSES - 1) as f32 / (high - low) } else { 0.0 };
    let class = |sum: f32| (((sum - low) * per_class) as usize).min(CLASSES - 1);
    let mut starts = [0u32; CLASSES + 1];
    sums.iter().for_each(|&sum| starts[class(sum) + 1] += 1);
    (1..=CLASSES).for_each(|c| starts[c] += starts[c - 1]);
    let mut order = vec![0; sums.len()];
    for (at, &sum) in (0u32..).zip(sums) {
        let next = &mut starts[class(sum)];
        order[*next as usize] = at;
        *next += 1;
    }
    order
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn nearest_avx2<const N: usize>(
    blocks: &[Block<N>],
    range: [f32; 2],
    entries: &Sorted<N>,
) -> ([u32; LANES], [f32; LANES]) {
    nearest_of_block(blocks, range, entries)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
fn nearest_avx512<const N: usize>(
    blocks: &[Block<N>],
    range: [f32; 2],
    entries: &Sorted<N>,
) -> ([u32; LANES], [f32; LANES]) {
    nearest_of_block(blocks, range, entries)
}

/// For each lane the entry of least cost, the first of several, and the cost.
///
/// The squared distance of two vectors of `n` components is at least `1 / n` of the squared difference of their
/// sums (Cauchy and Schwarz). So the entries are taken from the middle of the block's sums outwards, until the
/// next one's sum is too far from all the block's to cost less than what the lanes have found.
///
/// * `blocks`: runs of components of the vectors
/// * `range`: smallest and largest sum of the vectors
#[inline(always)]
fn nearest_of_block<const N: usize>(
    blocks: &[Block<N>],
    range: [f32; 2],
    entries: &Sorted<N>,
) -> ([u32; LANES], [f32; LANES]) {
    let mut best = Best { indices: [0; LANES], costs: [f32::INFINITY; LANES] };
    let num_entries = entries.sums.len();
    let middle = entries.sums.partition_point(|&sum| sum < (range[0] + range[1]) / 2.0);
    let (mut below, mut above) = (middle, middle);
    let mut reach = f32::INFINITY;
    loop {
        let go_up = above < num_entries && entries.sums[above] - range[1] <= reach;
        let go_down = below > 0 && range[0] - entries.sums[below - 1] <= reach;
        if go_up {
            let end = num_entries.min(above + AT_ONCE);
            for e in above..end {
                best.consider(blocks, entries, e);
            }
            above = end;
        }
        if go_down {
            let start = below.saturating_sub(AT_ONCE);
            for e in start..below {
                best.consider(blocks, entries, e);
            }
            below = start;
        }
        if !go_up && !go_down {
            return (best.indices, best.costs);
        }
        let mut largest = 0.0f32;
        for cost in best.costs {
            largest = if cost > largest { cost } else { largest };
        }
        // Computed costs are off by parts in a million.
        reach = (largest * 1.0001).sqrt() * entries.root + entries.margin;
    }
}

/// Entries that are taken between two looks at how far to go.
const AT_ONCE: usize = 8;

/// What the lanes have found.
struct Best {
    indices: [u32; LANES],
    costs: [f32; LANES],
}

impl Best {
    /// Takes an entry where it costs less than the best so far, or as much and comes first.
    #[inline(always)]
    fn consider<const N: usize>(&mut self, blocks: &[Block<N>], entries: &Sorted<N>, at: usize) {
        let mut cost = [0.0f32; LANES];
        if let [block] = blocks {
            add_squared_distance(&mut cost, block, &entries.runs[at]);
        } else {
            let runs = &entries.runs[at * entries.num_runs..][..entries.num_runs];
            for (block, run) in blocks.iter().zip(runs) {
                add_squared_distance(&mut cost, block, run);
            }
        }
        let (number, price) = (entries.numbers[at], entries.prices[at]);
        for lane in 0..LANES {
            let cost = cost[lane] + price;
            let (best, index) = (self.costs[lane], self.indices[lane]);
            let less = (cost < best) | ((cost == best) & (number < index));
            self.costs[lane] = if less { cost } else { best };
            self.indices[lane] = if less { number } else { index };
        }
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
