//! What the fuzz targets share: a folder for each process, and reading a source as `encode` does.

pub mod fixture;

use std::{
    path::{Path, PathBuf},
    sync::OnceLock,
};

use chronoxel_ingest::sources::{SourceOptions, open, open_mesh};

/// Samples that a target reads of a step: enough to come past every header, few enough to be quick.
const MOST_SAMPLES: usize = 1 << 18;

/// An empty folder of this process, made once.
pub fn scratch() -> &'static Path {
    static FOLDER: OnceLock<PathBuf> = OnceLock::new();
    FOLDER.get_or_init(|| {
        let folder = std::env::temp_dir().join(format!("chronoxel-fuzz-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("the temporary folder takes a new one");
        folder
    })
}

/// Writes a file in the scratch folder.
pub fn write(name: &str, bytes: &[u8]) -> PathBuf {
    let path = scratch().join(name);
    if let Some(parent) = path.parent() {
        std::fs::create_dir_all(parent).expect("the scratch folder takes a new one");
    }
    std::fs::write(&path, bytes).expect("the scratch folder takes a file");
    path
}

/// Opens a source and reads its first and last step of every variable, checking what a series promises.
pub fn read_source(path: &Path, options: &SourceOptions) {
    let Ok(mut series) = open(&[path.to_string_lossy().into_owned()], options) else { return };
    let [nx, ny, nz] = series.grid().dims;
    let num_steps = series.times().num_steps();
    assert!(nx * ny * nz > 0 && num_steps > 0 && !series.variables().is_empty());
    assert!(series.times().times.is_sorted_by(|a, b| a < b));
    for variable in 0..series.variables().len().min(4) {
        for step in [0, num_steps - 1] {
            let Ok(mut reader) = series.open_step(variable, step) else { continue };
            for _ in 0..nz.min(MOST_SAMPLES / (nx * ny)) {
                let Ok(samples) = reader.read_slices(1) else { break };
                assert_eq!(samples.len(), nx * ny, "a slice has every sample");
            }
        }
    }
}

/// Opens a mesh, walks its tetrahedra and reads its first and last step of every variable, checking what a mesh promises.
pub fn read_mesh(paths: &[PathBuf]) {
    let inputs: Vec<String> = paths.iter().map(|path| path.to_string_lossy().into_owned()).collect();
    let Ok(mut mesh) = open_mesh(&inputs, &SourceOptions::default()) else { return };
    let (num_points, num_steps) = (mesh.num_points(), mesh.times().num_steps());
    assert!(num_points > 0 && num_steps > 0 && !mesh.variables().is_empty());
    let points = mesh.points().expect("the geometry was read before");
    assert!(points.len() == num_points && points.iter().flatten().all(|x| x.is_finite()));
    let mut num_tetrahedra = 0;
    let walked = mesh.for_each_tetrahedron(&mut |corners| {
        assert!(corners.iter().all(|corner| (*corner as usize) < num_points));
        num_tetrahedra += 1;
        Ok(())
    });
    if let Ok(census) = walked {
        assert_eq!(census.num_tetrahedra, num_tetrahedra);
    }
    for variable in 0..mesh.variables().len().min(4) {
        for step in [0, num_steps - 1] {
            let Ok(values) = mesh.read_values(variable, step) else { continue };
            assert_eq!(values.len(), num_points, "every point has a value");
        }
    }
}
