//! What slicing gives: polygons in flat arrays, as they are uploaded.

use std::ops::Range;

/// Polygons of slices, one after another in the order in which they are drawn.
///
/// Every polygon has three to six vertices, counter-clockwise as seen from the eye, and is convex. Where a plane only
/// touches a box, some or all of them coincide; such a polygon has no area.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SliceList {
    pub(super) positions: Vec<[f32; 3]>,
    pub(super) firsts: Vec<u32>,
    pub(super) slices: Vec<i32>,
}

impl SliceList {
    /// Forgets the polygons; their memory is kept for the next ones.
    pub fn clear(&mut self) {
        self.positions.clear();
        self.firsts.clear();
        self.slices.clear();
    }

    /// The vertices of all polygons, in the coordinates of the boxes.
    pub fn positions(&self) -> &[[f32; 3]] {
        &self.positions
    }

    /// For each polygon, its first vertex; it ends where the next begins, the last one with the vertices.
    pub fn firsts(&self) -> &[u32] {
        &self.firsts
    }

    /// For each polygon, the slice that it is a part of: `k` for the plane at depth `k` times the slice distance.
    pub fn slices(&self) -> &[i32] {
        &self.slices
    }

    /// How many polygons there are.
    pub fn num_polygons(&self) -> usize {
        self.slices.len()
    }

    /// The vertices of a polygon.
    ///
    /// # Panics
    /// If there is no such polygon.
    pub fn polygon(&self, index: usize) -> &[[f32; 3]] {
        &self.positions[self.vertices_of(index)]
    }

    /// Adds to `triangles` the polygons from `first_polygon` on, as triangles between vertices of the list: a fan
    /// each, in order and turned as the polygons are.
    pub fn push_triangles(&self, first_polygon: usize, triangles: &mut Vec<[u32; 3]>) {
        for polygon in first_polygon..self.num_polygons() {
            let vertices = self.vertices_of(polygon);
            let first = vertices.start as u32;
            triangles.extend((first + 1..vertices.end as u32 - 1).map(|v| [first, v, v + 1]));
        }
    }

    fn vertices_of(&self, polygon: usize) -> Range<usize> {
        let end = self.firsts.get(polygon + 1).map_or(self.positions.len(), |&next| next as usize);
        self.firsts[polygon] as usize..end
    }
}
