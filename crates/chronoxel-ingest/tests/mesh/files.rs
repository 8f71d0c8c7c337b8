//! Meshes in the formats of VTK, written by VTK in every encoding.

use std::path::PathBuf;

use chronoxel_core::SampleType;
use chronoxel_ingest::sources::{SourceOptions, open, open_mesh};
use chronoxel_ingest::{GridType, MeshSeries};

use crate::conformity::{Walked, close};

/// What `make_meshes.py` calls its variants of XML files.
const VARIANTS: [&str; 6] =
    ["ascii", "inline_plain_32", "inline_zlib_64", "base64_lz4_32", "raw_plain_64", "raw_zlib_32"];

/// What it calls its variants of legacy files.
const LEGACY: [&str; 4] = ["ascii_42", "ascii_51", "binary_42", "binary_51"];

pub fn path(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

pub fn mesh(name: &str) -> Box<dyn MeshSeries> {
    open_mesh(&[path(name).to_string_lossy().into_owned()], &SourceOptions::default()).unwrap()
}

/// Indices of the points of the lattices.
fn indices() -> impl Iterator<Item = [f64; 3]> {
    (0..36).map(|p| [p % 4, p / 4 % 3, p / 12].map(f64::from))
}

/// Holds the values of a lattice against the rule that `make_meshes.py` states.
fn check_values(mesh: &mut dyn MeshSeries, num_steps: usize) {
    let names: Vec<&str> = mesh.variables().iter().map(|v| v.name.as_str()).collect();
    assert_eq!(names, ["scalar", "vector_0", "vector_1", "vector_2"]);
    let types: Vec<SampleType> = mesh.variables().iter().map(|v| v.sample_type).collect();
    assert_eq!(types, [SampleType::F32, SampleType::F64, SampleType::F64, SampleType::F64]);
    assert_eq!(mesh.times().num_steps(), num_steps);
    for step in 0..num_steps {
        let expected: Vec<f64> =
            indices().map(|[i, j, k]| i + 10.0 * j + 100.0 * k + 1000.0 * step as f64).collect();
        assert_eq!(mesh.read_values(0, step).unwrap().to_f64(), expected);
        for axis in 0..3 {
            let expected: Vec<f64> = indices().map(|index| index[axis]).collect();
            assert_eq!(mesh.read_values(1 + axis, step).unwrap().to_f64(), expected);
        }
    }
}

fn check_curvilinear(mesh: &mut dyn MeshSeries) {
    assert_eq!((mesh.grid_type(), mesh.dims()), (GridType::Curvilinear, Some([4, 3, 3])));
    let walked = Walked::of(mesh);
    for (point, [i, j, k]) in walked.points.iter().zip(indices()) {
        let expected = [i + 0.1 * j * k, 2.0 * j + 0.2 * i, k + 0.05 * i * j];
        assert!((0..3).all(|axis| (point[axis] - expected[axis]).abs() < 1e-6), "{point:?} {expected:?}");
    }
    assert_eq!(walked.census.num_tetrahedra, 5 * 3 * 2 * 2);
    assert_eq!(walked.surface().len(), 2 * 2 * (6 + 6 + 4));
    assert!(close(walked.volume(), walked.census.volume));
}

fn check_rectilinear(mesh: &mut dyn MeshSeries) {
    assert_eq!((mesh.grid_type(), mesh.dims()), (GridType::Rectilinear, Some([4, 3, 3])));
    let walked = Walked::of(mesh);
    let axes = [[0.0, 1.0, 4.0, 9.0], [0.0, 2.0, 5.0, 0.0], [0.0, 1.0, 3.0, 0.0]];
    for (point, index) in walked.points.iter().zip(indices()) {
        assert_eq!(*point, std::array::from_fn(|axis| axes[axis][index[axis] as usize]));
    }
    assert_eq!(walked.census.num_tetrahedra, 5 * 3 * 2 * 2);
    assert!(close(walked.volume(), 9.0 * 5.0 * 3.0));
    assert!(mesh.notes().is_empty());
}

fn check_unstructured(mesh: &mut dyn MeshSeries) {
    let points = check_unstructured_geometry(mesh);
    assert_eq!(mesh.variables().len(), 1);
    let expected: Vec<f64> = points.iter().map(|[x, y, z]| x + 2.0 * y + 4.0 * z).collect();
    assert_eq!(mesh.read_values(0, 0).unwrap().to_f64(), expected);
}

/// Holds cells and tetrahedra against what `mixed` in `make_meshes.py` makes; gives the points.
fn check_unstructured_geometry(mesh: &mut dyn MeshSeries) -> Vec<[f64; 3]> {
    assert_eq!((mesh.grid_type(), mesh.dims()), (GridType::Unstructured, None));
    let walked = Walked::of(mesh);
    let cells = walked.census.cells;
    assert_eq!((cells.tetrahedra, cells.hexahedra, cells.wedges, cells.pyramids), (1, 2, 1, 1));
    assert_eq!((cells.without_volume, cells.total()), (4, 9));
    assert_eq!(walked.census.num_tetrahedra, 1 + 2 * 5 + 3 + 2);
    assert_eq!((walked.census.num_flat, walked.census.num_inverted), (0, 0));
    // Two cubes, a pyramid, a wedge, a tetrahedron.
    assert!(close(walked.volume(), 2.0 + 1.0 / 3.0 + 1.0 / 2.0 + 1.0 / 6.0));
    walked.surface();
    walked.points
}

#[test]
fn xml_files_in_every_encoding() {
    for variant in VARIANTS {
        let mut mesh = mesh(&format!("mesh/{variant}.vts"));
        check_curvilinear(mesh.as_mut());
        check_values(mesh.as_mut(), 1);
        let mut mesh = self::mesh(&format!("mesh/{variant}.vtr"));
        check_rectilinear(mesh.as_mut());
        check_values(mesh.as_mut(), 1);
        check_unstructured(self::mesh(&format!("mesh/{variant}.vtu")).as_mut());
    }
}

#[test]
fn legacy_files_in_every_encoding() {
    for variant in LEGACY {
        let mut mesh = mesh(&format!("mesh/structured_{variant}.vtk"));
        check_curvilinear(mesh.as_mut());
        check_values(mesh.as_mut(), 1);
        assert_eq!(mesh.times().times, [2.5]);
        let mut mesh = self::mesh(&format!("mesh/rectilinear_{variant}.vtk"));
        check_rectilinear(mesh.as_mut());
        check_values(mesh.as_mut(), 1);
        check_unstructured(self::mesh(&format!("mesh/unstructured_{variant}.vtk")).as_mut());
    }
}

#[test]
fn legacy_structured_points_are_a_uniform_grid() {
    for variant in LEGACY {
        let path = path(&format!("mesh/points_{variant}.vtk"));
        let mut series = open(&[path.to_string_lossy().into_owned()], &SourceOptions::default()).unwrap();
        let grid = series.grid();
        assert_eq!((grid.dims, grid.origin, grid.spacing), ([4, 3, 3], [1.0, -2.0, 3.0], [0.5, 2.0, 0.25]));
        let values = series.open_step(0, 0).unwrap().read_slices(3).unwrap().to_f64();
        assert_eq!(values, indices().map(|[i, j, k]| i + 10.0 * j + 100.0 * k).collect::<Vec<f64>>());
    }
}

#[test]
fn positions_of_eight_bytes_are_not_rounded() {
    let points = mesh("mesh/f8.vts").points().unwrap();
    for (point, [i, j, k]) in points.iter().zip(indices()) {
        assert_eq!(*point, [i + 0.1 * j * k, 2.0 * j + 0.2 * i, k + 0.05 * i * j]);
    }
}

#[test]
fn a_rectilinear_grid_that_is_uniform_says_so() {
    let mut mesh = mesh("mesh/even.vtr");
    assert!(mesh.notes()[0].contains("evenly spaced"), "{:?}", mesh.notes());
    // Its third coordinate falls: all tetrahedra were turned, none of them against the others.
    let walked = Walked::of(mesh.as_mut());
    assert_eq!(walked.census.num_inverted, 0);
    assert!(close(walked.volume(), 3.0 * 4.0 * 1.0));
}

#[test]
fn hidden_points_and_cells_are_left_out() {
    for name in ["mesh/hidden.vts", "mesh/hidden.vtk"] {
        let mut mesh = mesh(name);
        let walked = Walked::of(mesh.as_mut());
        assert_eq!((walked.census.cells.hexahedra, walked.census.num_blanked), (12, 2), "{name}");
        assert_eq!(walked.census.num_tetrahedra, 5 * 10);
        // The flags themselves are no variable.
        check_values(mesh.as_mut(), 1);
    }
}

#[test]
fn files_are_a_series_with_their_times() {
    let mut mesh = mesh("mesh_series/step[0-9].vts");
    assert_eq!(mesh.times().times, [0.5, 0.75, 2.0]);
    check_curvilinear(mesh.as_mut());
    check_values(mesh.as_mut(), 3);
    // The geometry can be asked for again.
    check_curvilinear(mesh.as_mut());
    let mut collection = self::mesh("mesh_series/run.pvd");
    assert_eq!(collection.times().times, [0.0, 10.0, 20.0]);
    check_values(collection.as_mut(), 3);
}

#[test]
fn variables_can_be_chosen_and_values_be_none() {
    let options = SourceOptions {
        variables: vec!["vector_1".to_owned(), "scalar".to_owned()],
        fill_value: Some(2.0),
        ..SourceOptions::default()
    };
    let input = [path("mesh/ascii.vts").to_string_lossy().into_owned()];
    let mut mesh = open_mesh(&input, &options).unwrap();
    let names: Vec<&str> = mesh.variables().iter().map(|v| v.name.as_str()).collect();
    assert_eq!(names, ["vector_1", "scalar"]);
    for (value, [_, j, _]) in mesh.read_values(0, 0).unwrap().to_f64().iter().zip(indices()) {
        assert!(if j == 2.0 { value.is_nan() } else { *value == j });
    }
}

#[test]
fn a_mesh_that_fades() {
    let file = path("mesh/ascii.vtu");
    let open = |spec: String| open_mesh(&[spec], &SourceOptions::default());
    let mut fading = open(format!("sim:fade?mesh={}&steps=5", file.display())).unwrap();
    check_unstructured_geometry(fading.as_mut());
    assert_eq!(fading.times().num_steps(), 5);
    let first = mesh("mesh/ascii.vtu").read_values(0, 0).unwrap().to_f64();
    for (step, left) in [1.0, 0.75, 0.5, 0.25, 0.0].into_iter().enumerate() {
        let expected: Vec<f64> = first.iter().map(|value| value * left).collect();
        assert_eq!(fading.read_values(0, step).unwrap().to_f64(), expected);
    }
    let refused = open("sim:fade?steps=5".to_owned()).err().unwrap().to_string();
    assert!(refused.contains("name the files of a mesh"), "{refused}");
}
