//! Statistics of every octree node over every node of the time tree, against the definitions, from the raw series.

mod common;

use std::path::Path;

use chronoxel_core::octree::levels_of;
use chronoxel_core::time_tree::{num_time_levels, num_time_nodes};
use chronoxel_core::{BrickLayout, NodeFacts, NodeId, NodeStatistics, Octree, SampleType, TimeNode};
use chronoxel_ingest::{Codec, EncodeOptions, encode};
use chronoxel_store::{Store, verify};
use common::{MemorySeries, noise};

const EDGE: usize = 8;

fn options() -> EncodeOptions {
    EncodeOptions { codec: Codec::Raw, brick_edge: EDGE, ..EncodeOptions::default() }
}

fn encoded(series: &mut MemorySeries, options: &EncodeOptions, folder: &Path) -> Store {
    let path = folder.join("s.cxl");
    let options = EncodeOptions { overwrite: true, ..options.clone() };
    encode(series, &path, &options, &mut |_| {}).unwrap();
    let store = Store::open(&path).unwrap();
    let report = verify(&store, &|_, _| {});
    assert!(report.problems.is_empty(), "{:?}", report.problems);
    store
}

/// Noise, waves about zero, a ramp that stands still, one value, holes that stay, holes that move, and no data at all.
fn mixed(s: usize, [x, y, z]: [usize; 3]) -> f64 {
    match (x / 8 + 2 * (y / 8) + 3 * (z / 8)) % 8 {
        0 => 2.0 + noise((s * 7 + x + 100 * (y + 100 * z)) as u64),
        1 => (0.7 * s as f64 + 0.3 * x as f64).sin() * (0.2 * y as f64).cos(),
        2 => (x + 2 * y) as f64,
        3 => 3.0,
        4 if (x + y + z).is_multiple_of(5) => f64::NAN,
        4 => 1.0 + (s * x) as f64 * 0.01,
        5 if (x + y + z + s / 3).is_multiple_of(7) => f64::NAN,
        5 => -4.0 + noise((s + x * 31 + y * 7 + z) as u64),
        6 => f64::NAN,
        _ if s < 5 => -0.0,
        _ => 0.0,
    }
}

/// Every time node of a series.
fn time_nodes(num_steps: u32) -> impl Iterator<Item = TimeNode> {
    (0..num_time_levels(num_steps)).flat_map(move |level| {
        (0..num_time_nodes(num_steps, level)).map(move |index| TimeNode { level, index })
    })
}

/// Plain sums over the raw series.
struct Brute<'a> {
    series: &'a MemorySeries,
    /// Of the variable, where given.
    range: Option<[f64; 2]>,
}

impl Brute<'_> {
    fn at(&self, step: usize, place: [usize; 3]) -> f64 {
        let [nx, ny, _] = self.series.grid.dims;
        let v = self.series.steps[0][step][place[0] + nx * (place[1] + ny * place[2])];
        let fits = self.series.variables[0].sample_type.fits_f32();
        if fits { f64::from(v as f32) } else { v }
    }

    /// Places of a box, cut to the grid.
    fn places(&self, low: [usize; 3], high: [usize; 3]) -> Vec<[usize; 3]> {
        let high: [usize; 3] = std::array::from_fn(|a| high[a].min(self.series.grid.dims[a]));
        (low[2]..high[2])
            .flat_map(|z| (low[1]..high[1]).flat_map(move |y| (low[0]..high[0]).map(move |x| [x, y, z])))
            .collect()
    }

    fn value_range(&self, num_steps: usize) -> f64 {
        let before = self.series.steps[0][..num_steps].iter().flatten().filter(|v| !v.is_nan());
        let [low, high] = self.range.unwrap_or_else(|| {
            before.fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], &v| [a.min(v), b.max(v)])
        });
        (high - low).max(0.0)
    }

    fn statistics(&self, node: NodeId, at: TimeNode) -> NodeStatistics {
        let steps = at.steps(self.series.times.num_steps() as u32);
        let steps = steps.start as usize..steps.end as usize;
        let size = EDGE << node.level;
        let low = node.brick().map(|b| b as usize * size);
        let places = self.places(low, low.map(|v| v + size));
        let series: Vec<Vec<f64>> =
            places.iter().map(|&p| steps.clone().map(|s| self.at(s, p)).collect()).collect();
        let all: Vec<f64> = series.iter().flatten().copied().filter(|v| !v.is_nan()).collect();
        let facts = self.facts(low, size, steps.clone());
        if all.is_empty() {
            return NodeStatistics { facts, ..NodeStatistics::EMPTY };
        }
        let [mean, std] = moments(&all);
        let guard = 0.001 * self.value_range(steps.end - 1);
        let whole = series.iter().filter(|v| v.iter().all(|v| !v.is_nan()));
        let errors: Vec<f64> = whole
            .map(|v| {
                let [mean, std] = moments(v);
                if std == 0.0 { 0.0 } else { std / mean.abs().max(guard) }
            })
            .collect();
        let temporal_error = match facts.is_static {
            true => 0.0,
            false => errors.iter().sum::<f64>() / errors.len().max(1) as f64,
        };
        let fold = |pick: fn(f64, f64) -> f64| all.iter().copied().reduce(pick).unwrap();
        NodeStatistics { min: fold(f64::min), max: fold(f64::max), mean, std, temporal_error, facts }
    }

    /// Over core and apron of every finest brick of a box.
    fn facts(&self, low: [usize; 3], size: usize, steps: std::ops::Range<usize>) -> NodeFacts {
        let dims = self.series.grid.dims;
        let places = self.places(
            low.map(|v| v.saturating_sub(1)),
            std::array::from_fn(|a| {
                // The apron of the last brick that holds a sample.
                let end = (low[a] + size).min(dims[a].div_ceil(EDGE) * EDGE);
                end + 2
            }),
        );
        let bits = |s: usize, p| Some(self.at(s, p)).filter(|v| !v.is_nan()).map(f64::to_bits);
        let first = bits(steps.start, places[0]);
        let all = |holds: &dyn Fn(usize, [usize; 3]) -> bool| {
            steps.clone().all(|s| places.iter().all(|&p| holds(s, p)))
        };
        NodeFacts {
            is_uniform: first.is_some() && all(&|s, p| bits(s, p) == first),
            is_static: all(&|s, p| bits(s, p) == bits(steps.start, p)),
            is_masked: !all(&|s, p| bits(s, p).is_some()),
            mask_changes: !all(&|s, p| bits(s, p).is_some() == bits(steps.start, p).is_some()),
        }
    }
}

/// Mean and deviation, in two passes.
fn moments(values: &[f64]) -> [f64; 2] {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let equal = values.iter().all(|v| *v == values[0]);
    let variance = values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / n;
    if equal { [values[0], 0.0] } else { [mean, variance.sqrt()] }
}

fn tree_of(series: &MemorySeries) -> Octree {
    Octree::full(&levels_of(&series.grid, &BrickLayout::new(EDGE).unwrap()))
}

fn nodes_of(tree: &Octree) -> Vec<NodeId> {
    (0..tree.num_levels() as u8)
        .flat_map(|level| tree.nodes(level).iter().map(move |&morton| NodeId { level, morton }))
        .collect()
}

fn assert_near(found: f64, expected: f64, tolerance: f64, what: &str) {
    let near = (found - expected).abs() <= tolerance || found.is_nan() && expected.is_nan();
    assert!(near, "{what}: {found:e} and not {expected:e}");
}

fn compare(store: &Store, brute: &Brute<'_>, what: &str) {
    let nodes = nodes_of(&tree_of(brute.series));
    for at in time_nodes(brute.series.times.num_steps() as u32) {
        let of_nodes = store.statistics(0, at).unwrap();
        assert_eq!(of_nodes.len(), nodes.len());
        for (&node, found) in nodes.iter().zip(&of_nodes) {
            let expected = brute.statistics(node, at);
            let what = format!("{what}, {node:?}, {at:?}");
            let scale = expected.min.abs().max(expected.max.abs());
            assert_eq!(found.facts, expected.facts, "{what}");
            assert_near(found.min, expected.min, 1e-6 * scale, &what);
            assert_near(found.max, expected.max, 1e-6 * scale, &what);
            assert!(found.is_empty() || found.min <= expected.min && found.max >= expected.max, "{what}");
            assert_near(found.mean, expected.mean, 1e-6 * scale, &what);
            assert_near(found.std, expected.std, 1e-6 * scale, &what);
            let error = expected.temporal_error;
            assert_near(found.temporal_error, error, 2e-6 * (1.0 + error), &format!("e_st, {what}"));
            assert_eq!(found.temporal_error == 0.0, found.facts.is_static && !found.is_empty(), "{what}");
        }
    }
}

#[test]
fn all_nodes_of_both_trees_have_what_the_definitions_give() {
    let folder = tempfile::tempdir().unwrap();
    for num_steps in [1, 2, 7, 8, 13, 36] {
        for sample_type in [SampleType::F32, SampleType::F64] {
            let mut series = MemorySeries::of([21, 18, 11], sample_type, num_steps, mixed);
            let store = encoded(&mut series, &options(), folder.path());
            assert_eq!(store.time_tree().unwrap().stride, 1);
            compare(&store, &Brute { series: &series, range: None }, &format!("{num_steps} {sample_type}"));
        }
    }
}

#[test]
fn codecs_that_use_time_have_the_same_statistics_and_a_given_range_is_the_guards() {
    let folder = tempfile::tempdir().unwrap();
    let mut series = MemorySeries::of([21, 18, 11], SampleType::F32, 19, mixed);
    let bound = EncodeOptions { codec: Codec::Auto, max_error: Some(0.01), window: Some(4), ..options() };
    for (codec, range) in
        [(bound.clone(), None), (bound, Some([-5.0, 1000.0])), (options(), Some([-5.0, 45.0]))]
    {
        let store = encoded(&mut series, &EncodeOptions { range, ..codec }, folder.path());
        compare(&store, &Brute { series: &series, range }, &format!("{range:?}"));
    }
}

#[test]
fn means_of_zero_are_guarded() {
    let folder = tempfile::tempdir().unwrap();
    let phase = |x: usize| std::f64::consts::TAU * x as f64 / 8.0;
    let wave = |s: usize, [x, ..]: [usize; 3]| (phase(s) + phase(x)).sin();
    let mut series = MemorySeries::of([16, 9, 8], SampleType::F64, 16, wave);
    let store = encoded(&mut series, &options(), folder.path());
    // Whole periods: mean 0, deviation 1/√2, in thousandths of a range of 2.
    for at in
        [TimeNode { level: 3, index: 0 }, TimeNode { level: 3, index: 1 }, TimeNode { level: 4, index: 0 }]
    {
        for found in store.statistics(0, at).unwrap() {
            assert!((found.temporal_error - 0.5f64.sqrt() / 0.002).abs() < 1e-3, "{found:?}");
            assert!((found.spatial_error(2.0) - 0.5f64.sqrt() / 0.002).abs() < 1e-3, "{found:?}");
        }
    }
}

#[test]
fn where_means_are_not_small_the_papers_value_is_ours() {
    let folder = tempfile::tempdir().unwrap();
    let field = |s: usize, [x, y, z]: [usize; 3]| 5.0 + 3.0 * noise((s * 7 + x + 100 * (y + 100 * z)) as u64);
    let mut series = MemorySeries::of([16, 16, 8], SampleType::F32, 11, field);
    let store = encoded(&mut series, &options(), folder.path());
    let brute = Brute { series: &series, range: None };
    for at in time_nodes(11).filter(|at| at.level > 0) {
        let steps = at.steps(11);
        if steps.len() == 1 {
            continue;
        }
        let papers: f64 = (0..16 * 16 * 8)
            .map(|i| {
                let place = [i % 16, i / 16 % 16, i / 256];
                let values: Vec<f64> = steps.clone().map(|s| brute.at(s as usize, place)).collect();
                let [mean, std] = moments(&values);
                std / mean
            })
            .sum::<f64>()
            / (16.0 * 16.0 * 8.0);
        let root = store.statistics(0, at).unwrap().pop().unwrap();
        assert!(
            (root.temporal_error / papers - 1.0).abs() < 1e-5,
            "{at:?}: {} {papers}",
            root.temporal_error
        );
    }
}

#[test]
fn the_ends_of_the_number_range_have_statistics() {
    let folder = tempfile::tempdir().unwrap();
    let cases: [(SampleType, f64); 4] = [
        (SampleType::F64, 0.4 * f64::MAX),
        (SampleType::F64, 1e-305),
        (SampleType::F32, f64::from(f32::MAX)),
        (SampleType::F32, f64::from(f32::MIN_POSITIVE)),
    ];
    for (sample_type, size) in cases {
        let mut series = MemorySeries::of([9, 8, 8], sample_type, 8, |s, [x, ..]| match x < 4 {
            true if s % 2 == 0 => size,
            true => -size,
            false => size,
        });
        let store = encoded(&mut series, &options(), folder.path());
        let root = store.statistics(0, TimeNode::root(8)).unwrap().pop().unwrap();
        // Mean 0 and deviation `size` in four ninths of the samples; the range is twice `size`.
        let expected = 4.0 / 9.0 / 0.002;
        // A thousandth of the smallest range is denormal, and has fewer digits.
        assert!((root.temporal_error / expected - 1.0).abs() < 2e-5, "{size:e}: {root:?}");
        // What is beyond single precision is stored as its smallest number.
        let mean = (5.0 / 9.0 * size).max(f32::from_bits(1).into());
        assert!((root.mean / mean - 1.0).abs() < 1e-6, "{size:e}: {root:?}");
    }
}
