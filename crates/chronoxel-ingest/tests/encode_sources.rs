//! Encoding what real sources give: a simulation that is interrupted, and files as scientists have them.

#[path = "common/files.rs"]
mod files;

use std::path::{Path, PathBuf};

use chronoxel_ingest::{Codec, EncodeOptions, encode, measure, sim, sources};
use chronoxel_store::Store;
use files::{copy_folder, files_of};

#[test]
fn an_interrupted_simulation_is_run_again_up_to_the_step() {
    let folder = tempfile::tempdir().unwrap();
    let (path, copy) = (folder.path().join("s.cxl"), folder.path().join("copy.cxl"));
    let options = EncodeOptions {
        codec: Codec::Raw,
        brick_edge: 8,
        source_name: "plume".into(),
        ..EncodeOptions::default()
    };
    let spec = "sim:plume?dims=64x48x32&steps=6";
    let mut series = sim::open(spec).unwrap();
    encode(&mut *series, &path, &options, &mut |progress| {
        if progress.step == 5 && !copy.exists() {
            copy_folder(&path, &copy);
        }
    })
    .unwrap();
    let mut again = sim::open(spec).unwrap();
    let resumed = EncodeOptions { resume: true, ..options };
    let report = encode(&mut *again, &copy, &resumed, &mut |_| {}).unwrap();
    assert_eq!((report.steps_resumed, report.steps_read), (4, 2), "four steps share a shard");
    assert!(files_of(&copy) == files_of(&path));
}

/// The folder of real data sets, if it is there.
fn data_folder() -> Option<PathBuf> {
    let default = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let folder = std::env::var_os("CHRONOXEL_DATA").map_or(default, PathBuf::from);
    if folder.is_dir() {
        return Some(folder);
    }
    assert_ne!(std::env::var("CHRONOXEL_REQUIRE_DATA").as_deref(), Ok("1"), "{} is absent", folder.display());
    println!("skipped: {} is absent", folder.display());
    None
}

#[test]
fn viscous_fingers_are_encoded_within_the_error_asked_for() {
    let Some(data) = data_folder() else { return };
    let glob = data.join("viscousfingers/00*.vti").display().to_string();
    let mut series = sources::open(&[glob], &sources::SourceOptions::default()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let num_steps = series.times().num_steps();
    let mut bits = Vec::new();
    for (name, options) in [
        ("raw", EncodeOptions { codec: Codec::Raw, ..EncodeOptions::default() }),
        ("auto", EncodeOptions { max_error: Some(1e-3), ..EncodeOptions::default() }),
    ] {
        let path = folder.path().join(format!("{name}.cxl"));
        let report = encode(&mut *series, &path, &options, &mut |_| {}).unwrap();
        assert_eq!((report.steps_read, report.num_masked), (num_steps, 0));
        let store = Store::open(&path).unwrap();
        let measured = measure(&store, &mut *series, 0..num_steps).unwrap();
        assert_eq!(measured.problems, [""; 0]);
        let errors = &measured.variables[0];
        let bound = options.max_error.unwrap_or(0.5 / 65535.0);
        assert!(errors.max_abs_error <= bound * (1.0 + 1e-9), "{name}: {errors:?}");
        bits.push(errors.bits_per_sample);
    }
    assert!(bits[1] < bits[0] && bits[0] < 32.0, "{bits:?}");
}
