//! The renderer on the GPU: what it uploads, what it holds, and what it refuses.

#![cfg(feature = "gpu")]

mod pictures;

use std::sync::Arc;

use chronoxel_codec::Payload;
use chronoxel_core::{BitMask, Image, NodeId, UniformGrid};
use chronoxel_render::{
    GpuBrick, GpuError, GpuHow, GpuOptions, GpuRenderer, GpuStats, Interpolation, LaterStep, Scene, Way,
};
use pictures::cases::{Case, Coding, NUM_STEPS, assert_all_drawn, cpu_picture};
use pictures::{Field, assert_identical, assert_similar, difference, region_of, scene_of, waves};

/// A renderer, where there is an adapter.
fn renderer(options: &GpuOptions) -> Option<GpuRenderer> {
    match GpuRenderer::new(options) {
        Ok(renderer) => Some(renderer),
        Err(e @ GpuError::NoAdapter { .. }) if std::env::var_os("CHRONOXEL_REQUIRE_GPU").is_none() => {
            println!("skipped: {e}");
            None
        }
        Err(e) => panic!("{e}"),
    }
}

fn with_memory(memory_bytes: u64) -> GpuOptions {
    GpuOptions { memory_bytes, ..Default::default() }
}

fn field() -> Field {
    waves(UniformGrid::new([41, 33, 50], [0.0; 3], [1.0; 3]).unwrap())
}

fn case(field: &Field, edge: usize, coding: Coding) -> Case {
    let scene = scene_of(field, edge, "filled", true);
    let bricks = field.coded_list(&scene, 0, coding);
    Case { name: format!("{coding:?}"), scene, bricks }
}

/// The same at another step of all spans.
fn at_step(case: &Case, step: u32) -> Case {
    let mut bricks = case.bricks.clone();
    for brick in &mut bricks {
        if let GpuHow::Coded(coded) = &mut brick.how {
            coded.step_in_span = step;
        }
    }
    Case { name: format!("{} at {step}", case.name), scene: case.scene.clone(), bricks }
}

#[track_caller]
fn check(case: &Case, (image, stats): &(Image, GpuStats)) {
    assert_all_drawn(case, stats);
    assert_similar(&format!("gpu {}", case.name), image, &cpu_picture(case), 60.0, 0);
}

#[test]
fn a_step_uploads_row_numbers() {
    let Some(mut gpu) = renderer(&with_memory(64 << 20)) else { return };
    let start = case(&field(), 16, Coding::TwoStages);
    let num_payload_bytes = start.bricks.len() as u64 * 19 * 19 * 19;
    for (i, step) in [0, 1, 2, 3, 1].into_iter().enumerate() {
        let case = at_step(&start, step);
        let drawn = gpu.draw(&case.scene, &case.bricks).unwrap();
        check(&case, &drawn);
        let stats = drawn.1;
        assert_eq!(stats.slots_decoded, stats.bricks_drawn, "step {step}: {stats:?}");
        if i == 0 {
            assert_eq!(stats.payloads_uploaded, stats.bricks_drawn);
            assert!(stats.bytes_uploaded > num_payload_bytes, "{stats:?}");
            continue;
        }
        assert_eq!(stats.payloads_uploaded, 0, "step {step}: {stats:?}");
        // A slot and its row, 8 bytes a brick; the view; the parameters of a batch.
        assert!(stats.bytes_uploaded <= 8 * stats.bricks_drawn as u64 + 512, "step {step}: {stats:?}");
    }
}

#[test]
fn a_still_picture_uploads_and_decodes_nothing() {
    let Some(mut gpu) = renderer(&with_memory(64 << 20)) else { return };
    let case = case(&field(), 16, Coding::Affine);
    let (first, _) = gpu.draw(&case.scene, &case.bricks).unwrap();
    let (second, stats) = gpu.draw(&case.scene, &case.bricks).unwrap();
    assert_identical("still", &second, &first);
    assert_eq!((stats.slots_decoded, stats.payloads_uploaded), (0, 0));
    assert!(stats.bytes_uploaded < 512, "{stats:?}");
    assert_eq!(stats.decode_ms, 0.0);
    assert!(stats.render_ms > 0.0 && stats.render_ms <= stats.wall_ms, "{stats:?}");
}

#[test]
fn a_new_window_uploads_its_payload_alone() {
    let Some(mut gpu) = renderer(&with_memory(64 << 20)) else { return };
    let mut case = case(&field(), 16, Coding::Listed);
    gpu.draw(&case.scene, &case.bricks).unwrap();
    // The second window of one brick in the middle: another payload.
    let other = Field::new(field().grid, |[x, y, z]| (0.2 * x + 0.1 * y * z).sin().abs() * 60_000.0);
    let at = case.bricks.iter().position(|brick| brick.node == NodeId::new(0, [1, 0, 1])).unwrap();
    let node = case.bricks[at].node;
    let mut brick = other.coded(&case.scene, node, region_of(node, &case.scene.layout), Coding::Listed);
    if let GpuHow::Coded(coded) = &mut brick.how {
        coded.key |= 1 << 60;
        coded.step_in_span = 0;
    }
    case.bricks[at] = brick;
    let drawn = gpu.draw(&case.scene, &case.bricks).unwrap();
    check(&case, &drawn);
    let stats = drawn.1;
    assert_eq!((stats.payloads_uploaded, stats.slots_decoded), (1, 1));
    let payload_bytes = 19 * 19 * 19 + 2 * 256 * u64::from(NUM_STEPS);
    assert!(stats.bytes_uploaded < payload_bytes + 2048, "{stats:?}");
}

#[test]
fn payloads_at_different_steps_in_one_picture() {
    let Some(mut gpu) = renderer(&with_memory(64 << 20)) else { return };
    let mut case = case(&field(), 16, Coding::Listed);
    // All boxes show one payload, half of them at an early step.
    let shared = case.bricks.iter().find_map(|brick| match &brick.how {
        GpuHow::Coded(coded) => Some(coded.clone()),
        _ => None,
    });
    for (i, brick) in case.bricks.iter_mut().enumerate() {
        let mut coded = shared.clone().unwrap();
        coded.step_in_span = if i % 2 == 0 { 0 } else { 3 };
        brick.how = GpuHow::Coded(coded);
    }
    let drawn = gpu.draw(&case.scene, &case.bricks).unwrap();
    check(&case, &drawn);
    assert_eq!((drawn.1.payloads_uploaded, drawn.1.slots_decoded), (1, 2), "{:?}", drawn.1);
}

/// Bricks between two steps, every other one between two payloads, the last with a mask.
fn between_steps(weight: f64) -> Case {
    let mut case = case(&field(), 16, Coding::Listed);
    let other = Field::new(field().grid, |[x, y, z]| (0.2 * x + 0.1 * y * z).sin().abs() * 90_000.0);
    for (i, brick) in case.bricks.iter_mut().enumerate() {
        let node = brick.node;
        let GpuHow::Coded(coded) = &mut brick.how else { panic!("not coded") };
        (coded.key, coded.step_in_span) = (coded.key | 1 << 50, 1);
        let mut later =
            LaterStep { key: coded.key, payload: Arc::clone(&coded.payload), step_in_span: 2, weight };
        if i % 2 == 0 {
            let next = other.coded(&case.scene, node, region_of(node, &case.scene.layout), Coding::TwoStages);
            let GpuHow::Coded(next) = next.how else { panic!("not coded") };
            later = LaterStep { key: next.key | 1 << 51, payload: next.payload, step_in_span: 0, weight };
        }
        if i % 3 == 0 {
            let mut mask = BitMask { bytes: vec![0; (19usize * 19 * 19).div_ceil(8)] };
            mask.bytes[100..300].fill(0x0f);
            coded.mask = Some(Arc::new(mask));
            coded.key |= 1 << 52;
            // Without a mask, it is another.
            later.key |= 1 << 53;
        }
        coded.later = Some(later);
    }
    Case { name: format!("between steps, {weight}"), ..case }
}

#[test]
fn steps_are_blended() {
    // Decoding twice at each fetch takes drivers in software seconds a picture.
    let ways = [(Way::Pool, false, 64), (Way::Pool, true, 64), (Way::Pool, false, 3), (Way::Fetch, false, 3)];
    for (way, guaranteed_only, mib) in ways {
        let options = GpuOptions { way: Some(way), guaranteed_only, ..with_memory(mib << 20) };
        let Some(mut gpu) = renderer(&options) else { return };
        for weight in if way == Way::Pool { &[0.25, 0.6, 0.6, 1.0][..] } else { &[0.6] } {
            let mut case = between_steps(*weight);
            if way == Way::Fetch {
                case.scene.size = [40, 32];
            }
            let drawn = gpu.draw(&case.scene, &case.bricks).unwrap();
            check(&case, &drawn);
            assert!(drawn.1.gpu_bytes_peak <= options.memory_bytes);
        }
        if way == Way::Fetch {
            continue;
        }
        // Nothing is left of it at the step.
        let mut case = between_steps(0.5);
        for brick in &mut case.bricks {
            let GpuHow::Coded(coded) = &mut brick.how else { panic!("not coded") };
            coded.later = None;
        }
        let drawn = gpu.draw(&case.scene, &case.bricks).unwrap();
        check(&case, &drawn);
    }
}

#[test]
fn a_blend_uploads_rows_and_weights() {
    let Some(mut gpu) = renderer(&with_memory(64 << 20)) else { return };
    let first = between_steps(0.25);
    gpu.draw(&first.scene, &first.bricks).unwrap();
    let again = gpu.draw(&first.scene, &first.bricks).unwrap().1;
    assert_eq!((again.slots_decoded, again.payloads_uploaded), (0, 0));
    let second = between_steps(0.75);
    let stats = gpu.draw(&second.scene, &second.bricks).unwrap().1;
    assert_eq!((stats.slots_decoded, stats.payloads_uploaded), (stats.bricks_drawn, 0));
    // Both jobs of a slot, its later payload and weight; the view; a batch.
    assert!(stats.bytes_uploaded <= 32 * stats.bricks_drawn as u64 + 2048, "{stats:?}");
}

#[test]
fn memory_far_below_the_data_draws_the_same_picture() {
    let field = waves(UniformGrid::new([150, 140, 130], [0.0; 3], [1.0; 3]).unwrap());
    let case = case(&field, 16, Coding::TwoStages);
    let num_bytes = case.bricks.len() as u64 * 19 * 19 * (19 + 20) * 2;
    for (way, mib) in [(Way::Pool, 3), (Way::Pool, 6), (Way::Pool, 64), (Way::Fetch, 3)] {
        let memory_bytes = mib << 20;
        let Some(mut gpu) = renderer(&GpuOptions { way: Some(way), ..with_memory(memory_bytes) }) else {
            return;
        };
        for step in [3, 1] {
            let case = at_step(&case, step);
            let drawn = gpu.draw(&case.scene, &case.bricks).unwrap();
            check(&case, &drawn);
            let stats = drawn.1;
            assert!(stats.gpu_bytes_peak <= memory_bytes && stats.gpu_bytes <= stats.gpu_bytes_peak);
            let is_less = memory_bytes < num_bytes / 3;
            assert_eq!(stats.num_portions > 1, is_less, "{way:?} {memory_bytes}: {stats:?}");
        }
    }
}

#[test]
fn large_pictures_are_drawn_in_bands() {
    let mut case = case(&field(), 16, Coding::Affine);
    case.scene.size = [200, 160];
    let Some(mut gpu) = renderer(&with_memory(2 << 20)) else { return };
    let drawn = gpu.draw(&case.scene, &case.bricks).unwrap();
    check(&case, &drawn);
    assert!(drawn.1.num_portions >= 2, "{:?}", drawn.1);
}

#[test]
fn one_renderer_draws_one_scene_after_another() {
    let Some(mut gpu) = renderer(&with_memory(32 << 20)) else { return };
    for (number, edge) in [(1, 16), (2, 8), (3, 32), (4, 16)] {
        let mut case = case(&field(), edge, Coding::Affine);
        case.scene.size = [90 + 10 * number as usize, 100];
        for brick in &mut case.bricks {
            if let GpuHow::Coded(coded) = &mut brick.how {
                coded.key |= number << 50;
            }
        }
        let drawn = gpu.draw(&case.scene, &case.bricks).unwrap();
        check(&case, &drawn);
    }
}

#[test]
fn renderers_go_to_other_threads() {
    let Some(mut gpu) = renderer(&with_memory(32 << 20)) else { return };
    let case = case(&field(), 16, Coding::Affine);
    let (first, _) = gpu.draw(&case.scene, &case.bricks).unwrap();
    let draw = move || gpu.draw(&case.scene, &case.bricks).unwrap().0;
    assert_identical("another thread", &std::thread::spawn(draw).join().unwrap(), &first);
}

#[test]
fn nothing_is_a_blank_picture() {
    let Some(mut gpu) = renderer(&with_memory(16 << 20)) else { return };
    let mut case = case(&field(), 16, Coding::Affine);
    gpu.draw(&case.scene, &case.bricks).unwrap();
    case.bricks.iter_mut().for_each(|brick| brick.how = GpuHow::Skip);
    for bricks in [&case.bricks[..], &[]] {
        let (image, stats) = gpu.draw(&case.scene, bricks).unwrap();
        assert!(image.pixels.iter().all(|pixel| *pixel == [0.0; 4]));
        assert_eq!(stats.bricks_skipped, bricks.len());
    }
}

#[test]
fn colors_are_interpolated_on_request() {
    let way = |way, interpolation| GpuOptions { way: Some(way), interpolation, ..with_memory(64 << 20) };
    let Some(mut scalar) = renderer(&way(Way::Pool, Interpolation::Scalar)) else { return };
    // Where colours are linear in the value, both are one.
    let mut case = case(&field(), 16, Coding::Affine);
    case.scene.lighting = None;
    let line = |x: f64, c: f32| chronoxel_core::TransferPoint { x, color: [c, 1.0 - c, 0.5], opacity: 0.02 };
    let linear = chronoxel_core::TransferFunction::new(
        vec![line(0.0, 0.0), line(1.0, 1.0)],
        chronoxel_core::TransferDomain::Variable,
    );
    let mut straight = case.scene.clone();
    straight.transfer = linear.unwrap().resolve([0.0, 65535.0]).unwrap();
    case.scene = scene_of(&field(), 16, "sparse", false);
    for of_way in [Way::Pool, Way::Fetch] {
        let mut color = renderer(&way(of_way, Interpolation::Color)).unwrap();
        let mut both = |scene: &Scene| {
            let drawn = [&mut scalar, &mut color].map(|gpu| gpu.draw(scene, &case.bricks).unwrap().0);
            difference(&drawn[1], &drawn[0])
        };
        let found = both(&straight);
        assert!(found.max < 1e-3, "{of_way:?}: {found:?}");
        let found = both(&case.scene);
        assert!(found.num_failed > 1000, "{of_way:?}: interpolation must matter: {found:?}");
    }
}

#[test]
fn interpolated_colors_are_those_of_the_corners() {
    // Seen along z through voxels whose values alternate along x: halfway, the colour is the mean of both.
    let options = GpuOptions { interpolation: Interpolation::Color, ..with_memory(16 << 20) };
    let Some(mut gpu) = renderer(&options) else { return };
    let grid = UniformGrid::new([9, 9, 9], [0.0; 3], [1.0; 3]).unwrap();
    let field = Field::new(grid, |[x, _, _]| if x < 4.5 { 0.0 } else { 65535.0 });
    let point = |x: f64, color: [f32; 3], opacity| chronoxel_core::TransferPoint { x, color, opacity };
    let points = vec![
        point(0.0, [1.0, 0.0, 0.0], 0.1),
        point(0.2, [0.0; 3], 0.0),
        point(0.8, [0.0; 3], 0.0),
        point(1.0, [0.0, 0.0, 1.0], 0.1),
    ];
    let transfer =
        chronoxel_core::TransferFunction::new(points, chronoxel_core::TransferDomain::Variable).unwrap();
    let projection = chronoxel_core::Projection::Orthographic { height: 1.0 };
    let camera =
        chronoxel_core::Camera::new([4.5, 4.0, 20.0], [4.5, 4.0, 0.0], [0.0, 1.0, 0.0], projection).unwrap();
    let scene = Scene {
        camera,
        size: [1, 1],
        transfer: transfer.resolve([0.0, 65535.0]).unwrap(),
        step_voxels: 1.0,
        opacity_unit: 1.0,
        ..scene_of(&field, 8, "ramp", false)
    };
    let bricks = field.coded_list(&scene, 0, Coding::Affine);
    let (image, _) = gpu.draw(&scene, &bricks).unwrap();
    // Eight samples of premultiplied (0.05, 0, 0.05, 0.1).
    let alpha = 1.0 - 0.9f64.powi(8);
    let expected = [0.5 * alpha, 0.0, 0.5 * alpha, alpha];
    for (c, e) in image.pixels[0].iter().zip(expected) {
        assert!((f64::from(*c) - e).abs() < 1e-4, "{:?} {expected:?}", image.pixels[0]);
    }
}

#[test]
fn adapters_that_are_not_there() {
    let options = GpuOptions { adapter: Some("no such adapter".into()), ..Default::default() };
    let Err(e) = GpuRenderer::new(&options) else { panic!("an adapter of that name") };
    let GpuError::NoAdapter { .. } = e else { panic!("{e}") };
    let message = e.to_string();
    assert!(message.contains("\"no such adapter\"") && message.contains("draw on the CPU"), "{message}");
    assert!(!message.contains('\n'));
}

#[test]
fn too_little_memory_is_refused_with_an_amount_that_does() {
    let case = case(&field(), 32, Coding::TwoStages);
    let Some(_) = renderer(&with_memory(64 << 20)) else { return };
    let mut memory_bytes = 1 << 16;
    for _ in 0..20 {
        let drawn = GpuRenderer::new(&with_memory(memory_bytes))
            .and_then(|mut gpu| gpu.draw(&case.scene, &case.bricks));
        match drawn {
            Ok(drawn) => {
                assert!((1 << 16..8 << 20).contains(&memory_bytes), "{memory_bytes}");
                return check(&case, &drawn);
            }
            Err(GpuError::MemoryTooSmall { given, least, .. }) => {
                assert!(given == memory_bytes && least > given, "{given} {least}");
                memory_bytes = least.next_multiple_of(1 << 20);
            }
            Err(e) => panic!("{e}"),
        }
    }
    panic!("{memory_bytes} bytes do not suffice");
}

#[test]
fn lists_that_cannot_be_drawn_are_refused() {
    let Some(mut gpu) = renderer(&with_memory(32 << 20)) else { return };
    let start = case(&field(), 16, Coding::Listed);
    let change = |change: &dyn Fn(&mut Vec<GpuBrick>)| {
        let mut bricks = start.bricks.clone();
        change(&mut bricks);
        bricks
    };
    let coded = |bricks: &mut Vec<GpuBrick>, with: &dyn Fn(&mut chronoxel_render::CodedBrick)| {
        let GpuHow::Coded(coded) = &mut bricks[7].how else { panic!("not coded") };
        coded.key = 1 << 62;
        with(coded);
    };
    let lists = [
        ("overlap", change(&|bricks| bricks[3].region = bricks[7].region)),
        ("box of the octree", change(&|bricks| bricks[7].region[1][0] += 1.0)),
        ("table of fewer rows", change(&|bricks| coded(bricks, &|c| c.step_in_span = 4))),
        (
            "mask",
            change(&|bricks| coded(bricks, &|c| c.mask = Some(Arc::new(BitMask { bytes: vec![0; 3] })))),
        ),
        ("level", change(&|bricks| bricks[7].node.level = 32)),
        (
            "number of indices",
            change(&|bricks| {
                coded(bricks, &|c| {
                    let mut stages = c.payload.stages.clone();
                    stages[0].indices = chronoxel_codec::Indices::U8(vec![0; 5]);
                    c.payload = Arc::new(Payload { stages });
                });
            }),
        ),
        ("finite", change(&|bricks| coded(bricks, &|c| c.payload = Arc::new(Payload { stages: vec![] })))),
    ];
    for (what, bricks) in lists {
        match gpu.draw(&start.scene, &bricks) {
            Err(e) => assert!(e.to_string().contains(what), "{what}: {e}"),
            Ok(_) => panic!("{what} was drawn"),
        }
    }
    // And the renderer goes on.
    let drawn = gpu.draw(&start.scene, &start.bricks).unwrap();
    check(&start, &drawn);
}
