//! Tetrahedra drawn as they are: `render`, `movie` and `play` of stores of cells.

use std::{fs, path::Path};

use serde_json::Value;
use tempfile::tempdir;

use crate::{
    command::{at, done, json, number, refused, run},
    files::{names_in, picture, tree},
};

/// Steps of two blocks, of a bar that is twisted, with a pulse in it.
fn store_in(folder: &Path, form: &str) {
    let depth = if form == "both" { "--max-depth 5" } else { "" };
    let source = "'sim:twist?dims=11&steps=70' --variable pulse";
    done(folder, &format!("encode {source} --as {form} {depth} -o m.cxl -q"));
}

/// What pictures have in common here.
const SMALL: &str = "--backend cpu --size 90x70 --tf filled --lighting off";

fn bytes(folder: &Path, name: &str) -> Vec<u8> {
    fs::read(folder.join(name)).unwrap()
}

#[test]
fn a_store_of_both_draws_one_scene_in_two_ways() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder, "both");
    for camera in ["", "--azimuth 200 --elevation -35 --ortho", "--zoom 2 --fov 50"] {
        let render = |method: &str| {
            json(folder, &format!("render m.cxl -t 9 {SMALL} {camera} --method {method} -o {method}.png"))
        };
        let (rays, cells) = (render("raycast"), render("cells"));
        for key in ["opacity_unit", "size", "step", "time"] {
            assert_eq!(at(&rays, key), at(&cells, key), "{key}");
        }
        assert_eq!((at(&rays, "method"), at(&cells, "method")), (&"raycast".into(), &"cells".into()));
        assert_eq!((number(&cells, "cells.tetrahedra"), number(&cells, "cells.points")), (5000.0, 1331.0));
        assert_eq!((number(&cells, "cells.k"), number(&cells, "cells.lod")), (6.0, 1.0));
        assert_eq!(number(&cells, "cells.misordered"), 0.0);
        assert!(number(&cells, "cells.faces_drawn") > 5000.0 && number(&cells, "cells.fragments") > 20_000.0);
        let psnr = number(&json(folder, "compare raycast.png cells.png"), "psnr_db");
        println!("{camera}: {psnr:.1} dB");
        assert!(psnr > 38.0, "{psnr} dB");
    }
    // The default stays what it was.
    assert_eq!(at(&json(folder, &format!("render m.cxl {SMALL} -o x.png")), "method"), "raycast");
}

#[test]
fn a_store_that_has_one_thing_draws_it_and_says_so() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder, "cells");
    let report = json(folder, &format!("render m.cxl -t 3 {SMALL} -o x.png"));
    assert_eq!(at(&report, "method"), "cells");
    assert_eq!(at(&report, "method_reason"), "the store has nothing else");
    assert!(done(folder, &format!("render m.cxl {SMALL} -o x.png")).stdout.contains("as cells"));
    for method in ["raycast", "slices"] {
        refused(folder, &format!("render m.cxl -o y.png --method {method}"), &["cells alone", "--as both"]);
    }
    done(folder, "encode 'sim:plume?dims=12&steps=2' -o bricks.cxl -q");
    for verb in ["render bricks.cxl -o y.png", "movie bricks.cxl -o y.gif", "play bricks.cxl"] {
        refused(folder, &format!("{verb} --method cells"), &["bricks.cxl", "--as cells"]);
    }
}

#[test]
fn what_contradicts_a_method_is_wrong_usage() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder, "cells");
    let before = names_in(folder);
    for (line, says) in [
        ("render m.cxl -o x.png --method cells --level 1", "--level is for bricks"),
        ("render m.cxl -o x.png --level 1", "--level is for bricks"),
        ("render m.cxl -o x.png --method cells --step 0.5", "--step is for bricks"),
        ("render m.cxl -o x.png --method cells --interpolation color", "--interpolation"),
        ("render m.cxl -o x.png --method cells --metric scalar", "--metric"),
        ("render m.cxl -o x.png --method cells --spatial-tolerance 0.1", "--spatial-tolerance"),
        ("render m.cxl -o x.png --method cells --temporal-tolerance 0.1", "--temporal-tolerance"),
        ("render m.cxl -o x.png --method raycast --k 6", "--k is for cells"),
        ("render m.cxl -o x.png --method slices --lod 0.5", "--lod is for cells"),
        ("render m.cxl -o x.png --k 5", "use 2, 6 or 16"),
        ("render m.cxl -o x.png --lod 1.5", "0 to 1"),
        ("render m.cxl -o x.png --lod-steps 0:4", "--lod-steps says which faces matter"),
        ("render m.cxl -o x.png --lod-by static", "--lod-by says which faces matter"),
        ("render m.cxl -o x.png --lod 0.5 --lod-by chance", "possible values"),
        ("movie m.cxl -o x.gif --image-cache 1MiB", "--image-cache is for bricks"),
        ("play m.cxl --image-cache 1MiB", "--image-cache is for bricks"),
        ("play m.cxl --upload-limit 1MiB", "--upload-limit is for bricks"),
        ("play m.cxl --target-fps 5 --lod 0.5", "leave it out with --target-fps"),
    ] {
        let ran = run(folder, line);
        assert_eq!(ran.status, 2, "{line}: {ran:#?}");
        assert!(ran.stderr.contains(says) && ran.stdout.is_empty(), "no {says:?} in {line}: {ran:#?}");
    }
    refused(folder, "render m.cxl -o x.png -t 70", &["step 70", "0 to 69"]);
    refused(folder, "render m.cxl -o x.png --variable slope", &["no variable", "pulse"]);
    refused(folder, "render m.cxl -o x.png --lod 0.5 --lod-steps 60:80", &["--lod-steps ends at 80"]);
    refused(folder, "render m.cxl -o x.png --memory 300KB", &["5000 tetrahedra", "--memory", "raise it"]);
    assert_eq!(names_in(folder), before);
}

#[test]
fn neither_threads_nor_memory_nor_the_verb_change_a_picture() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder, "cells");
    for more in ["", "--lighting on --k 16", "--lod 0.1 --lod-steps 0:66:3", "--lod 0.1 --lod-by static"] {
        let draw = |how: &str| {
            json(
                folder,
                &format!("render m.cxl -t 65 {SMALL} {more} {how} -o x.png")
                    .replace("--lighting off --lighting on", "--lighting on"),
            );
            bytes(folder, "x.png")
        };
        let once = draw("--threads 1");
        assert!(once == draw("--threads 3") && once == draw("--memory 4MiB"), "{more}");
    }
    done(folder, &format!("movie m.cxl --steps 62:68 {SMALL} -o 'f/{{frame:02}}.png' -q"));
    for (frame, step) in (62..68).enumerate() {
        done(folder, &format!("render m.cxl -t {step} {SMALL} -o x.png -q"));
        assert_eq!(
            picture(folder.join(format!("f/{frame:02}.png"))),
            picture(folder.join("x.png")),
            "{step}"
        );
    }
}

#[test]
fn between_two_steps_values_are_interpolated() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder, "cells");
    let at_time = |time: f64, name: &str| {
        let report = json(folder, &format!("render m.cxl --time {time} --blend-steps {SMALL} -o {name}.png"));
        assert!((number(&report, "time") - time).abs() < 1e-9);
    };
    // Step 10 lies at 10/70; half-way to the next one is as far from both.
    at_time(10.0 / 70.0, "first");
    at_time(10.5 / 70.0, "middle");
    at_time(11.0 / 70.0, "last");
    done(folder, &format!("render m.cxl -t 10 {SMALL} -o step.png -q"));
    assert_eq!(bytes(folder, "first.png"), bytes(folder, "step.png"));
    let psnr = |a: &str, b: &str| number(&json(folder, &format!("compare {a}.png {b}.png")), "psnr_db");
    let whole = psnr("first", "last");
    assert!(psnr("first", "middle") > whole + 3.0 && psnr("middle", "last") > whole + 3.0);
}

#[test]
fn less_detail_costs_less_and_comes_close() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder, "cells");
    let mut faces_before = 0.0;
    let mut distance_before = f64::INFINITY;
    done(folder, &format!("render m.cxl -t 20 {SMALL} -o all.png -q"));
    for lod in [0.0, 0.1, 0.4, 1.0] {
        let report = json(folder, &format!("render m.cxl -t 20 {SMALL} --lod {lod} -o some.png"));
        let faces = number(&report, "cells.faces_chosen");
        let inner = number(&report, "cells.faces") - 1200.0;
        assert_eq!(faces, 1200.0 + (lod * inner).round(), "the boundary has 1200 faces");
        let by = at(&report, "cells.lod_by");
        assert_eq!(by, &if lod < 1.0 { Value::from("variation") } else { Value::Null });
        let distance = number(&json(folder, "compare all.png some.png"), "luv_mean");
        println!("{lod}: {faces} faces, L*u*v* {distance:.3}");
        assert!(faces > faces_before && distance <= distance_before);
        (faces_before, distance_before) = (faces, distance);
    }
    assert_eq!(distance_before, 0.0);
}

#[test]
fn playing_decodes_ahead_and_reports() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder, "cells");
    let report = json(folder, &format!("play m.cxl {SMALL} --frames 140 --csv frames.csv"));
    assert_eq!((number(&report, "frames"), at(&report, "method")), (140.0, &"cells".into()));
    assert_eq!(number(&report, "cache.hits") + number(&report, "cache.misses"), 140.0);
    assert!(number(&report, "payload_bytes_peak") <= number(&report, "payload_bytes_budget"));
    for key in ["fps.mean", "frame_ms.p50", "step_ms.p50", "cpu_ms.p50", "bytes_from_disk", "peak_rss_bytes"]
    {
        assert!(number(&report, key) >= 0.0, "{key}");
    }
    let csv = fs::read_to_string(folder.join("frames.csv")).unwrap();
    let steps: Vec<usize> =
        csv.lines().skip(1).map(|l| l.split(',').nth(1).unwrap().parse().unwrap()).collect();
    assert_eq!(steps, (0..140).map(|frame| frame % 70).collect::<Vec<_>>());
    assert!(csv.starts_with("frame,step,frame_ms,"));
    // Backwards, turning, along a path, at a speed that the machine may or may not hold.
    json(folder, &format!("play m.cxl {SMALL} --reverse --orbit 90 --frames 12"));
    let held =
        json(folder, &format!("play m.cxl {SMALL} --target-fps 40 --late drop --throttle 10MB --frames 12"));
    assert_eq!(at(&held, "cells.lod_by"), "variation");
}

#[test]
fn damage_is_an_error_that_names_the_file() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder, "cells");
    done(folder, &format!("render m.cxl -t 5 {SMALL} -o whole.png -q"));
    let whole = bytes(folder, "whole.png");
    let mut num_failed = 0;
    for (name, content) in tree(&folder.join("m.cxl")) {
        let Some(content) = content.filter(|content| content.len() > 40) else { continue };
        let path = folder.join("m.cxl").join(&name);
        for kind in ["flipped", "cut", "gone"] {
            let mut damaged = content.clone();
            match kind {
                "flipped" => damaged[content.len() / 2] ^= 0x55,
                _ => damaged.truncate(content.len() / 2),
            }
            match kind {
                "gone" => fs::remove_file(&path).unwrap(),
                _ => fs::write(&path, damaged).unwrap(),
            }
            let ran = run(folder, &format!("render m.cxl -t 5 {SMALL} -o x.png -q"));
            match ran.status {
                // Damage to what the picture does not need changes nothing.
                0 => assert_eq!(bytes(folder, "x.png"), whole, "{name:?} {kind}"),
                status => {
                    assert_eq!((status, ran.stderr.matches('\n').count()), (1, 1), "{ran:?}");
                    assert!(ran.stderr.contains("m.cxl"), "{name:?} {kind}: {ran:?}");
                    num_failed += 1;
                }
            }
            fs::write(&path, &content).unwrap();
        }
    }
    assert!(num_failed >= 12, "{num_failed}");
}

/// The program's code, the stacks of its threads, what the allocator keeps, and the picture on its way.
const BASE_BYTES: f64 = 32.0 * 1048576.0;

#[test]
fn memory_is_what_was_allowed_or_the_mesh_is_refused() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    done(folder, "encode 'sim:twist?dims=37&steps=3' --variable pulse --as cells -o m.cxl -q");
    for (lod, memory_mib) in [("", 64.0), ("--lod 0.2", 64.0), ("--lighting on", 72.0)] {
        let line = format!("play m.cxl {SMALL} {lod} --orbit 40 --frames 6 --memory {memory_mib}MiB");
        let report = json(folder, &line.replace("--lighting off --lighting on", "--lighting on"));
        let peak = number(&report, "peak_rss_bytes");
        println!("{lod} --memory {memory_mib} MiB: {:.1} MiB resident at most", peak / 1048576.0);
        assert!(peak < memory_mib * 1048576.0 + BASE_BYTES, "{peak} bytes");
    }
    refused(folder, &format!("play m.cxl {SMALL} --memory 40MiB"), &["233280 tetrahedra", "raise it"]);
}
