//! Tetrahedra per second of the cell renderer, a new step each frame, at 512 x 512; meshes that need no file.
//!
//! Before criterion's figures, which are wall-clock times, each case prints its processor time per frame, which a busy
//! machine changes less.

#![allow(missing_docs, reason = "what the macro makes has none")]

use std::sync::Arc;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};

use chronoxel_render::{CellMesh, CellOptions, CellRenderer, CellScene};

#[path = "../tests/cell_meshes/mod.rs"]
mod cell_meshes;
mod processor;
use processor::cpu_ms;

/// Prints the processor time of a frame.
fn print_cpu(name: &str, num: usize, mut frame: impl FnMut(usize)) {
    frame(0);
    let before = cpu_ms();
    (1..=num).for_each(&mut frame);
    println!("{name}: {:.1} CPU ms per frame", (cpu_ms() - before) / num as f64);
}

fn cells(c: &mut Criterion) {
    let mut group = c.benchmark_group("cells");
    group.sample_size(10);
    for num in [[39, 31, 31], [72, 50, 55]] {
        let mesh = Arc::new(cell_meshes::twisted(num));
        let steps: Vec<Vec<f32>> = (0..8).map(|t| cell_meshes::waves(num, t as f64 * 0.2)).collect();
        let name = |what: &str| format!("{}k {what}", mesh.num_tetrahedra() / 1000);
        group.throughput(Throughput::Elements(mesh.num_tetrahedra() as u64));
        for (what, function, k, lit) in [
            ("filled k=6", "filled", 6, false),
            ("filled k=2", "filled", 2, false),
            ("filled k=16", "filled", 16, false),
            ("sparse k=6", "sparse", 6, false),
            ("filled k=6 lit", "filled", 6, true),
        ] {
            let scene = cell_meshes::scene(&mesh, function, [512, 512], Some(30.0), lit);
            let mut renderer = new_renderer(&mesh, k);
            let stats = renderer.render(&scene, &steps[0]).expect("a picture").1;
            println!("{}: {stats:?}", name(what));
            let mut frame = |i: usize| drop(renderer.render(&scene, &steps[i % 8]).expect("a picture"));
            print_cpu(&name(what), 6, &mut frame);
            let mut i = 0;
            group.bench_function(name(what), |b| {
                b.iter(|| {
                    i += 1;
                    frame(i);
                });
            });
        }
        let scene = cell_meshes::scene(&mesh, "filled", [512, 512], Some(30.0), false);
        let mut renderer = new_renderer(&mesh, 6);
        let turned = |i: usize| CellScene {
            camera: scene.camera.turned(10.0 * i as f64).expect("an angle"),
            ..scene.clone()
        };
        print_cpu(&name("filled k=6 turning"), 6, |i| {
            drop(renderer.render(&turned(i), &steps[0]).expect("a picture"));
        });
        let range = |i: usize| CellScene { value_range: [0.0, 1.0 + i as f64 * 1e-3], ..scene.clone() };
        print_cpu(&name("filled k=6, new transfer function each frame"), 6, |i| {
            drop(renderer.render(&range(i), &steps[0]).expect("a picture"));
        });
    }
    group.finish();
}

fn new_renderer(mesh: &Arc<CellMesh>, k: usize) -> CellRenderer {
    CellRenderer::new(Arc::clone(mesh), CellOptions { k, plain: false }).expect("a k")
}

criterion_group!(benches, cells);
criterion_main!(benches);
