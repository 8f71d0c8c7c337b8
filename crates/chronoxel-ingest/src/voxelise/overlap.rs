//! Whether a tetrahedron and a box overlap: the 25 axes of leven2002, section 4.2.

/// Four corners.
pub type Corners = [[f64; 3]; 4];

/// The planes of a tetrahedron's faces, and what the tests against boxes share.
#[derive(Debug, Clone, Copy)]
pub struct Shape {
    corners: Corners,
    low: [f64; 3],
    high: [f64; 3],
    /// Inward, not of unit length.
    normals: [[f64; 3]; 4],
}

/// The edges, as pairs of corners.
const EDGES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];
/// The corners of each face, and the one opposite.
pub const FACES: [[usize; 4]; 4] = [[1, 3, 2, 0], [0, 2, 3, 1], [0, 3, 1, 2], [0, 1, 2, 3]];

/// `b - a`.
#[inline(always)]
pub fn minus(b: [f64; 3], a: [f64; 3]) -> [f64; 3] {
    [b[0] - a[0], b[1] - a[1], b[2] - a[2]]
}

/// The cross product.
#[inline(always)]
pub fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// The scalar product.
#[inline(always)]
pub fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// The smallest box around corners.
#[inline(always)]
pub fn bounds(corners: &Corners) -> [[f64; 3]; 2] {
    let [a, b, c, d] = corners;
    // Corners are numbers: a comparison is enough.
    let least = |a: f64, b: f64| if b < a { b } else { a };
    let most = |a: f64, b: f64| if b > a { b } else { a };
    let low = |i: usize| least(least(a[i], b[i]), least(c[i], d[i]));
    let high = |i: usize| most(most(a[i], b[i]), most(c[i], d[i]));
    [[low(0), low(1), low(2)], [high(0), high(1), high(2)]]
}

impl Shape {
    /// Of a tetrahedron, whatever its orientation.
    pub fn new(corners: Corners) -> Self {
        let [low, high] = bounds(&corners);
        let normals = FACES.map(|[a, b, c, opposite]| {
            let n = cross(minus(corners[b], corners[a]), minus(corners[c], corners[a]));
            let inward = dot(n, minus(corners[opposite], corners[a])) >= 0.0;
            if inward { n } else { n.map(|v| -v) }
        });
        Self { corners, low, high, normals }
    }

    /// Whether it overlaps a box; touching counts.
    #[inline]
    pub fn overlaps(&self, low: [f64; 3], high: [f64; 3]) -> bool {
        if (0..3).any(|a| self.high[a] < low[a] || self.low[a] > high[a]) {
            return false;
        }
        // Wholly inside: nothing separates them.
        if (0..3).all(|a| self.low[a] >= low[a] && self.high[a] <= high[a]) {
            return true;
        }
        let middle: [f64; 3] = std::array::from_fn(|a| 0.5 * (low[a] + high[a]));
        let half: [f64; 3] = std::array::from_fn(|a| 0.5 * (high[a] - low[a]));
        let corners = self.corners.map(|c| minus(c, middle));
        for (n, face) in self.normals.iter().zip(FACES) {
            let reach = half[0] * n[0].abs() + half[1] * n[1].abs() + half[2] * n[2].abs();
            // The corner of the box farthest inwards is still outside.
            if reach < dot(*n, corners[face[0]]) {
                return false;
            }
        }
        EDGES.iter().all(|&[a, b]| !separated_by_edge(&corners, minus(corners[b], corners[a]), half))
    }
}

/// Whether one of the three axes across an edge and an edge of the box separates them; the box is around the origin.
#[inline(always)]
fn separated_by_edge(corners: &Corners, edge: [f64; 3], half: [f64; 3]) -> bool {
    (0..3).any(|axis| {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        // The cross product of the unit vector along `axis` and the edge.
        let (nu, nv) = (-edge[v], edge[u]);
        let reach = half[u] * nu.abs() + half[v] * nv.abs();
        let along = corners.map(|c| nu * c[u] + nv * c[v]);
        let least = along[0].min(along[1]).min(along[2].min(along[3]));
        let most = along[0].max(along[1]).max(along[2].max(along[3]));
        least > reach || most < -reach
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn overlaps(corners: Corners, low: [f64; 3], high: [f64; 3]) -> bool {
        Shape::new(corners).overlaps(low, high)
    }

    const UNIT: Corners = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

    #[test]
    fn boxes_inside_around_and_touching_overlap() {
        assert!(overlaps(UNIT, [0.1; 3], [0.2; 3]));
        assert!(overlaps(UNIT, [-1.0; 3], [2.0; 3]));
        assert!(overlaps(UNIT, [-1.0; 3], [0.0; 3]), "they share a corner");
        assert!(overlaps(UNIT, [-1.0, 0.2, 0.2], [0.0, 0.3, 0.3]), "they share a face");
    }

    #[test]
    fn each_kind_of_axis_separates() {
        assert!(!overlaps(UNIT, [1.1, 0.0, 0.0], [2.0, 1.0, 1.0]), "a face of the box");
        // The boxes of both overlap, and the slanted face lies between.
        assert!(!overlaps(UNIT, [0.4; 3], [1.0; 3]), "a face of the tetrahedron");
        // An edge along (1, 1, 0) passes the edge of the box along z that ends at (0.6, 0.4).
        let blade = [[0.0, 0.0, -1.0], [1.0, 1.0, 1.0], [0.9, 1.1, 0.2], [0.1, 0.9, 0.1]];
        assert!(overlaps(blade, [0.5, 0.0, -1.0], [1.0, 0.51, 1.0]));
        let edges = [[-1.0, 0.1, 0.0], [0.1, -1.0, 0.05], [-1.0, -1.0, 3.0], [-1.0, -1.0, -3.0]];
        assert!(!overlaps(edges, [0.0, 0.0, -9.0], [1.0, 1.0, 9.0]), "an edge of each");
    }

    /// By force: whether a point of a fine lattice in the box lies in the tetrahedron.
    fn overlaps_by_points(corners: Corners, low: [f64; 3], high: [f64; 3]) -> bool {
        const N: usize = 24;
        let at = |i: usize, a: usize| low[a] + (high[a] - low[a]) * i as f64 / (N - 1) as f64;
        let volume = |c: &Corners| dot(minus(c[1], c[0]), cross(minus(c[2], c[0]), minus(c[3], c[0])));
        let whole = volume(&corners);
        (0..N * N * N).any(|i| {
            let p = [at(i % N, 0), at(i / N % N, 1), at(i / N / N, 2)];
            (0..4).all(|k| {
                let mut part = corners;
                part[k] = p;
                volume(&part) / whole >= 0.0
            })
        })
    }

    #[test]
    fn never_separates_what_shares_a_point() {
        let mut state = 1u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 40) as f64 / f64::from(1 << 24)
        };
        let (mut num_apart, mut num_missed) = (0, 0);
        for _ in 0..2000 {
            let corners: Corners = std::array::from_fn(|_| std::array::from_fn(|_| random()));
            let low: [f64; 3] = std::array::from_fn(|_| random());
            let high = low.map(|v| v + 0.3);
            let (by_axes, by_points) = (overlaps(corners, low, high), overlaps_by_points(corners, low, high));
            assert!(by_axes || !by_points, "{corners:?} {low:?}");
            num_apart += usize::from(!by_axes);
            num_missed += usize::from(by_axes && !by_points);
        }
        // A lattice misses what overlaps by less than its spacing, and that alone.
        assert!(num_apart > 500 && num_missed < 200, "{num_apart} {num_missed}");
    }
}
