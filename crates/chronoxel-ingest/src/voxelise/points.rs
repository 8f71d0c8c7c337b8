//! The field of a mesh at any points: by the tetrahedra that the bricks are sampled from, and with the same planes.

use chronoxel_core::Samples;

use super::apply::value_at;
use super::lattice::{Lattice, TOLERANCE};
use super::overlap::bounds;
use super::raster::is_inside;
use super::records::Tetrahedron;
use crate::encode::mark::mark;
use crate::encode::real::Real;
use crate::{EncodeError, MeshSeries};

/// Values of a step at points of the world; NaN outside of the mesh, and where the source has none.
///
/// # Errors
/// Of the source, and for a mesh without a size.
///
/// # Panics
/// If `variable` or `step` is out of range.
pub fn sample_points(
    mesh: &mut dyn MeshSeries,
    variable: usize,
    step: usize,
    points: &[[f64; 3]],
) -> Result<Vec<f64>, EncodeError> {
    let fill_value = mesh.variables()[variable].fill_value;
    match mesh.read_values(variable, step)? {
        Samples::F32(values) => of_values(mesh, values, fill_value, points),
        Samples::F64(values) => of_values(mesh, values, fill_value, points),
    }
}

fn of_values<T: Real>(
    mesh: &mut dyn MeshSeries,
    mut values: Vec<T>,
    fill_value: Option<f64>,
    points: &[[f64; 3]],
) -> Result<Vec<f64>, EncodeError> {
    mark(&mut values, fill_value);
    let corners = mesh.points()?;
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    mesh.for_each_tetrahedron(&mut |vertices| {
        for point in vertices.map(|v| corners[v as usize]) {
            (0..3).for_each(|a| (low[a], high[a]) = (low[a].min(point[a]), high[a].max(point[a])));
        }
        Ok(())
    })?;
    let lattice = Lattice::new([low, high], 32)?;
    let places: Vec<[f64; 3]> = corners.into_iter().map(|p| lattice.place(p)).collect();
    let inside = |p: &[f64; 3]| (0..3).all(|a| (low[a]..=high[a]).contains(&p[a]));
    let wanted: Vec<Option<[f64; 3]>> = points.iter().map(|p| inside(p).then(|| lattice.place(*p))).collect();
    let buckets = Buckets::new(&wanted, &lattice);
    let mut found = vec![f64::NAN; points.len()];
    let mut is_found = vec![false; points.len()];
    mesh.for_each_tetrahedron(&mut |vertices| {
        let tetrahedron = Tetrahedron { vertices };
        let corners = tetrahedron.corners(&places);
        buckets.each_near(bounds(&corners), &mut |point| {
            let place = wanted[point].expect("only what is inside is in a bucket");
            if !is_found[point] && is_inside(&corners, place) {
                is_found[point] = true;
                found[point] = value_at(&tetrahedron, &places, &values, place);
            }
        });
        Ok(())
    })?;
    Ok(found)
}

/// Points sorted into a coarse grid.
struct Buckets {
    per_root: [f64; 3],
    dims: [usize; 3],
    points: Vec<Vec<usize>>,
}

impl Buckets {
    fn new(wanted: &[Option<[f64; 3]>], lattice: &Lattice) -> Self {
        // About one point in each.
        let along = (wanted.len() as f64).cbrt().ceil().clamp(1.0, 128.0);
        let per_root = lattice.extent.map(|e| if e > 0.0 { along / e } else { 0.0 });
        let dims = [along as usize; 3];
        let mut buckets = Self { per_root, dims, points: vec![Vec::new(); dims.iter().product()] };
        for (point, place) in wanted.iter().enumerate() {
            if let Some(place) = place {
                let [x, y, z] = buckets.of(*place);
                buckets.points[x + dims[0] * (y + dims[1] * z)].push(point);
            }
        }
        buckets
    }

    fn of(&self, place: [f64; 3]) -> [usize; 3] {
        std::array::from_fn(|a| ((place[a] * self.per_root[a]).max(0.0) as usize).min(self.dims[a] - 1))
    }

    fn each_near(&self, [low, high]: [[f64; 3]; 2], of_point: &mut dyn FnMut(usize)) {
        let (from, to) = (self.of(low.map(|v| v - TOLERANCE)), self.of(high.map(|v| v + TOLERANCE)));
        for z in from[2]..=to[2] {
            for y in from[1]..=to[1] {
                for x in from[0]..=to[0] {
                    self.points[x + self.dims[0] * (y + self.dims[1] * z)].iter().for_each(|&p| of_point(p));
                }
            }
        }
    }
}
