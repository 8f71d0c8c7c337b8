//! Pictures of meshes: bricks of several levels side by side show no seams, nothing is drawn beyond the mesh, and its
//! boundary shows no stripes.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use chronoxel::session::{LevelBorders, Session, View, orbit_camera};
use chronoxel_core::{
    Background, Camera, ColorMap, Image, Image8, TransferDomain, TransferFunction, TransferPoint,
    difference_picture,
};
use chronoxel_ingest::voxelise::sample_points;
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

/// A field on a rectilinear grid over the unit cube whose layers become thinner towards one corner.
fn stretched(folder: &Path, field: fn([f64; 3]) -> f64) -> PathBuf {
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
        level_borders: Default::default(),
    };
    let picture = session.draw(&view, 0).unwrap();
    assert!(picture.warnings.is_empty(), "{:?}", picture.warnings);
    picture.image
}

#[test]
fn levels_side_by_side_show_no_seams() {
    let folder = tempfile::tempdir().unwrap();
    let source = stretched(folder.path(), field);
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

/// Lit shells of a curved field: where levels jump, shells break.
fn shells(store: &Path, level_borders: LevelBorders, memory_bytes: u64) -> Image {
    let mut session = Session::open(store, None, memory_bytes).unwrap();
    let size = [160, 160];
    let bump = |x: f64| {
        let point = |x: f64, opacity: f32| TransferPoint { x, color: [0.9, 0.8, 0.6], opacity };
        [point(x - 0.02, 0.0), point(x, 0.8), point(x + 0.02, 0.0)]
    };
    let points: Vec<TransferPoint> = [0.3, 0.5, 0.7].into_iter().flat_map(bump).collect();
    let ends = [0.0, 1.0].map(|x| TransferPoint { x, color: [0.9, 0.8, 0.6], opacity: 0.0 });
    let points = [&ends[..1], &points, &ends[1..]].concat();
    let view = View {
        camera: orbit_camera(&session.store().header().grid, [215.0, -25.0], 1.2, Some(30.0), size).unwrap(),
        transfer: session.resolve(&TransferFunction::new(points, TransferDomain::Variable).unwrap()).unwrap(),
        size,
        step_voxels: 0.5,
        lighting: None,
        opacity_unit: 1.0 / 56.0,
        level: 0,
        coherence: None,
        level_borders,
    };
    session.draw(&view, 0).unwrap().image
}

#[test]
fn portions_change_nothing_where_borders_are_filtered() {
    let folder = tempfile::tempdir().unwrap();
    let curved = |[x, y, z]: [f64; 3]| (3.0 * x).sin() * (2.0 * y).cos() + z * z;
    let store = mesh_store(folder.path(), &stretched(folder.path(), curved).to_string_lossy(), 3);
    let sharp = shells(&store, LevelBorders::Sharp, 1 << 30);
    let filtered = shells(&store, LevelBorders::Filtered, 1 << 30);
    if let Some(folder) = std::env::var_os("CHRONOXEL_PICTURES") {
        for (name, image) in [("sharp.png", &sharp), ("filtered.png", &filtered)] {
            let black = Background::Color([0.0; 3]);
            std::fs::write(Path::new(&folder).join(name), image.to_png(black)).unwrap();
        }
    }
    let num_changed = sharp.pixels.iter().zip(&filtered.pixels).filter(|(a, b)| a != b).count();
    assert!(num_changed > 500, "{num_changed} pixels differ");
    // About 15 bricks at a time.
    assert!(filtered == shells(&store, LevelBorders::Filtered, 3 << 20));
}

/// A structured grid with a value at each point; both are told the indices of a point, and `value` its place.
fn structured(
    path: &Path,
    dims: [usize; 3],
    point: impl Fn([f64; 3]) -> [f64; 3],
    value: impl Fn([f64; 3], [f64; 3]) -> f64,
) -> PathBuf {
    let [nx, ny, nz] = dims;
    let num = nx * ny * nz;
    let mut text = "# vtk DataFile Version 3.0\ncurved\nASCII\nDATASET STRUCTURED_GRID\n".to_owned();
    writeln!(text, "DIMENSIONS {nx} {ny} {nz}\nPOINTS {num} double").unwrap();
    let indices = |i: usize| [i % nx, i / nx % ny, i / (nx * ny)].map(|k| k as f64);
    for [x, y, z] in (0..num).map(|i| point(indices(i))) {
        writeln!(text, "{x:?} {y:?} {z:?}").unwrap();
    }
    writeln!(text, "POINT_DATA {num}\nSCALARS v float 1\nLOOKUP_TABLE default").unwrap();
    for i in (0..num).map(indices) {
        writeln!(text, "{}", value(i, point(i)) as f32).unwrap();
    }
    std::fs::write(path, text).unwrap();
    path.to_owned()
}

/// A field that is the same everywhere but for one point, on a ring of outer radius 1 and inner radius 0.5.
fn ring(folder: &Path) -> PathBuf {
    let point = |[u, v, w]: [f64; 3]| {
        let (angle, radius) = (u / 64.0 * std::f64::consts::TAU, 0.5 + v / 8.0);
        [radius * angle.cos(), radius * angle.sin(), 0.2 * w]
    };
    structured(&folder.join("ring.vtk"), [65, 5, 3], point, |[u, ..], _| 2.0 + 0.1 * u)
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
        level_borders: Default::default(),
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

/// Values of the twisted bar lie above this.
const LEAST: f64 = 3.0;

/// A bar twisted by a quarter turn, with a linear field between 3 and 7.
fn bar(folder: &Path) -> PathBuf {
    let point = |[u, v, w]: [f64; 3]| {
        let (sin, cos) = (w / 16.0 * std::f64::consts::FRAC_PI_2).sin_cos();
        let [x, y] = [u, v].map(|k| k / 8.0 - 0.5);
        [x * cos - y * sin, x * sin + y * cos, w / 8.0]
    };
    structured(&folder.join("bar.vtk"), [9, 9, 17], point, |_, [x, y, z]| 5.0 + x + y - 0.5 * (z - 1.0))
}

/// Opaque: red below all values of the bar, from dark to bright green within them.
fn surface(store: &Path) -> Image {
    let mut session = Session::open(store, None, 1 << 30).unwrap();
    let bounds = [[-0.71, -0.71, 0.0], [0.71, 0.71, 2.0]];
    let point = |x: f64, color: [f32; 3]| TransferPoint { x, color, opacity: 1.0 };
    let (red, dark, bright) = ([1.0, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 1.0, 0.0]);
    let points = vec![point(0.0, red), point(LEAST - 0.05, red), point(LEAST, dark), point(7.0, bright)];
    let size = [64, 64];
    let view = View {
        camera: Camera::orbit(bounds, 35.0, 25.0, 1.15, Some(30.0), 1.0).unwrap(),
        transfer: session.resolve(&TransferFunction::new(points, TransferDomain::Data).unwrap()).unwrap(),
        size,
        step_voxels: 0.5,
        lighting: None,
        opacity_unit: 0.02,
        level: 0,
        coherence: None,
        level_borders: Default::default(),
    };
    let picture = session.draw(&view, 0).unwrap();
    assert!(picture.warnings.is_empty(), "{:?}", picture.warnings);
    picture.image
}

/// The bar's field on a uniform grid, zero where there is no mesh.
fn filled_with_zeros(folder: &Path, source: &Path) -> PathBuf {
    let mut mesh = sources::open_mesh(&[source.to_string_lossy().into_owned()], &Default::default()).unwrap();
    let at = |i: usize| [i % N, i / N % N, i / N / N].map(|k| k as f64 / (N - 1) as f64);
    let place = |i: usize| {
        let [x, y, z] = at(i);
        [2.0 * x - 1.0, 2.0 * y - 1.0, 2.0 * z]
    };
    let points: Vec<[f64; 3]> = (0..N * N * N).map(place).collect();
    let found = sample_points(mesh.as_mut(), 0, 0, &points).unwrap();
    let samples: Vec<u8> =
        found.iter().flat_map(|v| (if v.is_nan() { 0.0 } else { *v as f32 }).to_le_bytes()).collect();
    let raw = folder.join("zeros.raw");
    std::fs::write(&raw, samples).unwrap();
    let hints = sources::SourceOptions {
        dims: Some([N; 3]),
        sample_type: Some(chronoxel_core::SampleType::F32),
        spacing: Some([2.0 / (N - 1) as f64; 3]),
        origin: Some([-1.0, -1.0, 0.0]),
        ..Default::default()
    };
    let mut series = sources::open(&[raw.to_string_lossy().into_owned()], &hints).unwrap();
    let path = folder.join("zeros.cxl");
    encode(series.as_mut(), &path, &options(0), &mut |_| {}).unwrap();
    path
}

/// Pixels that show values which the bar does not have.
fn num_striped(image: &Image) -> usize {
    image.pixels.iter().filter(|p| p[0] > 0.02).count()
}

#[test]
fn the_boundary_is_clipped_without_stripes() {
    let folder = tempfile::tempdir().unwrap();
    let source = bar(folder.path());
    let image = surface(&mesh_store(folder.path(), &source.to_string_lossy(), 3));
    let covered = |i: usize| image.pixels[i][3] > 0.5;
    assert!((0..64 * 64).filter(|&i| covered(i)).count() > 500, "the picture is empty");
    // As the paper's figure 5 before and after.
    let striped = num_striped(&surface(&filled_with_zeros(folder.path(), &source)));
    assert!(striped > 200, "{striped}: the test would not see stripes");
    assert_eq!(num_striped(&image), 0);
    assert_golden("mesh_boundary", &image);
    // Opaque wherever most of what is around is: the silhouette has steps of a voxel, but what it encloses no gaps.
    let inside = (2..62).flat_map(|y| (2..62).map(move |x| [x, y])).filter(|[x, y]| {
        let around = (y - 2..=y + 2).flat_map(|y| (x - 2..=x + 2).map(move |x| y * 64 + x));
        around.filter(|i| covered(*i)).count() >= 22
    });
    let inside: Vec<[usize; 2]> = inside.collect();
    assert!(inside.len() > 400, "{}", inside.len());
    for [x, y] in inside {
        let pixel = image.pixels[y * 64 + x];
        assert!(pixel[3] > 0.99, "{pixel:?} at {x}, {y}");
    }
}

/// Pixels of a golden of 64x64 that may be off by more than `TOLERANCE`.
const MOST_FAILED: usize = 20;
const TOLERANCE: u8 = 3;

/// Holds a picture against tests/golden; on failure it, what was expected and the difference are written. With CHRONOXEL_GOLDEN=write the
/// picture becomes the golden.
fn assert_golden(name: &str, image: &Image) {
    let black = Background::Color([0.0; 3]);
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/golden/{name}.png"));
    if std::env::var_os("CHRONOXEL_GOLDEN").is_some_and(|v| v == "write") {
        std::fs::create_dir_all(golden.parent().unwrap()).unwrap();
        std::fs::write(&golden, image.to_png(black)).unwrap();
    }
    let decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(&golden).unwrap()));
    let mut reader = decoder.read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    let samples = info.color_type.samples();
    let pixels: Vec<[u8; 4]> = bytes.chunks_exact(samples).map(|p| [p[0], p[1], p[2], 255]).collect();
    let expected = Image8 { width: info.width as usize, height: info.height as usize, pixels };
    let actual = Image8::from_image(image, black);
    assert_eq!((actual.width, actual.height), (expected.width, expected.height));
    let is_off = |(a, e): &(&[u8; 4], &[u8; 4])| (0..3).any(|c| a[c].abs_diff(e[c]) > TOLERANCE);
    let num_failed = actual.pixels.iter().zip(&expected.pixels).filter(is_off).count();
    if num_failed > MOST_FAILED {
        let folder = std::env::temp_dir().join("chronoxel-pictures").join(name);
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join("actual.png"), image.to_png(black)).unwrap();
        std::fs::copy(&golden, folder.join("expected.png")).unwrap();
        let difference = difference_picture(&actual, &expected, 16).unwrap();
        write_png(&folder.join("difference.png"), &difference);
        panic!(
            "{name}: {num_failed} pixels are off by more than {TOLERANCE}; pictures in {}",
            folder.display()
        );
    }
}

fn write_png(path: &Path, image: &Image8) {
    let file = std::fs::File::create(path).unwrap();
    let mut encoder = png::Encoder::new(file, image.width as u32, image.height as u32);
    encoder.set_color(png::ColorType::Rgba);
    encoder.write_header().unwrap().write_image_data(image.pixels.as_flattened()).unwrap();
}
