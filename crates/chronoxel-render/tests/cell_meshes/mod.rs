//! Meshes of tetrahedra that need no file, and scenes around them.

#![allow(dead_code, reason = "each test and bench uses some of it")]

use chronoxel_core::{Camera, ColorMap, Lighting, TransferFunction};
use chronoxel_render::{CellMesh, CellScene};

/// A box of hexahedra, each cut into five tetrahedra, and bent by a function of the place in the unit cube.
///
/// * `num`: hexahedra along each axis
/// * `keep`: which hexahedra there are
pub fn lattice(
    num: [usize; 3],
    bend: impl Fn([f64; 3]) -> [f64; 3],
    keep: impl Fn([usize; 3]) -> bool,
) -> CellMesh {
    let [nx, ny, nz] = num;
    let (px, py) = (nx + 1, ny + 1);
    let number = |x: usize, y: usize, z: usize| ((z * py + y) * px + x) as u32;
    let mut points = Vec::new();
    for z in 0..=nz {
        for y in 0..=ny {
            points.extend(
                (0..=nx).map(|x| bend([x as f64 / nx as f64, y as f64 / ny as f64, z as f64 / nz as f64])),
            );
        }
    }
    let mut cells = Vec::new();
    for (z, y, x) in (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| (z, y, x)))) {
        if !keep([x, y, z]) {
            continue;
        }
        let corner = |i: usize| number(x + (i & 1), y + (i >> 1 & 1), z + (i >> 2));
        // The two ways alternate, so that neighbours share their faces' diagonals.
        let five = if (x + y + z) % 2 == 0 {
            [[0, 1, 2, 4], [1, 2, 3, 7], [1, 4, 5, 7], [2, 4, 6, 7], [1, 2, 4, 7]]
        } else {
            [[0, 1, 3, 5], [0, 2, 3, 6], [0, 4, 5, 6], [3, 5, 6, 7], [0, 3, 5, 6]]
        };
        cells.extend(five.map(|cell: [usize; 4]| cell.map(corner)));
    }
    CellMesh::new(points, &cells).expect("a mesh")
}

/// A block that is twisted by 60 degrees from bottom to top.
pub fn twisted(num: [usize; 3]) -> CellMesh {
    lattice(num, twist, |_| true)
}

fn twist([x, y, z]: [f64; 3]) -> [f64; 3] {
    let angle = (z - 0.5) * 60f64.to_radians();
    let (x, y) = (x - 0.5, y - 0.5);
    [x * angle.cos() - y * angle.sin(), x * angle.sin() + y * angle.cos(), z - 0.5]
}

/// Values at the points of a mesh of [`lattice`], in order of the lattice: waves that run with time.
pub fn waves(num: [usize; 3], time: f64) -> Vec<f32> {
    let [nx, ny, nz] = num.map(|n| n + 1);
    let wave = |x: usize, y: usize, z: usize| {
        let [x, y, z] = [x as f64 / nx as f64, y as f64 / ny as f64, z as f64 / nz as f64];
        let sum = (9.0 * x + time).sin() + (7.0 * y - 2.0 * time).cos() + (5.0 * z + 4.0 * x * y).sin();
        (0.5 + sum / 6.0) as f32
    };
    (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| wave(x, y, z)))).collect()
}

/// A scene around a mesh whose values lie in [0, 1].
pub fn scene(
    mesh: &CellMesh,
    function: &str,
    size: [usize; 2],
    fov_y_deg: Option<f64>,
    lit: bool,
) -> CellScene {
    let [low, high] = mesh.bounds();
    let longest = (0..3).map(|a| high[a] - low[a]).fold(0.0, f64::max);
    let function = TransferFunction::built_in(function, ColorMap::Turbo).expect("a built-in function");
    CellScene {
        camera: Camera::orbit(mesh.bounds(), 30.0, 20.0, 1.0, fov_y_deg, 1.0).expect("a camera"),
        transfer: function.resolve([0.0, 1.0]).expect("a range"),
        size,
        lighting: lit.then(Lighting::default),
        opacity_unit: longest / 128.0,
        value_range: [0.0, 1.0],
    }
}
