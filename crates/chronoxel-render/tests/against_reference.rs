//! The ray caster against the reference renderer, over everything that can be varied.

mod pictures;

use chronoxel_core::{Camera, Lighting, NodeId, Projection, UniformGrid};
use chronoxel_render::{DenseField, DrawHow, Scene, render, render_reference};
use pictures::{Field, Quantise, assert_similar, in_view_order, region_of, scene_of, waves};

fn grid() -> UniformGrid {
    UniformGrid::new([41, 33, 50], [-3.0, 10.0, 0.5], [1.0; 3]).unwrap()
}

/// Draws level 0 with the ray caster and the reference, and compares.
#[track_caller]
fn compare(name: &str, scene: &Scene, field: &Field, psnr_db: f64, num_failed: usize) {
    let (actual, _) = render(scene, &field.draw_list(scene, 0, Quantise::PerBrick)).unwrap();
    let dense = DenseField { samples: &field.samples, mask: field.mask.as_deref() };
    let expected = render_reference(scene, &dense).unwrap();
    assert_similar(name, &actual, &expected, psnr_db, num_failed);
}

#[test]
fn built_in_functions_unlit() {
    let field = waves(grid());
    for function in ["ramp", "sparse", "filled"] {
        compare(&format!("unlit {function}"), &scene_of(&field, 32, function, false), &field, 60.0, 0);
    }
}

#[test]
fn built_in_functions_lit() {
    let field = waves(grid());
    for function in ["ramp", "sparse", "filled"] {
        compare(&format!("lit {function}"), &scene_of(&field, 32, function, true), &field, 60.0, 0);
    }
}

#[test]
fn brick_edges() {
    let field = waves(grid());
    for edge in [8, 16, 64] {
        compare(&format!("edge {edge}"), &scene_of(&field, edge, "ramp", true), &field, 60.0, 0);
    }
}

#[test]
fn orthographic_cameras() {
    let field = waves(grid());
    for (azimuth, elevation) in [(0.0, 0.0), (40.0, -30.0), (90.0, 90.0)] {
        let camera = Camera::orbit(field.grid.bounds(), azimuth, elevation, 1.3, None, 1.2).unwrap();
        let scene = Scene { camera, ..scene_of(&field, 16, "sparse", true) };
        compare(&format!("ortho {azimuth} {elevation}"), &scene, &field, 60.0, 0);
    }
}

#[test]
fn cameras_on_every_side() {
    let field = waves(grid());
    for (azimuth, elevation) in [(0.0, 0.0), (120.0, 50.0), (215.0, -40.0), (300.0, 5.0)] {
        let camera = Camera::orbit(field.grid.bounds(), azimuth, elevation, 1.0, Some(50.0), 1.2).unwrap();
        let scene = Scene { camera, ..scene_of(&field, 16, "filled", false) };
        compare(&format!("perspective {azimuth} {elevation}"), &scene, &field, 60.0, 0);
    }
}

#[test]
fn anisotropic_spacing() {
    let grid = UniformGrid::new([30, 40, 25], [0.0; 3], [0.5, 0.25, 2.0]).unwrap();
    let field = waves(grid);
    compare("anisotropic", &scene_of(&field, 16, "sparse", true), &field, 58.0, 0);
}

#[test]
fn step_lengths_and_opacity_units() {
    let field = waves(grid());
    for (step_voxels, opacity_unit) in [(0.25, 1.0), (1.0, 4.0), (1.7, 0.5)] {
        let scene = Scene { step_voxels, opacity_unit, ..scene_of(&field, 16, "ramp", true) };
        compare(&format!("step {step_voxels}"), &scene, &field, 60.0, 0);
    }
}

#[test]
fn lighting_coefficients() {
    let field = waves(grid());
    let lighting = Lighting { ambient: 0.3, diffuse: 0.4, specular: 0.9, specular_power: 37 };
    let scene = Scene { lighting: Some(lighting), ..scene_of(&field, 16, "filled", true) };
    compare("coefficients", &scene, &field, 60.0, 0);
}

#[test]
fn camera_inside_the_volume() {
    let field = waves(grid());
    let eye = field.grid.world_from_voxel([17.3, 12.1, 30.2]);
    let target = field.grid.world_from_voxel([5.0, 20.0, 3.0]);
    let projection = Projection::Perspective { fov_y_deg: 90.0 };
    let camera = Camera::new(eye, target, [0.0, 1.0, 0.0], projection).unwrap();
    for function in ["filled", "sparse"] {
        let scene = Scene { camera, ..scene_of(&field, 16, function, true) };
        compare(&format!("inside {function}"), &scene, &field, 58.0, 0);
    }
}

#[test]
fn masked_samples_are_not_drawn() {
    let mut field = waves(grid());
    let ball = Field::new(grid(), |[x, y, z]| (x - 20.0).hypot(y - 15.0).hypot(z - 30.0));
    field.mask = Some(ball.samples.iter().map(|r| *r < 11.0).collect());
    // A pixel fails where a sample lies so close to the middle of two samples that rounding decides.
    compare("mask", &scene_of(&field, 16, "filled", true), &field, 50.0, 20);
    let without = scene_of(&field, 16, "filled", true);
    let (masked, _) = render(&without, &field.draw_list(&without, 0, Quantise::PerBrick)).unwrap();
    field.mask = None;
    let (whole, _) = render(&without, &field.draw_list(&without, 0, Quantise::PerBrick)).unwrap();
    assert!(pictures::difference(&masked, &whole).num_failed > 500, "the mask must matter");
}

#[test]
fn constant_bricks_are_crossed_in_closed_form() {
    let grid = UniformGrid::new([33, 33, 65], [0.0; 3], [1.0; 3]).unwrap();
    let field = Field::new(grid, |[x, y, z]| if z < 35.0 { 0.6 } else { (0.2 * x + 0.1 * y).sin().abs() });
    let scene = scene_of(&field, 16, "filled", true);
    let mut list = field.draw_list(&scene, 0, Quantise::PerBrick);
    let mut num_constant = 0;
    for item in &mut list {
        // Bricks whose apron also lies in the constant part.
        if item.region[1][2] <= 32.0 {
            item.how = DrawHow::Constant(0.6);
            num_constant += 1;
        }
    }
    let (actual, stats) = render(&scene, &list).unwrap();
    // Those of the 18 that reach into the grid: the others touch no more than its faces.
    assert_eq!((num_constant, stats.bricks_constant), (18, 8), "{stats:?}");
    let expected = render_reference(&scene, &DenseField { samples: &field.samples, mask: None }).unwrap();
    assert_similar("constants", &actual, &expected, 58.0, 0);
}

#[test]
fn absent_children_are_drawn_from_their_parent() {
    // Linear in each voxel coordinate, so that every level interpolates to the same values.
    let grid = UniformGrid::new([33, 33, 33], [0.0; 3], [1.0; 3]).unwrap();
    let field = Field::new(grid, |[x, y, z]| 0.5 * x + 0.3 * y + 0.2 * z);
    let scene = Scene { step_voxels: 0.25, ..scene_of(&field, 16, "ramp", true) };
    let root = NodeId::new(1, [0; 3]);
    let list = (0..8)
        .map(|octant| {
            let child = root.child(octant).unwrap();
            let node = if [1, 2, 6].contains(&octant) { root } else { child };
            field.draw_brick(&scene, node, region_of(child, &scene.layout), Quantise::PerBrick)
        })
        .collect();
    let (actual, _) = render(&scene, &in_view_order(&scene, list)).unwrap();
    let expected = render_reference(&scene, &DenseField { samples: &field.samples, mask: None }).unwrap();
    // Twice the step in three octants: its ends are off by up to half a coarse sample, of opacity below 0.03.
    assert_similar("absent children", &actual, &expected, 45.0, 60);
}
