//! The scenes in which the ray caster is measured beside other programs.

#![allow(dead_code, reason = "the bench and the example use a part each")]

use chronoxel_core::{
    Camera, Lighting, Projection, ResolvedTransfer, TransferDomain, TransferFunction, TransferPoint,
    UniformGrid,
};
use chronoxel_render::{DrawBrick, Scene};

#[path = "../../tests/pictures/mod.rs"]
pub mod pictures;

pub use pictures::{Field, in_view_order};

/// Distance of the camera in edges of a cube, at which the cube covers a third of the picture over a full turn.
const DISTANCE_IN_EDGES: f64 = 4.0561;

/// The transfer functions of the comparison: `sparse` shows nothing below 0.35 of the range and two sheets above,
/// `filled` shows everything, thinly. Opacities are those of one voxel.
pub fn transfer_function(name: &str, domain: [f64; 2]) -> ResolvedTransfer {
    let bump = |s: f64, centre: f64, width: f64| (-((s - centre) / width).powi(2)).exp();
    let opacity = |s: f64| match name {
        "sparse" if s < 0.35 => 0.0,
        "sparse" => 0.04 * s + 0.28 * bump(s, 0.75, 0.05) + 0.10 * bump(s, 0.5, 0.03),
        _ => 0.006 + 0.02 * s + 0.04 * bump(s, 0.75, 0.05) + 0.02 * bump(s, 0.2, 0.04),
    };
    let points = (0..256).map(|i| {
        let s = f64::from(i) / 255.0;
        let color = [s, 0.2 + 0.6 * bump(s, 0.5, 0.2), 1.0 - s].map(|c| c as f32);
        TransferPoint { x: s, color, opacity: opacity(s) as f32 }
    });
    TransferFunction::new(points.collect(), TransferDomain::Range(domain)).unwrap().resolve(domain).unwrap()
}

/// The camera of a turn: elevation 20 degrees, field of view 30 degrees.
pub fn camera(grid: &UniformGrid, azimuth_deg: f64) -> Camera {
    let [low, high] = grid.bounds();
    let centre: [f64; 3] = std::array::from_fn(|a| 0.5 * (low[a] + high[a]));
    let distance = DISTANCE_IN_EDGES * grid.dims[0] as f64 * grid.spacing[0];
    let ((sin_az, cos_az), (sin_el, cos_el)) =
        (azimuth_deg.to_radians().sin_cos(), 20f64.to_radians().sin_cos());
    let outward = [sin_az * cos_el, sin_el, cos_az * cos_el];
    let position = std::array::from_fn(|a| centre[a] + distance * outward[a]);
    Camera::new(position, centre, [0.0, 1.0, 0.0], Projection::Perspective { fov_y_deg: 30.0 }).unwrap()
}

/// 512 x 512 pixels, half a voxel from sample to sample.
pub fn scene(field: &Field, function: &str, domain: [f64; 2], lit: bool) -> Scene {
    Scene {
        grid: field.grid,
        layout: chronoxel_core::BrickLayout::new(32).unwrap(),
        camera: camera(&field.grid, 30.0),
        transfer: transfer_function(function, domain),
        size: [512, 512],
        step_voxels: 0.5,
        finest_level: 0,
        lighting: lit.then(Lighting::default),
        opacity_unit: 1.0,
    }
}

/// Concentric shells with ripples, 0 to 255, on a cube of `n` samples along an edge.
pub fn ripples(n: usize) -> Field {
    let grid = UniformGrid::new([n; 3], [0.0; 3], [1.0; 3]).unwrap();
    Field::new(grid, |place| {
        let [a, b, c] = place.map(|p| (p - n as f64 / 2.0) / n as f64);
        let r = (a * a + b * b + c * c).sqrt();
        (127.0 + 127.0 * (40.0 * r + 6.0 * a * (9.0 * b).sin()).sin() * (-2.0 * r).exp()).floor()
    })
}

/// The bricks of a scene, in the order of one of its views.
pub fn turned(scene: &mut Scene, bricks: &[DrawBrick], azimuth_deg: f64) -> Vec<DrawBrick> {
    scene.camera = camera(&scene.grid, azimuth_deg);
    in_view_order(scene, bricks.to_vec())
}
