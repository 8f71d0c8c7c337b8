//! The rolling window of slices that one level of the pyramid keeps while a step streams past.

use std::collections::VecDeque;

use chronoxel_core::{BrickLayout, LevelGeometry};

use super::real::Real;

/// Some consecutive slices of constant z of one level, `[z, y, x]` over `field_dims`; masked samples are NaN.
#[derive(Debug)]
pub struct Slab<T> {
    /// z of the first slice.
    pub first: usize,
    /// The samples.
    pub samples: Vec<T>,
    /// For each slice, whether any of its samples is masked.
    pub masked: Vec<bool>,
}

/// The slices of a level that are still needed.
#[derive(Debug)]
pub struct Window<T> {
    /// Sizes of the level.
    pub geometry: LevelGeometry,
    /// The next layer of bricks to cut.
    pub next_layer: usize,
    slabs: VecDeque<Slab<T>>,
    num_slices: usize,
}

impl<T: Real> Window<T> {
    /// An empty window at the start of a step.
    pub fn new(geometry: LevelGeometry) -> Self {
        Self { geometry, next_layer: 0, slabs: VecDeque::new(), num_slices: 0 }
    }

    /// Slices that came so far, dropped ones included.
    pub fn num_slices(&self) -> usize {
        self.num_slices
    }

    /// Appends slices; they must follow those that came before.
    pub fn push(&mut self, slab: Slab<T>) {
        assert_eq!(slab.first, self.num_slices, "slabs come in order");
        self.num_slices += slab.masked.len();
        self.slabs.push_back(slab);
    }

    /// Samples of one slice.
    pub fn slice_len(&self) -> usize {
        self.geometry.field_dims[0] * self.geometry.field_dims[1]
    }

    /// Slice `z`, and whether any of its samples is masked.
    pub fn slice(&self, z: usize) -> (&[T], bool) {
        let index = self.slabs.partition_point(|s| s.first + s.masked.len() <= z);
        let slab = &self.slabs[index];
        let len = self.slice_len();
        (&slab.samples[(z - slab.first) * len..][..len], slab.masked[z - slab.first])
    }

    /// Slice `z` clamped to the level: samples are replicated outwards.
    pub fn slice_clamped(&self, z: isize) -> (&[T], bool) {
        self.slice(z.clamp(0, self.geometry.field_dims[2] as isize - 1) as usize)
    }

    /// Whether every slice that the next layer of bricks reaches, apron included, has come.
    pub fn layer_is_complete(&self, layout: &BrickLayout) -> bool {
        self.next_layer < self.geometry.bricks[2]
            && self.num_slices >= self.slices_for(layout, self.next_layer)
    }

    /// Slices that must have come before layer `layer` can be cut.
    pub fn slices_for(&self, layout: &BrickLayout, layer: usize) -> usize {
        (layout.edge * (layer + 1) + layout.high).min(self.geometry.field_dims[2])
    }

    /// Forgets slabs that neither the next layer of bricks nor slice `next_above` of the level above needs.
    pub fn forget(&mut self, layout: &BrickLayout, next_above: Option<usize>) {
        let for_bricks = match self.next_layer < self.geometry.bricks[2] {
            true => (layout.edge * self.next_layer).saturating_sub(layout.low),
            false => usize::MAX,
        };
        let for_above = next_above.map_or(usize::MAX, |i| (2 * i).saturating_sub(1));
        // Replicated slices: the last one may be asked for from beyond the end.
        let needed = for_bricks.min(for_above).min(self.geometry.field_dims[2] - 1);
        while self.slabs.front().is_some_and(|s| s.first + s.masked.len() <= needed) {
            self.slabs.pop_front();
        }
    }
}
