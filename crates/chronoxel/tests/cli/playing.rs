//! `play` of what is larger than memory: budgets, lateness, flights.

use std::{fs, path::Path};

use tempfile::tempdir;

use crate::{
    command::{at, json, number, one_object, refused, run},
    files::{noise, write_u8_steps},
    gpu::can_draw,
};

/// The program's code, the stacks of its threads, what the allocator keeps, and the picture on its way.
const BASE_BYTES: f64 = 32.0 * 1048576.0;
/// The same with a software driver of a GPU, and what it compiles.
const GPU_BASE_BYTES: f64 = 160.0 * 1048576.0;
const MIB: f64 = 1048576.0;

/// 24 steps of noise, which does not shrink: a megabyte each and more.
fn store_in(folder: &Path) -> f64 {
    let dims = [96; 3];
    write_u8_steps(&folder.join("noise.npy"), 24, dims, |step, [x, y, z]| {
        (noise((((step * 96 + z) * 96 + y) * 96 + x) as u64) >> 56) as u8
    });
    number(&json(folder, "encode noise.npy -o run.cxl --codec raw --memory 64MiB"), "stored_bytes")
}

/// The report of a run that may warn.
fn json_with_warnings(folder: &Path, line: &str) -> serde_json::Value {
    let ran = run(folder, &format!("{line} --json"));
    assert_eq!(ran.status, 0, "{ran:?}");
    one_object(&ran)
}

#[test]
fn a_store_larger_than_memory_plays_twice_round_both_ways() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    let stored = store_in(folder);
    let memory = stored / 4.5;
    for way in ["", "--reverse"] {
        let line = format!(
            "play run.cxl --backend cpu --size 48x48 --tf filled --lighting off --frames 48 --memory {memory:.0} {way}"
        );
        let report = json(folder, &line);
        assert_eq!((number(&report, "frames"), number(&report, "stand_ins")), (48.0, 0.0));
        // Both rounds come from disk, but for what the first leaves in memory.
        assert!(number(&report, "bytes_from_disk") > 1.5 * stored, "{report}");
        assert!(number(&report, "payload_bytes_peak") <= number(&report, "payload_bytes_budget"));
        let peak = number(&report, "peak_rss_bytes");
        println!("--memory {:.1} MiB: {:.1} MiB resident at most", memory / MIB, peak / MIB);
        assert!(peak < 1.1 * memory + BASE_BYTES, "{peak} bytes at {memory}");
    }
}

#[test]
fn so_it_does_on_a_gpu() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    let stored = store_in(folder);
    if !can_draw(folder) {
        return;
    }
    let (memory, gpu_memory) = (stored / 4.5, 24.0 * MIB);
    let play = |options: &str| {
        let line = format!(
            "play run.cxl --backend gpu --size 48x48 --lighting off --memory {memory:.0} --gpu-memory 24MiB {options}"
        );
        json(folder, &line)
    };
    for way in ["", "--reverse"] {
        let report = play(&format!("--frames 48 {way}"));
        assert_eq!((number(&report, "frames"), number(&report, "stand_ins")), (48.0, 0.0));
        assert!(number(&report, "gpu_bytes_peak") <= gpu_memory);
        let peak = number(&report, "peak_rss_bytes");
        println!("{:.1} MiB and 24 MiB of a GPU: {:.1} MiB resident at most", memory / MIB, peak / MIB);
        assert!(peak < 1.1 * memory + gpu_memory + GPU_BASE_BYTES, "{peak} bytes at {memory}");
    }
    // A step has more than a megabyte of payloads: what may not be sent is drawn coarser.
    let limited = play("--frames 12 --upload-limit 512KiB --csv frames.csv");
    assert!(number(&limited, "stand_ins") > 20.0, "{limited}");
    let csv = fs::read_to_string(folder.join("frames.csv")).unwrap();
    let column = csv.lines().next().unwrap().split(',').position(|name| name == "bytes_uploaded").unwrap();
    let sent: Vec<u64> =
        csv.lines().skip(1).map(|line| line.split(',').nth(column).unwrap().parse().unwrap()).collect();
    assert!(
        sent.iter().all(|bytes| *bytes <= 512 << 10) && sent.iter().any(|bytes| *bytes > 256 << 10),
        "{sent:?}"
    );
}

#[test]
fn late_data_is_told() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let play = |options: &str| {
        let line = format!(
            "play run.cxl --backend cpu --size 48x48 --lighting off --warm off --throttle 12MB --memory 64MiB {options}"
        );
        json(folder, &line)
    };
    let waits = play("--csv frames.csv");
    assert_eq!((number(&waits, "frames"), number(&waits, "dropped_steps")), (24.0, 0.0));
    // A step is more than a megabyte.
    assert!(number(&waits, "fps.mean") < 12.0 && number(&waits, "wait_ms.max") > 50.0, "{waits}");
    assert!(number(&waits, "cache.misses") > 20.0, "{waits}");
    let csv = fs::read_to_string(folder.join("frames.csv")).unwrap();
    assert!(
        csv.lines()
            .next()
            .unwrap()
            .ends_with("wait_ms,hits,misses,dropped_steps,is_late,stand_ins,nodes,pixels_per_voxel")
    );
    assert_eq!(csv.lines().count(), 25);
    let drops = play("--late drop");
    assert_eq!(number(&drops, "frames"), 24.0);
    assert!(number(&drops, "late_frames") > 2.0, "{drops}");
}

#[test]
fn a_flight_passes_its_cameras() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let camera =
        |z: f64| format!(r#"{{"position":[48,48,{z}],"look_at":[48,48,48],"up":[0,1,0],"fov_y_deg":40}}"#);
    fs::write(folder.join("path.json"), format!(r#"{{"keys":[{},{}]}}"#, camera(400.0), camera(150.0)))
        .unwrap();
    let line =
        "play run.cxl --backend cpu --size 32x32 --steps 3 --frames 9 --path path.json --csv frames.csv";
    json(folder, line);
    let csv = fs::read_to_string(folder.join("frames.csv")).unwrap();
    let pixels: Vec<f64> =
        csv.lines().skip(1).map(|line| line.rsplit(',').next().unwrap().parse().unwrap()).collect();
    assert!(pixels.is_sorted() && pixels[8] > 2.0 * pixels[0], "{pixels:?}");
    for (text, says) in [("{}", "keys"), (r#"{"keys":[{"position":[1,2]}, 3]}"#, "key frame 0")] {
        fs::write(folder.join("bad.json"), text).unwrap();
        refused(folder, "play run.cxl --path bad.json", &["bad.json", says]);
    }
    refused(folder, "play run.cxl --path absent.json", &["absent.json"]);
}

#[test]
fn what_memory_makes_coarser_is_said() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let play = |options: &str| {
        json_with_warnings(folder, &format!("play run.cxl --backend cpu --size 32x32 --frames 3 {options}"))
    };
    let warnings = |report: &serde_json::Value| at(report, "warnings").as_array().unwrap().len();
    assert_eq!(warnings(&play("--memory 64MiB")), 0);
    let tight = play("--memory 1MiB");
    assert!(at(&tight, "warnings")[0].as_str().unwrap().contains("--memory"), "{tight}");
    refused(folder, "play run.cxl --throttle 0", &["--throttle"]);
}

#[test]
fn a_target_is_met_by_coarser_bricks() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let play = |options: &str| {
        json(folder, &format!("play run.cxl --backend cpu --tf filled --memory 64MiB {options}"))
    };
    let full = play("--frames 4 --size 64x64");
    assert_eq!(number(&full, "nodes_per_frame"), 27.0);
    // No machine draws 27 bricks of noise a thousandfold in a second.
    let fast = play("--frames 12 --target-fps 240 --size 512x512");
    assert!(number(&fast, "nodes_per_frame") < 20.0, "{fast}");
    assert!(number(&fast, "mean_pixels_per_voxel") > number(&full, "mean_pixels_per_voxel"));
    assert_eq!(at(&fast, "frames"), 12);
}
