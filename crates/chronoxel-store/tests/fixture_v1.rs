//! The committed store of version 1 is read forever: spans, both kinds of table, masks, sharing, absent nodes.

mod common;
mod fixture;
mod known;

use std::path::{Path, PathBuf};

use chronoxel_codec::{decode_f64, decode_resident};
use chronoxel_core::{NodeFacts, NodeId, NodeStatistics, SpanKind, TimeNode};
use chronoxel_store::{Store, StoreWriter, TimeTreeEntry, Totals, verify};

use fixture::{NUM_STEPS, expected, positions, window_of};

/// Of the first stores of the version: everything has a folder.
fn committed() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/v1.cxl")
}

/// The same store, what holds nothing left out.
fn committed_sparse() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/v1_sparse.cxl")
}

/// The same with the statistics of the time tree.
fn committed_time_tree() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/v1_time_tree.cxl")
}

/// Holds every sample of every step, apron included, against its closed form.
fn check_samples(store: &Store) {
    let num_steps = store.header().num_steps();
    for step in 0..num_steps {
        for (variable, level) in [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)] {
            let spans = store.spans(variable, level, step).unwrap();
            for (span, &morton) in spans.iter().zip(store.tree().nodes(level)) {
                let node = NodeId { level, morton };
                let due = if variable == 0 { window_of(node, step, num_steps) } else { (step, 1) };
                assert_eq!((span.start, span.len), due);
                let mask = store.read_mask(variable, level, span).unwrap();
                let values: Vec<Option<f64>> = positions(node)
                    .into_iter()
                    .map(|position| expected(variable, node, position, step))
                    .collect();
                let masked = |i: usize| mask.as_ref().is_some_and(|mask| mask.get(i));
                let (samples, resident) = match span.kind {
                    SpanKind::Empty => {
                        assert!(values.iter().all(Option::is_none));
                        continue;
                    }
                    SpanKind::Constant(value) => (vec![value; values.len()], vec![value; values.len()]),
                    SpanKind::Coded { .. } => {
                        let payload = store.read_payload(variable, level, span).unwrap();
                        let at = step - span.start;
                        let brick = decode_resident(&payload, store.layout(), at, None).unwrap();
                        let resident =
                            brick.samples.iter().map(|&s| brick.offset + brick.scale * f64::from(s));
                        (decode_f64(&payload, store.layout(), at).unwrap(), resident.collect())
                    }
                };
                for (i, value) in values.iter().enumerate() {
                    assert_eq!(value.is_none(), masked(i));
                    let Some(value) = value else { continue };
                    assert_eq!(samples[i], *value, "{variable} {node:?} step {step} sample {i}");
                    assert!((resident[i] - value).abs() < 1e-3);
                }
            }
        }
    }
}

#[test]
fn the_committed_stores_are_sound_and_decode_to_their_closed_form() {
    for path in [committed(), committed_sparse(), committed_time_tree()] {
        let store = Store::open(&path).unwrap();
        let report = verify(&store, &|_, _| {});
        assert!(report.is_ok(), "{:?}", report.problems);
        check_samples(&store);
        let header = store.header();
        assert_eq!(header.variables[1].fill_value, Some(255.0));
        assert_eq!((header.times.units.as_str(), header.times.times[3]), ("days", 2.25));
        let totals = header.totals;
        assert!(totals.empty == 5 && totals.shared > 20 && totals.masks < totals.masked, "{totals:?}");
    }
}

#[test]
fn absent_siblings_have_a_parent_that_stands_in() {
    let store = Store::open(&committed()).unwrap();
    let tree = store.tree();
    for brick in [[0, 1, 0], [2, 1, 0]] {
        let node = NodeId::new(0, brick);
        assert_eq!(tree.rank(node), None);
        assert!(tree.rank(node.parent()).is_some());
    }
    assert_eq!(tree.nodes(0).len(), 4);
}

#[test]
fn the_generator_still_makes_the_same_store() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v1.cxl");
    fixture::write_store(&path, NUM_STEPS, None).unwrap();
    let [new, old] = [Store::open(&path).unwrap(), Store::open(&committed()).unwrap()];
    check_samples(&new);
    // Another version of zstd may give other bytes; everything else must be the same.
    let [mut new_header, mut old_header] = [new.header().clone(), old.header().clone()];
    assert!(new_header.sparse && !old_header.sparse);
    for header in [&mut new_header, &mut old_header] {
        header.sparse = true;
        header.totals = Totals { payload_bytes: 0, mask_bytes: 0, data_bytes: 0, ..header.totals };
    }
    assert_eq!(new_header, old_header);
    let names = |path: &Path| common::tree_of(path).into_iter().map(|(name, _)| name).collect::<Vec<_>>();
    assert_eq!(names(&path), names(&committed_sparse()));
    assert!(names(&path).iter().all(|name| names(&committed()).contains(name)));
    for step in 0..NUM_STEPS {
        // Debug text, since absent statistics are NaN.
        let spans = |store: &Store| format!("{:?}", store.spans(1, 0, step).unwrap());
        assert_eq!(spans(&new), spans(&old));
    }
    let path = folder.path().join("v1_time_tree.cxl");
    fixture::write_store(&path, NUM_STEPS, Some(TimeTreeEntry { stride: 1 })).unwrap();
    assert_eq!(names(&path), names(&committed_time_tree()));
    let [new, old] = [Store::open(&path).unwrap(), Store::open(&committed_time_tree()).unwrap()];
    for step in 0..NUM_STEPS {
        for at in TimeNode::closed_by(step, NUM_STEPS) {
            let rows = |store: &Store| format!("{:?}", [0, 1].map(|v| store.statistics(v, at).unwrap()));
            assert_eq!(rows(&new), rows(&old));
        }
    }
}

#[test]
fn the_statistics_of_the_committed_store_are_those_of_its_closed_form() {
    let store = Store::open(&committed_time_tree()).unwrap();
    assert!(store.has_time_tree() && !Store::open(&committed_sparse()).unwrap().has_time_tree());
    let of = |variable, at, level, brick| {
        let index = store.node_index(NodeId::new(level, brick)).unwrap();
        store.statistics(variable, at).unwrap()[index]
    };
    let facts = |node: NodeStatistics| {
        let NodeFacts { is_uniform, is_static, is_masked, mask_changes } = node.facts;
        [is_uniform, is_static, is_masked, mask_changes]
    };
    let root = TimeNode::root(NUM_STEPS);
    // 280 + 0.5 (x + 2 y + 3 z) + 0.125 ((x + step) mod 8): over eight steps each sample has mean m + 0.4375 and the
    // deviation of eight equidistant numbers, sqrt(63 / 12) · 0.125. The mean of x + 2 y + 3 z is 21.
    let node = of(0, TimeNode { level: 3, index: 0 }, 0, [0, 0, 0]);
    assert_eq!((node.min, node.max, node.mean), (280.0, 280.0 + 21.0 + 0.875, 280.0 + 10.5 + 0.4375));
    let mut error = 0.0;
    for at in 0..512 {
        let [x, y, z] = [at % 8, at / 8 % 8, at / 64];
        error += (63.0f64 / 12.0).sqrt() * 0.125 / (280.4375 + 0.5 * f64::from(x + 2 * y + 3 * z)) / 512.0;
    }
    assert!((node.temporal_error / error - 1.0).abs() < 1e-7, "{} {error}", node.temporal_error);
    assert_eq!(facts(node), [false; 4]);
    // Empty at even steps, else 42 and masked for z = 0.
    assert!(of(1, TimeNode::of_step(4), 0, [2, 0, 0]).is_empty());
    let node = of(1, root, 0, [2, 0, 0]);
    assert_eq!((node.min, node.max, node.mean, node.std), (42.0, 42.0, 42.0, 0.0));
    assert_eq!(facts(node), [false, false, true, true]);
    assert_eq!(
        node.temporal_error,
        f64::from(f32::from_bits(1)),
        "it changes, but in no sample that has data throughout"
    );
    // Constant 17; over it and over the octant of the brick that is absent, with 3 x + 5 y + 7 z at every other voxel.
    let node = of(1, root, 0, [1, 1, 0]);
    assert_eq!((facts(node), node.mean, node.std), ([true, true, false, false], 17.0, 0.0));
    let absent = (3 * 6 + 5 * 14 + 7 * 6) as f64;
    assert_eq!(of(1, root, 1, [0, 0, 0]).max, absent.max((3 * 7 + 5 * 7 + 7 * 7 + 1) as f64));
    assert_eq!(facts(of(1, root, 2, [0, 0, 0])), [false, false, true, true]);
}

#[test]
fn windows_out_of_phase_resume_to_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let description = fixture::description(150, None);
    let whole = folder.path().join("whole.cxl");
    fixture::write_store(&whole, 150, None).unwrap();
    let expected = common::tree_of(&whole);
    let [path, copy] = ["a.cxl", "copy.cxl"].map(|name| folder.path().join(name));
    let mut writer = StoreWriter::create(&path, &description, false).unwrap();
    let (mut moment, mut finished) = (0, Vec::new());
    fixture::write_from(&mut writer, &description, 0, || {
        moment += 1;
        if moment % 131 != 0 {
            return;
        }
        common::copy_folder(&path, &copy);
        let store = Store::open(&copy).unwrap();
        let report = verify(&store, &|_, _| {});
        assert!(report.is_ok(), "{:?}", report.problems);
        finished.push(store.header().num_steps_finished);
        let (mut resumed, next) = StoreWriter::resume(&copy, &description).unwrap();
        fixture::write_from(&mut resumed, &description, next, || {}).unwrap();
        resumed.finish().unwrap();
        assert!(common::tree_of(&copy) == expected, "moment {moment}");
        std::fs::remove_dir_all(&copy).unwrap();
    })
    .unwrap();
    writer.finish().unwrap();
    assert!(common::tree_of(&path) == expected);
    // Shards of 16 rows of 4 steps: with phases up to 3, what is closed ends a few steps before a commit.
    finished.dedup();
    assert_eq!(finished.len(), 3, "{finished:?}");
    check_samples(&Store::open(&path).unwrap());
}
