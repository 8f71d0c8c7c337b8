//! What is written is what is read: spans, payloads, masks, sharing, whatever the number of threads.

mod common;
mod known;

use chronoxel_codec::{decode_f64, decode_resident};
use chronoxel_core::{NodeId, SpanKind};
use chronoxel_store::{SpanContent, Store, StoreWriter, stored_len};

use common::{description, field, samples, write_steps, write_store};

#[test]
fn every_sample_comes_back_within_half_a_quantum() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    let description = description([20, 13, 9], 5);
    write_store(&path, &description);
    let store = Store::open(&path).unwrap();
    assert!(store.is_complete());
    assert_eq!(store.tree(), &description.tree);
    let (mut num_coded, mut num_masked) = (0, 0);
    for (variable, step, level) in
        (0..2).flat_map(|v| (0..5).flat_map(move |s| (0..3).map(move |l| (v, s, l))))
    {
        let spans = store.spans(variable, level, step).unwrap();
        assert_eq!(spans.len(), description.tree.nodes(level).len());
        for (span, &morton) in spans.iter().zip(description.tree.nodes(level)) {
            assert_eq!((span.start, span.len), (step, 1));
            let source = samples(&description, variable, NodeId { level, morton }, step, field);
            let mask = store.read_mask(variable, level, span).unwrap();
            num_masked += u32::from(mask.is_some());
            let masked = |i: usize| mask.as_ref().is_some_and(|mask| mask.get(i));
            let decoded = match span.kind {
                SpanKind::Empty => vec![f64::NAN; source.len()],
                SpanKind::Constant(value) => vec![value; source.len()],
                SpanKind::Coded { class, .. } => {
                    num_coded += 1;
                    assert_eq!(class, u8::from(variable == 0));
                    let payload = store.read_payload(variable, level, span).unwrap();
                    let brick = decode_resident(&payload, store.layout(), 0, None).unwrap();
                    let decoded = decode_f64(&payload, store.layout(), 0).unwrap();
                    let resident = brick.samples.iter().map(|&s| brick.offset + brick.scale * f64::from(s));
                    assert!(resident.eq(decoded.iter().copied()));
                    decoded
                }
            };
            // 16 bits over at most [0, 20 * 13 * 9]; whole numbers are exact.
            let bound = if variable == 0 { 2340.0 / 65535.0 / 2.0 + 1e-9 } else { 0.0 };
            for i in 0..source.len() {
                match source[i].is_nan() {
                    true => assert!(span.kind == SpanKind::Empty || masked(i)),
                    false => assert!((decoded[i] - source[i]).abs() <= bound && !masked(i)),
                }
            }
        }
    }
    assert!(num_coded > 50 && num_masked > 5, "{num_coded} coded, {num_masked} masked");
}

#[test]
fn equal_payloads_are_stored_once() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write_store(&path, &description([20, 13, 9], 5));
    let store = Store::open(&path).unwrap();
    // The second variable does not change: every later step is that of step 0.
    let first = store.spans(1, 0, 0).unwrap();
    for (span, first) in store.spans(1, 0, 4).unwrap().iter().zip(&first) {
        assert_eq!(span.kind, first.kind);
    }
    let totals = store.header().totals;
    let num_spans = totals.empty + totals.constant + totals.coded + totals.shared;
    let num_nodes: usize = store.header().levels.iter().map(|l| l.num_nodes).sum();
    assert_eq!(num_spans as usize, 2 * 5 * num_nodes);
    assert!(totals.shared as usize >= 4 * num_nodes && totals.masks < totals.masked, "{totals:?}");
    assert_eq!(store.header().variables[1].folder, "variable-1");
    assert_eq!((store.header().variables[1].min, store.header().variables[1].max), (Some(0.0), Some(177.0)));
}

#[test]
fn stored_lengths_are_known_before_writing() {
    let folder = tempfile::tempdir().unwrap();
    let mut sizes = Vec::new();
    for zstd_level in [1, 19, -3] {
        let path = folder.path().join(format!("{zstd_level}.cxl"));
        let mut description = description([8, 8, 8], 6);
        description.zstd_level = zstd_level;
        let mut spans = Vec::new();
        for step in 0..6 {
            spans.extend(common::spans_of(&description, 0, 0, step, field));
        }
        let stages = spans.iter().filter_map(|span| match &span.content {
            SpanContent::Coded { stages, .. } => Some(stages),
            _ => None,
        });
        let stages: Vec<&Vec<u8>> = stages.flatten().collect();
        assert_eq!(stages.len(), 6);
        // From many threads at once, and levels taking turns on each.
        let lens = std::thread::scope(|scope| {
            let threads = [0, 1].map(|_| {
                scope.spawn(|| {
                    let lens = |level| stages.iter().map(|s| stored_len(s, level)).sum::<usize>();
                    assert_ne!(lens(5), 0);
                    lens(zstd_level)
                })
            });
            threads.map(|thread| thread.join().unwrap())
        });
        assert_eq!(lens[0], lens[1]);
        let mut writer = StoreWriter::create(&path, &description, false).unwrap();
        writer.put(0, 0, spans).unwrap();
        assert_eq!(writer.header().totals.payload_bytes, lens[0] as u64);
        assert_eq!(writer.header().zstd_level, zstd_level);
        sizes.push(lens[0]);
    }
    assert!(sizes[1] < sizes[0] && sizes[0] <= sizes[2], "{sizes:?}");
}

#[test]
fn many_payloads_at_once_are_those_read_one_by_one() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write_store(&path, &description([20, 13, 9], 3));
    let store = Store::open(&path).unwrap();
    let spans: Vec<_> = (0..3).flat_map(|step| store.spans(0, 0, step).unwrap()).collect();
    let all = store.read_payloads(0, 0, &spans);
    for (span, payload) in spans.iter().zip(all) {
        match span.kind {
            SpanKind::Coded { .. } => {
                assert_eq!(payload.unwrap().unwrap(), store.read_payload(0, 0, span).unwrap());
            }
            _ => assert!(payload.unwrap().is_none() && store.read_payload(0, 0, span).is_err()),
        }
    }
}

#[test]
fn the_bytes_do_not_depend_on_the_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let trees = [1, 3].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let path = folder.path().join(format!("{threads}.cxl"));
        pool.install(|| write_store(&path, &description([20, 13, 9], 4)));
        common::tree_of(&path)
    });
    assert!(trees[0].len() > 30);
    assert_eq!(trees[0], trees[1]);
}

#[test]
fn what_is_in_the_way_stays() {
    let folder = tempfile::tempdir().unwrap();
    let description = description([9, 9, 9], 1);
    let path = folder.path().join("a.cxl");
    std::fs::create_dir(&path).unwrap();
    std::fs::write(path.join("thesis.txt"), "years of work").unwrap();
    let error = StoreWriter::create(&path, &description, true).unwrap_err().to_string();
    assert!(error.contains("a.cxl") && error.contains("not a store"), "{error}");
    assert!(path.join("thesis.txt").exists());
    std::fs::remove_file(path.join("thesis.txt")).unwrap();
    write_store(&path, &description);
    assert!(StoreWriter::create(&path, &description, false).is_err());
    let mut writer = StoreWriter::create(&path, &description, true).unwrap();
    write_steps(&mut writer, &description, 0..1).unwrap();
    writer.finish().unwrap();
    assert!(Store::open(&path).unwrap().is_complete());
}

#[test]
fn spans_that_do_not_fit_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let description = description([9, 9, 9], 3);
    let mut case = 0;
    let mut refused = |change: fn(&mut chronoxel_store::SpanWrite), message: &str| {
        case += 1;
        let path = folder.path().join(format!("{case}.cxl"));
        let mut writer = StoreWriter::create(&path, &description, false).unwrap();
        let mut batch = common::spans_of(&description, 1, 0, 0, field);
        change(&mut batch[1]);
        let error = writer.put(1, 0, batch.clone()).unwrap_err().to_string();
        assert!(error.contains(message) && error.contains("node"), "{error}");
        assert!(writer.put(1, 0, batch).unwrap_err().to_string().contains("abandon"));
        assert_eq!(writer.abandon().unwrap(), None);
        assert!(!path.exists());
    };
    refused(|span| span.start = 1, "without gaps");
    refused(|span| span.len = 2, "no longer than their window");
    refused(|span| span.window = 4, "not one of the variable's");
    refused(|span| span.node_rank = 99, "fewer nodes");
    refused(|span| span.drawn_range = [1.0, 0.0], "drawn range");
    refused(|span| span.content = chronoxel_store::SpanContent::Constant(f64::NAN), "NaN");
}

#[test]
fn the_header_keeps_every_bit_of_its_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let fills =
        [None, Some(f64::NAN), Some(f64::INFINITY), Some(f64::NEG_INFINITY), Some(-9.969_209_968_386_869e36)];
    for (case, fill) in fills.into_iter().enumerate() {
        let mut description = description([9, 9, 9], 40);
        description.grid.origin = [0.1 + 0.2, -1e-300, 1.0 / 3.0];
        description.times.times = (0..40).map(|s| (f64::from(s) / 7.0).exp() * 1e-5).collect();
        description.times.units = "days since \"2000\" \u{b5}".into();
        description.variables[0].fill_value = fill;
        let path = folder.path().join(format!("{case}.cxl"));
        drop(StoreWriter::create(&path, &description, false).unwrap());
        let store = Store::open(&path).unwrap();
        let header = store.header();
        assert_eq!(header.grid, description.grid);
        assert_eq!(header.times, description.times);
        assert_eq!(header.variables[0].fill_value.map(f64::to_bits), fill.map(f64::to_bits));
        assert_eq!((header.num_steps_finished, header.encoder.clone()), (0, description.encoder));
        assert!(!store.is_complete());
        assert_eq!(header.raw_bytes(), 40 * 729 * (4 + 1));
    }
}

#[test]
fn a_thousand_steps_open_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write_store(&path, &description([9, 8, 8], 1000));
    // The header and the nodes are read, and nothing that grows with what is stored.
    for (name, _) in common::tree_of(&path) {
        let text = name.to_string_lossy();
        if !text.starts_with("nodes") && text != "zarr.json" {
            std::fs::remove_file(path.join(&name)).unwrap();
        }
    }
    let store = Store::open(&path).unwrap();
    assert_eq!(store.header().num_steps_finished, 1000);
}
