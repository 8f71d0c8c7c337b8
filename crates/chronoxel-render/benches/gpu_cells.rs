//! Tetrahedra per second of the cell renderer on the GPU, at 512 x 512, beside the CPU's: a still step, and a new one each
//! frame, decoded on the CPU or in a compute pass; and a camera that turns, with both ways to sort.

#![allow(missing_docs, reason = "what the macro makes has none")]

use std::sync::Arc;
use std::time::Instant;

use chronoxel_codec::{CellCodecOptions, OneWorker, decode_points, encode_cells};
use chronoxel_render::{
    CellMesh, CellOptions, CellRenderer, CellScene, CellWay, GpuCellOptions, GpuCellRenderer, GpuCellStats,
    GpuCellValues, GpuOptions, ReadBack,
};
use criterion::{Criterion, criterion_group, criterion_main};

#[path = "../tests/cell_meshes/mod.rs"]
mod cell_meshes;
mod processor;
use processor::cpu_ms;

/// Frames that are timed.
const NUM_FRAMES: usize = 5;

/// Prints the least time of a frame, since other programs only add to it, and the processor time of the mean frame.
fn print_frames(mesh: &CellMesh, name: &str, mut frame: impl FnMut(usize) -> Option<GpuCellStats>) {
    frame(0);
    let mut best = (f64::INFINITY, None);
    let before = cpu_ms();
    for i in 1..=NUM_FRAMES {
        let start = Instant::now();
        let stats = frame(i);
        let ms = start.elapsed().as_secs_f64() * 1e3;
        if ms < best.0 {
            best = (ms, stats);
        }
    }
    let cpu = (cpu_ms() - before) / NUM_FRAMES as f64;
    let (ms, stats) = best;
    let million_per_second = mesh.num_tetrahedra() as f64 / ms * 1e-3;
    let parts = stats.map_or(String::new(), |s| {
        format!(
            "; decode {:.1}, view {:.1}, tiles {:.1} ms; {} bytes uploaded, {} faces listed",
            s.decode_ms, s.view_ms, s.render_ms, s.bytes_uploaded, s.num_listed
        )
    });
    println!("{name}: {ms:.1} ms, {cpu:.1} CPU ms, {million_per_second:.2} million tetrahedra/s{parts}");
}

fn cells(_: &mut Criterion) {
    print_mesh([39, 31, 31], &[2, 6, 16]);
    print_mesh([72, 50, 55], &[6]);
}

fn print_mesh(num: [usize; 3], ks: &[usize]) {
    let mesh = Arc::new(cell_meshes::twisted(num));
    let steps: Vec<Vec<f32>> = (0..64).map(|t| cell_meshes::waves(num, t as f64 * 0.05)).collect();
    let borrowed: Vec<&[f32]> = steps.iter().map(Vec::as_slice).collect();
    let spans = encode_cells(&borrowed, &CellCodecOptions::default(), &OneWorker).expect("a span");
    let payload = Arc::new(spans[0].payload.clone());
    let coded = |step: usize| GpuCellValues::Coded {
        payload: Arc::clone(&payload),
        key: 1,
        step_in_span: step as u32,
        missing: None,
    };
    let scene = cell_meshes::scene(&mesh, "filled", [512, 512], Some(30.0), false);
    for &k in ks {
        let options = GpuCellOptions { k, ..Default::default() };
        let mut gpu = match GpuCellRenderer::new(Arc::clone(&mesh), &GpuOptions::default(), options) {
            Ok(gpu) => gpu,
            Err(e) => return println!("{e}"),
        };
        if k == ks[0] {
            println!("{:?}; {} tetrahedra, {} faces", gpu.info(), mesh.num_tetrahedra(), mesh.num_faces());
        }
        let mut cpu = CellRenderer::new(Arc::clone(&mesh), CellOptions { k, plain: false }).expect("a k");
        let draw = |gpu: &mut GpuCellRenderer, scene: &CellScene, values: &GpuCellValues| {
            Some(gpu.render_as(scene, values, ReadBack::Bytes).expect("a picture").1)
        };
        let name = |what: &str| format!("k={k}, {what}");
        let mut values = vec![0.0; mesh.num_points()];
        print_frames(&mesh, &name("CPU, a new step each frame"), |i| {
            decode_points(&payload, i as u32, &mut values).expect("a step");
            drop(cpu.render(&scene, &values).expect("a picture"));
            None
        });
        print_frames(&mesh, &name("still"), |_| draw(&mut gpu, &scene, &coded(0)));
        for way in [CellWay::Cpu, CellWay::Gpu] {
            gpu.set_decoding(way);
            let name = name(&format!("a new step each frame, decoded on the {way:?}"));
            print_frames(&mesh, &name, |i| draw(&mut gpu, &scene, &coded(i)));
        }
        for way in [CellWay::Cpu, CellWay::Gpu] {
            gpu.set_sorting(way);
            let name = name(&format!("turning, sorted on the {way:?}"));
            print_frames(&mesh, &name, |i| {
                let camera = scene.camera.turned(10.0 * i as f64).expect("an angle");
                draw(&mut gpu, &CellScene { camera, ..scene.clone() }, &coded(0))
            });
        }
    }
}

criterion_group!(benches, cells);
criterion_main!(benches);
