//! The octree over a mesh: what it covers, how deep it goes, and what neighbours share.

use std::collections::HashMap;

use chronoxel_core::{NodeId, SampleType};
use chronoxel_ingest::MeshSeries;
use chronoxel_ingest::voxelise::{Voxels, sample_points};

use crate::meshes::{bricks, linear, mixed, ring, stretched, voxelised, wavy, with_field};

/// The leaf whose box holds a point, and the point's voxel at its level; `None` where no node of the finest level above does.
fn leaf_of(voxels: &Voxels, point: [f64; 3]) -> Option<(NodeId, [u64; 3])> {
    let (grid, layout, tree) = (voxels.grid(), voxels.layout(), voxels.tree());
    let voxel: [f64; 3] = std::array::from_fn(|a| ((point[a] - grid.origin[a]) / grid.spacing[a]).max(0.0));
    (0..tree.num_levels() as u8).find_map(|level| {
        let at: [u64; 3] = voxel.map(|v| (v / f64::from(1u32 << level)) as u64);
        let node = NodeId::new(level, at.map(|v| (v / layout.edge as u64) as u32));
        (tree.rank(node).is_some()).then_some((node, at))
    })
}

#[test]
fn every_tetrahedron_lies_in_leaves_and_every_point_has_a_voxel() {
    for (name, mesh) in [("ring", ring()), ("stretched", stretched()), ("mixed", mixed())] {
        let mut mesh = with_field(mesh, SampleType::F32, linear);
        let voxels = voxelised(&mut mesh, 0.0, 8);
        assert_eq!(voxels.report().num_cut_off, 0, "{name}");
        let points = mesh.points().unwrap();
        let mut is_used = vec![false; points.len()];
        mesh.for_each_tetrahedron(&mut |t| {
            let corners = t.map(|v| points[v as usize]);
            t.iter().for_each(|&v| is_used[v as usize] = true);
            let weights = [[1.0, 1.0, 1.0, 1.0], [7.0, 1.0, 1.0, 1.0], [1.0, 1.0, 9.0, 9.0]];
            for w in weights {
                let sum: f64 = w.iter().sum();
                let p = std::array::from_fn(|a| (0..4).map(|k| corners[k][a] * w[k] / sum).sum());
                let (leaf, _) = leaf_of(&voxels, p).unwrap();
                assert!(voxels.tree().is_leaf(leaf), "{name}: {p:?} lies in an octant without a node");
            }
            Ok(())
        })
        .unwrap();
        let mut points_of: HashMap<(NodeId, [u64; 3]), usize> = HashMap::new();
        for (i, &p) in points.iter().enumerate().filter(|(i, _)| is_used[*i]) {
            let place = leaf_of(&voxels, p).unwrap();
            if let Some(other) = points_of.insert(place, i) {
                // Rounding may move a point on the border of two voxels.
                let near = (0..3).any(|a| {
                    let v = (p[a] - voxels.grid().origin[a]) / voxels.grid().spacing[a];
                    let v = v / f64::from(1u32 << place.0.level);
                    (v - v.round()).abs() < 1e-9
                });
                assert!(near, "{name}: points {i} and {other} share a voxel of {:?}", place.0);
            }
        }
    }
}

#[test]
fn the_threshold_leaves_points_together_where_little_changes() {
    let mut mesh = with_field(ring(), SampleType::F32, |p, step| wavy(p, step).powi(3));
    let num_nodes = |threshold: f64| {
        let mut mesh = with_field(ring(), SampleType::F32, |p, step| wavy(p, step).powi(3));
        let tree = voxelised(&mut mesh, threshold, 6).tree().clone();
        (0..tree.num_levels() as u8).map(|level| tree.nodes(level).len()).sum::<usize>()
    };
    let counts = [0.0, 0.02, 0.1, 0.4, 1.0].map(num_nodes);
    assert!(counts.is_sorted_by(|a, b| a >= b) && counts[0] > counts[3] && counts[4] == 1, "{counts:?}");
    // A field that is the same everywhere needs no voxel of its own anywhere.
    assert_eq!(voxelised(&mut mesh, 1.0, 6).tree().num_levels(), 1);
    let mut still = with_field(ring(), SampleType::F32, |_, _| 4.0);
    assert_eq!(voxelised(&mut still, 0.0, 6).tree().num_levels(), 1);
    // One that changes at the last step alone does.
    let mut late = with_field(ring(), SampleType::F32, |p, step| if step == 2 { linear(p, 0) } else { 4.0 });
    assert!(voxelised(&mut late, 0.0, 6).tree().num_levels() > 2);
}

#[test]
fn the_depth_is_at_most_what_was_asked_for() {
    for depth in 0..4 {
        let mut mesh = with_field(stretched(), SampleType::F32, linear);
        let voxels = voxelised(&mut mesh, 0.0, depth);
        assert_eq!(voxels.tree().num_levels(), usize::from(depth) + 1);
        assert!(voxels.report().num_cut_off > 0);
    }
}

#[test]
fn neighbours_of_a_level_agree_on_every_sample_they_share() {
    for mesh in [ring(), stretched()] {
        let mut mesh = with_field(mesh, SampleType::F32, wavy);
        let voxels = voxelised(&mut mesh, 0.0, 4);
        let layout = *voxels.layout();
        let (edge, full, low) = (layout.edge as i64, layout.full_edge(), layout.low as i64);
        let all: HashMap<NodeId, Vec<f64>> = bricks(&voxels, &mut mesh, 1).into_iter().collect();
        let (mut num_shared, mut num_mixed) = (0, 0);
        for (node, samples) in &all {
            for (i, value) in samples.iter().enumerate() {
                let at = [i % full, i / full % full, i / full / full].map(|p| p as i64 - low);
                let first = node.brick().map(|b| i64::from(b) * edge);
                let place: [i64; 3] = std::array::from_fn(|a| first[a] + at[a]);
                if at.iter().all(|p| (0..edge).contains(p)) || place.iter().any(|p| *p < 0) {
                    continue;
                }
                let other = NodeId::new(node.level, place.map(|p| (p / edge) as u32));
                if let Some(theirs) = all.get(&other) {
                    let [x, y, z] = place.map(|p| (p % edge + low) as usize);
                    let theirs_at = theirs[x + full * (y + full * z)];
                    assert_eq!(value.to_bits(), theirs_at.to_bits(), "{node:?} and {other:?} at {place:?}");
                    num_shared += 1;
                    num_mixed += usize::from(voxels.tree().is_leaf(*node) != voxels.tree().is_leaf(other));
                }
            }
        }
        assert!(num_shared > 1000 && num_mixed > 100, "{num_shared} {num_mixed}");
    }
}

#[test]
fn filtered_nodes_take_the_borders_of_leaves_beside_them() {
    let mut mesh = with_field(stretched(), SampleType::F64, wavy);
    let voxels = voxelised(&mut mesh, 0.0, 4);
    let (tree, layout, grid) = (voxels.tree(), *voxels.layout(), *voxels.grid());
    let full = layout.full_edge();
    let (mut places, mut found, mut num_filtered) = (Vec::new(), Vec::new(), 0);
    for (node, samples) in bricks(&voxels, &mut mesh, 1).into_iter().filter(|(node, _)| !tree.is_leaf(*node))
    {
        for axis in 0..3 {
            let mut before = node.brick();
            let Some(below) = before[axis].checked_sub(1) else { continue };
            before[axis] = below;
            let before = NodeId::new(node.level, before);
            if tree.rank(before).is_none() || !tree.is_leaf(before) {
                continue;
            }
            for i in 0..layout.edge * layout.edge {
                let mut at = [i % layout.edge, i / layout.edge, 0];
                at.swap(axis, 2);
                let index = |at: [usize; 3]| {
                    let [x, y, z] = at.map(|p| p + layout.low);
                    x + full * (y + full * z)
                };
                let scale = f64::from(1u32 << node.level);
                let place = |a: usize| f64::from(node.brick()[a]) * layout.edge as f64 + at[a] as f64;
                places.push(grid.world_from_voxel([place(0), place(1), place(2)].map(|p| p * scale)));
                found.push(samples[index(at)]);
                num_filtered += 1;
            }
        }
    }
    assert!(num_filtered > 200, "{num_filtered}");
    let expected = sample_points(&mut mesh, 0, 1, &places).unwrap();
    for ((found, expected), place) in found.iter().zip(&expected).zip(&places) {
        // Places on the mesh's boundary may be rounded to its outside.
        if !expected.is_nan() && !found.is_nan() {
            assert!((found - expected).abs() < 1e-12, "{found} in place of {expected} at {place:?}");
        }
    }
    assert!(expected.iter().filter(|v| !v.is_nan()).count() > num_filtered / 2);
}
