//! Tetrahedra on the GPU, against the renderer on the CPU and the reference.

#![cfg(feature = "gpu")]

use std::sync::Arc;


use chronoxel_core::{Background, Image, Image8, compare};
use chronoxel_render::{
    CellMesh, CellOptions, CellRenderer, CellScene, CellStats, CellWay, FaceChoice, GpuCellOptions,
    GpuCellRenderer, GpuCellStats, GpuCellValues, GpuError, GpuOptions, GpuPicture, ReadBack, Variation,
    render_cells_reference,
};

mod cell_meshes;
use cell_meshes::{lattice, scene, twisted, waves};

/// A renderer, where there is an adapter.
fn renderer(mesh: &Arc<CellMesh>, gpu: &GpuOptions, options: GpuCellOptions) -> Option<GpuCellRenderer> {
    match GpuCellRenderer::new(Arc::clone(mesh), gpu, options) {
        Ok(renderer) => Some(renderer),
        Err(e @ GpuError::NoAdapter { .. }) if std::env::var_os("CHRONOXEL_REQUIRE_GPU").is_none() => {
            println!("skipped: {e}");
            None
        }
        Err(e) => panic!("{e}"),
    }
}

fn with_k(mesh: &Arc<CellMesh>, k: usize) -> Option<GpuCellRenderer> {
    renderer(mesh, &GpuOptions::default(), GpuCellOptions { k, ..Default::default() })
}

fn on_cpu(mesh: &Arc<CellMesh>, scene: &CellScene, values: &[f32], k: usize) -> (Image, CellStats) {
    let options = CellOptions { k, plain: false };
    CellRenderer::new(Arc::clone(mesh), options).unwrap().render(scene, values).unwrap()
}

fn psnr(a: &Image, b: &Image) -> f64 {
    let [a, b] = [a, b].map(|image| Image8::from_image(image, Background::default()));
    compare(&a, &b).unwrap().psnr_db
}

/// The largest difference of a channel, and how many pixels differ by more than a 16-bit level's share of it.
fn difference(a: &Image, b: &Image) -> (f32, usize) {
    let of_pixel = |(a, b): (&[f32; 4], &[f32; 4])| (0..4).map(|c| (a[c] - b[c]).abs()).fold(0.0, f32::max);
    let all: Vec<f32> = a.pixels.iter().zip(&b.pixels).map(of_pixel).collect();
    (all.iter().copied().fold(0.0, f32::max), all.iter().filter(|d| **d > 1e-4).count())
}

#[test]
fn pictures_are_those_of_the_cpu() {
    let num = [12, 10, 11];
    let mesh = Arc::new(twisted(num));
    let values = waves(num, 0.3);
    for k in [2, 6, 16] {
        let Some(mut gpu) = with_k(&mesh, k) else { return };
        for sorting in [CellWay::Cpu, CellWay::Gpu] {
            gpu.set_sorting(sorting);
            for (function, fov, lit) in [
                ("filled", Some(30.0), false),
                ("sparse", Some(30.0), false),
                ("ramp", None, false),
                ("filled", Some(60.0), true),
                ("sparse", None, true),
            ] {
                let scene = scene(&mesh, function, [96, 96], fov, lit);
                let (expected, cpu_stats) = on_cpu(&mesh, &scene, &values, k);
                let (found, stats) = gpu.render(&scene, &GpuCellValues::Decoded(&values)).unwrap();
                println!(
                    "{function} {fov:?} lit {lit} k {k} {sorting:?}: {:.1} dB, {:?}\n{stats:?}\n{cpu_stats:?}",
                    psnr(&expected, &found),
                    difference(&expected, &found)
                );
            }
        }
    }
}
