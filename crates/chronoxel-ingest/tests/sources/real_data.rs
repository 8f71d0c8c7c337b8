//! Real data sets, held against the numbers in the index that comes with them.

use std::path::PathBuf;

use chronoxel_core::SampleType;
use chronoxel_ingest::sources::SourceOptions;

use crate::fixtures::{open_with, read_slabs};

/// The folder of data sets, or `None` where it is absent and need not be there.
fn data() -> Option<PathBuf> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
    let folder = PathBuf::from(std::env::var_os("CHRONOXEL_DATA").unwrap_or_else(|| default.into()));
    if folder.join("isabel").is_dir() {
        return Some(folder);
    }
    let is_required = std::env::var_os("CHRONOXEL_REQUIRE_DATA").is_some_and(|v| v == "1");
    assert!(!is_required, "CHRONOXEL_REQUIRE_DATA=1, but there is no data in {}", folder.display());
    println!("skipped: there is no data in {}; set CHRONOXEL_DATA", folder.display());
    None
}

/// Holds minimum, maximum and mean of a step against the index, which gives six digits.
fn check(pattern: &str, step: usize, [min, max, mean]: [f64; 3]) {
    let mut series = open_with(pattern, &SourceOptions::default()).unwrap();
    let samples = read_slabs(series.as_mut(), 0, step, 10).unwrap().to_f64();
    let found_min = samples.iter().copied().fold(f64::INFINITY, f64::min);
    let found_max = samples.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let found_mean = samples.iter().sum::<f64>() / samples.len() as f64;
    for (found, listed) in [(found_min, min), (found_max, max), (found_mean, mean)] {
        assert!(
            (found - listed).abs() <= 1e-6,
            "{pattern}, step {step}: {found} where the index has {listed}"
        );
    }
}

#[test]
fn viscous_fingers() {
    let Some(data) = data() else { return };
    let pattern = data.join("viscousfingers/*.vti").to_string_lossy().into_owned();
    let series = open_with(&pattern, &SourceOptions::default()).unwrap();
    let grid = series.grid();
    assert_eq!((grid.dims, grid.spacing, series.times().num_steps()), ([64; 3], [1.0; 3], 40));
    let variable = &series.variables()[0];
    assert_eq!((variable.name.as_str(), variable.sample_type), ("ImageFile", SampleType::F32));
    check(&pattern, 0, [0.0, 76.763237, 3.882204]);
    check(&pattern, 39, [0.0, 113.590172, 9.950352]);
}

#[test]
fn hurricane_isabel() {
    let Some(data) = data() else { return };
    let pattern = data.join("isabel/*.vti").to_string_lossy().into_owned();
    let series = open_with(&pattern, &SourceOptions::default()).unwrap();
    assert_eq!(series.grid().dims, [125, 125, 25]);
    assert_eq!(series.grid().spacing, [4.0080321286, 4.0080321286, 4.0408163266]);
    let variable = &series.variables()[0];
    assert_eq!((variable.name.as_str(), variable.sample_type), ("velocityMag", SampleType::F64));
    // The hours between the two runs are missing.
    assert_eq!(series.times().times, [2.0, 3.0, 4.0, 5.0, 30.0, 31.0, 32.0, 33.0]);
    check(&pattern, 0, [0.0, 68.245478, 10.207427]);
}
