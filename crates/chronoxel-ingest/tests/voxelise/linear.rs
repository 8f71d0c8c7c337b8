//! Linear fields come back wherever the mesh covers a sample; what is covered is the mesh.

use chronoxel_core::SampleType;
use chronoxel_ingest::mesh::MemoryMesh;
use chronoxel_ingest::voxelise::sample_points;
use chronoxel_ingest::{MeshSeries, sources};

use crate::meshes::{bricks, core_of, linear, mixed, ring, stretched, voxelised, with_field, world_of};

fn meshes() -> [(&'static str, MemoryMesh); 3] {
    [("ring", ring()), ("stretched", stretched()), ("mixed", mixed())]
}

/// The largest error of a step against a linear field, over the samples of leaves, and how many had data.
fn largest_error(mesh: &mut dyn MeshSeries, step: usize, field: impl Fn([f64; 3]) -> f64) -> (f64, usize) {
    let voxels = voxelised(mesh, 0.0, 4);
    let (mut largest, mut count) = (0.0f64, 0);
    for (node, samples) in bricks(&voxels, mesh, step) {
        // In their aprons they have what neighbours with children are filtered to.
        let core = if voxels.tree().is_leaf(node) { core_of(&voxels, node) } else { Vec::new() };
        for i in core.into_iter().filter(|&i| !samples[i].is_nan()) {
            largest = largest.max((samples[i] - field(world_of(&voxels, node, i))).abs());
            count += 1;
        }
    }
    (largest, count)
}

#[test]
fn linear_fields_come_back_to_single_precision() {
    for (name, mesh) in meshes() {
        let mut mesh = with_field(mesh, SampleType::F32, linear);
        let (error, count) = largest_error(&mut mesh, 1, |p| linear(p, 1));
        // Of values up to about 50: half a unit in the last place at the points, and once more at the sample.
        assert!(error <= 2.0 * 32.0 * f64::from(f32::EPSILON), "{name}: {error:e}");
        assert!(count > if name == "mixed" { 50 } else { 3000 }, "{name}: {count}");
    }
}

#[test]
fn linear_fields_come_back_in_double_precision() {
    for (name, mesh) in meshes() {
        let mut mesh = with_field(mesh, SampleType::F64, linear);
        let (error, _) = largest_error(&mut mesh, 2, |p| linear(p, 2));
        assert!(error <= 1e-11, "{name}: {error:e}");
    }
}

#[test]
fn linear_fields_of_a_generated_mesh_come_back() {
    let source = ["sim:twist?dims=21x17x19&steps=4".to_owned()];
    let options = sources::SourceOptions { variables: vec!["slope".into()], ..Default::default() };
    let mut mesh = sources::open_mesh(&source, &options).unwrap();
    let slope = |[x, y, z]: [f64; 3]| 1.0 + 0.75 + x + 2.0 * y - 0.5 * z;
    let (error, count) = largest_error(mesh.as_mut(), 3, slope);
    assert!(error <= 4.0 * f64::from(f32::EPSILON) && count > 3000, "{error:e} {count}");
}

#[test]
fn parents_of_a_linear_field_are_linear_away_from_the_boundary() {
    let mut mesh = with_field(stretched(), SampleType::F64, linear);
    let voxels = voxelised(&mut mesh, 0.0, 4);
    let full = voxels.layout().full_edge();
    let mut count = 0;
    for (node, samples) in
        bricks(&voxels, &mut mesh, 0).into_iter().filter(|(n, _)| !voxels.tree().is_leaf(*n))
    {
        for i in core_of(&voxels, node) {
            let near = [1, full, full * full].into_iter().flat_map(|d| [i - d, i + d]);
            if near.chain([i]).all(|j| !samples[j].is_nan()) {
                let p = world_of(&voxels, node, i);
                // What lies within a sample of the level from the box is filtered with what lies outside.
                let h = voxels.grid().spacing[0] * f64::from(1u32 << node.level);
                if (0..3).all(|a| p[a] > h && p[a] < [3.0, 2.0, 1.0][a] - h) {
                    assert!((samples[i] - linear(p, 0)).abs() < 1e-11, "{node:?} {i}");
                    count += 1;
                }
            }
        }
    }
    assert!(count > 1000, "{count}");
}

#[test]
fn what_is_covered_is_the_mesh_within_a_layer_of_voxels() {
    for (name, mesh) in meshes() {
        let mut mesh = with_field(mesh, SampleType::F32, linear);
        let volume = mesh.for_each_tetrahedron(&mut |_| Ok(())).unwrap().volume;
        let voxels = voxelised(&mut mesh, 0.0, 4);
        let full = voxels.layout().full_edge();
        let (mut covered, mut boundary) = (0.0, 0.0);
        for (node, samples) in bricks(&voxels, &mut mesh, 0) {
            if !voxels.tree().is_leaf(node) {
                continue;
            }
            let voxel = (voxels.grid().spacing[0] * f64::from(1u32 << node.level)).powi(3);
            for i in core_of(&voxels, node) {
                let near = [1, full, full * full].into_iter().flat_map(|d| [i - d, i + d]);
                let has_data = !samples[i].is_nan();
                covered += if has_data { voxel } else { 0.0 };
                boundary +=
                    if near.into_iter().any(|j| samples[j].is_nan() == has_data) { voxel } else { 0.0 };
            }
        }
        assert!((covered - volume).abs() < boundary, "{name}: {covered} for {volume}, layer {boundary}");
        assert!((covered - volume).abs() < 0.15 * volume, "{name}: {covered} for {volume}");
    }
}

#[test]
fn points_are_sampled_as_bricks_are() {
    let mut mesh = with_field(ring(), SampleType::F32, crate::meshes::wavy);
    let voxels = voxelised(&mut mesh, 0.0, 4);
    let (mut points, mut values) = (Vec::new(), Vec::new());
    for (node, samples) in
        bricks(&voxels, &mut mesh, 2).into_iter().filter(|(n, _)| voxels.tree().is_leaf(*n))
    {
        for i in core_of(&voxels, node).into_iter().step_by(7) {
            points.push(world_of(&voxels, node, i));
            values.push(samples[i]);
        }
    }
    let found = sample_points(&mut mesh, 0, 2, &points).unwrap();
    let differing = found.iter().zip(&values).filter(|(a, b)| match (a.is_nan(), b.is_nan()) {
        (false, false) => (*a - *b).abs() > 1e-6,
        (a, b) => a != b,
    });
    // Places go through the world, whose rounding decides on the surface itself.
    assert!(differing.count() <= values.len() / 1000, "of {}", values.len());
    assert!(values.iter().filter(|v| !v.is_nan()).count() > 1000);
}
