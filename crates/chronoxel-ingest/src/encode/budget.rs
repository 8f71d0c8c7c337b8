//! Fitting the encoder's working set into the memory it was given. Portions change, results do not.

use chronoxel_core::{BrickLayout, LevelGeometry, SampleType};

use super::moments;
use crate::voxelise::Voxels;
use crate::{EncodeError, MeshSeries};

/// The portions in which a step is read and its bricks are coded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Portions {
    /// Slices read at once.
    pub slab_slices: usize,
    /// Bricks cut at once.
    pub batch_bricks: usize,
    /// Nodes whose windows are coded at once.
    pub batch_nodes: usize,
    /// What may wait in memory for the end of its window; the rest waits in the scratch file.
    pub scratch_bytes: u64,
}

/// Slabs larger than this are not read faster.
const LARGEST_SLAB_BYTES: u64 = 4 << 20;
/// Batches larger than this only leave the cache, as long as every thread has a few bricks.
const LARGEST_BATCH: usize = 64;
/// The program itself.
const FIXED_BYTES: u64 = 6 << 20;
/// A thread's stack and its compressor.
const THREAD_BYTES: u64 = 1 << 20;
/// What the writer keeps of a payload so that an equal one is stored once, and of how many at most.
const DIGEST_BYTES: u64 = 128;
const MAX_DIGESTS: u64 = 1 << 20;
/// What is known of a brick and step that waits: its analysis, and where it waits.
const WAITING_BYTES: u64 = 192;
/// Nodes coded at once, at most: enough for every thread.
const LARGEST_NODE_BATCH: usize = 16;
/// What the writer keeps of a node in the step being written: its record, its place in the open shards.
const NODE_BYTES: u64 = 256;

/// What the working set follows from.
#[derive(Debug, Clone, Copy)]
pub struct Task<'a> {
    /// The levels, finest first.
    pub levels: &'a [LevelGeometry],
    /// The shape of bricks.
    pub layout: &'a BrickLayout,
    /// The widest type among the variables.
    pub sample_type: SampleType,
    /// Number of variables times number of steps.
    pub num_volumes: u64,
    /// Threads that code bricks.
    pub num_threads: usize,
    /// What the source holds besides the slices that it hands over.
    pub source_bytes: u64,
    /// Nodes of each level.
    pub nodes: &'a [u64],
    /// Nodes without children.
    pub num_leaves: u64,
    /// Whether steps stream past in slices.
    pub has_slices: bool,
    /// Steps of a window; 1 where each step is coded as it comes.
    pub window: u32,
    /// Copies of a window's samples that coding one node holds, payloads included; 0 where each step is coded as it comes.
    pub copies: u64,
    /// Nodes whose windows are held at once, with what they may be coded as, besides those that threads work on.
    pub held_nodes: u64,
    /// Bytes of that for each of their samples and steps, besides the sample.
    pub held_payload_bytes: u64,
    /// Variables that wait at the same time.
    pub num_variables: u64,
    /// Steps of the series.
    pub num_steps: u32,
    /// Every so many samples along each axis take part in the temporal error.
    pub stride: u32,
}

/// The largest portions that fit `memory_bytes`.
///
/// # Errors
/// [`EncodeError::Memory`] if even the smallest do not fit.
pub fn portions(task: &Task<'_>, memory_bytes: u64) -> Result<Portions, EncodeError> {
    let needed = |slab_slices, batch_bricks, batch_nodes| {
        task.needed(Portions { slab_slices, batch_bricks, batch_nodes, scratch_bytes: 0 })
    };
    if needed(1, 1, 1) > memory_bytes {
        return Err(EncodeError::Memory {
            given: memory_bytes,
            needed: needed(1, 1, 1),
            source_bytes: task.source_bytes,
        });
    }
    let finest = &task.levels[0];
    let slice_bytes = area(finest) * task.held_bytes();
    let most_slices = (LARGEST_SLAB_BYTES / slice_bytes.max(1)).clamp(1, task.layout.edge as u64) as usize;
    let most_bricks =
        finest.bricks[0].saturating_mul(finest.bricks[1]).min(LARGEST_BATCH.max(4 * task.num_threads));
    // Batches first: without enough bricks at once, threads stand idle.
    let most_nodes = LARGEST_NODE_BATCH.max(4 * task.num_threads);
    let batch_nodes = largest(most_nodes, |nodes| needed(1, 1, nodes) <= memory_bytes);
    let batch_bricks = largest(most_bricks, |batch| needed(1, batch, batch_nodes) <= memory_bytes);
    let slab_slices = largest(most_slices, |slab| needed(slab, batch_bricks, batch_nodes) <= memory_bytes);
    let left = memory_bytes - needed(slab_slices, batch_bricks, batch_nodes);
    // A sixteenth of it is what the allocator cannot use.
    Ok(Portions { slab_slices, batch_bricks, batch_nodes, scratch_bytes: left - left / 16 })
}

/// What of the memory the cores of nodes above the finest may take, as a divisor.
pub const CORE_SHARE: u64 = 16;

/// What voxelising a mesh may take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct VoxelRoom {
    /// For lists of tetrahedra, until the tree is built.
    pub list_bytes: u64,
    /// For the sampling map, as long as steps are encoded.
    pub map_bytes: u64,
}

/// Shares the memory between what a mesh needs and what goes to files beyond it.
///
/// # Errors
/// [`EncodeError::Memory`] if the points of the mesh do not fit.
pub fn voxel_room(
    mesh: &dyn MeshSeries,
    layout: &BrickLayout,
    memory_bytes: u64,
) -> Result<VoxelRoom, EncodeError> {
    let num_threads = rayon::current_num_threads() as u64;
    let points = Voxels::BYTES_PER_POINT.saturating_mul(mesh.num_points() as u64);
    let source_bytes = points.saturating_add(mesh.working_bytes());
    // For each thread the samples of a brick, as numbers and as runs; and the voxels of a node.
    let bricks = 24 * layout.num_full() as u64 * num_threads;
    let fixed = FIXED_BYTES + THREAD_BYTES * num_threads;
    let least = source_bytes.saturating_add(bricks + fixed + LEAST_LIST_BYTES);
    let needed = least.saturating_add(least / 16);
    match memory_bytes.checked_sub(needed) {
        None => Err(EncodeError::Memory { given: memory_bytes, needed, source_bytes }),
        Some(left) => Ok(VoxelRoom { list_bytes: LEAST_LIST_BYTES + left / 2, map_bytes: left / 4 }),
    }
}

/// Lists of tetrahedra are no shorter than it takes to work on them.
const LEAST_LIST_BYTES: u64 = 4 << 20;

impl Task<'_> {
    fn held_bytes(&self) -> u64 {
        if self.sample_type.fits_f32() { 4 } else { 8 }
    }

    /// The least memory for some portions; a sixteenth more for what the allocator cannot use.
    fn needed(&self, portions: Portions) -> u64 {
        let parts = [
            FIXED_BYTES + THREAD_BYTES * self.num_threads as u64,
            self.slices_bytes(portions.slab_slices),
            self.bricks_bytes(portions.batch_bricks),
            self.nodes_bytes(portions.batch_nodes),
            self.moments_bytes(),
            self.writer_bytes(),
            self.source_bytes,
        ];
        let sum = parts.into_iter().fold(0, u64::saturating_add);
        sum.saturating_add(sum / 16)
    }

    /// The windows of all levels, the slab that the reader holds, and what the reader itself needs to make it.
    fn slices_bytes(&self, slab: usize) -> u64 {
        if !self.has_slices {
            return 0;
        }
        let raw = self.sample_type.num_bytes() as u64;
        let mut bytes = area(&self.levels[0]).saturating_mul(slab as u64 * (self.held_bytes() + raw));
        for level in self.levels {
            // What is complete at level 0 arrives here at once; it is at most an edge's worth.
            let portion = if level.level == 0 { slab } else { (self.layout.edge >> level.level) + 2 };
            let slices = level.field_dims[2].min(self.layout.full_edge() + portion) as u64;
            bytes = bytes.saturating_add(area(level).saturating_mul(slices * self.held_bytes()));
        }
        bytes
    }

    /// For each thread a brick being cut and quantised; for each brick of a batch its bytes, while those of the
    /// batch before are compressed.
    fn bricks_bytes(&self, batch: usize) -> u64 {
        let full = self.layout.num_full() as u64;
        full * ((self.held_bytes() + 4) * self.num_threads as u64 + 8 * batch as u64)
    }

    /// For each thread the windows of a node being coded; for each node of a batch its payloads, while those of the batch
    /// before are compressed; and what is known of every brick that waits.
    fn nodes_bytes(&self, batch: usize) -> u64 {
        if self.copies == 0 {
            return 0;
        }
        let samples = (self.layout.num_full() as u64).saturating_mul(self.window.into());
        let threads = (self.num_threads as u64).saturating_mul(self.copies * self.held_bytes());
        let held = self.held_nodes.saturating_mul(self.held_bytes() + self.held_payload_bytes);
        let coded = samples.saturating_mul(threads.saturating_add(held).saturating_add(4 * batch as u64));
        let waiting = self.num_nodes().saturating_mul(u64::from(self.window) * WAITING_BYTES);
        coded.saturating_add(waiting.saturating_mul(self.num_variables))
    }

    /// For each thread the samples of two runs of steps of a brick; what is known of each finest brick while it waits,
    /// and of all nodes over the runs that a step closes.
    fn moments_bytes(&self) -> u64 {
        let samples = moments::samples_of_brick(self.layout, self.stride) as u64;
        let threads = (self.num_threads as u64).saturating_mul(moments::BUFFERS * self.held_bytes());
        let waiting = moments::WAITING_BYTES.saturating_mul(self.num_variables);
        let of_node = waiting.saturating_add(moments::closing_bytes(self.num_steps, self.num_variables));
        samples.saturating_mul(threads).saturating_add(self.num_leaves.saturating_mul(of_node))
    }

    fn num_nodes(&self) -> u64 {
        self.nodes.iter().copied().fold(0, u64::saturating_add)
    }

    fn writer_bytes(&self) -> u64 {
        let num_nodes = self.num_nodes();
        let digests = num_nodes.saturating_mul(self.num_volumes).min(MAX_DIGESTS);
        digests * DIGEST_BYTES + num_nodes.saturating_mul(NODE_BYTES)
    }
}

/// The largest of `1 ..= most` that fits, halving; 1 fits.
fn largest(most: usize, fits: impl Fn(usize) -> bool) -> usize {
    let mut n = most;
    while n > 1 && !fits(n) {
        n /= 2;
    }
    n.max(1)
}

fn area(level: &LevelGeometry) -> u64 {
    (level.field_dims[0] as u64).saturating_mul(level.field_dims[1] as u64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use chronoxel_core::{UniformGrid, octree::levels_of};

    #[test]
    fn small_budgets_give_small_portions_and_smaller_ones_an_error() {
        let layout = BrickLayout::new(32).unwrap();
        let levels = levels_of(&UniformGrid::new([1024; 3], [0.0; 3], [1.0; 3]).unwrap(), &layout);
        let task = Task {
            levels: &levels,
            layout: &layout,
            sample_type: SampleType::F32,
            num_volumes: 1,
            num_threads: 2,
            source_bytes: 0,
            nodes: &[32_768, 4096, 512, 64, 8, 1],
            num_leaves: 32_768,
            has_slices: true,
            window: 1,
            copies: 0,
            held_nodes: 0,
            held_payload_bytes: 0,
            num_variables: 1,
            num_steps: 1,
            stride: 4,
        };
        let at = |bytes| portions(&task, bytes);
        let ample = at(1 << 33).unwrap();
        assert_eq!((ample.slab_slices, ample.batch_bricks), (1, 64));
        let Err(EncodeError::Memory { needed, .. }) = at(1 << 20) else { panic!("1 MiB cannot be enough") };
        // 35 slices of 4 MiB at least; an eighth of the step would be 512 MiB.
        assert!(needed > 35 << 22 && needed < 300 << 20, "{needed}");
        let least = at(needed).unwrap();
        assert_eq!((least.slab_slices, least.batch_bricks), (1, 1));
        // Windows of 8 steps: what one node takes for each thread, and one of a batch.
        let windowed = Task { window: 8, copies: 5, ..task };
        let Err(EncodeError::Memory { needed: with_windows, .. }) = portions(&windowed, 1 << 20) else {
            panic!("1 MiB cannot be enough")
        };
        assert!(with_windows > needed + 8 * 42_875 * 4 * 5 * 2, "{with_windows}");
        let least = portions(&windowed, with_windows).unwrap();
        assert_eq!((least.batch_nodes, least.scratch_bytes), (1, 0));
        assert!(portions(&windowed, 1 << 33).unwrap().scratch_bytes > 1 << 32);
        // What the source holds is on top, with the sixteenth that goes with it.
        let beside = Task { source_bytes: 1 << 30, ..task };
        let Err(error) = portions(&beside, needed + (1 << 30)) else { panic!("a sixteenth is missing") };
        let text = error.to_string();
        assert!(text.contains("1073741824 of them for the source") && !text.contains('\n'), "{text}");
        assert!(portions(&beside, needed + (17 << 26)).is_ok());
    }
}
