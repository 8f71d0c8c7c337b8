//! Meshes on the command line: encoded, looked at, checked against their source.

use tempfile::tempdir;

use crate::command::{at, done, json, number, refused};

#[test]
fn a_mesh_is_encoded_shown_and_checked() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    let line = "encode sim:twist?dims=13&steps=3 --variable pulse --brick 8 --max-depth 3 --max-error 0.001 -o t.cxl";
    let summary = json(folder, line);
    assert_eq!(at(&summary, "mesh.census.num_tetrahedra"), 12 * 12 * 12 * 5);
    assert_eq!(at(&summary, "raw_bytes"), 3 * 4 * 13 * 13 * 13);
    let info = json(folder, "info t.cxl");
    assert_eq!(at(&info, "kind"), "store");
    assert_eq!(at(&info, "grid.type"), "curvilinear");
    assert_eq!((at(&info, "grid.num_cells"), at(&info, "grid.num_points")), (&1728.into(), &2197.into()));
    assert!(done(folder, "info t.cxl").stdout.contains("curvilinear"));
    let checked = json(folder, "verify t.cxl --against sim:twist?dims=13&steps=3");
    assert_eq!(at(&checked, "ok"), true);
    let error = number(&checked, "variables.pulse.max_abs_error");
    assert!(error > 0.0 && error <= 0.001, "{error}");
    done(folder, "render t.cxl --step 1 --size 64x48 -o t.png");
    assert!(folder.join("t.png").is_file());
}

#[test]
fn only_meshes_take_what_is_for_meshes() {
    let folder = tempdir().unwrap();
    for option in ["--max-depth 3", "--field-threshold 0.1", "--as bricks"] {
        let line = format!("encode sim:vortex?dims=16&steps=1 -o v.cxl {option}");
        refused(folder.path(), &line, &[option.split(' ').next().unwrap(), "uniform"]);
    }
    refused(folder.path(), "encode sim:twist?dims=9&steps=1 -o t.cxl --max-depth 20", &["--max-depth 20"]);
    done(folder.path(), "encode sim:twist?dims=9&steps=1 --brick 8 -o t.cxl");
    let other = "verify t.cxl --against sim:twist?dims=10&steps=1";
    refused(folder.path(), other, &["not the source of this store"]);
}

#[test]
fn leven2002_stands_beside_what_was_measured() {
    let folder = tempdir().unwrap();
    let report = json(folder.path(), "bench leven2002 --size tiny --out results");
    let rows = at(&report, "rows").as_array().unwrap();
    assert_eq!(rows.len(), 12);
    assert_eq!(at(&rows[0], "here.tetrahedra"), 8 * 8 * 8 * 5);
    assert!(number(&rows[0], "here.stored_megabytes") > 0.0);
    assert_eq!(at(&rows[1], "here.relative_size"), 1.0);
    for row in &rows[8..] {
        let figures = ["min", "median", "max"].map(|key| number(row, &format!("here.{key}")));
        assert!(figures[0] > 0.0 && figures.is_sorted(), "{row}");
    }
    let plot = std::fs::read_to_string(folder.path().join("results/figure-15.svg")).unwrap();
    for label in ["frame rate (1/s)", "nodes drawn", "voxel edge (pixels)", "frame of the flight"] {
        assert!(plot.contains(label), "{label} is missing");
    }
}
