//! `bench`: the paper's figures beside those of a small run.

use std::{collections::BTreeMap, fs};

use serde_json::Value;
use tempfile::tempdir;

use crate::{
    command::{at, done, json, refused, run},
    files::{names_in, npy_bytes},
};

/// Small enough for a test: simulations in place of the built-in ones, and a file.
const LINE: &str = "bench lum2001 --source 'sim:vortex?dims=20&steps=8' --source 'sim:shockbubble?dims=24x12x12&steps=8' \
                    --source drops.npy --out results";

/// Eight steps of 14³ samples: a drop that moves along x over a ground that does not.
fn drops() -> Vec<u8> {
    let mut samples = Vec::new();
    for t in 0..8 {
        for z in 0..14 {
            for y in 0..14 {
                for x in 0..14 {
                    let [dx, dy, dz] = [x as f32 - 3.0 - t as f32, y as f32 - 7.0, z as f32 - 6.0];
                    let value = (-(dx * dx + dy * dy + dz * dz) / 8.0).exp() + 0.01 * (y * z) as f32;
                    samples.extend(value.to_le_bytes());
                }
            }
        }
    }
    npy_bytes("<f4", "8, 14, 14, 14", &samples)
}

/// The rows by their labels.
fn rows(report: &Value) -> BTreeMap<String, Value> {
    let rows = at(report, "rows").as_array().unwrap().iter();
    let by_label: BTreeMap<String, Value> =
        rows.clone().map(|row| (at(row, "label").as_str().unwrap().to_owned(), row.clone())).collect();
    assert_eq!(by_label.len(), rows.len(), "two rows have the same label");
    by_label
}

fn number(row: &Value, path: &str) -> f64 {
    at(row, path).as_f64().unwrap_or_else(|| panic!("{path} in {row}"))
}

#[test]
fn lum2001_stands_beside_what_was_measured() {
    let folder = tempdir().unwrap();
    fs::write(folder.path().join("drops.npy"), drops()).unwrap();
    let report = json(folder.path(), LINE);
    let keys: Vec<&str> = report.as_object().unwrap().keys().map(String::as_str).collect();
    assert_eq!(keys.len(), 3, "{keys:?}");
    assert_eq!(at(&report, "name"), "lum2001");
    assert!(at(&report, "machine").as_str().unwrap().contains("threads"));
    let rows = rows(&report);
    for row in rows.values() {
        assert_eq!(row.as_object().unwrap().len(), 3, "{row}");
    }
    check_errors(&rows);
    check_rates(&rows);

    // The paper's own data: its figures alone. Of a file the paper says nothing, but how long it takes.
    let qg = rows.iter().filter(|(label, _)| label.contains("quasi-geostrophic"));
    assert_eq!(qg.inspect(|(_, row)| assert_eq!(row["here"].as_object().unwrap().len(), 0)).count(), 7);
    let qg = &rows["Table 5, mean square error: quasi-geostrophic turbulent flow, 256^3, 1492 steps, not measured here: 8x"];
    assert_eq!(number(qg, "paper.mse_avg"), 0.000075);
    assert_eq!(
        rows["mean square error: drops.npy: 2x, vector palette"]["paper"].as_object().unwrap().len(),
        0
    );

    // The report lies where it was asked for, and nothing else.
    assert_eq!(names_in(folder.path()), ["drops.npy", "results"]);
    assert_eq!(names_in(&folder.path().join("results")), ["lum2001.json", "lum2001.txt"]);
    let written = fs::read_to_string(folder.path().join("results/lum2001.json")).unwrap();
    assert_eq!(serde_json::from_str::<Value>(&written).unwrap(), report);
    let text = fs::read_to_string(folder.path().join("results/lum2001.txt")).unwrap();
    assert!(text.contains("Table 6, mean square error: sim:vortex?dims=20&steps=8\n"), "{text}");
}

fn check_errors(rows: &BTreeMap<String, Value>) {
    for source in [
        "Table 6, mean square error: sim:vortex?dims=20&steps=8",
        "Table 7, mean square error: sim:shockbubble?dims=24x12x12&steps=8",
        "mean square error: drops.npy",
    ] {
        let row = |ratio: &str, codec: &str| &rows[&format!("{source}: {ratio}, {codec}")];
        for codec in ["product palette", "product palette per slice", "vector palette"] {
            let mse = ["2x", "4x", "8x"].map(|ratio| number(row(ratio, codec), "here.mse_avg"));
            assert!(0.0 < mse[0] && mse[0] < mse[1] && mse[1] < mse[2], "{source}, {codec}: {mse:?}");
            let eight = row("8x", codec);
            let [min, max] = ["here.mse_min", "here.mse_max"].map(|key| number(eight, key));
            assert!(min <= mse[2] && mse[2] <= max && max < 0.05, "{eight}");
            let psnr = number(eight, "here.psnr_db");
            assert!((psnr + 10.0 * mse[2].log10()).abs() < 1e-9, "{eight}");
            let [all, core] =
                ["here.bits_per_sample", "here.bits_per_sample_without_apron"].map(|k| number(eight, k));
            assert!(0.0 < core && core < all, "{eight}");
        }
        for ratio in ["2x", "4x", "8x"] {
            let [vector, product] =
                ["vector palette", "product palette"].map(|codec| number(row(ratio, codec), "here.mse_avg"));
            assert!(vector <= product, "{source}, {ratio}: {vector} {product}");
        }
    }
    let vortex = &rows["Table 6, mean square error: sim:vortex?dims=20&steps=8: 4x, vector palette"];
    assert_eq!(number(vortex, "paper.mse_avg"), 0.000304);
    let shock =
        &rows["Table 7, mean square error: sim:shockbubble?dims=24x12x12&steps=8: 2x, product palette"];
    assert_eq!(number(shock, "paper.mse_max"), 0.000017);
}

fn check_rates(rows: &BTreeMap<String, Value>) {
    for source in [
        "Table 4, frames per second: sim:vortex?dims=20&steps=8",
        "Table 3, frames per second: sim:shockbubble?dims=24x12x12&steps=8",
        "frames per second: drops.npy",
    ] {
        let row = |ratio: &str| &rows[&format!("{source}: {ratio}")];
        let all =
            ["1x, 8 bits", "2x, product palette", "4x, product palette", "8x, product palette"].map(row);
        for row in all {
            assert!(
                number(row, "here.fps_in_core") > 0.0 && number(row, "here.fps_out_of_core") > 0.0,
                "{row}"
            );
            assert!(
                number(row, "here.ms_per_step") > 0.0 && number(row, "here.steps_in_core") == 8.0,
                "{row}"
            );
            let share = number(row, "here.window_share");
            assert!((0.1..0.3334).contains(&share), "{row}");
        }
        assert!(number(all[3], "here.bytes_per_step") < number(all[0], "here.bytes_per_step"), "{source}");
    }
    let shock =
        &rows["Table 3, frames per second: sim:shockbubble?dims=24x12x12&steps=8: 8x, product palette"];
    assert_eq!([number(shock, "paper.fps_in_core"), number(shock, "paper.fps_out_of_core")], [11.7, 5.8]);
    let time = &rows["seconds to encode a step of 256^3: drops.npy: 2x, vector palette"];
    assert!(number(time, "here.secs_per_step") > 0.0);
    assert_eq!(number(time, "paper.secs_per_step_max"), 15.0);
}

#[test]
fn a_source_that_is_not_there_is_told_before_anything_is_measured() {
    let folder = tempdir().unwrap();
    refused(folder.path(), "bench lum2001 --source absent.npy --out results", &["absent.npy"]);
}

#[test]
fn help_names_the_benches() {
    let folder = tempdir().unwrap();
    let help = done(folder.path(), "bench --help").stdout;
    assert!(help.contains("lum2001") && help.contains("chronoxel bench lum2001 --size full"), "{help}");
}

#[test]
fn binotto2003_stands_beside_what_was_measured() {
    let folder = tempdir().unwrap();
    fs::write(folder.path().join("drops.npy"), drops()).unwrap();
    let line = "bench binotto2003 --source 'sim:plume?dims=32&steps=6&limit=0.05' --source drops.npy";
    let rows = rows(&json(folder.path(), line));
    assert_eq!(rows.len(), 2 + 6, "{:?}", rows.keys());
    let zeros = &rows["Table 1, spatial sparseness: sim:plume?dims=32&steps=6&limit=0.05"];
    assert!((50.0..100.0).contains(&number(zeros, "here.zeros_percent")), "{zeros}");
    // A level more: eight times the index cells, of 4 numbers; blocks that vary are fewer than all.
    for (level, blocks) in [(3, 512.0), (4, 4096.0)] {
        let title = "Table 2, index and refinement textures: sim:plume?dims=32&steps=6&limit=0.05: level";
        let row = &rows[&format!("{title} {level}")];
        assert_eq!(number(row, "here.index_cells"), 4.0 * 6.0 * blocks);
        let [varied, different] = ["here.varied_blocks", "here.different_blocks"].map(|k| number(row, k));
        assert!(0.0 < different && different <= varied && varied < 6.0 * blocks, "{row}");
        let cells = number(row, "here.index_cells") + number(row, "here.refinement_cells");
        let ratio = 4.0 * 6.0 * 32768.0 / cells;
        assert!((number(row, "here.ratio") - ratio).abs() < 1e-9, "{row}");
        assert!(number(row, "here.store_bytes") > 1000.0, "{row}");
    }
    // The drop leaves most of the ground as it is from step to step: seven of eight times its blocks are there already.
    let drops = &rows["Table 2, index and refinement textures: drops.npy: level 3"];
    assert!(number(drops, "here.different_blocks") < 0.25 * number(drops, "here.varied_blocks"), "{drops}");
}

#[test]
fn ellsworth2000_stands_beside_what_was_measured() {
    let folder = tempdir().unwrap();
    fs::write(folder.path().join("drops.npy"), drops()).unwrap();
    let line =
        "bench ellsworth2000 --size tiny --source 'sim:shockbubble?dims=24x12x12&steps=4' --source drops.npy";
    let rows = rows(&json(folder.path(), line));
    let paper = &rows["Table 5, % of samples by how they are drawn: the paper's data, not measured here: \
                       large Delta, 222x253x103, 12 steps, sparse, zero, approximate"];
    assert_eq!((number(paper, "paper.not_rendered"), number(paper, "paper.new")), (66.0, 34.0));
    for source in ["sim:shockbubble?dims=24x12x12&steps=4", "drops.npy"] {
        for case in ["brick 16, sparse", "brick 32, filled", "brick 64, sparse"] {
            check_coherence(&rows, source, case);
        }
    }
    let shock = &rows["Table 5, % of samples by how they are drawn: \
                       sim:shockbubble?dims=24x12x12&steps=4: brick 32, filled, slight, approximate"];
    assert_eq!(number(shock, "paper.constant"), 63.0);
}

fn check_coherence(rows: &BTreeMap<String, Value>, source: &str, case: &str) {
    let build = &rows[&format!("Table 2, seconds to compute the metrics: {source}: {case}")];
    assert!(number(build, "here.approximate") > 0.0 && number(build, "here.reference") > 0.0, "{build}");
    let share = |tolerance: &str, metric: &str| {
        let title = "Table 5, % of samples by how they are drawn";
        &rows[&format!("{title}: {source}: {case}, {tolerance}, {metric}")]
    };
    let shares = ["here.not_rendered", "here.constant", "here.reused", "here.new"];
    for tolerance in ["zero", "slight", "moderate"] {
        let times = &rows[&format!("Tables 3 and 4, ms per frame: {source}: {case}, {tolerance}")];
        for metric in ["scalar", "reference", "approximate", "reference luv", "approximate luv"] {
            let row = share(tolerance, metric);
            let sum: f64 = shares.iter().map(|key| number(row, key)).sum();
            assert!((sum - 100.0).abs() < 1e-6, "{row}");
            assert!(tolerance != "zero" || number(row, "here.luv_distance") == 0.0, "{row}");
            let times = times["here"].as_object().unwrap();
            assert!(times[&format!("{metric}, not cached")].as_f64().unwrap() > 0.0);
            assert!(times[&format!("{metric}, cached")].as_f64().unwrap() > 0.0);
        }
    }
    // As in the paper's table 5: without tolerance, the approximate metric chooses as the reference does.
    for key in shares {
        let [reference, approximate] =
            ["reference", "approximate"].map(|metric| number(share("zero", metric), key));
        assert!((reference - approximate).abs() <= 5.0, "{source}, {case}: {key} {reference} {approximate}");
    }
}

#[test]
fn playback_on_the_gpu_stands_beside_a_whole_texture() {
    let folder = tempdir().unwrap();
    if std::env::var("CHRONOXEL_REQUIRE_GPU").as_deref() != Ok("1")
        && run(folder.path(), "bench gpu-playback --size tiny").stderr.contains("no GPU adapter")
    {
        return println!("skipped: there is no adapter");
    }
    let rows = rows(&json(folder.path(), "bench gpu-playback --size tiny"));
    assert_eq!(rows.len(), 4);
    for (label, row) in &rows {
        for key in ["fps_pool", "fps_shown", "fps_fetch", "fps_whole", "fps_cpu", "render_ms_pool"] {
            assert!(number(row, &format!("here.{key}")) > 0.0, "{label}: {key}: {row}");
        }
        assert!(number(row, "here.psnr_db") > 35.0, "{label}: {row}");
        let [own, whole] = ["here.bytes_per_frame", "here.whole_bytes_per_frame"].map(|key| number(row, key));
        match label.ends_with("new steps") {
            true => assert!(own < 1024.0 && whole == 8000.0, "{label}: {row}"),
            false => assert!(own < 512.0 && whole == 0.0, "{label}: {row}"),
        }
    }
}

#[test]
fn binotto2003_frame_rates_stand_beside_what_was_measured() {
    let folder = tempdir().unwrap();
    let rows = rows(&json(folder.path(), "bench binotto2003-speed --source 'sim:plume?dims=16&steps=3'"));
    assert_eq!(rows.len(), 6);
    for row in rows.values() {
        assert!(number(row, "here.fps_cpu") > 0.0, "{row}");
    }
    let row = &rows["Table 3, frames per second: sim:plume?dims=16&steps=3: 500 slices, 512x512"];
    assert_eq!(number(row, "paper.fps"), 1.3);
    if std::env::var("CHRONOXEL_REQUIRE_GPU").as_deref() == Ok("1") {
        assert!(number(row, "here.fps_gpu") > 0.0, "{row}");
    }
}

#[test]
fn bernardon2006_stands_beside_what_was_measured() {
    let folder = tempdir().unwrap();
    let line = "bench bernardon2006 --size tiny --source 'sim:twist?dims=7&steps=66' --out results";
    let rows = rows(&json(folder.path(), line));
    let twist = "sim:twist?dims=7&steps=66";
    let table = &rows[&format!("Table 1, compression: {twist}")];
    assert_eq!((number(table, "here.points"), number(table, "here.tetrahedra")), (343.0, 1080.0));
    assert!(number(table, "here.stored_ratio") > 1.0 && number(table, "here.max_error") < 0.1, "{table}");
    let jet = &rows["Table 1, compression: TJET stand-in, vortex of 8³"];
    assert_eq!((number(jet, "paper.ratio"), number(jet, "paper.max_error")), (34.7, 0.2042));
    assert!(number(jet, "here.snr_min_db") <= number(jet, "here.snr_max_db"), "{jet}");
    let rates = &rows[&format!("Table 1, frames per second at 96 x 96, k = 6: {twist}")];
    assert!(number(rates, "here.static_fps") > 0.0 && number(rates, "here.moving_fps") > 0.0, "{rates}");
    if std::env::var("CHRONOXEL_REQUIRE_GPU").as_deref() == Ok("1") {
        assert!(number(rates, "here.gpu_moving_fps") > 0.0, "{rates}");
    }
    for k in [2, 6, 16] {
        let row = &rows[&format!("Fragments out of order: {twist}: k = {k}")];
        assert!(number(row, "here.fragments") > 1000.0, "{row}");
        assert!(k == 2 || number(row, "here.misordered") == 0.0, "{row}");
    }
    let parts = "Figures 4 and 5, pictures with a part of the faces, L*u*v* distance to all of them";
    let [few, many] = [5, 25].map(|share| &rows[&format!("{parts}: {twist}: {share} %")]);
    assert!(number(few, "here.luv_spread") >= number(many, "here.luv_spread"), "{few} {many}");
    let bricks =
        &rows[&format!("The same mesh as bricks and as cells: {twist}: bricks of level 0, all cells")];
    assert!(number(bricks, "here.psnr_db") > 20.0, "{bricks}");
    let svg = fs::read_to_string(folder.path().join("results/bricks-and-cells.svg")).unwrap();
    assert!(svg.contains("percent of those within"), "{svg}");
    assert_eq!(names_in(&folder.path().join("results")).len(), 3);
}
