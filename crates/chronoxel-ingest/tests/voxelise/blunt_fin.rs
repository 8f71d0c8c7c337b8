//! The Blunt Fin: the sampler against VTK's, and a store of it in little memory.

use std::path::PathBuf;

use chronoxel_ingest::sources::{SourceOptions, open_mesh};
use chronoxel_ingest::voxelise::sample_points;
use chronoxel_ingest::{Codec, EncodeOptions, MeshSeries, VoxelOptions, encode_mesh};

use crate::files::files_of;

/// The mesh, or `None` where the data is absent and need not be there.
fn blunt_fin() -> Option<Box<dyn MeshSeries>> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
    let folder = PathBuf::from(std::env::var_os("CHRONOXEL_DATA").unwrap_or_else(|| default.into()));
    let files = ["bluntfinxyz.bin", "bluntfinq.bin"].map(|name| folder.join("plot3d").join(name));
    if files.iter().all(|file| file.is_file()) {
        let options = SourceOptions { variables: vec!["density".into()], ..SourceOptions::default() };
        return Some(open_mesh(&files.map(|file| file.to_string_lossy().into_owned()), &options).unwrap());
    }
    let is_required = std::env::var_os("CHRONOXEL_REQUIRE_DATA").is_some_and(|v| v == "1");
    assert!(!is_required, "CHRONOXEL_REQUIRE_DATA=1, but there is no data in {}", folder.display());
    println!("skipped: there is no data in {}; set CHRONOXEL_DATA", folder.display());
    None
}

#[test]
fn points_have_the_values_of_vtks_probe_filter() {
    let Some(mut mesh) = blunt_fin() else { return };
    // Made by make.py beside it: x, y, z and the value.
    let bytes = include_bytes!("../fixtures/blunt_fin/probes.f64");
    let (numbers, _) = bytes.as_chunks::<8>();
    let numbers: Vec<f64> = numbers.iter().map(|b| f64::from_le_bytes(*b)).collect();
    let (probes, _) = numbers.as_chunks::<4>();
    assert_eq!(probes.len(), 3000);
    let points: Vec<[f64; 3]> = probes.iter().map(|&[x, y, z, _]| [x, y, z]).collect();
    let found = sample_points(mesh.as_mut(), 0, 0, &points).unwrap();
    let range = 4.9775 - 0.1926;
    let agrees = |(found, probe): &(&f64, &[f64; 4])| (*found - probe[3]).abs() <= 1e-5 * range;
    let num_agreeing = found.iter().zip(probes).filter(agrees).count();
    assert!(num_agreeing >= 2997, "{num_agreeing} of 3000");
}

#[test]
fn little_memory_gives_the_same_store() {
    let Some(mut mesh) = blunt_fin() else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut encoded = |memory_bytes: u64| {
        let path = folder.path().join("fin.cxl");
        let voxels = VoxelOptions { field_threshold: 0.01, max_depth: 4 };
        let options = EncodeOptions {
            codec: Codec::Raw,
            memory_bytes,
            voxels,
            overwrite: true,
            ..EncodeOptions::default()
        };
        let report = encode_mesh(mesh.as_mut(), &path, &options, &mut |_| {}).unwrap();
        (files_of(&path), report.voxels.unwrap().num_leaves)
    };
    let (ample, num_leaves) = encoded(1 << 30);
    assert!(num_leaves > 100, "{num_leaves}");
    assert!(encoded(64 << 20).0 == ample);
}
