//! Time of the colour metrics: the approximate ones for 1,000 nodes that fill all 256 entries, and the reference ones per voxel and step.

#![allow(missing_docs, reason = "criterion's macros make public items")]

use chronoxel_core::{
    BrickColors, ColorMap, ColorSpace, ColorTable, NodeFacts, NodeStatistics, ResolvedTransfer,
    TransferFunction, VoxelColors, approximate_spatial, approximate_temporal,
};
use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use rayon::prelude::*;

const NUM_NODES: usize = 1000;
const NUM_ENTRIES: usize = 256;

fn transfer() -> ResolvedTransfer {
    TransferFunction::built_in("filled", ColorMap::Turbo)
        .and_then(|function| function.resolve([0.0, 1.0]))
        .expect("built in")
}

/// Nodes over the whole range, so that every entry counts.
fn nodes() -> Vec<NodeStatistics> {
    let node = |i: usize| {
        let share = i as f64 / NUM_NODES as f64;
        NodeStatistics {
            min: 0.0,
            max: 1.0,
            mean: 0.1 + 0.8 * share,
            std: 0.02 + 0.3 * ((7.0 * share) % 1.0),
            temporal_error: share,
            facts: NodeFacts::default(),
        }
    };
    (0..NUM_NODES).map(node).collect()
}

fn approximate(c: &mut Criterion) {
    let (transfer, nodes) = (transfer(), nodes());
    let mut group = c.benchmark_group("approximate");
    group.throughput(Throughput::Elements((NUM_NODES * NUM_ENTRIES) as u64));
    for space in [ColorSpace::Rgb, ColorSpace::Luv] {
        group.bench_function(format!("{space:?}/table"), |b| {
            b.iter(|| ColorTable::new(&transfer, [0.0, 1.0], NUM_ENTRIES, space));
        });
        let table = ColorTable::new(&transfer, [0.0, 1.0], NUM_ENTRIES, space);
        let of_node = |node: &NodeStatistics| {
            approximate_spatial(&table, &transfer, node).error + approximate_temporal(&table, node)
        };
        group.bench_function(format!("{space:?}/1_thread"), |b| {
            b.iter(|| nodes.iter().map(of_node).sum::<f64>());
        });
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("two threads");
        group.bench_function(format!("{space:?}/2_threads"), |b| {
            b.iter(|| pool.install(|| nodes.par_iter().map(of_node).sum::<f64>()));
        });
    }
    group.finish();
}

fn reference(c: &mut Criterion) {
    const NUM_VOXELS: usize = 32 * 32 * 32;
    const NUM_STEPS: u32 = 16;
    let transfer = transfer();
    let sample = |i: usize, step: u32| ((i * 7919) % 10_007) as f64 / 20_014.0 + 0.03 * f64::from(step);
    let mut group = c.benchmark_group("reference");
    group.sample_size(10).throughput(Throughput::Elements(NUM_VOXELS as u64 * u64::from(NUM_STEPS)));
    for space in [ColorSpace::Rgb, ColorSpace::Luv] {
        let colors = VoxelColors::new(&transfer, space);
        group.bench_function(format!("{space:?}/brick"), |b| {
            b.iter(|| {
                let mut brick = BrickColors::new(NUM_VOXELS, NUM_STEPS);
                (0..NUM_STEPS).for_each(|step| {
                    brick.push(&colors, (0..NUM_VOXELS).map(|i| sample(i, step)));
                });
            });
        });
    }
    group.finish();
}

criterion_group!(benches, approximate, reference);
criterion_main!(benches);
