//! Fitting the encoder's working set into the memory it was given. Portions change, results do not.

use chronoxel_core::{BrickLayout, LevelGeometry, SampleType};

use crate::EncodeError;

/// The portions in which a step is read and its bricks are coded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Portions {
    /// Slices read at once.
    pub slab_slices: usize,
    /// Bricks coded at once.
    pub batch_bricks: usize,
}

/// Slabs larger than this are not read faster.
const LARGEST_SLAB_BYTES: u64 = 4 << 20;
const LARGEST_BATCH: usize = 256;

/// The largest portions that fit `memory_bytes`.
///
/// * `sample_types`: of all variables to encode; the widest counts
///
/// # Errors
/// [`EncodeError::Memory`] if even the smallest do not fit.
pub fn portions(
    levels: &[LevelGeometry],
    layout: &BrickLayout,
    sample_types: impl Iterator<Item = SampleType>,
    num_threads: usize,
    memory_bytes: u64,
) -> Result<Portions, EncodeError> {
    let widest = sample_types.map(|t| (held_bytes(t), t.num_bytes() as u64)).max().unwrap_or((4, 4));
    let needed = |slab: usize, batch: usize| {
        slices_bytes(levels, layout, widest, slab).saturating_add(bricks_bytes(
            layout,
            widest.0,
            num_threads,
            batch,
        ))
    };
    if needed(1, 1) > memory_bytes {
        return Err(EncodeError::Memory { given: memory_bytes, needed: needed(1, 1) });
    }
    let slice_bytes = area(&levels[0]) * widest.0;
    let most_slices = (LARGEST_SLAB_BYTES / slice_bytes.max(1)).clamp(1, layout.edge as u64) as usize;
    let most_bricks = levels[0].bricks[0].saturating_mul(levels[0].bricks[1]).min(LARGEST_BATCH);
    // Batches first: without enough bricks at once, threads stand idle.
    let batch_bricks = largest(most_bricks, |batch| needed(1, batch) <= memory_bytes);
    let slab_slices = largest(most_slices, |slab| needed(slab, batch_bricks) <= memory_bytes);
    Ok(Portions { slab_slices, batch_bricks })
}

/// The largest of `1 ..= most` that fits, halving; 1 fits.
fn largest(most: usize, fits: impl Fn(usize) -> bool) -> usize {
    let mut n = most;
    while n > 1 && !fits(n) {
        n /= 2;
    }
    n.max(1)
}

fn held_bytes(sample_type: SampleType) -> u64 {
    if sample_type.fits_f32() { 4 } else { 8 }
}

fn area(level: &LevelGeometry) -> u64 {
    (level.field_dims[0] as u64).saturating_mul(level.field_dims[1] as u64)
}

/// The windows of all levels, the slab that the reader holds, and what the reader itself needs to make it.
fn slices_bytes(levels: &[LevelGeometry], layout: &BrickLayout, (held, raw): (u64, u64), slab: usize) -> u64 {
    let mut bytes = area(&levels[0]).saturating_mul(slab as u64 * (held + raw));
    for level in levels {
        // What is complete at level 0 arrives here at once; it is at most an edge's worth.
        let portion = if level.level == 0 { slab } else { (layout.edge >> level.level) + 2 };
        let slices = level.field_dims[2].min(layout.full_edge() + portion);
        bytes = bytes.saturating_add(area(level).saturating_mul(slices as u64 * held));
    }
    bytes
}

/// For each thread a brick being cut and quantised; for each brick of a batch its indices, bytes and compressed bytes.
fn bricks_bytes(layout: &BrickLayout, held: u64, num_threads: usize, batch: usize) -> u64 {
    let full = layout.num_full() as u64;
    full * ((held + 4) * num_threads as u64 + 8 * batch as u64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use chronoxel_core::{UniformGrid, octree::levels_of};

    #[test]
    fn small_budgets_give_small_portions_and_smaller_ones_an_error() {
        let layout = BrickLayout::new(32).unwrap();
        let levels = levels_of(&UniformGrid::new([1024; 3], [0.0; 3], [1.0; 3]).unwrap(), &layout);
        let at = |bytes| portions(&levels, &layout, [SampleType::F32].into_iter(), 2, bytes);
        let ample = at(1 << 33).unwrap();
        assert_eq!((ample.slab_slices, ample.batch_bricks), (1, 256));
        let Err(EncodeError::Memory { needed, .. }) = at(1 << 20) else { panic!("1 MiB cannot be enough") };
        // 35 slices of 4 MiB at least; an eighth of the step would be 512 MiB.
        assert!(needed > 35 << 22 && needed < 300 << 20, "{needed}");
        assert_eq!(at(needed).unwrap(), Portions { slab_slices: 1, batch_bricks: 1 });
    }
}
