//! Codecs that use time: windows out of phase, masks that move, short series, scratch files, interruptions.

mod common;
#[path = "common/files.rs"]
mod files;

use std::fs;
use std::path::Path;

use chronoxel_core::{SampleType, SpanKind};
use chronoxel_ingest::{Codec, EncodeError, EncodeOptions, decode_step, encode, measure};
use chronoxel_store::{Store, verify};
use common::{MemorySeries, noise};
use files::{copy_folder, files_of};

/// Every codec that uses time, with a name for messages.
fn codecs() -> [(&'static str, EncodeOptions); 5] {
    let stages = Some(2);
    [
        ("palette", options(Codec::Palette)),
        ("slice", options(Codec::PaletteSlice)),
        ("vq", EncodeOptions { stages, ..options(Codec::Vq) }),
        ("bound", EncodeOptions { max_error: Some(2e-3), ..options(Codec::Auto) }),
        ("rate", EncodeOptions { bits: Some(2.5), ..options(Codec::Auto) }),
    ]
}

/// Waves that move, noise, holes that come and go, a quiet corner, and steps without any data.
fn moving(dims: [usize; 3], num_steps: usize) -> MemorySeries {
    MemorySeries::of(dims, SampleType::F32, num_steps, |s, [x, y, z]| match (x / 12 + y / 12 + z / 12) % 4 {
        0 => f64::from((0.3 * (x as f32 + 0.5 * s as f32)).sin() * (0.2 * y as f32).cos()),
        1 if s % 7 == 3 => f64::NAN,
        1 => noise((s * 7 + x + 100 * (y + 100 * z)) as u64),
        2 if (x + y + z + s / 3) % 11 == 0 => f64::NAN,
        2 => 0.1 * (z + s) as f64,
        _ => 3.0,
    })
}

fn options(codec: Codec) -> EncodeOptions {
    EncodeOptions {
        codec,
        window: Some(4),
        brick_edge: 16,
        source_name: "moving".into(),
        ..EncodeOptions::default()
    }
}

fn run(series: &mut MemorySeries, path: &Path, options: &EncodeOptions) -> Result<(), EncodeError> {
    encode(series, path, options, &mut |_| {}).map(|_| ())
}

fn assert_sound(path: &Path) -> Store {
    let store = Store::open(path).unwrap();
    let report = verify(&store, &|_, _| {});
    assert!(report.problems.is_empty(), "{:?}", report.problems);
    store
}

#[test]
fn windows_cover_every_step_of_every_node_out_of_phase() {
    let folder = tempfile::tempdir().unwrap();
    for (name, options) in codecs() {
        for num_steps in [1, 2, 5, 11] {
            let path = folder.path().join(format!("{name}-{num_steps}.cxl"));
            let mut series = moving([40, 33, 20], num_steps);
            run(&mut series, &path, &options).unwrap();
            let store = assert_sound(&path);
            assert!(store.is_complete());
            // Masks are exact; errors are those of a palette.
            let found = measure(&store, &mut series, 0..num_steps).unwrap();
            assert!(found.problems.is_empty(), "{:?}", found.problems);
            let bound = options.max_error.unwrap_or(1.0);
            assert!(found.variables[0].max_abs_error <= bound, "{name}: {:?}", found.variables[0]);
        }
    }
}

#[test]
fn a_step_replaces_about_one_payload_in_four() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.cxl");
    let mut series = MemorySeries::of([64, 64, 64], SampleType::F32, 12, |s, [x, y, z]| {
        noise((s * 7 + x + 100 * (y + 100 * z)) as u64)
    });
    run(&mut series, &path, &options(Codec::Palette)).unwrap();
    let store = assert_sound(&path);
    for step in 4..12 {
        let spans = store.spans(0, 0, step).unwrap();
        assert!(spans.iter().all(|span| matches!(span.kind, SpanKind::Coded { .. })));
        let replaced = spans.iter().filter(|span| span.start == step).count();
        assert_eq!(replaced, 16, "of 64, at step {step}");
    }
}

#[test]
fn threads_memory_and_the_scratch_file_do_not_change_a_byte() {
    let folder = tempfile::tempdir().unwrap();
    let mut series = moving([40, 33, 20], 6);
    for (name, options) in codecs() {
        let tiny = EncodeOptions { memory_bytes: 1, ..options.clone() };
        let least = match run(&mut series, &folder.path().join("x.cxl"), &tiny) {
            Err(EncodeError::Memory { needed, .. }) => needed,
            other => panic!("{other:?}"),
        };
        let mut expected = None;
        for (threads, memory_bytes) in [(1, 1 << 30), (4, 1 << 30), (1, least), (3, 3 * least)] {
            let path = folder.path().join(format!("{name}-{threads}-{memory_bytes}.cxl"));
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let options = EncodeOptions { memory_bytes, ..options.clone() };
            pool.install(|| run(&mut series, &path, &options)).unwrap();
            let files = files_of(&path);
            let expected = expected.get_or_insert_with(|| files.clone());
            assert!(*expected == files, "{name}, {threads} threads, {memory_bytes} bytes");
        }
    }
}

#[test]
fn a_resume_inside_windows_gives_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    for (name, options) in codecs() {
        let path_of = |what: &str| folder.path().join(format!("{name}-{what}.cxl"));
        // The range grows: a bound that is relative to it must be the same after a resume.
        let mut series = moving([70, 50, 34], 10);
        for (step, samples) in series.steps[0].iter_mut().enumerate() {
            samples[0] = (1 + step * step) as f64;
        }
        run(&mut series, &path_of("whole"), &options).unwrap();
        let whole = files_of(&path_of("whole"));
        for broken_step in [3, 9] {
            let path = path_of("broken");
            series.broken_step = Some(broken_step);
            let error = run(&mut series, &path, &options).unwrap_err();
            series.broken_step = None;
            let kept = path_of("broken.partial");
            assert_eq!(kept.exists(), matches!(error, EncodeError::Interrupted { .. }), "{error}");
            if kept.exists() {
                let found = Store::open(&kept).unwrap().header().num_steps_finished as usize;
                // Open windows, and those that share a row with one, lag behind by less than twice their length.
                assert!(found + 8 > broken_step && found <= broken_step, "{found} of {broken_step}");
            }
            series.slices_read.fill(0);
            run(&mut series, &path, &EncodeOptions { resume: true, ..options.clone() }).unwrap();
            if broken_step > 4 {
                let read = &series.slices_read;
                assert!(read[..broken_step - 4].iter().all(|&n| n == 0), "{name} reads {read:?}");
            }
            assert!(files_of(&path) == whole, "{name}, broken at {broken_step}");
            fs::remove_dir_all(&path).unwrap();
        }
        // Killed in the middle of a step, that is: copied as it lies there.
        let killed = path_of("killed");
        encode(&mut series, &path_of("watched"), &options, &mut |done| {
            if done.step == 7 && !killed.exists() {
                copy_folder(&path_of("watched"), &killed);
            }
        })
        .unwrap();
        run(&mut series, &killed, &EncodeOptions { resume: true, ..options.clone() }).unwrap();
        assert!(files_of(&killed) == whole, "{name}, killed");
    }
}

#[test]
fn a_rate_is_met_by_the_whole_store() {
    let folder = tempfile::tempdir().unwrap();
    // Quiet at first, busy later, in one half of the volume.
    let mut series =
        MemorySeries::of([64, 64, 64], SampleType::F32, 12, |s, [x, y, z]| match x < 32 || s < 4 {
            true => (0.05 * (x + 2 * y + s) as f64).sin(),
            false => (0.3 * (x + s * y) as f64).sin() * (0.4 * z as f64).cos(),
        });
    let mut last = f64::INFINITY;
    for bits in [0.25, 0.5, 1.5] {
        let path = folder.path().join(format!("{bits}.cxl"));
        let options = EncodeOptions { bits: Some(bits), brick_edge: 32, ..options(Codec::Auto) };
        run(&mut series, &path, &options).unwrap();
        let found = measure(&assert_sound(&path), &mut series, 0..12).unwrap();
        let [_, _, mse] = found.variables[0].mse_range();
        let stored = found.variables[0].bits_per_sample;
        assert!(stored <= bits && stored > 0.6 * bits, "{stored} bits per sample for {bits}");
        assert!(mse < last / 4.0, "{mse:e} at {bits} bits after {last:e}");
        last = mse;
    }
}

/// Infinities and NaN, denormals, huge samples, constants and bricks of two values, in time as well as in space.
#[test]
fn nothing_that_a_float_can_be_breaks_a_codec() {
    type Field = fn(usize, [usize; 3]) -> f64;
    let fields: [(&str, Field); 7] = [
        ("infinite", |s, [x, y, _]| if (x + s) % 5 == 0 { f64::INFINITY } else { (x * y) as f64 }),
        ("nan for a while", |s, [x, y, z]| if s % 3 == 1 { f64::NAN } else { (x + y * z + s) as f64 }),
        ("all nan but one", |s, p| if p == [3, 2, 1] { s as f64 } else { f64::NAN }),
        ("denormal", |s, [x, y, z]| f64::from(f32::from_bits(((x + 3 * y + z) * (s + 1)) as u32))),
        ("huge", |s, [x, _, z]| if (x + z + s) % 2 == 0 { 3e38 } else { -3e38 }),
        ("constant", |_, _| f64::from(-0.1f32)),
        ("two values", |s, [x, y, z]| if (x ^ y ^ z ^ s) & 1 == 0 { 7.25 } else { f64::from(1e-20f32) }),
    ];
    let folder = tempfile::tempdir().unwrap();
    for (what, field) in fields {
        for sample_type in [SampleType::F32, SampleType::F64] {
            let mut series = MemorySeries::of([20, 9, 10], sample_type, 6, field);
            // Rate control tries much: once is enough.
            let tried = |name: &str| name != "rate" || sample_type == SampleType::F32;
            for (name, options) in codecs().into_iter().filter(|(name, _)| tried(name)) {
                let path = folder.path().join("s.cxl");
                let options = EncodeOptions { overwrite: true, brick_edge: 8, ..options };
                run(&mut series, &path, &options).unwrap_or_else(|e| panic!("{what}, {name}: {e}"));
                let store = assert_sound(&path);
                let found = measure(&store, &mut series, 0..6).unwrap();
                assert!(found.problems.is_empty(), "{what}, {name}: {:?}", found.problems);
                let bound = options.max_error.unwrap_or(1.0);
                let largest = found.variables[0].max_abs_error;
                assert!(largest <= bound, "{what}, {name}: {largest}");
                if ["constant", "two values"].contains(&what) && name != "rate" && name != "slice" {
                    assert!(largest <= 1e-5, "{what}, {name}: {largest}");
                }
            }
        }
    }
}

#[test]
fn integers_are_lossless_at_a_bound_of_zero() {
    let folder = tempfile::tempdir().unwrap();
    for (sample_type, most) in
        [(SampleType::U8, 255.0), (SampleType::U16, 65535.0), (SampleType::I16, 32767.0)]
    {
        let mut series = MemorySeries::of([33, 20, 17], sample_type, 9, |s, [x, y, z]| {
            let moving = 0.5 + 0.5 * (0.2 * (x + y) as f64 + 0.1 * (z + s) as f64).sin();
            if x > 20 {
                (most * noise((x * 31 + y * 7 + z * 3 + s / 4) as u64)).floor()
            } else {
                (most * moving).floor()
            }
        });
        let path = folder.path().join(format!("{sample_type}.cxl"));
        let exact = EncodeOptions { max_error: Some(0.0), ..options(Codec::Auto) };
        run(&mut series, &path, &exact).unwrap();
        let store = assert_sound(&path);
        for step in 0..9 {
            assert!(
                decode_step(&store, 0, step).unwrap() == series.steps[0][step],
                "{sample_type}, step {step}"
            );
        }
    }
}
