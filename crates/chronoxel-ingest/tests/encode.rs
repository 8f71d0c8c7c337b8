//! Series in, stores out: what comes back, and how closely.

mod common;

use chronoxel_core::{SampleType, SpanKind};
use chronoxel_ingest::{Codec, EncodeError, EncodeOptions, EncodeReport, decode_step, encode, measure};
use chronoxel_store::Store;
use common::{MemorySeries, noise};

fn raw() -> EncodeOptions {
    EncodeOptions { codec: Codec::Raw, ..EncodeOptions::default() }
}

fn bounded(max_error: f64) -> EncodeOptions {
    EncodeOptions { max_error: Some(max_error), ..EncodeOptions::default() }
}

struct Encoded {
    _folder: tempfile::TempDir,
    store: Store,
    report: EncodeReport,
}

fn encoded(series: &mut MemorySeries, options: &EncodeOptions) -> Encoded {
    try_encoded(series, options).unwrap()
}

fn try_encoded(series: &mut MemorySeries, options: &EncodeOptions) -> Result<Encoded, EncodeError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.cxl");
    let report = encode(series, &path, options, &mut |_| {})?;
    let store = Store::open(&path).unwrap();
    // Whatever is encoded must hold what the store's own checks ask for.
    let problems = chronoxel_store::verify(&store, &|_, _| {}).problems;
    assert!(problems.is_empty(), "{problems:?}");
    Ok(Encoded { store, _folder: folder, report })
}

/// Decoded samples of a step next to the source's.
fn pairs(encoded: &Encoded, series: &MemorySeries, step: usize) -> Vec<(f64, f64)> {
    let decoded = decode_step(&encoded.store, 0, step).unwrap();
    assert_eq!(decoded.len(), series.steps[0][step].len());
    decoded.into_iter().zip(series.steps[0][step].iter().copied()).collect()
}

#[test]
fn a_constant_volume_is_constants_alone() {
    let mut series = MemorySeries::of([70, 40, 33], SampleType::F32, 2, |_, _| f64::from(0.1f32));
    let encoded = encoded(&mut series, &raw());
    let totals = encoded.store.header().totals;
    // 3 x 2 x 2 bricks, 2 x 1 x 1, 1: at both steps.
    assert_eq!((totals.constant, totals.coded, totals.empty), (2 * (12 + 2 + 1), 0, 0));
    assert!(pairs(&encoded, &series, 1).iter().all(|(d, s)| d == s));
    assert_eq!(encoded.report.steps_read, 2);
    assert_eq!(encoded.report.raw_bytes, 2 * 4 * 70 * 40 * 33);
    assert_eq!(series.slices_read, [33, 33], "each slice is read once");
}

#[test]
fn the_two_zeros_are_not_the_same_bits() {
    let zeros = |_, [x, _, _]: [usize; 3]| if x == 3 { -0.0 } else { 0.0 };
    let mut series = MemorySeries::of([8, 8, 8], SampleType::F32, 1, zeros);
    let totals = encoded(&mut series, &raw()).store.header().totals;
    assert_eq!((totals.constant, totals.coded), (0, 1));
}

#[test]
fn spans_hold_the_statistics_of_the_source() {
    // A ramp along x: brick b of 32 samples has mean 32 b + 15.5 and variance (32^2 - 1) / 12.
    let mut series = MemorySeries::of([64, 32, 32], SampleType::F32, 1, |_, [x, _, _]| x as f64);
    let encoded = encoded(&mut series, &raw());
    let spans = encoded.store.spans(0, 0, 0).unwrap();
    for (b, span) in spans.iter().enumerate() {
        let low = 32.0 * b as f64;
        assert_eq!(span.statistics.count, 32 * 32 * 32);
        assert_eq!((span.statistics.min, span.statistics.max), (low, low + 31.0));
        assert_eq!(span.statistics.mean, low + 15.5);
        assert!((span.statistics.std - (1023.0f64 / 12.0).sqrt()).abs() < 1e-10);
    }
    // The apron reaches one sample down and two up, cut to the grid.
    assert_eq!(spans[0].drawn_range, [0.0, 33.0]);
    let top = &encoded.store.spans(0, 1, 0).unwrap()[0];
    // Level 1 is the ramp 2 i but for its first sample, 1/4; the mean of 0.25, 2, 4, …, 62 is 31 + 0.25 / 32.
    assert_eq!((top.statistics.min, top.statistics.max), (0.25, 62.0));
    assert_eq!(top.statistics.mean, 31.0 + 0.25 / 32.0);
}

#[test]
fn noise_is_within_half_a_step_of_each_brick() {
    let mut series = MemorySeries::of([45, 33, 37], SampleType::F32, 1, |_, [x, y, z]| {
        f64::from(noise((x + 50 * (y + 50 * z)) as u64) as f32)
    });
    for (bits, steps) in [(8.0, 255.0), (16.0, 65535.0)] {
        let encoded = encoded(&mut series, &EncodeOptions { bits: Some(bits), ..raw() });
        let worst = pairs(&encoded, &series, 0).iter().map(|(d, s)| (d - s).abs()).fold(0.0, f64::max);
        assert!(worst <= 0.5 / steps * (1.0 + 1e-12), "{bits} bits: {worst}");
        assert!(worst > 0.4 / steps, "{bits} bits: {worst} is too good to be true");
    }
}

#[test]
fn islands_of_nan_stay_masked_and_cost_the_rest_nothing() {
    let hole = |[x, y, z]: [usize; 3]| (x / 5 + y / 3 + z / 4) % 3 == 0 || x > 40;
    let value = |_, p: [usize; 3]| if hole(p) { f64::NAN } else { 100.0 + p[0] as f64 };
    let mut series = MemorySeries::of([90, 20, 20], SampleType::F32, 1, value);
    let encoded = encoded(&mut series, &raw());
    for (decoded, source) in pairs(&encoded, &series, 0) {
        assert_eq!(decoded.is_nan(), source.is_nan());
        assert!(source.is_nan() || (decoded - source).abs() <= 0.5 * 41.0 / 65535.0);
    }
    let kinds: Vec<SpanKind> = encoded.store.spans(0, 0, 0).unwrap().iter().map(|s| s.kind).collect();
    assert_eq!(kinds[2], SpanKind::Empty);
    let nans = series.steps[0][0].iter().filter(|v| v.is_nan()).count() as u64;
    assert_eq!((encoded.report.num_masked, encoded.report.num_infinite), (nans, 0));
    let measured = measure(&encoded.store, &mut series, 0..1).unwrap();
    assert_eq!(measured.problems, [""; 0]);
}

#[test]
fn fill_values_and_infinities_are_masked() {
    let value = |_, [x, y, _]: [usize; 3]| match (x, y) {
        (0, _) => 1e20,
        (1, 0) => f64::INFINITY,
        (1, 1) => f64::NEG_INFINITY,
        _ => y as f64,
    };
    let mut series = MemorySeries::of([9, 9, 9], SampleType::F32, 1, value);
    series.variables[0].fill_value = Some(1e20);
    let encoded = encoded(&mut series, &raw());
    assert_eq!((encoded.report.num_masked, encoded.report.num_infinite), (81 + 18, 18));
    let decoded = decode_step(&encoded.store, 0, 0).unwrap();
    assert!(decoded[0].is_nan() && decoded[1].is_nan() && decoded[10].is_nan() && decoded[2] == 0.0);
    let header = encoded.store.header();
    assert_eq!((header.variables[0].min, header.variables[0].max), (Some(0.0), Some(8.0)));
}

#[test]
fn odd_shapes_come_back() {
    for dims in [[1, 1, 1], [1, 50, 3], [100, 1, 1], [1, 1, 77], [33, 32, 31], [65, 2, 34]] {
        let value = |_, [x, y, z]: [usize; 3]| (x * 3 + y * 5 + z * 7) as f64;
        let mut series = MemorySeries::of(dims, SampleType::F32, 2, value);
        let encoded = encoded(&mut series, &bounded(1e-4));
        let width = (3 * (dims[0] - 1) + 5 * (dims[1] - 1) + 7 * (dims[2] - 1)) as f64;
        for (decoded, source) in pairs(&encoded, &series, 1) {
            assert!((decoded - source).abs() <= 1e-4 * width, "{dims:?}: {decoded} for {source}");
        }
    }
}

#[test]
fn integers_up_to_16_bits_lose_nothing() {
    let wide = |low: f64, high: f64| {
        move |s: usize, [x, y, z]: [usize; 3]| {
            low + (noise((s + x * 7 + y * 1009 + z * 77_777) as u64) * (high - low + 1.0)).floor()
        }
    };
    for (sample_type, low, high) in [
        (SampleType::U8, 0.0, 255.0),
        (SampleType::I8, -128.0, 127.0),
        (SampleType::U16, 0.0, 65535.0),
        (SampleType::I16, -32768.0, 32767.0),
        (SampleType::I64, -30000.0, 30000.0),
        // Whole numbers in a type for any.
        (SampleType::F32, -500.0, 9999.0),
    ] {
        let mut series = MemorySeries::of([40, 35, 34], sample_type, 1, wide(low, high));
        for options in [raw(), bounded(0.0)] {
            let encoded = encoded(&mut series, &options);
            assert!(pairs(&encoded, &series, 0).iter().all(|(d, s)| d == s), "{sample_type}, {options:?}");
        }
    }
    // A narrow range needs no more than 8 bits.
    let mut series = MemorySeries::of([64, 32, 32], SampleType::I16, 1, wide(900.0, 1155.0));
    let encoded = encoded(&mut series, &bounded(0.0));
    let class = |level, rank: usize| encoded.store.spans(0, level, 0).unwrap()[rank].kind;
    assert!(matches!(class(0, 1), SpanKind::Coded { class: 0, .. }));
    assert!(pairs(&encoded, &series, 0).iter().all(|(d, s)| d == s));
}

#[test]
fn masked_integers_lose_nothing_either() {
    let value = |_, [x, y, z]: [usize; 3]| ((x * 7919 + y * 104_729 + z * 1_299_709) % 5000) as f64;
    let mut series = MemorySeries::of([40, 20, 20], SampleType::I16, 1, value);
    series.variables[0].fill_value = Some(77.0);
    let encoded = encoded(&mut series, &bounded(0.0));
    let masked = pairs(&encoded, &series, 0).iter().filter(|(d, _)| d.is_nan()).count();
    assert!(pairs(&encoded, &series, 0).iter().all(|(d, s)| d == s || d.is_nan() && *s == 77.0));
    assert_eq!(masked as u64, encoded.report.num_masked);
    assert!(masked > 0);
}

#[test]
fn the_error_bound_holds_whatever_the_samples() {
    let hash = |s: usize, [x, y, z]: [usize; 3]| noise((s * 31 + x * 7 + y * 1009 + z * 77_777) as u64);
    let smooth = |_: usize, [x, y, z]: [usize; 3]| (x as f64 * 0.1).sin() + (y as f64 * 0.2).cos() * z as f64;
    type Field = Box<dyn Fn(usize, [usize; 3]) -> f64>;
    let fields: Vec<(&str, Field)> = vec![
        ("noise", Box::new(hash)),
        ("smooth", Box::new(smooth)),
        ("denormal", Box::new(move |s, p| (hash(s, p) * 1000.0).floor() * f64::from(f32::from_bits(1)))),
        ("huge", Box::new(move |s, p| (hash(s, p) - 0.5) * 2.0 * f64::from(f32::MAX))),
        ("one outlier", Box::new(move |s, p| if p == [20, 3, 3] { 1e30 } else { hash(s, p) })),
        ("large offset", Box::new(move |s, p| 1e6 + hash(s, p))),
    ];
    for (name, field) in fields {
        let mut series =
            MemorySeries::of([37, 34, 33], SampleType::F32, 2, |s, p| f64::from(field(s, p) as f32));
        let all = series.steps[0].iter().flatten();
        let width = all.clone().copied().fold(f64::MIN, f64::max) - all.copied().fold(f64::MAX, f64::min);
        for max_error in [1e-2, 1e-3, 1e-4] {
            let encoded = encoded(&mut series, &bounded(max_error));
            for step in 0..2 {
                for (decoded, source) in pairs(&encoded, &series, step) {
                    assert!((decoded - source).abs() <= max_error * width, "{name}: {decoded} for {source}");
                }
            }
            let measured = measure(&encoded.store, &mut series, 0..2).unwrap();
            let errors = &measured.variables[0];
            assert!(errors.max_abs_error <= max_error * (1.0 + 1e-9), "{name}: {errors:?}");
            assert!(errors.psnr_db() >= -20.0 * max_error.log10());
        }
    }
}

#[test]
fn a_looser_bound_takes_fewer_bytes() {
    let value = |_, [x, y, z]: [usize; 3]| noise((x + 100 * y + 10_000 * z) as u64);
    let mut series = MemorySeries::of([64, 64, 32], SampleType::F64, 1, value);
    let bytes: Vec<u64> =
        [1e-5, 1e-2, 0.6].map(|e| encoded(&mut series, &bounded(e)).report.stored_bytes).into();
    assert!(bytes[0] > bytes[1] + bytes[1] / 2 && bytes[1] > 5 * bytes[2], "{bytes:?}");
}

#[test]
fn a_bound_beyond_16_bits_is_refused_by_name() {
    let value =
        |s, [x, y, z]: [usize; 3]| noise((x + 100 * y + 10_000 * z) as u64) * if s == 1 { 1.0 } else { 0.0 };
    let mut series = MemorySeries::of([40, 10, 10], SampleType::F64, 2, value);
    let error = try_encoded(&mut series, &bounded(1e-7)).err().expect("16 bits leave 7.6e-6");
    let text = error.to_string();
    for part in ["--max-error 0.0000001", "variable v", "step 1", "brick (0, 0, 0)"] {
        assert!(text.contains(part), "{text} lacks {part}");
    }
}

#[test]
fn a_given_range_is_what_errors_refer_to() {
    let value = |_, [x, y, z]: [usize; 3]| noise((x + 100 * y + 10_000 * z) as u64);
    let mut series = MemorySeries::of([40, 10, 10], SampleType::F64, 1, value);
    let options = EncodeOptions { range: Some([0.0, 1000.0]), ..bounded(1e-3) };
    let encoded = encoded(&mut series, &options);
    // An error of 1 is allowed on samples in [0, 1): constants.
    assert_eq!(encoded.store.header().totals.coded, 0);
}

#[test]
fn aprons_equal_their_neighbours_cores() {
    let value = |_, [x, y, z]: [usize; 3]| (x as f64 * 0.3).sin() * 50.0 + y as f64 + 0.1 * z as f64;
    let mut series =
        MemorySeries::of([100, 70, 40], SampleType::F32, 1, |s, p| f64::from(value(s, p) as f32));
    let encoded = encoded(&mut series, &raw());
    let store = &encoded.store;
    for level in 0..2u8 {
        let spans = store.spans(0, level, 0).unwrap();
        let full = |brick: [u32; 3]| {
            let rank = store.tree().rank(chronoxel_core::NodeId::new(level, brick)).unwrap();
            let payload = store.read_payload(0, level, &spans[rank]).unwrap();
            chronoxel_codec::decode_f64(&payload, &store.header().bricks, 0).unwrap()
        };
        let (left, right) = (full([0, 0, 0]), full([1, 0, 0]));
        let at = |v: &[f64], [x, y, z]: [usize; 3]| v[x + 35 * (y + 35 * z)];
        // Half a step of either brick, whose ranges are below 200.
        let tolerance = 200.0 / 65535.0;
        for z in 0..35 {
            for y in 0..35 {
                for (in_left, in_right) in [(32, 0), (33, 1), (34, 2)] {
                    let (a, b) = (at(&left, [in_left, y, z]), at(&right, [in_right, y, z]));
                    assert!((a - b).abs() <= tolerance, "level {level}, ({in_left}, {y}, {z}): {a} and {b}");
                }
            }
        }
    }
}

#[test]
fn several_variables_and_a_choice_of_them() {
    let mut series = MemorySeries::of([20, 20, 20], SampleType::F32, 2, |s, [x, _, _]| (s + x) as f64);
    let mut second = series.variables[0].clone();
    second.name = "w".into();
    second.sample_type = SampleType::F64;
    series.variables.push(second);
    let steps = series.steps[0].iter().map(|step| step.iter().map(|v| -v).collect()).collect();
    series.steps.push(steps);
    let both = encoded(&mut series, &raw());
    assert_eq!(both.store.header().variables.len(), 2);
    assert_eq!(decode_step(&both.store, 1, 1).unwrap()[19], -20.0);
    let one = encoded(&mut series, &EncodeOptions { variables: vec!["w".into()], ..raw() });
    assert_eq!(decode_step(&one.store, 0, 1).unwrap()[19], -20.0);
    let none = try_encoded(&mut series, &EncodeOptions { variables: vec!["q".into()], ..raw() });
    assert_eq!(none.err().unwrap().to_string(), "--variable q: the source has v, w");
}

#[test]
fn too_little_memory_is_an_error_that_says_how_much() {
    let mut series = MemorySeries::of([64, 64, 64], SampleType::F32, 1, |_, [x, _, _]| x as f64);
    let error = try_encoded(&mut series, &EncodeOptions { memory_bytes: 10_000, ..raw() }).err().unwrap();
    let EncodeError::Memory { given, needed, .. } = error else { panic!("{error}") };
    assert_eq!(given, 10_000);
    assert!(try_encoded(&mut series, &EncodeOptions { memory_bytes: needed - 1, ..raw() }).is_err());
    assert!(try_encoded(&mut series, &EncodeOptions { memory_bytes: needed, ..raw() }).is_ok());
}

#[test]
fn a_range_beyond_f64_is_refused_by_name() {
    let value = |_, [x, _, _]: [usize; 3]| if x % 2 == 0 { f64::MAX } else { -f64::MAX };
    let mut series = MemorySeries::of([9, 9, 9], SampleType::F64, 1, value);
    let text = try_encoded(&mut series, &raw()).err().unwrap().to_string();
    assert!(text.starts_with("variable v, step 0, level 0, brick (0, 0, 0): "), "{text}");
}

#[test]
fn a_step_without_data_is_fine_a_series_without_is_not() {
    let mut series =
        MemorySeries::of([40, 9, 9], SampleType::F32, 3, |s, _| if s == 1 { 1.0 } else { f64::NAN });
    let encoded = encoded(&mut series, &raw());
    assert!(decode_step(&encoded.store, 0, 0).unwrap().iter().all(|v| v.is_nan()));
    assert!(decode_step(&encoded.store, 0, 1).unwrap().iter().all(|v| *v == 1.0));
    let mut nothing = MemorySeries::of([40, 9, 9], SampleType::F32, 2, |_, _| f64::NAN);
    let error = try_encoded(&mut nothing, &raw()).err().unwrap();
    assert!(matches!(error, EncodeError::NoData { num_steps: 2, .. }), "{error}");
}
