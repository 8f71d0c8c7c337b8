//! Pictures from the GPU in bytes, not at all, and from lists that come in parts.

#![cfg(feature = "gpu")]

mod pictures;

use std::borrow::Cow;

use chronoxel_core::UniformGrid;
use chronoxel_render::{GpuBrick, GpuError, GpuOptions, GpuPicture, GpuRenderer, Method, ReadBack};
use pictures::cases::{Case, Coding, assert_all_drawn, cases};
use pictures::{difference, scene_of, waves};

/// A renderer, where there is an adapter.
fn renderer(method: Method, memory_bytes: u64) -> Option<GpuRenderer> {
    match GpuRenderer::new(&GpuOptions { method, memory_bytes, ..Default::default() }) {
        Ok(renderer) => Some(renderer),
        Err(e @ GpuError::NoAdapter { .. }) if std::env::var_os("CHRONOXEL_REQUIRE_GPU").is_none() => {
            println!("skipped: {e}");
            None
        }
        Err(e) => panic!("{e}"),
    }
}

fn case() -> Case {
    let field = waves(UniformGrid::new([41, 33, 50], [0.0; 3], [1.0; 3]).unwrap());
    let mut scene = scene_of(&field, 16, "filled", true);
    // Rows that are no multiple of what is copied at a time.
    scene.size = [131, 97];
    let bricks = field.coded_list(&scene, 0, Coding::Affine);
    Case { name: "filled".into(), scene, bricks }
}

#[test]
fn bytes_are_the_floats_in_8_bits() {
    for (method, mib) in
        [(Method::Raycast, 64), (Method::Raycast, 1), (Method::Slices, 64), (Method::Slices, 2)]
    {
        let Some(mut gpu) = renderer(method, mib << 20) else { return };
        let case = case();
        let (floats, stats) = gpu.draw(&case.scene, &case.bricks).unwrap();
        let expected = floats.to_bytes();
        assert!(expected.pixels.iter().any(|p| p[3] > 100));
        let (found, in_bytes) = gpu.draw_as(&case.scene, &case.bricks, ReadBack::Bytes).unwrap();
        let GpuPicture::Bytes(found) = found else { panic!("{found:?}") };
        assert_eq!([found.width, found.height], case.scene.size);
        assert_eq!(found.pixels.len(), expected.pixels.len());
        for (a, b) in found.pixels.iter().zip(&expected.pixels) {
            assert!((0..4).all(|i| a[i].abs_diff(b[i]) <= 1), "{method:?}: {a:?} {b:?}");
        }
        let (nothing, unread) = gpu.draw_as(&case.scene, &case.bricks, ReadBack::Nothing).unwrap();
        assert_eq!(nothing, GpuPicture::Nothing);
        assert_eq!(stats.bricks_drawn, unread.bricks_drawn);
        assert!(unread.gpu_bytes < in_bytes.gpu_bytes && in_bytes.gpu_bytes < stats.gpu_bytes);
        assert!(unread.render_ms > 0.0);
    }
}

#[test]
fn parts_of_a_list_give_its_picture() {
    for method in [Method::Raycast, Method::Slices] {
        let Some(mut gpu) = renderer(method, 64 << 20) else { return };
        let chosen = cases()
            .into_iter()
            .filter(|case| ["mixed levels lit true", "constants", "masked"].contains(&case.name.as_str()));
        for case in chosen {
            let (expected, _) = gpu.draw(&case.scene, &case.bricks).unwrap();
            for size in [1, 7] {
                let parts: Vec<&[GpuBrick]> = case.bricks.chunks(size).collect();
                let mut asked = Vec::new();
                let mut part = |number: usize| {
                    asked.push(number);
                    Ok::<_, GpuError>(Cow::Borrowed(parts[number]))
                };
                let drawn = gpu.draw_in_parts(&case.scene, ReadBack::Floats, parts.len(), &mut part);
                let (GpuPicture::Floats(image), stats) = drawn.unwrap() else {
                    panic!("floats were asked for")
                };
                assert_all_drawn(&case, &stats);
                let found = difference(&image, &expected);
                assert!(found.max < 2e-5, "{method:?} {} {size}: {found:?}", case.name);
                let mut order: Vec<usize> = (0..parts.len()).collect();
                if method == Method::Slices {
                    order.reverse();
                }
                assert_eq!(asked, order);
            }
        }
    }
}

#[test]
fn a_part_that_cannot_be_made_ends_the_picture() {
    let Some(mut gpu) = renderer(Method::Raycast, 64 << 20) else { return };
    let case = case();
    let mut part = |number: usize| match number {
        0 => Ok(Cow::Borrowed(&case.bricks[..3])),
        _ => Err(GpuError::NoAdapter { wanted: "a test".into(), found: "none".into() }),
    };
    let refused = gpu.draw_in_parts(&case.scene, ReadBack::Floats, 2, &mut part).unwrap_err();
    assert!(refused.to_string().contains("a test"), "{refused}");
    let (again, _) = gpu.draw(&case.scene, &case.bricks).unwrap();
    assert!(again.pixels.iter().any(|p| p[3] > 0.5));
}
