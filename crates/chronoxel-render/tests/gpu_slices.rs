//! Slices on the GPU against their definition, and against rays.

#![cfg(feature = "gpu")]

mod pictures;

use chronoxel_render::{GpuError, GpuOptions, GpuRenderer, Method};
use pictures::cases::{assert_all_drawn, cases, cpu_picture};
use pictures::difference;

/// A renderer of slices, where there is an adapter.
fn renderer(options: &GpuOptions) -> Option<GpuRenderer> {
    match GpuRenderer::new(&GpuOptions { method: Method::Slices, ..options.clone() }) {
        Ok(renderer) => Some(renderer),
        Err(e @ GpuError::NoAdapter { .. }) if std::env::var_os("CHRONOXEL_REQUIRE_GPU").is_none() => {
            println!("skipped: {e}");
            None
        }
        Err(e) => panic!("{e}"),
    }
}

#[test]
fn the_list_of_scenes_is_drawn() {
    let Some(mut gpu) = renderer(&GpuOptions { memory_bytes: 64 << 20, ..Default::default() }) else {
        return;
    };
    for case in cases() {
        let (image, stats) = gpu.draw(&case.scene, &case.bricks).unwrap();
        assert_all_drawn(&case, &stats);
        println!("{} {:?}", case.name, difference(&image, &cpu_picture(&case)));
    }
}
