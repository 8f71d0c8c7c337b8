//! Zarr arrays and groups written by `zarr-python`.

use chronoxel_core::SampleType;
use chronoxel_ingest::sources::SourceOptions;

use crate::fixtures::{
    DIMS, ORIGIN, SPACING, check, expected, open, open_with, path, read, refusal, refused,
};

#[test]
fn every_type_in_both_byte_orders_and_versions() {
    let names = ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"];
    for version in [2, 3] {
        for (name, sample_type) in names.into_iter().zip(SampleType::ALL) {
            for order in ["", "_big"] {
                check(&format!("zarr/types_v{version}.zarr/{name}{order}"), sample_type, 1, false);
            }
        }
    }
}

/// Checks every array of a group against the usual values.
fn check_group(name: &str, arrays: &[&str]) {
    let mut series = open(name).unwrap_or_else(|e| panic!("{e}"));
    let names: Vec<String> = series.variables().iter().map(|v| v.name.clone()).collect();
    assert_eq!(names, arrays);
    assert_eq!((series.grid().dims, series.times().num_steps()), (DIMS, 2));
    for (variable, name) in arrays.iter().enumerate() {
        for step in [0, 1, 0] {
            assert_eq!(read(series.as_mut(), variable, step), expected(SampleType::F32, step), "{name}");
        }
    }
}

#[test]
fn every_codec_and_layout() {
    let arrays = ["blosc", "default", "fortran", "gzip", "lz4", "none", "slash", "zlib", "zstd"];
    check_group("zarr/codecs_v2.zarr", &arrays);
    let arrays = [
        "blosc",
        "checked",
        "default",
        "gzip",
        "key_dot",
        "key_v2",
        "none",
        "sharded",
        "sharded_start",
        "transposed",
        "two",
        "whole",
    ];
    check_group("zarr/codecs_v3.zarr", &arrays);
}

#[test]
fn blosc_in_all_its_ways() {
    let mut values = Vec::new();
    for z in 0..4 {
        for y in 0..16 {
            values.extend((0..40).map(|x| f64::from(x / 3 + 16 * y + 300 * z)));
        }
    }
    let mut series = open("zarr/blosc.zarr").unwrap();
    assert_eq!(series.variables().len(), 16);
    for variable in 0..16 {
        let name = series.variables()[variable].name.clone();
        assert!(read(series.as_mut(), variable, 0) == values, "{name}");
    }
    let mut stored = open("zarr/noise.zarr/noise").unwrap();
    let mut plain = open("npy/noise.npy").unwrap();
    assert_eq!(read(stored.as_mut(), 0, 0), read(plain.as_mut(), 0, 0));
}

#[test]
fn dimension_names_lead_to_times_and_placement() {
    for name in ["zarr/ocean.zarr", "zarr/ocean.zarr/temperature"] {
        let mut series = open(name).unwrap();
        let grid = series.grid();
        assert_eq!((grid.dims, grid.origin, grid.spacing), (DIMS, ORIGIN, SPACING));
        assert_eq!(series.times().times, [6.0, 18.0]);
        assert_eq!(series.times().units, "hours since 2000-01-01");
        let index = series.variables().iter().position(|v| v.name == "temperature").unwrap();
        let variable = &series.variables()[index];
        assert_eq!(variable.units, "degC");
        assert!(variable.fill_value.unwrap().is_nan());
        // The chunks of step 0 were never written.
        assert_eq!(read(series.as_mut(), index, 0), vec![-1.5; 60]);
        assert_eq!(read(series.as_mut(), index, 1), expected(SampleType::F32, 1));
    }
    let mut series = open("zarr/ocean.zarr").unwrap();
    assert_eq!(series.variables()[0].fill_value, Some(-999.0));
    assert_eq!(read(series.as_mut(), 0, 1), expected(SampleType::I16, 1));
}

#[test]
fn the_fill_value_of_xarray_in_version_2_is_missing_data() {
    let series = open("zarr/xarray_v2.zarr").unwrap();
    assert!(series.variables()[0].fill_value.unwrap().is_nan());
    assert_eq!(open("zarr/types_v2.zarr/f4").unwrap().variables()[0].fill_value, None);
}

#[test]
fn what_is_not_read_is_refused_with_a_remedy() {
    let message = refusal(open("zarr/refused.zarr/complex"));
    assert!(message.contains("complex/zarr.json: data_type is \"complex64\""), "{message}");
    let message = refusal(open("zarr/refused.zarr/lzma"));
    assert!(message.contains("codecs is numcodecs.lzma") && message.contains("zstd"), "{message}");
    assert!(refusal(open("zarr/refused.zarr/packed")).contains("scale_factor is 0.01"));
    assert!(refusal(open("zarr/refused.zarr/flat")).contains("shape is [4, 5]"));
    let message = refused("zarr/mixed.zarr");
    assert!(
        message.contains("b/zarr.json: shape is [2, 4, 5]") && message.contains("[3, 4, 5]"),
        "{message}"
    );
    assert!(refused("zarr/uneven.zarr").contains("coordinates is 0, 1, 10"));
    let spacing = Some([1.0; 3]);
    let options = SourceOptions { spacing, ..SourceOptions::default() };
    assert!(open_with(&path("zarr/uneven.zarr").to_string_lossy(), &options).is_ok());
    let options = SourceOptions { variables: vec!["b".to_owned()], ..SourceOptions::default() };
    assert!(open_with(&path("zarr/mixed.zarr").to_string_lossy(), &options).is_ok());
}
