//! A small raw store for the tests: two variables whose samples follow a closed form.

#![allow(dead_code)] // each test binary uses its part

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::Mutex,
};

use chronoxel_codec::{Payload, PayloadClass, decoded_range, quantize_affine, stage_to_bytes};
use chronoxel_core::{
    BitMask, BrickLayout, NodeId, NodeStatistics, Octree, SampleType, SpanStatistics, TimeAxis, TimeNode,
    UniformGrid, octree::levels_of,
};
use chronoxel_store::{
    SpanContent, SpanWrite, StoreDescription, StoreError, StoreWriter, TimeTreeEntry, VariableDescription,
};

use crate::known::Known;

/// What may lie at a sample.
pub type Field = fn(variable: usize, voxel: [usize; 3], step: u32) -> f64;

pub fn description(dims: [usize; 3], num_steps: usize) -> StoreDescription {
    let grid = UniformGrid::new(dims, [1.0, 2.0, 3.0], [0.5, 0.5, 0.25]).unwrap();
    let layout = BrickLayout::new(8).unwrap();
    let variable = |name: &str, sample_type| VariableDescription {
        name: name.into(),
        units: "m/s".into(),
        sample_type,
        fill_value: None,
        windows: vec![1],
        classes: vec![PayloadClass::affine(8), PayloadClass::affine(16)],
    };
    StoreDescription {
        grid,
        times: TimeAxis::regular(num_steps, 0.1, "s").unwrap(),
        layout,
        tree: Octree::full(&levels_of(&grid, &layout)),
        variables: vec![variable("speed", SampleType::F32), variable("an odd/name", SampleType::U8)],
        zstd_level: 1,
        time_tree: None,
        mesh: None,
        encoder: serde_json::json!({ "codec": "raw", "z_crc32c": "deadbeef" }),
    }
}

/// Moving waves, with a masked corner, a constant half, and bricks that do not change in time.
pub fn field(variable: usize, [x, y, z]: [usize; 3], step: u32) -> f64 {
    if variable == 1 {
        return ((x * 7 + y * 3 + z) % 200) as f64;
    }
    match (x, step) {
        (12.., 3) => f64::NAN,
        (12.., _) => 4.5,
        (..8, _) => ((x + 2 * y + 3 * z) as f64 * 0.1 + f64::from(step) * 0.3).sin(),
        _ if x + y + z > 20 => f64::NAN,
        _ => (x * y * z) as f64,
    }
}

/// Samples of a brick, core and apron, replicated beyond the grid; NaN is masked.
pub fn samples(
    description: &StoreDescription,
    variable: usize,
    node: NodeId,
    step: u32,
    field: Field,
) -> Vec<f64> {
    let (full, layout) = (description.layout.full_edge(), description.layout);
    let dims = levels_of(&description.grid, &layout)[usize::from(node.level)].dims;
    let base = node.brick().map(|b| b as usize * layout.edge);
    let place =
        |axis: usize, i: usize| (base[axis] + i).saturating_sub(layout.low).min(dims[axis] - 1) << node.level;
    let at = |i: usize| [i % full, i / full % full, i / full / full];
    (0..full.pow(3)).map(|i| field(variable, std::array::from_fn(|a| place(a, at(i)[a])), step)).collect()
}

fn statistics(description: &StoreDescription, node: NodeId, samples: &[f64]) -> SpanStatistics {
    let (full, layout) = (description.layout.full_edge(), description.layout);
    let dims = levels_of(&description.grid, &layout)[usize::from(node.level)].dims;
    let base = node.brick().map(|b| b as usize * layout.edge);
    let in_core = |i: usize| {
        let at = [i % full, i / full % full, i / full / full];
        (0..3).all(|a| {
            let core = at[a].wrapping_sub(layout.low);
            core < layout.edge && base[a] + core < dims[a]
        })
    };
    let core: Vec<f64> = (0..samples.len()).filter(|&i| in_core(i)).map(|i| samples[i]).collect();
    let core: Vec<f64> = core.into_iter().filter(|v| !v.is_nan()).collect();
    let n = core.len() as f64;
    let mean = core.iter().sum::<f64>() / n;
    let variance = core.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
    let fold = |pick: fn(f64, f64) -> f64| core.iter().copied().reduce(pick).unwrap_or(f64::NAN);
    SpanStatistics {
        count: core.len() as u64,
        min: fold(f64::min),
        max: fold(f64::max),
        mean: mean.max(fold(f64::min)).min(fold(f64::max)),
        std: variance.sqrt(),
    }
}

/// The spans of one step of one level.
pub fn spans_of(
    description: &StoreDescription,
    variable: usize,
    level: u8,
    step: u32,
    field: Field,
) -> Vec<SpanWrite> {
    let nodes = description.tree.nodes(level).iter().enumerate();
    nodes
        .map(|(rank, &morton)| {
            let node = NodeId { level, morton };
            let source = samples(description, variable, node, step, field);
            span_of(description, variable, node, rank as u32, step, &source)
        })
        .collect()
}

fn span_of(
    description: &StoreDescription,
    variable: usize,
    node: NodeId,
    node_rank: u32,
    step: u32,
    source: &[f64],
) -> SpanWrite {
    let statistics = statistics(description, node, source);
    let masked = source.iter().any(|v| v.is_nan());
    let pad = source.iter().copied().find(|v| !v.is_nan());
    let mask = masked.then(|| BitMask::from_flags(source.iter().map(|v| v.is_nan())));
    let span = |content, mask, drawn_range| SpanWrite {
        node_rank,
        start: step,
        len: 1,
        window: 1,
        content,
        mask,
        drawn_range,
        statistics,
    };
    let Some(pad) = pad else { return span(SpanContent::Empty, None, [f64::NAN; 2]) };
    let padded: Vec<f64> = source.iter().map(|v| if v.is_nan() { pad } else { *v }).collect();
    if padded.iter().all(|&v| v == pad) {
        return span(SpanContent::Constant(pad), mask, [pad; 2]);
    }
    let class = u8::from(variable == 0);
    let stage = quantize_affine(&padded, variable == 1, 8 + 8 * class).unwrap();
    let stages = vec![stage_to_bytes(&stage, &description.layout)];
    let payload = Payload { stages: vec![stage] };
    let drawn_range = decoded_range(&payload, &description.layout, 1).unwrap();
    span(SpanContent::Coded { class, stages }, mask, drawn_range)
}

/// The same store with a time tree.
pub fn with_time_tree(description: StoreDescription) -> StoreDescription {
    StoreDescription { time_tree: Some(TimeTreeEntry { stride: 1 }), ..description }
}

/// A variable, the dimensions of a grid, a number of steps.
type Series = (usize, [usize; 3], usize);

/// What was worked out of [`field`].
static KNOWN: Mutex<BTreeMap<Series, Known>> = Mutex::new(BTreeMap::new());

/// The statistics of all nodes over a time node.
pub fn statistics_of(description: &StoreDescription, variable: usize, at: TimeNode) -> Vec<NodeStatistics> {
    let mut known = KNOWN.lock().unwrap();
    let known =
        known.entry((variable, description.grid.dims, description.times.num_steps())).or_insert_with(|| {
            Known::new(description, |node, step| samples(description, variable, node, step, field))
        });
    known.row(at).to_vec()
}

/// Puts the statistics that a step brings.
pub fn put_statistics(
    writer: &mut StoreWriter,
    description: &StoreDescription,
    step: u32,
) -> Result<(), StoreError> {
    let num_steps = description.times.num_steps() as u32;
    for at in TimeNode::closed_by(step, num_steps).filter(|_| description.time_tree.is_some()) {
        for variable in 0..description.variables.len() {
            writer.put_statistics(variable, at, &statistics_of(description, variable, at))?;
        }
    }
    Ok(())
}

/// Puts and commits steps `from..to`.
pub fn write_steps(
    writer: &mut StoreWriter,
    description: &StoreDescription,
    steps: std::ops::Range<u32>,
) -> Result<(), StoreError> {
    for step in steps {
        put_statistics(writer, description, step)?;
        for variable in 0..description.variables.len() {
            for level in 0..description.tree.num_levels() as u8 {
                writer.put(variable, level, spans_of(description, variable, level, step, field))?;
            }
        }
        writer.commit_step(step)?;
    }
    Ok(())
}

/// Writes a whole store.
pub fn write_store(path: &Path, description: &StoreDescription) {
    let mut writer = StoreWriter::create(path, description, false).unwrap();
    write_steps(&mut writer, description, 0..description.times.num_steps() as u32).unwrap();
    writer.finish().unwrap();
}

/// Every file below a folder, with its bytes.
pub fn tree_of(root: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let (mut files, mut folders) = (Vec::new(), vec![root.to_owned()]);
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => {
                    files.push((path.strip_prefix(root).unwrap().to_owned(), std::fs::read(&path).unwrap()));
                }
            }
        }
    }
    files.sort();
    files
}

/// Copies a folder with everything in it.
pub fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        match path.is_dir() {
            true => copy_folder(&path, &target),
            false => std::fs::copy(&path, &target).map(|_| ()).unwrap(),
        }
    }
}
