//! Which tetrahedron each sample of a brick lies in: scan conversion, row by row.
//!
//! A tetrahedron is convex, so that its samples of a row are an interval, found from its four planes without a test per sample.
//! Planes are evaluated at the samples' places in the lattice, by the same operations in every brick: bricks agree on the samples
//! they share. A sample within the tolerance of several tetrahedra belongs to the first in the order of the mesh.

use chronoxel_core::BrickLayout;

use super::lattice::TOLERANCE;
use super::map::{BrickMap, NO_TETRAHEDRON, OTHERWISE};
use super::overlap::{Corners, FACES, bounds, cross, dot, minus};
use super::records::Tetrahedron;

/// Which samples of a brick are looked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wanted {
    /// Core and apron.
    All,
    /// The apron, and of the core what lies on its low faces, which neighbours share: the rest of the core comes from elsewhere.
    Borders,
}

/// The samples of one brick, while tetrahedra come one after the other.
pub struct Raster {
    full: usize,
    low: usize,
    edge: usize,
    which: Wanted,
    /// Of the first sample, apron included, in samples of the depth.
    first: [i64; 3],
    /// Samples of the depth for each of the root, and its inverse; both are powers of two.
    per_root: f64,
    spacing: f64,
    /// The tetrahedron of each sample, counted from 1; 0 where there is none yet.
    of_sample: Vec<u32>,
    tetrahedra: Vec<Tetrahedron>,
}

/// A plane as the samples are tested against it: `n · p + d` is the distance inwards.
#[derive(Clone, Copy)]
struct Plane {
    n: [f64; 3],
    d: f64,
}

/// Samples of a row below which each is tested by itself.
const SHORT: usize = 4;

/// The next whole number; without a call where the processor may lack an instruction for it.
#[inline(always)]
fn ceil(v: f64) -> i64 {
    let cut = v as i64;
    cut.saturating_add(i64::from((cut as f64) < v))
}

/// The whole number before.
#[inline(always)]
fn floor(v: f64) -> i64 {
    let cut = v as i64;
    cut.saturating_sub(i64::from((cut as f64) > v))
}

impl Raster {
    /// Of brick `[x, y, z]` of a depth, without a tetrahedron yet.
    pub fn new(depth: u8, brick: [u32; 3], layout: &BrickLayout, which: Wanted) -> Self {
        Self {
            full: layout.full_edge(),
            low: layout.low,
            edge: layout.edge,
            which,
            first: brick.map(|b| i64::from(b) * layout.edge as i64 - layout.low as i64),
            per_root: f64::from(1u32 << depth),
            spacing: 1.0 / f64::from(1u32 << depth),
            of_sample: vec![0; layout.num_full()],
            tetrahedra: Vec::new(),
        }
    }

    /// Takes the next tetrahedra.
    ///
    /// * `places`: of all points, in samples of the root
    pub fn push(&mut self, tetrahedra: &[Tetrahedron], places: &[[f64; 3]]) {
        for tetrahedron in tetrahedra {
            let corners = tetrahedron.corners(places);
            let [low, high] = bounds(&corners);
            let mut from = [0usize; 3];
            let mut to = [0usize; 3];
            for a in 0..3 {
                let last = self.full as i64 - 1;
                let (f, t) = ((low[a] - TOLERANCE) * self.per_root, (high[a] + TOLERANCE) * self.per_root);
                let (f, t) = (ceil(f) - self.first[a], floor(t) - self.first[a]);
                if f > t || f > last || t < 0 {
                    (from[a], to[a]) = (1, 0);
                } else {
                    (from[a], to[a]) = (f.max(0) as usize, t.min(last) as usize);
                }
            }
            if (0..3).all(|a| from[a] <= to[a])
                && self.has_free(from, to)
                && let Some(planes) = planes_of(&corners)
                && self.fill(&planes, from, to, self.tetrahedra.len() as u32 + 1)
            {
                self.tetrahedra.push(*tetrahedron);
            }
        }
    }

    /// Along an axis, samples of the core that no neighbour shares.
    fn inner(&self) -> std::ops::Range<usize> {
        self.low + 1..self.low + self.edge
    }

    fn place(&self, axis: usize, index: usize) -> f64 {
        (self.first[axis] + index as i64) as f64 * self.spacing
    }

    /// Whether a sample of a box has no tetrahedron yet. Where cells are hardly larger than voxels, most boxes have none by the time.
    #[inline(always)]
    fn has_free(&self, from: [usize; 3], to: [usize; 3]) -> bool {
        (from[2]..=to[2]).any(|z| {
            (from[1]..=to[1]).any(|y| {
                let row = self.full * (y + self.full * z);
                self.of_sample[row + from[0]..=row + to[0]].contains(&0)
            })
        })
    }

    /// Gives the free samples inside the planes to a tetrahedron; whether there was one.
    fn fill(&mut self, planes: &[Plane; 4], from: [usize; 3], to: [usize; 3], number: u32) -> bool {
        if to[0] - from[0] < SHORT {
            return self.fill_short(planes, from, to, number);
        }
        let inverse = planes.map(|p| 1.0 / p.n[0]);
        let mut is_filled = false;
        for z in from[2]..=to[2] {
            let at_z = self.place(2, z);
            let by_z = planes.map(|p| p.n[2] * at_z + p.d);
            for y in from[1]..=to[1] {
                let at_y = self.place(1, y);
                let rest: [f64; 4] = std::array::from_fn(|k| planes[k].n[1] * at_y + by_z[k]);
                let Some([first, last]) = self.interval(planes, &inverse, &rest, [from[0], to[0]]) else {
                    continue;
                };
                let row = self.full * (y + self.full * z);
                let inner = self.inner();
                let crosses_inner = self.which == Wanted::Borders && inner.contains(&y) && inner.contains(&z);
                for x in first..=last {
                    let of_sample = &mut self.of_sample[row + x];
                    if *of_sample == 0 && !(crosses_inner && inner.contains(&x)) {
                        *of_sample = number;
                        is_filled = true;
                    }
                }
            }
        }
        is_filled
    }

    /// The same where rows are short: with a test per free sample.
    #[inline(always)]
    fn fill_short(&mut self, planes: &[Plane; 4], from: [usize; 3], to: [usize; 3], number: u32) -> bool {
        let mut is_filled = false;
        let inner = self.inner();
        for z in from[2]..=to[2] {
            let at_z = self.place(2, z);
            let by_z = planes.map(|p| p.n[2] * at_z + p.d);
            for y in from[1]..=to[1] {
                let at_y = self.place(1, y);
                let rest: [f64; 4] = std::array::from_fn(|k| planes[k].n[1] * at_y + by_z[k]);
                let row = self.full * (y + self.full * z);
                let crosses_inner = self.which == Wanted::Borders && inner.contains(&y) && inner.contains(&z);
                for x in from[0]..=to[0] {
                    if self.of_sample[row + x] != 0 || crosses_inner && inner.contains(&x) {
                        continue;
                    }
                    let at_x = self.place(0, x);
                    let is_inside = |k: usize| planes[k].n[0] * at_x + rest[k] >= -TOLERANCE;
                    if is_inside(0) & is_inside(1) & is_inside(2) & is_inside(3) {
                        self.of_sample[row + x] = number;
                        is_filled = true;
                    }
                }
            }
        }
        is_filled
    }

    /// The first and last sample of a row inside all planes.
    #[inline(always)]
    fn interval(
        &self,
        planes: &[Plane; 4],
        inverse: &[f64; 4],
        rest: &[f64; 4],
        [from, to]: [usize; 2],
    ) -> Option<[usize; 2]> {
        let (mut low, mut high) = (f64::NEG_INFINITY, f64::INFINITY);
        for k in 0..4 {
            let zero = (-TOLERANCE - rest[k]) * inverse[k];
            if planes[k].n[0] > 0.0 {
                low = low.max(zero);
            } else if planes[k].n[0] < 0.0 {
                high = high.min(zero);
            } else if rest[k] < -TOLERANCE {
                return None;
            }
        }
        // A little wider than it is, so that what is left only needs to shrink.
        let first_place = self.first[0] as f64;
        let first = ceil(low * self.per_root - first_place - 1e-3).max(from as i64);
        let last = floor(high * self.per_root - first_place + 1e-3).min(to as i64);
        if first > last {
            return None;
        }
        let (mut first, mut last) = (first as usize, last as usize);
        let is_inside = |x: usize| {
            let at_x = self.place(0, x);
            (0..4).all(|k| planes[k].n[0] * at_x + rest[k] >= -TOLERANCE)
        };
        while !is_inside(first) {
            first += 1;
            if first > last {
                return None;
            }
        }
        while !is_inside(last) {
            last -= 1;
        }
        Some([first, last])
    }

    /// What was found.
    pub fn finish(self) -> BrickMap {
        let inner = self.inner();
        let mut runs: Vec<u32> = Vec::new();
        let mut tetrahedra = Vec::with_capacity(self.tetrahedra.len());
        // Numbers as the runs come to them, counted from 1: so what is computed of them lies in the order in which it is used.
        let mut renumbered = vec![0u32; self.tetrahedra.len()];
        for (r, row) in self.of_sample.chunks(self.full).enumerate() {
            let crosses_inner = self.which == Wanted::Borders
                && inner.contains(&(r % self.full))
                && inner.contains(&(r / self.full));
            let mut start = 0;
            while start < self.full {
                let number = row[start];
                let mut end = match crosses_inner && start < inner.start {
                    true => inner.start,
                    false => self.full,
                };
                let owner = match number {
                    _ if crosses_inner && inner.contains(&start) => {
                        end = inner.end;
                        OTHERWISE
                    }
                    0 => NO_TETRAHEDRON,
                    number => {
                        let old = number as usize - 1;
                        if renumbered[old] == 0 {
                            tetrahedra.push(self.tetrahedra[old]);
                            renumbered[old] = tetrahedra.len() as u32;
                        }
                        renumbered[old] - 1
                    }
                };
                let len = row[start..end].iter().take_while(|other| **other == number).count();
                runs.push(owner << 8 | len as u32);
                start += len;
            }
        }
        BrickMap { tetrahedra, runs }
    }
}

/// The four planes, inwards and of unit length; `None` for a tetrahedron without a volume.
#[inline(always)]
fn planes_of(corners: &Corners) -> Option<[Plane; 4]> {
    let mut planes = [Plane { n: [0.0; 3], d: 0.0 }; 4];
    for (plane, [a, b, c, opposite]) in planes.iter_mut().zip(FACES) {
        let n = cross(minus(corners[b], corners[a]), minus(corners[c], corners[a]));
        let inward = dot(n, minus(corners[opposite], corners[a]));
        let length = dot(n, n).sqrt();
        if !(length > 0.0 && inward != 0.0) {
            return None;
        }
        let scale = if inward > 0.0 { 1.0 / length } else { -1.0 / length };
        plane.n = n.map(|v| v * scale);
        plane.d = -dot(plane.n, corners[a]);
    }
    Some(planes)
}

/// Whether a place lies in a tetrahedron, as samples of bricks do.
pub fn is_inside(corners: &Corners, place: [f64; 3]) -> bool {
    planes_of(corners).is_some_and(|planes| {
        let distance = |p: &Plane| p.n[0] * place[0] + (p.n[1] * place[1] + (p.n[2] * place[2] + p.d));
        planes.iter().all(|plane| distance(plane) >= -TOLERANCE)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The tetrahedron of every sample, by the sign of four volumes.
    fn by_force(
        brick: [u32; 3],
        depth: u8,
        layout: &BrickLayout,
        mesh: &[Tetrahedron],
        places: &[[f64; 3]],
    ) -> Vec<Option<usize>> {
        let full = layout.full_edge();
        (0..layout.num_full())
            .map(|i| {
                let index = [i % full, i / full % full, i / full / full];
                let p: [f64; 3] = std::array::from_fn(|a| {
                    (brick[a] as f64 * layout.edge as f64 + index[a] as f64 - layout.low as f64)
                        / f64::from(1u32 << depth)
                });
                mesh.iter().position(|t| {
                    planes_of(&t.corners(places)).is_some_and(|planes| {
                        planes.iter().all(|plane| dot(plane.n, p) + plane.d >= -TOLERANCE)
                    })
                })
            })
            .collect()
    }

    fn owners(map: &BrickMap, full: usize) -> Vec<u32> {
        let all: Vec<u32> =
            map.runs.iter().flat_map(|run| std::iter::repeat_n(run >> 8, (run & 255) as usize)).collect();
        assert_eq!(all.len(), full.pow(3));
        all
    }

    #[test]
    fn rows_agree_with_a_test_per_sample() {
        let layout = BrickLayout::new(8).unwrap();
        let mut state = 7u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f64 / f64::from(1 << 24)
        };
        // Some corners on samples, so that faces and edges pass through samples.
        let places: Vec<[f64; 3]> = (0..60)
            .map(|i| {
                std::array::from_fn(|_| {
                    let v = 7.0 * random();
                    if i % 2 == 0 { v.round() } else { v }
                })
            })
            .collect();
        let mesh: Vec<Tetrahedron> = (0..80)
            .map(|_| Tetrahedron { vertices: std::array::from_fn(|_| (random() * 60.0) as u32) })
            .collect();
        for (depth, brick) in [(0, [0, 0, 0]), (1, [1, 0, 1]), (2, [1, 2, 0])] {
            let mut raster = Raster::new(depth, brick, &layout, Wanted::All);
            mesh.chunks(7).for_each(|part| raster.push(part, &places));
            let map = raster.finish();
            let expected = by_force(brick, depth, &layout, &mesh, &places);
            for (i, owner) in owners(&map, layout.full_edge()).into_iter().enumerate() {
                let found = (owner != NO_TETRAHEDRON).then(|| map.tetrahedra[owner as usize]);
                assert_eq!(found, expected[i].map(|k| mesh[k]), "depth {depth}, sample {i}");
            }
            let mut borders = Raster::new(depth, brick, &layout, Wanted::Borders);
            borders.push(&mesh, &places);
            let borders = borders.finish();
            let full = layout.full_edge();
            for (i, owner) in owners(&borders, full).into_iter().enumerate() {
                let is_inner =
                    [i % full, i / full % full, i / full / full].iter().all(|p| (2..9).contains(p));
                assert_eq!(owner == OTHERWISE, is_inner);
                if !is_inner {
                    let found = (owner != NO_TETRAHEDRON).then(|| borders.tetrahedra[owner as usize]);
                    assert_eq!(found, expected[i].map(|k| mesh[k]));
                }
            }
        }
    }
}
