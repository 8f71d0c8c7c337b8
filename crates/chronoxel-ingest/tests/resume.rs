//! The same bytes for any threads, memory and interruptions; and what is left after an error.

mod common;
#[path = "common/files.rs"]
mod files;

use std::fs;
use std::path::Path;

use chronoxel_core::SampleType;
use chronoxel_ingest::{Codec, EncodeError, EncodeOptions, EncodeReport, decode_step, encode};
use chronoxel_store::Store;
use common::{MemorySeries, noise};
use files::{copy_folder, files_of};

/// Steps with noise, ramps, holes, repetitions; more than one shard, and not a whole number of them.
fn mixed(dims: [usize; 3], num_steps: usize) -> MemorySeries {
    MemorySeries::of(dims, SampleType::F32, num_steps, |s, [x, y, z]| match (x / 16 + y / 16 + z / 16) % 4 {
        0 => f64::from(noise((s * 7 + x + 100 * (y + 100 * z)) as u64) as f32),
        1 => (x + 2 * y) as f64,
        2 if (x + y + z + s) % 11 == 0 => f64::NAN,
        _ => 3.0,
    })
}

fn options() -> EncodeOptions {
    EncodeOptions { codec: Codec::Raw, source_name: "mixed".into(), ..EncodeOptions::default() }
}

fn run(series: &mut MemorySeries, path: &Path, options: &EncodeOptions) -> Result<EncodeReport, EncodeError> {
    encode(series, path, options, &mut |_| {})
}

fn resumed() -> EncodeOptions {
    EncodeOptions { resume: true, ..options() }
}

#[test]
fn threads_and_memory_do_not_change_a_byte() {
    let folder = tempfile::tempdir().unwrap();
    let mut series = mixed([70, 65, 50], 3);
    let least =
        match run(&mut series, &folder.path().join("x.cxl"), &EncodeOptions { memory_bytes: 1, ..options() })
        {
            Err(EncodeError::Memory { needed, .. }) => needed,
            other => panic!("{other:?}"),
        };
    let mut expected = None;
    for (threads, memory_bytes) in [(1, 1 << 30), (4, 1 << 30), (1, least), (3, 3 * least)] {
        let path = folder.path().join(format!("{threads}-{memory_bytes}.cxl"));
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| run(&mut series, &path, &EncodeOptions { memory_bytes, ..options() })).unwrap();
        let files = files_of(&path);
        let expected = expected.get_or_insert_with(|| files.clone());
        assert!(*expected == files, "{threads} threads, {memory_bytes} bytes");
    }
}

#[test]
fn an_error_keeps_finished_steps_aside_and_a_resume_completes_them() {
    let folder = tempfile::tempdir().unwrap();
    let (path, kept) = (folder.path().join("s.cxl"), folder.path().join("s.partial.cxl"));
    let whole = folder.path().join("whole.cxl");
    // Volumes this small share a shard between 16 steps: the commit is at 16.
    let mut series = mixed([30, 20, 20], 37);
    run(&mut series, &whole, &options()).unwrap();
    series.broken_step = Some(20);
    let error = run(&mut series, &path, &options()).unwrap_err();
    assert!(matches!(&error, EncodeError::Interrupted { num_steps: 16, .. }), "{error:?}");
    let text = error.to_string();
    assert!(
        text.contains("s.partial.cxl") && text.contains("--resume") && text.contains("broken on purpose")
    );
    assert!(!path.exists() && kept.exists());
    let store = Store::open(&kept).unwrap();
    assert_eq!(store.header().num_steps_finished, 16);
    let of_whole = Store::open(&whole).unwrap();
    let bits = |store: &Store, step| {
        decode_step(store, 0, step).unwrap().iter().map(|v| v.to_bits()).collect::<Vec<_>>()
    };
    assert_eq!(bits(&store, 15), bits(&of_whole, 15));
    assert!(decode_step(&store, 0, 16).is_err());

    // Neither without being told, nor with other options, nor from another source.
    let refused = run(&mut series, &path, &options()).unwrap_err();
    assert!(matches!(refused, EncodeError::OutputExists { is_unfinished: true, .. }), "{refused}");
    let refused = run(&mut series, &path, &EncodeOptions { bits: Some(8.0), ..resumed() }).unwrap_err();
    assert!(refused.to_string().contains("bits was Null and is Number(8.0)"), "{refused}");
    let refused = run(&mut mixed([30, 20, 21], 37), &path, &resumed()).unwrap_err();
    assert!(refused.to_string().contains("grid was"), "{refused}");
    assert!(kept.exists());

    series.broken_step = None;
    series.slices_read = vec![0; 37];
    let report = run(&mut series, &path, &resumed()).unwrap();
    assert_eq!((report.steps_resumed, report.steps_read), (16, 21));
    assert_eq!(series.slices_read[15..17], [0, 20]);
    assert!(!kept.exists());
    assert!(files_of(&path) == files_of(&whole));
}

#[test]
fn a_kill_at_any_moment_leaves_what_a_resume_completes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.cxl");
    let mut series = mixed([70, 70, 33], 4);
    // A copy of the folder at some moment is what a kill at that moment would have left.
    let mut copies = Vec::new();
    encode(&mut series, &path, &options(), &mut |progress| {
        let copy = folder.path().join(format!("copy-{}.cxl", copies.len()));
        copy_folder(&path, &copy);
        copies.push((progress.step, copy));
    })
    .unwrap();
    assert!(copies.len() >= 8);
    let whole = files_of(&path);
    for (step, copy) in copies {
        let finished = Store::open(&copy).unwrap().header().num_steps_finished as usize;
        assert_eq!(finished, step, "every step of a volume this large is committed");
        let report = run(&mut series, &copy, &resumed()).unwrap();
        assert_eq!(report.steps_resumed, step);
        assert!(files_of(&copy) == whole, "killed in step {step}");
    }
}

/// Long enough for several levels of the time tree to wait in the journal.
#[test]
fn statistics_go_on_from_a_multiple_of_eight_steps() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.cxl");
    let num_steps = 27;
    let mut series = mixed([66, 65, 33], num_steps);
    for codec in [Codec::Raw, Codec::Palette] {
        let options = |resume| EncodeOptions { codec, resume, overwrite: !resume, ..options() };
        let mut copies: Vec<(usize, std::path::PathBuf)> = Vec::new();
        encode(&mut series, &path, &options(false), &mut |progress| {
            let due = [3, 8, 9, 15, 16, 23, 25, 26].contains(&progress.step);
            if due && copies.last().is_none_or(|(step, _)| *step != progress.step) {
                let copy = folder.path().join(format!("copy-{}.cxl", progress.step));
                let _ = fs::remove_dir_all(&copy);
                copy_folder(&path, &copy);
                copies.push((progress.step, copy));
            }
        })
        .unwrap();
        let whole = files_of(&path);
        assert_eq!(copies.len(), 8);
        for (step, copy) in copies {
            series.slices_read = vec![0; num_steps];
            run(&mut series, &copy, &options(true)).unwrap();
            let first_read = series.slices_read.iter().position(|&n| n > 0).unwrap();
            // Each step of a volume this large is committed; windows of 8 steps are open up to 8 steps back.
            let window = if codec == Codec::Palette { 8 } else { 0 };
            assert!(
                first_read <= step / 8 * 8 && first_read + window >= step / 8 * 8,
                "{first_read} for {step}"
            );
            assert!(files_of(&copy) == whole, "{codec:?}, killed in step {step}");
        }
    }
}

#[test]
fn damage_to_what_the_journal_keeps_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.cxl");
    let mut series = mixed([66, 65, 33], 17);
    series.broken_step = Some(10);
    assert!(run(&mut series, &path, &options()).is_err());
    series.broken_step = None;
    let kept = folder.path().join("s.partial.cxl");
    let mut names = files_of(&kept).into_keys().filter(|name| name.contains("moments-0-3-0"));
    let file = kept.join(names.next_back().expect("eight steps are kept"));
    let sound = fs::read(&file).unwrap();
    // In what is known of a brick; in the samples of one.
    for at in [200, sound.len() - 5] {
        let mut damaged = sound.clone();
        damaged[at] ^= 1;
        fs::write(&file, damaged).unwrap();
        let error = run(&mut series, &path, &resumed()).unwrap_err().to_string();
        assert!(error.contains("moments-0-3-0") && error.contains("checksum of"), "{error}");
    }
}

#[test]
fn an_error_before_the_first_step_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.cxl");
    let mut series = mixed([40, 40, 40], 2);
    series.broken_step = Some(0);
    let error = run(&mut series, &path, &options()).unwrap_err();
    assert!(matches!(error, EncodeError::Source(_)), "{error}");
    let mut nothing = MemorySeries::of([5, 5, 5], SampleType::F32, 1, |_, _| f64::NAN);
    assert!(matches!(run(&mut nothing, &path, &options()), Err(EncodeError::NoData { .. })));
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

#[test]
fn an_existing_output_is_replaced_only_when_told_and_only_by_a_success() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.cxl");
    let mut series = mixed([20, 20, 20], 1);
    run(&mut series, &path, &options()).unwrap();
    let before = files_of(&path);
    let refused = run(&mut series, &path, &options()).unwrap_err();
    assert!(matches!(refused, EncodeError::OutputExists { is_unfinished: false, .. }), "{refused}");

    let overwriting = EncodeOptions { overwrite: true, ..options() };
    series.broken_step = Some(0);
    assert!(run(&mut series, &path, &overwriting).is_err());
    assert!(files_of(&path) == before, "a failure leaves the old store");

    let mut other = MemorySeries::of([9, 9, 9], SampleType::U8, 1, |_, [x, _, _]| x as f64);
    run(&mut other, &path, &overwriting).unwrap();
    assert_eq!(Store::open(&path).unwrap().header().grid.dims, [9, 9, 9]);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);

    let foreign = folder.path().join("mine.cxl");
    fs::create_dir(&foreign).unwrap();
    fs::write(foreign.join("thesis.txt"), "years of work").unwrap();
    let refused = run(&mut other, &foreign, &overwriting).unwrap_err();
    assert!(refused.to_string().contains("not a Chronoxel store"), "{refused}");
    assert!(foreign.join("thesis.txt").exists());
}

#[test]
fn an_interrupted_replacement_leaves_both_and_a_resume_completes_the_new_one() {
    let folder = tempfile::tempdir().unwrap();
    let (path, kept) = (folder.path().join("s.cxl"), folder.path().join("s.partial.cxl"));
    let mut old = MemorySeries::of([9, 9, 9], SampleType::U8, 1, |_, [x, _, _]| x as f64);
    run(&mut old, &path, &options()).unwrap();
    let before = files_of(&path);
    let mut series = mixed([70, 70, 33], 3);
    series.broken_step = Some(2);
    let error = run(&mut series, &path, &EncodeOptions { overwrite: true, ..options() }).unwrap_err();
    assert!(matches!(error, EncodeError::Interrupted { num_steps: 2, .. }), "{error:?}");
    assert!(files_of(&path) == before);
    series.broken_step = None;
    assert_eq!(run(&mut series, &path, &resumed()).unwrap().steps_resumed, 2);
    assert!(!kept.exists());
    assert_eq!(Store::open(&path).unwrap().header().grid.dims, [70, 70, 33]);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn a_finished_store_resumes_to_itself() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("s.cxl");
    let mut series = mixed([20, 20, 20], 3);
    run(&mut series, &path, &options()).unwrap();
    let before = files_of(&path);
    let report = run(&mut series, &path, &resumed()).unwrap();
    assert_eq!((report.steps_read, report.steps_resumed), (0, 3));
    assert!(files_of(&path) == before);
}

#[test]
fn unusable_outputs_and_options_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut series = mixed([20, 20, 20], 1);
    let error = run(&mut series, &folder.path().join("s.zarr"), &options()).unwrap_err();
    assert!(error.to_string().contains("ends in .cxl"), "{error}");
    fs::write(folder.path().join("file"), "").unwrap();
    let error = run(&mut series, &folder.path().join("file/s.cxl"), &options()).unwrap_err();
    assert!(error.to_string().contains("file/s.cxl"), "{error}");
    let path = folder.path().join("s.cxl");
    let unusable = [
        (EncodeOptions { bits: Some(12.0), ..options() }, "--bits 12"),
        (EncodeOptions { codec: Codec::Auto, bits: Some(0.0), ..options() }, "--bits 0"),
        (
            EncodeOptions { codec: Codec::Auto, bits: Some(1.0), max_error: Some(0.1), ..options() },
            "--max-error 0.1",
        ),
        (EncodeOptions { codec: Codec::Vq, bits: Some(1.0), ..options() }, "--bits 1"),
        (EncodeOptions { codec: Codec::Auto, max_error: Some(-0.5), ..options() }, "--max-error -0.5"),
        (EncodeOptions { codec: Codec::Auto, max_error: Some(f64::NAN), ..options() }, "--max-error NaN"),
        (EncodeOptions { max_error: Some(0.001), ..options() }, "--max-error 0.001"),
        (EncodeOptions { codec: Codec::Vq, window: Some(3), ..options() }, "--window 3"),
        (EncodeOptions { window: Some(4), ..options() }, "--window 4"),
        (EncodeOptions { codec: Codec::Palette, stages: Some(4), ..options() }, "--stages 4"),
        (EncodeOptions { stages: Some(2), ..options() }, "--stages 2"),
        (EncodeOptions { range: Some([2.0, 2.0]), ..options() }, "--range 2:2"),
        (EncodeOptions { brick_edge: 33, ..options() }, "brick edge is 33"),
        (EncodeOptions { overwrite: true, resume: true, ..options() }, "--overwrite"),
    ];
    for (options, expected) in unusable {
        let error = run(&mut series, &path, &options).unwrap_err();
        assert!(error.to_string().starts_with(expected), "{error}");
        assert!(!path.exists());
    }
}
