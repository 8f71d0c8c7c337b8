//! Tetrahedra: closed forms, and the fast renderer against the reference.

use std::sync::Arc;

use chronoxel_core::{
    Background, Camera, Image, Image8, Projection, TransferDomain, TransferFunction, TransferPoint, compare,
};
use chronoxel_render::{
    CellMesh, CellOptions, CellRenderer, CellScene, CellStats, FaceChoice, FaceOrder, Variation,
    render_cells_reference, static_importance,
};

mod cell_meshes;
use cell_meshes::{lattice, scene, twisted, waves};

fn fast(mesh: &Arc<CellMesh>, scene: &CellScene, values: &[f32], k: usize) -> (Image, CellStats) {
    let options = CellOptions { k, plain: false };
    CellRenderer::new(Arc::clone(mesh), options).unwrap().render(scene, values).unwrap()
}

fn psnr(a: &Image, b: &Image) -> f64 {
    let [a, b] = [a, b].map(|image| Image8::from_image(image, Background::default()));
    compare(&a, &b).unwrap().psnr_db
}

fn largest_difference(a: &Image, b: &Image) -> f32 {
    let pairs = a.pixels.iter().flatten().zip(b.pixels.iter().flatten());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

/// A gray function of constant opacity.
fn constant_fog(scene: &mut CellScene, opacity: f32) {
    let point = TransferPoint { x: 0.0, color: [1.0, 0.5, 0.25], opacity };
    let function = TransferFunction::new(vec![point], TransferDomain::Data).unwrap();
    scene.transfer = function.resolve([0.0, 1.0]).unwrap();
}

fn straight(p: [f64; 3]) -> [f64; 3] {
    p
}

/// Length of a pixel's ray in the box between two corners.
fn length_in_box(scene: &CellScene, pixel: usize, [low, high]: [[f64; 3]; 2]) -> f64 {
    let centre = [(pixel % scene.size[0]) as f64 + 0.5, (pixel / scene.size[0]) as f64 + 0.5];
    let ray = scene.camera.ray(centre, scene.size);
    let (mut entry, mut exit) = (0.0f64, f64::INFINITY);
    for a in 0..3 {
        let [t0, t1] = [low[a], high[a]].map(|plane| (plane - ray.origin[a]) / ray.direction[a]);
        entry = entry.max(t0.min(t1));
        exit = exit.min(t0.max(t1));
    }
    (exit - entry).max(0.0)
}

#[test]
fn fog_in_a_box_has_the_opacity_of_each_rays_length() {
    let mesh = Arc::new(lattice([3, 4, 2], straight, |_| true));
    let values = vec![0.5; mesh.num_points()];
    for fov in [Some(40.0), None] {
        let mut scene = scene(&mesh, "filled", [48, 40], fov, false);
        constant_fog(&mut scene, 0.03);
        let exact = render_cells_reference(&mesh, &scene, &values).unwrap();
        let (found, stats) = fast(&mesh, &scene, &values, 16);
        assert_eq!(stats.num_misordered, 0);
        for i in 0..found.pixels.len() {
            let length = length_in_box(&scene, i, [[0.0; 3], [1.0; 3]]);
            let alpha = 1.0 - 0.97f64.powf(length / scene.opacity_unit);
            assert!((f64::from(exact.pixels[i][3]) - alpha).abs() < 1e-6, "{i}");
            // Corners are rounded to 2^-18 of a pixel's place: the ray is a bit longer or shorter.
            assert!(
                (f64::from(found.pixels[i][3]) - alpha).abs() < 2e-4,
                "{i} {:?} {alpha}",
                found.pixels[i]
            );
            assert!((f64::from(found.pixels[i][1]) - alpha * 0.5).abs() < 2e-4);
        }
    }
}

#[test]
fn the_space_in_a_hole_and_in_a_bay_is_empty() {
    // A frame around a hole along z, and a bay on the side of x = 1.
    let is_out = |[x, y, _]: [usize; 3]| (x == 2 && y == 2) || (x >= 3 && y == 0);
    let mesh = Arc::new(lattice([5, 5, 3], straight, |cell| !is_out(cell)));
    let values = vec![0.5; mesh.num_points()];
    for fov in [Some(50.0), None] {
        let mut scene = scene(&mesh, "filled", [64, 64], fov, false);
        constant_fog(&mut scene, 0.03);
        let (found, _) = fast(&mesh, &scene, &values, 16);
        let exact = render_cells_reference(&mesh, &scene, &values).unwrap();
        for i in 0..found.pixels.len() {
            let hole = length_in_box(&scene, i, [[0.4, 0.4, 0.0], [0.6, 0.6, 1.0]]);
            let bay = length_in_box(&scene, i, [[0.6, 0.0, 0.0], [1.0, 0.2, 1.0]]);
            let length = length_in_box(&scene, i, [[0.0; 3], [1.0; 3]]) - hole - bay;
            let alpha = 1.0 - 0.97f64.powf(length / scene.opacity_unit);
            assert!((f64::from(exact.pixels[i][3]) - alpha).abs() < 1e-6, "{i}");
            assert!(
                (f64::from(found.pixels[i][3]) - alpha).abs() < 3e-4,
                "{i} {:?} {alpha}",
                found.pixels[i]
            );
        }
    }
}

#[test]
fn blocks_that_touch_without_sharing_points_are_one() {
    // Two boxes with points of their own in the plane x = 1/2.
    let half = |from: f64| move |[x, y, z]: [f64; 3]| [from + 0.5 * x, y, z];
    let (mut points, mut cells) = (Vec::new(), Vec::new());
    for from in [0.0, 0.5] {
        let first = points.len() as u32;
        points.extend((0..8).map(|i| half(from)([i & 1, i >> 1 & 1, i >> 2].map(f64::from))));
        let five = [[0, 1, 2, 4], [1, 2, 3, 7], [1, 4, 5, 7], [2, 4, 6, 7], [1, 2, 4, 7]];
        cells.extend(five.map(|cell: [u32; 4]| cell.map(|p| p + first)));
    }
    let mesh = Arc::new(CellMesh::new(points, &cells).unwrap());
    let mut scene = scene(&mesh, "filled", [40, 40], Some(30.0), false);
    constant_fog(&mut scene, 0.02);
    let (found, _) = fast(&mesh, &scene, &[1.0; 16], 6);
    for (i, pixel) in found.pixels.iter().enumerate() {
        let length = length_in_box(&scene, i, [[0.0; 3], [1.0; 3]]);
        let alpha = 1.0 - 0.98f64.powf(length / scene.opacity_unit);
        assert!((f64::from(pixel[3]) - alpha).abs() < 2e-4, "{i} {pixel:?} {alpha}");
    }
}

#[test]
fn a_linear_field_is_its_integral_along_each_ray() {
    let mesh = Arc::new(lattice([4, 3, 5], straight, |_| true));
    let value = |p: [f64; 3]| 0.1 + 0.5 * p[0] + 0.3 * p[1] - 0.05 * p[2];
    let values: Vec<f32> = (0..6 * 4 * 5)
        .map(|i| value([(i % 5) as f64 / 4.0, (i / 5 % 4) as f64 / 3.0, (i / 20) as f64 / 5.0]) as f32)
        .collect();
    let scene = scene(&mesh, "filled", [24, 24], Some(35.0), false);
    let exact = render_cells_reference(&mesh, &scene, &values).unwrap();
    let (found, _) = fast(&mesh, &scene, &values, 16);
    for i in 0..exact.pixels.len() {
        let centre = [(i % 24) as f64 + 0.5, (i / 24) as f64 + 0.5];
        let ray = scene.camera.ray(centre, scene.size);
        let (mut entry, mut exit) = (0.0f64, f64::INFINITY);
        for a in 0..3 {
            let [t0, t1] = [0.0, 1.0].map(|plane| (plane - ray.origin[a]) / ray.direction[a]);
            (entry, exit) = (entry.max(t0.min(t1)), exit.min(t0.max(t1)));
        }
        // A thousand samples, each of its own opacity.
        let (mut pixel, dt) = ([0.0f64; 4], (exit - entry) / 1000.0);
        for k in 0..if exit > entry { 1000 } else { 0 } {
            let t = entry + (f64::from(k) + 0.5) * dt;
            let [r, g, b, opacity] =
                scene.transfer.evaluate(value([0, 1, 2].map(|a| ray.origin[a] + t * ray.direction[a])));
            let alpha = 1.0 - (1.0 - opacity).powf(dt / scene.opacity_unit);
            let transmittance = 1.0 - pixel[3];
            let sample = [r * alpha, g * alpha, b * alpha, alpha];
            pixel.iter_mut().zip(sample).for_each(|(sum, s)| *sum += transmittance * s);
        }
        for (c, expected) in pixel.into_iter().enumerate() {
            let [exact, found] = [&exact, &found].map(|image| f64::from(image.pixels[i][c]));
            assert!((exact - expected).abs() < 1e-4, "{i} {c}: {exact} {expected}");
            // Values are rounded to 255 numbers at every face, and colours change fast.
            assert!((found - expected).abs() < 1e-2, "{i} {c}: {found} {expected}");
        }
    }
}

#[test]
fn the_fast_picture_is_the_reference() {
    let num = [12, 10, 11];
    let mesh = Arc::new(twisted(num));
    let values = waves(num, 0.3);
    for (function, fov, lit) in [
        ("filled", Some(30.0), false),
        ("sparse", Some(30.0), false),
        ("ramp", None, false),
        ("filled", Some(60.0), true),
        ("sparse", None, true),
    ] {
        let scene = scene(&mesh, function, [96, 96], fov, lit);
        let exact = render_cells_reference(&mesh, &scene, &values).unwrap();
        for k in [2, 6, 16] {
            let (found, stats) = fast(&mesh, &scene, &values, k);
            let psnr = psnr(&exact, &found);
            println!(
                "{function} {fov:?} lit {lit} k {k}: {psnr:.1} dB, {} of {} fragments misordered, largest {}",
                stats.num_misordered,
                stats.num_fragments,
                largest_difference(&exact, &found)
            );
            assert!(k < 16 || stats.num_misordered == 0);
            assert!(psnr >= if k == 2 { 25.0 } else { 40.0 });
        }
    }
}

#[test]
fn cameras_inside_see_what_is_in_front() {
    let num = [8, 8, 8];
    let mesh = Arc::new(lattice(num, straight, |[x, y, z]| (x, y, z) != (5, 4, 4)));
    let values = waves(num, 1.0);
    let cameras = [
        (Projection::Perspective { fov_y_deg: 70.0 }, [0.31, 0.42, 0.53]),
        (Projection::Perspective { fov_y_deg: 40.0 }, [0.69, 0.55, 0.55]),
        (Projection::Orthographic { height: 1.5 }, [0.31, 0.42, 0.53]),
    ];
    for (projection, position) in cameras {
        let mut scene = scene(&mesh, "filled", [64, 64], None, false);
        scene.camera = Camera::new(position, [1.0, 0.6, 0.7], [0.0, 1.0, 0.0], projection).unwrap();
        let exact = render_cells_reference(&mesh, &scene, &values).unwrap();
        let (found, stats) = fast(&mesh, &scene, &values, 16);
        let psnr = psnr(&exact, &found);
        println!("{projection:?}: {psnr:.1} dB {}", largest_difference(&exact, &found));
        assert!(psnr > 40.0);
        assert_eq!(stats.num_misordered, 0);
    }
}

#[test]
fn missing_values_leave_their_cells_out() {
    let num = [6, 6, 6];
    let mesh = Arc::new(twisted(num));
    let mut values = waves(num, 0.0);
    values[170] = f32::NAN;
    let scene = scene(&mesh, "filled", [64, 64], Some(30.0), false);
    let exact = render_cells_reference(&mesh, &scene, &values).unwrap();
    let (found, _) = fast(&mesh, &scene, &values, 16);
    let psnr = psnr(&exact, &found);
    assert!(psnr > 40.0, "{psnr}");
}

#[test]
fn neither_threads_nor_instructions_nor_what_was_drawn_before_change_a_bit() {
    let num = [9, 8, 10];
    let mesh = Arc::new(twisted(num));
    let first = scene(&mesh, "filled", [90, 70], Some(30.0), true);
    let second = CellScene { camera: first.camera.turned(50.0).unwrap(), ..first.clone() };
    let values = waves(num, 0.5);
    let draw = |threads: usize, plain: bool| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut renderer = CellRenderer::new(Arc::clone(&mesh), CellOptions { k: 6, plain }).unwrap();
        pool.install(|| {
            let a = renderer.render(&first, &values).unwrap().0;
            let b = renderer.render(&second, &waves(num, 0.6)).unwrap().0;
            let (c, stats) = renderer.render(&first, &values).unwrap();
            assert!(stats.view_changed && !stats.table_changed);
            let (_, stats) = renderer.render(&first, &values).unwrap();
            assert!(!stats.view_changed);
            assert_eq!(a.pixels, c.pixels);
            [a, b]
        })
    };
    let found = draw(1, false);
    assert_eq!(found, draw(3, false));
    assert_eq!(found, draw(2, true));
}

#[test]
fn long_cells_are_drawn_in_order() {
    // Towards one corner cells become a thousand times longer than wide: their centroids say little about what is in front.
    let num = [14, 14, 14];
    let long = |[x, y, z]: [f64; 3]| [4.0 * x.powi(4), y.powi(4), z.powi(4)];
    let mesh = Arc::new(lattice(num, long, |_| true));
    let values = waves(num, 0.4);
    for fov in [None, Some(50.0)] {
        for turn in 0..12 {
            let first = scene(&mesh, "ramp", [96, 96], fov, false);
            let camera = first.camera.turned(29.0 * f64::from(turn)).unwrap();
            let (_, stats) = fast(&mesh, &CellScene { camera, ..first }, &values, 2);
            assert_eq!(stats.num_misordered, 0, "{turn} {fov:?}: of {}", stats.num_fragments);
        }
    }
}

#[test]
fn fewer_faces_come_close_and_keep_the_boundary() {
    let num = [12, 10, 11];
    let mesh = Arc::new(twisted(num));
    let mut variation = Variation::new(mesh.num_points());
    (0..16).for_each(|t| variation.push(&waves(num, f64::from(t) * 0.1)));
    let importance = variation.importance(&mesh, [0.0, 1.0]);
    let scene = scene(&mesh, "filled", [96, 96], Some(30.0), false);
    let values = waves(num, 0.8);
    let mut renderer = CellRenderer::new(Arc::clone(&mesh), CellOptions::default()).unwrap();
    let all = renderer.render(&scene, &values).unwrap().0;
    for importance in [&importance, &static_importance(&mesh, &values, 1)] {
        let order = FaceOrder::by_importance(&mesh, importance);
        let choice = order.choose(0.5).unwrap();
        let num_inner = (0.5 * order.num_inner() as f64).round() as usize;
        assert_eq!(choice.num_faces(), mesh.num_boundary_faces() + num_inner);
        renderer.choose(Some(choice));
        let (some, _) = renderer.render(&scene, &values).unwrap();
        let found = psnr(&all, &some);
        println!("{found:.1} dB");
        assert!(found > 20.0 && found.is_finite());
        // Between the boundary's faces a ray is as long as ever.
        let outline = |image: &Image| image.pixels.iter().map(|p| p[3] > 0.0).collect::<Vec<_>>();
        assert_eq!(outline(&some), outline(&all));
    }
}

/// A blob that runs around in one half of a mesh of which the rest hardly changes.
fn running_blob(num: [usize; 3], time: f64) -> Vec<f32> {
    let [nx, ny, nz] = num.map(|n| n + 1);
    let centre = [0.28 + 0.12 * time.cos(), 0.5 + 0.3 * time.sin(), 0.5 + 0.2 * (2.0 * time).sin()];
    let value = move |place: [f64; 3]| {
        let squared: f64 = (0..3).map(|a| (place[a] - centre[a]).powi(2)).sum();
        (0.15 + 0.1 * place[0] + 0.75 * (-squared / 0.015).exp()) as f32
    };
    let place = move |x: usize, y: usize, z: usize| {
        [x as f64 / nx as f64, y as f64 / ny as f64, z as f64 / nz as f64]
    };
    (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| value(place(x, y, z))))).collect()
}

#[test]
fn faces_that_vary_over_time_are_worth_more_than_those_of_one_step() {
    let num = [24, 24, 24];
    let mesh = Arc::new(twisted(num));
    let times: Vec<f64> = (0..32).map(|t| f64::from(t) * 0.2).collect();
    let mut variation = Variation::new(mesh.num_points());
    times.iter().for_each(|&time| variation.push(&running_blob(num, time)));
    let scene = scene(&mesh, "ramp", [128, 128], Some(30.0), false);
    let mut renderer = CellRenderer::new(Arc::clone(&mesh), CellOptions::default()).unwrap();
    let mut draw = |choice: Option<FaceChoice>| -> Vec<Image8> {
        renderer.choose(choice);
        let picture = |time: &f64| renderer.render(&scene, &running_blob(num, *time)).unwrap().0;
        times.iter().step_by(6).map(picture).map(|i| Image8::from_image(&i, Background::default())).collect()
    };
    let all = draw(None);
    let orders = [
        variation.order(&mesh, [0.0, 1.0]),
        FaceOrder::by_importance(&mesh, &variation.importance(&mesh, [0.0, 1.0])),
        FaceOrder::by_importance(&mesh, &static_importance(&mesh, &running_blob(num, 0.0), 1)),
    ];
    for fraction in [0.05, 0.1, 0.25] {
        let [spread, most, by_one_step] = [0, 1, 2].map(|i| -> f64 {
            let some = draw(orders[i].choose(fraction));
            some.iter().zip(&all).map(|(a, b)| compare(a, b).unwrap().luv_mean).sum::<f64>()
                / all.len() as f64
        });
        println!("{fraction}: L*u*v* {spread:.3}, most important {most:.3}, by one step {by_one_step:.3}");
        assert!(spread < by_one_step && spread < most);
    }
}

#[test]
fn what_cannot_be_drawn_is_refused() {
    let mesh = Arc::new(twisted([2, 2, 2]));
    let good = scene(&mesh, "filled", [8, 8], None, false);
    let mut renderer = CellRenderer::new(Arc::clone(&mesh), CellOptions::default()).unwrap();
    assert!(renderer.render(&good, &[0.0; 27]).is_ok());
    assert!(renderer.render(&good, &[0.0; 26]).is_err());
    assert!(renderer.render(&CellScene { opacity_unit: 0.0, ..good.clone() }, &[0.0; 27]).is_err());
    assert!(renderer.render(&CellScene { value_range: [1.0, 0.0], ..good.clone() }, &[0.0; 27]).is_err());
    assert!(CellRenderer::new(mesh, CellOptions { k: 5, plain: false }).is_err());
}
