//! Random boxes and views, and their slices by brute force: each plane with each of the twelve edges, sorted by angle.

use chronoxel_render::{SliceList, SliceOrder, Slicer};

/// Random numbers (SplitMix64).
pub struct Random(pub u64);

impl Random {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    pub fn below(&mut self, n: u64) -> u64 {
        self.next() % n
    }

    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// A box and the planes `normal · (p − origin) = k · distance`.
#[derive(Debug, Clone, Copy)]
pub struct Case {
    pub normal: [f64; 3],
    pub origin: [f64; 3],
    pub distance: f64,
    pub bounds: [[f64; 3]; 2],
}

impl Case {
    /// The unit box, planes a unit apart along z.
    pub fn unit() -> Self {
        Self { normal: [0.0, 0.0, 1.0], origin: [0.0; 3], distance: 1.0, bounds: [[0.0; 3], [1.0; 3]] }
    }

    /// Tiny to huge boxes, any view, any number of slices up to about 30.
    pub fn any(random: &mut Random) -> Self {
        let size = 10f64.powf(random.between(-6.0, 6.0));
        let shape = [(); 3].map(|()| size * 10f64.powf(random.between(-1.5, 0.0)));
        let place = size * [0.0, 1.0, 30.0][random.below(3) as usize];
        let low = [(); 3].map(|()| random.between(-1.0, 1.0) * place);
        let bounds = [low, std::array::from_fn(|a| low[a] + shape[a])];
        let origin = [(); 3].map(|()| random.between(-1.0, 1.0) * place);
        let normal = any_normal(random);
        let extent: f64 = (0..3).map(|a| normal[a].abs() * shape[a]).sum();
        Self { normal, origin, distance: extent / random.between(0.3, 30.0), bounds }
    }

    /// Numbers that are exact, so that corners lie in planes.
    pub fn with_ties(random: &mut Random) -> Self {
        let whole = |random: &mut Random, from: i64, n: u64| (from + random.below(n) as i64) as f64;
        let mut normal = [(); 3].map(|()| whole(random, -2, 5));
        if normal == [0.0; 3] {
            normal = [0.0, -1.0, 0.0];
        }
        let low = [(); 3].map(|()| whole(random, -8, 16));
        // Even lengths, which can be halved.
        let high = low.map(|c| c + 2.0 * whole(random, 1, 4));
        let origin = [(); 3].map(|()| whole(random, -8, 16));
        let distance = [0.25, 0.5, 1.0, 1.0, 2.0, 3.0][random.below(6) as usize];
        Self { normal, origin, distance, bounds: [low, high] }
    }

    /// How many corners lie in a plane.
    pub fn num_ties(&self) -> usize {
        (0..8).filter(|&i| (self.depth(corner(self.bounds, i)) / self.distance).fract() == 0.0).count()
    }

    fn depth(&self, p: [f64; 3]) -> f64 {
        (0..3).map(|a| self.normal[a] * (p[a] - self.origin[a])).sum()
    }
}

/// Along axes, along diagonals, nearly along an axis, or anywhere.
fn any_normal(random: &mut Random) -> [f64; 3] {
    let sign = |random: &mut Random| [-1.0, 1.0][random.below(2) as usize];
    let axis = random.below(3) as usize;
    match random.below(6) {
        0 => std::array::from_fn(|a| if a == axis { sign(random) } else { 0.0 }),
        1 => [(); 3].map(|()| sign(random)),
        2 => std::array::from_fn(|a| if a == axis { 0.0 } else { sign(random) }),
        3 => std::array::from_fn(|a| {
            if a == axis { sign(random) } else { sign(random) * 10f64.powf(random.between(-7.0, -2.0)) }
        }),
        _ => loop {
            let v = [(); 3].map(|()| random.between(-1.0, 1.0));
            let length = v.iter().map(|c| c * c).sum::<f64>().sqrt();
            if (0.1..1.0).contains(&length) {
                break v.map(|c| c / length);
            }
        },
    }
}

fn corner(bounds: [[f64; 3]; 2], i: usize) -> [f64; 3] {
    std::array::from_fn(|a| bounds[i >> a & 1][a])
}

pub fn slice(case: &Case, boxes: &[[[f64; 3]; 2]], order: SliceOrder) -> SliceList {
    let slicer = Slicer::new(case.normal, case.origin, case.distance, order).unwrap();
    let mut list = SliceList::default();
    for bounds in boxes {
        slicer.slice(*bounds, &mut list).unwrap();
    }
    list
}

/// Length of the longest edge.
pub fn scale_of(bounds: [[f64; 3]; 2]) -> f64 {
    (0..3).map(|a| bounds[1][a] - bounds[0][a]).fold(0.0, f64::max)
}

/// How far a vertex may be off: single-precision rounding of a coordinate, and how far along an edge rounding of a
/// depth in double precision moves it.
pub fn tolerance(case: &Case) -> f64 {
    let bounds = case.bounds.as_flattened();
    let largest = bounds.iter().chain(&case.origin).fold(0.0f64, |m, c| m.max(c.abs()));
    let along = |n: f64| if n == 0.0 { 0.0 } else { 1e-15 * 8.0 * largest / n.abs() };
    let single = bounds.iter().fold(0.0f64, |m, c| m.max(c.abs())) * 0.5f64.powi(23);
    let norm = case.normal.iter().map(|n| n.abs()).fold(0.0, f64::max);
    single + case.normal.map(|n| norm * along(n)).into_iter().fold(0.0, f64::max)
}

/// The polygon of each slice that has one, nearest first. A plane passes an edge's end that lies in it.
pub fn force(case: &Case) -> Vec<(i32, Vec<[f64; 3]>)> {
    let corners: [[f64; 3]; 8] = std::array::from_fn(|i| corner(case.bounds, i));
    let depths = corners.map(|p| case.depth(p));
    let [near, far] = [
        depths.iter().copied().fold(f64::INFINITY, f64::min),
        depths.iter().copied().fold(f64::NEG_INFINITY, f64::max),
    ];
    let [first, last] = [near, far].map(|z| (z / case.distance).floor() as i32);
    let mut polygons = Vec::new();
    for k in first - 1..=last + 1 {
        let depth = f64::from(k) * case.distance;
        let mut points = Vec::new();
        for (i, j) in (0..8).flat_map(|i| [1, 2, 4].map(|bit| (i, i | bit))).filter(|(i, j)| i != j) {
            if (depths[i] <= depth) != (depths[j] <= depth) {
                let t = (depth - depths[i]) / (depths[j] - depths[i]);
                points.push(std::array::from_fn(|a| corners[i][a] + t * (corners[j][a] - corners[i][a])));
            }
        }
        if !points.is_empty() {
            polygons.push((k, by_angle(points, case.normal)));
        }
    }
    polygons
}

/// Points about their middle, counter-clockwise as seen against the normal.
fn by_angle(mut points: Vec<[f64; 3]>, normal: [f64; 3]) -> Vec<[f64; 3]> {
    let n = points.len() as f64;
    let middle: [f64; 3] = std::array::from_fn(|a| points.iter().map(|p| p[a]).sum::<f64>() / n);
    let least = (0..3).min_by(|&a, &b| normal[a].abs().total_cmp(&normal[b].abs())).unwrap();
    let across = cross(normal, std::array::from_fn(|a| if a == least { 1.0 } else { 0.0 }));
    // Unit vectors of the plane of which the second is a quarter of a turn ahead, as the eye sees it.
    let u = unit(across);
    let v = unit(cross(u, normal));
    let angle = |p: &[f64; 3]| {
        let arm: [f64; 3] = std::array::from_fn(|a| p[a] - middle[a]);
        dot(arm, v).atan2(dot(arm, u))
    };
    points.sort_by(|a, b| angle(a).total_cmp(&angle(b)));
    points
}

/// Area of a polygon, positive where it runs counter-clockwise as seen by an eye that looks along the normal.
pub fn area_of(polygon: &[[f64; 3]], normal: [f64; 3]) -> f64 {
    let to_eye = unit(normal.map(|c| -c));
    let from_first = |p: [f64; 3]| std::array::from_fn(|a| p[a] - polygon[0][a]);
    let twice: f64 =
        polygon.windows(2).map(|pair| dot(cross(from_first(pair[0]), from_first(pair[1])), to_eye)).sum();
    0.5 * twice
}

/// The edges of polygons that are not met by an edge the other way, to the bit, and do not lie in a face of `bounds`.
pub fn edges_between(polygons: &[&[[f32; 3]]], bounds: [[f64; 3]; 2]) -> Vec<[[f32; 3]; 2]> {
    let edges: Vec<[[f32; 3]; 2]> = polygons
        .iter()
        .flat_map(|p| (0..p.len()).map(move |i| [p[i], p[(i + 1) % p.len()]]))
        .filter(|[a, b]| a != b)
        .collect();
    let lies_in_face = |[p, q]: &[[f32; 3]; 2]| {
        (0..3).any(|a| p[a] == q[a] && bounds.iter().any(|face| face[a] as f32 == p[a]))
    };
    let open = edges.iter().filter(|e| !lies_in_face(e) && !edges.contains(&[e[1], e[0]]));
    open.copied().collect()
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn unit(a: [f64; 3]) -> [f64; 3] {
    let length = dot(a, a).sqrt();
    a.map(|c| c / length)
}
