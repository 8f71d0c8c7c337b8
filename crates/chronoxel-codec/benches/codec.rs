//! Bytes of `f32` input per second of the encoders, and samples per second of the decoders: `cargo bench -p chronoxel-codec`.

use std::hint::black_box;

use chronoxel_codec::{
    CellCodecOptions, Indices, OneWorker, Payload, Stage, Table, UnitWindow, decode_f64, decode_resident,
    decoded_range, encode_cells, product_palette, vector_palette,
    vq::{Entries, InstructionSet, Vectors, nearest_with},
};
use chronoxel_core::BrickLayout;
use criterion::{Criterion, Throughput};

/// Numbers in [0, 1) of a linear congruence.
fn random() -> impl FnMut() -> f32 {
    let mut state = 1u32;
    move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    }
}

/// Moving waves with a little noise over the steps of a window, core and apron; trained on the core.
fn window(layout: &BrickLayout, num_steps: usize) -> UnitWindow {
    let mut random = random();
    let (full, core) = (layout.full_edge(), layout.low..layout.low + layout.edge);
    let at = |i: usize| [i % full, i / full % full, i / full / full];
    let mut wave = |i: usize, t: usize| {
        let [x, y, z] = at(i).map(|c| c as f32);
        let t = 0.2 * t as f32;
        (x * 0.31 + t).sin() * (y * 0.17 - t).cos() + (z * 0.23 + x * 0.15 + 2.0 * t).sin() + 0.1 * random()
    };
    let steps: Vec<Vec<f32>> =
        (0..num_steps).map(|t| (0..layout.num_full()).map(|i| wave(i, t)).collect()).collect();
    let steps: Vec<&[f32]> = steps.iter().map(|step| &step[..]).collect();
    let in_core = |&i: &u32| at(i as usize).iter().all(|c| core.contains(c));
    UnitWindow::new(&steps, (0..layout.num_full() as u32).filter(in_core).collect()).expect("finite samples")
}

fn encode(criterion: &mut Criterion) {
    let layout = BrickLayout::new(32).expect("a valid edge");
    let mut group = criterion.benchmark_group("product_palette");
    for num_steps in [1, 2, 4, 8, 16] {
        let window = window(&layout, num_steps);
        // The input is the core: the apron is the encoder's own.
        group.throughput(Throughput::Bytes((4 * num_steps * layout.num_core()) as u64));
        group.bench_function(format!("window {num_steps}"), |b| {
            b.iter(|| product_palette(black_box(&window), 8));
        });
    }
}

fn encode_vectors(criterion: &mut Criterion) {
    let layout = BrickLayout::new(32).expect("a valid edge");
    let mut group = criterion.benchmark_group("vector_palette");
    for num_steps in [2, 4, 8, 16] {
        let window = window(&layout, num_steps);
        group.throughput(Throughput::Bytes((4 * num_steps * layout.num_core()) as u64));
        group.bench_function(format!("window {num_steps}"), |b| {
            b.iter(|| vector_palette(black_box(&window), 256));
        });
    }
    let window = window(&layout, 8);
    let vectors = Vectors { values: &window.values, len: window.num_samples() };
    let palette = vector_palette(&window, 256);
    let entry = |e: usize| (0..8).map(move |t| t * 256 + e);
    let values = (0..256).flat_map(|e| entry(e).map(|at| palette.values[at])).collect();
    let entries = Entries { values, prices: vec![0.0; 256] };
    for set in InstructionSet::available() {
        group.bench_function(format!("nearest of 256, window 8, {set:?}"), |b| {
            b.iter(|| nearest_with(set, black_box(vectors), &entries));
        });
    }
}

fn stage(layout: &BrickLayout, num_rows: usize, largest: u16) -> Stage {
    let mut random = random();
    let indices = (0..layout.num_full()).map(|_| (random() * f32::from(largest)) as u8).collect();
    let entries = (0..num_rows * 256).map(|_| (random() * 65535.0) as u16).collect();
    let table = match num_rows {
        0 => Table::Affine { offset: -1.0, scale: 0.01 },
        _ => Table::Listed { offset: -1.0, scale: 1e-5, num_rows, entries },
    };
    Stage { indices: Indices::U8(indices), table, shift: 0 }
}

fn decode(criterion: &mut Criterion) {
    let layout = BrickLayout::new(32).expect("a valid edge");
    let [affine, listed, residual] =
        [(0, 256), (8, 256), (8, 200)].map(|(num_rows, largest)| stage(&layout, num_rows, largest));
    let payloads = [
        ("affine 8", vec![affine]),
        ("listed 8", vec![listed.clone()]),
        ("listed 8 + listed 8", vec![listed.clone(), residual.clone()]),
        ("three of listed 8", vec![listed.clone(), residual.clone(), listed]),
    ];
    for (name, stages) in payloads {
        let payload = Payload { stages };
        let mut group = criterion.benchmark_group("decode");
        group.throughput(Throughput::Elements(layout.num_full() as u64));
        group.bench_function(format!("{name}, resident"), |b| {
            b.iter(|| decode_resident(black_box(&payload), &layout, 3, None));
        });
        group.bench_function(format!("{name}, f64"), |b| {
            b.iter(|| decode_f64(black_box(&payload), &layout, 3));
        });
        group.throughput(Throughput::Elements(8 * layout.num_full() as u64));
        group.bench_function(format!("{name}, range of 8 steps"), |b| {
            b.iter(|| decoded_range(black_box(&payload), &layout, 8));
        });
    }
}

/// 64 steps at the points of a mesh of 40,960, which fade to zero.
fn cells(criterion: &mut Criterion) {
    let value = |p: usize, t: usize| (0.5 + 0.5 * (p as f32 * 0.37).sin()) * (1.0 - t as f32 / 63.0);
    let steps: Vec<Vec<f32>> = (0..64).map(|t| (0..40_960).map(|p| value(p, t)).collect()).collect();
    let steps: Vec<&[f32]> = steps.iter().map(Vec::as_slice).collect();
    let mut group = criterion.benchmark_group("cells");
    group.sample_size(10);
    group.throughput(Throughput::Elements(64 * 40_960));
    let options = CellCodecOptions::default();
    group.bench_function("encode 64 steps, 256 entries", |b| {
        b.iter(|| encode_cells(black_box(&steps), &options, &OneWorker));
    });
    let spans = encode_cells(&steps, &options, &OneWorker).expect("valid steps");
    let mut values = vec![0.0; 40_960];
    group.throughput(Throughput::Elements(40_960));
    group.bench_function("decode a step", |b| {
        b.iter(|| spans[0].decode(black_box(17), &mut values));
    });
    group.finish();
}

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    encode(&mut criterion);
    encode_vectors(&mut criterion);
    decode(&mut criterion);
    cells(&mut criterion);
    criterion.final_summary();
}
