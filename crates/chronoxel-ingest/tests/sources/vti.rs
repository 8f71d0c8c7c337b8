//! ImageData written by the `vtk` package.

use chronoxel_core::SampleType;

use crate::fixtures::{DIMS, ORIGIN, SPACING, check, expected, open, read, refused};

/// Arrays `density` and `count` at time 2.5.
fn check_two(name: &str) {
    let mut series = open(name).unwrap_or_else(|e| panic!("{e}"));
    let grid = *series.grid();
    assert_eq!((grid.dims, grid.origin, grid.spacing), (DIMS, ORIGIN, SPACING), "{name}");
    assert_eq!(series.times().times, [2.5], "{name}");
    let found: Vec<_> = series.variables().iter().map(|v| (v.name.clone(), v.sample_type)).collect();
    assert_eq!(
        found,
        [("density".to_owned(), SampleType::F32), ("count".to_owned(), SampleType::U16)],
        "{name}"
    );
    assert_eq!(read(series.as_mut(), 0, 0), expected(SampleType::F32, 0), "{name}");
    assert_eq!(read(series.as_mut(), 1, 0), expected(SampleType::U16, 0), "{name}");
}

#[test]
fn every_encoding_compressor_and_header_width() {
    for encoding in ["inline", "raw", "base64"] {
        for compressor in ["plain", "zlib", "lz4"] {
            for header in [32, 64] {
                check_two(&format!("vti/{encoding}_{compressor}_{header}.vti"));
            }
        }
    }
    check_two("vti/ascii.vti");
}

#[test]
fn every_type() {
    for name in ["vti/types_raw.vti", "vti/types_ascii.vti", "vti/types_big.vti"] {
        let mut series = open(name).unwrap();
        for (variable, sample_type) in SampleType::ALL.into_iter().enumerate() {
            assert_eq!(series.variables()[variable].sample_type, sample_type, "{name}");
            assert_eq!(read(series.as_mut(), variable, 0), expected(sample_type, 0), "{name}, {sample_type}");
        }
    }
    assert_eq!(open("vti/types_big.vti").unwrap().times().times, [7.0]);
}

#[test]
fn one_whole_block() {
    check("vti/one_block.vti", SampleType::F32, 1, true);
}

#[test]
fn an_extent_that_does_not_start_at_zero_moves_the_origin() {
    let mut series = open("vti/extent.vti").unwrap();
    assert_eq!(series.grid().origin, [1.0 + 10.0 * 0.5, -2.0 + 20.0 * 2.0, 3.0 - 3.0 * 0.25]);
    assert_eq!(read(series.as_mut(), 0, 0), expected(SampleType::F32, 0));
}

#[test]
fn components_are_variables() {
    let mut series = open("vti/vector.vti").unwrap();
    let names: Vec<_> = series.variables().iter().map(|v| v.name.clone()).collect();
    assert_eq!(names, ["velocity_x", "velocity_y", "velocity_z", "density"]);
    let density = expected(SampleType::F32, 0);
    assert_eq!(read(series.as_mut(), 0, 0), density);
    assert_eq!(read(series.as_mut(), 1, 0), density.iter().map(|v| -v).collect::<Vec<_>>());
    assert_eq!(read(series.as_mut(), 2, 0), density.iter().map(|v| v + 0.5).collect::<Vec<_>>());
    assert_eq!(read(series.as_mut(), 3, 0), density);
}

#[test]
fn a_step_number_stands_in_for_a_time() {
    assert_eq!(open("vti/step_number.vti").unwrap().times().times, [30.0]);
}

#[test]
fn what_is_not_read_is_refused_with_a_remedy() {
    assert!(refused("vti/refused_lzma.vti").contains("compressor is vtkLZMADataCompressor"));
    assert!(refused("vti/refused_direction.vti").contains("Direction is 0 -1 0"));
    assert!(refused("vti/refused_cells.vti").contains("Cell Data to Point Data"));
}
