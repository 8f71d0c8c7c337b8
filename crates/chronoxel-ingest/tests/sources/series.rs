//! Several files as one series: order, times, and files that do not agree.

use std::path::Path;

use chronoxel_core::SampleType;
use chronoxel_ingest::sources::{self, SourceOptions};

use crate::fixtures::{expected, open, open_with, path, read, refusal};

/// A glob in the folder of fixtures.
fn glob(pattern: &str) -> String {
    path(pattern).to_string_lossy().into_owned()
}

#[test]
fn a_glob_is_in_natural_order_with_the_times_of_its_files() {
    let mut series = open_with(&glob("series/step*.vti"), &SourceOptions::default()).unwrap();
    assert_eq!(series.times().times, [5.0, 7.5, 30.0]);
    for step in [0, 1, 2, 0] {
        assert_eq!(read(series.as_mut(), 0, step), expected(SampleType::F32, step));
    }
    let options = SourceOptions { dt: Some(0.25), ..SourceOptions::default() };
    let series = open_with(&glob("series/step*.vti"), &options).unwrap();
    assert_eq!(series.times().times, [0.0, 0.25, 0.5]);
}

#[test]
fn a_collection_gives_its_own_times() {
    let mut series = open("series/run.pvd").unwrap();
    assert_eq!(series.times().times, [0.5, 0.75, 3.0]);
    for step in 0..3 {
        assert_eq!(read(series.as_mut(), 0, step), expected(SampleType::F32, step));
    }
}

#[test]
fn files_without_times_are_numbered_and_named_by_their_common_part() {
    let options = SourceOptions { dt: Some(0.5), ..SourceOptions::default() };
    let mut series = open_with(&glob("npy/version?.npy"), &options).unwrap();
    assert_eq!(series.times().times, [0.0, 0.5, 1.0]);
    assert_eq!(series.variables()[0].name, "version");
    assert_eq!(read(series.as_mut(), 0, 2), expected(SampleType::I16, 0));
}

#[test]
fn files_of_several_steps_follow_each_other() {
    let inputs = [glob("npy/steps.npy"), glob("npy/f4.npy"), glob("nrrd/listed.nhdr")];
    let mut series = sources::open(&inputs, &SourceOptions::default()).unwrap();
    assert_eq!(series.times().num_steps(), 6);
    for (step, shown) in [0, 1, 0, 0, 1, 2].into_iter().enumerate() {
        assert_eq!(read(series.as_mut(), 0, step), expected(SampleType::F32, shown), "step {step}");
    }
}

#[test]
fn variables_are_chosen_by_name() {
    let choose = |names: &[&str]| {
        let variables = names.iter().map(|n| n.to_string()).collect();
        open_with(&glob("vti/ascii.vti"), &SourceOptions { variables, ..SourceOptions::default() })
    };
    let mut series = choose(&["count"]).unwrap();
    assert_eq!(series.variables().len(), 1);
    assert_eq!(read(series.as_mut(), 0, 0), expected(SampleType::U16, 0));
    assert!(refusal(choose(&["cuont"])).contains("--variable cuont: the source has density, count"));
    assert!(refusal(choose(&["count", "count"])).contains("once"));
}

/// The message for inputs that do not make a series.
fn refused_series(inputs: &[String]) -> String {
    refusal(sources::open(inputs, &SourceOptions::default()))
}

#[test]
fn files_that_do_not_agree_are_named_with_both_values() {
    let message = refused_series(&[glob("npy/f4.npy"), glob("npy/f8.npy")]);
    assert!(
        message.contains("f8.npy: type of") && message.contains("is f64") && message.contains("f32"),
        "{message}"
    );
    let message = refused_series(&[glob("nrrd/raw.nrrd"), glob("npy/f4.npy")]);
    assert!(
        message.contains("f4.npy: spacing is [1.0, 1.0, 1.0]") && message.contains("[0.5, 2.0, 0.25]"),
        "{message}"
    );
    let message = refused_series(&[glob("vti/one_block.vti"), glob("vti/extent.vti")]);
    assert!(message.contains("extent.vti: origin is"), "{message}");
    let message = refused_series(&[glob("vti/one_block.vti"), glob("vti/ascii.vti")]);
    assert!(message.contains("ascii.vti: variables is density, count"), "{message}");
    let folder = tempfile::tempdir().unwrap();
    let other = folder.path().join("other.nhdr");
    let header = "NRRD0004\ntype: float\ndimension: 3\nsizes: 4 5 3\nencoding: raw\nendian: little\ndata file: other.raw\n";
    std::fs::write(&other, header).unwrap();
    std::fs::write(folder.path().join("other.raw"), [0; 240]).unwrap();
    let message = refused_series(&[glob("npy/f4.npy"), other.to_string_lossy().into_owned()]);
    assert!(
        message.contains("other.nhdr: dimensions is 4 x 5 x 3") && message.contains("5 x 4 x 3"),
        "{message}"
    );
}

#[test]
fn times_that_do_not_increase_are_refused() {
    let message = refused_series(&[glob("series/step9.vti"), glob("series/step8.vti")]);
    assert!(message.contains("step8.vti: time is 5:") && message.contains("7.5"), "{message}");
    let message = refused_series(&[glob("series/step8.vti"), glob("vti/one_block.vti")]);
    assert!(message.contains("one_block.vti: time is missing"), "{message}");
}

/// The message for a collection with these lines.
fn refused_collection(lines: &str) -> String {
    let folder = tempfile::tempdir().unwrap();
    for name in ["step8.vti", "step9.vti"] {
        std::fs::copy(path("series").join(name), folder.path().join(name)).unwrap();
    }
    let text = format!("<VTKFile type=\"Collection\"><Collection>{lines}</Collection></VTKFile>");
    let collection = folder.path().join("a.pvd");
    std::fs::write(&collection, text).unwrap();
    refused_series(&[collection.to_string_lossy().into_owned()])
}

#[test]
fn collections_with_parts_or_times_out_of_order_are_refused() {
    let first = "<DataSet timestep=\"2\" part=\"0\" file=\"step8.vti\"/>";
    let second =
        |attributes: &str| refused_collection(&format!("{first}<DataSet {attributes} file=\"step9.vti\"/>"));
    assert!(second("timestep=\"1\"").contains("timestep is 1: the entry before it has 2"));
    assert!(second("timestep=\"2\"").contains("timestep is 2"));
    assert!(second("timestep=\"3\" part=\"1\"").contains("part is 1"));
    assert!(second("timestep=\"nan\"").contains("timestep is nan"));
    assert!(second("").contains("timestep is missing"));
    assert!(refused_collection("").contains("Collection is empty"));
    assert!(refused_collection("<DataSet timestep=\"1\" file=\"no.vti\"/>").contains("no.vti: cannot open"));
    assert!(refused_collection("<DataSet timestep=\"1\" file=\"a.pvd\"/>").contains("collection"));
}

#[test]
fn a_thousand_files_open_fast() {
    let folder = tempfile::tempdir().unwrap();
    for step in 0..1000 {
        std::fs::copy(path("vti/one_block.vti"), folder.path().join(format!("s{step}.vti"))).unwrap();
    }
    let pattern = folder.path().join("s*.vti");
    let mut series = open_with(&pattern.to_string_lossy(), &SourceOptions::default()).unwrap();
    assert_eq!(series.times().num_steps(), 1000);
    assert_eq!(read(series.as_mut(), 0, 999), expected(SampleType::F32, 0));
    assert!(Path::new(folder.path()).exists());
}

#[test]
fn a_simulation_is_a_source_of_its_own() {
    let name = "sim:plume?dims=8x8x8&steps=2".to_owned();
    let mut series = sources::open(std::slice::from_ref(&name), &SourceOptions::default()).unwrap();
    assert_eq!((series.grid().dims, series.times().num_steps()), ([8, 8, 8], 2));
    assert_eq!(series.open_step(0, 0).unwrap().read_slices(8).unwrap().len(), 512);
    assert!(refused_series(&[name.clone(), glob("npy/f4.npy")]).contains("cannot be joined"));
    assert!(refused_series(&["sim:nothing".to_owned()]).contains("nothing"));
    let options = SourceOptions { dt: Some(1.0), ..SourceOptions::default() };
    assert!(refusal(open_with(&name, &options)).contains("settings after its name"));
    let options = SourceOptions { variables: vec!["x".to_owned()], ..SourceOptions::default() };
    assert!(refusal(open_with(&name, &options)).contains("--variable x"));
}
