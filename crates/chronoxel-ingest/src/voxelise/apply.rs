//! A step's samples from its values at the points: the linear field of each tetrahedron along the runs of the map.

use chronoxel_core::BrickLayout;

use super::map::{BrickMap, NO_TETRAHEDRON, OTHERWISE};
use super::overlap::{cross, dot, minus};
use super::records::Tetrahedron;
use crate::encode::real::Real;

/// Where a brick lies in the lattice.
#[derive(Debug, Clone, Copy)]
pub struct BrickPlace {
    /// Depth of its level.
    pub depth: u8,
    /// Its place, in bricks.
    pub brick: [u32; 3],
}

/// A linear field over the samples of a brick, by their indices in the full brick, within the range of its four values.
#[derive(Debug, Clone, Copy)]
struct Field {
    at_first: f64,
    gradient: [f64; 3],
    low: f64,
    high: f64,
}

impl Field {
    /// Of a tetrahedron whose corners have values; `None` where one has none.
    fn new<T: Real>(
        tetrahedron: &Tetrahedron,
        places: &[[f64; 3]],
        values: &[T],
        first: [f64; 3],
        spacing: f64,
    ) -> Option<Self> {
        let v = tetrahedron.vertices.map(|i| values[i as usize]);
        if v.iter().any(|v| v.is_masked()) {
            return None;
        }
        let v = v.map(T::to_f64);
        let low = v[0].min(v[1]).min(v[2].min(v[3]));
        let high = v[0].max(v[1]).max(v[2].max(v[3]));
        if low == high {
            return Some(Self { at_first: low, gradient: [0.0; 3], low, high });
        }
        let p = tetrahedron.corners(places);
        let [a, b, c] = [1, 2, 3].map(|k| minus(p[k], p[0]));
        let (bc, ca, ab) = (cross(b, c), cross(c, a), cross(a, b));
        let per_volume = 1.0 / dot(a, bc);
        // Halved before the difference, which cannot overflow then.
        let [da, db, dc] = [1, 2, 3].map(|k| (0.5 * v[k] - 0.5 * v[0]) * per_volume);
        let gradient: [f64; 3] = std::array::from_fn(|i| 2.0 * (da * bc[i] + db * ca[i] + dc * ab[i]));
        let at_first = v[0] + dot(gradient, minus(first, p[0]));
        Some(Self { at_first, gradient: gradient.map(|g| g * spacing), low, high })
    }
}

/// Computes the samples of a brick: those of no tetrahedron are masked, those that come from elsewhere are left as they are.
///
/// * `values`: at all points; masked ones are NaN
/// * `samples`: of the full brick, `[z, y, x]`
pub fn apply<T: Real>(
    map: &BrickMap,
    at: BrickPlace,
    layout: &BrickLayout,
    places: &[[f64; 3]],
    values: &[T],
    samples: &mut [T],
) {
    let full = layout.full_edge();
    let spacing = 1.0 / f64::from(1u32 << at.depth);
    let first = at.brick.map(|b| (f64::from(b) * layout.edge as f64 - layout.low as f64) * spacing);
    let field = |tetrahedron| Field::new(tetrahedron, places, values, first, spacing);
    let fields: Vec<Option<Field>> = map.tetrahedra.iter().map(field).collect();
    let (mut at, mut row) = (0, [0.0; 2]);
    for run in &map.runs {
        let (owner, len) = (run >> 8, (run & 255) as usize);
        let x = at % full;
        if x == 0 {
            row = [(at / full % full) as f64, (at / (full * full)) as f64];
        }
        let out = &mut samples[at..at + len];
        match owner {
            OTHERWISE => {}
            NO_TETRAHEDRON => out.fill(T::MASKED),
            _ => match &fields[owner as usize] {
                None => out.fill(T::MASKED),
                Some(Field { at_first, gradient, low, high }) => {
                    let from = at_first + (gradient[1] * row[0] + gradient[2] * row[1]);
                    for (i, out) in out.iter_mut().enumerate() {
                        let value = from + gradient[0] * (x + i) as f64;
                        let value = if value < *low { *low } else { value };
                        *out = T::from_f64(if value > *high { *high } else { value });
                    }
                }
            },
        }
        at += len;
    }
}
