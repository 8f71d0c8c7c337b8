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

/// The linear field of a tetrahedron, within the range of its four values.
///
/// It is told by the place of a corner, in samples of the root: so a sample has the same value in every brick that has it.
#[derive(Debug, Clone, Copy)]
struct Field {
    corner: [f64; 3],
    value: f64,
    gradient: [f64; 3],
    low: f64,
    high: f64,
}

impl Field {
    /// Of a tetrahedron whose corners have values; `None` where one has none.
    fn new<T: Real>(tetrahedron: &Tetrahedron, places: &[[f64; 3]], values: &[T]) -> Option<Self> {
        let v = tetrahedron.vertices.map(|i| values[i as usize]);
        if v.iter().any(|v| v.is_masked()) {
            return None;
        }
        let v = v.map(T::to_f64);
        let low = v[0].min(v[1]).min(v[2].min(v[3]));
        let high = v[0].max(v[1]).max(v[2].max(v[3]));
        let p = tetrahedron.corners(places);
        if low == high {
            return Some(Self { corner: p[0], value: v[0], gradient: [0.0; 3], low, high });
        }
        let [a, b, c] = [1, 2, 3].map(|k| minus(p[k], p[0]));
        let (bc, ca, ab) = (cross(b, c), cross(c, a), cross(a, b));
        let per_volume = 1.0 / dot(a, bc);
        // Halved before the difference, which cannot overflow then.
        let [da, db, dc] = [1, 2, 3].map(|k| (0.5 * v[k] - 0.5 * v[0]) * per_volume);
        let gradient = std::array::from_fn(|i| 2.0 * (da * bc[i] + db * ca[i] + dc * ab[i]));
        Some(Self { corner: p[0], value: v[0], gradient, low, high })
    }

    /// What a row contributes.
    #[inline(always)]
    fn of_row(&self, y: f64, z: f64) -> f64 {
        self.gradient[1] * (y - self.corner[1]) + self.gradient[2] * (z - self.corner[2])
    }

    /// The value at `x` in a row.
    #[inline(always)]
    fn at(&self, of_row: f64, x: f64) -> f64 {
        let value = self.value + (self.gradient[0] * (x - self.corner[0]) + of_row);
        let value = if value < self.low { self.low } else { value };
        if value > self.high { self.high } else { value }
    }
}

/// The field of a tetrahedron at one place; NaN where a corner has no value.
pub fn value_at<T: Real>(
    tetrahedron: &Tetrahedron,
    places: &[[f64; 3]],
    values: &[T],
    [x, y, z]: [f64; 3],
) -> f64 {
    let field = Field::new(tetrahedron, places, values);
    field.map_or(f64::NAN, |field| field.at(field.of_row(y, z), x))
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
    let first = at.brick.map(|b| f64::from(b) * layout.edge as f64 - layout.low as f64);
    // Exact: a whole number times a power of two.
    let place = |axis: usize, index: usize| (first[axis] + index as f64) * spacing;
    let fields: Vec<Option<Field>> =
        map.tetrahedra.iter().map(|tetrahedron| Field::new(tetrahedron, places, values)).collect();
    let (mut at, mut row) = (0, [0.0; 2]);
    for run in &map.runs {
        let (owner, len) = (run >> 8, (run & 255) as usize);
        let x = at % full;
        if x == 0 {
            row = [place(1, at / full % full), place(2, at / (full * full))];
        }
        let out = &mut samples[at..at + len];
        match owner {
            OTHERWISE => {}
            NO_TETRAHEDRON => out.fill(T::MASKED),
            _ => match &fields[owner as usize] {
                None => out.fill(T::MASKED),
                Some(field) => {
                    let of_row = field.of_row(row[0], row[1]);
                    for (i, out) in out.iter_mut().enumerate() {
                        *out = T::from_f64(field.at(of_row, place(0, x + i)));
                    }
                }
            },
        }
        at += len;
    }
}
