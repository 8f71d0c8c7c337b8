//! Polygons per second of the incremental slicer, beside slicers that begin anew with every plane.

#![allow(missing_docs, reason = "what the macro makes has none")]

use std::hint::black_box;

use chronoxel_core::{Camera, UniformGrid};
use chronoxel_render::{SliceList, SliceOrder, Slicer};
use criterion::{Criterion, Throughput, criterion_group, criterion_main};

mod force;

use force::{ByForce, Polygons};

/// 16 x 16 x 16 bricks of 32 voxels.
fn bricks() -> (UniformGrid, Vec<[[f64; 3]; 2]>) {
    let grid = UniformGrid::new([513; 3], [0.0; 3], [1.0; 3]).expect("a grid");
    let at = |i: usize| [i % 16, i / 16 % 16, i / 256].map(|b| (b * 32) as f64);
    let boxes = (0..4096).map(|i| [at(i), at(i).map(|low| low + 32.0)]).collect();
    (grid, boxes)
}

fn slices(c: &mut Criterion) {
    let (grid, boxes) = bricks();
    for (view, azimuth, elevation) in
        [("oblique", 30.0, 20.0), ("diagonal", 45.0, 35.264), ("axis", 0.0, 0.0)]
    {
        let camera =
            Camera::orbit(grid.bounds(), azimuth, elevation, 1.0, Some(30.0), 1.0).expect("a camera");
        for distance in [0.5, 1.0, 2.0, 4.0] {
            let order = SliceOrder::BackToFront;
            let slicer = Slicer::of_camera_in_voxels(&camera, &grid, distance, order).expect("a slicer");
            let mut list = SliceList::default();
            let incremental = |list: &mut SliceList| {
                list.clear();
                for bounds in &boxes {
                    slicer.slice(black_box(*bounds), list).expect("few slices");
                }
            };
            incremental(&mut list);
            let mut group = c.benchmark_group(format!("{view}, {distance} voxels apart"));
            group.sample_size(20);
            group.throughput(Throughput::Elements(list.num_polygons() as u64));
            group.bench_function("incremental", |b| b.iter(|| incremental(&mut list)));
            let force = ByForce::new(&camera, distance);
            let mut polygons = Polygons::default();
            let mut by_force = |cut: fn(&ByForce, [[f64; 3]; 2], &mut Polygons)| {
                polygons.clear();
                boxes.iter().for_each(|bounds| cut(&force, black_box(*bounds), &mut polygons));
                polygons.num_polygons()
            };
            assert!(by_force(ByForce::sorted).abs_diff(list.num_polygons()) <= 4096, "the same polygons");
            assert_eq!(by_force(ByForce::sorted), by_force(ByForce::walked));
            group.bench_function("brute force, sorted", |b| b.iter(|| by_force(ByForce::sorted)));
            group.bench_function("brute force, walked", |b| b.iter(|| by_force(ByForce::walked)));
            group.finish();
        }
    }
}

criterion_group!(benches, slices);
criterion_main!(benches);
