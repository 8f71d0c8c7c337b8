//! Holds ARCHITECTURE.md's invariants: which crate may depend on which, and what the pure crates must not use.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// For each crate of the workspace, every crate of the workspace that it may depend on.
const ALLOWED: &[(&str, &[&str])] = &[
    ("chronoxel-core", &[]),
    ("chronoxel-codec", &["chronoxel-core"]),
    ("chronoxel-store", &["chronoxel-core", "chronoxel-codec"]),
    ("chronoxel-ingest", &["chronoxel-core", "chronoxel-codec", "chronoxel-store"]),
    ("chronoxel-stream", &["chronoxel-core"]),
    ("chronoxel-render", &["chronoxel-core", "chronoxel-codec"]),
    (
        "chronoxel",
        &[
            "chronoxel-core",
            "chronoxel-codec",
            "chronoxel-store",
            "chronoxel-ingest",
            "chronoxel-stream",
            "chronoxel-render",
        ],
    ),
];

/// Crates that are pure: slices in, slices out.
const PURE: &[&str] = &["chronoxel-core", "chronoxel-codec", "chronoxel-stream"];

/// What a pure crate must not name in its sources. Files and threads come in as arguments, if at all.
const IMPURE_WORDS: &[&str] =
    &["std::fs", "std::thread", "std::net", "std::process", "rayon", "wgpu", "fs::File", "thread::spawn"];

fn workspace_root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap()
}

/// For each crate of the workspace, the names of the crates it depends on, by `cargo metadata`; crates
/// used by tests and benchmarks alone are left out.
fn dependencies_of_workspace_crates() -> BTreeMap<String, BTreeSet<String>> {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version=1", "--no-deps", "--offline", "--manifest-path"])
        .arg(workspace_root().join("Cargo.toml"))
        .output()
        .expect("cargo runs");
    assert!(output.status.success(), "cargo metadata: {}", String::from_utf8_lossy(&output.stderr));
    let metadata: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let packages = metadata["packages"].as_array().unwrap();
    packages
        .iter()
        .map(|package| {
            let dependencies = package["dependencies"].as_array().unwrap().iter();
            let names = dependencies
                .filter(|dependency| dependency["kind"] != "dev")
                .map(|dependency| dependency["name"].as_str().unwrap().to_owned());
            (package["name"].as_str().unwrap().to_owned(), names.collect())
        })
        .collect()
}

#[test]
fn crates_depend_on_each_other_in_one_direction() {
    let crates = dependencies_of_workspace_crates();
    let known: BTreeSet<&str> = ALLOWED.iter().map(|(name, _)| *name).collect();
    let found: BTreeSet<&str> = crates.keys().map(String::as_str).collect();
    assert_eq!(found, known, "a crate was added or removed: say here what it may depend on");
    for (name, allowed) in ALLOWED {
        let inside = crates[*name].iter().map(String::as_str).filter(|d| known.contains(d));
        let wrong: Vec<&str> = inside.filter(|d| !allowed.contains(d)).collect();
        assert!(wrong.is_empty(), "{name} must not depend on {}", wrong.join(", "));
    }
}

/// Every `.rs` file below `folder`, in order.
fn rust_files(folder: &Path) -> Vec<PathBuf> {
    let mut entries: Vec<PathBuf> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    entries.sort();
    let mut files = Vec::new();
    for path in entries {
        if path.is_dir() {
            files.extend(rust_files(&path));
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            files.push(path);
        }
    }
    files
}

/// The lines of a file that are code, without what follows `//`.
fn code_lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines().enumerate().map(|(n, line)| (n + 1, line.split("//").next().unwrap_or_default()))
}

#[test]
fn pure_crates_use_no_files_and_no_threads() {
    for name in PURE {
        let files = rust_files(&workspace_root().join("crates").join(name).join("src"));
        assert!(!files.is_empty(), "{name} has no sources");
        for file in files {
            let text = fs::read_to_string(&file).unwrap();
            for (line, code) in code_lines(&text) {
                if let Some(word) = IMPURE_WORDS.iter().find(|word| code.contains(**word)) {
                    panic!("{}:{line} names {word}, but {name} is pure", file.display());
                }
            }
        }
    }
}

#[test]
fn pure_crates_depend_on_no_files_and_no_threads() {
    let crates = dependencies_of_workspace_crates();
    for name in PURE {
        let wrong = ["rayon", "tempfile", "memmap2", "zarrs", "tokio", "wgpu"];
        let used: Vec<&str> = wrong.into_iter().filter(|d| crates[*name].contains(*d)).collect();
        assert!(used.is_empty(), "{name} must not depend on {}", used.join(", "));
    }
}

#[test]
fn every_source_file_says_what_it_is_for() {
    for (name, _) in ALLOWED {
        for file in rust_files(&workspace_root().join("crates").join(name).join("src")) {
            let text = fs::read_to_string(&file).unwrap();
            assert!(text.starts_with("//!"), "{} does not start with //!", file.display());
            let num_lines = text.lines().count();
            assert!(num_lines <= 900, "{} has {num_lines} lines: split it", file.display());
        }
    }
}
