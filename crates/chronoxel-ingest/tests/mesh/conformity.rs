//! What must hold for the tetrahedra of any mesh, computed by plain means.

use std::collections::BTreeMap;

use chronoxel_ingest::mesh::{MeshCensus, MeshSeries};

/// The tetrahedra of a mesh with what was counted.
pub struct Walked {
    pub points: Vec<[f64; 3]>,
    pub tetrahedra: Vec<[u32; 4]>,
    pub census: MeshCensus,
}

impl Walked {
    pub fn of(mesh: &mut dyn MeshSeries) -> Self {
        let mut tetrahedra = Vec::new();
        let census = mesh
            .for_each_tetrahedron(&mut |t| {
                tetrahedra.push(t);
                Ok(())
            })
            .unwrap();
        let points = mesh.points().unwrap();
        assert_eq!(points.len(), mesh.num_points());
        assert_eq!(census.num_points, points.len() as u64);
        assert_eq!(census.num_tetrahedra, tetrahedra.len() as u64);
        assert_eq!(census.num_split, census.num_tetrahedra + census.num_flat);
        Self { points, tetrahedra, census }
    }

    /// Sum of the volumes, each of which must be positive.
    pub fn volume(&self) -> f64 {
        let volume = |t: &[u32; 4]| {
            let [a, b, c, d] = t.map(|p| self.points[p as usize]);
            let e = |p: [f64; 3]| [p[0] - a[0], p[1] - a[1], p[2] - a[2]];
            let ([x, y, z], v, w) = (e(b), e(c), e(d));
            let determinant = x * (v[1] * w[2] - v[2] * w[1]) - y * (v[0] * w[2] - v[2] * w[0])
                + z * (v[0] * w[1] - v[1] * w[0]);
            assert!(determinant > 0.0, "{t:?} has the volume {determinant}");
            determinant / 6.0
        };
        self.tetrahedra.iter().map(volume).sum()
    }

    /// Triangles that only one tetrahedron has: the surface. No triangle may belong to more than two.
    pub fn surface(&self) -> Vec<[u32; 3]> {
        let mut count = BTreeMap::new();
        for [a, b, c, d] in &self.tetrahedra {
            for mut face in [[a, b, c], [a, b, d], [a, c, d], [b, c, d]] {
                face.sort();
                *count.entry(face.map(|p| *p)).or_insert(0) += 1;
            }
        }
        assert!(count.values().all(|n| *n <= 2), "a triangle belongs to more than two tetrahedra");
        count.into_iter().filter(|(_, n)| *n == 1).map(|(face, _)| face).collect()
    }
}

pub fn close(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-12 * a.abs().max(b.abs())
}
