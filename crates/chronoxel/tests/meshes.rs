//! Pictures of meshes: bricks of several levels side by side show no seams, and nothing is drawn beyond the mesh.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use chronoxel::session::{Session, View, orbit_camera};
use chronoxel_core::{ColorMap, Image, TransferFunction};
use chronoxel_ingest::{Codec, EncodeOptions, VoxelOptions, encode, encode_mesh, sources};

/// Samples along the unit cube's edges of the uniform grid whose samples are those of a tree of depth 3 with bricks of 8.
const N: usize = 57;

fn field([x, y, z]: [f64; 3]) -> f64 {
    x + 0.5 * y + 0.25 * z
}

fn options(max_depth: u8) -> EncodeOptions {
    let voxels = VoxelOptions { field_threshold: 0.0, max_depth };
    EncodeOptions { codec: Codec::Raw, brick_edge: 8, voxels, ..EncodeOptions::default() }
}

/// The field on a rectilinear grid over the unit cube whose layers become thinner towards one corner.
fn stretched(folder: &Path) -> PathBuf {
    let along: Vec<f64> = (0..13).map(|i| (f64::from(i) / 12.0).powi(3)).collect();
    let mut text = "# vtk DataFile Version 3.0\nstretched\nASCII\nDATASET RECTILINEAR_GRID\n".to_owned();
    writeln!(text, "DIMENSIONS 13 13 13").unwrap();
    for axis in "XYZ".chars() {
        writeln!(text, "{axis}_COORDINATES 13 double").unwrap();
        along.iter().for_each(|v| writeln!(text, "{v:?}").unwrap());
    }
    writeln!(text, "POINT_DATA 2197\nSCALARS v float 1\nLOOKUP_TABLE default").unwrap();
    for i in 0..13 * 13 * 13 {
        let p = [i % 13, i / 13 % 13, i / 169].map(|k| along[k]);
        writeln!(text, "{}", field(p) as f32).unwrap();
    }
    let path = folder.join("stretched.vtk");
    std::fs::write(&path, text).unwrap();
    path
}

fn mesh_store(folder: &Path, source: &str, max_depth: u8) -> PathBuf {
    let path = folder.join("mesh.cxl");
    let mut mesh = sources::open_mesh(&[source.to_owned()], &Default::default()).unwrap();
    encode_mesh(mesh.as_mut(), &path, &options(max_depth), &mut |_| {}).unwrap();
    path
}

/// The field on the uniform grid.
fn uniform_store(folder: &Path) -> PathBuf {
    let at = |i: usize| [i % N, i / N % N, i / N / N].map(|k| k as f64 / (N - 1) as f64);
    let samples: Vec<u8> = (0..N * N * N).flat_map(|i| (field(at(i)) as f32).to_le_bytes()).collect();
    let raw = folder.join("uniform.raw");
    std::fs::write(&raw, samples).unwrap();
    let hints = sources::SourceOptions {
        dims: Some([N; 3]),
        sample_type: Some(chronoxel_core::SampleType::F32),
        spacing: Some([1.0 / (N - 1) as f64; 3]),
        ..Default::default()
    };
    let mut series = sources::open(&[raw.to_string_lossy().into_owned()], &hints).unwrap();
    let path = folder.join("uniform.cxl");
    encode(series.as_mut(), &path, &options(0), &mut |_| {}).unwrap();
    path
}

fn picture(store: &Path, angles: [f64; 2]) -> Image {
    let mut session = Session::open(store, None, 1 << 30).unwrap();
    let size = [120, 90];
    let transfer = TransferFunction::built_in("filled", ColorMap::Viridis).unwrap();
    let view = View {
        camera: orbit_camera(&session.store().header().grid, angles, 1.2, Some(30.0), size).unwrap(),
        transfer: session.resolve(&transfer).unwrap(),
        size,
        step_voxels: 0.5,
        lighting: None,
        opacity_unit: 1.0 / 32.0,
        level: 0,
        coherence: None,
    };
    let picture = session.draw(&view, 0).unwrap();
    assert!(picture.warnings.is_empty(), "{:?}", picture.warnings);
    picture.image
}

#[test]
fn levels_side_by_side_show_no_seams() {
    let folder = tempfile::tempdir().unwrap();
    let source = stretched(folder.path());
    let mesh = mesh_store(folder.path(), &source.to_string_lossy(), 3);
    let uniform = uniform_store(folder.path());
    let tree = Session::open(&mesh, None, 1 << 30).unwrap().store().tree().clone();
    let num_leaves = |level: u8| {
        let nodes = tree.nodes(level).iter().map(|&morton| chronoxel_core::NodeId { level, morton });
        nodes.filter(|node| tree.is_leaf(*node)).count()
    };
    assert!(num_leaves(0) > 10 && num_leaves(1) > 10 && num_leaves(2) > 0, "levels lie side by side");
    for angles in [[35.0, 25.0], [200.0, -40.0], [0.0, 0.0]] {
        let (adaptive, whole) = (picture(&mesh, angles), picture(&uniform, angles));
        assert!(whole.pixels.iter().filter(|p| p[3] > 0.5).count() > 1000, "the picture is empty");
        let differences: Vec<f32> = adaptive
            .pixels
            .iter()
            .zip(&whole.pixels)
            .map(|(a, b)| (0..4).map(|c| (a[c] - b[c]).abs()).fold(0.0, f32::max))
            .collect();
        let squares: f64 = differences.iter().map(|d| f64::from(d * d)).sum();
        let rms = (squares / differences.len() as f64).sqrt();
        let largest = differences.iter().copied().fold(0.0, f32::max);
        println!("{angles:?}: rms {rms:.5}, largest {largest:.4}");
        // A seam of a sample at a border is a sixteenth of a brick's opacity.
        assert!(rms < 0.004 && largest < 0.06, "{angles:?}: rms {rms}, largest {largest}");
    }
}

/// A field that is the same everywhere but for one point, on a ring of outer radius 1 and inner radius 0.5.
fn ring(folder: &Path) -> PathBuf {
    let mut text = "# vtk DataFile Version 3.0\nring\nASCII\nDATASET STRUCTURED_GRID\n".to_owned();
    writeln!(text, "DIMENSIONS 65 5 3\nPOINTS 975 double").unwrap();
    let place = |i: usize| [i % 65, i / 65 % 5, i / 325].map(|k| k as f64);
    for [u, v, w] in (0..975).map(place) {
        let (angle, radius) = (u / 64.0 * std::f64::consts::TAU, 0.5 + v / 8.0);
        writeln!(text, "{:?} {:?} {:?}", radius * angle.cos(), radius * angle.sin(), 0.2 * w).unwrap();
    }
    writeln!(text, "POINT_DATA 975\nSCALARS v float 1\nLOOKUP_TABLE default").unwrap();
    (0..975).map(place).for_each(|p| writeln!(text, "{}", 2.0 + 0.1 * p[0]).unwrap());
    let path = folder.join("ring.vtk");
    std::fs::write(&path, text).unwrap();
    path
}

#[test]
fn nothing_is_drawn_beyond_the_mesh() {
    let folder = tempfile::tempdir().unwrap();
    let store = mesh_store(folder.path(), &ring(folder.path()).to_string_lossy(), 4);
    let mut session = Session::open(&store, None, 1 << 30).unwrap();
    let size = [240, 240];
    let transfer = TransferFunction::built_in("filled", ColorMap::Viridis).unwrap();
    let view = View {
        // Along the axis of the ring, without perspective.
        camera: orbit_camera(&session.store().header().grid, [0.0, 0.0], 1.0, None, size).unwrap(),
        transfer: session.resolve(&transfer).unwrap(),
        size,
        step_voxels: 0.5,
        lighting: None,
        opacity_unit: 0.01,
        level: 0,
        coherence: None,
    };
    let image = session.draw(&view, 0).unwrap().image;
    let centre = 119.5;
    let radii = image.pixels.iter().enumerate().filter(|(_, p)| p[3] > 0.0).map(|(i, _)| {
        let [x, y] = [i % 240, i / 240].map(|k| k as f64 - centre);
        x.hypot(y)
    });
    let radii: Vec<f64> = radii.collect();
    // The picture shows the sphere around the box.
    let pixels_per_unit = 120.0 / (1.0f64 + 1.0 + 0.04).sqrt();
    let inner = radii.iter().copied().fold(f64::INFINITY, f64::min) / pixels_per_unit;
    let outer = radii.iter().copied().fold(0.0, f64::max) / pixels_per_unit;
    // A voxel is shown where its sample has data: up to half the diagonal of the coarsest ones, and half a pixel.
    let reach = 0.5 * 3f64.sqrt() * 2.0 / 7.0 / 4.0 + 0.5 / pixels_per_unit;
    assert!((0.5 - reach..=0.5).contains(&inner) && (1.0..=1.0 + reach).contains(&outer), "{inner} {outer}");
    let area = std::f64::consts::PI * (1.0 - 0.25) * pixels_per_unit * pixels_per_unit;
    assert!((radii.len() as f64 / area - 1.0).abs() < 0.1, "{} of {area}", radii.len());
}
