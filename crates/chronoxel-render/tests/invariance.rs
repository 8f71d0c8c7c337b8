//! What must not change a pixel: threads, tiles, instructions, and how a field is cut into bricks.

mod pictures;

use chronoxel_core::{BrickLayout, Camera, UniformGrid};
use chronoxel_render::{CpuOptions, Scene, render, render_with};
use pictures::{Field, Quantise, assert_identical, scene_of, waves};

fn field() -> Field {
    let mut field = waves(UniformGrid::new([50, 44, 57], [0.0; 3], [1.0, 1.5, 0.75]).unwrap());
    field.mask = Some(field.samples.iter().map(|s| s % 97.0 == 0.0).collect());
    field
}

/// Each built-in function, unlit and lit, in perspective and orthographic.
fn scenes(field: &Field, edge: usize) -> Vec<(String, Scene)> {
    let mut scenes = Vec::new();
    for function in ["ramp", "sparse", "filled"] {
        for lit in [false, true] {
            for fov in [Some(35.0), None] {
                let camera = Camera::orbit(field.grid.bounds(), 37.0, 22.0, 1.1, fov, 1.2).unwrap();
                let scene = Scene { camera, ..scene_of(field, edge, function, lit) };
                scenes.push((format!("{function} lit {lit} fov {fov:?}"), scene));
            }
        }
    }
    scenes
}

#[test]
fn threads() {
    let field = field();
    for (name, scene) in scenes(&field, 16) {
        let list = field.draw_list(&scene, 0, Quantise::PerBrick);
        let with_threads = |n| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
            pool.install(|| render(&scene, &list).unwrap().0)
        };
        let one = with_threads(1);
        assert_identical(&format!("2 threads {name}"), &with_threads(2), &one);
        assert_identical(&format!("4 threads {name}"), &with_threads(4), &one);
    }
}

#[test]
fn tiles_and_instructions() {
    let field = field();
    for (name, scene) in scenes(&field, 16) {
        let list = field.draw_list(&scene, 0, Quantise::PerBrick);
        let with = |tile_edge, plain| render_with(&scene, &list, &CpuOptions { tile_edge, plain }).unwrap();
        let (expected, stats) = with(16, false);
        for (tile_edge, plain) in [(8, false), (40, false), (1024, false), (16, true)] {
            let (actual, other_stats) = with(tile_edge, plain);
            assert_identical(&format!("tiles {tile_edge} plain {plain} {name}"), &actual, &expected);
            assert_eq!(other_stats.num_samples, stats.num_samples);
        }
    }
}

/// Whole numbers up to 65535 lose nothing in any brick, so that bricks of every size hold the same field.
#[test]
fn bricks_leave_no_seam() {
    let field = field();
    for (name, whole) in scenes(&field, 64) {
        let one_brick = field.draw_list(&whole, 0, Quantise::Exact);
        assert_eq!(one_brick.len(), 1);
        let (expected, _) = render(&whole, &one_brick).unwrap();
        for edge in [8, 16, 32] {
            let scene = Scene { layout: BrickLayout::new(edge).unwrap(), ..whole.clone() };
            let (actual, _) = render(&scene, &field.draw_list(&scene, 0, Quantise::Exact)).unwrap();
            assert_identical(&format!("bricks of {edge} {name}"), &actual, &expected);
        }
    }
}

#[test]
fn a_coarser_level_is_a_march_with_a_longer_step() {
    let field = waves(UniformGrid::new([65, 65, 65], [0.0; 3], [1.0; 3]).unwrap());
    let scene = scene_of(&field, 16, "filled", true);
    let (coarse, stats) = render(&scene, &field.draw_list(&scene, 1, Quantise::Exact)).unwrap();
    let [nx, ny] = [65, 65 * 65];
    let every_second = |i: usize| 2 * (i % 33 + nx * (i / 33 % 33) + ny * (i / (33 * 33)));
    let half = Field {
        grid: UniformGrid::new([33; 3], [0.0; 3], [2.0; 3]).unwrap(),
        samples: (0..33 * 33 * 33).map(|i| field.samples[every_second(i)]).collect(),
        mask: None,
    };
    let half_scene = Scene { grid: half.grid, ..scene.clone() };
    let (expected, half_stats) =
        render(&half_scene, &half.draw_list(&half_scene, 0, Quantise::Exact)).unwrap();
    assert!(stats.num_samples.abs_diff(half_stats.num_samples) < half_stats.num_samples / 50);
    // Rounding the number of samples in two places may add or drop a ray's last.
    pictures::assert_similar("level 1", &coarse, &expected, 50.0, 250);
}
