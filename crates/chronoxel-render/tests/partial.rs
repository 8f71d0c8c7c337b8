//! Pictures from partial images: what was recorded is drawn again, and nothing else changes.

mod pictures;

use std::ops::Range;
use std::sync::Arc;

use chronoxel_core::{Camera, Image, NodeId, UniformGrid};
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

/// Runs to be recorded again, because they were hidden somewhere.
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
        let (drawn, stats, _) =
            record(scene, &from_images, &again, CpuOptions { tile_edge, plain, ..CpuOptions::default() });
        assert_identical(&format!("{name} tiles {tile_edge}"), &drawn, &recorded);
        assert!(stats.bricks_composited > 0 && stats.bricks_composited <= num_images, "{name}: {stats:?}");
        // Larger tiles are less often hidden as a whole.
        assert!(stats.num_samples <= first_stats.num_samples || tile_edge > 16, "{name}");
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
    for (name, scene) in scenes(&field) {
        let list = mixed_list(&scene, &field);
        let runs = [0..1, 1..2, 3..9, 12..13];
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
        // Nothing in front is opaque, so that the same is recorded with any tiles and instructions.
        let (_, _, other_images) =
            with(2, CpuOptions { tile_edge: 24, plain: true, ..CpuOptions::default() });
        assert!(other_images == images, "tiles {name}");
    }
}

#[test]
fn what_is_hidden_is_neither_drawn_nor_recorded() {
    let field = field();
    for (name, scene) in scenes(&field) {
        let mut list = field.draw_list(&scene, 0, Quantise::PerBrick);
        // The brick nearest to the eye hides whatever is behind it, and does not fill the picture.
        list[0].how = DrawHow::ConstantColor([1.0; 3], 1.0);
        let runs = each(list.len());
        let options = CpuOptions { tile_edge: 8, ..CpuOptions::default() };
        let (recorded, stats, images) = record(&scene, &list, &runs, options);
        let num_hidden = images.iter().filter(|image| image.is_none()).count();
        assert!(images[0].is_some() && num_hidden > 1 && num_hidden < list.len() - 3, "{name}: {num_hidden}");
        let (expected, plain_stats) = render(&scene, &list).unwrap();
        assert!(difference(&recorded, &expected).max <= 1.0 / 255.0, "{name}");
        // Rays that end early go on to be recorded, but not in tiles where nothing would be seen.
        let alone = |brick| render(&scene, std::slice::from_ref(brick)).unwrap().1.num_samples;
        let all: u64 = list.iter().map(alone).sum();
        assert!(plain_stats.num_samples <= stats.num_samples && stats.num_samples < all, "{name}");
        let again = without_image(&runs, &images);
        let from_images = with_images(&list, &runs, images);
        let (drawn, _, images) = record(&scene, &from_images, &again, options);
        assert_identical(&name, &drawn, &recorded);
        assert!(images.iter().all(Option::is_none), "{name}");
    }
}

#[test]
fn what_is_hidden_in_some_tiles_can_be_recorded_as_a_whole() {
    let field = field();
    for (name, scene) in scenes(&field) {
        let mut list = field.draw_list(&scene, 0, Quantise::PerBrick);
        list[0].how = DrawHow::ConstantColor([1.0; 3], 1.0);
        let runs = each(list.len());
        let options = CpuOptions { tile_edge: 8, ..CpuOptions::default() };
        let (expected, _, some) = record(&scene, &list, &runs, options);
        let whole = CpuOptions { record_hidden: true, ..options };
        let (recorded, stats, all) = record(&scene, &list, &runs, whole);
        assert_identical(&name, &recorded, &expected);
        assert!(all.iter().flatten().count() > some.iter().flatten().count(), "{name}");
        let mut num_samples = 0;
        for (brick, image) in list.iter().zip(&all) {
            let run = 0..1;
            let (_, stats, alone) =
                record(&scene, std::slice::from_ref(brick), std::slice::from_ref(&run), options);
            assert!(image.is_none() || *image == alone[0], "{name}");
            num_samples += stats.num_samples;
        }
        assert!(stats.num_samples <= num_samples, "{name}");
        let from_images = with_images(&list, &runs, all);
        assert_identical(&name, &render(&scene, &from_images).unwrap().0, &expected);
        // Behind a wall, what is hidden altogether has no image.
        let wall = DrawHow::ConstantColor([1.0; 3], 1.0);
        let mut behind_wall =
            vec![DrawBrick { how: wall, region: [[-1.0; 3], [99.0; 3]], ..list[0].clone() }];
        behind_wall.extend(list.iter().skip(1).cloned());
        let (_, stats, images) = record(&scene, &behind_wall, &runs, whole);
        assert!(images[0].is_some() && stats.num_samples == 0, "{name}: {stats:?}");
        assert!(images[1..].iter().flatten().all(|image| image.pixels() == [[0; 2]; 2]), "{name}");
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
