//! Raw binary files.

use chronoxel_core::SampleType;
use chronoxel_ingest::sources::SourceOptions;

use crate::fixtures::{DIMS, expected, open_with, read, refusal};

/// Options for a raw file.
fn options(sample_type: SampleType) -> SourceOptions {
    SourceOptions { dims: Some(DIMS), sample_type: Some(sample_type), ..SourceOptions::default() }
}

/// The bytes of the usual values.
fn bytes(sample_type: SampleType, big_endian: bool) -> Vec<u8> {
    let mut all = Vec::new();
    for value in expected(sample_type, 0) {
        let mut bytes = match sample_type {
            SampleType::U8 => (value as u8).to_le_bytes().to_vec(),
            SampleType::I8 => (value as i8).to_le_bytes().to_vec(),
            SampleType::U16 => (value as u16).to_le_bytes().to_vec(),
            SampleType::I16 => (value as i16).to_le_bytes().to_vec(),
            SampleType::U32 => (value as u32).to_le_bytes().to_vec(),
            SampleType::I32 => (value as i32).to_le_bytes().to_vec(),
            SampleType::U64 => (value as u64).to_le_bytes().to_vec(),
            SampleType::I64 => (value as i64).to_le_bytes().to_vec(),
            SampleType::F32 => (value as f32).to_le_bytes().to_vec(),
            SampleType::F64 => value.to_le_bytes().to_vec(),
        };
        if big_endian {
            bytes.reverse();
        }
        all.extend(bytes);
    }
    all
}

#[test]
fn every_type_in_both_byte_orders_with_and_without_a_header() {
    let folder = tempfile::tempdir().unwrap();
    for sample_type in SampleType::ALL {
        for big_endian in [false, true] {
            for header_bytes in [0, 7] {
                let path = folder.path().join(format!("{sample_type}.raw"));
                let mut content = vec![b'#'; header_bytes];
                content.extend(bytes(sample_type, big_endian));
                std::fs::write(&path, content).unwrap();
                let options =
                    SourceOptions { big_endian, header_bytes: header_bytes as u64, ..options(sample_type) };
                let mut series = open_with(&path.to_string_lossy(), &options).unwrap();
                assert_eq!(
                    read(series.as_mut(), 0, 0),
                    expected(sample_type, 0),
                    "{sample_type} {big_endian}"
                );
            }
        }
    }
}

#[test]
fn placement_and_fill_value_come_from_the_caller() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("density.raw");
    std::fs::write(&path, bytes(SampleType::U16, false)).unwrap();
    let options = SourceOptions {
        spacing: Some([1.0, 2.0, 3.0]),
        origin: Some([4.0, 5.0, 6.0]),
        fill_value: Some(12.0),
        ..options(SampleType::U16)
    };
    let series = open_with(&path.to_string_lossy(), &options).unwrap();
    assert_eq!((series.grid().spacing, series.grid().origin), ([1.0, 2.0, 3.0], [4.0, 5.0, 6.0]));
    let variable = &series.variables()[0];
    assert_eq!((variable.name.as_str(), variable.fill_value), ("density", Some(12.0)));
}

#[test]
fn a_length_that_does_not_fit_is_refused_with_both_lengths() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.raw");
    for length in [1, 239, 241, 480] {
        std::fs::write(&path, vec![0; length]).unwrap();
        let message = refusal(open_with(&path.to_string_lossy(), &options(SampleType::F32)));
        assert!(message.contains(&format!("length is {length} bytes")), "{message}");
        assert!(message.contains("240 bytes") && message.contains("5 x 4 x 3"), "{message}");
    }
    let huge = SourceOptions { dims: Some([1 << 31, 1 << 16, 2]), ..options(SampleType::F64) };
    assert!(refusal(open_with(&path.to_string_lossy(), &huge)).contains("a.raw"));
    let zero = SourceOptions { dims: Some([5, 0, 3]), ..options(SampleType::F64) };
    assert!(refusal(open_with(&path.to_string_lossy(), &zero)).contains("5 x 0 x 3"));
}

#[test]
fn missing_options_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.raw");
    std::fs::write(&path, [1; 240]).unwrap();
    let path = path.to_string_lossy();
    assert!(refusal(open_with(&path, &SourceOptions::default())).contains("--dims is missing"));
    let options = SourceOptions { dims: Some(DIMS), ..SourceOptions::default() };
    assert!(refusal(open_with(&path, &options)).contains("--dtype is missing"));
}
