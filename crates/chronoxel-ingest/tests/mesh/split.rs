//! Cells of every kind become tetrahedra that fill them and fit each other.

use chronoxel_core::TimeAxis;
use chronoxel_ingest::mesh::{CellKind, CellList, MemoryMesh, MeshSeries};
use chronoxel_ingest::sources::{SourceOptions, open_mesh};

use crate::conformity::{Walked, close};

fn one_step() -> TimeAxis {
    TimeAxis::regular(1, 1.0, "").unwrap()
}

/// A cell by its corners.
type Cell = (CellKind, Vec<u32>);

/// Points of a lattice of unit cells.
fn lattice(dims: [usize; 3]) -> Vec<[f64; 3]> {
    let mut points = Vec::new();
    for (k, j) in (0..dims[2]).flat_map(|k| (0..dims[1]).map(move |j| (k, j))) {
        points.extend((0..dims[0]).map(|i| [i as f64, j as f64, k as f64]));
    }
    points
}

/// The hexahedra of a lattice, as VTK orders their corners.
fn hexahedra(dims: [usize; 3]) -> Vec<[u32; 8]> {
    let mut cells = Vec::new();
    let at = |i: usize, j: usize, k: usize| (i + dims[0] * (j + dims[1] * k)) as u32;
    for k in 0..dims[2] - 1 {
        for j in 0..dims[1] - 1 {
            for i in 0..dims[0] - 1 {
                let face = |k| [at(i, j, k), at(i + 1, j, k), at(i + 1, j + 1, k), at(i, j + 1, k)];
                cells.push([face(k), face(k + 1)].concat().try_into().unwrap());
            }
        }
    }
    cells
}

/// Numbers that look random, the same every time.
struct Shuffle(u64);

impl Shuffle {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        self.0 >> 33
    }

    /// A renumbering of points, which decides all diagonals.
    fn permutation(&mut self, n: usize) -> Vec<u32> {
        let mut order: Vec<u32> = (0..n as u32).collect();
        (1..n).for_each(|i| order.swap(i, self.next() as usize % (i + 1)));
        order
    }
}

/// A mesh of cells whose points were renumbered.
fn renumbered(points: &[[f64; 3]], cells: &[Cell], order: &[u32]) -> MemoryMesh {
    let mut moved = vec![[0.0; 3]; points.len()];
    points.iter().enumerate().for_each(|(i, p)| moved[order[i] as usize] = *p);
    let mut list = CellList::default();
    for (kind, corners) in cells {
        let corners: Vec<u32> = corners.iter().map(|c| order[*c as usize]).collect();
        list.push(*kind, &corners);
    }
    MemoryMesh::unstructured(moved, list, one_step()).unwrap()
}

#[test]
fn a_lattice_gives_five_tetrahedra_per_cell_that_fit() {
    let dims = [4, 3, 5];
    let mut mesh = MemoryMesh::curvilinear(dims, lattice(dims), one_step()).unwrap();
    let walked = Walked::of(&mut mesh);
    assert_eq!(walked.census.num_tetrahedra, 5 * 3 * 2 * 4);
    assert_eq!((walked.census.num_flat, walked.census.num_inverted), (0, 0));
    assert!(close(walked.volume(), 24.0) && close(walked.census.volume, 24.0));
    // Two triangles per face of the box: 3 x 2, 3 x 4 and 2 x 4 of them, twice.
    assert_eq!(walked.surface().len(), 2 * 2 * (6 + 12 + 8));
}

#[test]
fn hexahedra_of_a_lattice_give_five_each_whatever_the_numbers_of_their_points() {
    let dims = [4, 3, 3];
    let cells: Vec<_> = hexahedra(dims).into_iter().map(|c| (CellKind::Hexahedron, c.to_vec())).collect();
    let mut shuffle = Shuffle(1);
    for _ in 0..20 {
        let walked = Walked::of(&mut renumbered(&lattice(dims), &cells, &shuffle.permutation(36)));
        assert_eq!(walked.census.num_tetrahedra, 5 * 12);
        assert_eq!((walked.census.num_flat, walked.census.num_inverted), (0, 0));
        assert!(close(walked.volume(), 12.0));
        assert_eq!(walked.surface().len(), 2 * 2 * (6 + 6 + 4));
    }
}

/// Cuts the unit cells of a lattice into all kinds by turns: hexahedra, pairs of wedges, six pyramids about the centre.
fn mixed(dims: [usize; 3], kinds: &[usize]) -> (Vec<[f64; 3]>, Vec<Cell>) {
    let mut points = lattice(dims);
    let mut cells = Vec::new();
    for (number, c) in hexahedra(dims).into_iter().enumerate() {
        match kinds[number % kinds.len()] {
            0 => cells.push((CellKind::Hexahedron, c.to_vec())),
            1 => {
                // Triangles lie at the sides, so that tops and bottoms stay whole; the pairs match along x and y.
                cells.push((CellKind::Wedge, vec![c[0], c[4], c[3], c[1], c[5], c[2]]));
                cells.push((CellKind::Wedge, vec![c[4], c[7], c[3], c[5], c[6], c[2]]));
            }
            _ => {
                let centre: [f64; 3] = std::array::from_fn(|axis| {
                    c.iter().map(|p| points[*p as usize][axis]).sum::<f64>() / 8.0
                });
                let tip = points.len() as u32;
                points.push(centre);
                let bases =
                    [[0, 1, 2, 3], [4, 7, 6, 5], [0, 4, 5, 1], [3, 2, 6, 7], [1, 5, 6, 2], [0, 3, 7, 4]];
                for base in bases {
                    let mut corners: Vec<u32> = base.iter().map(|b| c[*b]).collect();
                    corners.push(tip);
                    cells.push((CellKind::Pyramid, corners));
                }
            }
        }
    }
    (points, cells)
}

#[test]
fn hexahedra_wedges_and_pyramids_fit_each_other() {
    // Along z whole layers of wedges, so that their triangles meet triangles; pyramids and hexahedra anywhere else.
    let dims = [3, 3, 4];
    let kinds = [0, 2, 2, 0, 2, 0, 0, 2, 0, 0, 2, 0];
    let row_of_wedges = [1, 1, 0, 2, 2, 0, 1, 1, 1, 1, 0, 2];
    let mut shuffle = Shuffle(7);
    for kinds in [kinds, row_of_wedges] {
        let (points, cells) = mixed(dims, &kinds);
        for _ in 0..20 {
            let order = shuffle.permutation(points.len());
            let walked = Walked::of(&mut renumbered(&points, &cells, &order));
            assert_eq!((walked.census.num_flat, walked.census.num_inverted), (0, 0));
            assert!(close(walked.volume(), 12.0));
            assert_eq!(walked.surface().len(), 2 * 2 * (4 + 6 + 6));
        }
    }
}

/// Three hexahedra around a wedge: their edges go around in odd circles, so no colouring is possible.
#[test]
fn hexahedra_that_cannot_be_coloured_fit_all_the_same() {
    let mut points: Vec<[f64; 3]> = Vec::new();
    for z in [0.0, 1.0, 2.0] {
        for radius in [0.5, 1.0] {
            points.extend([0.0, 1.0, 2.0].map(|third: f64| {
                let angle = std::f64::consts::TAU / 3.0 * third;
                [radius * angle.cos(), radius * angle.sin(), z]
            }));
        }
    }
    let mut cells = Vec::new();
    for base in [0, 6] {
        for i in 0..3u32 {
            let next = (i + 1) % 3;
            let around = [i, 3 + i, 3 + next, next].map(|p| p + base);
            cells.push((CellKind::Hexahedron, [around, around.map(|p| p + 6)].concat()));
        }
        let triangle = [0, 2, 1].map(|p| p + base);
        cells.push((CellKind::Wedge, [triangle, triangle.map(|p| p + 6)].concat()));
    }
    let area = 3.0 * 3f64.sqrt() / 4.0;
    let mut shuffle = Shuffle(3);
    for _ in 0..20 {
        let walked = Walked::of(&mut renumbered(&points, &cells, &shuffle.permutation(points.len())));
        assert_eq!((walked.census.num_flat, walked.census.num_inverted), (0, 0));
        assert!(close(walked.volume(), 2.0 * area), "{}", walked.volume());
        // Twice three sides with two triangles each; bottom and top with six and the wedge's.
        assert_eq!(walked.surface().len(), 2 * 3 * 2 + 2 * 7);
    }
}

#[test]
fn left_out_cells_are_counted() {
    let points = [lattice([2, 2, 2]), vec![[0.5, 0.5, 2.0], [0.5, 0.5, 3.0], [0.2, 0.3, 4.0]]].concat();
    let mut cells = CellList::default();
    cells.push(CellKind::Tetrahedron, &[0, 1, 2, 4]);
    cells.push_without_volume();
    // The same again, in another order, and flat, and left-handed.
    cells.push(CellKind::Tetrahedron, &[4, 0, 2, 1]);
    cells.push(CellKind::Tetrahedron, &[0, 1, 2, 3]);
    cells.push(CellKind::Tetrahedron, &[2, 1, 4, 7]);
    // A third one on the face 1 2 4.
    cells.push(CellKind::Tetrahedron, &[1, 2, 4, 8]);
    let mut mesh = MemoryMesh::unstructured(points, cells, one_step()).unwrap();
    let walked = Walked::of(&mut mesh);
    let census = walked.census;
    assert_eq!((census.cells.tetrahedra, census.cells.without_volume), (5, 1));
    assert_eq!((census.num_duplicate, census.num_non_manifold, census.num_flat), (1, 1, 1));
    assert_eq!((census.num_tetrahedra, census.num_inverted), (2, 1));
    assert!(close(walked.volume(), 1.0 / 6.0 + 1.0 / 3.0));
}

#[test]
fn meshes_that_cannot_be_are_refused() {
    let mut cells = CellList::default();
    cells.push_without_volume();
    cells.push(CellKind::Tetrahedron, &[0, 1, 2, 9]);
    let points = lattice([2, 2, 2]);
    let refused = MemoryMesh::unstructured(points.clone(), cells, one_step()).err().unwrap().to_string();
    assert!(refused.contains("corner of cell 1 is 9") && refused.contains("8 points"), "{refused}");
    let mut wrong = points.clone();
    wrong[3][1] = f64::NAN;
    let refused = MemoryMesh::curvilinear([2; 3], wrong, one_step()).err().unwrap().to_string();
    assert!(refused.contains("position of point 3 is 1.0, NaN, 0.0"), "{refused}");
    let flat = points.iter().map(|p| [p[0], p[1], 0.0]).collect();
    let mut mesh = MemoryMesh::curvilinear([2; 3], flat, one_step()).unwrap();
    let refused = mesh.for_each_tetrahedron(&mut |_| Ok(())).unwrap_err().to_string();
    assert!(refused.contains("volume of the mesh is 0"), "{refused}");
}

#[test]
fn the_twisted_bar_is_sound() {
    let source = ["sim:twist?dims=9x8x7&steps=3".to_owned()];
    let mut mesh = open_mesh(&source, &SourceOptions::default()).unwrap();
    let walked = Walked::of(mesh.as_mut());
    assert_eq!(walked.census.num_tetrahedra, 5 * 8 * 7 * 6);
    assert_eq!((walked.census.num_flat, walked.census.num_inverted), (0, 0));
    walked.volume();
    assert_eq!(walked.surface().len(), 2 * 2 * (8 * 7 + 8 * 6 + 7 * 6));
    // Its second field is linear in the world.
    let values = mesh.read_values(1, 2).unwrap();
    for (index, [x, y, z]) in walked.points.iter().enumerate() {
        let expected = 1.0 + 2.0 / 3.0 + x + 2.0 * y - 0.5 * z;
        assert!((values.get(index) - expected).abs() < 1e-6);
    }
}
