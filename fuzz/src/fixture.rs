//! A store of the first version, copied from the fixture once for each process, of which one file at a time
//! is replaced.

use std::{
    path::{Path, PathBuf},
    sync::OnceLock,
};

use chronoxel_codec::{decode_f64, decode_resident};
use chronoxel_core::SpanKind;
use chronoxel_store::{Store, verify};

const FIXTURE: &str =
    concat!(env!("CARGO_MANIFEST_DIR"), "/../crates/chronoxel-store/tests/fixtures/v1_sparse.cxl");
/// Most nodes of a level of a store that is read through: the fixture has four, a forged header may say any number.
const MOST_NODES: usize = 64;
const ABSENT: [u8; 16] = [0xff; 16];

/// The copy, and the files of it that hold data, by name.
struct Copy {
    root: PathBuf,
    data: Vec<(String, Vec<u8>)>,
}

fn copy() -> &'static Copy {
    static COPY: OnceLock<Copy> = OnceLock::new();
    COPY.get_or_init(|| {
        let root = crate::scratch().join("v1.cxl");
        let mut data = Vec::new();
        copy_folder(Path::new(FIXTURE), "", &mut data);
        data.sort();
        Copy { root, data }
    })
}

fn copy_folder(from: &Path, name: &str, data: &mut Vec<(String, Vec<u8>)>) {
    for entry in std::fs::read_dir(from).expect("the fixture can be listed") {
        let path = entry.expect("the fixture can be listed").path();
        let file = path.file_name().unwrap_or_default().to_string_lossy();
        let inner = if name.is_empty() { file.to_string() } else { format!("{name}/{file}") };
        if path.is_dir() {
            copy_folder(&path, &inner, data);
            continue;
        }
        let bytes = std::fs::read(&path).expect("the fixture can be read");
        crate::write(&format!("v1.cxl/{inner}"), &bytes);
        if file.starts_with("c.") {
            data.push((inner, bytes));
        }
    }
}

/// One of the files that hold data: its name and bytes.
pub fn data_file(number: usize) -> (&'static str, &'static [u8]) {
    let data = &copy().data;
    let (name, bytes) = &data[number % data.len()];
    (name, bytes)
}

/// Runs something on the store with one file replaced, and puts the file back.
pub fn with_file(name: &str, bytes: &[u8], run: impl FnOnce(&Path)) {
    let copy = copy();
    let path = copy.root.join(name);
    let original = std::fs::read(&path).expect("the copy can be read");
    std::fs::write(&path, bytes).expect("the copy can be written");
    run(&copy.root);
    std::fs::write(&path, original).expect("the copy can be written");
}

/// Reads all that a viewer reads, then verifies.
pub fn read_all(path: &Path) {
    let Ok(store) = Store::open(path) else { return };
    let header = store.header();
    if header.levels.iter().any(|level| level.num_nodes > MOST_NODES) {
        return;
    }
    for variable in 0..header.variables.len().min(4) {
        for level in 0..header.levels.len() as u8 {
            for step in (0..header.num_steps_finished.min(12)).step_by(4) {
                read_step(&store, variable, level, step);
            }
        }
    }
    if header.num_steps() <= 64 && header.variables.len() <= 4 {
        verify(&store, &|_, _| {});
    }
}

fn read_step(store: &Store, variable: usize, level: u8, step: u32) {
    let Ok(spans) = store.spans(variable, level, step) else { return };
    assert_eq!(spans.len(), store.tree().nodes(level).len());
    for (span, payload) in spans.iter().zip(store.read_payloads(variable, level, &spans)) {
        assert!((span.start..span.start + span.len).contains(&step));
        let mask = store.read_mask(variable, level, span);
        let (Ok(Some(payload)), Ok(mask)) = (payload, mask) else { continue };
        assert!(matches!(span.kind, SpanKind::Coded { .. }));
        let layout = store.layout();
        if let (Ok(samples), Ok(resident)) = (
            decode_f64(&payload, layout, step - span.start),
            decode_resident(&payload, layout, step - span.start, mask),
        ) {
            assert_eq!(samples.len(), resident.samples.len());
        }
    }
}

fn with_crc(bytes: &[u8]) -> Vec<u8> {
    [bytes, &crc32c::crc32c(bytes).to_le_bytes()].concat()
}

fn unzip(stored: &[u8]) -> Vec<u8> {
    let compressed = &stored[..stored.len().saturating_sub(4)];
    zstd::bulk::decompress(compressed, 1 << 20).expect("the fixture is sound")
}

fn zip(content: &[u8]) -> Vec<u8> {
    with_crc(&zstd::bulk::compress(content, 1).expect("memory can be compressed"))
}

/// Start and length of the index of a fixture's shard: 64 steps of `nodes` nodes in rows of a window.
fn index_start(name: &str, bytes: &[u8]) -> usize {
    let nodes = [4, 2, 1][(0..3).find(|level| name.contains(&format!("/L{level}/"))).unwrap_or(0)];
    let rows = if name.contains("/W4/") { 16 } else { 64 };
    bytes.len() - 4 - 16 * nodes * rows
}

/// The stored chunks of a shard, as places in its index.
fn present(index: &[u8]) -> Vec<usize> {
    (0..index.len() / 16).filter(|slot| index[16 * slot..16 * slot + 16] != ABSENT).collect()
}

/// Offset and length of a chunk in the shard.
fn extent(index: &[u8], slot: usize) -> (usize, usize) {
    let number = |at: usize| {
        index[at..at + 8].iter().rev().fold(0usize, |number, &byte| number << 8 | usize::from(byte))
    };
    (number(16 * slot), number(16 * slot + 8))
}

/// What of a file is changed: the file as it lies, what its checksum guards, or for a shard its index or the
/// unpacked bytes of a chunk.
pub fn unpack(name: &str, bytes: &[u8], how: u8, slot: usize) -> Vec<u8> {
    if how.is_multiple_of(4) {
        return bytes.to_vec();
    }
    if name.starts_with("nodes") {
        return bytes[..bytes.len() - 4].to_vec();
    }
    if name.contains("/spans/") {
        return unzip(bytes);
    }
    let index = &bytes[index_start(name, bytes)..bytes.len() - 4];
    if how % 4 == 1 {
        return index.to_vec();
    }
    let slots = present(index);
    let (offset, len) = extent(index, slots[slot % slots.len()]);
    unzip(&bytes[offset..offset + len])
}

/// The file with changed content, every checksum right.
pub fn pack(name: &str, bytes: &[u8], how: u8, slot: usize, content: Vec<u8>) -> Vec<u8> {
    if how.is_multiple_of(4) {
        return content;
    }
    if name.starts_with("nodes") {
        return with_crc(&content);
    }
    if name.contains("/spans/") {
        return zip(&content);
    }
    let start = index_start(name, bytes);
    if how % 4 == 1 {
        return [&bytes[..start], &with_crc(&content)].concat();
    }
    // The changed chunk goes to the end of the chunks, where there is room for any length.
    let mut index = bytes[start..bytes.len() - 4].to_vec();
    let slots = present(&index);
    let at = 16 * slots[slot % slots.len()];
    let chunk = zip(&content);
    index[at..at + 8].copy_from_slice(&(start as u64).to_le_bytes());
    index[at + 8..at + 16].copy_from_slice(&(chunk.len() as u64).to_le_bytes());
    [&bytes[..start], &chunk, &with_crc(&index)].concat()
}
