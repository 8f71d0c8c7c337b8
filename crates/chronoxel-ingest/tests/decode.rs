//! Decoding to level-0 samples, and measuring them against a source.

mod common;

use chronoxel_codec::{Payload, PayloadClass, decoded_range, quantize_affine, stage_to_bytes};
use chronoxel_core::{BitMask, BrickLayout, Octree, SampleType, SpanStatistics, TimeAxis, UniformGrid};
use chronoxel_ingest::{Codec, EncodeOptions, StepDecoder, decode_step, encode, measure};
use chronoxel_store::{SpanContent, SpanWrite, Store, StoreDescription, StoreWriter, VariableDescription};
use common::{MemorySeries, noise};

fn ramp([x, y, z]: [f64; 3]) -> f64 {
    x + 2.0 * y + 4.0 * z
}

/// A brick of the ramp at any level, exact at its samples, as a span.
fn ramp_span(
    layout: &BrickLayout,
    level: u8,
    brick: [usize; 3],
    rank: u32,
    mask: Option<BitMask>,
) -> SpanWrite {
    let full = layout.full_edge();
    let voxel = |i: usize, axis: usize| {
        ((brick[axis] * layout.edge + i) as f64 - layout.low as f64) * f64::from(1u32 << level)
    };
    let samples: Vec<f64> = (0..layout.num_full())
        .map(|i| ramp([voxel(i % full, 0), voxel(i / full % full, 1), voxel(i / full / full, 2)]))
        .collect();
    let payload = Payload { stages: vec![quantize_affine(&samples, true, 16).unwrap()] };
    let drawn_range = decoded_range(&payload, layout, 1).unwrap();
    SpanWrite {
        node_rank: rank,
        start: 0,
        len: 1,
        window: 1,
        content: SpanContent::Coded { class: 0, stages: vec![stage_to_bytes(&payload.stages[0], layout)] },
        mask,
        drawn_range,
        statistics: SpanStatistics { count: 1, min: 0.0, max: 1.0, mean: 0.5, std: 0.5 },
    }
}

/// 16³ samples of the ramp in bricks of 8³, of which only two of the eight finest exist.
fn adaptive_store(folder: &std::path::Path, mask: Option<BitMask>) -> Store {
    let layout = BrickLayout::new(8).unwrap();
    let path = folder.join("a.cxl");
    let description = StoreDescription {
        grid: UniformGrid::new([16; 3], [0.0; 3], [1.0; 3]).unwrap(),
        times: TimeAxis::regular(1, 1.0, "").unwrap(),
        layout,
        tree: Octree::from_levels(vec![vec![0, 6], vec![0]]).unwrap(),
        variables: vec![VariableDescription {
            name: "ramp".into(),
            units: String::new(),
            sample_type: SampleType::F64,
            fill_value: None,
            windows: vec![1],
            classes: vec![PayloadClass::affine(16)],
        }],
        zstd_level: 1,
        time_tree: None,
        mesh: None,
        encoder: serde_json::Value::Null,
    };
    let mut writer = StoreWriter::create(&path, &description, false).unwrap();
    let finest = vec![ramp_span(&layout, 0, [0, 0, 0], 0, None), ramp_span(&layout, 0, [0, 1, 1], 1, None)];
    writer.put(0, 0, finest).unwrap();
    writer.put(0, 1, vec![ramp_span(&layout, 1, [0, 0, 0], 0, mask)]).unwrap();
    writer.commit_step(0).unwrap();
    writer.finish().unwrap();
    Store::open(&path).unwrap()
}

#[test]
fn absent_nodes_are_interpolated_in_their_ancestor() {
    let folder = tempfile::tempdir().unwrap();
    let store = adaptive_store(folder.path(), None);
    let decoded = decode_step(&store, 0, 0).unwrap();
    for (i, value) in decoded.iter().enumerate() {
        let place = [i % 16, i / 16 % 16, i / 256].map(|p| p as f64);
        // Trilinear interpolation of a ramp is the ramp, and whole numbers are coded exactly.
        assert_eq!(*value, ramp(place), "{place:?}");
    }
}

#[test]
fn samples_whose_nearest_is_masked_are_masked() {
    let folder = tempfile::tempdir().unwrap();
    let layout = BrickLayout::new(8).unwrap();
    // Level-1 sample (6, 0, 0), which lies at voxel (12, 0, 0).
    let masked = (6 + layout.low) + 11 * (layout.low + 11 * layout.low);
    let mask = BitMask::from_flags((0..layout.num_full()).map(|i| i == masked));
    let store = adaptive_store(folder.path(), Some(mask));
    let decoded = decode_step(&store, 0, 0).unwrap();
    let nan: Vec<usize> = (0..decoded.len()).filter(|&i| decoded[i].is_nan()).collect();
    // Halfway between two samples the lower is the nearest.
    let x = |y: usize, z: usize| [12, 13].map(|x| x + 16 * (y + 16 * z));
    assert_eq!(nan, [x(0, 0), x(1, 0), x(0, 1), x(1, 1)].concat());
    // Beside it, what is masked is left out: (11, 0, 0) is its other neighbour alone.
    assert_eq!(decoded[11], 10.0);
}

#[test]
fn slabs_are_parts_of_the_step() {
    let mut series =
        MemorySeries::of([20, 11, 45], SampleType::F32, 1, |_, [x, y, z]| (x + 20 * y + 300 * z) as f64);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.cxl");
    let options = EncodeOptions { codec: Codec::Raw, brick_edge: 16, ..EncodeOptions::default() };
    encode(&mut series, &path, &options, &mut |_| {}).unwrap();
    let store = Store::open(&path).unwrap();
    let whole = decode_step(&store, 0, 0).unwrap();
    assert_eq!(whole, series.steps[0][0]);
    let decoder = StepDecoder::new(&store, 0, 0).unwrap();
    for (first, end) in [(0, 1), (15, 17), (3, 44), (44, 45), (7, 7)] {
        assert_eq!(decoder.slab(first..end).unwrap(), whole[220 * first..220 * end], "{first}..{end}");
    }
    let block = decoder.brick([1, 0, 2]).unwrap();
    assert_eq!((block.first, block.extent), ([16, 0, 32], [4, 11, 13]));
    assert_eq!(block.samples[0], whole[16 + 220 * 32]);
}

#[test]
fn measured_errors_are_those_of_the_change_made() {
    // Two values, so that 8 bits lose nothing; then the source is moved by 1/100 of the range at one step.
    let value = |_, [x, _, _]: [usize; 3]| if x % 2 == 0 { 100.0 } else { 300.0 };
    let mut series = MemorySeries::of([40, 12, 12], SampleType::F64, 3, value);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.cxl");
    encode(&mut series, &path, &EncodeOptions::default(), &mut |_| {}).unwrap();
    let store = Store::open(&path).unwrap();
    let exact = measure(&store, &mut series, 0..3).unwrap();
    assert_eq!(exact.variables[0].mse, [0.0; 3]);
    assert_eq!((exact.variables[0].max_abs_error, exact.variables[0].psnr_db()), (0.0, f64::INFINITY));

    series.steps[0][1].iter_mut().for_each(|v| *v += 2.0);
    let moved = measure(&store, &mut series, 0..3).unwrap();
    let errors = &moved.variables[0];
    assert!((errors.mse[1] - 1e-4).abs() < 1e-15 && errors.mse[0] == 0.0 && errors.mse[2] == 0.0);
    assert!((errors.max_abs_error - 0.01).abs() < 1e-12);
    let [min, max, avg] = errors.mse_range();
    assert_eq!((min, max), (0.0, errors.mse[1]));
    assert!((avg - 1e-4 / 3.0).abs() < 1e-15);
    // 10 log10(3e4)
    assert!((errors.psnr_db() - 44.771_212_547).abs() < 1e-6);
    let bits = 8.0 * store.stored_bytes().unwrap() as f64 / (3.0 * 40.0 * 144.0);
    assert!((errors.bits_per_sample / bits - 1.0).abs() < 1e-12);
    assert_eq!(moved.problems, [""; 0]);

    series.steps[0][2][40 * 12 * 5 + 40 * 4 + 33] = f64::NAN;
    let masked = measure(&store, &mut series, 2..3).unwrap();
    assert_eq!(masked.problems.len(), 1);
    assert!(masked.problems[0].contains("step 2: 1 samples") && masked.problems[0].contains("(33, 4, 5)"));
}

#[test]
fn another_source_is_refused() {
    let field = |_: usize, [x, y, z]: [usize; 3]| noise((x + 100 * (y + 100 * z)) as u64);
    let mut series = MemorySeries::of([10, 11, 12], SampleType::F64, 2, field);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.cxl");
    encode(&mut series, &path, &EncodeOptions::default(), &mut |_| {}).unwrap();
    let store = Store::open(&path).unwrap();
    let refusal = |mut other: MemorySeries| measure(&store, &mut other, 0..1).unwrap_err().to_string();
    assert!(
        refusal(MemorySeries::of([10, 11, 13], SampleType::F64, 2, field))
            .contains("dimensions [10, 11, 13]")
    );
    assert!(refusal(MemorySeries::of([10, 11, 12], SampleType::F64, 3, field)).contains("number of steps 3"));
    assert!(refusal(MemorySeries::of([10, 11, 12], SampleType::F32, 2, field)).contains("sample type f32"));
    let mut renamed = MemorySeries::of([10, 11, 12], SampleType::F64, 2, field);
    renamed.variables[0].name = "w".into();
    assert!(refusal(renamed).contains("the source has w"));
}
