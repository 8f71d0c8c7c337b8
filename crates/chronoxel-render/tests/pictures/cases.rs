//! The list of scenes over which every way of drawing must give the same picture.

use std::sync::Arc;

use chronoxel_codec::{Indices, Payload, Stage, Table, decode_f64, decode_resident, quantize_affine};
use chronoxel_core::{
    BitMask, BrickLayout, Camera, Lighting, NodeId, Projection, ResidentBrick, UniformGrid,
};
use chronoxel_render::{
    CodedBrick, DrawBrick, DrawHow, GpuBrick, GpuHow, GpuStats, LaterStep, PreparedBrick, Scene, render,
};

use super::{Field, Quantise, in_order, region_of, scene_of, waves};

/// A scene, and what is drawn in it, front to back.
pub struct Case {
    pub name: String,
    pub scene: Scene,
    pub bricks: Vec<GpuBrick>,
}

/// How samples of a brick are coded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Coding {
    /// 16-bit indices that are the samples.
    Affine,
    /// A table with a row per step, of which the last has the samples' high bytes.
    Listed,
    /// That, and the low bytes as a second stage: the last row gives the samples.
    TwoStages,
}

/// Steps of the spans of listed tables.
pub const NUM_STEPS: u32 = 4;

/// A payload whose last step has the samples of a brick; earlier ones have less of them.
pub fn payload_of(brick: &ResidentBrick, coding: Coding) -> Payload {
    let ResidentBrick { samples, offset, scale, .. } = brick;
    let (offset, scale) = (*offset, *scale);
    if coding == Coding::Affine {
        let table = Table::Affine { offset, scale };
        return Payload { stages: vec![Stage { indices: Indices::U16(samples.clone()), table, shift: 0 }] };
    }
    let num_rows = NUM_STEPS as usize;
    let entry = |at: usize| ((at % 256) * 256 * (at / 256 + 1) / num_rows) as u16;
    let entries = (0..256 * num_rows).map(entry).collect();
    let high = Stage {
        indices: Indices::U8(samples.iter().map(|s| (s >> 8) as u8).collect()),
        table: Table::Listed { offset, scale, num_rows, entries },
        shift: 0,
    };
    let low = Stage {
        indices: Indices::U8(samples.iter().map(|s| *s as u8).collect()),
        table: Table::Affine { offset: 0.0, scale },
        shift: 0,
    };
    let stages = if coding == Coding::Listed { vec![high] } else { vec![high, low] };
    Payload { stages }
}

/// A key for a node: different for every node of a field.
pub fn key_of(node: NodeId) -> u64 {
    node.morton | u64::from(node.level) << 40
}

impl Field {
    /// A node's box and its samples, coded.
    pub fn coded(&self, scene: &Scene, node: NodeId, region: [[f64; 3]; 2], coding: Coding) -> GpuBrick {
        let brick = self.brick(node, &scene.layout, Quantise::PerBrick);
        let payload = Arc::new(payload_of(&brick, coding));
        let step_in_span = if coding == Coding::Affine { 0 } else { NUM_STEPS - 1 };
        let mask = brick.mask.map(Arc::new);
        let coded = CodedBrick { key: key_of(node), payload, step_in_span, mask, later: None };
        GpuBrick { node, region, how: GpuHow::Coded(coded) }
    }

    /// All bricks of a level, coded, in the order of a scene's camera.
    pub fn coded_list(&self, scene: &Scene, level: u8, coding: Coding) -> Vec<GpuBrick> {
        let nodes = self.nodes(scene, level);
        let bricks =
            nodes.into_iter().map(|node| self.coded(scene, node, region_of(node, &scene.layout), coding));
        gpu_order(scene, bricks.collect())
    }
}

/// A draw list front to back.
pub fn gpu_order(scene: &Scene, list: Vec<GpuBrick>) -> Vec<GpuBrick> {
    in_order(scene, list, |brick| brick.region)
}

/// The list as the CPU draws it.
pub fn cpu_list(case: &Case) -> Vec<DrawBrick> {
    let layout = &case.scene.layout;
    let bricks = case.bricks.iter().map(|brick| {
        let how = match &brick.how {
            GpuHow::Skip => DrawHow::Skip,
            GpuHow::Constant(value) => DrawHow::Constant(*value),
            GpuHow::ConstantColor(color, opacity) => DrawHow::ConstantColor(*color, *opacity),
            GpuHow::Coded(coded) => {
                let mask = coded.mask.as_deref().cloned();
                let resident = match &coded.later {
                    None => decode_resident(&coded.payload, layout, coded.step_in_span, mask).unwrap(),
                    Some(later) => between(coded, later, layout, mask),
                };
                DrawHow::Samples(Arc::new(PreparedBrick::new(resident, layout).unwrap()))
            }
        };
        DrawBrick { node: brick.node, region: brick.region, how }
    });
    bricks.collect()
}

/// A brick between two steps, by definition: samples interpolated in double precision, quantised once.
fn between(
    coded: &CodedBrick,
    later: &LaterStep,
    layout: &BrickLayout,
    mask: Option<BitMask>,
) -> ResidentBrick {
    let mut samples = decode_f64(&coded.payload, layout, coded.step_in_span).unwrap();
    let of_later = decode_f64(&later.payload, layout, later.step_in_span).unwrap();
    samples.iter_mut().zip(of_later).for_each(|(a, b)| *a += later.weight * (b - *a));
    let stage = quantize_affine(&samples, false, 16).unwrap();
    let (Indices::U16(samples), Table::Affine { offset, scale }) = (stage.indices, stage.table) else {
        panic!("16 bits were asked for");
    };
    ResidentBrick { samples, offset, scale, mask }
}

/// The picture that the CPU makes of a case.
pub fn cpu_picture(case: &Case) -> chronoxel_core::Image {
    render(&case.scene, &cpu_list(case)).unwrap().0
}

/// Checks that a list went through the renderer whole.
#[track_caller]
pub fn assert_all_drawn(case: &Case, stats: &GpuStats) {
    let sum = stats.bricks_drawn + stats.bricks_constant + stats.bricks_skipped;
    assert_eq!(sum, case.bricks.len(), "{}: {stats:?}", case.name);
}

fn grid() -> UniformGrid {
    UniformGrid::new([41, 33, 50], [-3.0, 10.0, 0.5], [1.0; 3]).unwrap()
}

/// The whole list.
pub fn cases() -> Vec<Case> {
    let mut cases = functions();
    cases.extend([anisotropic(), inside(), far_away(), masked(), coefficients(), offset_values()]);
    cases.extend([mixed_levels(false), mixed_levels(true), absent_children(), constants()]);
    cases.extend([8, 32].map(edge));
    cases.extend([Coding::Listed, Coding::TwoStages].map(coding));
    // Payloads of different fields have different keys.
    for (number, case) in (0..).zip(&mut cases) {
        for brick in &mut case.bricks {
            if let GpuHow::Coded(coded) = &mut brick.how {
                coded.key |= number << 48;
            }
        }
    }
    cases
}

/// Each built-in function, unlit and lit, in perspective and orthographic.
fn functions() -> Vec<Case> {
    let field = waves(grid());
    let mut cases = Vec::new();
    for function in ["ramp", "sparse", "filled"] {
        for (lit, fov) in [(false, Some(35.0)), (false, None), (true, Some(35.0)), (true, None)] {
            let camera = Camera::orbit(field.grid.bounds(), 37.0, 22.0, 1.1, fov, 1.2).unwrap();
            let scene = Scene { camera, ..scene_of(&field, 16, function, lit) };
            let bricks = field.coded_list(&scene, 0, Coding::Affine);
            cases.push(Case { name: format!("{function} lit {lit} fov {fov:?}"), scene, bricks });
        }
    }
    cases
}

fn edge(edge: usize) -> Case {
    let field = waves(grid());
    let scene = scene_of(&field, edge, "ramp", true);
    let bricks = field.coded_list(&scene, 0, Coding::Affine);
    Case { name: format!("edge {edge}"), scene, bricks }
}

fn coding(coding: Coding) -> Case {
    let field = waves(grid());
    let scene = scene_of(&field, 16, "filled", true);
    let bricks = field.coded_list(&scene, 0, coding);
    Case { name: format!("coding {coding:?}"), scene, bricks }
}

fn anisotropic() -> Case {
    let field = waves(UniformGrid::new([30, 40, 25], [0.0; 3], [0.5, 0.25, 2.0]).unwrap());
    let scene = Scene { step_voxels: 0.7, ..scene_of(&field, 16, "sparse", true) };
    let bricks = field.coded_list(&scene, 0, Coding::Affine);
    Case { name: "anisotropic".into(), scene, bricks }
}

fn inside() -> Case {
    let field = waves(grid());
    let eye = field.grid.world_from_voxel([17.3, 12.1, 30.2]);
    let target = field.grid.world_from_voxel([5.0, 20.0, 3.0]);
    let camera =
        Camera::new(eye, target, [0.0, 1.0, 0.0], Projection::Perspective { fov_y_deg: 90.0 }).unwrap();
    let scene = Scene { camera, ..scene_of(&field, 16, "sparse", true) };
    let bricks = field.coded_list(&scene, 0, Coding::Affine);
    Case { name: "inside".into(), scene, bricks }
}

/// Through a telescope, far from the origin.
fn far_away() -> Case {
    let grid = UniformGrid::new([41, 33, 50], [1e5, -3e5, 2e4], [1.0; 3]).unwrap();
    let field = waves(grid);
    let camera = Camera::orbit(grid.bounds(), 200.0, -30.0, 1.0, Some(0.02), 1.2).unwrap();
    let scene = Scene { camera, ..scene_of(&field, 16, "sparse", false) };
    let bricks = field.coded_list(&scene, 0, Coding::Affine);
    Case { name: "far away".into(), scene, bricks }
}

fn masked() -> Case {
    let mut field = waves(grid());
    let ball = Field::new(grid(), |[x, y, z]| (x - 20.0).hypot(y - 15.0).hypot(z - 30.0));
    field.mask = Some(ball.samples.iter().map(|r| *r < 11.0).collect());
    let scene = scene_of(&field, 16, "filled", true);
    let bricks = field.coded_list(&scene, 0, Coding::Affine);
    Case { name: "masked".into(), scene, bricks }
}

fn coefficients() -> Case {
    let field = waves(grid());
    let lighting = Lighting { ambient: 0.3, diffuse: 0.4, specular: 0.9, specular_power: 37 };
    let scene = Scene {
        lighting: Some(lighting),
        step_voxels: 1.3,
        opacity_unit: 2.5,
        ..scene_of(&field, 16, "filled", true)
    };
    let bricks = field.coded_list(&scene, 0, Coding::Affine);
    Case { name: "coefficients".into(), scene, bricks }
}

/// Values whose range is small against them.
fn offset_values() -> Case {
    let mut field = waves(grid());
    field.samples.iter_mut().for_each(|s| *s = 101_325.0 + *s * 1e-4);
    let scene = scene_of(&field, 16, "sparse", true);
    let bricks = field.coded_list(&scene, 0, Coding::Affine);
    Case { name: "offset values".into(), scene, bricks }
}

/// Octants of the tree at levels 0, 1 and 2, in turn.
fn mixed_levels(lit: bool) -> Case {
    let field = waves(UniformGrid::new([64, 60, 50], [0.0; 3], [1.0; 3]).unwrap());
    let scene = Scene { opacity_unit: 3.0, ..scene_of(&field, 8, "filled", lit) };
    let mut bricks = Vec::new();
    for octant in 0..8 {
        let top = NodeId::new(3, [0; 3]).child(octant).unwrap();
        let mut nodes = vec![top];
        for _ in 0..octant % 3 {
            nodes = nodes.iter().flat_map(|node| (0..8).filter_map(|o| node.child(o))).collect();
        }
        let coded = |node| field.coded(&scene, node, region_of(node, &scene.layout), Coding::Affine);
        bricks.extend(nodes.into_iter().map(coded));
    }
    let bricks = gpu_order(&scene, bricks);
    Case { name: format!("mixed levels lit {lit}"), scene, bricks }
}

/// Octants of a node, some drawn from the node itself.
fn absent_children() -> Case {
    let field = waves(UniformGrid::new([33; 3], [0.0; 3], [1.0; 3]).unwrap());
    let scene = Scene { step_voxels: 0.25, ..scene_of(&field, 16, "ramp", true) };
    let root = NodeId::new(1, [0; 3]);
    let bricks = (0..8).map(|octant| {
        let child = root.child(octant).unwrap();
        let node = if [1, 2, 6].contains(&octant) { root } else { child };
        field.coded(&scene, node, region_of(child, &scene.layout), Coding::Affine)
    });
    let bricks = gpu_order(&scene, bricks.collect());
    Case { name: "absent children".into(), scene, bricks }
}

/// Inner nodes in one colour, one value and nothing among bricks.
fn constants() -> Case {
    let field = waves(UniformGrid::new([45, 39, 64], [0.0; 3], [1.0, 1.5, 0.75]).unwrap());
    let scene = Scene { opacity_unit: 4.0, step_voxels: 0.7, ..scene_of(&field, 8, "filled", true) };
    let inner = [
        (NodeId::new(2, [0, 0, 1]), GpuHow::ConstantColor([0.9, 0.4, 0.1], 0.08)),
        (NodeId::new(1, [2, 1, 1]), GpuHow::Constant(36_000.0)),
        (NodeId::new(1, [1, 2, 0]), GpuHow::ConstantColor([0.1, 0.8, 0.7], 1.0)),
        (NodeId::new(1, [0, 1, 1]), GpuHow::Skip),
    ];
    let inner = inner.map(|(node, how)| GpuBrick { node, region: region_of(node, &scene.layout), how });
    let contains = |outer: [[f64; 3]; 2], place: [[f64; 3]; 2]| {
        (0..3).all(|a| outer[0][a] <= place[0][a] && place[1][a] <= outer[1][a])
    };
    let mut bricks = field.coded_list(&scene, 0, Coding::Affine);
    bricks.retain(|brick| !inner.iter().any(|inner| contains(inner.region, brick.region)));
    bricks.extend(inner);
    let bricks = gpu_order(&scene, bricks);
    Case { name: "constants".into(), scene, bricks }
}
