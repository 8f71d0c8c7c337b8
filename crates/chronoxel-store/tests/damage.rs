//! Damage anywhere is found: every flipped byte, every missing, cut or added file, and never a panic.

mod common;
mod known;

use std::path::Path;

use chronoxel_core::SpanKind;
use chronoxel_store::{Store, verify};

use common::{copy_folder, description, tree_of, with_time_tree, write_store};

/// The problems of a store, whether they show when it is opened or when it is verified.
fn problems_of(path: &Path) -> Vec<String> {
    match Store::open(path) {
        Ok(store) => verify(&store, &|_, _| {}).problems,
        Err(error) => vec![error.to_string()],
    }
}

#[test]
fn a_sound_store_has_no_problems() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write_store(&path, &with_time_tree(description([20, 13, 9], 4)));
    let store = Store::open(&path).unwrap();
    let last = std::sync::Mutex::new((0, 1));
    let report = verify(&store, &|done, total| *last.lock().unwrap() = (done, total));
    assert_eq!(report.problems, [] as [&str; 0]);
    let totals = store.header().totals;
    assert_eq!(report.num_payloads, totals.coded + totals.shared);
    assert_eq!(report.num_spans, totals.coded + totals.shared + totals.empty + totals.constant);
    let (done, total) = *last.lock().unwrap();
    assert_eq!(done, total);
}

#[test]
fn a_flipped_byte_anywhere_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write_store(&path, &with_time_tree(description([9, 8, 8], 2)));
    let mut num_flips = 0;
    for (name, bytes) in tree_of(&path) {
        let file = path.join(&name);
        let stride = (bytes.len() / 70).max(1);
        let near_end = bytes.len().saturating_sub(24);
        for at in (0..bytes.len()).filter(|at| at % stride == 0 || *at >= near_end) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 1 << (at % 8);
            std::fs::write(&file, &damaged).unwrap();
            let problems = problems_of(&path);
            assert!(!problems.is_empty(), "byte {at} of {}", name.display());
            assert!(problems.iter().all(|problem| !problem.contains('\n')), "{problems:?}");
            num_flips += 1;
        }
        std::fs::write(&file, &bytes).unwrap();
    }
    assert!(num_flips > 1500, "{num_flips}");
    assert_eq!(problems_of(&path), [] as [&str; 0]);
}

#[test]
fn a_missing_cut_or_added_file_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write_store(&path, &with_time_tree(description([9, 8, 8], 2)));
    for (name, bytes) in tree_of(&path) {
        let file = path.join(&name);
        std::fs::remove_file(&file).unwrap();
        assert!(!problems_of(&path).is_empty(), "{} missing", name.display());
        for len in [0, 1, bytes.len() / 2, bytes.len() - 1] {
            std::fs::write(&file, &bytes[..len]).unwrap();
            assert!(!problems_of(&path).is_empty(), "{} cut to {len}", name.display());
        }
        std::fs::write(&file, [&bytes[..], b"x"].concat()).unwrap();
        assert!(!problems_of(&path).is_empty(), "{} grown", name.display());
        std::fs::write(&file, &bytes).unwrap();
        let added = file.with_file_name("c.77.0.0");
        std::fs::write(&added, b"x").unwrap();
        assert!(problems_of(&path).iter().any(|problem| problem.contains("c.77.0.0")));
        std::fs::remove_file(&added).unwrap();
    }
}

#[test]
fn what_belongs_to_no_data_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write_store(&path, &with_time_tree(description([9, 8, 8], 2)));
    let (sound, class) = (tree_of(&path), path.join("speed/L0/W1/C0"));
    assert!(!class.exists(), "speed is of class 1 only");
    // Metadata of an array without a file, right as it may be; then a folder without that.
    let other = std::fs::read(path.join("speed/L0/W1/zarr.json")).unwrap();
    std::fs::create_dir(&class).unwrap();
    assert!(problems_of(&path).iter().any(|p| p.contains("C0: empty folder is unexpected")));
    std::fs::write(class.join("zarr.json"), other).unwrap();
    let problems = problems_of(&path);
    assert!(problems.len() == 1 && problems[0].contains("there is no data in its folder"), "{problems:?}");
    std::fs::remove_dir_all(&class).unwrap();
    assert!(problems_of(&path).is_empty() && tree_of(&path) == sound);
    // Spans are lost with everything they speak of, and with what remains of their payloads.
    std::fs::remove_file(path.join("speed/L0/W1/spans/c.0.0.0")).unwrap();
    let problems = problems_of(&path);
    let lost = "no span holds step 1: lost is speed/L0/W1/spans/c.0.0.0";
    for due in [lost, "C1/S0/c.0.0.0: file is unexpected", "mask/c.0.0.0: file is unexpected"] {
        assert!(problems.iter().any(|p| p.contains(due)), "{due}: {problems:?}");
    }
    std::fs::remove_dir_all(path.join("speed/L0/W1")).unwrap();
    assert!(problems_of(&path).iter().any(|p| p.contains(lost)));
}

#[test]
fn a_damaged_payload_is_named_and_the_others_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    // 27 bricks of 8 per step: too many bytes for one shard to hold all steps, but these two share one.
    write_store(&path, &description([20, 20, 20], 2));
    let file = path.join("speed/L0/W1/C1/S0/c.0.0.0");
    let mut bytes = std::fs::read(&file).unwrap();
    bytes[50] ^= 1;
    std::fs::write(&file, bytes).unwrap();
    let store = Store::open(&path).unwrap();
    let spans = store.spans(0, 0, 0).unwrap();
    let coded: Vec<_> = spans.iter().filter(|s| matches!(s.kind, SpanKind::Coded { .. })).copied().collect();
    let results = store.read_payloads(0, 0, &coded);
    let errors: Vec<String> =
        results.iter().filter_map(|r| r.as_ref().err()).map(|e| e.to_string()).collect();
    assert_eq!(errors.len(), 1, "{errors:?}");
    for part in ["speed/L0/W1/C1/S0/c.0.0.0", "speed, level 0, brick (0, 0, 0), step 0", "checksum"] {
        assert!(errors[0].contains(part), "{errors:?} lacks {part}");
    }
    assert!(results.len() > 5);
}

#[test]
fn a_copied_header_of_another_store_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let [a, b, mixed] = ["a.cxl", "b.cxl", "c.cxl"].map(|name| folder.path().join(name));
    write_store(&a, &description([9, 8, 8], 2));
    write_store(&b, &description([17, 8, 8], 3));
    copy_folder(&a, &mixed);
    std::fs::copy(b.join("zarr.json"), mixed.join("zarr.json")).unwrap();
    assert!(!problems_of(&mixed).is_empty());
}
