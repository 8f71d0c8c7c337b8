//! Tolerances and partial images on the command line.

use std::path::Path;

use serde_json::{Value, json};
use tempfile::tempdir;

use crate::{
    command::{at, done, json, number, refused},
    files::{mean_difference, picture, write_u8_steps},
};

const DIMS: [usize; 3] = [40, 24, 20];

/// A blob that stays and one that moves.
fn sample(step: usize, place: [usize; 3]) -> u8 {
    let [x, y, z] = place.map(|i| i as f64);
    let blob = |cx: f64, r: f64| (-((x - cx).powi(2) + (y - 12.0).powi(2) + (z - 9.0).powi(2)) / r).exp();
    (120.0 * blob(30.0, 40.0) + 100.0 * blob(4.0 + step as f64, 25.0)) as u8
}

fn store_in(folder: &Path) {
    write_u8_steps(&folder.join("source.npy"), 8, DIMS, sample);
    done(folder, "encode source.npy -o run.cxl --brick 8 --codec raw -q");
}

fn share(report: &Value, of: &str) -> f64 {
    number(report, &format!("samples_of_grid.{of}")) / (40.0 * 24.0 * 20.0)
}

#[test]
fn tolerances_are_reported_by_what_is_drawn_how() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let render =
        |options: &str| json(folder, &format!("render run.cxl -t 6 --size 80x60 --tf filled {options}"));
    let plain = render("-o plain.png");
    assert!(share(&plain, "reused") == 0.0 && share(&plain, "new") > 0.3, "{plain}");
    let exact = render("-o exact.png --metric scalar");
    assert_eq!(picture(folder.join("exact.png")), picture(folder.join("plain.png")));
    assert_eq!(at(&exact, "samples"), at(&plain, "samples"));
    for metric in ["scalar", "color-reference", "color-approximate"] {
        let report = render(&format!(
            "-o coarse.png --metric {metric} --spatial-tolerance 0.4 --temporal-tolerance 0.2"
        ));
        assert!(share(&report, "new") < share(&plain, "new"), "{metric}");
        let sum: f64 = ["skipped", "constant", "reused", "new"].iter().map(|of| share(&report, of)).sum();
        assert!((sum - 1.0).abs() < 1e-12, "{metric}");
        let off = mean_difference(&picture(folder.join("coarse.png")), &picture(folder.join("plain.png")));
        assert!(0.0 < off && off < 10.0, "{metric}: {off} levels");
    }
    refused(
        folder,
        "render run.cxl --time 2.5 --blend-steps --temporal-tolerance 0.1 -o x.png",
        &["--blend-steps"],
    );
}

#[test]
fn a_still_camera_composites_what_stays() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let play = |options: &str| json(folder, &format!("play run.cxl --size 80x60 --tf filled {options}"));
    let plain = play("");
    assert_eq!(
        [at(&plain, "composited_per_frame"), at(&plain, "image_bytes_peak")],
        [&json!(0.0), &json!(0)]
    );
    let kept = play("--image-cache 64MiB --csv frames.csv");
    assert!(number(&kept, "composited_per_frame") > 1.0, "{kept}");
    assert!(number(&kept, "samples_per_frame") < 0.8 * number(&plain, "samples_per_frame"));
    let bytes = number(&kept, "image_bytes_peak");
    assert!(bytes > 0.0 && bytes < 64e6);
    let csv = std::fs::read_to_string(folder.join("frames.csv")).unwrap();
    assert!(csv.lines().next().unwrap().contains(",composited_bricks"));
    let turning = play("--image-cache 64MiB --orbit 90");
    assert_eq!(number(&turning, "composited_per_frame"), 0.0);
    done(folder, "movie run.cxl -o 'plain/{frame}.png' --size 80x60 --tf filled -q");
    done(folder, "movie run.cxl -o 'kept/{frame}.png' --size 80x60 --tf filled --image-cache 64MiB -q");
    for frame in 0..8 {
        let [a, b] = ["plain", "kept"].map(|f| picture(folder.join(format!("{f}/{frame}.png"))));
        let pairs = a.pixels.iter().flatten().zip(b.pixels.iter().flatten());
        assert!(pairs.map(|(&a, &b)| a.abs_diff(b)).max().unwrap() <= 1, "frame {frame}");
    }
}
