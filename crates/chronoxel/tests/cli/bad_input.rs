//! Sources that cannot be encoded: one line that names the file and what is wrong, and nothing left behind.

use std::{fs, path::Path};

use tempfile::tempdir;

use crate::{
    command::{at, done, json, refused},
    files::{fixture, npy_bytes, write_f32},
};

#[test]
fn sources_that_cannot_be_read_are_refused() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    let write = |name: &str, bytes: &[u8]| fs::write(folder.join(name), bytes).unwrap();
    write_f32(&folder.join("good.npy"), [8, 9, 10], |[x, y, z]| (x + y + z) as f32);
    write_f32(&folder.join("other.npy"), [8, 9, 11], |[x, y, z]| (x + y + z) as f32);
    let good = fs::read(folder.join("good.npy")).unwrap();
    write("cut.npy", &good[..good.len() - 1]);
    write("head.npy", &good[..40]);
    write("zero.npy", b"");
    write("huge.npy", &npy_bytes("<f4", "4000000000, 4000000000, 4000000000", &[0; 64]));
    write("wide.npy", &npy_bytes("<f4", "1000, 1000, 1000", &[0; 64]));
    write("text.npy", b"these are not samples");
    let mut header = good.clone();
    header[8..10].copy_from_slice(&u16::MAX.to_le_bytes());
    write("header.npy", &header);
    write("x.bin", &[0; 100]);
    write("a.png", b"\x89PNG");
    fs::create_dir(folder.join("folder.npy")).unwrap();
    fs::create_dir(folder.join("nothing")).unwrap();
    for (source, says) in [
        ("cut.npy", &["cut.npy", "bytes"][..]),
        ("head.npy", &["head.npy"]),
        ("zero.npy", &["zero.npy", "empty"]),
        ("huge.npy", &["huge.npy", "4000000000"]),
        ("wide.npy", &["wide.npy"]),
        ("text.npy", &["text.npy"]),
        ("header.npy", &["header.npy", "65535"]),
        ("folder.npy", &["folder.npy"]),
        ("nothing", &["nothing", "zarr.json"]),
        ("lost.npy", &["lost.npy", "No such file"]),
        ("good.npy/below.npy", &["good.npy/below.npy", "ot a directory"]),
        ("'lost*.npy'", &["lost*.npy", "no file matches"]),
        ("'lost[.npy'", &["lost[.npy"]),
        ("good.npy other.npy", &["other.npy", "8 x 9 x 11", "8 x 9 x 10"]),
        ("good.npy --variable heat", &["--variable", "heat", "good"]),
        ("good.npy --dims 8x9x10", &["--dims", "good.npy"]),
        ("a.png", &["a.png", "png"]),
        ("x.bin", &["x.bin", "--dims"]),
        ("x.bin --dims 4x5x6 --dtype u8", &["x.bin", "100", "120"]),
        ("x.bin --dims 4x5x5 --dtype u8 --header-bytes 1000", &["x.bin", "1000"]),
        ("sim:fire", &["fire", "plume, vortex, shockbubble"]),
        ("'sim:plume?dims=4'", &["dims", "4"]),
        ("'sim:plume?steps=0'", &["steps", "0"]),
        ("'sim:plume?wind=3'", &["wind", "dims"]),
        ("'sim:plume' good.npy", &["sim:plume"]),
        ("'sim:plume?dims=16' --spacing 1,1,2", &["sim:plume", "--spacing"]),
    ] {
        refused(folder, &format!("encode {source} -o out.cxl"), says);
        refused(folder, &format!("info {source}"), says);
    }
}

#[test]
fn files_that_a_format_forbids_are_refused() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    for name in [
        "npy/refused_2d.npy",
        "npy/refused_complex.npy",
        "npy/refused_record.npy",
        "npy/refused_wide.npy",
        "nrrd/refused_bzip2.nrrd",
        "nrrd/refused_oblique.nrrd",
        "vti/refused_cells.vti",
        "vti/refused_direction.vti",
        "vti/refused_lzma.vti",
    ] {
        let file = name.split('/').next_back().unwrap();
        refused(folder, &format!("encode '{}' -o out.cxl", fixture(name)), &[file, " is "]);
    }
    let vti = fs::read_to_string(fixture("vti/ascii.vti")).unwrap();
    fs::write(
        folder.join("unknown.vti"),
        vti.replace("<VTKFile ", "<VTKFile compressor=\"vtkMagicCompressor\" "),
    )
    .unwrap();
    refused(folder, "encode unknown.vti -o out.cxl", &["unknown.vti", "compressor", "vtkMagicCompressor"]);
    fs::write(folder.join("half.vti"), &vti[..vti.len() / 2]).unwrap();
    refused(folder, "encode half.vti -o out.cxl", &["half.vti"]);
    let raw = fs::read(fixture("vti/raw_zlib_64.vti")).unwrap();
    fs::write(folder.join("cut.vti"), &raw[..raw.len() - raw.len() / 4]).unwrap();
    refused(folder, "encode cut.vti -o out.cxl", &["cut.vti"]);
}

#[test]
fn collections_with_wrong_times_or_files_are_refused() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    for name in ["step8.vti", "step9.vti"] {
        fs::copy(fixture(&format!("series/{name}")), folder.join(name)).unwrap();
    }
    let write = |name: &str, entries: &[(&str, &str)]| {
        let sets: String = entries
            .iter()
            .map(|(t, file)| format!("<DataSet timestep=\"{t}\" file=\"{file}\"/>\n"))
            .collect();
        let text = format!(
            "<VTKFile type=\"Collection\" version=\"1.0\"><Collection>\n{sets}</Collection></VTKFile>\n"
        );
        fs::write(folder.join(name), text).unwrap();
    };
    write("good.pvd", &[("1", "step8.vti"), ("2", "step9.vti")]);
    done(folder, "info good.pvd -q");
    write("equal.pvd", &[("1", "step8.vti"), ("1", "step9.vti")]);
    write("nan.pvd", &[("1", "step8.vti"), ("nan", "step9.vti")]);
    write("lost.pvd", &[("1", "step8.vti"), ("2", "step7.vti")]);
    write("self.pvd", &[("1", "self.pvd")]);
    write("none.pvd", &[]);
    for (name, says) in [
        ("equal.pvd", &["time"][..]),
        ("nan.pvd", &["nan"]),
        ("lost.pvd", &["step7.vti", "No such file"]),
        ("self.pvd", &["self.pvd", "collection"]),
        ("none.pvd", &["none.pvd"]),
    ] {
        refused(folder, &format!("encode {name} -o out.cxl"), says);
    }
}

#[test]
fn series_of_nothing_but_missing_samples_are_refused() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    write_f32(&folder.join("nan.npy"), [9, 9, 9], |_| f32::NAN);
    refused(folder, "encode nan.npy -o out.cxl", &["nan", "every sample", "NaN"]);
    write_f32(&folder.join("seven.npy"), [9, 9, 9], |_| 7.0);
    refused(folder, "encode seven.npy -o out.cxl --fill-value 7", &["seven", "fill value"]);
    // What was there before stays.
    done(folder, "encode seven.npy -o out.cxl -q");
    refused(folder, "encode nan.npy -o out.cxl --overwrite", &["nan", "every sample"]);
    assert_eq!(at(&json(folder, "info out.cxl"), "variables.seven.max"), 7.0);
}

#[test]
fn budgets_and_bounds_that_cannot_be_kept_are_refused() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    write_f32(&folder.join("wave.npy"), [20, 20, 20], |[x, y, z]| ((x * y + z) as f32).sin());
    refused(folder, "encode wave.npy -o out.cxl --memory 1MiB", &["--memory", "1048576", "raise it"]);
    refused(
        folder,
        "encode wave.npy -o out.cxl --max-error 1e-9",
        &["--max-error", "wave", "step 0", "raise it"],
    );
    write_f32(&folder.join("more.npy"), [40, 40, 40], |[x, y, z]| (x + y + z) as f32);
    done(folder, "encode more.npy -o more.cxl -q");
    refused(folder, "export more.cxl -o more.vti --memory 500KiB", &["--memory", "64000 samples"]);
    refused(
        folder,
        "render more.cxl -o more.png --size 400x400 --memory 1MiB",
        &["--size 400x400", "--memory"],
    );
}

#[test]
fn outputs_that_cannot_be_written_are_refused() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    write_f32(&folder.join("good.npy"), [8, 9, 10], |[x, y, z]| (x + y + z) as f32);
    done(folder, "encode good.npy -o run.cxl -q");
    fs::write(folder.join("file.cxl"), "mine").unwrap();
    fs::create_dir(folder.join("folder.npy")).unwrap();
    for (line, says) in [
        ("encode good.npy -o good.npy/x.cxl", &["good.npy/x.cxl", "ot a directory"][..]),
        ("encode good.npy -o file.cxl", &["file.cxl", "already exists"]),
        ("encode good.npy -o file.cxl --overwrite", &["file.cxl", "not a Chronoxel store"]),
        ("export run.cxl -o good.npy/x.npy", &["good.npy/x.npy", "ot a directory"]),
        ("export run.cxl -o good.npy/x.zarr", &["good.npy/x.zarr", "ot a directory"]),
        ("export run.cxl -o good.npy/x.pvd", &["good.npy/x", "ot a directory"]),
        ("export run.cxl -o folder.npy", &["folder.npy"]),
        ("export run.cxl -o x.mat", &["x.mat", ".mat", ".nrrd"]),
        ("export run.cxl -o x", &["x", "missing"]),
        ("export run.cxl -o x.npy --variable heat", &["run.cxl", "heat", "good"]),
        ("export run.cxl -o x.npy --steps 0:4", &["--steps", "4"]),
    ] {
        refused(folder, line, says);
    }
}

/// A store is a source of nothing but itself.
#[test]
fn a_store_is_not_encoded_again() {
    let folder = tempdir().unwrap();
    let folder: &Path = folder.path();
    write_f32(&folder.join("good.npy"), [8, 9, 10], |[x, y, z]| (x + y + z) as f32);
    done(folder, "encode good.npy -o run.cxl -q");
    refused(folder, "encode run.cxl -o again.cxl", &["run.cxl", "export it first"]);
    refused(folder, "encode run.cxl -o run.cxl --overwrite", &["run.cxl", "export it first"]);
}
