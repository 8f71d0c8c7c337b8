//! The renderer on the GPU against the ray caster on the CPU.

#![cfg(feature = "gpu")]

mod pictures;

use std::sync::Arc;

use chronoxel_codec::{Indices, Payload, Stage, Table};
use chronoxel_core::{ResidentBrick, UniformGrid};
use chronoxel_render::{CodedBrick, GpuBrick, GpuError, GpuHow, GpuOptions, GpuRenderer, Scene, render};
use pictures::{Field, Quantise, assert_similar, region_of, scene_of, waves};

/// A renderer, where there is an adapter.
fn renderer(options: &GpuOptions) -> Option<GpuRenderer> {
    match GpuRenderer::new(options) {
        Ok(renderer) => Some(renderer),
        Err(e @ GpuError::NoAdapter { .. }) if std::env::var_os("CHRONOXEL_REQUIRE_GPU").is_none() => {
            println!("skipped: {e}");
            None
        }
        Err(e) => panic!("{e}"),
    }
}

fn payload_of(brick: ResidentBrick) -> Payload {
    let table = Table::Affine { offset: brick.offset, scale: brick.scale };
    Payload { stages: vec![Stage { indices: Indices::U16(brick.samples), table, shift: 0 }] }
}

fn coded_list(field: &Field, scene: &Scene) -> Vec<GpuBrick> {
    let list = field.draw_list(scene, 0, Quantise::PerBrick);
    let coded = list.iter().map(|item| {
        let brick = field.brick(item.node, &scene.layout, Quantise::PerBrick);
        let mask = brick.mask.clone().map(Arc::new);
        let payload = Arc::new(payload_of(brick));
        let coded = CodedBrick { key: item.node.morton, payload, step_in_span: 0, mask };
        GpuBrick { node: item.node, region: region_of(item.node, &scene.layout), how: GpuHow::Coded(coded) }
    });
    coded.collect()
}

#[test]
fn a_field_of_one_level() {
    let Some(mut gpu) = renderer(&GpuOptions::default()) else { return };
    println!("{:?}", gpu.info());
    let field = waves(UniformGrid::new([41, 33, 50], [-3.0, 10.0, 0.5], [1.0; 3]).unwrap());
    for function in ["ramp", "sparse", "filled"] {
        for lit in [false, true] {
            let scene = scene_of(&field, 16, function, lit);
            let (expected, _) = render(&scene, &field.draw_list(&scene, 0, Quantise::PerBrick)).unwrap();
            let (actual, stats) = gpu.draw(&scene, &coded_list(&field, &scene)).unwrap();
            println!("{function} {lit} {:?} {stats:?}", pictures::difference(&actual, &expected));
            assert_similar(&format!("gpu {function} {lit}"), &actual, &expected, 45.0, 12);
        }
    }
}
