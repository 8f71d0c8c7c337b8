//! Gradients at the points of a mesh.

use rayon::prelude::*;

use super::CellMesh;
use super::mesh::{cross, sub};

/// Points, or tetrahedra, that one task takes.
const TASK: usize = 4096;

/// The direction of the gradient at each point: that of the tetrahedra around it, weighted by their volumes.
///
/// Zero where there is none. Tetrahedra without a value count for nothing.
///
/// * `values`: one per point
pub(super) fn unit_gradients(mesh: &CellMesh, values: &[f32]) -> Vec<[f32; 3]> {
    let of_cell = |cell: &[u32; 4]| weighted_gradient(mesh, *cell, values);
    let of_cells: Vec<[f32; 3]> = mesh.tetrahedra.par_iter().with_min_len(TASK).map(of_cell).collect();
    let around = mesh.cells_of_points();
    let of_point = |run: &[u32]| {
        let mut sum = [0.0f64; 3];
        for &cell in &around.cells[run[0] as usize..run[1] as usize] {
            (0..3).for_each(|a| sum[a] += f64::from(of_cells[cell as usize][a]));
        }
        let length = (sum[0] * sum[0] + sum[1] * sum[1] + sum[2] * sum[2]).sqrt();
        if length > 0.0 { sum.map(|c| (c / length) as f32) } else { [0.0; 3] }
    };
    around.starts.par_windows(2).with_min_len(TASK).map(of_point).collect()
}

/// The gradient in a tetrahedron times six times its volume; zero where a value is missing.
fn weighted_gradient(mesh: &CellMesh, cell: [u32; 4], values: &[f32]) -> [f32; 3] {
    let [a, b, c, d] = cell.map(|p| mesh.points[p as usize]);
    let [va, vb, vc, vd] = cell.map(|p| f64::from(values[p as usize]));
    let (ab, ac, ad) = (sub(b, a), sub(c, a), sub(d, a));
    let (nb, nc, nd) = (cross(ac, ad), cross(ad, ab), cross(ab, ac));
    let sum: [f64; 3] = std::array::from_fn(|i| (vb - va) * nb[i] + (vc - va) * nc[i] + (vd - va) * nd[i]);
    if sum.iter().all(|c| c.is_finite()) { sum.map(|c| c as f32) } else { [0.0; 3] }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_linear_field_has_one_gradient() {
        let points =
            vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.2], [0.0, 1.5, 0.0], [0.1, 0.0, 1.0], [1.0, 1.0, 1.0]];
        let value = |p: &[f64; 3]| (2.0 * p[0] - p[1] + 2.0 * p[2] + 7.0) as f32;
        let values: Vec<f32> = points.iter().map(value).collect();
        let mesh = CellMesh::new(points, &[[0, 1, 2, 3], [1, 2, 3, 4]]).unwrap();
        for found in unit_gradients(&mesh, &values) {
            for (found, expected) in found.into_iter().zip([2.0 / 3.0, -1.0 / 3.0, 2.0 / 3.0]) {
                assert!((found - expected).abs() < 1e-6);
            }
        }
        assert_eq!(unit_gradients(&mesh, &[3.0; 5]), [[0.0; 3]; 5]);
    }
}
