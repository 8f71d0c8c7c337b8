//! Samples per second of the ray caster, over scenes that need no file.

#![allow(missing_docs, reason = "what the macro makes has none")]

use criterion::{Criterion, Throughput, criterion_group, criterion_main};

use chronoxel_render::render;

mod peers;

fn raycast(c: &mut Criterion) {
    let field = peers::ripples(128);
    let mut group = c.benchmark_group("raycast");
    group.sample_size(10);
    for (function, lit) in [("sparse", false), ("filled", false), ("sparse", true), ("filled", true)] {
        let mut scene = peers::scene(&field, function, [0.0, 255.0], lit);
        let bricks = field.draw_list(&scene, 0, peers::pictures::Quantise::PerBrick);
        let list = peers::turned(&mut scene, &bricks, 30.0);
        let (_, stats) = render(&scene, &list).expect("the scene can be drawn");
        group.throughput(Throughput::Elements(stats.num_samples));
        group.bench_function(format!("{function}{}", if lit { " lit" } else { "" }), |b| {
            b.iter(|| render(&scene, &list).expect("the scene can be drawn"));
        });
    }
    group.finish();
}

criterion_group!(benches, raycast);
criterion_main!(benches);
