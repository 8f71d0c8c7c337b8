//! Constants among bricks: inner nodes of the tree that are drawn in one colour.

mod pictures;

use chronoxel_core::{Camera, NodeId, Projection, UniformGrid, octree::levels_of};
use chronoxel_render::{
    DenseField, DrawBrick, DrawHow, Scene, render, render_reference, render_reference_with,
};
use pictures::{Field, Quantise, assert_identical, assert_similar, difference, in_view_order, region_of};
use pictures::{scene_of, waves};

/// Inner nodes of bricks of 8³, one of level 2 and two of level 1, and how they are drawn.
fn inner_nodes() -> [(NodeId, DrawHow); 3] {
    [
        (NodeId::new(2, [0, 0, 1]), DrawHow::ConstantColor([0.9, 0.4, 0.1], 0.08)),
        (NodeId::new(1, [2, 1, 1]), DrawHow::Constant(36_000.0)),
        (NodeId::new(1, [1, 2, 0]), DrawHow::ConstantColor([0.1, 0.8, 0.7], 0.15)),
    ]
}

fn contains(outer: [[f64; 3]; 2], inner: [[f64; 3]; 2]) -> bool {
    (0..3).all(|a| outer[0][a] <= inner[0][a] && inner[1][a] <= outer[1][a])
}

/// Bricks of level 0, and the inner nodes in place of those inside them: as they are, and as bricks of level 0.
fn mixed_lists(scene: &Scene, field: &Field) -> [Vec<DrawBrick>; 2] {
    let inner =
        inner_nodes().map(|(node, how)| DrawBrick { node, region: region_of(node, &scene.layout), how });
    let inside = |brick: &DrawBrick| inner.iter().find(|inner| contains(inner.region, brick.region));
    let bricks = field.draw_list(scene, 0, Quantise::PerBrick);
    let mut whole: Vec<_> = bricks.iter().filter(|brick| inside(brick).is_none()).cloned().collect();
    whole.extend(inner.iter().cloned());
    let cut = bricks.iter().map(|brick| {
        let how = inside(brick).map_or_else(|| brick.how.clone(), |inner| inner.how.clone());
        DrawBrick { how, ..brick.clone() }
    });
    [in_view_order(scene, whole), cut.collect()]
}

fn field() -> Field {
    waves(UniformGrid::new([45, 39, 64], [0.0; 3], [1.0, 1.5, 0.75]).unwrap())
}

/// Thin enough that no ray ends early: where one does depends on how a box is cut.
fn scenes(field: &Field) -> Vec<(String, Scene)> {
    let mut scenes = Vec::new();
    for (function, lit, fov) in [
        ("ramp", false, Some(35.0)),
        ("filled", true, Some(35.0)),
        ("sparse", false, None),
        ("ramp", true, None),
    ] {
        for (azimuth, step_voxels) in [(37.0, 0.5), (200.0, 0.7)] {
            let camera = Camera::orbit(field.grid.bounds(), azimuth, 22.0, 1.1, fov, 1.2).unwrap();
            let thin = Scene { camera, step_voxels, opacity_unit: 4.0, ..scene_of(field, 8, function, lit) };
            scenes.push((format!("{function} lit {lit} fov {fov:?} azimuth {azimuth}"), thin));
        }
    }
    scenes
}

#[test]
fn an_inner_node_is_its_bricks_of_level_0() {
    let field = field();
    for (name, scene) in scenes(&field) {
        let [whole, cut] = mixed_lists(&scene, &field);
        let ((actual, stats), (expected, cut_stats)) =
            (render(&scene, &whole).unwrap(), render(&scene, &cut).unwrap());
        assert_eq!((stats.bricks_constant, cut_stats.bricks_constant), (3, 76), "{name}");
        assert!(expected.pixels.iter().all(|p| p[3] < 0.99), "{name}: rays end early");
        let found = difference(&actual, &expected);
        assert!(found.max <= 1e-6, "{name}: {found:?}");
        // With steps of its own level, an inner node loses samples to its neighbours or takes them twice.
        let coarse = Scene { finest_level: 2, ..scene };
        assert!(difference(&render(&coarse, &whole).unwrap().0, &expected).max > 1e-3, "{name}");
    }
}

#[test]
fn the_reference_agrees() {
    let field = field();
    for (name, scene) in scenes(&field) {
        let [whole, cut] = mixed_lists(&scene, &field);
        let dense = DenseField { samples: &field.samples, mask: None };
        let expected = render_reference_with(&scene, &dense, &whole).unwrap();
        assert_identical(&name, &render_reference_with(&scene, &dense, &cut).unwrap(), &expected);
        assert_similar(&format!("constants {name}"), &render(&scene, &whole).unwrap().0, &expected, 60.0, 0);
        let without = render_reference(&scene, &dense).unwrap();
        assert!(difference(&without, &expected).num_failed > 1000, "{name}: constants must matter");
    }
}

/// A list that shows nothing but a box of one colour, which is a node of level 2.
fn one_box(field: &Field, scene: &Scene, node: NodeId, how: DrawHow) -> Vec<DrawBrick> {
    let region = region_of(node, &scene.layout);
    let bricks = levels_of(&field.grid, &scene.layout)[0].bricks;
    let list = (0..bricks.iter().product::<usize>()).map(|i| {
        let at = [i % bricks[0], i / bricks[0] % bricks[1], i / (bricks[0] * bricks[1])];
        let node = NodeId::new(0, at.map(|b| b as u32));
        DrawBrick { node, region: region_of(node, &scene.layout), how: DrawHow::Skip }
    });
    let mut list: Vec<_> = list.filter(|brick| !contains(region, brick.region)).collect();
    list.push(DrawBrick { node, region, how });
    in_view_order(scene, list)
}

#[test]
fn a_box_of_one_color_is_crossed_exactly() {
    // Seen from z = 100 along -z, rays enter at z = 99; the box is [32, 64) in every axis and fills the picture.
    let grid = UniformGrid::new([100; 3], [0.0; 3], [1.0; 3]).unwrap();
    let field = Field::new(grid, |_| 0.5);
    let projection = Projection::Orthographic { height: 20.0 };
    let camera = Camera::new([48.0, 48.0, 100.0], [48.0; 3], [0.0, 1.0, 0.0], projection).unwrap();
    let node = NodeId::new(2, [1; 3]);
    for (step_voxels, opacity, lit) in
        [(0.5, 0.03f32, false), (0.83, 0.2, true), (1.7, 0.06, false), (0.7, 1.0, true)]
    {
        let start = scene_of(&field, 8, "ramp", lit);
        let scene = Scene { camera, size: [40, 30], step_voxels, opacity_unit: 2.5, ..start };
        let list = one_box(&field, &scene, node, DrawHow::ConstantColor([0.25, 0.5, 1.0], opacity));
        // Samples of level 0 that lie in the box.
        let lies_within = |k: &i32| (32.0..64.0).contains(&(99.0 - (f64::from(*k) + 0.5) * step_voxels));
        let num_samples = (0..200).filter(lies_within).count() as f64;
        let alpha = 1.0 - (1.0 - f64::from(opacity)).powf(num_samples * step_voxels / 2.5);
        let dense = DenseField { samples: &field.samples, mask: None };
        let images = [
            ("ray caster", render(&scene, &list).unwrap().0),
            ("reference", render_reference_with(&scene, &dense, &list).unwrap()),
        ];
        for (name, image) in images {
            for pixel in &image.pixels {
                let expected = [0.25, 0.5, 1.0, 1.0].map(|c| c * alpha);
                let off =
                    pixel.iter().zip(expected).map(|(p, e)| (f64::from(*p) - e).abs()).fold(0.0, f64::max);
                assert!(off < 1e-6, "{name}, step {step_voxels}: {pixel:?}, not {expected:?}");
            }
        }
    }
}
