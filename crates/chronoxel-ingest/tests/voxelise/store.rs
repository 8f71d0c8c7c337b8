//! Stores of meshes: sound with every codec, within their bounds, the same whatever memory and threads, and resumed.

use std::path::Path;

use chronoxel_core::{SampleType, Samples, TimeAxis};
use chronoxel_ingest::mesh::VisitTetrahedron;
use chronoxel_ingest::{
    Codec, EncodeError, EncodeOptions, GridType, MeshCensus, MeshSeries, SourceError, Variable, VoxelOptions,
    encode_mesh, measure_mesh, sources,
};
use chronoxel_store::{Store, verify};

use crate::files::{copy_folder, files_of};
use crate::meshes::{ring, wavy, with_field};

fn options(codec: Codec) -> EncodeOptions {
    let voxels = VoxelOptions { field_threshold: 0.0, max_depth: 3 };
    EncodeOptions { codec, brick_edge: 8, voxels, ..EncodeOptions::default() }
}

fn sound(path: &Path) -> Store {
    let store = Store::open(path).unwrap();
    let found = verify(&store, &|_, _| {});
    assert!(found.problems.is_empty(), "{:?}", found.problems);
    store
}

#[test]
fn every_codec_gives_a_sound_store_within_its_error() {
    let folder = tempfile::tempdir().unwrap();
    let codecs: [(EncodeOptions, f64); 5] = [
        (options(Codec::Raw), 1.0 / 65535.0),
        (EncodeOptions { max_error: Some(0.01), ..options(Codec::Auto) }, 0.01),
        (EncodeOptions { bits: Some(8.0), ..options(Codec::Auto) }, 0.5),
        (options(Codec::Palette), 0.5),
        (options(Codec::Vq), 0.5),
    ];
    for (i, (options, bound)) in codecs.into_iter().enumerate() {
        let path = folder.path().join(format!("{i}.cxl"));
        let mut mesh = with_field(ring(), SampleType::F32, wavy);
        let report = encode_mesh(&mut mesh, &path, &options, &mut |_| {}).unwrap();
        assert_eq!((report.steps_read, report.raw_bytes), (3, 3 * 4 * 25 * 9 * 7));
        let store = sound(&path);
        let entry = store.header().mesh.clone().unwrap();
        assert_eq!(
            (entry.kind.as_str(), entry.num_cells, entry.num_points),
            ("curvilinear", 24 * 8 * 6, 1575)
        );
        let found = measure_mesh(&store, &mut mesh, 1 << 28, 0..3).unwrap();
        assert!(found.problems.is_empty(), "{:?}", found.problems);
        let errors = &found.variables[0];
        assert!(errors.max_abs_error <= bound && errors.max_abs_error > 0.0, "{i}: {}", errors.max_abs_error);
        assert!(errors.mse.iter().all(|mse| mse.sqrt() < 0.05), "{i}: {:?}", errors.mse);
    }
}

#[test]
fn another_mesh_is_not_the_source() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.cxl");
    let mut mesh = with_field(ring(), SampleType::F32, wavy);
    encode_mesh(&mut mesh, &path, &options(Codec::Raw), &mut |_| {}).unwrap();
    let store = Store::open(&path).unwrap();
    let mut other = with_field(crate::meshes::stretched(), SampleType::F32, wavy);
    let error = measure_mesh(&store, &mut other, 1 << 28, 0..1).err().unwrap().to_string();
    assert!(error.contains("not the source of this store") && !error.contains('\n'), "{error}");
    // The same mesh with values elsewhere: the tree differs.
    let still = with_field(ring(), SampleType::F32, |p, _| if p[0] > 11.0 { p[1] } else { 0.0 });
    let error = measure_mesh(&store, &mut { still }, 1 << 28, 0..1).err().unwrap().to_string();
    assert!(error.contains("other nodes"), "{error}");
    let mut volume = chronoxel_ingest::sim::open("sim:vortex?dims=16&steps=3").unwrap();
    assert!(chronoxel_ingest::measure(&store, volume.as_mut(), 0..1).is_err());
}

#[test]
fn memory_and_threads_do_not_change_a_byte() {
    let folder = tempfile::tempdir().unwrap();
    let encoded = |source: &str, memory_bytes: u64, threads: usize, codec: Codec| {
        let path = folder.path().join("m.cxl");
        let wanted = sources::SourceOptions { variables: vec!["pulse".into()], ..Default::default() };
        let mut mesh = sources::open_mesh(&[source.to_owned()], &wanted).unwrap();
        let options = EncodeOptions { memory_bytes, overwrite: true, ..options(codec) };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| encode_mesh(mesh.as_mut(), &path, &options, &mut |_| {}).unwrap());
        files_of(&path)
    };
    // 233,280 tetrahedra, of which 26 MiB hold less in a list.
    let large = "sim:twist?dims=37&steps=1";
    let ample = encoded(large, 1 << 30, 2, Codec::Raw);
    assert!(ample == encoded(large, 26 << 20, 1, Codec::Raw), "one thread, little memory");
    let small = "sim:twist?dims=17&steps=3";
    let ample = encoded(small, 1 << 30, 1, Codec::Vq);
    assert!(ample == encoded(small, 32 << 20, 3, Codec::Vq), "three threads");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing but the store");
}

#[test]
fn what_does_not_fit_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.cxl");
    let mut mesh = with_field(ring(), SampleType::F32, wavy);
    let mut refused = |options: EncodeOptions| {
        let error = encode_mesh(&mut mesh, &path, &options, &mut |_| {}).unwrap_err().to_string();
        assert!(!error.contains('\n') && !path.exists(), "{error}");
        error
    };
    let tight = EncodeOptions { memory_bytes: 1 << 20, ..options(Codec::Raw) };
    assert!(refused(tight).contains("--memory"));
    assert!(refused(options(Codec::PaletteSlice)).contains("no slices"));
    let deep = VoxelOptions { max_depth: 14, ..VoxelOptions::default() };
    assert!(refused(EncodeOptions { voxels: deep, ..options(Codec::Raw) }).contains("--max-depth 14"));
    let wrong = VoxelOptions { field_threshold: 1.5, ..VoxelOptions::default() };
    assert!(
        refused(EncodeOptions { voxels: wrong, ..options(Codec::Raw) }).contains("--field-threshold 1.5")
    );
}

/// A mesh of which a step cannot be read.
struct Broken<M> {
    mesh: M,
    step: Option<usize>,
}

impl<M: MeshSeries> MeshSeries for Broken<M> {
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
        if self.step == Some(step) {
            return Err(SourceError::InvalidArgument {
                argument: "step",
                value: step.to_string(),
                remedy: "the disk is gone".into(),
            });
        }
        self.mesh.read_values(variable, step)
    }
    fn working_bytes(&self) -> u64 {
        self.mesh.working_bytes()
    }
}

#[test]
fn an_interrupted_store_goes_on_to_the_same_bytes() {
    for codec in [Codec::Raw, Codec::Palette] {
        let folder = tempfile::tempdir().unwrap();
        let [whole, parts] = ["whole.cxl", "parts.cxl"].map(|name| folder.path().join(name));
        let open = |step| {
            let mesh = with_field(ring(), SampleType::F32, wavy);
            Broken { mesh, step }
        };
        let options = EncodeOptions { window: (codec == Codec::Palette).then_some(2), ..options(codec) };
        encode_mesh(&mut open(None), &whole, &options, &mut |_| {}).unwrap();
        let error = encode_mesh(&mut open(Some(2)), &parts, &options, &mut |_| {}).unwrap_err();
        assert!(matches!(error, EncodeError::Interrupted { .. } | EncodeError::Source(_)), "{error}");
        // Also as a kill in the last step leaves it.
        let killed = folder.path().join("killed.cxl");
        let again = folder.path().join("again.cxl");
        let mut copied = false;
        encode_mesh(&mut open(None), &again, &options, &mut |progress| {
            if progress.step == 2 && !copied {
                copied = true;
                copy_folder(&again, &killed);
            }
        })
        .unwrap();
        let on = EncodeOptions { resume: true, ..options.clone() };
        encode_mesh(&mut open(None), &killed, &on, &mut |_| {}).unwrap();
        assert!(copied && files_of(&whole) == files_of(&killed), "{}", codec.name());
        let resumed = EncodeOptions { resume: true, ..options.clone() };
        encode_mesh(&mut open(None), &parts, &resumed, &mut |_| {}).unwrap();
        assert!(files_of(&whole) == files_of(&parts), "{}", codec.name());
        sound(&parts);
    }
}

#[test]
fn points_without_a_value_mask_the_tetrahedra_around_them() {
    let folder = tempfile::tempdir().unwrap();
    // NaN in a part that moves, and the value that means "no data".
    let field = |p: [f64; 3], step: usize| match p[0] - 10.0 - 0.3 * step as f64 {
        x if (0.0..0.4).contains(&x) => f64::NAN,
        x if x > 1.2 => -9.0,
        _ => wavy(p, step),
    };
    for codec in [Codec::Raw, Codec::Auto] {
        let path = folder.path().join(format!("{}.cxl", codec.name()));
        let mut mesh = with_field(ring(), SampleType::F32, field);
        let max_error = (codec == Codec::Auto).then_some(0.01);
        let options = EncodeOptions { fill_value: Some(-9.0), max_error, ..options(codec) };
        let report = encode_mesh(&mut mesh, &path, &options, &mut |_| {}).unwrap();
        let points = mesh.points().unwrap();
        let is_masked = |v: f64| v.is_nan() || v == -9.0;
        let of_step = |step| points.iter().filter(|p| is_masked(field(**p, step))).count() as u64;
        assert_eq!((report.num_masked, report.num_infinite), ((0..3).map(of_step).sum(), 0));
        let store = sound(&path);
        let entry = &store.header().variables[0];
        assert_eq!(entry.fill_value, Some(-9.0));
        assert!(entry.min.unwrap() > -2.0, "{:?}", entry.min);
        let found = measure_mesh(&store, &mut mesh, 1 << 28, 0..3).unwrap();
        assert!(found.problems.is_empty(), "{:?}", found.problems);
        assert!(found.variables[0].max_abs_error <= 0.01);
    }
}
