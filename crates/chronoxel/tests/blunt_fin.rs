//! The Blunt Fin from files to pictures: a field that changes on its mesh, and a picture beside one of the tetrahedra themselves.

use std::path::{Path, PathBuf};
use std::process::Command;

use chronoxel::session::{Session, View};
use chronoxel_core::{Camera, ColorMap, Samples, TransferFunction};
use chronoxel_ingest::sources::{SourceOptions, open_mesh};
use chronoxel_ingest::{Codec, EncodeOptions, VoxelOptions, encode_mesh};
use chronoxel_render::{CellMesh, CellScene, render_cells_reference};
use serde_json::Value;

/// The two files of the Blunt Fin, or `None` where they are absent and need not be there.
fn blunt_fin() -> Option<[String; 2]> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
    let folder = PathBuf::from(std::env::var_os("CHRONOXEL_DATA").unwrap_or_else(|| default.into()));
    let files = ["bluntfinxyz.bin", "bluntfinq.bin"].map(|name| folder.join("plot3d").join(name));
    if files.iter().all(|file| file.is_file()) {
        return Some(files.map(|file| file.to_string_lossy().into_owned()));
    }
    let is_required = std::env::var_os("CHRONOXEL_REQUIRE_DATA").is_some_and(|v| v == "1");
    assert!(!is_required, "CHRONOXEL_REQUIRE_DATA=1, but there is no data in {}", folder.display());
    println!("skipped: there is no data in {}; set CHRONOXEL_DATA", folder.display());
    None
}

/// Runs the command in a folder and gives what it prints with `--json`.
fn chronoxel(folder: &Path, line: &str) -> Value {
    let output = Command::new(env!("CARGO_BIN_EXE_chronoxel"))
        .current_dir(folder)
        .args(line.split(' '))
        .arg("--json")
        .output()
        .unwrap();
    assert!(output.status.success(), "{line}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn a_field_that_changes_is_encoded_played_and_verified() {
    let Some(files) = blunt_fin() else { return };
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let source = format!("sim:fade?mesh={}&steps=16", files.join(","));
    for (how, largest) in [("--codec raw --bits 16", 1e-5), ("--max-error 0.001", 0.001)] {
        let encode = format!("encode {source} --variable density --max-depth 3 {how} -o fin.cxl --overwrite");
        let encoded = chronoxel(folder, &encode);
        assert_eq!(encoded["mesh"]["census"]["num_tetrahedra"], 187_222);

        let verified = chronoxel(folder, &format!("verify fin.cxl --against {source}"));
        assert_eq!(verified["ok"], true, "{verified}");
        let error = verified["variables"]["density"]["max_abs_error"].as_f64().unwrap();
        let range = 4.9775;
        assert!(error > 0.0 && error <= largest * range, "{how}: {error}");

        let played = chronoxel(folder, "play fin.cxl --backend cpu --size 96x72 --orbit 60 --csv frames.csv");
        assert_eq!((&played["frames"], &played["warnings"]), (&16.into(), &Value::Array(Vec::new())));
        assert_eq!((&played["dropped_steps"], &played["stand_ins"]), (&0.into(), &0.into()));
        assert!(played["nodes_per_frame"].as_f64().unwrap() > 10.0, "{played}");
        let rows = std::fs::read_to_string(folder.join("frames.csv")).unwrap();
        let steps: Vec<&str> = rows.lines().skip(1).filter_map(|row| row.split(',').nth(1)).collect();
        assert_eq!(steps, (0..16).map(|step| step.to_string()).collect::<Vec<_>>());

        // It fades: from what there was to nothing.
        let mut session = Session::open(&folder.join("fin.cxl"), None, 1 << 30).unwrap();
        let view = view_of(&session, bounds_of(&files), [48, 36]);
        let sums: Vec<f64> = (0..16)
            .map(|step| session.draw(&view, step).unwrap().image.pixels)
            .map(|pixels| pixels.iter().map(|p| f64::from(p[3])).sum())
            .collect();
        assert!(sums[0] > 10.0 && sums[15] < 0.01 * sums[0], "{sums:?}");
        assert!(sums.windows(2).all(|pair| pair[1] < pair[0]), "{sums:?}");
    }
}

fn bounds_of(files: &[String; 2]) -> [[f64; 3]; 2] {
    let points = open_mesh(files, &SourceOptions::default()).unwrap().points().unwrap();
    points.iter().fold([[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]], |[low, high], p| {
        [std::array::from_fn(|a| low[a].min(p[a])), std::array::from_fn(|a| high[a].max(p[a]))]
    })
}

/// The whole mesh, seen from upstream and above.
fn view_of(session: &Session, bounds: [[f64; 3]; 2], size: [usize; 2]) -> View {
    let aspect = size[0] as f64 / size[1] as f64;
    let transfer = TransferFunction::built_in("ramp", ColorMap::Viridis).unwrap();
    View {
        camera: Camera::orbit(bounds, 145.0, 35.0, 1.5, Some(30.0), aspect).unwrap(),
        transfer: session.resolve(&transfer).unwrap(),
        size,
        step_voxels: 0.5,
        lighting: None,
        opacity_unit: 0.03,
        level: 0,
        coherence: None,
        level_borders: Default::default(),
    }
}

/// Pixels along an edge of the picture. At 512, and at depth 5, it is 52 dB, but the reference takes minutes.
const EDGE: usize = 160;

#[test]
fn the_picture_is_that_of_the_tetrahedra() {
    let Some(files) = blunt_fin() else { return };
    let options = SourceOptions { variables: vec!["density".into()], ..SourceOptions::default() };
    let mut mesh = open_mesh(&files, &options).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("fin.cxl");
    let options = EncodeOptions {
        codec: Codec::Raw,
        voxels: VoxelOptions { field_threshold: 0.0, max_depth: 3 },
        ..EncodeOptions::default()
    };
    encode_mesh(mesh.as_mut(), &store, &options, &mut |_| {}).unwrap();
    let mut session = Session::open(&store, None, 2 << 30).unwrap();
    let view = view_of(&session, bounds_of(&files), [EDGE; 2]);
    let picture = session.draw(&view, 0).unwrap().image;

    let mut tetrahedra = Vec::new();
    mesh.for_each_tetrahedron(&mut |cell| {
        tetrahedra.push(cell);
        Ok(())
    })
    .unwrap();
    let cells = CellMesh::new(mesh.points().unwrap(), &tetrahedra).unwrap();
    let values = match mesh.read_values(0, 0).unwrap() {
        Samples::F32(values) => values,
        Samples::F64(values) => values.iter().map(|v| *v as f32).collect(),
    };
    let scene = CellScene {
        camera: view.camera,
        transfer: view.transfer.clone(),
        size: view.size,
        lighting: None,
        opacity_unit: view.opacity_unit,
        value_range: session.variable_range(),
    };
    let reference = render_cells_reference(&cells, &scene, &values).unwrap();
    let pairs = || picture.pixels.iter().flatten().zip(reference.pixels.iter().flatten());
    let squares: f64 = pairs().map(|(a, b)| f64::from(a - b).powi(2)).sum();
    let psnr_db = -10.0 * (squares / pairs().count() as f64).log10();
    let opacity: Vec<f32> = reference.pixels.iter().map(|p| p[3]).filter(|a| *a > 0.0).collect();
    let mean_opacity = opacity.iter().sum::<f32>() / opacity.len() as f32;
    println!("{psnr_db:.2} dB; {} pixels of mean opacity {mean_opacity:.2}", opacity.len());
    assert!(opacity.len() > EDGE * EDGE / 5 && mean_opacity > 0.4, "there is little to see");
    assert!(psnr_db >= 35.0, "{psnr_db} dB");
}
