//! Bytes of `f32` per second of processor time for each part of writing and reading raw bricks:
//! `cargo bench -p chronoxel-store`. Processor time, since the machine may be busy; Linux only.

use std::{hint::black_box, path::Path};

use chronoxel_codec::{
    Payload, PayloadClass, StageClass, decode_resident, quantize_affine, stage_from_bytes, stage_to_bytes,
};
use chronoxel_core::{
    BrickLayout, Octree, SampleType, SpanStatistics, TimeAxis, UniformGrid, octree::levels_of,
};
use chronoxel_store::{SpanContent, SpanWrite, Store, StoreDescription, StoreWriter, VariableDescription};

const NUM_BRICKS: usize = 64;

/// Processor time of the process so far, seconds.
fn processor_secs() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<f64> =
        stat.rsplit(')').next().unwrap_or("").split_whitespace().map(|f| f.parse().unwrap_or(0.0)).collect();
    fields.get(11).zip(fields.get(12)).map_or(0.0, |(user, system)| (user + system) / 100.0)
}

/// Runs something until it has used a second of processor time and prints its throughput.
fn measure(name: &str, bytes_per_run: usize, mut run: impl FnMut() -> usize) {
    let start = processor_secs();
    let (mut num_runs, mut out_bytes) = (0usize, 0);
    while processor_secs() - start < 1.0 {
        out_bytes += run();
        num_runs += 1;
    }
    let secs = processor_secs() - start;
    let in_bytes = num_runs * bytes_per_run;
    println!(
        "{name:<34} {:8.0} MB/s of f32, {:5.2} ns per sample, output {:5.1} % of input",
        in_bytes as f64 / secs / 1e6,
        4.0 * secs * 1e9 / in_bytes as f64,
        100.0 * out_bytes as f64 / in_bytes as f64
    );
}

/// Bricks of waves with noise of `noise` times their range.
fn bricks(layout: &BrickLayout, noise: f32) -> Vec<Vec<f32>> {
    let mut state = 1u32;
    let mut random = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32 - 0.5
    };
    let full = layout.full_edge();
    let wave = |b: usize, i: usize| {
        let at = [i % full, i / full % full, i / full / full].map(|c| (c + 7 * b) as f32);
        (at[0] * 0.11).sin() * (at[1] * 0.07).cos() + (at[2] * 0.13 + at[0] * 0.05).sin()
    };
    (0..NUM_BRICKS)
        .map(|b| (0..layout.num_full()).map(|i| wave(b, i) + 2.0 * noise * random()).collect())
        .collect()
}

fn parts(layout: &BrickLayout, bricks: &[Vec<f32>], bits: u8, label: &str) {
    let bytes = 4 * layout.num_full() * bricks.len();
    let class = StageClass::affine(bits);
    let quantised = || bricks.iter().map(|brick| quantize_affine(brick, false, bits).unwrap());
    measure(&format!("quantise, {bits} bits, {label}"), bytes, || {
        quantised().map(|stage| black_box(stage).indices.len() * usize::from(bits) / 8).sum()
    });
    let stages: Vec<_> = quantised().collect();
    measure(&format!("stage to bytes, {bits} bits, {label}"), bytes, || {
        stages.iter().map(|stage| black_box(stage_to_bytes(stage, layout)).len()).sum()
    });
    let raw: Vec<_> = stages.iter().map(|stage| stage_to_bytes(stage, layout)).collect();
    for level in [-5, -1, 1, 3] {
        let mut compressor = zstd::bulk::Compressor::new(level).unwrap();
        measure(&format!("zstd {level}, {bits} bits, {label}"), bytes, || {
            raw.iter().map(|raw| compressor.compress(raw).unwrap().len()).sum()
        });
    }
    measure(&format!("bytes to resident, {bits} bits, {label}"), bytes, || {
        let decode = |raw: &Vec<u8>| {
            let stages = vec![stage_from_bytes(&class, layout, raw).unwrap()];
            decode_resident(&Payload { stages }, layout, 0, None).unwrap()
        };
        raw.iter().map(|raw| 2 * black_box(decode(raw)).samples.len()).sum()
    });
}

/// Writes and reads a store of 128³ samples, level 0 only being full of data.
fn whole(layout: &BrickLayout, bricks: &[Vec<f32>], bits: u8, folder: &Path) {
    let grid = UniformGrid::new([128; 3], [0.0; 3], [1.0; 3]).unwrap();
    let num_steps = 40;
    let description = StoreDescription {
        grid,
        times: TimeAxis::regular(num_steps, 1.0, "").unwrap(),
        layout: *layout,
        tree: Octree::full(&levels_of(&grid, layout)),
        variables: vec![VariableDescription {
            name: "v".into(),
            units: String::new(),
            sample_type: SampleType::F32,
            fill_value: None,
            windows: vec![1],
            classes: vec![PayloadClass::affine(bits)],
        }],
        zstd_level: 1,
        time_tree: None,
        mesh: None,
        encoder: serde_json::Value::Null,
    };
    let path = folder.join("bench.cxl");
    let mut writer = StoreWriter::create(&path, &description, true).unwrap();
    let raw: Vec<_> = bricks
        .iter()
        .map(|brick| stage_to_bytes(&quantize_affine(brick, false, bits).unwrap(), layout))
        .collect();
    let statistics = SpanStatistics { count: 1, min: 0.0, max: 0.0, mean: 0.0, std: 0.0 };
    let (start, clock) = (processor_secs(), std::time::Instant::now());
    for step in 0..num_steps as u32 {
        for level in 0..3 {
            let span = |node_rank: u32| {
                let mut bytes = raw[node_rank as usize].clone();
                bytes[0] ^= step as u8; // so that no step equals another
                let content = SpanContent::Coded { class: 0, stages: vec![bytes] };
                let (len, window, mask, drawn_range) = (1, 1, None, [-9.0, 9.0]);
                SpanWrite { node_rank, start: step, len, window, content, mask, drawn_range, statistics }
            };
            let num_nodes = description.tree.nodes(level).len() as u32;
            writer.put(0, level, (0..num_nodes).map(span).collect()).unwrap();
        }
        writer.commit_step(step).unwrap();
    }
    let totals = writer.finish().unwrap();
    let (secs, wall) = (processor_secs() - start, clock.elapsed().as_secs_f64());
    let input = ((num_steps * 4) << 21) as f64;
    println!(
        "put and commit, {bits} bits: {:.0} MB/s of f32 per processor second, {:.0} per second, ratio {:.2}",
        input / secs / 1e6,
        input / wall / 1e6,
        input / totals.data_bytes as f64
    );
    let clock = std::time::Instant::now();
    let store = Store::open(&path).unwrap();
    println!("open: {:.2} ms", clock.elapsed().as_secs_f64() * 1e3);
    let start = processor_secs();
    for step in 0..num_steps as u32 {
        let spans = store.spans(0, 0, step).unwrap();
        store.read_payloads(0, 0, &spans).into_iter().for_each(|payload| drop(black_box(payload.unwrap())));
    }
    println!(
        "read level 0: {:.0} MB/s of f32 per processor second",
        input / (processor_secs() - start) / 1e6
    );
}

fn main() {
    let layout = BrickLayout::new(32).unwrap();
    let folder = std::env::temp_dir().join(format!("chronoxel-bench-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    for (noise, label) in [(0.0, "smooth"), (0.02, "noise 2 %"), (0.3, "noise 30 %")] {
        let bricks = bricks(&layout, noise);
        for bits in [8, 16] {
            parts(&layout, &bricks, bits, label);
            whole(&layout, &bricks, bits, &folder);
        }
    }
    std::fs::remove_dir_all(&folder).unwrap();
}
