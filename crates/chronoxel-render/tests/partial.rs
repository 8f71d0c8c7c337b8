//! Pictures from partial images: what was recorded is drawn again, and nothing else changes.

mod pictures;

use std::ops::Range;
use std::sync::Arc;

use chronoxel_core::{Camera, Image, NodeId, Projection, UniformGrid};
use chronoxel_render::{CpuOptions, DrawBrick, DrawHow, Frame, PartialImage, RenderStats, Scene, render};
use pictures::{Field, Quantise, assert_identical, difference, in_view_order, region_of, scene_of, waves};

/// With a mask, and sizes of picture and grid that are no multiples of packets, tiles and bricks.
fn field() -> Field {
    let mut field = waves(UniformGrid::new([50, 44, 57], [0.0; 3], [1.0, 1.5, 0.75]).unwrap());
    field.mask = Some(field.samples.iter().map(|s| s % 97.0 == 0.0).collect());
    field
}

/// Each built-in function, unlit and lit, in perspective and orthographic.
fn scenes(field: &Field) -> Vec<(String, Scene)> {
    let mut scenes = Vec::new();
    for function in ["ramp", "sparse", "filled"] {
        for lit in [false, true] {
            for fov in [Some(35.0), None] {
                let camera = Camera::orbit(field.grid.bounds(), 37.0, 22.0, 1.1, fov, 1.2).unwrap();
                let scene = Scene { camera, size: [109, 83], ..scene_of(field, 16, function, lit) };
                scenes.push((format!("{function} lit {lit} fov {fov:?}"), scene));
            }
        }
    }
    scenes
}

/// Bricks of levels 0 and 1, a constant, and a constant colour.
fn mixed_list(scene: &Scene, field: &Field) -> Vec<DrawBrick> {
    let (coarse, constant) = (NodeId::new(1, [0, 1, 0]), NodeId::new(1, [1, 0, 1]));
    let kept = field.draw_list(scene, 0, Quantise::PerBrick).into_iter().filter(|brick| {
        let parent = brick.node.parent();
        parent != coarse && parent != constant
    });
    let mut list: Vec<_> = kept.collect();
    list.push(field.draw_brick(scene, coarse, region_of(coarse, &scene.layout), Quantise::PerBrick));
    let how = DrawHow::ConstantColor([0.9, 0.5, 0.2], 0.04);
    list.push(DrawBrick { node: constant, region: region_of(constant, &scene.layout), how });
    list[3].how = DrawHow::Constant(36_000.0);
    list[9].how = DrawHow::Skip;
    in_view_order(scene, list)
}

fn record(
    scene: &Scene,
    list: &[DrawBrick],
    runs: &[Range<usize>],
    options: CpuOptions,
) -> (Image, RenderStats, Vec<Option<PartialImage>>) {
    let mut frame = Frame::new(scene, options).unwrap();
    let images = frame.draw_recording(list, runs).unwrap();
    let (image, stats) = frame.finish();
    (image, stats, images)
}

/// The list with images in place of the runs that have one.
fn with_images(
    list: &[DrawBrick],
    runs: &[Range<usize>],
    images: Vec<Option<PartialImage>>,
) -> Vec<DrawBrick> {
    let mut list = list.to_vec();
    for (run, image) in runs.iter().zip(images) {
        if let Some(image) = image {
            list[run.clone()].iter_mut().for_each(|brick| brick.how = DrawHow::Skip);
            list[run.start].how = DrawHow::Partial(Arc::new(image));
        }
    }
    list
}

/// Runs that were hidden.
fn without_image(runs: &[Range<usize>], images: &[Option<PartialImage>]) -> Vec<Range<usize>> {
    runs.iter().zip(images).filter(|(_, image)| image.is_none()).map(|(run, _)| run.clone()).collect()
}

fn each(num_bricks: usize) -> Vec<Range<usize>> {
    (0..num_bricks).map(|i| i..i + 1).collect()
}

/// Largest difference of a picture that is recorded, and of one drawn from what was recorded, from the picture without.
///
/// The second has the bits of the first, whatever the tiles it is drawn with.
fn compare(name: &str, scene: &Scene, list: &[DrawBrick], runs: &[Range<usize>]) -> f64 {
    let (expected, expected_stats) = render(scene, list).unwrap();
    let (recorded, first_stats, images) = record(scene, list, runs, CpuOptions::default());
    assert!(first_stats.num_samples >= expected_stats.num_samples, "{name}");
    let num_images = images.iter().flatten().count();
    assert!(num_images > 0, "{name}: all is hidden");
    let again = without_image(runs, &images);
    let is_all = again.is_empty() && runs.iter().map(|run| run.len()).sum::<usize>() == list.len();
    let from_images = with_images(list, runs, images);
    for (tile_edge, plain) in [(16, false), (8, false), (40, true), (1024, false)] {
        let (drawn, stats, _) = record(scene, &from_images, &again, CpuOptions { tile_edge, plain });
        assert_identical(&format!("{name} tiles {tile_edge}"), &drawn, &recorded);
        assert!(stats.bricks_composited > 0 && stats.bricks_composited <= num_images, "{name}: {stats:?}");
        assert!(stats.num_samples <= first_stats.num_samples, "{name}");
        assert!(!is_all || stats.num_samples == 0, "{name}");
    }
    difference(&recorded, &expected).max
}

/// Asserts that where no ray ends early nothing but rounding is different, and else no more than what is left there.
fn assert_close(name: &str, scene: &Scene, list: &[DrawBrick], runs: &[Range<usize>]) {
    let max = compare(name, scene, list, runs);
    let dense = Scene { opacity_unit: 0.1, ..scene.clone() };
    let dense_max = compare(&format!("dense {name}"), &dense, list, runs);
    assert!(max.max(dense_max) <= 1.001 / 512.0, "{name}: {max}, {dense_max}");
    let thin = Scene { opacity_unit: 20.0, ..scene.clone() };
    assert!(render(&thin, list).unwrap().0.pixels.iter().all(|p| p[3] < 0.998), "{name}: rays end early");
    let thin_max = compare(&format!("thin {name}"), &thin, list, runs);
    assert!(thin_max <= 2e-6, "thin {name}: {thin_max}");
    println!("{name}: {max:.2e}, dense {dense_max:.2e}, thin {thin_max:.2e}");
}

#[test]
fn bricks_one_by_one() {
    let field = field();
    for (name, scene) in scenes(&field) {
        let list = field.draw_list(&scene, 0, Quantise::PerBrick);
        assert_close(&name, &scene, &list, &each(list.len()));
    }
}

#[test]
fn some_bricks_of_mixed_levels() {
    let field = field();
    for (name, scene) in scenes(&field) {
        let list = mixed_list(&scene, &field);
        let some: Vec<_> = each(list.len()).into_iter().filter(|run| run.start % 3 != 1).collect();
        assert_close(&format!("mixed {name}"), &scene, &list, &some);
    }
}

#[test]
fn camera_inside_the_volume() {
    let field = field();
    let eye = field.grid.world_from_voxel([17.3, 12.1, 30.2]);
    let target = field.grid.world_from_voxel([5.0, 20.0, 3.0]);
    let projection = Projection::Perspective { fov_y_deg: 90.0 };
    let camera = Camera::new(eye, target, [0.0, 1.0, 0.0], projection).unwrap();
    for function in ["sparse", "filled"] {
        let scene = Scene { camera, ..scene_of(&field, 16, function, true) };
        let list = field.draw_list(&scene, 0, Quantise::PerBrick);
        assert_close(&format!("inside {function}"), &scene, &list, &each(list.len()));
    }
}

#[test]
fn runs_of_bricks() {
    let field = field();
    for (name, scene) in scenes(&field) {
        let list = mixed_list(&scene, &field);
        assert_close(&format!("runs {name}"), &scene, &list, &[0..1, 1..6, 8..17, 20..list.len()]);
        let whole = 0..list.len();
        let max = compare(&format!("whole {name}"), &scene, &list, std::slice::from_ref(&whole));
        assert_eq!(max, 0.0, "{name}");
    }
}

#[test]
fn portions() {
    let field = field();
    for (name, scene) in scenes(&field) {
        let list = mixed_list(&scene, &field);
        let (expected, _, images) = record(&scene, &list, &each(list.len()), CpuOptions::default());
        let from_images = with_images(&list, &each(list.len()), images);
        // Every second portion comes from images, and the others are recorded once more.
        let mut frame = Frame::new(&scene, CpuOptions::default()).unwrap();
        for (i, portion) in (0..list.len()).step_by(5).enumerate() {
            let portion = portion..list.len().min(portion + 5);
            if i % 2 == 0 {
                frame.draw(&from_images[portion]).unwrap();
            } else {
                let again = frame.draw_recording(&list[portion.clone()], &each(portion.len())).unwrap();
                for (image, brick) in again.iter().zip(&from_images[portion]) {
                    if let (Some(image), DrawHow::Partial(before)) = (image, &brick.how) {
                        assert!(*image == **before, "{name}");
                    }
                }
            }
        }
        assert_identical(&format!("portions {name}"), &frame.finish().0, &expected);
    }
}

#[test]
fn images_of_images() {
    let field = field();
    let (_, scene) = scenes(&field).swap_remove(1);
    let list = mixed_list(&scene, &field);
    let (_, _, images) = record(&scene, &list, &each(list.len()), CpuOptions::default());
    let singles = with_images(&list, &each(list.len()), images);
    let runs = [2..11, 11..20];
    let (expected, stats, images) = record(&scene, &singles, &runs, CpuOptions::default());
    assert_eq!(stats.num_samples, 0);
    let joined = with_images(&singles, &runs, images);
    assert_identical("images of images", &render(&scene, &joined).unwrap().0, &expected);
    assert!(difference(&expected, &render(&scene, &list).unwrap().0).max < 1e-2);
}

#[test]
fn threads_and_tiles() {
    let field = field();
    let dense = |(name, scene)| (format!("dense {name}"), Scene { opacity_unit: 0.1, ..scene });
    for (name, scene) in scenes(&field).into_iter().chain(scenes(&field).into_iter().map(dense)) {
        let list = mixed_list(&scene, &field);
        let runs = [0..1, 1..2, 3..9, 12..13, 14..15, 19..20];
        let with = |num_threads, options| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(num_threads).build().unwrap();
            pool.install(|| record(&scene, &list, &runs, options))
        };
        let (image, stats, images) = with(1, CpuOptions::default());
        assert!(images.iter().flatten().any(|image| image.num_bytes() > 10_000), "{name}");
        for num_threads in [2, 4] {
            let (other_image, other_stats, other_images) = with(num_threads, CpuOptions::default());
            assert_identical(&format!("{num_threads} threads {name}"), &other_image, &image);
            assert!(other_images == images, "{num_threads} threads {name}");
            assert_eq!(other_stats.num_samples, stats.num_samples);
        }
        let (other_image, _, other_images) = with(2, CpuOptions { tile_edge: 24, plain: true });
        assert_identical(&format!("tiles {name}"), &other_image, &image);
        assert!(other_images == images, "tiles {name}");
    }
}

/// A brick in front that lets nothing through and fills a part of the picture.
#[test]
fn what_is_hidden_in_part_is_recorded_as_a_whole() {
    let field = field();
    for (name, scene) in scenes(&field) {
        let mut list = field.draw_list(&scene, 0, Quantise::PerBrick);
        list[0].how = DrawHow::ConstantColor([1.0; 3], 1.0);
        let runs = each(list.len());
        let (recorded, stats, images) = record(&scene, &list, &runs, CpuOptions::default());
        let (expected, plain_stats) = render(&scene, &list).unwrap();
        assert!(plain_stats.num_samples < stats.num_samples, "{name}");
        assert!(difference(&recorded, &expected).max <= 1e-6, "{name}");
        let mut num_images = 0;
        for (brick, image) in list.iter().zip(&images).filter(|(_, image)| image.is_some()) {
            let run = 0..1;
            let (brick, run) = (std::slice::from_ref(brick), std::slice::from_ref(&run));
            let (_, _, alone) = record(&scene, brick, run, CpuOptions::default());
            assert!(*image == alone[0], "{name}");
            num_images += 1;
        }
        assert!(num_images > list.len() * 3 / 4, "{name}: {num_images} of {}", list.len());
        let (_, _, of_small_tiles) =
            record(&scene, &list, &runs, CpuOptions { tile_edge: 8, ..CpuOptions::default() });
        assert!(of_small_tiles == images, "{name}");
        let from_images = with_images(&list, &runs, images);
        assert_identical(&name, &render(&scene, &from_images).unwrap().0, &recorded);
    }
}

#[test]
fn what_is_hidden_altogether_is_neither_drawn_nor_recorded() {
    let field = field();
    for (name, scene) in scenes(&field) {
        let bricks = field.draw_list(&scene, 0, Quantise::PerBrick);
        let how = DrawHow::ConstantColor([1.0; 3], 1.0);
        let mut list = vec![DrawBrick { how, region: [[-1.0; 3], [99.0; 3]], ..bricks[0].clone() }];
        list.extend(bricks);
        let runs = each(list.len());
        let (image, stats, images) = record(&scene, &list, &runs, CpuOptions::default());
        assert_eq!((stats.num_samples, stats.bricks_constant), (0, 1), "{name}");
        assert!(
            images[0].is_some() && images[1..].iter().filter(|image| image.is_none()).count() > 30,
            "{name}"
        );
        // What the function hides, or the grid's faces leave no sample, is not behind the wall: it shows nothing.
        assert!(images[1..].iter().flatten().all(|image| image.pixels() == [[0; 2]; 2]), "{name}");
        assert_identical(&name, &image, &render(&scene, &list[..1]).unwrap().0);
    }
}

#[test]
fn an_image_holds_what_its_boxes_show_and_little_else() {
    let field = field();
    for (name, scene) in scenes(&field) {
        let list = field.draw_list(&scene, 0, Quantise::PerBrick);
        let (_, _, images) = record(&scene, &list, &each(list.len()), CpuOptions::default());
        for (brick, image) in list.iter().zip(images) {
            let image = image.unwrap();
            let (alone, stats) = render(&scene, std::slice::from_ref(brick)).unwrap();
            let is_seen = |i: usize| alone.pixels[i] != [0.0; 4];
            let seen: Vec<_> = (0..alone.pixels.len()).filter(|i| is_seen(*i)).collect();
            let [[left, right], [top, bottom]] = image.pixels();
            let is_inside = |i: usize| {
                (left..right).contains(&(i % alone.width)) && (top..bottom).contains(&(i / alone.width))
            };
            assert!(seen.iter().all(|i| is_inside(*i)), "{name}");
            // Packets with a pixel that is seen take all of their 8 pixels.
            let mut packets: Vec<_> =
                seen.iter().map(|i| (i / alone.width / 2, i % alone.width / 4)).collect();
            packets.sort_unstable();
            packets.dedup();
            let num_rows = (bottom - top).div_ceil(2) + 1;
            let least = 128 * packets.len();
            let bytes = image.num_bytes();
            assert!(
                bytes >= least && bytes <= least + 2 * packets.len() + 4 * num_rows + 150,
                "{name}: {bytes}"
            );
            if stats.bricks_skipped == 1 {
                assert_eq!(image.pixels(), [[0; 2]; 2], "{name}");
            }
            let how = DrawHow::Partial(Arc::new(image));
            let drawn = render(&scene, &[DrawBrick { how, ..brick.clone() }]).unwrap().0;
            assert!(drawn.pixels == alone.pixels, "{name}");
        }
    }
}

#[test]
fn what_does_not_fit_is_refused() {
    let field = field();
    let (_, scene) = scenes(&field).swap_remove(0);
    let list = field.draw_list(&scene, 0, Quantise::PerBrick);
    let message = |scene: &Scene, list: &[DrawBrick], runs: &[Range<usize>]| {
        let refused = Frame::new(scene, CpuOptions::default()).unwrap().draw_recording(list, runs);
        refused.unwrap_err().to_string()
    };
    for runs in [vec![0..2, 1..3], vec![3..4, 0..1], vec![5..5, 6..7], vec![0..1, list.len()..list.len() + 1]]
    {
        let message = message(&scene, &list, &runs);
        assert!(message.contains("run to record is") && !message.contains('\n'), "{message}");
    }
    let (_, _, images) = record(&scene, &list, &each(list.len()), CpuOptions::default());
    let from_images = with_images(&list, &each(list.len()), images);
    let message = message(&Scene { size: [110, 83], ..scene }, &from_images, &[]);
    assert!(message.contains("partial image's picture is 109x83"), "{message}");
}
