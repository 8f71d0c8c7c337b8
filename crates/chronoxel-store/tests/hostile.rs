//! Stores made to harm: checksums are right, what they guard is not. Every one is an error, none a panic or a large allocation.

mod common;
mod known;

use std::path::{Path, PathBuf};

use chronoxel_store::{Store, verify};

use common::{description, tree_of, with_time_tree, write_store};

/// A small store in a folder of its own.
fn store(folder: &Path) -> PathBuf {
    let path = folder.join("a.cxl");
    write_store(&path, &with_time_tree(description([9, 8, 8], 2)));
    path
}

/// Appends the CRC-32C of bytes to them.
fn with_crc(bytes: &[u8]) -> Vec<u8> {
    [bytes, &crc32c::crc32c(bytes).to_le_bytes()].concat()
}

/// Replaces a part of the header's text and makes its checksum right.
fn edit_header(path: &Path, from: &str, to: &str) {
    let file = path.join("zarr.json");
    let text = std::fs::read_to_string(&file).unwrap();
    assert!(text.contains(from), "{from} is not in the header");
    let text = text.replacen(from, to, 1);
    let at = text.rfind("\"z_crc32c\": \"").unwrap() + 13;
    let blank = format!("{}00000000{}", &text[..at], &text[at + 8..]);
    let crc = format!("{:08x}", crc32c::crc32c(blank.as_bytes()));
    std::fs::write(file, format!("{}{crc}{}", &text[..at], &text[at + 8..])).unwrap();
}

/// Every problem there is, whether it shows on opening or later.
fn problems_of(path: &Path) -> Vec<String> {
    match Store::open(path) {
        Ok(store) => verify(&store, &|_, _| {}).problems,
        Err(error) => vec![error.to_string()],
    }
}

#[test]
fn headers_that_lie_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = store(folder.path());
    let original = std::fs::read(path.join("zarr.json")).unwrap();
    edit_header(&path, "\"encoder\": {", "\"encoder\": { \"more\": 1,");
    assert_eq!(problems_of(&path), [] as [&str; 0], "an edit with a right checksum is no damage by itself");
    for (from, to, message) in [
        ("\"version\": 1", "\"version\": 2", "version is 2, which is not supported"),
        ("\"edge\":8", "\"edge\":9", "bricks"),
        ("\"edge\":8", "\"edge\":16", "levels"),
        ("\"num_nodes\":2", "\"num_nodes\":1", "size in bytes"),
        ("\"num_nodes\":2", "\"num_nodes\":2000000000", "levels"),
        ("\"num_nodes\":2", "\"num_nodes\":18446744073709551615", "levels"),
        ("\"apron_stored\": true", "\"apron_stored\": false", "apron_stored"),
        ("\"folder\":\"speed\"", "\"folder\":\"../../etc\"", "folder"),
        ("\"index_bits\":8", "\"index_bits\":9", "index_bits"),
        ("\"windows\":[", "\"windows\":[ 0,", "windows"),
        ("\"windows\":[", "\"windows\":[ 1,", "windows"),
        ("\"num_steps_finished\": 2", "\"num_steps_finished\": 3", "num_steps_finished"),
        ("\"steps_per_shard\": 64", "\"steps_per_shard\": 1", "steps_per_shard"),
        ("\"dims\":[9,", "\"dims\":[900000000000,", "grid"),
        ("\"encoder\"", "\"surprise\"", "surprise"),
        ("\"zstd_level\": 1", "\"zstd_level\": 99", "zstd_level"),
        ("\"sparse\": true", "\"sparse\": 7", "attributes.chronoxel"),
        ("\"stride\":1", "\"stride\":0", "time_tree.stride"),
        ("\"stride\":1", "\"stride\":3", "time_tree.stride"),
        ("\"stride\":1", "\"stride\":4294967292", "time_tree.stride"),
        ("\"stride\":1", "\"stride\":4294967297", "attributes.chronoxel"),
        ("\"stride\":1", "\"stride\":-1", "attributes.chronoxel"),
        ("\"stride\":1", "\"stride\":1,\"more\":1", "more"),
        ("\"stride\":1", "", "stride"),
    ] {
        std::fs::write(path.join("zarr.json"), &original).unwrap();
        edit_header(&path, from, to);
        let problems = problems_of(&path);
        assert!(problems[0].contains(message), "{from} → {to}: {problems:?}");
        assert!(problems[0].contains(if message == "size in bytes" { "c.0" } else { "zarr.json" }));
    }
    for text in ["", "{", "[]", "{\"attributes\": {\"chronoxel\": 7}}", "\u{0}"] {
        std::fs::write(path.join("zarr.json"), text).unwrap();
        assert!(Store::open(&path).is_err());
    }
}

#[test]
fn nodes_that_are_no_tree_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = store(folder.path());
    for nodes in [[1u64, 0], [0, 0], [0, 2], [0, u64::MAX], [0, 1 << 63]] {
        let bytes: Vec<u8> = nodes.iter().flat_map(|n| n.to_le_bytes()).collect();
        std::fs::write(path.join("nodes/L0/c.0"), with_crc(&bytes)).unwrap();
        let problems = problems_of(&path);
        assert!(problems[0].contains("nodes"), "{nodes:?}: {problems:?}");
    }
}

#[test]
fn shard_indexes_that_lie_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = store(folder.path());
    let file = path.join("speed/L0/W1/C1/S0/c.0.0.0");
    let original = std::fs::read(&file).unwrap();
    let index_start = original.len() - 4 - 16 * 64 * 2;
    let len = u64::from_le_bytes(original[index_start + 8..index_start + 16].try_into().unwrap());
    for (offset, len) in [
        (u64::MAX - 1, 5),
        (0, u64::MAX - 1),
        (0, original.len() as u64 * 4),
        (original.len() as u64, 8),
        (1, len),
        (0, len - 1),
        (0, 3),
        (0, 0),
        (u64::MAX, u64::MAX),
        (1 << 40, 1 << 40),
    ] {
        let mut index = original[index_start..original.len() - 4].to_vec();
        index[..8].copy_from_slice(&offset.to_le_bytes());
        index[8..16].copy_from_slice(&len.to_le_bytes());
        std::fs::write(&file, [&original[..index_start], &with_crc(&index)].concat()).unwrap();
        assert!(!problems_of(&path).is_empty(), "offset {offset}, {len} bytes");
    }
}

#[test]
fn chunks_that_expand_without_end_or_decode_to_nonsense_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = store(folder.path());
    let bomb = with_crc(&zstd::bulk::compress(&vec![0u8; 1 << 28], 1).unwrap());
    assert!(bomb.len() < 100_000);
    std::fs::write(path.join("speed/L1/W1/spans/c.0.0.0"), &bomb).unwrap();
    assert!(problems_of(&path).iter().any(|p| p.contains("L1/W1/spans")));

    // A payload whose stage decodes to NaN, with every checksum right.
    let stage = [&f64::NAN.to_le_bytes()[..], &[0u8; 8 + 2 * 1331]].concat();
    for (chunk, message) in [(with_crc(&zstd::bulk::compress(&stage, 1).unwrap()), "offset"), (bomb, "")] {
        let file = path.join("speed/L0/W1/C1/S0/c.0.0.0");
        let original = std::fs::read(&file).unwrap();
        let mut index = original[original.len() - 4 - 16 * 64 * 2..original.len() - 4].to_vec();
        index[..8].copy_from_slice(&0u64.to_le_bytes());
        index[8..16].copy_from_slice(&(chunk.len() as u64).to_le_bytes());
        let store = Store::open(&path).unwrap();
        let span = store.spans(0, 0, 0).unwrap()[0];
        std::fs::write(&file, [&chunk[..], &with_crc(&index)].concat()).unwrap();
        let error = store.read_payload(0, 0, &span).unwrap_err().to_string();
        assert!(error.contains("brick (0, 0, 0), step 0") && error.contains(message), "{error}");
    }
}

#[test]
fn spans_that_contradict_the_header_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = store(folder.path());
    let file = path.join("speed/L0/W1/spans/c.0.0.0");
    let stored = std::fs::read(&file).unwrap();
    let num_bytes = 64 * 2 * 16 * 8;
    let original = zstd::bulk::decompress(&stored[..stored.len() - 4], num_bytes).unwrap();
    // Field, value, and what the first span then says.
    for (field, value, message) in [
        (0, 1.0, "another row"),
        (0, -1.0, "start"),
        (0, 0.5, "start"),
        (1, 0.0, "len"),
        (1, 3.0, "len"),
        (1, f64::NAN, "len"),
        (2, 7.0, "kind"),
        (3, 2.0, "class"),
        (3, 0.0, "missing"),
        (4, 1.0, "outside"),
        (4, 4e9, "outside"),
        (5, 2.0, "outside"),
        (5, 1e300, "payload_node"),
        (6, 1.0, "value"),
        (7, f64::INFINITY, "drawn range"),
        (8, -9.0, "drawn range"),
        (8, 0.5, "drawn range"),
        (9, 1.0, "outside"),
        (9, f64::NAN, "mask_row"),
        (10, 2.0, "outside"),
        (11, 513.0, "statistics"),
        (11, -1.0, "count"),
        (12, 1e9, "statistics"),
        (14, 1e9, "statistics"),
        (15, -1.0, "statistics"),
        (15, 1e9, "statistics"),
    ] {
        let mut bytes = original.clone();
        // Stored field after field.
        let at = field * num_bytes / 16;
        bytes[at..at + 8].copy_from_slice(&f64::to_le_bytes(value));
        std::fs::write(&file, with_crc(&zstd::bulk::compress(&bytes, 1).unwrap())).unwrap();
        let problems = problems_of(&path);
        assert!(problems.iter().any(|p| p.contains(message)), "{field} = {value}: {problems:?}");
    }
    // All NaN: the span is missing.
    let mut bytes = original.clone();
    (0..16).for_each(|field| bytes[field * num_bytes / 16..][..8].fill(0xff));
    std::fs::write(&file, with_crc(&zstd::bulk::compress(&bytes, 1).unwrap())).unwrap();
    assert!(
        problems_of(&path)
            .iter()
            .any(|p| p.contains("no span holds step 0") && p.contains("brick (0, 0, 0)"))
    );
}

/// A value in the statistics of a variable `speed`: level of the time tree, index of the time node, node, field.
struct Edit(u8, usize, usize, usize, f64);

/// Puts a value into a chunk of statistics of three nodes, checksums right.
fn edit_statistics(path: &Path, &Edit(level, index, node, field, value): &Edit) {
    let file = path.join(format!("speed/time/T{level}/c.0.0.0"));
    let stored = std::fs::read(&file).unwrap();
    let num_places = [4, 2, 1][usize::from(level)] * 3;
    let mut bytes = zstd::bulk::decompress(&stored[..stored.len() - 4], num_places * 6 * 8).unwrap();
    // Stored field after field.
    let at = 8 * (field * num_places + index * 3 + node);
    bytes[at..at + 8].copy_from_slice(&value.to_le_bytes());
    std::fs::write(&file, with_crc(&zstd::bulk::compress(&bytes, 1).unwrap())).unwrap();
}

#[test]
fn statistics_that_contradict_each_other_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    // Two bricks and their parent, three steps: four rows of single steps, the last of them blank; two of pairs; one.
    write_store(&path, &with_time_tree(description([9, 8, 8], 3)));
    assert_eq!(problems_of(&path), [] as [&str; 0]);
    let sound = tree_of(&path);
    // Bits of the facts: uniform, static, masked, mask changes. Node 0 has waves, and all have a mask that stays.
    for (edit, message) in [
        (Edit(0, 0, 0, 0, -9.0), "[-9.0, 288.0] of the node's children"),
        (Edit(0, 0, 0, 0, -9.0), "the range of its steps is [-9.0"),
        (Edit(0, 2, 1, 1, 600.0), "the range of its steps is [0.0, 600.0]"),
        (Edit(0, 0, 0, 0, 9.0), "statistics are [9.0"),
        (Edit(0, 0, 0, 1, f64::INFINITY), "statistics are"),
        (Edit(0, 0, 0, 2, f64::NAN), "statistics are"),
        (Edit(0, 0, 0, 3, -1.0), "statistics are"),
        (Edit(0, 0, 0, 3, 9.0), "std is more than half the range"),
        (Edit(0, 0, 0, 4, 1e-9), "temporal_error is not that of facts"),
        (Edit(1, 0, 0, 4, 0.0), "temporal_error is not that of facts"),
        (Edit(0, 0, 0, 5, 16.0), "facts are 16"),
        (Edit(0, 0, 0, 5, 0.5), "facts are 0.5"),
        (Edit(0, 0, 0, 5, -1.0), "facts are -1"),
        (Edit(0, 0, 0, 5, f64::NAN), "facts are NaN"),
        (Edit(0, 0, 0, 5, 0.0), "a single step changes"),
        (Edit(0, 0, 0, 5, 3.0), "they are uniform, but samples differ"),
        (Edit(0, 0, 0, 5, 1.0), "facts contradict each other"),
        (Edit(0, 0, 1, 5, 14.0), "facts contradict each other"),
        (Edit(0, 0, 2, 5, 2.0), "are not those of the node's children"),
        (Edit(1, 0, 0, 5, 0.0), "are not those of the halves of the steps"),
        (Edit(1, 1, 0, 5, 0.0), "temporal_error is not that of facts"),
        (Edit(1, 0, 0, 0, -9.0), "of the halves of the steps"),
        (Edit(2, 0, 2, 1, 600.0), "max 600 are not"),
        (Edit(1, 0, 2, 2, 250.0), "mean 250 is not within"),
        (Edit(2, 0, 2, 3, 0.0), "std 0 is less than"),
        (Edit(0, 3, 1, 5, 0.0), "they lie after the series"),
    ] {
        edit_statistics(&path, &edit);
        let Edit(level, index, node, field, value) = edit;
        let problems = problems_of(&path);
        let named = format!("T{level}/c.0.0.0");
        assert!(
            problems
                .iter()
                .any(|p| p.contains(message) && (p.contains(&named) || p.contains("range of its"))),
            "T{level} row {index}, node {node}, field {field} = {value}: {problems:?}"
        );
        let file = format!("speed/time/T{level}/c.0.0.0");
        let original = sound.iter().find(|(name, _)| name.to_string_lossy() == file).unwrap();
        std::fs::write(path.join(file), &original.1).unwrap();
    }
    assert_eq!(problems_of(&path), [] as [&str; 0]);
}

#[test]
fn statistics_that_are_lost_or_too_large_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = store(folder.path());
    let file = path.join("speed/time/T1/c.0.0.0");
    let bomb = with_crc(&zstd::bulk::compress(&vec![0u8; 1 << 28], 1).unwrap());
    for (bytes, message) in
        [(bomb, "size in bytes is"), (with_crc(b"1234"), "zstd"), (vec![0; 3], "checksum")]
    {
        std::fs::write(&file, bytes).unwrap();
        let problems = problems_of(&path);
        assert!(problems.iter().any(|p| p.contains("time/T1/c.0") && p.contains(message)), "{problems:?}");
    }
    std::fs::remove_file(&file).unwrap();
    let store = Store::open(&path).unwrap();
    let root = chronoxel_core::TimeNode::root(2);
    let error = store.statistics(0, root).unwrap_err().to_string();
    assert!(error.contains("T1/c.0.0.0: file is absent: the statistics"), "{error}");
    assert!(store.statistics(1, root).is_ok() && store.statistics(2, root).is_err());
    // A header that denies them: their files belong to nothing.
    edit_header(&path, "\"time_tree\": {\"stride\":1},\n", "");
    let problems = problems_of(&path);
    assert!(problems.iter().any(|p| p.contains("T0/c.0.0.0: file is unexpected")), "{problems:?}");
    let error = Store::open(&path).unwrap().statistics(0, root).unwrap_err().to_string();
    assert!(error.contains("the store has no statistics"), "{error}");
}

#[test]
fn arguments_out_of_range_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let path = store(folder.path());
    let store = Store::open(&path).unwrap();
    assert!(store.spans(2, 0, 0).is_err() && store.spans(0, 9, 0).is_err() && store.spans(0, 0, 2).is_err());
    let span = store.spans(0, 0, 0).unwrap()[0];
    let foreign = chronoxel_core::SpanRecord { window: 4, ..span };
    assert!(store.read_payload(0, 0, &foreign).is_err() && store.read_mask(0, 7, &span).is_err());
    let at = chronoxel_core::PayloadAddress { row: 5, node: 5 };
    let foreign =
        chronoxel_core::SpanRecord { kind: chronoxel_core::SpanKind::Coded { class: 1, at }, ..span };
    assert!(store.read_payload(0, 0, &foreign).is_err());
    let error = Store::open(&folder.path().join("absent.cxl")).unwrap_err().to_string();
    assert!(error.contains("absent.cxl"), "{error}");
}
