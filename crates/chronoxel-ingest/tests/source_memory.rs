//! What sources say they hold, against what the allocator saw, and what the encoder makes of it.

#[path = "common/files.rs"]
mod files;

use std::alloc::{GlobalAlloc, Layout, System};
use std::fs;
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use chronoxel_ingest::sources::{self, SourceOptions};
use chronoxel_ingest::{EncodeError, EncodeOptions, TimeSeries, encode};
use files::{copy_folder, files_of};

/// The system's allocator, which counts the bytes in use and remembers the most.
struct Counted;

static IN_USE: AtomicUsize = AtomicUsize::new(0);
static MOST: AtomicUsize = AtomicUsize::new(0);

fn add(bytes: usize) {
    let now = IN_USE.fetch_add(bytes, Ordering::Relaxed) + bytes;
    MOST.fetch_max(now, Ordering::Relaxed);
}

// SAFETY: every call is handed to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counted {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        add(layout.size());
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        add(layout.size());
        // SAFETY: the caller keeps the contract of `alloc_zeroed`.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        IN_USE.fetch_sub(layout.size(), Ordering::Relaxed);
        add(size);
        // SAFETY: the caller keeps the contract of `realloc`.
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        IN_USE.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counted = Counted;

/// One test at a time: the allocator counts for all.
static TURN: Mutex<()> = Mutex::new(());

const EDGE: usize = 64;
const NUM_STEPS: usize = 4;
const STEP_SAMPLES: usize = EDGE * EDGE * EDGE;

fn open(input: &str, memory_bytes: Option<u64>) -> Box<dyn TimeSeries> {
    let options = SourceOptions { memory_bytes, ..SourceOptions::default() };
    sources::open(&[input.to_owned()], &options).unwrap()
}

/// The most bytes in use beyond those before, while a series is read slice by slice, less those of the slice.
fn most_held(series: &mut dyn TimeSeries) -> u64 {
    let before = IN_USE.load(Ordering::Relaxed);
    MOST.store(before, Ordering::Relaxed);
    let mut slice_bytes = 0;
    for step in 0..series.times().num_steps() {
        let num_slices = series.grid().dims[2];
        let mut reader = series.open_step(0, step).unwrap();
        for _ in 0..num_slices {
            slice_bytes = reader.read_slices(1).unwrap().len() as u64 * 4;
        }
    }
    ((MOST.load(Ordering::Relaxed) - before) as u64).saturating_sub(slice_bytes)
}

/// Reads a series and checks that it holds what it says: no more than a few buffers above, no less than `share`.
fn check_held(name: &str, series: &mut dyn TimeSeries, share: f64) {
    let said = series.working_bytes();
    let held = most_held(series);
    assert!(held <= said + (600 << 10), "{name}: {held} bytes held, {said} said");
    assert!(held as f64 >= share * said as f64, "{name}: {held} bytes held, {said} said");
}

/// A sample of the arrays below.
fn sample(t: usize, z: usize, y: usize, x: usize) -> f32 {
    ((t * 31 + z * 17 + y * 7 + x * 3) % 251) as f32
}

/// Writes `[t, z, y, x]` without compression, in chunks of several steps and slices.
fn write_zarr(folder: &Path, [steps, slices]: [usize; 2]) {
    fs::create_dir_all(folder).unwrap();
    let metadata = format!(
        r#"{{"zarr_format":3,"node_type":"array","shape":[{NUM_STEPS},{EDGE},{EDGE},{EDGE}],"data_type":"float32",
        "chunk_grid":{{"name":"regular","configuration":{{"chunk_shape":[{steps},{slices},{EDGE},{EDGE}]}}}},
        "chunk_key_encoding":{{"name":"default","configuration":{{"separator":"."}}}},"fill_value":0,
        "codecs":[{{"name":"bytes","configuration":{{"endian":"little"}}}}],"attributes":{{}}}}"#
    );
    fs::write(folder.join("zarr.json"), metadata).unwrap();
    for chunk_t in 0..NUM_STEPS / steps {
        for chunk_z in 0..EDGE / slices {
            let mut bytes = Vec::new();
            for t in 0..steps {
                for z in 0..slices {
                    let value =
                        |i: usize| sample(chunk_t * steps + t, chunk_z * slices + z, i / EDGE, i % EDGE);
                    bytes.extend((0..EDGE * EDGE).flat_map(|i| value(i).to_le_bytes()));
                }
            }
            fs::write(folder.join(format!("c.{chunk_t}.{chunk_z}.0.0")), bytes).unwrap();
        }
    }
}

/// Writes the same samples as NumPy does for an array in Fortran order.
fn write_fortran(path: &Path) {
    let header = format!(
        "{{'descr': '<f4', 'fortran_order': True, 'shape': ({NUM_STEPS}, {EDGE}, {EDGE}, {EDGE}), }}{:>9}",
        '\n'
    );
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    for point in 0..STEP_SAMPLES {
        let [z, y, x] = [point % EDGE, point / EDGE % EDGE, point / EDGE / EDGE];
        bytes.extend((0..NUM_STEPS).flat_map(|t| sample(t, z, y, x).to_le_bytes()));
    }
    fs::write(path, bytes).unwrap();
}

#[test]
fn sources_hold_what_they_say() {
    let _turn = TURN.lock().unwrap_or_else(|e| e.into_inner());
    let folder = tempfile::tempdir().unwrap();
    let name = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    write_zarr(&folder.path().join("tall.zarr"), [1, EDGE]);
    write_zarr(&folder.path().join("long.zarr"), [NUM_STEPS, EDGE / 2]);
    write_fortran(&folder.path().join("f.npy"));
    let step_bytes = 4 * STEP_SAMPLES as u64;
    // A layer, the bytes of a chunk and its samples; long chunks keep all steps where they may.
    let tall = open(&name("tall.zarr"), None).working_bytes();
    assert_eq!(tall, 3 * step_bytes);
    let long = open(&name("long.zarr"), None).working_bytes();
    assert_eq!(long, step_bytes / 2 + 2 * (2 * step_bytes) + 4 * step_bytes);
    let scarce = open(&name("long.zarr"), Some(15 * step_bytes)).working_bytes();
    assert_eq!(scarce, step_bytes / 2 + 2 * (2 * step_bytes));
    let fortran = open(&name("f.npy"), Some(step_bytes)).working_bytes();
    assert!((step_bytes / 4..step_bytes / 4 + (600 << 10)).contains(&fortran), "{fortran}");
    let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
    pool.install(|| {
        for (input, memory, share) in [
            (name("tall.zarr"), None, 0.9),
            (name("long.zarr"), None, 0.9),
            (name("long.zarr"), Some(15 * step_bytes), 0.9),
            (name("f.npy"), None, 0.7),
            (name("f.npy"), Some(step_bytes), 0.4),
            ("sim:plume?dims=40x48x36&steps=3".to_owned(), None, 0.9),
            ("sim:vortex?dims=64x48x40&steps=3".to_owned(), None, 0.8),
            ("sim:shockbubble?dims=80x32x32&steps=3".to_owned(), None, 0.9),
        ] {
            check_held(&input, &mut *open(&input, memory), share);
        }
    });
}

#[test]
fn a_series_of_arrays_keeps_the_layers_of_one() {
    let _turn = TURN.lock().unwrap_or_else(|e| e.into_inner());
    let folder = tempfile::tempdir().unwrap();
    let first = folder.path().join("a0.zarr");
    write_zarr(&first, [NUM_STEPS, EDGE]);
    ["a1.zarr", "a2.zarr"].iter().for_each(|name| copy_folder(&first, &folder.path().join(name)));
    let input = folder.path().join("a*.zarr").to_string_lossy().into_owned();
    let mut series = open(&input, None);
    assert_eq!(series.times().num_steps(), 3 * NUM_STEPS);
    check_held(&input, &mut *series, 0.9);
}

/// Encodes with some memory.
fn encoded(input: &str, output: &Path, memory_bytes: u64) -> Result<(), EncodeError> {
    let options = EncodeOptions { brick_edge: 8, memory_bytes, ..EncodeOptions::default() };
    encode(&mut *open(input, Some(memory_bytes)), output, &options, &mut |_| {}).map(|_| ())
}

#[test]
fn a_layer_of_chunks_that_does_not_fit_is_refused_with_the_figure() {
    let _turn = TURN.lock().unwrap_or_else(|e| e.into_inner());
    let folder = tempfile::tempdir().unwrap();
    let tall = folder.path().join("tall/v.zarr");
    let flat = folder.path().join("flat/v.zarr");
    write_zarr(&tall, [1, EDGE]);
    write_zarr(&flat, [1, 4]);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let run = |input: &Path, name: &str, memory| {
        pool.install(|| encoded(&input.to_string_lossy(), &folder.path().join(name), memory))
    };
    let error = run(&tall, "a.cxl", 1).unwrap_err();
    let EncodeError::Memory { needed, source_bytes, .. } = error else { panic!("{error}") };
    assert_eq!(source_bytes, 3 * 4 * STEP_SAMPLES as u64);
    assert!(error.to_string().contains("3145728 of them for the source"), "{error}");
    assert!(matches!(run(&tall, "a.cxl", needed - 1), Err(EncodeError::Memory { .. })));
    // The same samples in flat chunks fit where tall ones do not.
    run(&flat, "flat.cxl", needed - 1).unwrap();
    run(&tall, "tall.cxl", needed).unwrap();
    assert!(files_of(&folder.path().join("flat.cxl")) == files_of(&folder.path().join("tall.cxl")));
}

#[test]
fn memory_changes_no_byte_of_an_array_in_fortran_order() {
    let _turn = TURN.lock().unwrap_or_else(|e| e.into_inner());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("f.npy").to_string_lossy().into_owned();
    write_fortran(Path::new(&path));
    let zarr = folder.path().join("f.zarr");
    write_zarr(&zarr, [1, 4]);
    let [small, large, other] = ["small.cxl", "large.cxl", "zarr.cxl"].map(|name| folder.path().join(name));
    let Err(EncodeError::Memory { .. }) = encoded(&path, &small, 1 << 20) else {
        panic!("1 MiB is too little")
    };
    let options = |memory_bytes| EncodeOptions { brick_edge: 8, memory_bytes, ..EncodeOptions::default() };
    // Room for two slices in one pass, against all of them.
    let mut in_passes = open(&path, Some(4 * 2 * 4 * (EDGE * EDGE) as u64));
    encode(&mut *in_passes, &small, &options(1 << 28), &mut |_| {}).unwrap();
    encoded(&path, &large, 1 << 30).unwrap();
    encoded(&zarr.to_string_lossy(), &other, 1 << 30).unwrap();
    let expected = files_of(&small);
    assert!(expected == files_of(&large) && expected == files_of(&other));
}

/// Writes a legacy VTK file with the hexahedra of a lattice.
fn write_hexahedra(path: &Path, edge: usize) {
    let mut bytes = format!(
        "# vtk DataFile Version 3.0\nmesh\nBINARY\nDATASET UNSTRUCTURED_GRID\nPOINTS {} float\n",
        edge.pow(3)
    )
    .into_bytes();
    let points = || (0..edge.pow(3)).map(|p| [p % edge, p / edge % edge, p / (edge * edge)]);
    bytes.extend(points().flatten().flat_map(|n| (n as f32).to_be_bytes()));
    let num_cells = (edge - 1).pow(3);
    bytes.extend(format!("\nCELLS {num_cells} {}\n", 9 * num_cells).into_bytes());
    for [i, j, k] in points().filter(|p| p.iter().all(|n| n + 1 < edge)) {
        let at = |i: usize, j: usize, k: usize| i + edge * (j + edge * k);
        let face = |k| [at(i, j, k), at(i + 1, j, k), at(i + 1, j + 1, k), at(i, j + 1, k)];
        let numbers = [8].into_iter().chain(face(k)).chain(face(k + 1));
        bytes.extend(numbers.flat_map(|n| (n as i32).to_be_bytes()));
    }
    bytes.extend(format!("\nCELL_TYPES {num_cells}\n").into_bytes());
    bytes.extend((0..num_cells).flat_map(|_| 12i32.to_be_bytes()));
    bytes.extend(
        format!("\nPOINT_DATA {}\nSCALARS s float\nLOOKUP_TABLE default\n", edge.pow(3)).into_bytes(),
    );
    bytes.extend(points().flat_map(|p| (p[0] as f32).to_be_bytes()));
    fs::write(path, bytes).unwrap();
}

/// A mesh in a file holds what it says while it is opened, walked and read, besides what it hands over.
#[test]
fn a_mesh_says_what_it_holds() {
    let _turn = TURN.lock().unwrap_or_else(|e| e.into_inner());
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("mesh.vtk");
    write_hexahedra(&file, 40);
    let before = IN_USE.load(Ordering::Relaxed);
    MOST.store(before, Ordering::Relaxed);
    let held = || (MOST.load(Ordering::Relaxed) - before) as u64;
    let mut mesh =
        sources::open_mesh(&[file.to_string_lossy().into_owned()], &SourceOptions::default()).unwrap();
    let opened = held();
    let census = mesh.for_each_tetrahedron(&mut |_| Ok(())).unwrap();
    assert_eq!(census.num_tetrahedra, 5 * 39 * 39 * 39);
    let said = mesh.working_bytes();
    assert!(held() <= said + (600 << 10), "{} bytes held, {said} said", held());
    assert!(opened >= said / 2, "{opened} bytes held, {said} said");
    drop(mesh.points().unwrap());
    drop(mesh.read_values(0, 0).unwrap());
    let after = (IN_USE.load(Ordering::Relaxed) - before) as u64;
    assert!(after < 200 << 10, "{after} bytes are held when values are read");
}

/// A generated mesh of any size holds two layers of points while it is walked.
#[test]
fn a_generated_mesh_holds_layers() {
    let _turn = TURN.lock().unwrap_or_else(|e| e.into_inner());
    let source = ["sim:twist?dims=40x40x400&steps=2".to_owned()];
    let mut mesh = sources::open_mesh(&source, &SourceOptions::default()).unwrap();
    let before = IN_USE.load(Ordering::Relaxed);
    MOST.store(before, Ordering::Relaxed);
    mesh.for_each_tetrahedron(&mut |_| Ok(())).unwrap();
    let held = (MOST.load(Ordering::Relaxed) - before) as u64;
    assert!(held <= mesh.working_bytes() + (64 << 10), "{held} bytes held");
}
