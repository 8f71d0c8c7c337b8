//! Stores of cells: within their bounds, the same whatever threads do the work, resumed, and honest about what they cost.

use std::path::{Path, PathBuf};

use chronoxel_core::{SampleType, Samples, TimeAxis};
use chronoxel_ingest::mesh::{CellKind, CellList, MemoryMesh, VisitTetrahedron};
use chronoxel_ingest::{
    CellOptions, EncodeError, EncodeOptions, GridType, MeshCensus, MeshSeries, SourceError, Variable,
    encode_cells, measure_cells,
};
use chronoxel_store::{CellStore, verify_cells};

const EDGE: usize = 12;

/// Points of a lattice, and a value at each step: a wave that runs, and holes.
fn mesh(num_steps: usize, sample_type: SampleType, value: impl Fn(usize, usize) -> f64) -> MemoryMesh {
    let place = |n: usize| [n % EDGE, n / EDGE % EDGE, n / EDGE / EDGE].map(|i| i as f64);
    let points = (0..EDGE.pow(3)).map(place).collect();
    let times = TimeAxis::regular(num_steps, 1.0, "s").unwrap();
    let variable = Variable { name: "wave".into(), units: "m".into(), sample_type, fill_value: Some(-99.0) };
    let step = |t: usize| {
        let values = (0..EDGE.pow(3)).map(|p| value(p, t));
        match sample_type.fits_f32() {
            true => Samples::F32(values.map(|v| v as f32).collect()),
            false => Samples::F64(values.collect()),
        }
    };
    let mesh = MemoryMesh::curvilinear([EDGE; 3], points, times).unwrap();
    mesh.with_variable(variable, (0..num_steps).map(step).collect()).unwrap()
}

fn wave(p: usize, t: usize) -> f64 {
    (0.02 * p as f64 + 0.1 * t as f64).sin() + 0.3 * (0.31 * p as f64 - 0.2 * t as f64).cos()
}

fn sound(path: &Path) -> CellStore {
    let store = CellStore::open(path).unwrap();
    let found = verify_cells(&store, &|_, _| {});
    assert!(found.problems.is_empty(), "{:?}", found.problems);
    store
}

fn files_of(root: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let (mut found, mut folders) = (Vec::new(), vec![root.to_owned()]);
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => {
                    found.push((path.strip_prefix(root).unwrap().to_owned(), std::fs::read(&path).unwrap()))
                }
            }
        }
    }
    found.sort();
    found
}

fn encode(
    mesh: &mut dyn MeshSeries,
    path: &Path,
    options: &EncodeOptions,
    entries: usize,
) -> Result<chronoxel_ingest::CellReport, EncodeError> {
    encode_cells(mesh, path, options, &CellOptions { entries, nested: false }, &mut |_| {})
}

#[test]
fn bounds_hold_and_what_is_reported_is_so() {
    let folder = tempfile::tempdir().unwrap();
    for (number, (max_error, sample_type)) in
        [(None, SampleType::F32), (Some(0.02), SampleType::F32), (Some(1e-4), SampleType::F64)]
            .into_iter()
            .enumerate()
    {
        let path = folder.path().join(format!("{number}.cxl"));
        let mut source = mesh(70, sample_type, wave);
        let options = EncodeOptions { max_error, ..EncodeOptions::default() };
        let report = encode(&mut source, &path, &options, 64).unwrap();
        let store = sound(&path);
        assert_eq!((report.num_points, report.num_tetrahedra), (1728, 5 * 11 * 11 * 11));
        assert_eq!(report.raw_bytes, 70 * 1728 * sample_type.num_bytes() as u64);
        assert_eq!(report.stored_bytes, store.stored_bytes().unwrap());
        assert_eq!((report.steps_read, report.steps_resumed, report.num_masked), (70, 0, 0));
        assert_eq!(store.header().kind, "curvilinear");
        let found = measure_cells(&store, &mut source, 0..70).unwrap();
        assert!(found.problems.is_empty(), "{:?}", found.problems);
        let errors = &found.variables[0];
        assert_eq!((errors.errors.mse.len(), errors.snr_db.len()), (70, 2));
        println!("{max_error:?}: {:?} {}", errors.snr_db, errors.errors.max_abs_error);
        assert!(errors.errors.max_abs_error <= max_error.unwrap_or(0.5));
        assert!(errors.snr_db.iter().all(|&snr| snr > 10.0));
        // What the spans say of themselves is what was measured.
        let [low, high] =
            [store.header().variables[0].min.unwrap(), store.header().variables[0].max.unwrap()];
        let spans = [0, 1].map(|block| store.spans(0, block).unwrap());
        let largest = spans.iter().flat_map(|spans| spans.iter()).map(|s| s.max_error).fold(0.0, f64::max);
        let ratio = largest / (high - low) / errors.errors.max_abs_error;
        assert!((1.0 - 1e-6..1.02).contains(&ratio), "what rounding to f32 may add is in it: {ratio}");
        assert!(encode(&mut source, &path, &options, 64).unwrap_err().to_string().contains("already exists"));
    }
}

#[test]
fn missing_values_are_missing_again() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    let value = |p: usize, t: usize| match (p, t) {
        (0..40, _) => f64::NAN,
        (100, 30..) => -99.0,
        (101, 7) => f64::INFINITY,
        (_, 65) => f64::NAN,
        _ => wave(p, t),
    };
    let mut source = mesh(67, SampleType::F32, value);
    let report = encode(&mut source, &path, &EncodeOptions::default(), 32).unwrap();
    assert_eq!((report.num_masked, report.num_infinite), (40 * 66 + 36 + 1 + 1728, 1));
    let store = sound(&path);
    let found = measure_cells(&store, &mut source, 0..67).unwrap();
    assert!(found.problems.is_empty(), "{:?}", found.problems);
    let nothing = mesh(3, SampleType::F32, |_, _| f64::NAN).num_points();
    let mut nothing_at_all = mesh(3, SampleType::F32, |_, _| f64::NAN);
    let error = encode(&mut nothing_at_all, &folder.path().join("b.cxl"), &EncodeOptions::default(), 32);
    assert!(matches!(error, Err(EncodeError::NoData { .. })), "{nothing} points");
    assert!(!folder.path().join("b.cxl").exists());
}

#[test]
fn the_bytes_do_not_depend_on_threads() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = [1, 2, 5].map(|threads| {
        let path = folder.path().join(format!("{threads}.cxl"));
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let options = EncodeOptions { max_error: Some(0.01), ..EncodeOptions::default() };
        pool.install(|| {
            let value = |p: usize, t: usize| if p == 7 && t > 40 { f64::NAN } else { wave(p, t) };
            encode(&mut mesh(66, SampleType::F32, value), &path, &options, 128).unwrap()
        });
        files_of(&path)
    });
    assert!(bytes[0] == bytes[1] && bytes[0] == bytes[2]);
}

#[test]
fn what_does_not_fit_is_refused_with_what_it_takes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    let refused = |options: &EncodeOptions, entries: usize| {
        encode(&mut mesh(64, SampleType::F32, wave), &path, options, entries).unwrap_err().to_string()
    };
    let small = EncodeOptions { memory_bytes: 1 << 20, ..EncodeOptions::default() };
    let message = refused(&small, 256);
    assert!(
        message.starts_with("--memory 1048576 bytes: a block of 64 steps at 1728 points needs"),
        "{message}"
    );
    assert!(refused(&EncodeOptions::default(), 1).contains("--entries 1"));
    assert!(refused(&EncodeOptions::default(), 1025).contains("2 to 1024"));
    let tight = EncodeOptions { max_error: Some(1e-12), ..EncodeOptions::default() };
    assert!(refused(&tight, 256).contains("steps 0 to 63"), "{}", refused(&tight, 256));
    assert!(!path.exists());
}

/// A series that cannot be read from a step on.
struct Broken {
    mesh: MemoryMesh,
    from: usize,
}

impl MeshSeries for Broken {
    fn grid_type(&self) -> GridType {
        self.mesh.grid_type()
    }
    fn dims(&self) -> Option<[usize; 3]> {
        self.mesh.dims()
    }
    fn num_points(&self) -> usize {
        self.mesh.num_points()
    }
    fn times(&self) -> &TimeAxis {
        self.mesh.times()
    }
    fn variables(&self) -> &[Variable] {
        self.mesh.variables()
    }
    fn points(&mut self) -> Result<Vec<[f64; 3]>, SourceError> {
        self.mesh.points()
    }
    fn for_each_tetrahedron(&mut self, visit: &mut VisitTetrahedron<'_>) -> Result<MeshCensus, SourceError> {
        self.mesh.for_each_tetrahedron(visit)
    }
    fn read_values(&mut self, variable: usize, step: usize) -> Result<Samples, SourceError> {
        if step >= self.from {
            return Err(SourceError::Io {
                path: "x".into(),
                action: "read",
                source: std::io::Error::other("gone"),
            });
        }
        self.mesh.read_values(variable, step)
    }
    fn working_bytes(&self) -> u64 {
        self.mesh.working_bytes()
    }
}

#[test]
fn an_interrupted_encoding_goes_on_to_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let [whole, path, partial] = ["whole.cxl", "a.cxl", "a.partial.cxl"].map(|name| folder.path().join(name));
    let options = EncodeOptions { max_error: Some(0.01), ..EncodeOptions::default() };
    encode(&mut mesh(150, SampleType::F32, wave), &whole, &options, 64).unwrap();
    let broken = |from| Broken { mesh: mesh(150, SampleType::F32, wave), from };
    assert!(encode(&mut broken(10), &path, &options, 64).is_err());
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is left");
    let error = encode(&mut broken(100), &path, &options, 64).unwrap_err();
    assert!(error.to_string().contains("64 finished steps are kept"), "{error}");
    assert!(partial.is_dir() && !path.exists());
    sound(&partial);
    let resume = EncodeOptions { resume: true, ..options.clone() };
    let other = encode(&mut mesh(150, SampleType::F32, wave), &path, &resume, 65).unwrap_err();
    assert!(other.to_string().contains("options was"), "{other}");
    let report = encode(&mut mesh(150, SampleType::F32, wave), &path, &resume, 64).unwrap();
    assert_eq!((report.steps_read, report.steps_resumed), (86, 64));
    assert!(files_of(&path) == files_of(&whole));
    // What is to be replaced stays until the new store is complete.
    let overwrite = EncodeOptions { overwrite: true, ..options };
    assert!(encode(&mut broken(10), &path, &overwrite, 64).is_err());
    assert!(files_of(&path) == files_of(&whole));
    encode(&mut mesh(20, SampleType::F32, wave), &path, &overwrite, 64).unwrap();
    assert_eq!(sound(&path).header().num_steps(), 20);
}

#[test]
fn another_mesh_is_not_the_source() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.cxl");
    encode(&mut mesh(3, SampleType::F32, wave), &path, &EncodeOptions::default(), 16).unwrap();
    let store = sound(&path);
    let refused = |mesh: &mut dyn MeshSeries| measure_cells(&store, mesh, 0..1).unwrap_err().to_string();
    assert!(refused(&mut mesh(4, SampleType::F32, wave)).contains("number of steps 4"));
    assert!(refused(&mut mesh(3, SampleType::F64, wave)).contains("sample type f64"));
    let mut cells = CellList::default();
    cells.push(CellKind::Tetrahedron, &[0, 1, EDGE as u32, (EDGE * EDGE) as u32]);
    let points = mesh(3, SampleType::F32, wave).points().unwrap();
    let times = TimeAxis::regular(3, 1.0, "s").unwrap();
    let variable = mesh(3, SampleType::F32, wave).variables()[0].clone();
    let steps = vec![Samples::F32(vec![0.0; EDGE.pow(3)]); 3];
    let other = MemoryMesh::unstructured(points, cells, times).unwrap();
    assert!(refused(&mut other.with_variable(variable, steps).unwrap()).contains("geometry"));
}
