//! What a store takes beside its payloads, and what is read of it per step.

mod common;
mod known;

use std::{collections::BTreeMap, path::Path};

use chronoxel_codec::{Indices, PayloadClass, Stage, StageClass, Table, TableClass, stage_to_bytes};
use chronoxel_core::{
    BrickLayout, NodeId, Octree, SampleType, SpanKind, SpanStatistics, TimeAxis, TimeNode, UniformGrid,
    octree::levels_of,
};
use chronoxel_store::{
    SpanContent, SpanWrite, Store, StoreDescription, StoreWriter, TimeTreeEntry, VariableDescription, verify,
};

/// 20 classes: one to four stages of 16, 64 or 256 entries for windows of 2 to 16, and affine ones.
fn classes() -> Vec<PayloadClass> {
    let listed =
        |entries, rows| StageClass { index_bits: 8, table: TableClass::Listed { entries, rows }, shift: 0 };
    let mut classes = vec![PayloadClass::affine(8), PayloadClass::affine(16)];
    for rows in [2, 4, 8, 16] {
        for entries in [16, 64, 256] {
            classes.push(PayloadClass { stages: vec![listed(entries, rows)] });
        }
        classes.push(PayloadClass { stages: vec![listed(256, rows), listed(256, rows)] });
    }
    classes.push(PayloadClass { stages: vec![listed(256, 8); 3] });
    classes.push(PayloadClass { stages: vec![listed(256, 16); 3] });
    classes
}

fn description(edge: usize, dims: [usize; 3], num_steps: u32) -> StoreDescription {
    let grid = UniformGrid::new(dims, [0.0; 3], [1.0; 3]).unwrap();
    let layout = BrickLayout::new(edge).unwrap();
    StoreDescription {
        grid,
        times: TimeAxis::regular(num_steps as usize, 0.1, "s").unwrap(),
        layout,
        tree: Octree::full(&levels_of(&grid, &layout)),
        variables: vec![VariableDescription {
            name: "density".into(),
            units: String::new(),
            sample_type: SampleType::F32,
            fill_value: None,
            windows: vec![1, 2, 4, 8, 16],
            classes: classes(),
        }],
        zstd_level: 1,
        time_tree: None,
        mesh: None,
        encoder: serde_json::json!({ "codec": "auto", "max_error": 0.004, "window": 16, "source": "sim:plume" }),
    }
}

fn phase_of(node: NodeId, window: u32) -> u32 {
    let [x, y, z] = node.brick();
    (x + 3 * y + 5 * z) % window
}

/// Writes a series in windows of one length out of phase, with what `content` puts into them.
fn write(
    path: &Path,
    description: &StoreDescription,
    window: u32,
    content: impl Fn(NodeId, u32) -> (SpanContent, [f64; 2], SpanStatistics),
) {
    let num_steps = description.times.num_steps() as u32;
    let mut writer = StoreWriter::create(path, description, false).unwrap();
    // The windows of a node start at its phase, and the first is what precedes it.
    let statistics = description.time_tree.map(|_| {
        known::agreeing(&description.tree, num_steps, |rank, step| {
            let node = NodeId { level: 0, morton: description.tree.nodes(0)[rank] };
            let phase = phase_of(node, window);
            let start = if step < phase { 0 } else { step - (step - phase) % window };
            content(node, start).2
        })
    });
    for step in 0..num_steps {
        for (at, statistics) in TimeNode::closed_by(step, num_steps).zip(statistics.iter().cycle()) {
            let row = &statistics[usize::from(at.level)][at.index as usize];
            writer.put_statistics(0, at, row).unwrap();
        }
        for level in 0..description.tree.num_levels() as u8 {
            let nodes = description.tree.nodes(level).iter().enumerate();
            let batch = nodes.filter_map(|(rank, &morton)| {
                let node = NodeId { level, morton };
                let phase = phase_of(node, window);
                if step + 1 < num_steps && (step + 1) % window != phase % window {
                    return None;
                }
                let start = writer.covered_until(0, level, rank as u32);
                let len = step + 1 - start;
                let (content, drawn_range, statistics) = content(node, start);
                let node_rank = rank as u32;
                let span =
                    SpanWrite { node_rank, start, len, window, content, mask: None, drawn_range, statistics };
                (len > 0).then_some(span)
            });
            let batch = batch.collect();
            writer.put(0, level, batch).unwrap();
        }
        writer.commit_step(step).unwrap();
    }
    writer.finish().unwrap();
}

/// Bytes of the files of a store by what they are, and their number.
fn parts(path: &Path) -> BTreeMap<&'static str, (usize, usize)> {
    let mut parts = BTreeMap::new();
    for (name, bytes) in common::tree_of(path) {
        let name = name.to_string_lossy();
        let part = match name.as_ref() {
            "zarr.json" => "header",
            name if name.ends_with("zarr.json") => "metadata",
            name if name.starts_with("nodes") => "nodes",
            name if name.contains("/spans/") => "spans",
            name if name.contains("/time/") => "time tree",
            _ => "shards",
        };
        let (num_bytes, num_files) = parts.entry(part).or_insert((0, 0));
        *num_bytes += bytes.len();
        *num_files += 1;
    }
    parts
}

#[test]
fn a_store_of_constants_is_small() {
    let folder = tempfile::tempdir().unwrap();
    let time_tree = Some(TimeTreeEntry { stride: 1 });
    let description = StoreDescription { time_tree, ..description(32, [128; 3], 36) };
    let mut totals = Vec::new();
    for (name, amplitude) in [("constant", 0.0), ("varied", 1.0)] {
        let path = folder.path().join(name).with_extension("cxl");
        write(&path, &description, 16, |node, start| {
            // Either the same everywhere, or no two statistics alike.
            let value =
                amplitude * (f64::from(start) + node.morton as f64 * 0.37 + f64::from(node.level)).sin();
            let statistics = SpanStatistics {
                count: 1 << 15,
                min: value,
                max: value + amplitude * 1e-3,
                mean: value + amplitude * 0.41e-3,
                std: amplitude * 0.2e-3,
            };
            (SpanContent::Constant(value), [value; 2], statistics)
        });
        let store = Store::open(&path).unwrap();
        let report = verify(&store, &|_, _| {});
        assert!(report.is_ok(), "{:?}", report.problems);
        let parts = parts(&path);
        println!("{name}: {} bytes, (bytes, files): {parts:?}", store.stored_bytes().unwrap());
        totals.push((store.stored_bytes().unwrap(), parts["time tree"].0));
    }
    // The header with its 20 classes, 18 fixed folders, spans of three levels; of the time tree, 74 runs of steps of 73 nodes.
    assert!(totals[0].0 < 16_000 && totals[1].0 < 60_000, "{totals:?}");
    assert!(totals[0].1 < 2_000 && totals[1].1 < 6 * 74 * 73, "{totals:?}");
}

/// A payload of the class of 256 entries for windows of 8 that zstd makes little of.
fn noise(
    description: &StoreDescription,
    node: NodeId,
    start: u32,
) -> (SpanContent, [f64; 2], SpanStatistics) {
    let mut state = u64::from(start) << 40 | u64::from(node.level) << 32 | node.morton << 1 | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state as u8
    };
    for _ in 0..9 {
        next();
    }
    let class = StageClass { index_bits: 8, table: TableClass::Listed { entries: 256, rows: 8 }, shift: 0 };
    let number = description.variables[0].classes.iter().position(|c| c.stages == [class]).unwrap();
    let stage = Stage {
        indices: Indices::U8((0..description.layout.num_full()).map(|_| next()).collect()),
        table: Table::Listed {
            offset: 0.0,
            scale: 1.0,
            num_rows: 8,
            entries: (0..8 * 256).map(|at| (at % 256) as u16).collect(),
        },
        shift: 0,
    };
    let stage = stage.into_canonical(&description.layout).unwrap();
    let stages = vec![stage_to_bytes(&stage, &description.layout)];
    let statistics = SpanStatistics { count: 4096, min: 0.0, max: 255.0, mean: 127.0, std: 70.0 };
    (SpanContent::Coded { class: number as u8, stages }, [0.0, 255.0], statistics)
}

#[test]
fn playing_forward_reads_each_byte_once_and_as_much_at_every_step() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    // 512 bricks: every row has a shard of its own.
    let (description, num_steps) = (description(8, [64; 3], 48), 48);
    write(&path, &description, 8, |node, start| noise(&description, node, start));
    let store = Store::open(&path).unwrap();
    assert_eq!(store.header().steps_per_shard, 1);
    let mut per_step = Vec::new();
    for step in 0..num_steps {
        let before = store.bytes_read();
        for level in 0..description.tree.num_levels() as u8 {
            let spans = store.spans(0, level, step).unwrap();
            // What was read at an earlier step is still in memory.
            let new: Vec<_> = spans.into_iter().filter(|span| span.start == step).collect();
            assert!(new.iter().all(|span| matches!(span.kind, SpanKind::Coded { .. })));
            let payloads = store.read_payloads(0, level, &new);
            assert!(payloads.iter().all(|payload| payload.as_ref().is_ok_and(Option::is_some)));
        }
        per_step.push(store.bytes_read() - before);
    }
    let totals = store.header().totals;
    // Every byte of data once: payloads, masks, indexes, spans. A few small gaps between them are read twice.
    let read: u64 = per_step.iter().sum();
    assert!((totals.data_bytes..totals.data_bytes * 101 / 100).contains(&read), "{read} of {totals:?}");
    // A whole step has a payload for each node; each step brings an eighth of them, and the first the rest.
    let num_nodes: usize = store.header().levels.iter().map(|level| level.num_nodes).sum();
    let whole = totals.payload_bytes / totals.coded * num_nodes as u64;
    for (step, &bytes) in per_step.iter().enumerate().skip(1) {
        let share = bytes as f64 / (whole as f64 / 8.0);
        assert!((0.8..1.3).contains(&share), "step {step} reads {share} of an eighth of {whole} bytes");
    }
    assert!((per_step[0] as f64) < 1.1 * whole as f64);
    println!("a step of all nodes has {whole} bytes, steps read {:?}", &per_step[..12]);
}
