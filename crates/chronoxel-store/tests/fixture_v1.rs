//! The committed store of version 1 is read forever: spans, both kinds of table, masks, sharing, absent nodes.

mod common;
mod fixture;

use std::path::{Path, PathBuf};

use chronoxel_codec::{decode_f64, decode_resident};
use chronoxel_core::{NodeId, SpanKind};
use chronoxel_store::{Store, StoreWriter, Totals, verify};

use fixture::{NUM_STEPS, expected, positions, window_of};

/// Of the first stores of the version: everything has a folder.
fn committed() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/v1.cxl")
}

/// The same store, what holds nothing left out.
fn committed_sparse() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/v1_sparse.cxl")
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
    for path in [committed(), committed_sparse()] {
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
    fixture::write_store(&path, NUM_STEPS).unwrap();
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
}

#[test]
fn windows_out_of_phase_resume_to_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let description = fixture::description(150);
    let whole = folder.path().join("whole.cxl");
    fixture::write_store(&whole, 150).unwrap();
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
