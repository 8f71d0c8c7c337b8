//! Statistics of every octree node over every node of the time tree (ellsworth2000, eq. 1–6), while steps stream past.
//!
//! Each finest brick, a node without children, has a run of steps waiting at some levels of its time tree, as a binary counter has its bits: a step is a run of
//! one, and two halves are merged as soon as the second is over. At the end of the series what is left is merged as it is, so that
//! the last nodes are cut to the series. A run knows its statistics, hashes of what it holds, and of every sample
//! ([`samples`]) the mean and the deviation in time; these wait in files ([`carried`]). What closes is merged up the octree
//! ([`tree`]) and put to the store.
//!
//! For large grids only every `stride`-th sample along each axis takes part in the temporal error; a mean over fewer samples.

mod blocks;
mod carried;
mod run;
mod samples;
mod tree;

use std::sync::Mutex;

use chronoxel_core::time_tree::num_time_levels;
use chronoxel_core::{BrickLayout, NodeStatistics, Octree, TimeNode};
use chronoxel_store::StoreWriter;

use super::analyse::Core;
use super::real::Real;
use super::step::CutBrick;
use super::variable::Places;
use crate::EncodeError;
use carried::{Carried, KEPT_FROM, ShortRuns};
use run::{Held, Known, Run};
use samples::{ErrorSum, Merging};
use tree::Leaves;

/// Statistics go on from a multiple of so many steps after an interruption.
pub const KEPT_STEPS: u32 = 1 << KEPT_FROM;

/// The first step that statistics go on from where a store of `num_steps` has some committed.
pub fn first_step(num_committed: u32, num_steps: u32) -> u32 {
    if num_committed >= num_steps { num_steps } else { num_committed / KEPT_STEPS * KEPT_STEPS }
}

/// Bytes of memory that each finest node takes: while it waits, for each variable.
pub const WAITING_BYTES: u64 = size_of::<Node<f64>>() as u64;

/// Bytes that all nodes take while a step is merged and put, for each finest node.
///
/// * `num_steps`: of the series
pub fn closing_bytes(num_steps: u32, num_variables: u64) -> u64 {
    // The last step closes a run at each time level, which the writer holds until its commit, in an eighth more nodes.
    let put = (size_of::<NodeStatistics>() as u64 + 16).saturating_mul(num_variables);
    let of_level = put.saturating_add(size_of::<Known>() as u64);
    // Octree levels are merged for one time level at a time.
    u64::from(num_time_levels(num_steps)).saturating_mul(of_level) + 4 * size_of::<Known>() as u64
}

/// The largest number of samples of a brick that take part.
pub fn samples_of_brick(layout: &BrickLayout, stride: u32) -> usize {
    layout.edge.div_ceil(stride as usize).pow(3)
}

/// Buffers of samples of a brick that a thread uses.
pub const BUFFERS: u64 = 4;

/// What is carried through time of the finest bricks of one variable.
pub struct TimeMoments<T> {
    num_steps: u32,
    layout: BrickLayout,
    stride: usize,
    variable: usize,
    /// The first step that statistics go on from: those before have theirs.
    first: u32,
    leaves: Leaves,
    /// Of the leaves.
    nodes: Vec<Mutex<Node<T>>>,
    carried: Carried,
    /// Those that no thread uses.
    buffers: Mutex<Vec<Buffers<T>>>,
}

/// A finest brick, between steps and while one streams past.
struct Node<T> {
    short: ShortRuns<T>,
    /// What the step closes, by time level.
    closed: Vec<Known>,
}

/// Means, then deviations, of two runs.
struct Buffers<T> {
    left: Vec<T>,
    /// Of the run that ends with the step.
    right: Vec<T>,
}

impl<T: Real> TimeMoments<T> {
    /// Of variable `variable` of a store, from step `first` on, which [`first_step`] gives.
    ///
    /// * `in_memory`: whether there is memory for [`Self::short_bytes`]
    pub fn new(
        variable: usize,
        places: &Places<'_>,
        first: u32,
        in_memory: bool,
        writer: &StoreWriter,
    ) -> Result<Self, EncodeError> {
        let Places { tree, layout, stride, num_steps, folder, .. } = *places;
        let leaves = Leaves::new(tree);
        let num_nodes = leaves.len();
        let block_bytes = (2 * samples_of_brick(layout, stride) * size_of::<T>()) as u64;
        let mut carried = Carried::new(variable, num_nodes, block_bytes, folder, in_memory)?;
        if first < num_steps {
            carried.reopen(first, writer)?;
        }
        Ok(Self {
            num_steps,
            layout: *layout,
            stride: stride as usize,
            variable,
            first,
            leaves,
            nodes: (0..num_nodes)
                .map(|_| Mutex::new(Node { short: ShortRuns::default(), closed: Vec::new() }))
                .collect(),
            carried,
            buffers: Mutex::default(),
        })
    }

    /// Bytes of the samples of short runs, at most.
    pub fn short_bytes(places: &Places<'_>) -> u64 {
        let samples = 2 * samples_of_brick(places.layout, places.stride) as u64;
        let num_nodes = places.num_leaves;
        u64::from(KEPT_FROM) * num_nodes * samples * size_of::<T>() as u64
    }

    /// The run that waits once a step is read; none after the last.
    fn waiting(&self, step: u32) -> Option<TimeNode> {
        let last = TimeNode::closed_by(step, self.num_steps).last();
        last.filter(|_| step + 1 < self.num_steps)
    }

    /// Before a step is read.
    pub fn begin(&mut self, step: u32, writer: &mut StoreWriter) -> Result<(), EncodeError> {
        match self.waiting(step).filter(|_| step >= self.first) {
            Some(at) => self.carried.prepare(at, writer),
            None => Ok(()),
        }
    }

    /// Takes a brick of a step; called in parallel.
    ///
    /// * `value_range`: largest minus smallest value of the variable, for the guard of small means
    pub fn take(&self, brick: &CutBrick<'_, T>, step: u32, value_range: f64) -> Result<(), EncodeError> {
        let leaf = self.leaves.number(brick.geometry.level, brick.rank as usize);
        let Some(rank) = leaf.filter(|_| step >= self.first) else { return Ok(()) };
        let free = self.buffers.lock().expect("no one panics while holding buffers").pop();
        let mut buffers = free.unwrap_or(Buffers { left: Vec::new(), right: Vec::new() });
        let core = Core::new(brick.samples, brick.brick, brick.geometry, &self.layout);
        let num_samples = core.num_strided(self.stride);
        let mut node = self.nodes[rank].lock().expect("no one panics while holding a node");
        let Node { short, closed } = &mut *node;
        let mut merger =
            Merger { moments: self, rank, value_range, num_samples, buffers: &mut buffers, short };
        let taken = merger.take(brick, &core, step, closed);
        self.buffers.lock().expect("no one panics while holding buffers").push(buffers);
        taken
    }

    /// Once all bricks of a step are taken: puts what it closes.
    pub fn end(&mut self, step: u32, tree: &Octree, writer: &mut StoreWriter) -> Result<(), EncodeError> {
        if step < self.first {
            return Ok(());
        }
        let mut closed: Vec<Vec<Known>> = Vec::with_capacity(self.nodes.len());
        for node in &mut self.nodes {
            closed.push(std::mem::take(
                &mut node.get_mut().expect("no one panics while holding a node").closed,
            ));
        }
        for (place, at) in TimeNode::closed_by(step, self.num_steps).enumerate() {
            let of_leaves: Vec<Known> = closed.iter().map(|closed| closed[place]).collect();
            let of_nodes = tree::of_all_nodes(&of_leaves, &self.leaves, tree);
            writer.put_statistics(self.variable, at, &of_nodes)?;
            if at.level > KEPT_FROM {
                self.carried.forget(at.halves()[0], writer);
            }
        }
        Ok(())
    }
}

/// Merges one brick of a step through time.
struct Merger<'a, T> {
    moments: &'a TimeMoments<T>,
    rank: usize,
    value_range: f64,
    /// Samples of the brick that take part.
    num_samples: usize,
    buffers: &'a mut Buffers<T>,
    short: &'a mut ShortRuns<T>,
}

impl<T: Real> Merger<'_, T> {
    fn take(
        &mut self,
        brick: &CutBrick<'_, T>,
        core: &Core<'_, T>,
        step: u32,
        closed: &mut Vec<Known>,
    ) -> Result<(), EncodeError> {
        let moments = self.moments;
        let mut run = self.run_of_step(brick, core);
        let mut last = TimeNode::of_step(step);
        closed.reserve_exact(TimeNode::closed_by(step, moments.num_steps).count());
        for at in TimeNode::closed_by(step, moments.num_steps) {
            // Where the series ends with the first half, the whole is the same.
            if at.level > 0 && last.index % 2 == 1 {
                run = self.merged(at.halves()[0], &run)?;
            }
            closed.push(run.known);
            last = at;
        }
        let Some(at) = moments.waiting(step) else { return Ok(()) };
        let len = self.num_held(run.held);
        moments.carried.store(at, self.rank, run, (&mut self.buffers.right, len), self.short)
    }

    fn num_held(&self, held: Held) -> usize {
        match held {
            Held::Alike(_) => 0,
            Held::Means => self.num_samples,
            Held::Both => 2 * self.num_samples,
        }
    }

    fn run_of_step(&mut self, brick: &CutBrick<'_, T>, core: &Core<'_, T>) -> Run {
        let num = self.num_samples;
        let mut run = Run::of_step(brick.samples, &brick.analysis, num as u64);
        if run.held == Held::Means {
            self.buffers.right.resize(2 * num, T::SMALLEST);
            let means = &mut self.buffers.right[..num];
            core.gather(self.moments.stride, means);
            if brick.analysis.num_masked > 0 {
                run.known.errors.count = means.iter().filter(|v| !v.is_masked()).count() as u64;
            }
        }
        run
    }

    /// The run that waits and the one that follows it, as one; `buffers.right` goes from the latter's samples to those of both.
    fn merged(&mut self, left: TimeNode, later: &Run) -> Result<Run, EncodeError> {
        let (earlier, crc) = self.moments.carried.run(left, self.rank, self.short)?;
        let mut merged = earlier.followed_by(later);
        if merged.known.facts.is_static {
            return Ok(merged);
        }
        let merging = Merging {
            num_steps: [earlier.num_steps, later.num_steps],
            value_range: self.value_range,
            is_masked: merged.known.facts.is_masked,
            magnitude: merged.magnitude(),
        };
        (merged.known.errors, merged.held) = match (earlier.held, later.held) {
            (Held::Alike(a), Held::Alike(b)) => {
                let [mean, deviation] = a.map(T::from_f64);
                let [mut means, mut deviations] = b.map(|v| [T::from_f64(v)]);
                let errors = merging.merge([&[mean], &[deviation]], &mut means, &mut deviations);
                let both = [means[0].to_f64(), deviations[0].to_f64()];
                (errors.times(self.num_samples as u64), Held::Alike(both))
            }
            (a, b) => {
                self.load(left, a, crc)?;
                (self.merge_samples(&merging, [a, b]), Held::Both)
            }
        };
        Ok(merged)
    }

    fn load(&mut self, left: TimeNode, held: Held, crc: Option<u32>) -> Result<(), EncodeError> {
        let len = self.num_held(held);
        let samples = &mut self.buffers.left;
        samples.resize(2 * self.num_samples, T::SMALLEST);
        match len {
            0 => Ok(()),
            _ => self.moments.carried.load(left, self.rank, crc, (samples, len), self.short),
        }
    }

    fn merge_samples(&mut self, merging: &Merging, [left, right]: [Held; 2]) -> ErrorSum {
        let num = self.num_samples;
        let both_steady = left == Held::Means && right == Held::Means;
        self.buffers.right.resize(2 * num, T::SMALLEST);
        if !both_steady {
            spread(left, &mut self.buffers.left, num);
            spread(right, &mut self.buffers.right, num);
        }
        let (left_means, left_deviations) = self.buffers.left.split_at(num);
        let (means, deviations) = self.buffers.right.split_at_mut(num);
        match both_steady {
            true => merging.merge_means(left_means, means, deviations),
            false => merging.merge([left_means, left_deviations], means, deviations),
        }
    }
}

/// Writes out what is held in fewer numbers.
fn spread<T: Real>(held: Held, samples: &mut [T], num: usize) {
    let (means, deviations) = samples.split_at_mut(num);
    match held {
        Held::Alike([mean, deviation]) => {
            means.fill(T::from_f64(mean));
            deviations.fill(T::from_f64(deviation));
        }
        Held::Means => deviations.fill(T::from_f64(0.0)),
        Held::Both => {}
    }
}

#[cfg(test)]
mod tests {
    use chronoxel_core::Samples;
    use chronoxel_store::{Store, TimeTreeEntry};

    use super::super::{Codec, EncodeOptions, EncodeReport, Job, Source};
    use super::*;
    use crate::{TimeSeries, sim};

    const DIMS: [usize; 3] = [17, 20, 15];

    /// A small store whose temporal errors are made from every `stride`-th sample.
    fn encoded(series: &mut dyn TimeSeries, stride: u32) -> Store {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("s.cxl");
        let options = EncodeOptions { codec: Codec::Raw, brick_edge: 8, ..EncodeOptions::default() };
        let mut source = Source::Volume(series);
        let mut job = Job::new(&source, &options).unwrap();
        job.description.time_tree = Some(TimeTreeEntry { stride });
        let mut writer = StoreWriter::create(&path, &job.description, false).unwrap();
        let mut report = EncodeReport::default();
        job.run(&mut source, &mut writer, 0, folder.path(), &mut report, &mut |_| {}).unwrap();
        writer.finish().unwrap();
        let store = Store::open(&path).unwrap();
        // Chunks of statistics stay in the store's cache when the folder goes: read them all.
        (0..4).for_each(|level| assert!(store.statistics(0, TimeNode { level, index: 0 }).is_ok()));
        store
    }

    #[test]
    fn strided_errors_are_means_over_every_so_many_samples() {
        let mut series = sim::open("sim:vortex?dims=17x20x15&steps=5").unwrap();
        let steps: Vec<Vec<f32>> = (0..5)
            .map(|step| match series.open_step(0, step).unwrap().read_slices(DIMS[2]).unwrap() {
                Samples::F32(samples) => samples,
                Samples::F64(_) => panic!("a simulation is of single precision"),
            })
            .collect();
        let fold = |from: &[Vec<f32>], pick: fn(f32, f32) -> f32| from.iter().flatten().copied().reduce(pick);
        let before = &steps[..4];
        let range = f64::from(fold(before, f32::max).unwrap()) - f64::from(fold(before, f32::min).unwrap());
        let exact = encoded(&mut *series, 1);
        for stride in [2, 4] {
            let store = encoded(&mut *series, stride as u32);
            let errors: Vec<f64> = (0..DIMS.iter().product())
                .filter(|&i| {
                    let place = [i % DIMS[0], i / DIMS[0] % DIMS[1], i / (DIMS[0] * DIMS[1])];
                    place.iter().all(|p| p % stride == 0)
                })
                .map(|i| {
                    let values = steps.iter().map(|step| f64::from(step[i]));
                    let mean = values.clone().sum::<f64>() / 5.0;
                    let variance = values.map(|v| (v - mean) * (v - mean)).sum::<f64>() / 5.0;
                    variance.sqrt() / mean.abs().max(0.001 * range)
                })
                .collect();
            let expected = errors.iter().sum::<f64>() / errors.len() as f64;
            let at = TimeNode::root(5);
            let root = store.statistics(0, at).unwrap().pop().unwrap();
            assert!((root.temporal_error / expected - 1.0).abs() < 1e-5, "{root:?} {expected}");
            let exact = exact.statistics(0, at).unwrap().pop().unwrap();
            assert_ne!(root.temporal_error, exact.temporal_error);
            assert_eq!((root.mean, root.std, root.facts), (exact.mean, exact.std, exact.facts));
        }
    }

    #[test]
    fn an_interruption_goes_back_to_a_multiple_of_eight() {
        assert_eq!([0, 7, 8, 13, 35, 36].map(|committed| first_step(committed, 36)), [0, 0, 8, 8, 32, 36]);
    }
}
