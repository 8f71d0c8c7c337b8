//! Cutting one brick, apron included, out of a level's window of slices.

use chronoxel_core::BrickLayout;

use super::real::Real;
use super::window::Window;

/// Copies brick `[x, y, z]` into `out`, `[z, y, x]` over core and apron; positions are clamped to the level.
///
/// Returns whether a slice that the brick touches has masked samples (not whether the brick itself has).
pub fn cut<T: Real>(window: &Window<T>, brick: [usize; 3], layout: &BrickLayout, out: &mut Vec<T>) -> bool {
    let full = layout.full_edge();
    let [width, height, _] = window.geometry.field_dims;
    let start = brick.map(|b| (b * layout.edge) as isize - layout.low as isize);
    let row_span = RowSpan::new(start[0], full, width);
    out.clear();
    out.reserve(layout.num_full());
    let mut may_be_masked = false;
    for z in 0..full as isize {
        let (slice, masked) = window.slice_clamped(start[2] + z);
        may_be_masked |= masked;
        for y in 0..full as isize {
            let y = (start[1] + y).clamp(0, height as isize - 1) as usize;
            row_span.copy(&slice[y * width..][..width], out);
        }
    }
    may_be_masked
}

/// Which samples of a level's row a brick's row consists of.
struct RowSpan {
    before: usize,
    inside: std::ops::Range<usize>,
    after: usize,
}

impl RowSpan {
    fn new(start: isize, full: usize, width: usize) -> Self {
        let inside = start.max(0) as usize..((start + full as isize) as usize).min(width);
        let before = (-start).max(0) as usize;
        Self { before, after: full - before - inside.len(), inside }
    }

    #[inline(always)]
    fn copy<T: Copy>(&self, row: &[T], out: &mut Vec<T>) {
        let inside = &row[self.inside.clone()];
        if self.before > 0 {
            out.extend(std::iter::repeat_n(inside[0], self.before));
        }
        out.extend_from_slice(inside);
        if self.after > 0 {
            out.extend(std::iter::repeat_n(inside[inside.len() - 1], self.after));
        }
    }
}
