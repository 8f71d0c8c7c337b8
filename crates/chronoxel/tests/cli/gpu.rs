//! Drawing on a GPU, or a software driver of one.

use std::path::Path;

use serde_json::json;
use tempfile::tempdir;

use crate::{
    command::{at, command, done, json, number, refused, run},
    files::{picture, write_u8_steps},
};

const DIMS: [usize; 3] = [40, 24, 20];

/// A blob that stays and one that moves.
fn sample(step: usize, place: [usize; 3]) -> u8 {
    let [x, y, z] = place.map(|i| i as f64);
    let blob = |cx: f64, r: f64| (-((x - cx).powi(2) + (y - 12.0).powi(2) + (z - 9.0).powi(2)) / r).exp();
    (20.0 + 120.0 * blob(30.0, 40.0) + 100.0 * blob(4.0 + step as f64, 25.0)) as u8
}

/// A store of eight steps in windows of four; false where there is nothing to draw it on, which is said, and fails where CI must have an adapter.
fn is_ready(folder: &Path) -> bool {
    write_u8_steps(&folder.join("source.npy"), 8, DIMS, sample);
    done(folder, "encode source.npy -o run.cxl --brick 16 --codec vq --window 4 -q");
    can_draw(folder)
}

/// Whether there is anything to draw `run.cxl` on; if not, that is said, and fails where CI must have an adapter.
pub fn can_draw(folder: &Path) -> bool {
    let ran = run(folder, "render run.cxl --backend gpu --size 8x8 -o probe.png -q");
    if ran.status == 0 {
        return true;
    }
    assert!(ran.stderr.contains("no GPU adapter"), "{ran:?}");
    assert!(std::env::var("CHRONOXEL_REQUIRE_GPU").as_deref() != Ok("1"), "{ran:?}");
    eprintln!("skipped: {}", ran.stderr);
    false
}

#[test]
fn the_gpu_draws_what_the_cpu_draws() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    if !is_ready(folder) {
        return;
    }
    for options in [
        "--tf filled",
        "--tf sparse --lighting off --ortho",
        "--tf ramp --level 1",
        "--spatial-tolerance 0.1 --tf filled",
    ] {
        let draw = |backend: &str| {
            json(
                folder,
                &format!("render run.cxl -t 5 --size 80x60 {options} --backend {backend} -o {backend}.png"),
            )
        };
        let [cpu, gpu] = ["cpu", "gpu"].map(draw);
        assert_eq!([at(&cpu, "backend"), at(&gpu, "backend")], [&json!("cpu"), &json!("gpu")]);
        assert_eq!(at(&gpu, "samples_of_grid"), at(&cpu, "samples_of_grid"));
        let compared = json(folder, "compare cpu.png gpu.png");
        assert!(
            at(&compared, "psnr_db").is_null() || number(&compared, "psnr_db") >= 45.0,
            "{options}: {compared}"
        );
        let [a, b] = ["cpu", "gpu"].map(|name| picture(folder.join(format!("{name}.png"))));
        let pairs = a.pixels.iter().zip(&b.pixels);
        let off = pairs.filter(|(p, q)| (0..4).any(|i| p[i].abs_diff(q[i]) > 2)).count();
        assert!(off as f64 <= 0.001 * 4800.0, "{options}: {off} pixels");
    }
}

#[test]
fn the_gpu_draws_times_between_steps() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    if !is_ready(folder) {
        return;
    }
    // Windows of four: within one, and from each to the next.
    for time in ["1.5", "2.25", "3.5", "6.9"] {
        for backend in ["cpu", "gpu"] {
            let line = format!("render run.cxl --time {time} --blend-steps --size 80x60 --tf filled");
            done(folder, &format!("{line} --backend {backend} -o {backend}.png -q"));
        }
        let compared = json(folder, "compare cpu.png gpu.png");
        assert!(
            at(&compared, "psnr_db").is_null() || number(&compared, "psnr_db") >= 45.0,
            "{time}: {compared}"
        );
    }
}

#[test]
fn little_memory_draws_the_same_picture_on_the_gpu() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    if !is_ready(folder) {
        return;
    }
    let line = "render run.cxl -t 5 --size 80x60 --tf filled";
    done(folder, &format!("{line} --backend gpu -o much.png -q"));
    // Twelve bricks of 19^3 samples and their tables are some 100 kB.
    for memory in ["200KiB", "320KiB"] {
        done(folder, &format!("{line} --memory {memory} --backend gpu -o gpu.png -q"));
        done(folder, &format!("{line} --memory {memory} --backend cpu -o cpu.png -q"));
        let of_much = json(folder, "compare much.png gpu.png");
        assert!(at(&of_much, "psnr_db").is_null() || number(&of_much, "psnr_db") > 80.0, "{of_much}");
        let compared = json(folder, "compare cpu.png gpu.png");
        assert!(at(&compared, "psnr_db").is_null() || number(&compared, "psnr_db") >= 45.0, "{compared}");
    }
}

#[test]
fn slices_show_what_rays_show() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    if !is_ready(folder) {
        return;
    }
    done(folder, "render run.cxl -t 5 --size 80x60 --tf filled --step 0.1 --backend cpu -o rays.png -q");
    let line =
        "render run.cxl -t 5 --size 80x60 --tf filled --step 0.1 --backend gpu --method slices -o slices.png";
    assert_eq!(at(&json(folder, line), "backend"), &json!("gpu"));
    let compared = json(folder, "compare rays.png slices.png");
    assert!(number(&compared, "psnr_db") >= 40.0, "{compared}");
    refused(folder, "render run.cxl --backend cpu --method slices -o x.png", &["--backend gpu"]);
}

#[test]
fn a_new_step_within_a_window_uploads_next_to_nothing() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    if !is_ready(folder) {
        return;
    }
    let play = |steps: &str| {
        json(folder, &format!("play run.cxl --backend gpu --size 64x48 --steps {steps} --gpu-memory 64MiB"))
    };
    let report = play("0:8");
    assert!(number(&report, "gpu_bytes_peak") > 0.0 && number(&report, "gpu_bytes_peak") <= 64.0 * 1048576.0);
    // The first frame is drawn before the clock starts; the bricks' windows begin at different steps.
    let all = number(&report, "bytes_uploaded");
    let again = number(
        &json(folder, "play run.cxl --backend gpu --size 64x48 --steps 2:3 --frames 4"),
        "bytes_uploaded",
    );
    assert!(again < 0.2 * all, "{again} of {all} bytes for a step that is there");
    let text = done(folder, "play run.cxl --backend gpu --size 64x48").stdout;
    assert!(text.contains("on gpu"), "{text}");
}

#[test]
fn what_the_gpu_does_not_do_is_refused() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    if !is_ready(folder) {
        return;
    }
    refused(folder, "play run.cxl --backend gpu --image-cache 1MiB", &["--image-cache"]);
    refused(folder, "render run.cxl --backend gpu --gpu-memory 1KiB -o x.png", &["GPU memory"]);
    refused(folder, "render run.cxl --backend cpu --interpolation color -o x.png", &["--backend gpu"]);
}

#[test]
fn what_draws_is_said_with_the_reason() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    if !is_ready(folder) {
        return;
    }
    let report = json(folder, "render run.cxl --size 8x8 -o auto.png");
    let reason = at(&report, "backend_reason").as_str().unwrap();
    assert!(reason.len() > 10 && !reason.contains('\n'), "{reason}");
    let text = done(folder, "render run.cxl --size 8x8 -o auto.png -v").stdout;
    assert!(text.contains(reason), "{text}");
    // Drivers must not complain of a display that is not there.
    let output =
        command(folder, "render run.cxl --size 8x8 -o auto.png -q").env_remove("XDG_RUNTIME_DIR").output();
    assert_eq!(String::from_utf8_lossy(&output.unwrap().stderr), "");
}
