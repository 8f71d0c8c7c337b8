//! Every fixture cut short at many lengths and with bytes flipped at many places: reading gives samples or an error of
//! one line, never a panic, and asks for no more memory than the file can fill.

use std::alloc::{GlobalAlloc, Layout, System};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use chronoxel_ingest::sources::{self, SourceOptions};
use chronoxel_ingest::{MeshSeries, Opened, SourceError};

use crate::fixtures::path;

/// The largest allocation that any fixture, broken or not, may lead to.
const MAX_ALLOCATION: usize = 32 << 20;

/// More samples than this are not read: a broken Zarr array may be large and all absent.
const MAX_SAMPLES: usize = 1 << 20;

/// Cuts and flipped places per file.
const NUM_CUTS: usize = 25;
const NUM_FLIPS: usize = 80;

/// The system's allocator, which remembers the largest request.
struct Watched;

static LARGEST: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call is handed to the system's allocator unchanged.
unsafe impl GlobalAlloc for Watched {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller keeps the contract of `alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller keeps the contract of `alloc_zeroed`.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        LARGEST.fetch_max(size, Ordering::Relaxed);
        // SAFETY: the caller keeps the contract of `realloc`.
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller keeps the contract of `dealloc`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Watched = Watched;

/// What is opened for a file: a solution of PLOT3D takes its grid from the file beside it.
fn inputs(input: &Path) -> Vec<String> {
    let paths = match input.extension().is_some_and(|extension| extension == "q" || extension == "xyz") {
        true => vec![input.with_extension("xyz"), input.with_extension("q")],
        false => vec![input.to_owned()],
    };
    paths.iter().map(|path| path.to_string_lossy().into_owned()).collect()
}

/// Reads all of a mesh.
fn read_mesh(mesh: &mut dyn MeshSeries) -> Result<(), SourceError> {
    let num_points = mesh.num_points() as u32;
    assert_eq!(mesh.points()?.len(), num_points as usize);
    mesh.for_each_tetrahedron(&mut |corners| {
        assert!(corners.iter().all(|corner| *corner < num_points));
        Ok(())
    })?;
    for variable in 0..mesh.variables().len() {
        for step in 0..mesh.times().num_steps().min(4) {
            assert_eq!(mesh.read_values(variable, step)?.len(), num_points as usize);
        }
    }
    Ok(())
}

/// Opens a source and reads all of it that is not too large; gives whether that went well.
fn is_readable(input: &Path) -> bool {
    let check = |message: String| assert!(!message.contains('\n') && message.len() < 1000, "{message}");
    let mut series = match sources::open_any(&inputs(input), &SourceOptions::default()) {
        Ok(Opened::Volume(series)) => series,
        Ok(Opened::Mesh(mut mesh)) => {
            return match read_mesh(mesh.as_mut()) {
                Ok(()) => true,
                Err(error) => {
                    check(error.to_string());
                    false
                }
            };
        }
        Err(error) => {
            check(error.to_string());
            return false;
        }
    };
    let num_slices = series.grid().dims[2];
    let num_samples = series.grid().num_samples();
    let mut all_read = true;
    for variable in 0..series.variables().len() {
        for step in 0..series.times().num_steps().min(4) {
            if num_samples > MAX_SAMPLES {
                continue;
            }
            let read = series.open_step(variable, step).and_then(|mut reader| reader.read_slices(num_slices));
            match read {
                Ok(samples) => assert_eq!(samples.len(), num_samples),
                Err(error) => {
                    check(error.to_string());
                    all_read = false;
                }
            }
        }
    }
    all_read
}

/// All files below a folder, in order.
fn files_below(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    let mut entries: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    entries.sort();
    for entry in entries {
        if entry.is_dir() {
            files.extend(files_below(&entry));
        } else {
            files.push(entry);
        }
    }
    files
}

/// A copy of a folder of fixtures.
fn copied(folder: &str) -> tempfile::TempDir {
    let copy = tempfile::tempdir().unwrap();
    let original = path(folder);
    for file in files_below(&original) {
        let to = copy.path().join(file.strip_prefix(&original).unwrap());
        std::fs::create_dir_all(to.parent().unwrap()).unwrap();
        std::fs::copy(&file, to).unwrap();
    }
    copy
}

/// Breaks a file in many ways and opens `targets` each time; the file is whole again at the end.
fn break_file(file: &Path, targets: &[PathBuf]) {
    let content = std::fs::read(file).unwrap();
    for cut in 0..NUM_CUTS.min(content.len()) {
        std::fs::write(file, &content[..cut * content.len() / NUM_CUTS.min(content.len())]).unwrap();
        targets.iter().for_each(|target| {
            is_readable(target);
        });
    }
    let stride = content.len().div_ceil(NUM_FLIPS).max(1);
    for (index, at) in (0..content.len()).step_by(stride).enumerate() {
        let mut broken = content.clone();
        broken[at] ^= [0x01, 0xff, 0x10, 0x80, 0x04][index % 5];
        std::fs::write(file, broken).unwrap();
        targets.iter().for_each(|target| {
            is_readable(target);
        });
    }
    std::fs::write(file, content).unwrap();
}

/// Breaks every file of a folder for which `targets` says what is then opened.
fn break_folder(folder: &str, targets: impl Fn(&Path) -> Vec<PathBuf>) {
    let copy = copied(folder);
    let files = files_below(copy.path());
    assert!(!files.is_empty());
    for file in files {
        let targets = targets(&file);
        if !targets.is_empty() {
            break_file(&file, &targets);
        }
    }
    let largest = LARGEST.load(Ordering::Relaxed);
    assert!(largest <= MAX_ALLOCATION, "{folder}: {largest} bytes were asked for at once");
}

#[test]
fn broken_npy() {
    break_folder("npy", |file| vec![file.to_owned()]);
}

#[test]
fn broken_vti() {
    break_folder("vti", |file| vec![file.to_owned()]);
}

#[test]
fn broken_collections() {
    break_folder("series", |file| vec![file.with_file_name("run.pvd")]);
}

#[test]
fn broken_nrrd() {
    break_folder("nrrd", |file| {
        let name = file.file_name().unwrap().to_string_lossy().into_owned();
        if name.ends_with(".nrrd") || name.ends_with(".nhdr") {
            return vec![file.to_owned()];
        }
        // The detached headers that name this data file.
        let headers: &[&str] = match name.as_str() {
            "one.raw" => &["one.nhdr", "end.nhdr"],
            "packed.raw.gz" => &["packed.nhdr"],
            name if name.ends_with(".gz") => &["listed.nhdr"],
            name if name.starts_with("slice") => &["slices.nhdr"],
            _ => &["numbered.nhdr"],
        };
        headers.iter().map(|header| file.with_file_name(header)).collect()
    });
}

/// A file whose name has one of some parts.
fn some_of(file: &Path, parts: &[&str]) -> Vec<PathBuf> {
    let name = file.file_name().unwrap().to_string_lossy().into_owned();
    parts.iter().find(|part| name.contains(**part)).map(|_| file.to_owned()).into_iter().collect()
}

#[test]
fn broken_meshes() {
    // The encodings of arrays are those of `.vti` files, which are all broken above.
    let encodings = ["ascii", "binary", "zlib"];
    break_folder("mesh", |file| some_of(file, &encodings));
}

#[test]
fn broken_plot3d() {
    let forms = [
        "big_f4_plain_all_one",
        "big_f8_plain_iblank_one",
        "little_f4_records_all_blocks",
        "little_f8_records_iblank_blocks",
    ];
    break_folder("plot3d", |file| some_of(file, &forms));
}

#[test]
fn broken_series_of_meshes() {
    break_folder("mesh_series", |file| vec![file.with_file_name("run.pvd")]);
}

/// The array or group that a file of a Zarr belongs to.
fn node_of(file: &Path) -> Vec<PathBuf> {
    let is_node =
        |folder: &&Path| [".zarray", "zarr.json", ".zgroup"].iter().any(|name| folder.join(name).exists());
    file.ancestors().skip(1).find(is_node).map(Path::to_owned).into_iter().collect()
}

#[test]
fn broken_zarr_version_2() {
    break_folder("zarr/codecs_v2.zarr", node_of);
    break_folder("zarr/blosc.zarr", node_of);
    break_folder("zarr/noise.zarr", node_of);
}

#[test]
fn broken_zarr_version_3() {
    break_folder("zarr/codecs_v3.zarr", node_of);
    break_folder("zarr/ocean.zarr", |file| {
        node_of(file)
            .into_iter()
            .chain([file
                .ancestors()
                .find(|f| f.ends_with("temperature"))
                .map_or_else(|| node_of(file)[0].with_file_name("temperature"), Path::to_owned)])
            .collect()
    });
}

#[test]
fn a_cut_file_of_plain_samples_is_never_read_as_whole() {
    for name in
        ["npy/f4.npy", "nrrd/raw.nrrd", "vti/raw_plain_64.vti", "vti/inline_zlib_32.vti", "nrrd/gzip.nrrd"]
    {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(name.rsplit('/').next().unwrap());
        let content = std::fs::read(path(name)).unwrap();
        std::fs::write(&file, &content).unwrap();
        assert!(is_readable(&file), "{name}");
        // VTK closes its elements after the data; the data end well before them.
        let end = if name.starts_with("vti") { content.len() - 60 } else { content.len() };
        for length in 0..end {
            std::fs::write(&file, &content[..length]).unwrap();
            assert!(!is_readable(&file), "{name} cut to {length} of {} bytes", content.len());
        }
    }
}
