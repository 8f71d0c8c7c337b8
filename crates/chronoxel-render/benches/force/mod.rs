//! Slices by brute force: every plane with all twelve edges of a box, and then the order of the vertices.

use chronoxel_core::Camera;

/// The edges of a box, as pairs of corners.
const EDGES: [[usize; 2]; 12] =
    [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];

/// What is made: the same arrays as the incremental slicer's.
#[derive(Default)]
pub struct Polygons {
    positions: Vec<[f32; 3]>,
    firsts: Vec<u32>,
    slices: Vec<i32>,
}

impl Polygons {
    pub fn clear(&mut self) {
        self.positions.clear();
        self.firsts.clear();
        self.slices.clear();
    }

    pub fn num_polygons(&self) -> usize {
        self.slices.len()
    }

    fn push(&mut self, slice: i32, vertices: &[[f64; 3]]) {
        self.firsts.push(self.positions.len() as u32);
        self.slices.push(slice);
        self.positions.extend(vertices.iter().map(|v| v.map(|c| c as f32)));
    }
}

/// The planes of a camera.
pub struct ByForce {
    forward: [f64; 3],
    position: [f64; 3],
    distance: f64,
    /// The two axes across the one that the view is most along, such that a positive turn is counter-clockwise.
    across: [usize; 2],
}

/// A box, and what does not change from plane to plane.
struct Cut {
    corners: [[f64; 3]; 8],
    depths: [f64; 8],
    per_depth: [f64; 12],
}

impl ByForce {
    pub fn new(camera: &Camera, distance: f64) -> Self {
        let [_, _, forward] = camera.axes();
        let main = (0..3).max_by(|&a, &b| forward[a].abs().total_cmp(&forward[b].abs())).expect("three");
        let (u, v) = ((main + 1) % 3, (main + 2) % 3);
        let across = if forward[main] > 0.0 { [v, u] } else { [u, v] };
        Self { forward, position: camera.position(), distance, across }
    }

    /// Sorts the vertices of each polygon as seen from the first of them, by the sign of cross products.
    pub fn sorted(&self, bounds: [[f64; 3]; 2], polygons: &mut Polygons) {
        let (cut, slices) = self.cut(bounds);
        for slice in slices {
            let mut points = [[0.0; 3]; 12];
            let mut n = 0;
            for (edge, &[i, j]) in EDGES.iter().enumerate() {
                if let Some(point) = self.crossing(&cut, slice, edge, i, j) {
                    points[n] = point;
                    n += 1;
                }
            }
            if n >= 3 {
                self.sort(&mut points[..n]);
                polygons.push(slice, &points[..n]);
            }
        }
    }

    /// Walks from face to face: each crossed edge shares a face with the next.
    pub fn walked(&self, bounds: [[f64; 3]; 2], polygons: &mut Polygons) {
        let (cut, slices) = self.cut(bounds);
        for slice in slices {
            let mut points = [[0.0; 3]; 12];
            let mut faces = [0u8; 12];
            let mut n = 0;
            for (edge, &[i, j]) in EDGES.iter().enumerate() {
                if let Some(point) = self.crossing(&cut, slice, edge, i, j) {
                    points[n] = point;
                    // The two faces in which both ends lie: low ones in the lower three bits, high ones above.
                    faces[n] = (!(i | j) & 7 | (i & j) << 3) as u8;
                    n += 1;
                }
            }
            if n >= 3 {
                for at in 1..n {
                    let next = (at..n).find(|&k| faces[k] & faces[at - 1] != 0).unwrap_or(at);
                    points.swap(at, next);
                    faces.swap(at, next);
                }
                if self.turn(points[0], points[1], points[2]) < 0.0 {
                    points[..n].reverse();
                }
                polygons.push(slice, &points[..n]);
            }
        }
    }

    fn cut(&self, bounds: [[f64; 3]; 2]) -> (Cut, std::ops::RangeInclusive<i32>) {
        let corners: [[f64; 3]; 8] = std::array::from_fn(|i| std::array::from_fn(|a| bounds[i >> a & 1][a]));
        let depths =
            corners.map(|p| (0..3).map(|a| self.forward[a] * (p[a] - self.position[a])).sum::<f64>());
        let per_depth = EDGES.map(|[i, j]| 1.0 / (depths[j] - depths[i]));
        let near = depths.iter().copied().fold(f64::INFINITY, f64::min);
        let far = depths.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let slices = (near / self.distance).ceil() as i32..=(far / self.distance).floor() as i32;
        (Cut { corners, depths, per_depth }, slices)
    }

    #[inline]
    fn crossing(&self, cut: &Cut, slice: i32, edge: usize, i: usize, j: usize) -> Option<[f64; 3]> {
        let depth = f64::from(slice) * self.distance;
        if (cut.depths[i] <= depth) == (cut.depths[j] <= depth) {
            return None;
        }
        let t = (depth - cut.depths[i]) * cut.per_depth[edge];
        let [from, to] = [cut.corners[i], cut.corners[j]];
        Some(std::array::from_fn(|a| from[a] + t * (to[a] - from[a])))
    }

    /// Twice the area of a triangle as seen along the main axis, positive where it runs counter-clockwise.
    #[inline]
    fn turn(&self, a: [f64; 3], b: [f64; 3], c: [f64; 3]) -> f64 {
        let [u, v] = self.across;
        (b[u] - a[u]) * (c[v] - a[v]) - (b[v] - a[v]) * (c[u] - a[u])
    }

    /// Insertion sort about the first vertex: the others lie within half a turn as seen from it.
    #[inline]
    fn sort(&self, points: &mut [[f64; 3]]) {
        for i in 2..points.len() {
            let mut k = i;
            while k > 1 && self.turn(points[0], points[k - 1], points[k]) < 0.0 {
                points.swap(k - 1, k);
                k -= 1;
            }
        }
    }
}
