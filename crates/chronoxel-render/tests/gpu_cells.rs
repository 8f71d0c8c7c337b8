//! Tetrahedra on the GPU, against the renderer on the CPU and the reference.

#![cfg(feature = "gpu")]

use std::sync::Arc;

use chronoxel_codec::{CellCodecOptions, OneWorker, Payload, decode_points, encode_cells};
use chronoxel_core::{Background, BitMask, Camera, Image, Image8, Projection, compare};
use chronoxel_render::{
    CellMesh, CellOptions, CellRenderer, CellScene, CellStats, CellWay, GpuCellOptions, GpuCellRenderer,
    GpuCellStats, GpuCellValues, GpuError, GpuOptions, GpuPicture, ReadBack, Variation,
    render_cells_reference,
};

mod cell_meshes;
use cell_meshes::{lattice, scene, twisted, waves};

const WAYS: [CellWay; 2] = [CellWay::Cpu, CellWay::Gpu];

/// A renderer, where there is an adapter.
fn renderer(mesh: &Arc<CellMesh>, gpu: &GpuOptions, options: GpuCellOptions) -> Option<GpuCellRenderer> {
    match GpuCellRenderer::new(Arc::clone(mesh), gpu, options) {
        Ok(renderer) => Some(renderer),
        Err(e @ GpuError::NoAdapter { .. }) if std::env::var_os("CHRONOXEL_REQUIRE_GPU").is_none() => {
            println!("skipped: {e}");
            None
        }
        Err(e) => panic!("{e}"),
    }
}

fn with_k(mesh: &Arc<CellMesh>, k: usize) -> Option<GpuCellRenderer> {
    renderer(mesh, &GpuOptions::default(), GpuCellOptions { k, ..Default::default() })
}

fn on_cpu(mesh: &Arc<CellMesh>, scene: &CellScene, values: &[f32], k: usize) -> (Image, CellStats) {
    let options = CellOptions { k, plain: false };
    CellRenderer::new(Arc::clone(mesh), options).unwrap().render(scene, values).unwrap()
}

fn on_gpu(gpu: &mut GpuCellRenderer, scene: &CellScene, values: &[f32]) -> (Image, GpuCellStats) {
    gpu.render(scene, &GpuCellValues::Decoded(values)).unwrap()
}

fn psnr(a: &Image, b: &Image) -> f64 {
    let [a, b] = [a, b].map(|image| Image8::from_image(image, Background::default()));
    compare(&a, &b).unwrap().psnr_db
}

/// Checks that pictures are the same but for rounding: at least 80 dB, and hardly any channel that differs by more than
/// 1e-4 of its range: where a value is rounded to another entry of the table.
#[track_caller]
fn assert_same(what: &str, found: &Image, expected: &Image) {
    let pairs = found.pixels.iter().flatten().zip(expected.pixels.iter().flatten());
    let differences: Vec<f32> = pairs.map(|(a, b)| (a - b).abs()).collect();
    let largest = differences.iter().copied().fold(0.0, f32::max);
    let num = differences.iter().filter(|d| **d > 1e-4).count();
    let psnr = psnr(found, expected);
    println!("{what}: {psnr:.1} dB, {num} channels differ by more than 1e-4, the largest by {largest}");
    assert!(psnr >= 80.0 && num * 500 <= differences.len() && largest < 0.02, "{what}");
}

/// Functions, fields of view, and whether segments are lit.
const CASES: [(&str, Option<f64>, bool); 5] = [
    ("filled", Some(30.0), false),
    ("sparse", Some(30.0), false),
    ("ramp", None, false),
    ("filled", Some(60.0), true),
    ("sparse", None, true),
];

#[test]
fn pictures_are_those_of_the_cpu() {
    let num = [12, 10, 11];
    let mesh = Arc::new(twisted(num));
    let values = waves(num, 0.3);
    for k in [2, 6, 16] {
        let Some(mut gpu) = with_k(&mesh, k) else { return };
        for sorting in WAYS {
            gpu.set_sorting(sorting);
            for (function, fov, lit) in CASES {
                let what = format!("{function} {fov:?} lit {lit} k {k} sorted on the {sorting:?}");
                let scene = scene(&mesh, function, [97, 90], fov, lit);
                let (expected, on_cpu) = on_cpu(&mesh, &scene, &values, k);
                let (found, stats) = on_gpu(&mut gpu, &scene, &values);
                assert_same(&what, &found, &expected);
                let cells = stats.cells;
                let of = |s: &CellStats| [s.num_faces as u64, s.num_fragments, s.num_misordered];
                if sorting == CellWay::Cpu {
                    assert_eq!(of(&cells), of(&on_cpu), "{what}");
                }
                // Faces whose depths differ by rounding alone may change places, and pixels change sides of an edge.
                for (found, expected) in of(&cells).into_iter().zip(of(&on_cpu)) {
                    assert!(found.abs_diff(expected) <= 2 + expected / 1000, "{what}: {found} {expected}");
                }
                assert!(k < 16 || cells.num_misordered == 0);
            }
        }
    }
}

#[test]
fn pictures_are_close_to_the_reference() {
    let num = [12, 10, 11];
    let mesh = Arc::new(twisted(num));
    let values = waves(num, 0.3);
    for k in [6, 16] {
        let Some(mut gpu) = with_k(&mesh, k) else { return };
        for (function, fov, lit) in CASES {
            let scene = scene(&mesh, function, [64, 64], fov, lit);
            let exact = render_cells_reference(&mesh, &scene, &values).unwrap();
            let found = on_gpu(&mut gpu, &scene, &values).0;
            let psnr = psnr(&exact, &found);
            assert!(psnr >= 40.0, "{function} {fov:?} lit {lit} k {k}: {psnr}");
        }
    }
}

#[test]
fn holes_and_cameras_inside_are_right() {
    let num = [8, 8, 8];
    let is_out = |[x, y, z]: [usize; 3]| (x == 2 && y == 2) || (x >= 6 && y == 0) || (x, y, z) == (5, 4, 4);
    let mesh = Arc::new(lattice(num, |p| p, |cell| !is_out(cell)));
    let values = waves(num, 1.0);
    let Some(mut gpu) = with_k(&mesh, 16) else { return };
    let outside = scene(&mesh, "filled", [64, 64], Some(50.0), false);
    assert_same("outside", &on_gpu(&mut gpu, &outside, &values).0, &on_cpu(&mesh, &outside, &values, 16).0);
    let cameras = [
        (Projection::Perspective { fov_y_deg: 70.0 }, [0.31, 0.42, 0.53]),
        (Projection::Perspective { fov_y_deg: 40.0 }, [0.69, 0.55, 0.55]),
        (Projection::Orthographic { height: 1.5 }, [0.31, 0.42, 0.53]),
    ];
    for (projection, position) in cameras {
        for lit in [false, true] {
            let mut inside = scene(&mesh, "filled", [64, 64], None, lit);
            inside.camera = Camera::new(position, [1.0, 0.6, 0.7], [0.0, 1.0, 0.0], projection).unwrap();
            let (found, stats) = on_gpu(&mut gpu, &inside, &values);
            assert_same(&format!("{projection:?}"), &found, &on_cpu(&mesh, &inside, &values, 16).0);
            assert_eq!(stats.cells.num_misordered, 0);
        }
    }
    // Out again: nothing of what was cut is left.
    assert_same("again", &on_gpu(&mut gpu, &outside, &values).0, &on_cpu(&mesh, &outside, &values, 16).0);
}

#[test]
fn missing_and_infinite_values_are_those_of_the_cpu() {
    let num = [6, 6, 6];
    let mesh = Arc::new(twisted(num));
    let mut values = waves(num, 0.0);
    values[170] = f32::NAN;
    values[100] = f32::INFINITY;
    values[240] = f32::NEG_INFINITY;
    let Some(mut gpu) = with_k(&mesh, 6) else { return };
    for lit in [false, true] {
        let scene = scene(&mesh, "filled", [64, 64], Some(30.0), lit);
        let expected = on_cpu(&mesh, &scene, &values, 6).0;
        assert_same("missing", &on_gpu(&mut gpu, &scene, &values).0, &expected);
    }
}

/// A span of steps with and without missing points.
fn span(num: [usize; 3]) -> (Arc<Payload>, Arc<BitMask>) {
    let steps: Vec<Vec<f32>> = (0..64).map(|t| waves(num, f64::from(t) * 0.05)).collect();
    let borrowed: Vec<&[f32]> = steps.iter().map(Vec::as_slice).collect();
    let mut spans =
        encode_cells(&borrowed, &CellCodecOptions { entries: 300, max_error: None }, &OneWorker).unwrap();
    let mask = BitMask::from_flags((0..steps[0].len()).map(|i| i % 97 == 5));
    (Arc::new(spans.remove(0).payload), Arc::new(mask))
}

fn coded<'a>(payload: &Arc<Payload>, step: u32, missing: Option<&Arc<BitMask>>) -> GpuCellValues<'a> {
    let key = u64::from(missing.is_some());
    GpuCellValues::Coded {
        payload: Arc::clone(payload),
        key,
        step_in_span: step,
        missing: missing.map(Arc::clone),
    }
}

#[test]
fn steps_are_decoded_alike_and_cost_a_row_number() {
    let num = [9, 8, 10];
    let mesh = Arc::new(twisted(num));
    let (payload, mask) = span(num);
    let scene = scene(&mesh, "filled", [64, 48], Some(30.0), true);
    let Some(mut gpu) = with_k(&mesh, 6) else { return };
    for missing in [None, Some(&mask)] {
        // The payload of the second comes before it is drawn.
        if missing.is_some() {
            gpu.prepare(&coded(&payload, 0, missing)).unwrap();
        }
        for (i, step) in [0, 9, 63].into_iter().enumerate() {
            let mut values = vec![0.0; mesh.num_points()];
            decode_points(&payload, step, &mut values).unwrap();
            if missing.is_some() {
                (5..values.len()).step_by(97).for_each(|p| values[p] = f32::NAN);
            }
            let expected = on_cpu(&mesh, &scene, &values, 6).0;
            gpu.set_decoding(CellWay::Cpu);
            let (found, stats) = gpu.render(&scene, &coded(&payload, step, missing)).unwrap();
            assert_same("decoded on the CPU", &found, &expected);
            assert!(stats.bytes_uploaded >= 4 * values.len() as u64);
            assert_eq!(stats.payloads_uploaded, usize::from(i == 0 && missing.is_some()));
            gpu.set_decoding(CellWay::Gpu);
            let (found, stats) = gpu.render(&scene, &coded(&payload, step, missing)).unwrap();
            assert_same("decoded in a pass", &found, &expected);
            assert_eq!(stats.payloads_uploaded, usize::from(i == 0 && missing.is_none()));
            assert!(i == 0 || stats.bytes_uploaded < 1024, "{stats:?}");
            // The same step again: nothing is decoded.
            let (again, stats) = gpu.render(&scene, &coded(&payload, step, missing)).unwrap();
            assert_eq!(again.pixels, found.pixels);
            assert!(stats.bytes_uploaded < 512, "{stats:?}");
        }
    }
}

#[test]
fn fewer_faces_are_those_of_the_cpu() {
    let num = [9, 8, 10];
    let mesh = Arc::new(twisted(num));
    let mut variation = Variation::new(mesh.num_points());
    (0..16).for_each(|t| variation.push(&waves(num, f64::from(t) * 0.1)));
    let order = variation.order(&mesh, [0.0, 1.0]);
    let values = waves(num, 0.8);
    let scene = scene(&mesh, "filled", [80, 80], Some(30.0), false);
    let Some(mut gpu) = with_k(&mesh, 6) else { return };
    let mut cpu = CellRenderer::new(Arc::clone(&mesh), CellOptions::default()).unwrap();
    let choices = [Some(0.5), Some(0.2), None];
    for fraction in choices {
        let choice = fraction.and_then(|fraction| order.choose(fraction));
        gpu.choose(choice.clone());
        cpu.choose(choice);
        let (expected, on_cpu) = cpu.render(&scene, &values).unwrap();
        for sorting in WAYS {
            gpu.set_sorting(sorting);
            let (found, stats) = on_gpu(&mut gpu, &scene, &values);
            assert_same(&format!("{fraction:?}"), &found, &expected);
            assert_eq!(stats.cells.num_faces, on_cpu.num_faces);
        }
    }
}

#[test]
fn what_was_drawn_before_changes_nothing() {
    let num = [9, 8, 10];
    let mesh = Arc::new(twisted(num));
    let values = [waves(num, 0.5), waves(num, 0.6)];
    let first = scene(&mesh, "filled", [70, 50], Some(30.0), true);
    let turned = CellScene { camera: first.camera.turned(50.0).unwrap(), ..first.clone() };
    let larger = CellScene { size: [90, 130], lighting: None, ..first.clone() };
    let Some(mut gpu) = with_k(&mesh, 6) else { return };
    let before = on_gpu(&mut gpu, &first, &values[0]).0;
    for other in [&turned, &larger] {
        let again = on_gpu(&mut gpu, other, &values[1]).0;
        assert_same("other", &again, &on_cpu(&mesh, other, &values[1], 6).0);
        let (after, stats) = on_gpu(&mut gpu, &first, &values[0]);
        assert_eq!(before.pixels, after.pixels);
        assert!(stats.cells.view_changed && !stats.cells.table_changed);
    }
    let (_, stats) = on_gpu(&mut gpu, &first, &values[1]);
    assert!(!stats.cells.view_changed && stats.view_ms == 0.0);
}

#[test]
fn bytes_are_packed_on_the_gpu() {
    let num = [6, 6, 6];
    let mesh = Arc::new(twisted(num));
    let scene = scene(&mesh, "filled", [50, 40], Some(30.0), false);
    let values = GpuCellValues::Decoded(&[0.4; 343]);
    let Some(mut gpu) = with_k(&mesh, 6) else { return };
    let (image, _) = gpu.render(&scene, &values).unwrap();
    let (GpuPicture::Bytes(bytes), _) = gpu.render_as(&scene, &values, ReadBack::Bytes).unwrap() else {
        panic!("bytes were asked for")
    };
    assert_eq!(bytes.pixels.len(), image.pixels.len());
    for (byte, float) in bytes.pixels.iter().zip(&image.pixels) {
        assert!(byte[3].abs_diff((float[3] * 255.0).round() as u8) <= 1);
    }
    let (nothing, stats) = gpu.render_as(&scene, &values, ReadBack::Nothing).unwrap();
    assert_eq!(nothing, GpuPicture::Nothing);
    assert!(stats.cells.num_fragments > 0);
}

#[test]
fn little_memory_draws_the_same_picture_in_portions() {
    let num = [16, 16, 16];
    let mesh = Arc::new(twisted(num));
    let values = waves(num, 0.5);
    let scene = scene(&mesh, "filled", [320, 240], Some(30.0), false);
    let options = GpuCellOptions { sorting: Some(CellWay::Cpu), ..Default::default() };
    let Some(mut gpu) = renderer(&mesh, &GpuOptions::default(), options) else { return };
    let (expected, stats) = on_gpu(&mut gpu, &scene, &values);
    assert_eq!(stats.num_portions, 1);
    let needed = stats.gpu_bytes;
    let mut num_portions = Vec::new();
    for (part, sorting) in
        [(0.95, CellWay::Cpu), (0.85, CellWay::Cpu), (0.95, CellWay::Gpu), (0.8, CellWay::Gpu)]
    {
        let gpu_options = GpuOptions { memory_bytes: (needed as f64 * part) as u64, ..Default::default() };
        let options = GpuCellOptions { sorting: Some(sorting), ..Default::default() };
        let Some(mut small) = renderer(&mesh, &gpu_options, options) else { return };
        for _ in 0..2 {
            let (found, stats) = on_gpu(&mut small, &scene, &values);
            assert!(stats.gpu_bytes_peak <= gpu_options.memory_bytes, "{stats:?}");
            assert_eq!(found.pixels, expected.pixels, "{part}: {stats:?}");
            num_portions.push(stats.num_portions);
        }
    }
    println!("{num_portions:?} portions");
    assert!(num_portions.iter().all(|n| *n > 1), "{num_portions:?}");
}

#[test]
fn large_pictures_are_those_of_the_cpu() {
    let num = [2, 2, 2];
    let mesh = Arc::new(twisted(num));
    let values = waves(num, 0.5);
    // More tiles than programs on the CPU list at once.
    let scene = scene(&mesh, "filled", [1999, 1203], Some(30.0), false);
    let Some(mut gpu) = with_k(&mesh, 6) else { return };
    let (found, stats) = on_gpu(&mut gpu, &scene, &values);
    assert_same("large", &found, &on_cpu(&mesh, &scene, &values, 6).0);
    assert_eq!(stats.num_portions, if gpu.info().is_software { 2 } else { 1 });
}

#[test]
fn too_little_memory_is_refused_with_what_is_needed() {
    let mesh = Arc::new(twisted([9, 8, 10]));
    if with_k(&mesh, 6).is_none() {
        return;
    }
    for memory_bytes in [100_000, 1 << 20, 4 << 20] {
        let gpu = GpuOptions { memory_bytes, ..Default::default() };
        let scene = scene(&mesh, "filled", [300, 200], Some(30.0), true);
        let values = waves([9, 8, 10], 0.0);
        let refused = GpuCellRenderer::new(Arc::clone(&mesh), &gpu, GpuCellOptions::default())
            .and_then(|mut gpu| gpu.render(&scene, &GpuCellValues::Decoded(&values)))
            .unwrap_err();
        let message = refused.to_string();
        assert!(matches!(refused, GpuError::MemoryTooSmall { .. }), "{message}");
        assert!(message.contains("allow at least") && !message.contains('\n'), "{message}");
    }
}

#[test]
fn no_more_than_webgpu_guarantees_is_needed() {
    let num = [6, 6, 6];
    let mesh = Arc::new(twisted(num));
    let values = waves(num, 0.2);
    let scene = scene(&mesh, "filled", [40, 40], Some(30.0), true);
    let gpu = GpuOptions { guaranteed_only: true, ..Default::default() };
    let Some(mut gpu) = renderer(&mesh, &gpu, GpuCellOptions::default()) else { return };
    assert_same("guaranteed", &on_gpu(&mut gpu, &scene, &values).0, &on_cpu(&mesh, &scene, &values, 6).0);
}

#[test]
fn what_cannot_be_drawn_is_refused() {
    let num = [2, 2, 2];
    let mesh = Arc::new(twisted(num));
    let good = scene(&mesh, "filled", [8, 8], None, false);
    let Some(mut gpu) = with_k(&mesh, 2) else { return };
    let values = [0.0; 27];
    assert!(gpu.render(&good, &GpuCellValues::Decoded(&values)).is_ok());
    assert!(gpu.render(&good, &GpuCellValues::Decoded(&values[1..])).is_err());
    let bad = CellScene { opacity_unit: 0.0, ..good.clone() };
    assert!(gpu.render(&bad, &GpuCellValues::Decoded(&values)).is_err());
    let (payload, _) = span(num);
    let message = |values: &GpuCellValues, gpu: &mut GpuCellRenderer| {
        gpu.render(&good, values).map(|_| ()).unwrap_err().to_string()
    };
    for way in WAYS {
        gpu.set_decoding(way);
        let late = message(&coded(&payload, 64, None), &mut gpu);
        assert!(late.contains("step in its span is 64"), "{late}");
        let short = Arc::new(BitMask { bytes: vec![0; 3] });
        let masked = message(&coded(&payload, 0, Some(&short)), &mut gpu);
        assert!(masked.contains("one bit per point"), "{masked}");
        assert!(gpu.render(&good, &coded(&payload, 63, None)).is_ok());
    }
    let options = GpuCellOptions { k: 5, ..Default::default() };
    assert!(GpuCellRenderer::new(mesh, &GpuOptions::default(), options).is_err());
}

#[test]
fn tiles_of_very_many_faces_are_drawn_or_refused() {
    // Piles of thin plates, seen from above: programs on the CPU end loops after a number of rounds.
    for num_plates in [4_000, 14_000] {
        let mesh = Arc::new(lattice([1, 1, num_plates], |p| p, |_| true));
        let values = vec![0.1; mesh.num_points()];
        let mut scene = scene(&mesh, "ramp", [8, 8], None, false);
        let projection = Projection::Orthographic { height: 1.2 };
        scene.camera = Camera::new([0.5, 0.5, 3.0], [0.5; 3], [0.0, 1.0, 0.0], projection).unwrap();
        let Some(mut gpu) = with_k(&mesh, 16) else { return };
        let found = gpu.render(&scene, &GpuCellValues::Decoded(&values));
        match found {
            Ok((found, stats)) => {
                let (expected, on_cpu) = on_cpu(&mesh, &scene, &values, 16);
                assert_same("many faces", &found, &expected);
                assert_eq!(stats.cells.num_fragments, on_cpu.num_fragments);
                assert!(stats.num_listed > 5 * num_plates as u64);
            }
            Err(e) => {
                let message = e.to_string();
                assert!(num_plates == 14_000 && gpu.info().is_software, "{message}");
                assert!(message.contains("a tile has over 28000 faces"), "{message}");
            }
        }
    }
}
