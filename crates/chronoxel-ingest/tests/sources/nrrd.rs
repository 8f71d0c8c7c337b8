//! NRRD files, attached and detached.

use chronoxel_core::SampleType;
use chronoxel_ingest::sources::SourceOptions;

use crate::fixtures::{SPACING, check, expected, open, open_with, read, refusal, refused};

#[test]
fn attached_files_of_every_encoding() {
    check("nrrd/raw.nrrd", SampleType::F32, 1, true);
    check("nrrd/big.nrrd", SampleType::I16, 1, true);
    check("nrrd/gzip.nrrd", SampleType::F32, 1, true);
    check("nrrd/text.nrrd", SampleType::U8, 1, true);
}

#[test]
fn detached_files_with_skips_and_many_data_files() {
    check("nrrd/one.nhdr", SampleType::F32, 1, true);
    check("nrrd/end.nhdr", SampleType::F32, 1, true);
    check("nrrd/packed.nhdr", SampleType::F32, 1, true);
    check("nrrd/slices.nhdr", SampleType::F32, 1, true);
    check("nrrd/numbered.nhdr", SampleType::F32, 3, false);
    check("nrrd/listed.nhdr", SampleType::F32, 3, false);
}

#[test]
fn a_time_axis_last_or_first() {
    check("nrrd/steps.nrrd", SampleType::F32, 3, true);
    check("nrrd/steps_first.nrrd", SampleType::F32, 3, true);
    let series = open("nrrd/steps.nrrd").unwrap();
    assert_eq!(series.times().times, [5.0, 5.1, 5.2]);
    assert_eq!(series.times().units, "ms");
    assert_eq!(series.variables()[0].units, "K m");
}

#[test]
fn components_are_variables() {
    let mut series = open("nrrd/vector.nrrd").unwrap();
    assert_eq!(series.grid().spacing, SPACING);
    let names: Vec<_> = series.variables().iter().map(|v| v.name.clone()).collect();
    assert_eq!(names, ["vector_0", "vector_1"]);
    let values = expected(SampleType::F32, 0);
    assert_eq!(read(series.as_mut(), 0, 0), values);
    assert_eq!(read(series.as_mut(), 1, 0), values.iter().map(|v| -v).collect::<Vec<_>>());
}

#[test]
fn what_is_not_read_is_refused_with_a_remedy() {
    assert!(refused("nrrd/refused_oblique.nrrd").contains("space directions is (0.5,0.5,0)"));
    assert!(refused("nrrd/refused_bzip2.nrrd").contains("encoding is bzip2"));
}

#[test]
fn an_axis_without_samples_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    for (sizes, kinds) in
        [("0 4 3 3", "vector domain domain domain"), ("4 3 3 0", "domain domain domain time")]
    {
        let file = folder.path().join("empty.nrrd");
        let header =
            format!("NRRD0004\ntype: uint8\ndimension: 4\nsizes: {sizes}\nencoding: raw\nkinds: {kinds}\n\n");
        std::fs::write(&file, header).unwrap();
        let message = refusal(open_with(&file.to_string_lossy(), &SourceOptions::default()));
        assert!(message.contains(sizes) && message.contains("at least one sample"), "{message:?}");
    }
}
