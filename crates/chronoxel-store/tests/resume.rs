//! A writer that stops anywhere leaves a store that opens, and that a resume completes to the same bytes.

mod common;
mod known;

use std::path::Path;

use chronoxel_store::{Store, StoreDescription, StoreWriter, verify};

use common::{
    copy_folder, description, field, put_statistics, spans_of, tree_of, with_time_tree, write_steps,
    write_store,
};

/// Opens a store that may not be complete and checks what is finished of it.
fn check_partial(path: &Path) -> u32 {
    let store = Store::open(path).unwrap();
    let report = verify(&store, &|_, _| {});
    assert!(report.is_ok(), "{:?}", report.problems);
    for step in 0..store.header().num_steps_finished {
        assert_eq!(store.spans(0, 0, step).unwrap()[0].start, step);
    }
    assert!(store.spans(0, 0, store.header().num_steps_finished).is_err());
    store.header().num_steps_finished
}

fn resume_and_finish(path: &Path, description: &StoreDescription) {
    let (mut writer, next) = StoreWriter::resume(path, description).unwrap();
    write_steps(&mut writer, description, next..description.times.num_steps() as u32).unwrap();
    writer.finish().unwrap();
}

/// Copies the store after every put and every commit, resumes each copy, and compares.
fn resume_from_everywhere(dims: [usize; 3], num_steps: usize, stride: usize) -> Vec<u32> {
    let folder = tempfile::tempdir().unwrap();
    let description = with_time_tree(description(dims, num_steps));
    let whole = folder.path().join("whole.cxl");
    write_store(&whole, &description);
    let expected = tree_of(&whole);

    let path = folder.path().join("a.cxl");
    let copy = folder.path().join("copy.cxl");
    let mut finished = Vec::new();
    let mut moment = 0;
    let mut check = |path: &Path| {
        moment += 1;
        if moment % stride != 1 && stride > 1 {
            return;
        }
        copy_folder(path, &copy);
        finished.push(check_partial(&copy));
        resume_and_finish(&copy, &description);
        assert!(tree_of(&copy) == expected, "moment {moment}");
        std::fs::remove_dir_all(&copy).unwrap();
    };
    let mut writer = StoreWriter::create(&path, &description, false).unwrap();
    check(&path);
    for step in 0..num_steps as u32 {
        let levels = 0..description.tree.num_levels() as u8;
        for (variable, level) in levels.flat_map(|level| [(0, level), (1, level)]) {
            writer.put(variable, level, spans_of(&description, variable, level, step, field)).unwrap();
            check(&path);
        }
        put_statistics(&mut writer, &description, step).unwrap();
        check(&path);
        writer.commit_step(step).unwrap();
        check(&path);
    }
    drop(writer);
    check(&path);
    finished
}

#[test]
fn a_resume_from_any_moment_gives_the_same_bytes() {
    // 180 bricks of 11^3 samples: 4 steps to a shard.
    let finished = resume_from_everywhere([40, 40, 28], 6, 5);
    assert_eq!(finished.iter().max(), Some(&6));
    assert!(finished.contains(&4) && finished.contains(&0));
}

#[test]
fn a_commit_that_was_cut_short_is_taken_back() {
    let folder = tempfile::tempdir().unwrap();
    let description = with_time_tree(description([20, 13, 9], 130));
    let whole = folder.path().join("whole.cxl");
    write_store(&whole, &description);
    let expected = tree_of(&whole);
    let path = folder.path().join("a.cxl");
    let before = folder.path().join("before.cxl");
    let mut writer = StoreWriter::create(&path, &description, false).unwrap();
    write_steps(&mut writer, &description, 0..127).unwrap();
    copy_folder(&path, &before);
    write_steps(&mut writer, &description, 127..128).unwrap();
    drop(writer);
    assert_eq!((check_partial(&before), check_partial(&path)), (64, 128));
    // Files of the commit appear one after the other; the crash comes after each of them.
    let [old, new] = [tree_of(&before), tree_of(&path)];
    let data: Vec<_> = new
        .iter()
        .filter(|(name, _)| !old.iter().any(|(other, _)| other == name) && !name.starts_with(".partial"))
        .collect();
    assert!(data.len() >= 8);
    for num_renamed in 0..=data.len() {
        let crashed = folder.path().join("crashed.cxl");
        copy_folder(&before, &crashed);
        for (name, bytes) in &data[..num_renamed] {
            std::fs::write(crashed.join(name), bytes).unwrap();
            let temporary = name.to_string_lossy().replace('/', "!");
            std::fs::remove_file(crashed.join(".partial").join(temporary)).ok();
        }
        if num_renamed == data.len() {
            for name in ["state", "digests"] {
                std::fs::copy(path.join(".partial").join(name), crashed.join(".partial").join(name)).unwrap();
            }
        }
        check_partial(&crashed);
        resume_and_finish(&crashed, &description);
        assert!(tree_of(&crashed) == expected, "{num_renamed} files renamed");
        std::fs::remove_dir_all(&crashed).unwrap();
    }
}

#[test]
fn what_was_finished_is_kept_when_a_writer_gives_up() {
    let folder = tempfile::tempdir().unwrap();
    let description = with_time_tree(description([20, 13, 9], 70));
    let path = folder.path().join("a.cxl");
    let whole = folder.path().join("whole.cxl");
    write_store(&whole, &description);
    let mut writer = StoreWriter::create(&path, &description, false).unwrap();
    write_steps(&mut writer, &description, 0..66).unwrap();
    let partial = writer.abandon().unwrap().unwrap();
    assert_eq!(partial, folder.path().join("a.partial.cxl"));
    assert!(!path.exists());
    assert_eq!(check_partial(&partial), 64);
    resume_and_finish(&path, &description);
    assert!(!partial.exists());
    assert!(tree_of(&path) == tree_of(&whole));
    // A complete store resumes to itself.
    resume_and_finish(&path, &description);
    assert!(tree_of(&path) == tree_of(&whole));
}

#[test]
fn what_the_encoder_carries_is_that_of_the_commit() {
    let folder = tempfile::tempdir().unwrap();
    let description = with_time_tree(description([20, 13, 9], 70));
    let path = folder.path().join("a.cxl");
    let carried = |step: u32| serde_json::json!({ "step": step, "rate": 0.1 + f64::from(step) });
    let mut writer = StoreWriter::create(&path, &description, false).unwrap();
    assert!(writer.carry().is_null());
    drop(writer);
    assert!(StoreWriter::resume(&path, &description).unwrap().0.carry().is_null());
    writer = StoreWriter::resume(&path, &description).unwrap().0;
    for step in 0..66 {
        writer.set_carry(carried(step));
        write_steps(&mut writer, &description, step..step + 1).unwrap();
    }
    assert_eq!(*writer.carry(), carried(65));
    drop(writer);
    // Steps 64 and 65 were never committed.
    let (writer, next) = StoreWriter::resume(&path, &description).unwrap();
    assert_eq!((next, writer.carry().clone()), (64, carried(63)));
    drop(writer);
    resume_and_finish(&path, &description);
    assert!(StoreWriter::resume(&path, &description).unwrap().0.carry().is_null());
}

#[test]
fn another_description_or_a_damaged_journal_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let first = with_time_tree(description([20, 13, 9], 70));
    let path = folder.path().join("a.cxl");
    let mut writer = StoreWriter::create(&path, &first, false).unwrap();
    write_steps(&mut writer, &first, 0..64).unwrap();
    drop(writer);
    let mut other = first.clone();
    other.encoder = serde_json::json!({ "codec": "palette" });
    let error = StoreWriter::resume(&path, &other).unwrap_err().to_string();
    assert!(error.contains("other options") && error.contains("a.cxl"), "{error}");
    let state = path.join(".partial/state");
    let mut bytes = std::fs::read(&state).unwrap();
    bytes[30] ^= 1;
    std::fs::write(&state, bytes).unwrap();
    let error = StoreWriter::resume(&path, &first).unwrap_err().to_string();
    assert!(error.contains("encode it anew"), "{error}");
    check_partial(&path);
}

#[test]
fn files_that_a_stopped_machine_lost_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let description = with_time_tree(description([20, 13, 9], 130));
    let path = folder.path().join("a.cxl");
    let mut writer = StoreWriter::create(&path, &description, false).unwrap();
    write_steps(&mut writer, &description, 0..64).unwrap();
    drop(writer);
    let shard = path.join("speed/L0/W1/C1/S0/c.0.0.0");
    let bytes = std::fs::read(&shard).unwrap();
    std::fs::write(&shard, []).unwrap();
    let error = StoreWriter::resume(&path, &description).unwrap_err().to_string();
    assert!(error.contains("c.0.0.0") && error.contains("machine stopped"), "{error}");
    std::fs::write(&shard, bytes).unwrap();
    assert_eq!(StoreWriter::resume(&path, &description).unwrap().1, 64);
}
