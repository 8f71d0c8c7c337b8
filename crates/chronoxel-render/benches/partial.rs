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
        let bricks = field.draw_list(&scene, 0, peers::pictures::Quantise::PerBrick);
        let list = peers::turned(&mut scene, &bricks, 30.0);
        let mut group = c.benchmark_group(format!("{function}{}", if lit { " lit" } else { "" }));
        group.sample_size(10);
        group.bench_function("marched", |b| b.iter(|| render(&scene, &list).expect("a picture")));
        for run_len in [1, 4, 16, 64] {
            let runs: Vec<_> = (0..64).step_by(run_len).map(|i| i..i + run_len).collect();
            let name = format!("by {run_len}");
            group.bench_function(format!("recorded {name}"), |b| {
                b.iter(|| black_box(record(&scene, &list, &runs)));
            });
            let images = record(&scene, &list, &runs);
            let num_bytes: usize = images.iter().flatten().map(PartialImage::num_bytes).sum();
            let from_images = composited(&list, &runs, images);
            let (_, stats) = render(&scene, &from_images).expect("a picture");
            println!(
                "{} images of {} KiB; {} bricks are marched beside them",
                stats.bricks_composited,
                num_bytes / 1024,
                stats.bricks_drawn
            );
            group.bench_function(format!("composited {name}"), |b| {
                b.iter(|| render(&scene, &from_images).expect("a picture"));
            });
        }
        group.finish();
    }
}

/// One partial image put behind itself again and again: the time per pixel beyond that of the frame.
fn pixels(c: &mut Criterion) {
    let field = peers::ripples(128);
    let mut scene = peers::scene(&field, "filled", [0.0, 255.0], false);
    scene.opacity_unit = 1e4;
    let bricks = field.draw_list(&scene, 0, peers::pictures::Quantise::PerBrick);
    let list = peers::turned(&mut scene, &bricks, 30.0);
    let run = 0..list.len();
    let image = record(&scene, &list, std::slice::from_ref(&run)).swap_remove(0).expect("it is seen");
    let num_pixels = image.num_bytes() as u64 / 16;
    let how = DrawHow::Partial(Arc::new(image));
    let mut group = c.benchmark_group("pixels composited");
    for num_layers in [1, 101] {
        let layers = vec![DrawBrick { how: how.clone(), ..list[0].clone() }; num_layers];
        group.throughput(Throughput::Elements(num_pixels * num_layers as u64));
        group.bench_function(format!("{num_layers} layers"), |b| {
            b.iter(|| render(&scene, &layers).expect("a picture"));
        });
    }
    group.finish();
}

criterion_group!(benches, pixels, frames);
criterion_main!(benches);
