//! Paths and contents that are not what they should be: each is an error of one line.

use std::path::PathBuf;

use chronoxel_core::SampleType;
use chronoxel_ingest::sources::{self, SourceOptions};

use crate::fixtures::{DIMS, open_with, path, refusal};

/// The message for one input.
fn refused(input: &str) -> String {
    refusal(open_with(input, &SourceOptions::default()))
}

/// A file of a name and content, in a folder that lives as long as the guard.
fn file(name: &str, content: &[u8]) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, content).unwrap();
    (folder, path)
}

#[test]
fn paths_that_lead_nowhere() {
    assert!(refused("/no/such/file.vti").starts_with("/no/such/file.vti: cannot open: "));
    assert!(refused("/no/such/*.vti").contains("SOURCE /no/such/*.vti: no file matches"));
    assert!(refused("a[.vti").contains("the glob is wrong"));
    assert!(refusal(sources::open(&[], &SourceOptions::default())).contains("SOURCE is missing"));
    let folder = path("vti");
    let message = refused(&folder.to_string_lossy());
    assert!(message.contains("a folder without zarr.json") && message.contains("/vti/*.vti'"), "{message}");
}

#[test]
fn an_extension_that_lies_is_told_what_the_file_is() {
    let npy = std::fs::read(path("npy/f4.npy")).unwrap();
    let vti = std::fs::read(path("vti/ascii.vti")).unwrap();
    let cases: [(&str, &[u8], &str); 12] = [
        ("a.vti", &npy, "the content is NumPy .npy"),
        ("a.npy", &vti, "the content is VTK ImageData .vti"),
        ("a.raw", &npy, "the content is NumPy .npy"),
        ("a.pvd", &vti, "the content is VTK ImageData .vti"),
        ("a.nrrd", b"\x89HDF\r\n\x1a\n", "the content is HDF5"),
        ("a.vti", b"some text", "none of the known formats"),
        ("a.vti", b"<VTKFile type=\"UnstructuredGrid\">", "the content is VTK UnstructuredGrid .vtu"),
        ("a.vti", b"# vtk DataFile Version 3.0", "the content is legacy VTK .vtk"),
        ("a.vts", b"<VTKFile type=\"PStructuredGrid\">", "the content is parallel VTK .pvtu, .pvts or .pvtr"),
        ("a.vti", b"<VTKFile type=\"PImageData\">", "a parallel VTK .pvti file"),
        ("a.txt", b"some text", "which is not supported"),
        ("a", b"some text", "extension is missing"),
    ];
    for (name, content, expected) in cases {
        let (_folder, path) = file(name, content);
        let message = refused(&path.to_string_lossy());
        assert!(message.contains(expected) && message.contains(name), "{name}: {message}");
    }
}

#[test]
fn empty_files_of_every_format() {
    for name in ["a.vti", "a.pvd", "a.npy", "a.nrrd", "a.nhdr", "a.raw", "a"] {
        let (_folder, path) = file(name, b"");
        let options =
            SourceOptions { dims: Some(DIMS), sample_type: Some(SampleType::U8), ..SourceOptions::default() };
        let message = refusal(open_with(&path.to_string_lossy(), &options));
        assert!(message.contains("the file is empty"), "{message}");
    }
}

#[test]
fn options_of_raw_files_are_refused_for_others() {
    let options = SourceOptions { dims: Some(DIMS), ..SourceOptions::default() };
    let message = refusal(open_with(&path("npy/f4.npy").to_string_lossy(), &options));
    assert!(message.contains("--dims is given") && message.contains("f4.npy"), "{message}");
}

/// A change to every place of a header that must be found before anything is allocated.
fn refused_change(fixture: &str, from: &str, to: &str) -> String {
    let content = std::fs::read(path(fixture)).unwrap();
    let mut changed = Vec::new();
    let mut rest = &content[..];
    while let Some(at) = rest.windows(from.len()).position(|w| w == from.as_bytes()) {
        changed.extend([&rest[..at], to.as_bytes()].concat());
        rest = &rest[at + from.len()..];
    }
    assert!(!changed.is_empty(), "{fixture} has no {from}");
    changed.extend(rest);
    let name = fixture.rsplit('/').next().unwrap();
    let (_folder, path) = file(name, &changed);
    let message = refused(&path.to_string_lossy());
    assert!(message.contains(name), "{message}");
    message
}

#[test]
fn headers_that_promise_more_than_the_file_holds() {
    let extent = "0 4 0 3 0 2";
    for name in ["raw_plain_32", "raw_zlib_64", "raw_lz4_32", "base64_plain_64", "inline_zlib_32"] {
        let message = refused_change(&format!("vti/{name}.vti"), extent, "0 65535 0 65535 0 999");
        assert!(
            message.contains("array \"density\" is too short") && message.contains("17179869184000 bytes"),
            "{message}"
        );
    }
    assert!(
        refused_change("vti/ascii.vti", extent, "0 4 0 3 0 99").contains("array \"density\" is too short")
    );
    assert!(refused_change("vti/ascii.vti", extent, "0 4 0 3 0 -1").contains("dimensions is 5 x 4 x 0"));
    let most = format!("0 4 0 3 {} {}", i64::MIN, i64::MAX);
    assert!(refused_change("vti/ascii.vti", extent, &most).contains("dimensions is"));
    assert!(
        refused_change("vti/ascii.vti", extent, "0 4 0 3 0")
            .contains("WholeExtent is 0 4 0 3 0: it must have 6")
    );
    let message = refused_change("vti/ascii.vti", "Piece Extent=\"0 4", "Piece Extent=\"1 5");
    assert!(message.contains("Piece Extent is [1, 5, 0, 3, 0, 2]"), "{message}");
    assert!(refused_change("npy/f4.npy", "(3, 4, 5)", "(3, 4, 6)").contains("length is 368 bytes"));
    assert!(refused_change("npy/f4.npy", "(3, 4, 5)", "(0, 4, 5)").contains("5 x 4 x 0"));
    let message = refused_change("npy/f4.npy", "(3, 4, 5), }          ", "(99999, 99999, 99999)}");
    assert!(message.contains("shape") || message.contains("number of samples"), "{message}");
    assert!(refused_change("nrrd/raw.nrrd", "5 4 3", "5 4 4").contains("need 320 bytes"));
    assert!(refused_change("nrrd/raw.nrrd", "5 4 3", "5 4 2").contains("need 160 bytes"));
    assert!(refused_change("nrrd/gzip.nrrd", "5 4 3", "500 400 30").contains("need 24000000 bytes"));
    assert!(refused_change("nrrd/text.nrrd", "5 4 3", "5 4 300").contains("need 6000 bytes"));
    assert!(refused_change("nrrd/raw.nrrd", "5 4 3", "0 4 3").contains("0 x 4 x 3"));
    assert!(refused_change("nrrd/raw.nrrd", "5 4 3", "5 4").contains("sizes is 5 4"));
    assert!(refused_change("nrrd/raw.nrrd", "endian: little", "endian: middle").contains("endian is middle"));
}

#[test]
fn arrays_longer_or_shorter_than_the_extent_are_found_when_read() {
    for name in ["raw_plain_32", "raw_zlib_64", "inline_lz4_32", "ascii"] {
        let content = std::fs::read(path(&format!("vti/{name}.vti"))).unwrap();
        let (_folder, path) = file("a.vti", &[]);
        // A byte at a time, so that what is appended stays as it is.
        let text: String = content.iter().map(|&b| char::from(b)).collect();
        let changed: Vec<u8> = text.replace("0 4 0 3 0 2", "0 4 0 3 0 1").chars().map(|c| c as u8).collect();
        std::fs::write(&path, changed).unwrap();
        let mut series = open_with(&path.to_string_lossy(), &SourceOptions::default()).unwrap();
        let read = series.open_step(0, 0).and_then(|mut reader| reader.read_slices(2));
        let message = read.unwrap_err().to_string();
        assert!(message.contains("a.vti") && message.contains("extent needs"), "{name}: {message}");
    }
}

#[test]
fn a_path_without_read_permission() {
    use std::os::unix::fs::PermissionsExt;
    let (_folder, path) = file("a.npy", &std::fs::read(crate::fixtures::path("npy/f4.npy")).unwrap());
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o000)).unwrap();
    if std::fs::File::open(&path).is_ok() {
        println!("skipped: this user may read everything");
        return;
    }
    assert!(refused(&path.to_string_lossy()).contains("a.npy: cannot open: "));
}

#[test]
fn what_is_no_file_is_not_waited_for() {
    for path in ["/dev/zero", "/dev/null"] {
        assert!(refused(path).contains("not a regular file"));
    }
}
