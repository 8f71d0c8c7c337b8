//! Level of detail of cells on real meshes: faces spread by how values vary over time come closer to the picture of all
//! faces than those that the histogram of one step names (bernardon2006, figures 4 and 5).

use std::path::PathBuf;
use std::sync::Arc;

use chronoxel_core::{Background, Camera, ColorMap, Image8, TransferFunction, compare};
use chronoxel_ingest::sources;
use chronoxel_render::{
    CellMesh, CellOptions, CellRenderer, CellScene, FaceChoice, FaceOrder, Variation, static_importance,
};

/// The folder of real data; `None`, said aloud, where there is none.
fn data() -> Option<PathBuf> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
    let folder = PathBuf::from(std::env::var("CHRONOXEL_DATA").unwrap_or_else(|_| default.to_owned()));
    if folder.join("mesh/spx.vtk").exists() {
        return Some(folder);
    }
    let is_required = std::env::var("CHRONOXEL_REQUIRE_DATA").is_ok_and(|v| v == "1");
    assert!(!is_required, "{}: no data", folder.display());
    println!("skipped: {} has no data", folder.display());
    None
}

/// A mesh, its points, and a value at each.
type Field = (Arc<CellMesh>, Vec<[f64; 3]>, Vec<f64>);

/// A mesh and the values of its file, or of its files with a comma in between.
fn mesh_of(files: &str) -> Option<Field> {
    let folder = data()?;
    let paths: Vec<String> = files.split(',').map(|file| folder.join(file).display().to_string()).collect();
    let mut series = sources::open_mesh(&paths, &Default::default()).unwrap();
    let points = series.points().unwrap();
    let mut cells = Vec::new();
    series
        .for_each_tetrahedron(&mut |cell| {
            cells.push(cell);
            Ok(())
        })
        .unwrap();
    let values = series.read_values(0, 0).unwrap().to_f64();
    Some((Arc::new(CellMesh::new(points.clone(), &cells).unwrap()), points, values))
}

/// Places in the box around a mesh: its middle is 0, its longest side 1.
fn places(mesh: &CellMesh, points: &[[f64; 3]]) -> Vec<[f64; 3]> {
    let [low, high] = mesh.bounds();
    let side = (0..3).map(|a| high[a] - low[a]).fold(0.0, f64::max);
    let place = |p: &[f64; 3]| std::array::from_fn(|a| (p[a] - 0.5 * (low[a] + high[a])) / side);
    points.iter().map(place).collect()
}

const NUM_STEPS: usize = 24;

/// Distances in L*u*v* for three fractions, over steps, views and transfer functions.
fn distances(
    mesh: &Arc<CellMesh>,
    steps: &[Vec<f32>],
    choose: &[&dyn Fn(f64) -> Option<FaceChoice>],
) -> Vec<[f64; 3]> {
    let values = || steps.iter().flatten().map(|v| f64::from(*v));
    let range = [values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max)];
    let [low, high] = mesh.bounds();
    let side = (0..3).map(|a| high[a] - low[a]).fold(0.0, f64::max);
    let scene = |(function, azimuth): (&str, f64)| CellScene {
        camera: Camera::orbit(mesh.bounds(), azimuth, 20.0, 1.0, Some(30.0), 1.0).unwrap(),
        transfer: TransferFunction::built_in(function, ColorMap::Turbo).unwrap().resolve(range).unwrap(),
        size: [160, 160],
        lighting: None,
        opacity_unit: side / 128.0,
        value_range: range,
    };
    let scenes = [("ramp", 20.0), ("sparse", 110.0), ("filled", 250.0)].map(scene);
    let mut renderer = CellRenderer::new(Arc::clone(mesh), CellOptions::default()).unwrap();
    let mut draw = |choice: Option<FaceChoice>| -> Vec<Image8> {
        renderer.choose(choice);
        let mut pictures = Vec::new();
        for scene in &scenes {
            for step in [1, 7, 13, 19] {
                let image = renderer.render(scene, &steps[step]).unwrap().0;
                pictures.push(Image8::from_image(&image, Background::Color([0.0; 3])));
            }
        }
        pictures
    };
    let all = draw(None);
    let mut distance = |choice| {
        let some = draw(choice);
        let sum: f64 = all.iter().zip(&some).map(|(a, b)| compare(a, b).unwrap().luv_mean).sum();
        sum / all.len() as f64
    };
    choose.iter().map(|choose| [0.05, 0.1, 0.25].map(|fraction| distance(choose(fraction)))).collect()
}

/// Compares the choices for a series.
fn check(name: &str, mesh: &Arc<CellMesh>, steps: &[Vec<f32>]) {
    let values = || steps.iter().flatten().map(|v| f64::from(*v));
    let range = [values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max)];
    let mut variation = Variation::new(mesh.num_points());
    steps.iter().for_each(|step| variation.push(step));
    let spread = variation.order(mesh, range);
    let most = FaceOrder::by_importance(mesh, &variation.importance(mesh, range));
    let one_step = FaceOrder::by_importance(mesh, &static_importance(mesh, &steps[0], 1));
    let found = distances(
        mesh,
        steps,
        &[&|fraction| spread.choose(fraction), &|fraction| most.choose(fraction), &|fraction| {
            one_step.choose(fraction)
        }],
    );
    println!(
        "{name}, L*u*v* at 5, 10, 25 %: spread {:.3?}, most important {:.3?}, one step {:.3?}",
        found[0], found[1], found[2]
    );
    for (i, distance) in found[0].iter().enumerate() {
        assert!(distance < &found[1][i] && distance < &found[2][i], "{name}");
    }
}

#[test]
fn a_dipole_that_turns_in_the_torso() {
    let Some((mesh, points, _)) = mesh_of("mesh/utah_torso_lowres.vtu") else { return };
    let places = places(&mesh, &points);
    let step = |s: usize| {
        let (sin, cos) = (s as f64 / NUM_STEPS as f64 * std::f64::consts::TAU).sin_cos();
        let value = |p: &[f64; 3]| {
            let squared: f64 = p.iter().map(|x| x * x).sum();
            ((p[0] * cos + p[1] * sin) / (squared + 0.01).powf(1.5)) as f32
        };
        places.iter().map(value).collect()
    };
    check("TORSO, dipole", &mesh, &(0..NUM_STEPS).map(step).collect::<Vec<_>>());
}

#[test]
fn fields_that_fade_and_waves_in_spx() {
    let Some((mesh, points, values)) = mesh_of("mesh/spx.vtk") else { return };
    let fading =
        |s: usize| values.iter().map(|v| (v * (1.0 - s as f64 / (NUM_STEPS - 1) as f64)) as f32).collect();
    check("SPX, fading", &mesh, &(0..NUM_STEPS).map(fading).collect::<Vec<_>>());
    let places = places(&mesh, &points);
    let wave = |s: usize| {
        let time = s as f64 / NUM_STEPS as f64;
        let value = |p: &[f64; 3]| {
            let z = p[2] + 0.5 - time;
            let front = (-(8.0 * z).powi(2)).exp() * (1.0 + 0.5 * (20.0 * p[0]).sin());
            (front + 0.2 * (-6.0 * z.abs()).exp()) as f32
        };
        places.iter().map(value).collect()
    };
    check("SPX, a force that runs through", &mesh, &(0..NUM_STEPS).map(wave).collect::<Vec<_>>());
}

#[test]
fn nothing_is_drawn_out_of_order_from_anywhere() {
    let blunt_fin = "plot3d/bluntfinxyz.bin,plot3d/bluntfinq.bin";
    for (file, k) in [("mesh/utah_torso_lowres.vtu", 6), ("mesh/spx.vtk", 2), (blunt_fin, 2)] {
        let Some((mesh, _, values)) = mesh_of(file) else { return };
        let values: Vec<f32> = values.iter().map(|v| *v as f32).collect();
        let range = values.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], &v| {
            [low.min(v.into()), high.max(v.into())]
        });
        let mut renderer =
            CellRenderer::new(Arc::clone(&mesh), CellOptions { k, ..CellOptions::default() }).unwrap();
        for azimuth in [0.0, 47.0, 94.0, 141.0, 188.0, 235.0, 282.0, 329.0] {
            for fov in [None, Some(40.0)] {
                let scene = CellScene {
                    camera: Camera::orbit(mesh.bounds(), azimuth, azimuth * 0.4 - 60.0, 1.0, fov, 1.0)
                        .unwrap(),
                    transfer: TransferFunction::built_in("ramp", ColorMap::Turbo)
                        .unwrap()
                        .resolve(range)
                        .unwrap(),
                    size: [200, 200],
                    lighting: None,
                    opacity_unit: mesh.bounds()[1][0] - mesh.bounds()[0][0],
                    value_range: range,
                };
                let stats = renderer.render(&scene, &values).unwrap().1;
                assert_eq!(
                    stats.num_misordered, 0,
                    "{file} from {azimuth}, {fov:?}, of {}",
                    stats.num_fragments
                );
            }
        }
    }
}
