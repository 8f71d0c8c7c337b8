//! One list of scenes, drawn in every way: each must give the picture that the ray caster on the CPU gives.

#![cfg(feature = "gpu")]

mod pictures;

use chronoxel_core::Image;
use chronoxel_render::{CpuOptions, GpuError, GpuOptions, GpuRenderer, Way, render_with};
use pictures::assert_similar;
use pictures::cases::{Case, assert_all_drawn, cases, cpu_list, cpu_picture};

/// What every back end must reach: 45 dB, and at most 0.1 % of pixels off by more than 2/255.
const LEAST_PSNR_DB: f64 = 45.0;

/// Draws the whole list by one back end.
fn run_over(back_end: &str, mut draw: impl FnMut(&Case) -> Image) {
    for case in cases() {
        let [width, height] = case.scene.size;
        let (actual, expected) = (draw(&case), cpu_picture(&case));
        let found = pictures::difference(&actual, &expected);
        println!(
            "{back_end}, {}: {:.1} dB, {} failed, max {:.5}",
            case.name, found.psnr_db, found.num_failed, found.max
        );
        let name = format!("{back_end} {}", case.name);
        assert_similar(&name, &actual, &expected, LEAST_PSNR_DB, width * height / 1000);
    }
}

/// Draws the whole list on the GPU, where there is an adapter.
fn run_over_gpu(back_end: &str, options: &GpuOptions) {
    let mut renderer = match GpuRenderer::new(options) {
        Ok(renderer) => renderer,
        Err(e @ GpuError::NoAdapter { .. }) if std::env::var_os("CHRONOXEL_REQUIRE_GPU").is_none() => {
            println!("skipped: {e}");
            return;
        }
        Err(e) => panic!("{e}"),
    };
    run_over(back_end, |case| {
        let (image, stats) = renderer.draw(&case.scene, &case.bricks).unwrap();
        assert_all_drawn(case, &stats);
        assert!(stats.gpu_bytes_peak <= options.memory_bytes, "{stats:?}");
        image
    });
}

#[test]
fn plain_kernels() {
    let options = CpuOptions { plain: true, ..CpuOptions::default() };
    run_over("plain", |case| render_with(&case.scene, &cpu_list(case), &options).unwrap().0);
}

#[test]
fn gpu() {
    run_over_gpu("gpu", &GpuOptions { memory_bytes: 64 << 20, ..Default::default() });
}

#[test]
fn gpu_with_what_is_guaranteed() {
    let options = GpuOptions { guaranteed_only: true, memory_bytes: 64 << 20, ..Default::default() };
    run_over_gpu("guaranteed", &options);
}

#[test]
fn gpu_with_less_memory_than_the_data() {
    run_over_gpu("portions", &GpuOptions { memory_bytes: 3 << 20, ..Default::default() });
}

#[test]
fn gpu_that_decodes_at_each_fetch() {
    let options = GpuOptions { way: Some(Way::Fetch), memory_bytes: 64 << 20, ..Default::default() };
    run_over_gpu("fetch", &options);
}
