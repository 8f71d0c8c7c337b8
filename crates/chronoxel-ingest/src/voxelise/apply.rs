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

/// What the field of a tetrahedron takes while a brick is computed.
pub const FIELD_BYTES: u64 = size_of::<Field>() as u64;

impl Field {
    /// Where a corner has no value.
    const MASKED: Self =
        Self { corner: [0.0; 3], value: f64::NAN, gradient: [0.0; 3], low: f64::NAN, high: f64::NAN };

    #[inline(always)]
    fn new<T: Real>(tetrahedron: &Tetrahedron, places: &[[f64; 3]], values: &[T]) -> Self {
        let [v0, v1, v2, v3] = tetrahedron.vertices.map(|i| values[i as usize]);
        if v0.is_masked() | v1.is_masked() | v2.is_masked() | v3.is_masked() {
            return Self::MASKED;
        }
        let (v0, v1, v2, v3) = (v0.to_f64(), v1.to_f64(), v2.to_f64(), v3.to_f64());
        let (least, most) = (|a, b| if b < a { b } else { a }, |a, b| if b > a { b } else { a });
        let low: f64 = least(least(v0, v1), least(v2, v3));
        let high: f64 = most(most(v0, v1), most(v2, v3));
        let [p0, p1, p2, p3] = tetrahedron.corners(places);
        if low == high {
            return Self { corner: p0, value: v0, gradient: [0.0; 3], low, high };
        }
        let (a, b, c) = (minus(p1, p0), minus(p2, p0), minus(p3, p0));
        let (bc, ca, ab) = (cross(b, c), cross(c, a), cross(a, b));
        let twice_per_volume = 2.0 / dot(a, bc);
        // Halved before the difference, which cannot overflow then.
        let difference = |v: f64| (0.5 * v - 0.5 * v0) * twice_per_volume;
        let (da, db, dc) = (difference(v1), difference(v2), difference(v3));
        let along = |i: usize| da * bc[i] + db * ca[i] + dc * ab[i];
        Self { corner: p0, value: v0, gradient: [along(0), along(1), along(2)], low, high }
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
    field.at(field.of_row(y, z), x)
}

/// The fields of the tetrahedra of a brick, computed when they are first asked for: that is in their order.
struct Fields<'a, T> {
    tetrahedra: &'a [Tetrahedron],
    places: &'a [[f64; 3]],
    values: &'a [T],
    known: Vec<Field>,
}

impl<T: Real> Fields<'_, T> {
    #[inline(always)]
    fn get(&mut self, number: usize) -> &Field {
        while number >= self.known.len() {
            let next = Field::new(&self.tetrahedra[self.known.len()], self.places, self.values);
            self.known.push(next);
        }
        &self.known[number]
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
    let first = at.brick.map(|b| f64::from(b) * layout.edge as f64 - layout.low as f64);
    // Exact: a whole number times a power of two.
    let place = |axis: usize, index: usize| (first[axis] + index as f64) * spacing;
    let known = Vec::with_capacity(map.tetrahedra.len());
    let mut fields = Fields { tetrahedra: &map.tetrahedra, places, values, known };
    let [along_x, along_y, along_z] = [0, 1, 2].map(|a| (0..full).map(|i| place(a, i)).collect::<Vec<f64>>());
    let mut runs = map.runs.iter();
    for (number, row) in samples.chunks_exact_mut(full).enumerate() {
        let (y, z) = (along_y[number % full], along_z[number / full]);
        let mut at = 0;
        while at < full {
            let Some(run) = runs.next() else { return };
            let (owner, len) = (run >> 8, (run & 255) as usize);
            let (out, along_x) = (&mut row[at..at + len], &along_x[at..at + len]);
            match owner {
                OTHERWISE => {}
                NO_TETRAHEDRON => out.fill(T::MASKED),
                _ => {
                    let field = fields.get(owner as usize);
                    let of_row = field.of_row(y, z);
                    for (out, x) in out.iter_mut().zip(along_x) {
                        *out = T::from_f64(field.at(of_row, *x));
                    }
                }
            }
            at += len;
        }
    }
}
