//! Partial images: what compositing them costs, beside marching through what they show.

#![allow(missing_docs, reason = "what the macro makes has none")]

use std::hint::black_box;
use std::ops::Range;
use std::sync::Arc;

use chronoxel_render::{CpuOptions, DrawBrick, DrawHow, Frame, PartialImage, Scene, render};
use criterion::{Criterion, Throughput, criterion_group, criterion_main};

mod peers;

fn record(scene: &Scene, list: &[DrawBrick], runs: &[Range<usize>]) -> Vec<Option<PartialImage>> {
    let mut frame = Frame::new(scene, CpuOptions::default()).expect("the scene can be drawn");
    frame.draw_recording(list, runs).expect("the runs fit")
}

/// The list with images in place of runs.
fn composited(
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

/// 128³ samples in 64 bricks, marched, recorded, and composited from runs of several lengths.
fn frames(c: &mut Criterion) {
    let field = peers::ripples(128);
    for (function, lit) in [("sparse", false), ("filled", false), ("sparse", true), ("filled", true)] {
        let mut scene = peers::scene(&field, function, [0.0, 255.0], lit);
        let bricks = field.draw_list(&scene, 0, peers::Quantise::PerBrick);
        let list = peers::turned(&mut scene, &bricks, 30.0);
        let mut group = c.benchmark_group(format!("{function}{}", if lit { " lit" } else { "" }));
        group.sample_size(10);
        group.bench_function("marched", |b| b.iter(|| render(&scene, &list).expect("a picture")));
        for run_len in [1, 4, 16, 64] {
            let runs: Vec<_> = (0..64).step_by(run_len).map(|i| i..i + run_len).collect();
            group.bench_function(format!("recorded by {run_len}"), |b| {
                b.iter(|| black_box(record(&scene, &list, &runs)));
            });
            let images = record(&scene, &list, &runs);
            let num_bytes: usize = images.iter().flatten().map(PartialImage::num_bytes).sum();
            let from_images = composited(&list, &runs, images);
            let (_, stats) = render(&scene, &from_images).expect("a picture");
            let name = format!(
                "composited by {run_len}, {} images of {} KiB, {} bricks marched",
                stats.bricks_composited,
                num_bytes / 1024,
                stats.bricks_drawn
            );
            group.throughput(Throughput::Bytes(num_bytes as u64));
            group.bench_function(name, |b| b.iter(|| render(&scene, &from_images).expect("a picture")));
        }
        group.finish();
    }
}

criterion_group!(benches, frames);
criterion_main!(benches);
