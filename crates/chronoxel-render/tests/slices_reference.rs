//! What drawing slices gives: closed forms, the ray caster's picture, and the polygons drawn over each other.

mod pictures;

use chronoxel_core::{
    Camera, Image, NodeId, Projection, ResolvedTransfer, TransferDomain, TransferFunction, TransferPoint,
    UniformGrid, compositing,
};
use chronoxel_render::slices::{render_slices_reference, render_slices_reference_with};
use chronoxel_render::{
    DenseField, DrawBrick, DrawHow, Scene, SliceList, SliceOrder, Slicer, render, render_reference,
};
use pictures::{Field, Quantise, difference, in_view_order, region_of, scene_of, waves};

fn dense(field: &Field) -> DenseField<'_> {
    DenseField { samples: &field.samples, mask: field.mask.as_deref() }
}

fn opacities(points: &[(f64, f32)]) -> ResolvedTransfer {
    let points =
        points.iter().map(|&(x, opacity)| TransferPoint { x, color: [0.25, 0.5, 1.0], opacity }).collect();
    TransferFunction::new(points, TransferDomain::Data).unwrap().resolve([0.0, 1.0]).unwrap()
}

#[test]
fn slices_along_an_axis_follow_beer_and_lambert() {
    let grid = UniformGrid::new([20, 20, 37], [1.0, 2.0, 3.0], [1.0, 1.0, 0.5]).unwrap();
    let field = Field::new(grid, |_| 0.7);
    let centre = [10.5, 11.5, 12.0];
    for z in [30.0, -10.0] {
        // Planes in both outer faces: the nearer is in the box, the farther is not, and 18 units of path are 36 slices.
        let camera = Camera::new(
            [centre[0], centre[1], z],
            centre,
            [0.0, 1.0, 0.0],
            Projection::Orthographic { height: 10.0 },
        );
        let scene = Scene {
            camera: camera.unwrap(),
            transfer: opacities(&[(0.0, 0.02), (1.0, 0.02)]),
            size: [20, 20],
            opacity_unit: 2.0,
            step_voxels: 1.0,
            ..scene_of(&field, 16, "ramp", false)
        };
        let alpha = 1.0 - 0.98f64.powi(9);
        let image = render_slices_reference(&scene, &dense(&field)).unwrap();
        for pixel in &image.pixels {
            let right = [0.25, 0.5, 1.0, 1.0].map(|c| c * alpha);
            assert!((0..4).all(|i| (f64::from(pixel[i]) - right[i]).abs() < 1e-6), "{pixel:?} {right:?}");
        }
    }
}

#[test]
fn opacity_is_that_of_the_path_between_planes() {
    let grid = UniformGrid::new([65, 65, 33], [0.0; 3], [1.0; 3]).unwrap();
    let field = Field::new(grid, |_| 0.7);
    let projection = Projection::Perspective { fov_y_deg: 60.0 };
    let camera = Camera::new([32.0, 32.0, 52.0], [32.0, 32.0, 0.0], [0.0, 1.0, 0.0], projection).unwrap();
    let scene = Scene {
        camera,
        transfer: opacities(&[(0.0, 0.01), (1.0, 0.01)]),
        size: [41, 41],
        step_voxels: 1.0,
        opacity_unit: 1.0,
        ..scene_of(&field, 16, "ramp", false)
    };
    let image = render_slices_reference(&scene, &dense(&field)).unwrap();
    for (i, pixel) in image.pixels.iter().enumerate() {
        let [x, y] = [i % 41, i / 41].map(|p| (p as f64 - 20.0) / 20.5 * 30f64.to_radians().tan());
        // Rays that leave by the back face cross 32 planes, each a path of the secant of their angle.
        if x.abs().max(y.abs()) * 52.0 < 31.9 {
            let alpha = 1.0 - 0.99f64.powf(32.0 * (1.0 + x * x + y * y).sqrt());
            assert!((f64::from(pixel[3]) - alpha).abs() < 1e-6, "pixel {i}: {}, not {alpha}", pixel[3]);
        }
    }
}

#[test]
fn slices_converge_to_the_ray_caster() {
    let field = waves(UniformGrid::new([41, 33, 50], [-3.0, 10.0, 0.5], [1.0, 0.8, 1.2]).unwrap());
    for (function, lit, fov) in [("filled", true, Some(40.0)), ("ramp", false, None)] {
        let camera = Camera::orbit(field.grid.bounds(), 30.0, 20.0, 1.2, fov, 1.2).unwrap();
        let start = Scene { camera, size: [60, 50], ..scene_of(&field, 16, function, lit) };
        let error = |step_voxels: f64| {
            let scene = Scene { step_voxels, ..start.clone() };
            let (cast, _) = render(&scene, &field.draw_list(&scene, 0, Quantise::PerBrick)).unwrap();
            let sliced = render_slices_reference(&scene, &dense(&field)).unwrap();
            10f64.powf(difference(&sliced, &cast).psnr_db / -20.0)
        };
        let errors = [1.6, 0.8, 0.4, 0.2, 0.1].map(error);
        println!("{function}: errors (root mean square) {errors:?}");
        // The ends of rays are found to half a slice: the error falls with the distance.
        assert!(errors.windows(2).all(|pair| pair[1] < 0.62 * pair[0]), "{function}: {errors:?}");
        assert!(errors[4] < 1.5e-3, "{function}: {errors:?}");
    }
}

/// Bricks of level 0, and of level 1 in some places.
fn mixed_levels(scene: &Scene) -> Vec<DrawBrick> {
    let mut list = Vec::new();
    for octant in 0..8 {
        let node = NodeId::new(2, [0; 3]).child(octant).unwrap();
        let nodes = if [1, 6].contains(&octant) {
            vec![node]
        } else {
            (0..8).filter_map(|o| node.child(o)).collect()
        };
        list.extend(nodes.into_iter().map(|node| {
            let [low, high] = region_of(node, &scene.layout);
            let last = scene.grid.dims.map(|n| (n - 1) as f64);
            let region = [low, std::array::from_fn(|a| high[a].min(last[a]))];
            DrawBrick { node, region, how: DrawHow::Skip }
        }));
    }
    in_view_order(scene, list)
}

/// Polygons in the picture, back to front, each with its slice: what a rasteriser is given.
fn project(scene: &Scene) -> Vec<(i32, Vec<[f64; 2]>)> {
    let distance = scene.step_length();
    let slicer =
        Slicer::of_camera_in_voxels(&scene.camera, &scene.grid, distance, SliceOrder::BackToFront).unwrap();
    let mut list = SliceList::default();
    for brick in mixed_levels(scene).iter().rev() {
        slicer.slice(brick.region, &mut list).unwrap();
    }
    let place = |v: &[f32; 3]| {
        let [x, y, _] =
            scene.camera.project(scene.grid.world_from_voxel(v.map(f64::from)), scene.size).unwrap();
        [x, y]
    };
    (0..list.num_polygons())
        .map(|i| (list.slices()[i], list.polygon(i).iter().map(place).collect()))
        .collect()
}

/// How far a point lies inside a polygon that is counter-clockwise as seen, where y counts downwards.
fn depth_inside(polygon: &[[f64; 2]], [x, y]: [f64; 2]) -> f64 {
    let edges = (0..polygon.len()).map(|i| (polygon[i], polygon[(i + 1) % polygon.len()]));
    let inside = edges.filter_map(|(a, b)| {
        let length = (b[0] - a[0]).hypot(b[1] - a[1]);
        let turn = (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]);
        (length > 1e-9).then(|| -turn / length)
    });
    inside.fold(f64::INFINITY, f64::min)
}

/// The colour where a pixel's ray meets a slice, for a field that is linear in the voxel coordinates.
fn sample(scene: &Scene, at: impl Fn([f64; 3]) -> f64, centre: [f64; 2], slice: i32) -> [f64; 4] {
    let ray = scene.camera.ray(centre, scene.size);
    let [_, _, forward] = scene.camera.axes();
    let cosine: f64 = (0..3).map(|a| forward[a] * ray.direction[a]).sum();
    let t = f64::from(slice) * scene.step_length() / cosine;
    let world = std::array::from_fn(|a| ray.origin[a] + t * ray.direction[a]);
    let [r, g, b, opacity] = scene.transfer.evaluate(at(scene.grid.voxel_from_world(world)));
    let alpha = compositing::correct_opacity(opacity, scene.step_length() / cosine, scene.opacity_unit);
    [alpha * r, alpha * g, alpha * b, alpha]
}

#[test]
fn polygons_drawn_over_each_other_are_the_reference() {
    let grid = UniformGrid::new([31, 30, 29], [5.0, -3.0, 1.0], [1.0, 0.7, 1.3]).unwrap();
    let at = |[x, y, z]: [f64; 3]| 0.5 * x + 0.3 * y + 0.2 * z;
    let field = Field::new(grid, at);
    let outside =
        [Some(45.0), None].map(|fov| Camera::orbit(grid.bounds(), 33.0, 21.0, 1.1, fov, 1.2).unwrap());
    let eye = grid.world_from_voxel([12.3, 13.1, 14.7]);
    let projection = Projection::Perspective { fov_y_deg: 70.0 };
    let inside = Camera::new(eye, grid.bounds()[1], [0.0, 1.0, 0.0], projection).unwrap();
    for camera in [outside[0], outside[1], inside] {
        let scene = Scene { camera, size: [48, 40], step_voxels: 1.1, ..scene_of(&field, 8, "ramp", false) };
        let reference = render_slices_reference(&scene, &dense(&field)).unwrap();
        let polygons = project(&scene);
        let (mut num_compared, mut num_on_borders) = (0, 0);
        for (i, right) in reference.pixels.iter().enumerate() {
            let centre = [(i % 48) as f64 + 0.5, (i / 48) as f64 + 0.5];
            let depths: Vec<f64> = polygons.iter().map(|(_, p)| depth_inside(p, centre)).collect();
            if depths.iter().any(|depth| depth.abs() < 1e-4) {
                num_on_borders += 1;
                continue;
            }
            let covering = (0..polygons.len()).filter(|&p| depths[p] > 0.0).map(|p| polygons[p].0);
            let covering: Vec<i32> = covering.collect();
            assert!(covering.windows(2).all(|pair| pair[0] == pair[1] + 1), "pixel {i}: {covering:?}");
            let drawn = covering.iter().fold([0.0; 4], |behind, &slice| {
                let front = sample(&scene, at, centre, slice);
                std::array::from_fn(|c| front[c] + (1.0 - front[3]) * behind[c])
            });
            assert!((0..4).all(|c| (drawn[c] - f64::from(right[c])).abs() < 1e-6), "{drawn:?} {right:?}");
            num_compared += usize::from(right[3] > 0.0);
        }
        assert!(num_compared > 700 && num_on_borders < 60, "{num_compared} {num_on_borders}");
    }
}

#[test]
fn a_draw_list_takes_the_place_of_samples() {
    let field = waves(UniformGrid::new([33, 33, 33], [0.0; 3], [1.0; 3]).unwrap());
    let scene = Scene { size: [40, 40], ..scene_of(&field, 16, "filled", true) };
    let list = |how: &dyn Fn(usize) -> DrawHow| -> Vec<DrawBrick> {
        let bricks =
            mixed_levels(&Scene { layout: chronoxel_core::BrickLayout::new(8).unwrap(), ..scene.clone() });
        bricks.into_iter().enumerate().map(|(i, b)| DrawBrick { how: how(i), ..b }).collect()
    };
    let drawn = |bricks: &[DrawBrick]| render_slices_reference_with(&scene, &dense(&field), bricks).unwrap();
    let blank = Image::new(40, 40).unwrap();
    assert_eq!(drawn(&list(&|_| DrawHow::Skip)).pixels, blank.pixels);
    let constants = list(&|i| DrawHow::Constant(1000.0 * i as f64));
    let cast = chronoxel_render::render_reference_with(&scene, &dense(&field), &constants).unwrap();
    let found = difference(&drawn(&constants), &cast);
    assert!(found.psnr_db > 35.0, "{found:?}");
    let field_alone = difference(&render_reference(&scene, &dense(&field)).unwrap(), &cast);
    assert!(field_alone.psnr_db < 30.0, "the constants must matter: {field_alone:?}");
}

#[test]
fn fields_of_another_size_are_refused() {
    let field = waves(UniformGrid::new([9, 9, 9], [0.0; 3], [1.0; 3]).unwrap());
    let scene = scene_of(&field, 8, "ramp", false);
    let short = DenseField { samples: &field.samples[1..], mask: None };
    let message = render_slices_reference(&scene, &short).unwrap_err().to_string();
    assert!(message.contains("728"), "{message}");
}
