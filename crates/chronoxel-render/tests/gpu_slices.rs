//! Slices on the GPU against their definition, and against rays.

#![cfg(feature = "gpu")]

mod pictures;

use std::sync::OnceLock;

use chronoxel_codec::decode_resident;
use chronoxel_core::{
    Camera, Image, ResolvedTransfer, TransferDomain, TransferFunction, TransferPoint, UniformGrid,
    compositing::correct_opacity,
};
use chronoxel_render::slices::render_slices_reference_with;
use chronoxel_render::{DenseField, DrawHow, GpuError, GpuHow, GpuOptions, GpuRenderer, Method, Scene, Way};
use pictures::cases::{Case, Coding, assert_all_drawn, cases, cpu_list, cpu_picture, gpu_order};
use pictures::{Field, assert_similar, difference, scene_of};

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

fn is_of_one_level(case: &Case) -> bool {
    case.bricks.iter().all(|brick| brick.node.level == 0 || !matches!(brick.how, GpuHow::Coded(_)))
}

/// The field whose bricks of level 0 a case has; what lies in none is 0.
fn field_of(case: &Case) -> Field {
    let Scene { grid, layout, .. } = &case.scene;
    let mut field = Field::new(*grid, |_| 0.0);
    let mut mask = vec![false; field.samples.len()];
    let full = layout.full_edge();
    for brick in &case.bricks {
        let GpuHow::Coded(coded) = &brick.how else { continue };
        let flags = coded.mask.as_deref().cloned();
        let decoded = decode_resident(&coded.payload, layout, coded.step_in_span, flags).unwrap();
        for (i, sample) in decoded.samples.iter().enumerate() {
            let at = [i % full, i / full % full, i / (full * full)];
            let first = brick.node.brick().map(|b| b as usize * layout.edge);
            let place: [usize; 3] = std::array::from_fn(|a| (first[a] + at[a]).wrapping_sub(layout.low));
            if (0..3).all(|a| place[a] < grid.dims[a]) {
                let index = (place[2] * grid.dims[1] + place[1]) * grid.dims[0] + place[0];
                field.samples[index] = decoded.offset + decoded.scale * f64::from(*sample);
                mask[index] = decoded.mask.as_ref().is_some_and(|mask| mask.get(i));
            }
        }
    }
    field.mask = Some(mask);
    field
}

/// The picture of a case's slices, by definition.
fn defined_picture(case: &Case) -> Image {
    let field = field_of(case);
    let dense = DenseField { samples: &field.samples, mask: field.mask.as_deref() };
    let mut list = cpu_list(case);
    list.retain(|brick| !matches!(brick.how, DrawHow::Samples(_)));
    render_slices_reference_with(&case.scene, &dense, &list).unwrap()
}

/// The scenes that have a definition, as small pictures, and these.
fn defined() -> &'static [(Case, Image)] {
    static DEFINED: OnceLock<Vec<(Case, Image)>> = OnceLock::new();
    DEFINED.get_or_init(|| {
        let small = cases().into_iter().filter(is_of_one_level).map(|mut case| {
            case.scene.size = [48, 40];
            let image = defined_picture(&case);
            (case, image)
        });
        small.collect()
    })
}

/// Pixels of 1920 that may be more than 2/255 off: 0.1 %.
const MOST_FAILED: usize = 2;

/// Draws the scenes that have a definition, in 45 dB or better; returns the largest difference.
fn run_over_list(name: &str, options: &GpuOptions, most_failed: usize) -> f64 {
    let Some(mut gpu) = renderer(options) else { return 0.0 };
    let mut largest = 0.0f64;
    for (case, expected) in defined() {
        let (actual, stats) = gpu.draw(&case.scene, &case.bricks).unwrap();
        assert_all_drawn(case, &stats);
        assert!(stats.gpu_bytes_peak <= options.memory_bytes, "{stats:?}");
        let found = difference(&actual, expected);
        println!(
            "{name}, {}: {:.1} dB, {} failed, max {:.5}, {} portions, {:.1} ms",
            case.name, found.psnr_db, found.num_failed, found.max, stats.num_portions, stats.render_ms
        );
        assert_similar(&format!("{name} {}", case.name), &actual, expected, 45.0, most_failed);
        largest = largest.max(found.max);
    }
    largest
}

#[test]
fn slices_are_those_of_the_definition() {
    run_over_list("slices", &GpuOptions { memory_bytes: 64 << 20, ..Default::default() }, MOST_FAILED);
}

#[test]
fn slices_with_what_is_guaranteed() {
    let options = GpuOptions { guaranteed_only: true, memory_bytes: 64 << 20, ..Default::default() };
    // Every layer is rounded to 11 bits; the 200 of a ray add up to less than 5/255.
    let largest = run_over_list("slices guaranteed", &options, 300);
    assert!(largest < 5.0 / 255.0, "{largest}");
}

#[test]
fn slices_with_less_memory_than_the_data() {
    run_over_list(
        "slices in portions",
        &GpuOptions { memory_bytes: 3 << 20, ..Default::default() },
        MOST_FAILED,
    );
}

#[test]
fn slices_that_decode_at_each_fetch() {
    let options = GpuOptions { way: Some(Way::Fetch), memory_bytes: 64 << 20, ..Default::default() };
    run_over_list("slices fetch", &options, MOST_FAILED);
}

#[test]
fn slices_become_the_picture_of_rays_as_the_distance_shrinks() {
    let options = GpuOptions { memory_bytes: 64 << 20, ..Default::default() };
    let Some(mut gpu) = renderer(&options) else { return };
    let is_chosen = |i: usize, case: &Case| i.is_multiple_of(5) || case.name.starts_with("mixed levels");
    let chosen = cases().into_iter().enumerate().filter(|(i, case)| is_chosen(*i, case));
    for (_, mut case) in chosen {
        case.scene.size = [48, 40];
        let from = case.scene.step_voxels;
        let mut psnr_db = Vec::new();
        for divisor in [1.0, 4.0] {
            case.scene.step_voxels = from / divisor;
            let (image, _) = gpu.draw(&case.scene, &case.bricks).unwrap();
            psnr_db.push(difference(&image, &cpu_picture(&case)).psnr_db);
        }
        println!("{}: {psnr_db:.1?} dB", case.name);
        // A quarter of the distance has a quarter of the error, 12 dB, but for rounding.
        assert!(psnr_db[1] > psnr_db[0] + 8.0 && psnr_db[1] > 50.0, "{}: {psnr_db:?}", case.name);
    }
}

fn opacity_everywhere(opacity: f32) -> ResolvedTransfer {
    let points = [0.0, 1.0].map(|x| TransferPoint { x, color: [0.25, 0.5, 1.0], opacity }).to_vec();
    TransferFunction::new(points, TransferDomain::Data).unwrap().resolve([0.0, 1.0]).unwrap()
}

/// Cameras from which the volume's borders are seen at several angles, and its outer faces at none.
fn scenes_within(field: &Field, edge: usize) -> Vec<Scene> {
    let views = [(0.0, 0.0, Some(35.0)), (37.0, 22.0, Some(35.0)), (37.0, 22.0, None), (45.0, 35.264, None)];
    let scenes = views.map(|(azimuth, elevation, fov)| {
        let bounds = field.grid.bounds();
        let camera = Camera::orbit(bounds, azimuth, elevation, 1.0, fov, 1.2).unwrap();
        let transfer = opacity_everywhere(0.03);
        Scene { camera, transfer, ..scene_of(field, edge, "ramp", false) }
    });
    scenes.to_vec()
}

/// What bricks of several levels show, by definition: each has the planes of its level on the part of a ray within it.
fn levels_by_definition(case: &Case, opacity: f64) -> Vec<f64> {
    let scene = &case.scene;
    let rays = scene.camera.rays(scene.size);
    let [_, _, forward] = scene.camera.axes();
    let bounds = scene.grid.bounds();
    let boxes: Vec<_> = case
        .bricks
        .iter()
        .map(|brick| {
            let corner = |voxel| scene.grid.world_from_voxel(voxel);
            let [low, high] = brick.region.map(corner);
            let cut = [low, std::array::from_fn(|a: usize| high[a].min(bounds[1][a]))];
            (cut, scene.step_voxels * scene.grid.smallest_spacing() * f64::from(1u32 << brick.node.level))
        })
        .collect();
    let pixels = (0..scene.size[0] * scene.size[1]).map(|i| {
        let [x, y] = [i % scene.size[0], i / scene.size[0]].map(|n| n as f64 + 0.5);
        let ray = rays.ray([x, y]);
        let dot = |v: [f64; 3]| (0..3).map(|a| forward[a] * v[a]).sum::<f64>();
        let (cosine, position) = (dot(ray.direction), dot(scene.camera.position()));
        let depth = dot(ray.origin) - position;
        let mut transmittance = 1.0f64;
        for ([low, high], distance) in &boxes {
            let (mut from, mut to) = (0.0f64, f64::INFINITY);
            for a in 0..3 {
                let [p, q] = [low[a], high[a]].map(|plane| (plane - ray.origin[a]) / ray.direction[a]);
                (from, to) = (from.max(p.min(q)), to.min(p.max(q)));
            }
            // Bricks may begin beyond the grid.
            if from < to && (0..3).all(|a| low[a] < high[a]) {
                let first_at = |length: f64| ((depth + length * cosine) / distance).ceil().max(1.0);
                let sample = correct_opacity(opacity, distance / cosine, scene.opacity_unit);
                transmittance *= (1.0 - sample).powf(first_at(to) - first_at(from));
            }
        }
        1.0 - transmittance
    });
    pixels.collect()
}

#[test]
fn levels_meet_without_cracks() {
    let Some(mut gpu) = renderer(&GpuOptions { memory_bytes: 64 << 20, ..Default::default() }) else {
        return;
    };
    let mut case = cases().into_iter().find(|case| case.name == "mixed levels lit false").unwrap();
    for (azimuth, elevation, fov) in [(37.0, 22.0, Some(35.0)), (160.0, -41.0, None), (0.0, 0.0, Some(50.0))]
    {
        let bounds = case.scene.grid.bounds();
        case.scene.camera = Camera::orbit(bounds, azimuth, elevation, 1.0, fov, 1.0).unwrap();
        case.scene.size = [160, 160];
        let points = [0.0, 1e6].map(|x| TransferPoint { x, color: [1.0; 3], opacity: 0.1 }).to_vec();
        let transfer = TransferFunction::new(points, TransferDomain::Data).unwrap();
        case.scene.transfer = transfer.resolve([0.0, 1.0]).unwrap();
        case.bricks = gpu_order(&case.scene, std::mem::take(&mut case.bricks));
        let (image, _) = gpu.draw(&case.scene, &case.bricks).unwrap();
        let expected = levels_by_definition(&case, 0.1);
        let off: Vec<f64> =
            image.pixels.iter().zip(&expected).map(|(p, e)| (f64::from(p[3]) - e).abs()).collect();
        let num_off = off.iter().filter(|d| **d > 2.0 / 255.0).count();
        println!(
            "{azimuth} {elevation} {fov:?}: {num_off} off, at most {:.5}",
            off.iter().fold(0.0f64, |a, b| a.max(*b))
        );
        assert!(expected.iter().filter(|e| **e > 0.3).count() > 3000);
        // 0.1 %.
        assert!(num_off <= 25, "{num_off} of {} pixels", off.len());
    }
}

#[test]
fn bricks_have_no_seams() {
    let Some(mut gpu) = renderer(&GpuOptions { memory_bytes: 64 << 20, ..Default::default() }) else {
        return;
    };
    let field = Field::new(UniformGrid::new([33; 3], [0.0; 3], [1.0; 3]).unwrap(), |_| 0.7);
    for (i, one) in scenes_within(&field, 32).iter().enumerate() {
        let (expected, _) = gpu.draw(one, &field.coded_list(one, 0, Coding::Affine)).unwrap();
        for edge in [8, 16] {
            let scene = &scenes_within(&field, edge)[i];
            let (actual, stats) = gpu.draw(scene, &field.coded_list(scene, 0, Coding::Affine)).unwrap();
            assert!(stats.bricks_drawn >= 8);
            let found = difference(&actual, &expected);
            println!("view {i}, bricks of {edge}: {found:?}");
            // A seam would be a line of pixels.
            assert!(found.num_failed <= 8 && found.max < 0.016, "view {i}, bricks of {edge}: {found:?}");
        }
    }
}
