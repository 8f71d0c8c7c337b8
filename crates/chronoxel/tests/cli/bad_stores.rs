//! Stores that are not there, not stores, or lack a part.

use std::{fs, path::Path};

use tempfile::tempdir;

use crate::{
    command::{at, done, one_object, refused, run},
    files::{tree, write_f32, write_u8_steps},
};

#[test]
fn what_is_no_store_is_named_as_such() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    write_f32(&folder.join("good.npy"), [8, 9, 10], |[x, y, z]| (x + y + z) as f32);
    fs::create_dir(folder.join("empty.cxl")).unwrap();
    fs::write(folder.join("file.cxl"), "").unwrap();
    fs::create_dir(folder.join("other.cxl")).unwrap();
    fs::write(folder.join("other.cxl/zarr.json"), r#"{"zarr_format":3,"node_type":"group"}"#).unwrap();
    for (store, says) in [
        ("lost.cxl", "No such file"),
        ("empty.cxl", "not a Chronoxel store"),
        ("file.cxl", "folder that ends in .cxl"),
        ("other.cxl", "not a Chronoxel store"),
        ("good.npy/run.cxl", "ot a directory"),
    ] {
        for line in
            ["info S", "verify S", "export S -o x.npy", "render S -o x.png", "movie S -o x.gif", "play S"]
        {
            refused(folder, &line.replace('S', store), &[store, says]);
        }
    }
    refused(folder, "render good.npy -o x.png", &["good.npy", "folder that ends in .cxl", "encode"]);
}

fn store_in(folder: &Path) {
    write_u8_steps(&folder.join("source.npy"), 3, [20, 20, 20], |step, [x, y, z]| (x * y + z + step) as u8);
    done(folder, "encode source.npy -o run.cxl --brick 16 -q");
}

#[test]
fn a_damaged_header_is_refused_by_every_verb() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let header = fs::read_to_string(folder.join("run.cxl/zarr.json")).unwrap();
    let changes = [
        header[..header.len() / 2].to_owned(),
        String::new(),
        header.replacen("20", "21", 1),
        header.replacen("\"chronoxel\"", "\"chronoxyl\"", 1),
        header.replacen("\"version\": 1", "\"version\": 99", 1),
    ];
    for changed in changes {
        assert_ne!(changed, header);
        fs::write(folder.join("run.cxl/zarr.json"), &changed).unwrap();
        for line in ["info S", "verify S", "export S -o x.npy", "render S -o x.png", "play S"] {
            refused(folder, &line.replace('S', "run.cxl"), &["run.cxl/zarr.json"]);
        }
    }
}

/// Every file of a store in turn is removed.
#[test]
fn a_store_that_lacks_a_file_says_which() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    done(folder, "render run.cxl -o whole.png --size 40x30 -q");
    let files: Vec<_> =
        tree(&folder.join("run.cxl")).into_iter().filter(|(_, bytes)| bytes.is_some()).collect();
    assert!(files.len() > 6, "{files:?}");
    for (name, bytes) in files {
        let path = folder.join("run.cxl").join(&name);
        fs::remove_file(&path).unwrap();
        let name = name.to_str().unwrap();
        let verified = run(folder, "verify run.cxl --json");
        assert_eq!(verified.status, 1, "{name}: {verified:#?}");
        if verified.stdout.is_empty() {
            assert!(verified.stderr.contains(name) || name == "zarr.json", "{name}: {verified:#?}");
        } else {
            let report = one_object(&verified);
            assert_eq!(at(&report, "ok"), false);
            assert!(at(&report, "problems").to_string().contains(name), "{name}: {report}");
        }
        let drawn = run(folder, "render run.cxl -o part.png --size 40x30 -q");
        match drawn.status {
            0 => {
                let same =
                    fs::read(folder.join("whole.png")).unwrap() == fs::read(folder.join("part.png")).unwrap();
                assert!(same || drawn.stderr.contains("warning"), "{name}: {drawn:#?}");
            }
            1 => assert!(drawn.stderr.starts_with("chronoxel: error: run.cxl"), "{name}: {drawn:#?}"),
            _ => panic!("{drawn:#?}"),
        }
        fs::write(&path, bytes.unwrap()).unwrap();
    }
}
