//! The renderer on the GPU: both ways of decoding, beside the ray caster on the CPU, on a still step and where every
//! picture is of another step.

#![allow(missing_docs, reason = "what the macro makes has none")]

use std::sync::Arc;

use chronoxel_codec::decode_resident;
use chronoxel_core::Image;
use chronoxel_render::{
    DrawBrick, DrawHow, GpuBrick, GpuHow, GpuOptions, GpuRenderer, Method, PreparedBrick, Scene, Way, render,
};
use criterion::{Criterion, criterion_group, criterion_main};
use peers::pictures::cases::{Coding, NUM_STEPS};
use rayon::prelude::*;

mod peers;

/// Small enough for drivers in software.
const SIZE: [usize; 2] = [128, 128];

/// The list at a step of all spans.
fn at_step(list: &[GpuBrick], step: u32) -> Vec<GpuBrick> {
    let mut list = list.to_vec();
    for brick in &mut list {
        if let GpuHow::Coded(coded) = &mut brick.how {
            coded.step_in_span = step;
        }
    }
    list
}

/// The list as the CPU draws it, decoded in all threads.
fn decoded(scene: &Scene, list: &[GpuBrick]) -> Vec<DrawBrick> {
    let decode = |brick: &GpuBrick| {
        let GpuHow::Coded(coded) = &brick.how else { panic!("all bricks are coded") };
        let resident = decode_resident(&coded.payload, &scene.layout, coded.step_in_span, None);
        let prepared = PreparedBrick::new(resident.expect("it is sound"), &scene.layout);
        let how = DrawHow::Samples(Arc::new(prepared.expect("it is sound")));
        DrawBrick { node: brick.node, region: brick.region, how }
    };
    list.par_iter().map(decode).collect()
}

fn gpu(c: &mut Criterion) {
    let renderer = |way| GpuRenderer::new(&GpuOptions { way: Some(way), ..Default::default() });
    let (mut pool, mut fetch) = match (renderer(Way::Pool), renderer(Way::Fetch)) {
        (Ok(pool), Ok(fetch)) => (pool, fetch),
        (Err(e), _) | (_, Err(e)) => return println!("{e}"),
    };
    println!("{:?}", pool.info());
    let field = peers::ripples(128);
    for (function, lit) in [("sparse", false), ("filled", false), ("sparse", true), ("filled", true)] {
        let scene = Scene { size: SIZE, ..peers::scene(&field, function, [0.0, 255.0], lit) };
        let start = field.coded_list(&scene, 0, Coding::Listed);
        let steps: Vec<_> = (0..NUM_STEPS).map(|step| at_step(&start, step)).collect();
        let last = &steps[steps.len() - 1];
        let mut group = c.benchmark_group(format!("{function}{}", if lit { " lit" } else { "" }));
        group.sample_size(10);
        let bricks = decoded(&scene, last);
        group.bench_function("still, CPU", |b| b.iter(|| render(&scene, &bricks).expect("a picture")));
        group.bench_function("new steps, CPU", |b| {
            let mut steps = steps.iter().cycle();
            b.iter(|| steps.next().map(|step| render(&scene, &decoded(&scene, step)).expect("a picture")));
        });
        for (name, gpu) in [("decoded once a step", &mut pool), ("decoded at each fetch", &mut fetch)] {
            let mut draw = |list: &[GpuBrick]| -> Image { gpu.draw(&scene, list).expect("a picture").0 };
            group.bench_function(format!("still, {name}"), |b| b.iter(|| draw(last)));
            group.bench_function(format!("new steps, {name}"), |b| {
                let mut steps = steps.iter().cycle();
                b.iter(|| steps.next().map(|step| draw(step)));
            });
        }
        group.finish();
    }
}

/// Slices beside rays, on a still step.
fn methods(c: &mut Criterion) {
    let renderer = |method| GpuRenderer::new(&GpuOptions { method, ..Default::default() });
    let (mut rays, mut slices) = match (renderer(Method::Raycast), renderer(Method::Slices)) {
        (Ok(rays), Ok(slices)) => (rays, slices),
        (Err(e), _) | (_, Err(e)) => return println!("{e}"),
    };
    let field = peers::ripples(64);
    for (function, lit) in [("sparse", false), ("filled", false), ("sparse", true), ("filled", true)] {
        let scene = Scene { size: SIZE, ..peers::scene(&field, function, [0.0, 255.0], lit) };
        let list = field.coded_list(&scene, 0, Coding::Affine);
        let mut group = c.benchmark_group(format!("methods, {function}{}", if lit { " lit" } else { "" }));
        group.sample_size(10);
        for (name, gpu) in [("rays", &mut rays), ("slices", &mut slices)] {
            group.bench_function(name, |b| b.iter(|| gpu.draw(&scene, &list).expect("a picture").0));
        }
        group.finish();
    }
}

criterion_group!(benches, gpu, methods);
criterion_main!(benches);
