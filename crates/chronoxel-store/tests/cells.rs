//! Stores of cells: what is written is read, an interruption changes no byte, and damage anywhere is found.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

use chronoxel_codec::{Indices, Payload, Stage, Table};
use chronoxel_core::{BitMask, SampleType, SpanStatistics, TimeAxis};
use chronoxel_store::{
    CellDescription, CellGeometry, CellSpanWrite, CellStore, CellStoreWriter, CellVariableDescription, Store,
    verify_cells,
};

/// Points and tetrahedra: a fan around an edge.
fn geometry() -> CellGeometry {
    let turn = |i: usize| i as f64 * 0.5;
    let rim = (0..11).map(|i| [turn(i).cos(), turn(i).sin(), 0.125 * i as f64]);
    let points = [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]].into_iter().chain(rim).collect();
    CellGeometry { points, tetrahedra: (2..12).map(|i| [0, 1, i, i + 1]).collect() }
}

const NUM_POINTS: usize = 13;

fn description(num_steps: usize) -> CellDescription {
    let variable = |name: &str, sample_type, fill_value| CellVariableDescription {
        name: name.into(),
        units: "K".into(),
        sample_type,
        fill_value,
    };
    CellDescription {
        kind: "tetrahedral".into(),
        times: TimeAxis::regular(num_steps, 0.5, "s").unwrap(),
        variables: vec![
            variable("points", SampleType::F32, None),
            variable("u8", SampleType::U8, Some(255.0)),
        ],
        zstd_level: 3,
        encoder: serde_json::json!({ "entries": 4 }),
    }
}

/// What is decoded at a point and step of the first variable: 10 + point + 0.5 (step mod 4), of every span of it.
fn value(point: usize, step: usize) -> f32 {
    10.0 + point as f32 + 0.5 * (step % 4) as f32
}

fn payload(num_steps: usize) -> Payload {
    let affine = Table::Affine { offset: 10.0, scale: 1.0 };
    let entries = (0..num_steps).flat_map(|step| [(step % 4) as u16; 2]).collect();
    let listed = Table::Listed { offset: 0.0, scale: 0.5, num_rows: num_steps, entries };
    let points = 0..NUM_POINTS as u16;
    Payload {
        stages: vec![
            Stage { indices: Indices::U16(points.clone().collect()), table: affine, shift: 0 },
            Stage { indices: Indices::U8(points.map(|p| (p % 2) as u8).collect()), table: listed, shift: 0 },
        ],
    }
}

fn span(start: usize, window: u32, num_steps: usize, missing: Option<BitMask>) -> CellSpanWrite {
    let present: Vec<usize> =
        (0..NUM_POINTS).filter(|&p| missing.as_ref().is_none_or(|mask| !mask.get(p))).collect();
    let values = || {
        (start..start + num_steps)
            .flat_map(|step| present.iter().map(move |&p| f64::from(value(p, step - start))))
    };
    let count = (present.len() * num_steps) as u64;
    let [low, high] = [values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max)];
    let nan = f64::NAN;
    let (drawn_range, statistics, errors) = match count {
        0 => ([nan; 2], SpanStatistics { count, min: nan, max: nan, mean: nan, std: nan }, nan),
        _ => {
            let mean = values().sum::<f64>() / count as f64;
            ([low, high], SpanStatistics { count, min: low, max: high, mean, std: 1.0 }, 0.125)
        }
    };
    CellSpanWrite {
        start: start as u32,
        window,
        payload: payload(num_steps),
        missing,
        drawn_range,
        statistics,
        rms_error: errors,
        max_error: errors,
    }
}

/// The spans of a block of both variables: the first whole, the second in parts with masks.
fn blocks_of(block: usize, num_steps: usize) -> [Vec<CellSpanWrite>; 2] {
    let (start, end) = (64 * block, num_steps.min(64 * block + 64));
    let mask = |point: usize| Some(BitMask::from_flags((0..NUM_POINTS).map(|p| p <= point)));
    let first = vec![span(start, 64, end - start, None)];
    let mut second = vec![span(start, 4, 4.min(end - start), mask(3))];
    let parts = [(4, 4, mask(3)), (8, 8, mask(NUM_POINTS)), (16, 16, None), (32, 32, mask(0))];
    for (from, window, missing) in parts {
        if start + from < end {
            second.push(span(start + from, window, (window as usize).min(end - start - from), missing));
        }
    }
    [first, second]
}

fn put_block(writer: &mut CellStoreWriter, block: usize, num_steps: usize) {
    for (variable, spans) in blocks_of(block, num_steps).iter().enumerate() {
        writer.put(variable, spans).unwrap();
    }
    writer.commit_block().unwrap();
}

fn write(path: &Path, num_steps: usize) {
    let mut writer = CellStoreWriter::create(path, &description(num_steps), &geometry(), false).unwrap();
    (0..num_steps.div_ceil(64)).for_each(|block| put_block(&mut writer, block, num_steps));
    writer.finish().unwrap();
}

fn files_of(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut found, mut folders) = (BTreeMap::new(), vec![root.to_owned()]);
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => {
                    found.insert(path.strip_prefix(root).unwrap().to_owned(), fs::read(&path).unwrap());
                }
            }
        }
    }
    found
}

fn problems_of(path: &Path) -> Vec<String> {
    match CellStore::open(path) {
        Ok(store) => verify_cells(&store, &|_, _| {}).problems,
        Err(error) => vec![error.to_string()],
    }
}

#[test]
fn what_is_written_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write(&path, 100);
    let store = CellStore::open(&path).unwrap();
    assert!(store.is_complete() && store.path() == path);
    let header = store.header();
    assert_eq!((header.num_points, header.num_tetrahedra, header.num_steps_finished), (13, 10, 100));
    assert_eq!(header.raw_bytes(), 13 * 5 * 100);
    // The name of an array of the store's own is no folder of a variable.
    assert_eq!(header.variables[0].folder, "variable-0");
    assert_eq!((header.variables[0].min, header.variables[0].max), (Some(10.0), Some(23.5)));
    assert_eq!(store.read_geometry().unwrap(), geometry());
    assert_eq!(header.bounds[1][2], 1.25);
    let mut values = vec![0.0; NUM_POINTS];
    for step in 0..100 {
        let record = store.span_at(0, step).unwrap();
        assert_eq!((record.start, record.len), if step < 64 { (0, 64) } else { (64, 36) });
        let payload = store.read_span(0, &record).unwrap();
        payload.decode(step, &mut values).unwrap();
        let expected: Vec<f32> = (0..NUM_POINTS).map(|p| value(p, (step - record.start) as usize)).collect();
        assert!(payload.missing.is_none());
        // Both entries of a row are alike, whatever the index.
        assert_eq!(values, expected, "{step}");
        assert!(payload.decode(record.start + record.len, &mut values).is_err());
        assert!(payload.decode(step, &mut values[1..]).is_err());

        let record = store.span_at(1, step).unwrap();
        store.read_span(1, &record).unwrap().decode(step, &mut values).unwrap();
        let num_missing = values.iter().filter(|v| v.is_nan()).count();
        let expected = match step % 64 {
            0..8 => 4,
            8..16 => NUM_POINTS,
            16..32 => 0,
            _ => 1,
        };
        assert_eq!(num_missing, expected, "{step}");
    }
    assert!(store.span_at(0, 100).is_err() && store.span_at(2, 0).is_err());
    let mut foreign = store.span_at(0, 0).unwrap();
    foreign.len = 3;
    assert!(store.read_span(0, &foreign).is_err());
    // Of the parts with masks, equal ones in a row are stored once.
    assert_eq!((header.totals.spans, header.totals.masked, header.totals.masks), (12, 8, 6));
    assert!(store.bytes_read() > 0 && store.stored_bytes().unwrap() > header.totals.data_bytes);
    assert_eq!(problems_of(&path), [] as [&str; 0]);
}

/// The committed store of this version, which is read forever. Made by [`write`] with `CHRONOXEL_MAKE_FIXTURE` set.
#[test]
fn the_fixture_is_read() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/cells/v1.cxl");
    if std::env::var_os("CHRONOXEL_MAKE_FIXTURE").is_some() {
        let _ = fs::remove_dir_all(&path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        write(&path, 70);
    }
    assert_eq!(problems_of(&path), [] as [&str; 0]);
    let store = CellStore::open(&path).unwrap();
    assert_eq!(store.read_geometry().unwrap(), geometry());
    let mut values = vec![0.0; NUM_POINTS];
    for step in 0..70 {
        let record = store.span_at(0, step).unwrap();
        store.read_span(0, &record).unwrap().decode(step, &mut values).unwrap();
        let expected: Vec<f32> = (0..NUM_POINTS).map(|p| value(p, step as usize % 64)).collect();
        assert_eq!(values, expected);
    }
    // The worked example of the format's page.
    let record = store.span_at(1, 69).unwrap();
    assert_eq!((record.start, record.len, record.class, record.mask), (68, 2, 4, Some(64)));
    store.read_span(1, &record).unwrap().decode(69, &mut values).unwrap();
    assert_eq!(values[5], 15.5);
    assert!(values[3].is_nan() && !values[4].is_nan());
}

#[test]
fn a_store_within_a_store_of_bricks_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let bricks = folder.path().join("a.cxl");
    fs::create_dir(&bricks).unwrap();
    write(&bricks.join("_cells"), 3);
    let store = CellStore::open(&bricks).unwrap();
    assert_eq!(store.path(), bricks.join("_cells"));
    assert_eq!(CellStore::find(&bricks), Some(bricks.join("_cells")));
    // What opens bricks says what there is instead, and the other way round.
    let error = Store::open(&bricks.join("_cells")).unwrap_err().to_string();
    assert!(error.contains("--method cells"), "{error}");
    fs::remove_dir_all(bricks.join("_cells")).unwrap();
    let error = CellStore::open(&bricks).unwrap_err().to_string();
    assert!(error.contains("not a Chronoxel store"), "{error}");
    assert!(CellStore::open(&folder.path().join("b.cxl")).is_err());
}

#[test]
fn a_resume_gives_the_bytes_of_an_uninterrupted_run() {
    let folder = tempfile::tempdir().unwrap();
    let whole = folder.path().join("whole.cxl");
    write(&whole, 200);
    let path = folder.path().join("a.cxl");
    for num_before in 0..4 {
        let mut writer = CellStoreWriter::create(&path, &description(200), &geometry(), false).unwrap();
        (0..num_before).for_each(|block| put_block(&mut writer, block, 200));
        // A block that was begun.
        writer.put(1, &blocks_of(num_before, 200)[1]).unwrap();
        drop(writer);
        assert_eq!(problems_of(&path), [] as [&str; 0]);
        assert_eq!(CellStore::open(&path).unwrap().header().num_steps_finished as usize, 64 * num_before);
        let other = CellStoreWriter::resume(&path, &description(199), &geometry()).unwrap_err();
        assert!(other.to_string().contains("other options"), "{other}");
        let (mut writer, first) = CellStoreWriter::resume(&path, &description(200), &geometry()).unwrap();
        assert_eq!(first as usize, 64 * num_before);
        (num_before..4).for_each(|block| put_block(&mut writer, block, 200));
        writer.finish().unwrap();
        assert!(files_of(&path) == files_of(&whole), "after {num_before} blocks");
        let again = CellStoreWriter::create(&path, &description(200), &geometry(), false).unwrap_err();
        assert!(again.to_string().contains("overwrite"), "{again}");
        fs::remove_dir_all(&path).unwrap();
    }
    let mut writer = CellStoreWriter::create(&path, &description(200), &geometry(), false).unwrap();
    put_block(&mut writer, 0, 200);
    assert_eq!(writer.abandon().unwrap(), Some(folder.path().join("a.partial.cxl")));
    let (writer, first) = CellStoreWriter::resume(&path, &description(200), &geometry()).unwrap();
    assert_eq!(first, 64);
    drop(writer);
    fs::remove_dir_all(&path).unwrap();
    let writer = CellStoreWriter::create(&path, &description(200), &geometry(), false).unwrap();
    assert_eq!(writer.abandon().unwrap(), None);
    assert!(!path.exists());
}

#[test]
fn what_does_not_fit_together_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    let create = |geometry: &CellGeometry| CellStoreWriter::create(&path, &description(70), geometry, true);
    let mut wrong = geometry();
    wrong.tetrahedra[3][2] = 13;
    assert!(create(&wrong).unwrap_err().to_string().contains("13 points"));
    wrong = geometry();
    wrong.points[4][1] = f64::NAN;
    assert!(create(&wrong).is_err());
    wrong.tetrahedra.clear();
    assert!(create(&wrong).is_err());
    let mut writer = create(&geometry()).unwrap();
    assert!(writer.commit_block().is_err());
    assert!(writer.put(0, &[span(0, 32, 32, None)]).is_err(), "32 steps are missing");
    assert!(writer.put(0, &[span(0, 3, 3, None)]).is_err());
    assert!(writer.put(0, &[span(1, 64, 64, None)]).is_err());
    let mut short = span(0, 64, 64, None);
    short.payload.stages[0].indices = Indices::U16(vec![0; 12]);
    assert!(writer.put(0, &[short]).is_err());
    assert!(writer.put(2, &[span(0, 64, 64, None)]).is_err());
    writer.put(0, &[span(0, 64, 64, None)]).unwrap();
    assert!(writer.put(0, &[span(0, 64, 64, None)]).is_err(), "twice");
    assert!(writer.finish().is_err());
}

#[test]
fn a_flipped_byte_anywhere_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write(&path, 70);
    let mut num_flips = 0;
    for (name, bytes) in files_of(&path) {
        let file = path.join(&name);
        let stride = (bytes.len() / 6).max(1);
        let near_end = bytes.len().saturating_sub(8);
        for at in (0..bytes.len()).filter(|at| at % stride == 0 || *at >= near_end) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 1 << (at % 8);
            fs::write(&file, &damaged).unwrap();
            let problems = problems_of(&path);
            assert!(!problems.is_empty(), "byte {at} of {}", name.display());
            assert!(problems.iter().all(|problem| !problem.contains('\n')), "{problems:?}");
            num_flips += 1;
        }
        for len in [0, 1, bytes.len() / 2, bytes.len() - 1] {
            fs::write(&file, &bytes[..len]).unwrap();
            assert!(!problems_of(&path).is_empty(), "{} cut to {len}", name.display());
        }
        fs::remove_file(&file).unwrap();
        assert!(!problems_of(&path).is_empty(), "{} lost", name.display());
        fs::write(&file, &bytes).unwrap();
    }
    assert!(num_flips > 400, "{num_flips}");
    assert_eq!(problems_of(&path), [] as [&str; 0]);
    fs::write(path.join("variable-0/C0/S0/c.2.0"), "x").unwrap();
    assert!(problems_of(&path)[0].contains("unexpected"));
}

/// Reads everything there is, and says nothing: errors are as good as values, a panic is not.
fn read_all(path: &Path) {
    let Ok(store) = CellStore::open(path) else { return };
    let _ = store.read_geometry();
    for (variable, step) in (0..2).flat_map(|v| (0..70).step_by(3).map(move |s| (v, s))) {
        let Ok(record) = store.span_at(variable, step) else { continue };
        let Ok(payload) = store.read_span(variable, &record) else { continue };
        let mut values = vec![0.0; payload.payload.stages[0].indices.len()];
        let _ = payload.decode(step, &mut values);
    }
    let _ = verify_cells(&store, &|_, _| {});
}

#[test]
fn a_header_that_lies_is_an_error_and_never_a_panic() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write(&path, 70);
    let header = fs::read_to_string(path.join("zarr.json")).unwrap();
    let lies = [
        ("\"num_points\": 13", "\"num_points\": 4294967295"),
        ("\"num_points\": 13", "\"num_points\": 0"),
        ("\"num_points\": 13", "\"num_points\": 12"),
        ("\"num_tetrahedra\": 10", "\"num_tetrahedra\": 4294967295"),
        ("\"num_tetrahedra\": 10", "\"num_tetrahedra\": 9"),
        ("\"num_steps_finished\": 70", "\"num_steps_finished\": 71"),
        ("\"num_steps_finished\": 70", "\"num_steps_finished\": 3"),
        ("\"window\":64", "\"window\":32"),
        ("\"window\":64", "\"window\":0"),
        ("\"window\":4}", "\"window\":8}"),
        ("\"index_bits\":16", "\"index_bits\":8"),
        ("\"index_bits\":16", "\"index_bits\":17"),
        ("\"rows\":64", "\"rows\":63"),
        ("\"entries\":2", "\"entries\":3"),
        ("\"shift\":0", "\"shift\":7"),
        ("variable-0", "../x"),
        ("\"kind\": \"tetrahedral\"", "\"kind\": \"cubic\""),
        ("\"version\": 1", "\"version\": 2"),
    ];
    for (field, lie) in lies {
        let changed = header.replacen(field, lie, 1);
        assert_ne!(changed, header, "{field}");
        fs::write(path.join("zarr.json"), with_checksum(&changed)).unwrap();
        assert!(!problems_of(&path).is_empty(), "{lie}");
        read_all(&path);
    }
}

/// The text of a header with the checksum that belongs to it.
fn with_checksum(text: &str) -> String {
    let key = "\"z_crc32c\": \"";
    let at = text.rfind(key).unwrap() + key.len();
    let blank = [&text[..at], "00000000", &text[at + 8..]].concat();
    let crc = format!("{:08x}", crc32c::crc32c(blank.as_bytes()));
    [&blank[..at], &crc, &blank[at + 8..]].concat()
}

#[test]
fn bytes_of_any_kind_are_errors_and_never_a_panic() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write(&path, 70);
    // Numbers that look random and are always the same.
    let mut state = 9u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize
    };
    let files = files_of(&path);
    for round in 0..300 {
        let (name, bytes) = files.iter().nth(random() % files.len()).unwrap();
        let mut damaged = bytes.clone();
        match round % 3 {
            0 => damaged.truncate(random() % bytes.len()),
            1 => (0..1 + random() % 40).for_each(|_| damaged[random() % bytes.len()] = random() as u8),
            _ => damaged.extend((0..random() % 200).map(|i| (i * 7) as u8)),
        }
        fs::write(path.join(name), &damaged).unwrap();
        read_all(&path);
        fs::write(path.join(name), bytes).unwrap();
    }
}

/// A zstd frame and its checksum.
fn packed(bytes: &[u8]) -> Vec<u8> {
    let mut stored = zstd::bulk::compress(bytes, 3).unwrap();
    stored.extend(crc32c::crc32c(&stored).to_le_bytes());
    stored
}

fn unpacked(stored: &[u8]) -> Vec<u8> {
    zstd::bulk::decompress(&stored[..stored.len() - 4], 1 << 20).unwrap()
}

#[test]
fn spans_that_lie_are_errors_and_never_a_panic() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write(&path, 70);
    let file = path.join("u8/spans/c.0.0");
    let whole = fs::read(&file).unwrap();
    let bytes = unpacked(&whole);
    assert_eq!(bytes.len(), 64 * 13 * 8);
    let lies = [-1.0, 0.5, 1.0, 3.0, 64.0, 1e9, 1e300, f64::NAN, f64::INFINITY];
    for (field, step) in (0..13).flat_map(|field| [0, 1, 8].map(|step| (field, step))) {
        for lie in lies {
            let mut changed = bytes.clone();
            changed[8 * (64 * field + step)..][..8].copy_from_slice(&lie.to_le_bytes());
            if changed != bytes {
                fs::write(&file, packed(&changed)).unwrap();
                // A mean, a deviation or an error of other than the largest value is beyond what a store can tell of itself.
                let is_known = field < 9 && !lie.is_nan();
                let problems = problems_of(&path);
                assert!(!is_known || !problems.is_empty(), "field {field} of step {step} is {lie}");
            }
        }
    }
    fs::write(&file, &whole).unwrap();
    assert_eq!(problems_of(&path), [] as [&str; 0]);
}

#[test]
fn stages_that_lie_are_errors_and_never_a_panic() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    write(&path, 70);
    // One slot, its index, and the checksum of that.
    for name in ["variable-0/C0/S0/c.0.0", "variable-0/C0/S1/c.0.0"] {
        let file = path.join(name);
        let whole = fs::read(&file).unwrap();
        let bytes = unpacked(&whole[..whole.len() - 20]);
        for at in 0..bytes.len() {
            for value in [0, 1, 0x7f, 0xff] {
                let mut changed = bytes.clone();
                changed[at] = value;
                if changed == bytes {
                    continue;
                }
                let mut stored = packed(&changed);
                let index = [0, stored.len() as u64].map(u64::to_le_bytes);
                stored.extend(index.as_flattened());
                stored.extend(crc32c::crc32c(index.as_flattened()).to_le_bytes());
                fs::write(&file, stored).unwrap();
                if let Ok(store) = CellStore::open(&path) {
                    let read = store.read_span(0, &store.span_at(0, 3).unwrap());
                    let _ = read.map(|payload| payload.decode(3, &mut [0.0; NUM_POINTS]));
                }
            }
        }
        let mut absurd = bytes.clone();
        absurd[..8].copy_from_slice(&f64::NAN.to_le_bytes());
        let mut stored = packed(&absurd);
        let index = [0, stored.len() as u64].map(u64::to_le_bytes);
        stored.extend(index.as_flattened());
        stored.extend(crc32c::crc32c(index.as_flattened()).to_le_bytes());
        fs::write(&file, stored).unwrap();
        assert!(problems_of(&path).iter().any(|problem| problem.contains("offset")), "{name}");
        fs::write(&file, &whole).unwrap();
    }
}
