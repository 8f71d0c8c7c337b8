//! Runs that are killed, and runs that Ctrl-C ends.
#![cfg(unix)]

use std::{
    path::Path,
    process::{Child, Command, Stdio},
    time::Duration,
};

use tempfile::tempdir;

use crate::{
    command::{Ran, at, command, done, json, run},
    files::{assert_same_folders, names_in},
};

const ENCODE: &str = "encode 'sim:vortex?dims=32&steps=16' -o run.cxl --brick 8 --threads 2 -q";

fn start(folder: &Path, line: &str) -> Child {
    command(folder, line).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

/// Waits until something is so, or the child has ended.
fn wait_until(child: &mut Child, is_so: impl Fn() -> bool) {
    while child.try_wait().unwrap().is_none() && !is_so() {
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn interrupt(child: &Child) {
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
}

/// Files below a folder that is being written.
fn num_files(folder: &Path) -> usize {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| if entry.path().is_dir() { num_files(&entry.path()) } else { 1 }).sum()
}

fn num_finished(folder: &Path) -> usize {
    let Ok(text) = std::fs::read_to_string(folder.join("run.cxl/zarr.json")) else { return 0 };
    let value: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
    value["attributes"]["chronoxel"]["num_steps_finished"].as_u64().unwrap_or(0) as usize
}

/// What must hold of a run that ended early: what is there can be read, and is completed to the same bytes.
fn check_resume(folder: &Path, whole: &Path, name: &str) {
    let info = run(folder, "info run.cxl --json");
    match info.status {
        0 => {
            let info: serde_json::Value = serde_json::from_str(&info.stdout).unwrap();
            let finished = at(&info, "num_steps_finished").as_u64().unwrap();
            let drawn = run(folder, "render run.cxl -o a.png --size 16x16 -q");
            if finished == 0 {
                assert_eq!(drawn.status, 1);
                assert!(drawn.stderr.contains("--resume"), "{name}: {drawn:#?}");
            } else {
                assert_eq!(drawn.status, 0, "{name}: {drawn:#?}");
                assert_eq!(at(&json(folder, "verify run.cxl"), "ok"), true, "{name}");
                std::fs::remove_file(folder.join("a.png")).unwrap();
            }
        }
        _ => assert!(
            info.stderr.contains("interrupted") || info.stderr.contains("No such file"),
            "{name}: {info:#?}"
        ),
    }
    done(folder, &format!("{ENCODE} --resume"));
    assert_same_folders(whole, &folder.join("run.cxl"));
    assert_eq!(names_in(folder), ["run.cxl"], "{name}");
    let again = json(folder, &format!("{ENCODE} --resume"));
    assert_eq!([at(&again, "steps_read"), at(&again, "steps_resumed")], [0, 16]);
    assert_eq!(at(&again, "bytes_per_sec"), 0.0);
    std::fs::remove_dir_all(folder.join("run.cxl")).unwrap();
}

#[test]
fn an_encode_that_is_killed_or_interrupted_is_resumed_to_the_same_bytes() {
    let (whole, folder) = (tempdir().unwrap(), tempdir().unwrap());
    done(whole.path(), ENCODE);
    let (whole, folder) = (whole.path().join("run.cxl"), folder.path());
    let mut num_cut_short = 0;
    type Moment = Box<dyn Fn() -> bool>;
    let files = |n: usize| -> Moment {
        let folder = folder.to_owned();
        Box::new(move || num_files(&folder.join("run.cxl")) >= n)
    };
    let finished = |n: usize| -> Moment {
        let folder = folder.to_owned();
        Box::new(move || num_finished(&folder) >= n)
    };
    let moments = [
        ("first file", files(1)),
        ("some files", files(12)),
        ("a step", finished(1)),
        ("seven", finished(7)),
    ];
    for (name, moment) in &moments {
        let mut child = start(folder, ENCODE);
        wait_until(&mut child, moment);
        let _ = child.kill();
        num_cut_short += usize::from(child.wait().unwrap().code().is_none());
        check_resume(folder, &whole, name);
    }
    assert!(num_cut_short >= 3, "{num_cut_short}");
    for (name, moment) in &moments[2..] {
        let mut child = start(folder, ENCODE);
        wait_until(&mut child, moment);
        interrupt(&child);
        let ran = Ran::new(name, &child.wait_with_output().unwrap());
        if ran.status != 0 {
            assert_eq!(ran.status, 130, "{ran:#?}");
            assert!(ran.stderr.contains("run.cxl") && ran.stderr.contains("--resume"), "{ran:#?}");
            assert_eq!(ran.stderr.matches('\n').count(), 1, "{ran:#?}");
        }
        check_resume(folder, &whole, name);
    }
}

#[test]
fn a_replacement_that_is_killed_leaves_nothing_once_it_is_resumed() {
    let (whole, folder) = (tempdir().unwrap(), tempdir().unwrap());
    done(whole.path(), ENCODE);
    let (whole, folder) = (whole.path().join("run.cxl"), folder.path());
    done(folder, "encode 'sim:plume?dims=8&steps=2' -o run.cxl -q");
    let mut child = start(folder, &format!("{ENCODE} --overwrite"));
    wait_until(&mut child, || names_in(folder).len() > 1 && (2..16).contains(&num_finished(folder)));
    child.kill().unwrap();
    child.wait().unwrap();
    check_resume(folder, &whole, "replacement");
}

#[test]
fn a_movie_that_is_interrupted_leaves_nothing() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    done(folder, "encode 'sim:plume?dims=16&steps=2' -o run.cxl -q");
    let mut outputs = vec!["m.gif", "m.apng", "new/folder/m.gif", "new/{frame}.png"];
    if Command::new("ffmpeg").arg("-version").output().is_ok() {
        outputs.push("m.mp4");
    }
    for output in outputs {
        let mut child = start(
            folder,
            &format!("movie run.cxl -o '{output}' --size 320x240 --frames 20000 --json --threads 1"),
        );
        wait_until(&mut child, || names_in(folder).len() > 1);
        interrupt(&child);
        let ran = Ran::new(output, &child.wait_with_output().unwrap());
        assert_eq!((ran.status, ran.stderr.as_str()), (130, "chronoxel: interrupted\n"), "{ran:#?}");
        assert_eq!(ran.stdout, "");
        assert_eq!(names_in(folder), ["run.cxl"], "{output}");
    }
}

#[test]
fn a_demo_that_is_interrupted_can_be_run_again() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    let mut child = start(folder, "demo made --size small --json");
    wait_until(&mut child, || folder.join("made/shockbubble.cxl/zarr.json").exists());
    interrupt(&child);
    let ran = Ran::new("demo", &child.wait_with_output().unwrap());
    assert_eq!(ran.status, 130, "{ran:#?}");
    assert!(ran.stderr.starts_with("chronoxel: interrupted"), "{ran:#?}");
    assert_eq!(names_in(&folder.join("made")), ["shockbubble.cxl"]);
    assert_eq!(at(&json(folder, "info made/shockbubble.cxl"), "complete"), false);
    done(folder, "demo made --size tiny -q");
    let names = names_in(&folder.join("made"));
    assert_eq!(names, ["shockbubble-colors.json", "shockbubble.cxl", "shockbubble.gif", "shockbubble.png"]);
}

#[test]
fn a_bench_that_is_interrupted_leaves_nothing() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    let has = |end: &str| {
        let entries = std::fs::read_dir(folder.join("out")).into_iter().flatten().flatten();
        entries.map(|entry| entry.path()).any(|place| place.join(end).exists())
    };
    // While a simulation is recorded, and while it is encoded.
    for moment in ["", "encoded.cxl/zarr.json"] {
        let mut child = start(folder, "bench lum2001 --out out --json");
        wait_until(&mut child, || has(moment));
        interrupt(&child);
        let ran = Ran::new(moment, &child.wait_with_output().unwrap());
        assert_eq!((ran.status, ran.stderr.as_str()), (130, "chronoxel: interrupted\n"), "{ran:#?}");
        assert_eq!(ran.stdout, "");
        assert!(names_in(&folder.join("out")).is_empty(), "{moment}");
    }
}
