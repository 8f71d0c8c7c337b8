//! Meshes that cannot be read: an error of one line that names the file, and the cell or point.

use chronoxel_ingest::sources::{SourceOptions, open, open_mesh};

use crate::files::path;

/// The message for inputs that must be refused when they are opened or read.
fn refusal(inputs: &[String], options: &SourceOptions) -> String {
    let read = || {
        let mut mesh = open_mesh(inputs, options)?;
        mesh.for_each_tetrahedron(&mut |_| Ok(()))?;
        for step in 0..mesh.times().num_steps() {
            mesh.read_values(0, step)?;
        }
        Ok::<_, chronoxel_ingest::SourceError>(())
    };
    let message = read().expect_err("the mesh must be refused").to_string();
    assert!(!message.contains('\n'), "{message}");
    message
}

fn inputs(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| path(name).to_string_lossy().into_owned()).collect()
}

/// The message for a text file in which one piece, which must be there once, was replaced.
fn changed(name: &str, from: &str, to: &str) -> String {
    let text = std::fs::read_to_string(path(name)).unwrap();
    assert_eq!(text.matches(from).count(), 1, "{name}: {from:?}");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join(path(name).file_name().unwrap());
    std::fs::write(&file, text.replace(from, to)).unwrap();
    let message = refusal(&[file.to_string_lossy().into_owned()], &SourceOptions::default());
    assert!(message.contains(&*file.file_name().unwrap().to_string_lossy()), "{message}");
    message
}

#[track_caller]
fn says(message: &str, parts: &[&str]) {
    assert!(parts.iter().all(|part| message.contains(part)), "{message}");
}

#[test]
fn cells_of_a_kind_that_is_not_known() {
    let message = changed("mesh/quadratic.vtu", "          10 24\n", "          10 42\n");
    says(&message, &["quadratic.vtu", "type of cell 1 is 42", "not supported"]);
    let message = changed("mesh/quadratic.vtu", "          10 24\n", "          10 25\n");
    says(&message, &["number of corners of cell 1 is 10", "type 25 has 20"]);
}

#[test]
fn corners_that_are_no_points() {
    let message = changed("mesh/unstructured_ascii_42.vtk", "4 7 10 12 13", "4 7 10 12 15");
    says(&message, &["corner of cell 8 is 15", "15 points"]);
    let message = changed("mesh/unstructured_ascii_42.vtk", "4 7 10 12 13", "4 7 10 12 -1");
    says(&message, &["CELLS is -1"]);
    let message = changed("mesh/unstructured_ascii_42.vtk", "4 7 10 12 13", "5 7 10 12 13");
    says(&message, &["number of corners of cell 8 is 5", "only 4"]);
}

#[test]
fn coordinates_that_are_not_finite() {
    let message = changed("mesh/structured_ascii_51.vtk", "0 0 0 1 0.2 0 2 0.4 0", "0 0 0 1 nan 0 2 0.4 0");
    says(&message, &["position of point 1 is 1.0, NaN, 0.0"]);
    let message = changed("mesh/rectilinear_ascii_51.vtk", "0 1 4 9", "0 1 1 9");
    says(&message, &["coordinate 2 along x is 1", "rise or fall"]);
}

#[test]
fn meshes_without_volume() {
    let text = std::fs::read_to_string(path("mesh/unstructured_ascii_42.vtk")).unwrap();
    let (before, rest) = text.split_once("CELL_TYPES 9\n").unwrap();
    let (types, after) = rest.split_once("\n\n").unwrap_or_else(|| rest.split_once("CELL_DATA").unwrap());
    let flat: String = types.split_whitespace().map(|_| "7\n").collect();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("flat.vtk");
    std::fs::write(&file, format!("{before}CELL_TYPES 9\n{flat}\n{after}")).unwrap();
    let message = refusal(&[file.to_string_lossy().into_owned()], &SourceOptions::default());
    says(&message, &["flat.vtk", "volume of the mesh is 0", "of 9 cells, 9 hold no volume"]);
}

#[test]
fn a_mesh_that_moves() {
    let names = ["mesh_series/step0.vts", "mesh_series/step1.vts", "mesh_series/moved3.vts"];
    let message = refusal(&inputs(&names), &SourceOptions::default());
    says(&message, &["moved3.vts: geometry of step 2 is another", "point 7", "step0.vts"]);
}

#[test]
fn files_that_do_not_agree() {
    let message = refusal(&inputs(&["mesh/ascii.vts", "mesh/ascii.vtu"]), &SourceOptions::default());
    says(&message, &["ascii.vtu: grid is tetrahedral, 15 points, 9 cells", "curvilinear 4 x 3 x 3"]);
    let message = refusal(&inputs(&["mesh/ascii.vts", "vti/ascii.vti"]), &SourceOptions::default());
    says(&message, &["ascii.vti: grid is a uniform grid", "ascii.vts has a mesh"]);
}

#[test]
fn options_that_do_not_fit_a_mesh() {
    let options = SourceOptions { spacing: Some([1.0; 3]), ..SourceOptions::default() };
    says(&refusal(&inputs(&["mesh/ascii.vts"]), &options), &["--spacing is given"]);
    let options = SourceOptions { flat_threshold: Some(f64::NAN), ..SourceOptions::default() };
    says(&refusal(&inputs(&["mesh/ascii.vts"]), &options), &["--flat-threshold NaN"]);
    let volume = inputs(&["vti/ascii.vti"]);
    says(&refusal(&volume, &SourceOptions::default()), &["uniform grid where a mesh is needed"]);
    let mesh = open(&inputs(&["mesh/ascii.vts"]), &SourceOptions::default()).err().unwrap().to_string();
    says(&mesh, &["a curvilinear grid where a uniform one is needed"]);
}
