//! Meshes of every kind, with fields that are known everywhere.

use std::f64::consts::TAU;

use chronoxel_core::{BrickLayout, NodeId, SampleType, Samples, TimeAxis};
use chronoxel_ingest::mesh::{CellKind, CellList, MemoryMesh};
use chronoxel_ingest::voxelise::{Room, Voxels};
use chronoxel_ingest::{MeshSeries, Variable, VoxelOptions};

/// The points of a lattice of `dims`, moved by a function of the unit cube.
pub fn lattice(dims: [usize; 3], to_world: impl Fn([f64; 3]) -> [f64; 3]) -> Vec<[f64; 3]> {
    let along = |i: usize, a: usize| i as f64 / (dims[a] - 1) as f64;
    let num = dims.iter().product();
    let place = |i: usize| [i % dims[0], i / dims[0] % dims[1], i / (dims[0] * dims[1])];
    (0..num).map(|i| to_world(std::array::from_fn(|a| along(place(i)[a], a)))).collect()
}

/// Most of a ring that becomes thinner: not convex, with a gap and a hole.
pub fn ring() -> MemoryMesh {
    let dims = [25, 9, 7];
    let points = lattice(dims, |[u, v, w]| {
        let (angle, radius) = (0.9 * TAU * u, 1.0 + (1.0 - 0.7 * u) * v);
        [10.0 + radius * angle.cos(), radius * angle.sin() - 3.0, 0.8 * w]
    });
    MemoryMesh::curvilinear(dims, points, steps(3)).unwrap()
}

/// A box whose layers become thinner towards one corner.
pub fn stretched() -> MemoryMesh {
    let dims = [13, 12, 11];
    let points = lattice(dims, |p| [3.0 * p[0].powi(3), 2.0 * p[1].powi(2), p[2]]);
    MemoryMesh::curvilinear(dims, points, steps(3)).unwrap()
}

/// Wedges beside a pyramid beside tetrahedra, in no order, and points that no cell uses.
pub fn mixed() -> MemoryMesh {
    let mut points = vec![
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [0.0, 1.0, 0.1],
        [0.0, 0.1, 1.0],
        [1.1, 0.0, 1.0],
        [0.0, 1.2, 1.0],
        // The apex over the quadrilateral 1 2 5 4, and one beyond it.
        [1.3, 1.2, 0.5],
        [2.0, 0.3, 0.7],
    ];
    points.push([50.0, 50.0, 50.0]);
    let mut cells = CellList::default();
    cells.push(CellKind::Tetrahedron, &[1, 4, 6, 7]);
    cells.push(CellKind::Pyramid, &[1, 2, 5, 4, 6]);
    cells.push(CellKind::Wedge, &[0, 1, 2, 3, 4, 5]);
    MemoryMesh::unstructured(points, cells, steps(3)).unwrap()
}

pub fn steps(num_steps: usize) -> TimeAxis {
    TimeAxis::regular(num_steps, 0.5, "s").unwrap()
}

/// Adds a variable that is a function of place and step.
pub fn with_field(
    mut mesh: MemoryMesh,
    sample_type: SampleType,
    f: impl Fn([f64; 3], usize) -> f64,
) -> MemoryMesh {
    let points = mesh.points().unwrap();
    let of_step = |step: usize| {
        let values = points.iter().map(|&p| f(p, step));
        match sample_type.fits_f32() {
            true => Samples::F32(values.map(|v| v as f32).collect()),
            false => Samples::F64(values.collect()),
        }
    };
    let values = (0..mesh.times().num_steps()).map(of_step).collect();
    let variable = Variable { name: "v".into(), units: "K".into(), sample_type, fill_value: None };
    mesh.with_variable(variable, values).unwrap()
}

/// A field that is linear in space.
pub fn linear([x, y, z]: [f64; 3], step: usize) -> f64 {
    1.5 + 2.0 * x - 3.0 * y + (0.5 + step as f64) * z
}

/// A field that is not.
pub fn wavy([x, y, z]: [f64; 3], step: usize) -> f64 {
    (3.0 * x + 0.4 * step as f64).sin() * (2.0 * y).cos() + 0.3 * (z * z) + 0.1 * step as f64
}

/// Voxelises with bricks of 8.
pub fn voxelised(mesh: &mut dyn MeshSeries, field_threshold: f64, max_depth: u8) -> Voxels {
    let folder = std::env::temp_dir();
    let room = Room { folder: &folder, list_bytes: 1 << 26, map_bytes: 1 << 26 };
    let options = VoxelOptions { field_threshold, max_depth };
    Voxels::new(mesh, &[(0, None)], &BrickLayout::new(8).unwrap(), &options, room).unwrap()
}

/// Every brick of a step.
pub fn bricks(voxels: &Voxels, mesh: &mut dyn MeshSeries, step: usize) -> Vec<(NodeId, Vec<f64>)> {
    let mut bricks = Vec::new();
    let values = mesh.read_values(0, step).unwrap();
    voxels
        .for_each_brick(values, &mut |node, samples| {
            bricks.push((node, samples.to_vec()));
            Ok(())
        })
        .unwrap();
    bricks
}

/// Where sample `index` of a full brick lies in the world.
pub fn world_of(voxels: &Voxels, node: NodeId, index: usize) -> [f64; 3] {
    let (layout, grid) = (voxels.layout(), voxels.grid());
    let full = layout.full_edge();
    let place = [index % full, index / full % full, index / full / full];
    std::array::from_fn(|a| {
        let sample = (node.brick()[a] as usize * layout.edge + place[a]) as f64 - layout.low as f64;
        grid.origin[a] + sample * f64::from(1u32 << node.level) * grid.spacing[a]
    })
}

/// Indices in the full brick of the core samples inside the grid.
pub fn core_of(voxels: &Voxels, node: NodeId) -> Vec<usize> {
    let geometry = &voxels.levels()[usize::from(node.level)];
    let core = geometry.core_inside(node.brick().map(|b| b as usize), voxels.layout());
    core.into_iter().map(|i| i as usize).collect()
}
