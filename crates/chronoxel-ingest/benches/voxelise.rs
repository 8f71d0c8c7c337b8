//! Tests of tetrahedra against boxes, samples found, and samples computed along the map, per second.
//!
//! `CHRONOXEL_BENCH_THREADS` sets the number of threads, 2 by default.

#![allow(missing_docs, reason = "criterion's macros make public items")]

use std::hint::black_box;

use chronoxel_core::BrickLayout;
use chronoxel_ingest::voxelise::apply::{BrickPlace, apply};
use chronoxel_ingest::voxelise::map::BrickMap;
use chronoxel_ingest::voxelise::overlap::Shape;
use chronoxel_ingest::voxelise::raster::{Raster, Wanted};
use chronoxel_ingest::voxelise::records::Tetrahedron;
use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use rayon::prelude::*;

/// The five tetrahedra of a cell, of which every other is mirrored.
const FIVE: [[[usize; 4]; 5]; 2] = [
    [[0, 5, 3, 6], [1, 3, 0, 5], [2, 0, 3, 6], [4, 5, 0, 6], [7, 3, 5, 6]],
    [[1, 2, 4, 7], [0, 1, 2, 4], [3, 2, 1, 7], [5, 1, 4, 7], [6, 4, 2, 7]],
];

/// A brick of 32 samples and a mesh over it whose cells are `cell` samples wide and bent a little.
struct Brick {
    layout: BrickLayout,
    places: Vec<[f64; 3]>,
    tetrahedra: Vec<Tetrahedron>,
}

impl Brick {
    fn new(cell: f64) -> Self {
        let n = (36.0 / cell).ceil() as usize + 1;
        let at = |i: usize| [i % n, i / n % n, i / n / n];
        let bent = |[x, y, z]: [f64; 3]| {
            [
                x + 0.2 * cell * (0.3 * y).sin(),
                y + 0.2 * cell * (0.2 * z).cos(),
                z + 0.2 * cell * (0.4 * x).sin(),
            ]
        };
        let places = (0..n * n * n).map(|i| bent(at(i).map(|p| p as f64 * cell))).collect();
        let mut tetrahedra = Vec::new();
        for first in (0..n * n * n).filter(|&i| at(i).iter().all(|p| p + 1 < n)) {
            let corner = |c: usize| first + (c & 1) + n * (c >> 1 & 1) + n * n * (c >> 2);
            for four in FIVE[at(first).iter().sum::<usize>() % 2] {
                tetrahedra.push(Tetrahedron { vertices: four.map(|c| corner(c) as u32) });
            }
        }
        Self { layout: BrickLayout::new(32).unwrap(), places, tetrahedra }
    }

    fn map(&self) -> BrickMap {
        let mut raster = Raster::new(0, [0; 3], &self.layout, Wanted::All);
        raster.push(&self.tetrahedra, &self.places);
        raster.finish()
    }
}

fn overlaps(criterion: &mut Criterion) {
    let brick = Brick::new(3.0);
    let mut group = criterion.benchmark_group("overlap");
    // Eight boxes that share a corner, as octants do.
    let boxes: Vec<[[f64; 3]; 2]> = (0..8)
        .map(|octant| {
            let low = [0, 1, 2].map(|a| if octant >> a & 1 != 0 { 16.0 } else { 0.0 });
            [low, low.map(|v| v + 16.0)]
        })
        .collect();
    group.throughput(Throughput::Elements((8 * brick.tetrahedra.len()) as u64));
    group.bench_function("octants", |bencher| {
        bencher.iter(|| {
            let count = |tetrahedron: &Tetrahedron| {
                let shape = Shape::new(tetrahedron.corners(&brick.places));
                boxes.iter().filter(|[low, high]| shape.overlaps(*low, *high)).count()
            };
            black_box(
                brick
                    .tetrahedra
                    .par_chunks(512)
                    .map(|part| part.iter().map(count).sum::<usize>())
                    .sum::<usize>(),
            )
        });
    });
    group.finish();
}

/// Bricks worked on at once, so that all threads have some.
const NUM_BRICKS: usize = 16;

fn samples(criterion: &mut Criterion) {
    for cell in [1.5, 3.0, 8.0] {
        let brick = Brick::new(cell);
        let num_samples = (NUM_BRICKS * brick.layout.num_full()) as u64;
        let mut group = criterion.benchmark_group("samples");
        group.throughput(Throughput::Elements(num_samples));
        group.bench_function(BenchmarkId::new("find", cell), |bencher| {
            bencher.iter(|| (0..NUM_BRICKS).into_par_iter().map(|_| brick.map().runs.len()).sum::<usize>());
        });
        let map = brick.map();
        let values: Vec<f32> = brick.places.iter().map(|p| (0.2 * p[0]).sin() as f32 + p[1] as f32).collect();
        let mut out = vec![vec![0f32; brick.layout.num_full()]; NUM_BRICKS];
        group.bench_function(BenchmarkId::new("apply", cell), |bencher| {
            let at = BrickPlace { depth: 0, brick: [0; 3] };
            bencher.iter(|| {
                out.par_iter_mut()
                    .for_each(|out| apply(&map, at, &brick.layout, &brick.places, &values, out));
            });
        });
        group.finish();
    }
}

fn configured() -> Criterion {
    let threads = std::env::var("CHRONOXEL_BENCH_THREADS").ok().and_then(|n| n.parse().ok()).unwrap_or(2);
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build_global()
        .expect("the first pool of the process");
    Criterion::default().sample_size(20)
}

criterion_group! { name = benches; config = configured(); targets = overlaps, samples }
criterion_main!(benches);
