//! Both renderers against opacities that can be written down.

mod pictures;

use chronoxel_core::{
    Camera, Image, Projection, TransferDomain, TransferFunction, TransferPoint, UniformGrid,
};
use chronoxel_render::{DenseField, Scene, render, render_reference};
use pictures::{Field, Quantise, scene_of};

/// Pictures of a field by the reference and by the ray caster.
fn both(scene: &Scene, field: &Field) -> [(&'static str, Image); 2] {
    let reference = render_reference(scene, &DenseField { samples: &field.samples, mask: None }).unwrap();
    let (cast, _) = render(scene, &field.draw_list(scene, 0, Quantise::PerBrick)).unwrap();
    [("reference", reference), ("ray caster", cast)]
}

fn opacities(points: &[(f64, f32)]) -> chronoxel_core::ResolvedTransfer {
    let points =
        points.iter().map(|&(x, opacity)| TransferPoint { x, color: [0.25, 0.5, 1.0], opacity }).collect();
    TransferFunction::new(points, TransferDomain::Data).unwrap().resolve([0.0, 1.0]).unwrap()
}

/// An orthographic camera along -z, 40 pixels over `height` world units.
fn along_z(field: &Field, height: f64) -> Camera {
    let [low, high] = field.grid.bounds();
    let centre: [f64; 3] = std::array::from_fn(|a| 0.5 * (low[a] + high[a]));
    let position = [centre[0], centre[1], high[2] + 5.0];
    Camera::new(position, centre, [0.0, 1.0, 0.0], Projection::Orthographic { height }).unwrap()
}

#[test]
fn a_constant_field_follows_beer_and_lambert() {
    let grid = UniformGrid::new([20, 20, 37], [1.0, 2.0, 3.0], [1.0, 1.0, 0.5]).unwrap();
    let field = Field::new(grid, |_| 0.7);
    let scene = Scene {
        camera: along_z(&field, 10.0),
        transfer: opacities(&[(0.0, 0.02), (1.0, 0.02)]),
        size: [40, 40],
        opacity_unit: 2.0,
        ..scene_of(&field, 16, "ramp", false)
    };
    // 36 cells of 0.5 make a path of 18: nine units.
    let alpha = 1.0 - 0.98f64.powi(9);
    for (name, image) in both(&scene, &field) {
        for pixel in &image.pixels {
            let expected = [0.25, 0.5, 1.0, 1.0].map(|c| c * alpha);
            for (found, expected) in pixel.iter().zip(expected) {
                assert!((f64::from(*found) - expected).abs() < 1e-5, "{name}: {pixel:?}, not {expected}");
            }
        }
    }
}

#[test]
fn a_linear_ramp_integrates_its_extinction() {
    let grid = UniformGrid::new([12, 12, 65], [0.0; 3], [1.0; 3]).unwrap();
    let field = Field::new(grid, |[_, _, z]| z / 64.0);
    let c = 0.06;
    let scene = Scene {
        camera: along_z(&field, 6.0),
        transfer: opacities(&[(0.0, 0.0), (1.0, c as f32)]),
        size: [10, 10],
        step_voxels: 0.25,
        ..scene_of(&field, 16, "ramp", false)
    };
    // Extinction -ln(1 - c v) at v = z/64, integrated over z from 0 to 64.
    let depth = 64.0 * ((1.0 - c) * (1.0f64 - c).ln() + c) / c;
    let alpha = 1.0 - (-depth).exp();
    for (name, image) in both(&scene, &field) {
        for pixel in &image.pixels {
            assert!((f64::from(pixel[3]) - alpha).abs() < 2e-4, "{name}: {}, not {alpha}", pixel[3]);
        }
    }
}

#[test]
fn a_gaussian_ball_of_constant_extinction_is_a_chord() {
    let n = 61;
    let grid = UniformGrid::new([n; 3], [-30.0; 3], [1.0; 3]).unwrap();
    let field = Field::new(grid, |p| (-p.map(|c| (c - 30.0).powi(2)).iter().sum::<f64>() / 800.0).exp());
    let radius = 20.0f64;
    let level = (-radius * radius / 800.0).exp();
    let scene = Scene {
        camera: along_z(&field, 60.0),
        transfer: opacities(&[(0.0, 0.0), (level, 0.0), (level, 0.03), (1.0, 0.03)]),
        size: [60, 60],
        step_voxels: 0.1,
        ..scene_of(&field, 16, "ramp", false)
    };
    for (name, image) in both(&scene, &field) {
        let mut error_sum = 0.0;
        for (i, pixel) in image.pixels.iter().enumerate() {
            let (x, y) = ((i % 60) as f64 - 29.5, (i / 60) as f64 - 29.5);
            let chord = 2.0 * (radius * radius - x * x - y * y).max(0.0).sqrt();
            let alpha = 1.0 - 0.97f64.powf(chord);
            let error = f64::from(pixel[3]) - alpha;
            error_sum += error;
            // A chord's ends are found to a sample, and near the limb trilinear interpolation moves it by more.
            let is_limb = (x.hypot(y) - radius).abs() < 0.5;
            let bound = if is_limb { 0.1 } else { 0.006 };
            assert!(error.abs() < bound, "{name}: pixel {i} has {}, not {alpha}", pixel[3]);
        }
        // Trilinear interpolation lies below a surface that is curved like a ball: it is drawn a little too small.
        assert!((error_sum / 3600.0).abs() < 5e-4, "{name}: biased by {}", error_sum / 3600.0);
    }
}
