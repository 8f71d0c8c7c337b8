//! From files to a store and back: encode, info, verify, export.

use std::path::Path;

use serde_json::json;
use tempfile::tempdir;

use crate::{
    command::{at, done, json, number, refused},
    files::{assert_same_folders, fixture, names_in, write_f32, write_u8_steps},
};

/// Bricks of every kind: 40 × 20 × 24 samples of 8 bits, three steps.
const DIMS: [usize; 3] = [40, 20, 24];

fn sample(step: usize, [x, y, z]: [usize; 3]) -> u8 {
    (3 * x + 5 * y + 7 * z + 11 * step) as u8
}

/// A folder with `source.npy` and `run.cxl`, encoded from it.
fn encoded(folder: &Path) {
    write_u8_steps(&folder.join("source.npy"), 3, DIMS, sample);
    done(folder, "encode source.npy -o run.cxl --brick 16 -q");
}

#[test]
fn encode_and_info_and_verify_say_what_scripts_rely_on() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    write_u8_steps(&folder.join("source.npy"), 3, DIMS, sample);
    let encoded = json(folder, "encode source.npy -o run.cxl --brick 16 --spacing 1,1,2 --dt 0.5");
    let raw_bytes = 3 * 40 * 20 * 24;
    assert_eq!(at(&encoded, "raw_bytes"), raw_bytes);
    assert_eq!(at(&encoded, "steps_read"), 3);
    let stored: u64 =
        crate::files::tree(&folder.join("run.cxl")).values().flatten().map(|bytes| bytes.len() as u64).sum();
    assert_eq!(at(&encoded, "stored_bytes"), stored);
    assert_eq!(number(&encoded, "ratio"), f64::from(raw_bytes) / stored as f64);
    assert_eq!(number(&encoded, "bits_per_sample"), 8.0 * stored as f64 / f64::from(raw_bytes));
    assert!(number(&encoded, "wall_secs") > 0.0 && number(&encoded, "bytes_per_sec") > 0.0);
    assert!((1e6..2e9).contains(&number(&encoded, "peak_rss_bytes")));

    let info = json(folder, "info run.cxl");
    assert_eq!(at(&info, "kind"), "store");
    let grid = json!({ "type": "uniform", "dims": DIMS, "spacing": [1.0, 1.0, 2.0], "origin": [0.0, 0.0, 0.0],
        "num_cells": 39 * 19 * 23 });
    assert_eq!(at(&info, "grid"), &grid);
    assert_eq!(at(&info, "num_steps"), 3);
    assert_eq!(at(&info, "times"), &json!([0.0, 0.5, 1.0]));
    assert!(at(&info, "time_units").is_string());
    let all: Vec<u8> = (0..DIMS[0] * DIMS[1] * DIMS[2])
        .flat_map(|i| (0..3).map(move |s| sample(s, [i % 40, i / 40 % 20, i / 800])))
        .collect();
    assert_eq!(number(&info, "variables.source.min"), f64::from(*all.iter().min().unwrap()));
    assert_eq!(number(&info, "variables.source.max"), f64::from(*all.iter().max().unwrap()));
    assert_eq!(at(&info, "variables.source.codec"), "auto");
    assert_eq!(at(&info, "brick"), &json!({ "edge": 16, "cells": 4096, "samples_stored": 6859 }));
    // 3 × 2 × 2 bricks, half as many twice, and the root.
    assert_eq!(at(&info, "num_levels"), 3);
    assert_eq!([at(&info, "raw_bytes"), at(&info, "stored_bytes")], [raw_bytes as u64, stored]);
    let payloads = ["empty", "constant", "coded", "shared"].map(|k| number(&info, &format!("payloads.{k}")));
    assert_eq!(payloads.iter().sum::<f64>(), 3.0 * (12.0 + 2.0 + 1.0), "{info}");

    let verified = json(folder, "verify run.cxl --against source.npy --spacing 1,1,2 --dt 0.5");
    let none =
        json!({ "mse": { "min": 0.0, "max": 0.0, "avg": 0.0 }, "psnr_db": null, "max_abs_error": 0.0 });
    assert_eq!([at(&verified, "ok"), at(&verified, "problems")], [&json!(true), &json!([])]);
    for (key, value) in none.as_object().unwrap() {
        assert_eq!(at(&verified, &format!("variables.source.{key}")), value);
    }
    assert_eq!(number(&verified, "variables.source.bits_per_sample"), number(&encoded, "bits_per_sample"));
    let unmeasured = json(folder, "verify run.cxl");
    assert_eq!([at(&unmeasured, "ok"), at(&unmeasured, "variables")], [&json!(true), &json!({})]);
}

#[test]
fn info_of_a_source_has_the_same_words() {
    let folder = tempdir().unwrap();
    let info = json(folder.path(), &format!("info {}", fixture("series/run.pvd")));
    assert_eq!(at(&info, "kind"), "source");
    assert_eq!(at(&info, "num_steps"), 3);
    for key in
        ["grid.dims", "grid.spacing", "grid.origin", "grid.num_cells", "times", "time_units", "raw_bytes"]
    {
        at(&info, key);
    }
    let variables = at(&info, "variables").as_object().unwrap();
    assert!(variables.values().all(|v| number(v, "min") < number(v, "max")), "{info}");
    done(folder.path(), &format!("info {}", fixture("series/run.pvd")));
}

#[test]
fn every_export_can_be_encoded_again_without_loss() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    encoded(folder);
    for format in ["pvd", "npy", "nrrd", "zarr"] {
        let exported = json(folder, &format!("export run.cxl -o again.{format}"));
        assert_eq!(at(&exported, "steps"), &json!([0, 1, 2]));
        let source = if format == "npy" { "again.npy --dt 1".to_owned() } else { format!("again.{format}") };
        done(folder, &format!("encode {source} -o {format}.cxl --brick 16 -q"));
        done(folder, &format!("export {format}.cxl -o {format}.npy"));
        let [first, again] =
            ["source.npy", &format!("{format}.npy")].map(|name| std::fs::read(folder.join(name)).unwrap());
        let samples = 3 * DIMS.iter().product::<usize>();
        assert!(first[first.len() - samples..] == again[again.len() - samples..], "{format}");
    }
    let step = json(folder, "export run.cxl --steps 1 -o step.vti");
    assert_eq!(at(&step, "steps"), &json!([1]));
    done(folder, "encode step.vti -o step.cxl -q");
    done(folder, "export run.cxl --steps 1 -o one.npy -q");
    refused(folder, "verify step.cxl --against one.npy", &["--against", "source", "one"]);
    std::fs::rename(folder.join("one.npy"), folder.join("source.npy")).unwrap();
    let measured = json(folder, "verify step.cxl --against source.npy");
    assert_eq!(number(&measured, "variables.source.max_abs_error"), 0.0);
}

#[test]
fn fixtures_of_every_format_are_encoded() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    let sources = ["npy/f4.npy", "nrrd/gzip.nrrd", "vti/raw_lz4_64.vti", "series/run.pvd", "zarr/ocean.zarr"];
    for (number, name) in sources.iter().enumerate() {
        let source = fixture(name);
        done(folder, &format!("encode '{source}' -o {number}.cxl -q --brick 8"));
        let verified = json(folder, &format!("verify {number}.cxl --against '{source}'"));
        assert_eq!(at(&verified, "ok"), true, "{name}: {verified}");
        for (variable, errors) in at(&verified, "variables").as_object().unwrap() {
            // 16 bits in each brick's range, which is not wider than the variable's.
            assert!(
                number_or(errors, "max_abs_error") <= 0.5 / 65535.0 * 1.01,
                "{name} {variable}: {errors}"
            );
        }
    }
    let glob = fixture("series/step*.vti");
    done(folder, &format!("encode '{glob}' -o glob.cxl -q"));
    assert_eq!(at(&json(folder, "info glob.cxl"), "num_steps"), 3);
}

fn number_or(value: &serde_json::Value, path: &str) -> f64 {
    at(value, path).as_f64().unwrap_or(0.0)
}

#[test]
fn an_error_bound_is_kept() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    write_f32(&folder.join("wave.npy"), [48, 33, 20], |[x, y, z]| {
        (0.3 * x as f32).sin() + (0.2 * (y + z) as f32).cos()
    });
    let mut last = f64::INFINITY;
    for bound in [0.01, 0.0005] {
        let line = format!("encode wave.npy -o wave.cxl --overwrite --max-error {bound}");
        let ratio = number(&json(folder, &line), "ratio");
        assert!(ratio < last, "a tighter bound takes more bytes");
        last = ratio;
        let verified = json(folder, "verify wave.cxl --against wave.npy");
        let error = number(&verified, "variables.wave.max_abs_error");
        assert!(error > 0.0 && error <= bound, "{error} of {bound}");
        assert!(number(&verified, "variables.wave.psnr_db") >= -20.0 * bound.log10());
    }
}

#[test]
fn threads_and_memory_do_not_change_a_byte() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    let source = "'sim:plume?dims=40x40x24&steps=3'";
    for (name, options) in [("a", "--threads 1"), ("b", "--threads 3"), ("c", "--threads 2 --memory 24MiB")] {
        done(folder, &format!("encode {source} -o {name}.cxl --brick 16 --max-error 0.001 -q {options}"));
        assert_same_folders(&folder.join("a.cxl"), &folder.join(format!("{name}.cxl")));
    }
}

#[test]
fn an_output_that_exists_is_left_alone_unless_it_is_to_go() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    encoded(folder);
    refused(folder, "encode source.npy -o run.cxl", &["run.cxl", "already exists", "--overwrite"]);
    done(folder, "encode source.npy -o run.cxl --overwrite -q --brick 8");
    assert_eq!(at(&json(folder, "info run.cxl"), "brick.edge"), 8);
    assert_eq!(names_in(folder), ["run.cxl", "source.npy"]);
    std::fs::create_dir(folder.join("mine.cxl")).unwrap();
    std::fs::write(folder.join("mine.cxl/letter"), "dear").unwrap();
    refused(folder, "encode source.npy -o mine.cxl --overwrite", &["mine.cxl", "not a Chronoxel store"]);
}
