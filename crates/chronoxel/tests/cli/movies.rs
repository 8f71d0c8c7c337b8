//! `movie`, `play` and `demo`.

use std::{fs, path::Path};

use serde_json::json;
use tempfile::tempdir;

use crate::{
    command::{Ran, at, command, done, json, number, one_object, refused, run},
    files::{mean_difference, names_in, picture},
};

fn store_in(folder: &Path) {
    done(folder, "encode 'sim:plume?dims=16&steps=4' -o run.cxl -q");
}

#[test]
fn movies_of_every_kind() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let report = json(folder, "movie run.cxl -o m.gif --size 32x24 --fps 10");
    assert_eq!([at(&report, "frames"), at(&report, "size")], [&json!(4), &json!([32, 24])]);
    let gif = fs::read(folder.join("m.gif")).unwrap();
    assert_eq!(&gif[..10], b"GIF89a\x20\x00\x18\x00");

    json(folder, "movie run.cxl -o m.apng --size 32x24 --steps 1:4:2 --orbit 30");
    let apng = fs::read(folder.join("m.apng")).unwrap();
    let control = apng.windows(4).position(|w| w == b"acTL").unwrap();
    assert_eq!(apng[control + 4..control + 8], [0, 0, 0, 2], "two frames");

    json(folder, "movie run.cxl -o 'frames/{frame:03}.png' --size 32x24 --frames 8");
    let names: Vec<String> = (0..8).map(|n| format!("{n:03}.png")).collect();
    assert_eq!(names_in(&folder.join("frames")), names);
    for (frame, step) in [(0, 0), (1, 0), (4, 2), (7, 3)] {
        done(folder, &format!("render run.cxl -o one.png -t {step} --size 32x24 -q"));
        assert_eq!(picture(folder.join("one.png")), picture(folder.join(format!("frames/{frame:03}.png"))));
    }
    done(folder, "movie run.cxl -o 'turn/{frame}.png' --size 32x24 --steps 2 --frames 4 --orbit 360 -q");
    done(folder, "render run.cxl -o one.png -t 2 --azimuth 120 --size 32x24 -q");
    assert!(mean_difference(&picture(folder.join("one.png")), &picture(folder.join("turn/1.png"))) < 1e-3);

    // Cameras of files are turned as well: a quarter about y, from z to x or back.
    let camera =
        |position: &str| format!(r#"{{"position":{position},"look_at":[500,500,500],"fov_y_deg":30}}"#);
    fs::write(folder.join("z.json"), camera("[500,500,3500]")).unwrap();
    done(
        folder,
        "movie run.cxl -o 'file/{frame}.png' --size 32x24 --steps 2 --frames 4 --orbit 360 --camera z.json -q",
    );
    let quarter = picture(folder.join("file/1.png"));
    let sides = ["[3500,500,500]", "[-2500,500,500]"].map(|position| {
        fs::write(folder.join("x.json"), camera(position)).unwrap();
        done(folder, "render run.cxl -o one.png -t 2 --camera x.json --size 32x24 -q");
        mean_difference(&picture(folder.join("one.png")), &quarter)
    });
    assert!(sides[0].min(sides[1]) < 0.01 && sides[0].max(sides[1]) > 0.05, "{sides:?}");
    for name in ["x.json", "z.json"] {
        fs::remove_file(folder.join(name)).unwrap();
    }
    assert_eq!(names_in(folder), ["file", "frames", "m.apng", "m.gif", "one.png", "run.cxl", "turn"]);
}

#[test]
fn an_mp4_is_made_or_the_remedy_named() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let line = "movie run.cxl -o m.mp4 --size 33x25 -q";
    // Without a PATH there is no ffmpeg.
    let output = command(folder, line).env("PATH", "").output().unwrap();
    let ran = Ran::new(line, &output);
    assert_eq!(ran.status, 1);
    for word in ["m.mp4", "ffmpeg", "not on the PATH", ".gif"] {
        assert!(ran.stderr.contains(word), "{ran:#?}");
    }
    assert_eq!(names_in(folder), ["run.cxl"]);
    if std::process::Command::new("ffmpeg").arg("-version").output().is_err() {
        eprintln!("skipped in part: there is no ffmpeg");
        return;
    }
    done(folder, line);
    let mp4 = fs::read(folder.join("m.mp4")).unwrap();
    assert_eq!(&mp4[4..8], b"ftyp");
    assert_eq!(names_in(folder), ["m.mp4", "run.cxl"]);
}

#[test]
fn movies_that_cannot_be_made_are_refused() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    fs::write(folder.join("file"), "").unwrap();
    for (line, says) in [
        ("movie run.cxl -o m.avi", &["m.avi", ".mp4"][..]),
        ("movie run.cxl -o m.png", &["m.png", "{frame:04}"]),
        ("movie run.cxl -o 'f/{page}.png'", &["{page}", "{frame:04}"]),
        ("movie run.cxl -o 'f/{step}.png' --steps 1 --frames 2 --size 8x8", &["f/1.png", "{frame}"]),
        ("movie run.cxl -o m.gif --steps 0:9", &["--steps", "9", "0 to 3"]),
        ("movie run.cxl -o m.gif --steps 2:2", &["--steps", "2:2"]),
        ("movie run.cxl -o file/m.gif", &["file"]),
        ("movie lost.cxl -o m.gif", &["lost.cxl"]),
        ("play lost.cxl", &["lost.cxl"]),
        ("play run.cxl --csv file/x.csv --size 8x8", &["file/x.csv"]),
        ("play run.cxl --steps 7", &["--steps", "0 to 3"]),
    ] {
        refused(folder, line, says);
    }
}

#[test]
fn play_measures_every_frame() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let line = "play run.cxl --size 40x30 --frames 6 --reverse --orbit 90 --csv frames.csv";
    let report = json(folder, line);
    assert_eq!(at(&report, "frames"), 6);
    let ordered = |path: &str, keys: &[&str]| {
        let values: Vec<f64> = keys.iter().map(|key| number(&report, &format!("{path}.{key}"))).collect();
        assert!(values.is_sorted() && values[0] >= 0.0, "{path}: {values:?}");
    };
    ordered("fps", &["p5", "p50"]);
    ["frame_ms", "step_ms", "render_ms", "cpu_ms"]
        .iter()
        .for_each(|t| ordered(t, &["p50", "p95", "p99", "max"]));
    assert!(number(&report, "fps.mean") > 0.0);
    // One brick per frame. Steps are read ahead, but the frames are short.
    assert_eq!(number(&report, "cache.misses") + number(&report, "cache.hits"), 6.0);
    assert!(number(&report, "cache.misses") <= 3.0);
    let stored = number(&json(folder, "info run.cxl"), "stored_bytes");
    assert!((0.0..stored).contains(&number(&report, "bytes_from_disk")));
    assert_eq!([number(&report, "bytes_uploaded"), number(&report, "gpu_bytes_peak")], [0.0; 2]);
    assert!(number(&report, "peak_rss_bytes") > 1e6 && number(&report, "mean_pixels_per_voxel") > 0.1);
    let csv = fs::read_to_string(folder.join("frames.csv")).unwrap();
    let rows: Vec<Vec<&str>> = csv.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(rows[0][..2], ["frame", "step"]);
    let steps: Vec<&str> = rows[1..].iter().map(|row| row[1]).collect();
    assert_eq!(steps, ["3", "2", "1", "0", "3", "2"]);
    assert!(rows.iter().all(|row| row.len() == rows[0].len()));
    assert!(done(folder, "play run.cxl --size 20x20 --warm off").stdout.contains("frames per second"));
}

#[test]
fn the_demo_makes_what_it_says() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    let ran = run(folder, "demo made/here --size tiny --json");
    assert_eq!((ran.status, ran.stderr.as_str()), (0, ""), "{ran:#?}");
    let report = one_object(&ran);
    for key in ["store", "picture", "movie"] {
        assert!(folder.join(at(&report, key).as_str().unwrap()).exists(), "{report}");
    }
    assert!(number(&report, "wall_secs") > 0.0 && number(&report, "ratio") > 1.0);
    // Every error is below 0.002 of the range: 54 dB.
    assert!(number(&report, "psnr_db") > 54.0);
    let drawn = picture(folder.join(at(&report, "picture").as_str().unwrap()));
    assert!(drawn.pixels.iter().filter(|p| p[..3] != [0, 0, 0]).count() > drawn.pixels.len() / 20);
    fs::write(folder.join("file"), "").unwrap();
    refused(folder, "demo file", &["file"]);
    refused(folder, "demo file/below", &["file/below"]);
}
