//! The statistics of the time tree: what is put is read, what is missing or wrong is refused, what is kept is found again.

mod common;
mod known;

use std::{
    io::{Read, Write},
    path::Path,
};

use chronoxel_core::{
    NodeFacts, NodeId, NodeStatistics, TimeNode,
    time_tree::{num_time_levels, num_time_nodes},
};
use chronoxel_store::{Store, StoreDescription, StoreWriter, TimeTreeEntry, verify};

use common::{
    copy_folder, description, field, put_statistics, spans_of, statistics_of, tree_of, with_time_tree,
    write_steps, write_store,
};

/// Every node of a time tree.
fn time_nodes(num_steps: u32) -> impl Iterator<Item = TimeNode> {
    (0..num_time_levels(num_steps)).flat_map(move |level| {
        (0..num_time_nodes(num_steps, level)).map(move |index| TimeNode { level, index })
    })
}

/// Half the distance between two single-precision numbers, as a share of them.
const HALF_ULP: f64 = 1.0 / (1 << 24) as f64;

/// Holds what was read against what was put.
fn check_rounded(found: &NodeStatistics, put: &NodeStatistics) {
    assert_eq!(found.facts, put.facts);
    if put.is_empty() {
        assert!(
            [found.min, found.max, found.mean, found.std, found.temporal_error].iter().all(|v| v.is_nan())
        );
        return;
    }
    let numbers = [found.min, found.max, found.mean, found.std, found.temporal_error];
    assert!(numbers.iter().all(|&v| f64::from(v as f32) == v), "{found:?}");
    let near = |found: f64, due: f64, ulps: f64| (found - due).abs() <= 2.0 * ulps * HALF_ULP * due.abs();
    assert!(found.min <= put.min && near(found.min, put.min, 1.0), "{found:?} {put:?}");
    assert!(found.max >= put.max && near(found.max, put.max, 1.0), "{found:?} {put:?}");
    assert!(near(found.mean, put.mean, 0.5) && near(found.std, put.std, 0.5), "{found:?} {put:?}");
    let is_least = found.temporal_error == f64::from(f32::from_bits(1)) && put.temporal_error > 0.0;
    assert!(is_least || near(found.temporal_error, put.temporal_error, 0.5), "{found:?} {put:?}");
}

fn check_all(store: &Store, description: &StoreDescription) {
    let num_steps = description.times.num_steps() as u32;
    for (variable, at) in time_nodes(num_steps).flat_map(|at| [(0, at), (1, at)]) {
        assert!(store.has_statistics(at));
        let found = store.statistics(variable, at).unwrap();
        let put = statistics_of(description, variable, at);
        assert_eq!(found.len(), put.len());
        found.iter().zip(&put).for_each(|(found, put)| check_rounded(found, put));
    }
}

#[test]
fn what_is_put_is_read_to_single_precision() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    // 12 + 2 + 1 nodes, so that 64 rows share a chunk; the last level has one row.
    let description = with_time_tree(description([20, 13, 9], 70));
    write_store(&path, &description);
    let store = Store::open(&path).unwrap();
    assert_eq!(store.time_tree(), Some(TimeTreeEntry { stride: 1 }));
    check_all(&store, &description);
    let report = verify(&store, &|_, _| {});
    assert!(report.is_ok(), "{:?}", report.problems);
    // 70 + 35 + 18 + 9 + 5 + 3 + 2 + 1 time nodes.
    assert_eq!(report.num_statistics, 2 * 143 * 15);
    // The field has waves, a constant half that is masked at step 3, and a variable that never changes.
    let any = |variable, at, holds: fn(&NodeStatistics) -> bool| {
        store.statistics(variable, at).unwrap().iter().any(holds)
    };
    let [root, first, fourth] = [TimeNode::root(70), TimeNode::of_step(0), TimeNode::of_step(3)];
    assert!(any(0, root, |node| node.facts.mask_changes) && !any(0, root, |node| node.facts.is_static));
    assert!(any(1, root, |node| node.facts.is_static) && !any(1, root, |node| !node.facts.is_static));
    assert!(any(0, first, |node| node.facts.is_uniform) && !any(0, first, NodeStatistics::is_empty));
    assert!(any(0, fourth, NodeStatistics::is_empty));
}

#[test]
fn nodes_are_numbered_finest_first() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write_store(&path, &with_time_tree(description([20, 13, 9], 1)));
    let store = Store::open(&path).unwrap();
    // Levels of 3 × 2 × 2, 2 × 1 × 1 and one bricks.
    let index = |level, brick| store.node_index(NodeId::new(level, brick));
    assert_eq!([index(0, [0; 3]), index(0, [1, 0, 0]), index(0, [2, 1, 1])], [0, 1, 11].map(Some));
    assert_eq!([index(1, [0; 3]), index(1, [1, 0, 0]), index(2, [0; 3])], [12, 13, 14].map(Some));
    assert_eq!([index(0, [3, 0, 0]), index(1, [0, 1, 0]), index(3, [0; 3])], [None; 3]);
    assert_eq!(store.header().num_tree_nodes(), 15);
}

#[test]
fn a_picture_reads_each_chunk_once() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write_store(&path, &with_time_tree(description([20, 13, 9], 100)));
    let store = Store::open(&path).unwrap();
    let levels = 0..num_time_levels(100);
    let read = |step| {
        let before = store.bytes_read();
        levels.clone().for_each(|level| drop(store.statistics(0, TimeNode::holding(step, level)).unwrap()));
        store.bytes_read() - before
    };
    let first = read(5);
    let stored: u64 = levels
        .clone()
        .map(|level| path.join(format!("speed/time/T{level}/c.0.0.0")).metadata().unwrap().len())
        .sum();
    assert_eq!(first, stored);
    assert_eq!(read(63), 0, "the same chunks");
    let second_chunk = path.join("speed/time/T0/c.1.0.0").metadata().unwrap().len();
    assert_eq!(read(64), second_chunk, "of longer runs, one chunk has all");
}

#[test]
fn what_is_missing_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let description = with_time_tree(description([20, 13, 9], 6));
    for missing in time_nodes(6) {
        let path = folder.path().join("a.cxl");
        let mut writer = StoreWriter::create(&path, &description, true).unwrap();
        for step in 0..6 {
            for (variable, level) in (0..3).flat_map(|level| [(0, level), (1, level)]) {
                writer.put(variable, level, spans_of(&description, variable, level, step, field)).unwrap();
            }
            for (variable, at) in TimeNode::closed_by(step, 6).flat_map(|at| [(0, at), (1, at)]) {
                if (variable, at) != (1, missing) {
                    let row = statistics_of(&description, variable, at);
                    writer.put_statistics(variable, at, &row).unwrap();
                }
            }
            let result = writer.commit_step(step);
            assert_eq!(result.is_err(), step == 5, "{result:?}");
            if let Err(error) = result {
                let due = format!("an odd/name over the steps {:?} are missing", missing.steps(6));
                assert!(error.to_string().contains(&due), "{error}");
            }
        }
        assert!(writer.finish().is_err());
        assert!(!path.join("variable-1/time/T0/c.0.0.0").exists());
    }
}

#[test]
fn what_is_not_sound_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let described = with_time_tree(description([9, 8, 8], 6));
    let at = TimeNode::of_step(2);
    let sound = statistics_of(&described, 0, at);
    let writer = |name: &str, described: &StoreDescription| {
        StoreWriter::create(&folder.path().join(name), described, true).unwrap()
    };
    writer("a.cxl", &described).put_statistics(0, at, &sound).unwrap();
    assert!(writer("a.cxl", &described).put_statistics(2, at, &sound).is_err());
    assert!(writer("a.cxl", &described).put_statistics(0, at, &sound[1..]).is_err());
    for wrong in [TimeNode::of_step(6), TimeNode { level: 4, index: 0 }, TimeNode { level: 3, index: 1 }] {
        let error = writer("a.cxl", &described).put_statistics(0, wrong, &sound).unwrap_err();
        assert!(error.to_string().contains("the series has 6 steps"), "{error}");
    }
    let without = writer("b.cxl", &description([9, 8, 8], 6)).put_statistics(0, at, &sound).unwrap_err();
    assert!(without.to_string().contains("the store has no statistics"), "{without}");
    let spoil: [fn(&mut NodeStatistics); 6] = [
        |node| node.min = node.max + 1.0,
        |node| node.mean = node.max + 1.0,
        |node| node.max = f64::INFINITY,
        |node| node.std = -1.0,
        |node| node.temporal_error = -1e-9,
        |node| node.mean = f64::NAN,
    ];
    for spoil in spoil {
        let mut wrong = sound.clone();
        spoil(&mut wrong[1]);
        let error = writer("a.cxl", &described).put_statistics(0, at, &wrong).unwrap_err().to_string();
        assert!(error.contains("those of speed, node 1") && error.contains("statistics are"), "{error}");
    }
}

#[test]
fn numbers_beyond_single_precision_keep_their_bits() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    let described = with_time_tree(description([8, 8, 8], 1));
    let mut writer = StoreWriter::create(&path, &described, false).unwrap();
    let at = TimeNode::of_step(0);
    let facts = NodeFacts { is_static: true, ..NodeFacts::default() };
    // 2^-149 is the least, 0x1.99999ap-4 the nearest to 0.1, and above it.
    let least = 2f64.powi(-149);
    for (variable, [min, max, mean, std]) in [(0, [-1e300, 1e39, 0.1, 1.5]), (1, [-1e-60, 0.1, 1e-70, 1e-50])]
    {
        let put = NodeStatistics { min, max, mean, std, temporal_error: 0.0, facts };
        writer.put_statistics(variable, at, &[put]).unwrap();
        writer.put(variable, 0, spans_of(&described, variable, 0, 0, field)).unwrap();
    }
    writer.commit_step(0).unwrap();
    writer.finish().unwrap();
    let store = Store::open(&path).unwrap();
    let tenth = 13_421_773.0 / 134_217_728.0;
    for (variable, due) in [(0, [-1e300, 1e39, tenth, 1.5]), (1, [-least, tenth, least, least])] {
        let found = store.statistics(variable, at).unwrap()[0];
        assert_eq!([found.min, found.max, found.mean, found.std], due);
    }
}

/// Puts and commits all steps, the statistics of each in an order of their own and again later.
fn write_in_another_order(path: &Path, described: &StoreDescription) {
    let num_steps = described.times.num_steps() as u32;
    let mut writer = StoreWriter::create(path, described, false).unwrap();
    let wrong = NodeStatistics::EMPTY;
    for step in 0..num_steps {
        let mut closed: Vec<TimeNode> = TimeNode::closed_by(step, num_steps).collect();
        closed.reverse();
        for (variable, at) in closed.iter().flat_map(|&at| [(1, at), (0, at)]) {
            let row = statistics_of(described, variable, at);
            writer.put_statistics(variable, at, &vec![wrong; row.len()]).unwrap();
            writer.put_statistics(variable, at, &row).unwrap();
        }
        for (variable, level) in (0..3).flat_map(|level| [(0, level), (1, level)]) {
            writer.put(variable, level, spans_of(described, variable, level, step, field)).unwrap();
        }
        writer.commit_step(step).unwrap();
        // Steps 0 to 63 are in files from then on: 64 rows of single steps, and 32 of two are not.
        if step == 127 {
            writer.put_statistics(0, TimeNode::of_step(63), &vec![wrong; 15]).unwrap();
        }
    }
    writer.finish().unwrap();
}

#[test]
fn order_does_not_matter_and_what_is_in_a_file_stays() {
    let folder = tempfile::tempdir().unwrap();
    let described = with_time_tree(description([20, 13, 9], 130));
    let [path, other] = ["a.cxl", "b.cxl"].map(|name| folder.path().join(name));
    write_store(&path, &described);
    write_in_another_order(&other, &described);
    assert!(tree_of(&path) == tree_of(&other));
}

#[test]
fn a_resume_may_put_again_what_it_reads_anew() {
    let folder = tempfile::tempdir().unwrap();
    // 448 + 64 + 8 + 1 nodes: four rows to a chunk, a commit at every step.
    let described = with_time_tree(description([64, 64, 50], 9));
    let [whole, path] = ["whole.cxl", "a.cxl"].map(|name| folder.path().join(name));
    write_store(&whole, &described);
    let expected = tree_of(&whole);
    let mut writer = StoreWriter::create(&path, &described, false).unwrap();
    let mut first = 0;
    for stop in [3, 8, 9] {
        write_steps(&mut writer, &described, first..stop).unwrap();
        // Of a step that is not committed, some statistics come early.
        let early = TimeNode { level: 1, index: 4 };
        writer.put_statistics(0, early, &statistics_of(&described, 0, early)).unwrap();
        assert_eq!(writer.steps_committed(), stop);
        drop(writer);
        let store = Store::open(&path).unwrap();
        let report = (stop == 3).then(|| verify(&store, &|_, _| {}));
        assert!(report.is_none_or(|report| report.is_ok()));
        check_finished(&store, &described, stop);
        (writer, first) = StoreWriter::resume(&path, &described).unwrap();
        assert_eq!((first, writer.steps_committed()), (stop, stop));
        // The last eight steps are read anew.
        (stop / 8 * 8..stop).for_each(|step| put_statistics(&mut writer, &described, step).unwrap());
    }
    writer.finish().unwrap();
    assert!(tree_of(&path) == expected);
}

/// Of an unfinished store what lies in whole chunks can be read, and the rest says so.
fn check_finished(store: &Store, described: &StoreDescription, finished: u32) {
    assert_eq!(store.header().num_steps_finished, finished);
    let num_steps = described.times.num_steps() as u32;
    for at in time_nodes(num_steps) {
        // Chunks of four rows, but for levels of fewer.
        let rows = num_time_nodes(num_steps, at.level).next_power_of_two().min(4);
        let last = TimeNode { level: at.level, index: at.index / rows * rows + rows - 1 };
        let is_due = last.steps(num_steps).end <= finished;
        assert_eq!(store.has_statistics(at), is_due, "{at:?} after {finished} steps");
        match store.statistics(1, at) {
            Ok(found) => {
                let put = statistics_of(described, 1, at);
                found.iter().zip(&put).for_each(|(found, put)| check_rounded(found, put));
            }
            Err(error) => assert!(error.to_string().contains("finished steps"), "{error}"),
        }
    }
}

fn text_of(writer: &StoreWriter, name: &str) -> Option<String> {
    let mut text = String::new();
    writer.kept_file(name).unwrap().map(|mut file| {
        file.read_to_string(&mut text).unwrap();
        text
    })
}

fn kept_on_disk(path: &Path) -> usize {
    tree_of(path).iter().filter(|(name, _)| name.to_string_lossy().contains("kept-")).count()
}

#[test]
fn kept_files_are_those_of_the_commit() {
    let folder = tempfile::tempdir().unwrap();
    let described = with_time_tree(description([20, 13, 9], 200));
    let [path, copy] = ["a.cxl", "copy.cxl"].map(|name| folder.path().join(name));
    let mut writer = StoreWriter::create(&path, &described, false).unwrap();
    let keep = |writer: &mut StoreWriter, name: &str, text: &str| {
        writer.keep_file(name).unwrap().write_all(text.as_bytes()).unwrap();
    };
    for name in ["", "A", "a/b", "a!b", "ä", &"a".repeat(65)] {
        assert!(writer.keep_file(name).is_err(), "{name:?}");
    }
    keep(&mut writer, "..", "one");
    keep(&mut writer, "later", "dropped before it was listed");
    writer.drop_file("later");
    write_steps(&mut writer, &described, 0..64).unwrap();
    assert_eq!(
        (text_of(&writer, ".."), text_of(&writer, "later"), kept_on_disk(&path)),
        (Some("one".into()), None, 1)
    );
    // After the commit: another of the same name, a new one, none of which a resume knows.
    keep(&mut writer, "..", "two");
    keep(&mut writer, "new", "new");
    assert_eq!(text_of(&writer, "..").unwrap(), "two");
    write_steps(&mut writer, &described, 64..100).unwrap();
    copy_folder(&path, &copy);
    let resumed = StoreWriter::resume(&copy, &described).unwrap().0;
    assert_eq!((text_of(&resumed, "..").unwrap(), text_of(&resumed, "new")), ("one".into(), None));
    assert_eq!(kept_on_disk(&copy), 1);
    drop(resumed);
    // Dropped, it is there until the commit.
    write_steps(&mut writer, &described, 100..127).unwrap();
    writer.drop_file("..");
    assert_eq!((text_of(&writer, ".."), kept_on_disk(&path)), (None, 3));
    drop(writer);
    let (mut writer, next) = StoreWriter::resume(&path, &described).unwrap();
    assert_eq!((next, text_of(&writer, "..").unwrap()), (64, "one".into()));
    writer.drop_file("..");
    keep(&mut writer, "new", "newer");
    write_steps(&mut writer, &described, 64..128).unwrap();
    assert_eq!(kept_on_disk(&path), 1);
    let (mut writer, _) = StoreWriter::resume(&path, &described).unwrap();
    assert_eq!((text_of(&writer, ".."), text_of(&writer, "new").unwrap()), (None, "newer".into()));
    let file =
        tree_of(&path).into_iter().find(|(name, _)| name.to_string_lossy().contains("-new")).unwrap().0;
    write_steps(&mut writer, &described, 128..200).unwrap();
    // Complete and not yet finished, then finished.
    assert_eq!(kept_on_disk(&path), 1);
    writer.finish().unwrap();
    assert_eq!(kept_on_disk(&path), 0);
    // One that was changed after its commit, or is lost.
    std::fs::write(copy.join(&file), "longer than it was").unwrap();
    drop(StoreWriter::resume(&copy, &described).unwrap());
    assert!(!copy.join(file).exists(), "it was no part of that state");
    for (name, bytes) in tree_of(&copy).iter().filter(|(name, _)| name.to_string_lossy().contains("kept-")) {
        std::fs::write(copy.join(name), &bytes[1..]).unwrap();
        let error = StoreWriter::resume(&copy, &described).unwrap_err().to_string();
        assert!(error.contains("size in bytes is 2") && error.contains("kept-"), "{error}");
        std::fs::remove_file(copy.join(name)).unwrap();
        assert!(StoreWriter::resume(&copy, &described).is_err());
    }
}

#[test]
fn kept_files_of_a_writer_that_gives_up() {
    let folder = tempfile::tempdir().unwrap();
    let described = with_time_tree(description([20, 13, 9], 130));
    let path = folder.path().join("a.cxl");
    for num_steps in [3, 64] {
        let mut writer = StoreWriter::create(&path, &described, false).unwrap();
        writer.keep_file("carried").unwrap().write_all(b"text").unwrap();
        write_steps(&mut writer, &described, 0..num_steps).unwrap();
        match writer.abandon().unwrap() {
            None => assert!(num_steps == 3 && !path.exists()),
            Some(partial) => {
                assert!(
                    kept_on_disk(&partial) == 1
                        && verify(&Store::open(&partial).unwrap(), &|_, _| {}).is_ok()
                );
                let (writer, next) = StoreWriter::resume(&path, &described).unwrap();
                assert_eq!((next, text_of(&writer, "carried").unwrap()), (64, "text".into()));
            }
        }
    }
}
