//! Blocks of a structured grid that touch.

use std::collections::BTreeMap;

use chronoxel_ingest::MeshSeries;
use chronoxel_ingest::sources::{SourceOptions, open_mesh};

use crate::meshes::{bricks, voxelised};

/// A PLOT3D grid and solution of blocks, little-endian, in 8 bytes, without records; the density is `x + 2 y + 4 z`.
fn written(folder: &std::path::Path, blocks: &[([usize; 3], Vec<[f64; 3]>)]) -> Box<dyn MeshSeries> {
    let mut head: Vec<u8> = (blocks.len() as i32).to_le_bytes().to_vec();
    for n in blocks.iter().flat_map(|(dims, _)| dims) {
        head.extend((*n as i32).to_le_bytes());
    }
    let (mut grid, mut solution) = (head.clone(), head);
    for (_, points) in blocks {
        for a in 0..3 {
            points.iter().for_each(|p| grid.extend(p[a].to_le_bytes()));
        }
        [0.5f64, 0.0, 1e6, 0.0].iter().for_each(|v| solution.extend(v.to_le_bytes()));
        for q in 0..5 {
            let value = |p: &[f64; 3]| if q == 0 { p[0] + 2.0 * p[1] + 4.0 * p[2] } else { 1.5 };
            points.iter().for_each(|p| solution.extend(value(p).to_le_bytes()));
        }
    }
    let paths = [folder.join("grid.xyz"), folder.join("solution.q")];
    std::fs::write(&paths[0], grid).unwrap();
    std::fs::write(&paths[1], solution).unwrap();
    let inputs = paths.map(|path| path.to_string_lossy().into_owned());
    let options = SourceOptions { variables: vec!["density".to_owned()], ..SourceOptions::default() };
    open_mesh(&inputs, &options).unwrap()
}

/// Two blocks that fill a box; the face between them is bent. The second runs backwards along y, so that its points are coloured the other way round there.
fn two() -> Vec<([usize; 3], Vec<[f64; 3]>)> {
    let between = |y: f64, z: f64| 1.0 + 0.3 * (5.0 * y).sin() * (4.0 * z).cos();
    let block = |nx: usize, is_second: bool| {
        let [ny, nz] = [6, 5];
        let place = move |n: usize| {
            let [i, j, k] = [n % nx, n / nx % ny, n / (nx * ny)];
            let j = if is_second { ny - 1 - j } else { j };
            let [u, y, z] = [i as f64 / (nx - 1) as f64, j as f64 / 5.0, k as f64 / 4.0];
            let middle = between(y, z);
            let [from, to] = if is_second { [middle, 2.0] } else { [0.0, middle] };
            [
                if u == 0.0 {
                    from
                } else if u == 1.0 {
                    to
                } else {
                    from + u * (to - from)
                },
                y,
                z,
            ]
        };
        ([nx, ny, nz], (0..nx * ny * nz).map(place).collect())
    };
    vec![block(4, false), block(4, true)]
}

#[test]
fn no_crack_opens_between_blocks() {
    let folder = tempfile::tempdir().unwrap();
    let mut mesh = written(folder.path(), &two());
    let points = mesh.points().unwrap();
    // Triangles by the places of their corners: those between two tetrahedra are there twice.
    let mut triangles: BTreeMap<Vec<[u64; 3]>, usize> = BTreeMap::new();
    let census = mesh
        .for_each_tetrahedron(&mut |t| {
            for left_out in 0..4 {
                let corners =
                    (0..4).filter(|c| *c != left_out).map(|c| points[t[c] as usize].map(f64::to_bits));
                let mut corners: Vec<_> = corners.collect();
                corners.sort_unstable();
                *triangles.entry(corners).or_default() += 1;
            }
            Ok(())
        })
        .unwrap();
    assert!((census.volume - 2.0).abs() < 1e-12, "{}", census.volume);
    let surface = triangles.values().filter(|n| **n == 1).count();
    // Of a box of 6 x 5 x 4 cells.
    assert_eq!(surface, 2 * 2 * (6 * 5 + 6 * 4 + 5 * 4));
    let voxels = voxelised(mesh.as_mut(), 0.0, 4);
    let (grid, layout) = (*voxels.grid(), *voxels.layout());
    let (full, mut num_inside) = (layout.full_edge(), 0);
    for (node, samples) in bricks(&voxels, mesh.as_mut(), 0) {
        if !voxels.tree().is_leaf(node) {
            continue;
        }
        for (n, value) in samples.iter().enumerate() {
            let at = [n % full, n / full % full, n / full / full];
            let scale = f64::from(1u32 << node.level);
            let voxel: [f64; 3] = std::array::from_fn(|a| {
                (f64::from(node.brick()[a]) * layout.edge as f64 + at[a] as f64 - layout.low as f64) * scale
            });
            let [x, y, z] = grid.world_from_voxel(voxel);
            if (0.0..=2.0).contains(&x) && (0.0..=1.0).contains(&y) && (0.0..=1.0).contains(&z) {
                assert!((value - (x + 2.0 * y + 4.0 * z)).abs() < 1e-10, "{value} at {x}, {y}, {z}");
                num_inside += 1;
            }
        }
    }
    assert!(num_inside > 1_000, "{num_inside}");
}
