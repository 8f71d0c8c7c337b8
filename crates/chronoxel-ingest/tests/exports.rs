//! Exports, read back by Chronoxel's own readers.
//!
//! Where CHRONOXEL_EXPORTS names a folder, the files are left there for `interop/check_exports.py`, which reads
//! them by vtk, numpy and zarr-python.

use std::path::{Path, PathBuf};

use chronoxel_core::{SampleType, TimeAxis, UniformGrid};
use chronoxel_ingest::export::{self, ExportDescription};
use chronoxel_ingest::sources::{self, SourceOptions};

const DIMS: [usize; 3] = [70, 5, 3];
const TIMES: [f64; 3] = [0.5, 1.25, 2.0];

fn description(sample_type: SampleType, num_steps: usize) -> ExportDescription {
    ExportDescription {
        grid: UniformGrid::new(DIMS, [1.5, -2.0, 0.25], [0.5, 1.0, 2.5]).unwrap(),
        times: TimeAxis::new(TIMES[..num_steps].to_vec(), "h").unwrap(),
        name: "speed".to_owned(),
        units: "m/s".to_owned(),
        sample_type,
        fill_value: sample_type.is_integer().then_some(99.0),
    }
}

/// What is exported; `check_exports.py` has the same formula. One sample is missing.
fn value(step: usize, [x, y, z]: [usize; 3]) -> f64 {
    if [x, y, z] == [69, 4, 0] {
        return f64::NAN;
    }
    40.0 * step as f64 + 0.75 * x as f64 - 12.0 * y as f64 + 7.0 * z as f64
}

fn samples(step: usize) -> Vec<f64> {
    let [nx, ny, _] = DIMS;
    (0..DIMS.iter().product()).map(|c| value(step, [c % nx, c / nx % ny, c / nx / ny])).collect()
}

/// The value as a type holds it, by rules of its own: nearest, halves away from zero, clamped.
fn cast(sample_type: SampleType, value: f64) -> f64 {
    let [low, high] = match sample_type {
        SampleType::U8 => [0.0, 255.0],
        SampleType::I16 => [-32768.0, 32767.0],
        _ => return value,
    };
    if value.is_nan() { 99.0 } else { (value.abs() + 0.5).floor().copysign(value).clamp(low, high) }
}

fn write(path: &Path, description: &ExportDescription) {
    let mut writer = export::create(path, description).unwrap();
    for step in 0..description.times.num_steps() {
        writer.write_step(step, &samples(step)).unwrap();
        assert!(!path.exists(), "{} has its name too early", path.display());
    }
    writer.finish().unwrap();
}

/// The folder for the exports, and what keeps it for as long as the test runs.
fn folder() -> (PathBuf, Option<tempfile::TempDir>) {
    match std::env::var_os("CHRONOXEL_EXPORTS") {
        Some(path) => {
            std::fs::create_dir_all(&path).unwrap();
            (path.into(), None)
        }
        None => {
            let temporary = tempfile::tempdir().unwrap();
            (temporary.path().to_owned(), Some(temporary))
        }
    }
}

fn is_same(a: f64, b: f64) -> bool {
    a == b || (a.is_nan() && b.is_nan())
}

#[test]
fn every_format_holds_the_samples_the_grid_and_the_times() {
    let (folder, _keep) = folder();
    for sample_type in [SampleType::U8, SampleType::I16, SampleType::F32, SampleType::F64] {
        for (format, num_steps) in
            [("npy", 1), ("npy", 3), ("nrrd", 1), ("nrrd", 3), ("vti", 1), ("pvd", 3), ("zarr", 3)]
        {
            let description = description(sample_type, num_steps);
            let path = folder.join(format!("{sample_type}_{num_steps}.{format}"));
            write(&path, &description);
            check_with_own_reader(&path, &description);
        }
    }
}

fn check_with_own_reader(path: &Path, description: &ExportDescription) {
    let name = path.to_str().unwrap().to_owned();
    let mut series = sources::open(std::slice::from_ref(&name), &SourceOptions::default()).unwrap();
    let num_steps = description.times.num_steps();
    assert_eq!(series.times().num_steps(), num_steps, "{name}");
    assert_eq!(series.grid().dims, DIMS);
    if !name.ends_with("npy") {
        assert_eq!(series.grid(), &description.grid, "{name}");
        assert_eq!(series.times().times, description.times.times, "{name}");
        let keeps_units = name.ends_with("nrrd") || name.ends_with("zarr");
        assert!(series.variables()[0].units == "m/s" || !keeps_units, "{name}");
    }
    assert_eq!(series.variables()[0].sample_type, description.sample_type);
    for step in 0..num_steps {
        let found = series.open_step(0, step).unwrap().read_slices(DIMS[2]).unwrap().to_f64();
        for (cell, (found, exported)) in found.iter().zip(samples(step)).enumerate() {
            let expected = cast(description.sample_type, exported);
            assert!(is_same(*found, expected), "{name}: {found} at {cell} of {step}, not {expected}");
        }
    }
}

#[test]
fn an_export_that_fails_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    for (name, num_steps) in [("a.vti", 1), ("a.npy", 3), ("a.nrrd", 3), ("a.pvd", 3), ("a.zarr", 3)] {
        let mut description = description(SampleType::U8, num_steps);
        description.fill_value = None;
        let mut writer = export::create(&folder.path().join(name), &description).unwrap();
        let message = writer.write_step(0, &samples(0)).unwrap_err().to_string();
        assert!(
            message.contains("u8") && message.contains("missing") && !message.contains('\n'),
            "{message}"
        );
        drop(writer);
        let left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().collect();
        assert!(left.is_empty(), "{name}: {left:?}");
    }
}

#[test]
fn what_a_format_cannot_hold_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let three = description(SampleType::F32, 3);
    let refuse = |name: &str, description: &ExportDescription, hint: &str| {
        let error = export::create(&folder.path().join(name), description).err();
        let message = error.unwrap_or_else(|| panic!("{name} was made")).to_string();
        assert!(message.contains(hint) && !message.contains('\n'), "{message}");
    };
    refuse("a.vti", &three, ".pvd");
    refuse("a.mhd", &three, ".nrrd");
    refuse("plain", &three, ".nrrd");
    refuse("missing/a.npy", &three, "cannot create");
    refuse("a.npy", &ExportDescription { fill_value: Some(-1.0), ..description(SampleType::U8, 3) }, "-1");
    refuse("a.zarr", &ExportDescription { name: "../x".to_owned(), ..three.clone() }, "name");
    std::fs::create_dir(folder.path().join("b.zarr")).unwrap();
    refuse("b.zarr", &three, "already exists");
    std::fs::create_dir(folder.path().join("b")).unwrap();
    refuse("b.pvd", &three, "already exists");
}

#[test]
fn awkward_names_and_uneven_times_survive() {
    let folder = tempfile::tempdir().unwrap();
    let times = TimeAxis::new(vec![0.0, 1.0, 30.0], "h").unwrap();
    let description =
        ExportDescription { name: "a <\"&\"> b".to_owned(), times, ..description(SampleType::F64, 3) };
    let path = folder.path().join("a & b.pvd");
    write(&path, &description);
    let series = sources::open(&[path.to_str().unwrap().to_owned()], &SourceOptions::default()).unwrap();
    assert_eq!(series.variables()[0].name, "a <\"&\"> b");
    assert_eq!(series.times().times, [0.0, 1.0, 30.0]);
    let path = folder.path().join("uneven.nrrd");
    write(&path, &description);
    let text = String::from_utf8_lossy(&std::fs::read(&path).unwrap()[..800]).into_owned();
    assert!(text.contains("times:=0.0 1.0 30.0\n") && !text.contains("spacings"), "{text}");
    let series = sources::open(&[path.to_str().unwrap().to_owned()], &SourceOptions::default()).unwrap();
    assert_eq!(series.times(), &description.times, "uneven times and their units come back");
}
