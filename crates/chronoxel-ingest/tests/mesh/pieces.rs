//! Meshes in several pieces are what they are in one.

use std::fmt::Write as _;
use std::path::Path;

use chronoxel_ingest::sources::{SourceOptions, open_mesh};
use chronoxel_ingest::{MeshSeries, SourceError};

use crate::conformity::{Walked, close};
use crate::files::path;

/// Points along x, y, z of the whole lattice, whose first point has these indices.
const DIMS: [i64; 3] = [5, 3, 4];
const FIRST: [i64; 3] = [2, 0, -1];

fn indices([x0, x1, y0, y1, z0, z1]: [i64; 6]) -> impl Iterator<Item = [f64; 3]> {
    (z0..=z1)
        .flat_map(move |k| (y0..=y1).flat_map(move |j| (x0..=x1).map(move |i| [i, j, k].map(|n| n as f64))))
}

fn point([i, j, k]: [f64; 3]) -> [f64; 3] {
    [i + 0.1 * j * k, 2.0 * j + 0.2 * i, k + 0.05 * i * j]
}

fn value([i, j, k]: [f64; 3]) -> f64 {
    i + 10.0 * j + 100.0 * k
}

fn whole() -> [i64; 6] {
    std::array::from_fn(|n| FIRST[n / 2] + if n % 2 == 0 { 0 } else { DIMS[n / 2] - 1 })
}

fn text(numbers: impl Iterator<Item = f64>) -> String {
    numbers.fold(String::new(), |mut text, n| {
        write!(text, "{n:?} ").unwrap();
        text
    })
}

fn shown(extent: [i64; 6]) -> String {
    extent.map(|n| n.to_string()).join(" ")
}

fn array(name: &str, components: usize, numbers: impl Iterator<Item = f64>) -> String {
    let numbers = text(numbers);
    format!(
        "<DataArray type=\"Float64\" Name=\"{name}\" NumberOfComponents=\"{components}\" format=\"ascii\">{numbers}</DataArray>"
    )
}

/// A structured piece.
fn curved(extent: [i64; 6]) -> String {
    format!(
        "<Piece Extent=\"{}\"><PointData>{}</PointData><Points>{}</Points></Piece>",
        shown(extent),
        array("v", 1, indices(extent).map(value)),
        array("Points", 3, indices(extent).flat_map(point))
    )
}

/// A rectilinear piece.
fn straight(extent: [i64; 6]) -> String {
    let axis = |a: usize| {
        let places = (extent[2 * a]..=extent[2 * a + 1]).map(|i| (i * i * i) as f64 + i as f64);
        array(["x", "y", "z"][a], 1, places)
    };
    format!(
        "<Piece Extent=\"{}\"><PointData>{}</PointData><Coordinates>{}{}{}</Coordinates></Piece>",
        shown(extent),
        array("v", 1, indices(extent).map(value)),
        axis(0),
        axis(1),
        axis(2)
    )
}

fn file(folder: &Path, name: &str, kind: &str, attributes: &str, pieces: &[String]) -> String {
    let text = format!(
        "<VTKFile type=\"{kind}\" byte_order=\"LittleEndian\"><{kind} {attributes}>{}</{kind}></VTKFile>",
        pieces.concat()
    );
    let path = folder.join(name);
    std::fs::write(&path, text).unwrap();
    path.to_string_lossy().into_owned()
}

fn opened(path: &str) -> Result<Box<dyn MeshSeries>, SourceError> {
    open_mesh(&[path.to_owned()], &SourceOptions::default())
}

fn everything(path: &str) -> (Walked, Vec<f64>, Option<[usize; 3]>) {
    let mut mesh = opened(path).unwrap_or_else(|e| panic!("{e}"));
    let walked = Walked::of(mesh.as_mut());
    let values = mesh.read_values(0, 0).unwrap().to_f64();
    (walked, values, mesh.dims())
}

/// The whole lattice cut at x = 4 and z = 1, with a layer of ghosts.
fn parts() -> Vec<[i64; 6]> {
    let [x0, x1, y0, y1, z0, z1] = whole();
    vec![[x0, 4, y0, y1, z0, 1], [4, x1, y0, y1, z0, 1], [x0, x1, y0, y1, 0, z1]]
}

#[test]
fn lattices_in_pieces() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    for (kind, extension, piece) in [
        ("StructuredGrid", "vts", curved as fn([i64; 6]) -> String),
        ("RectilinearGrid", "vtr", straight as fn([i64; 6]) -> String),
    ] {
        let attributes = format!("WholeExtent=\"{}\"", shown(whole()));
        let at_once = file(folder, &format!("whole.{extension}"), kind, &attributes, &[piece(whole())]);
        let pieces: Vec<String> = parts().into_iter().map(piece).collect();
        let in_pieces = file(folder, &format!("pieces.{extension}"), kind, &attributes, &pieces);
        let sources: Vec<String> = (0..3)
            .map(|n| {
                let name = format!("part{n}.{extension}");
                let attributes = format!("WholeExtent=\"{}\"", shown(parts()[n]));
                file(folder, &name, kind, &attributes, &[piece(parts()[n])]);
                format!("<Piece Extent=\"{}\" Source=\"{name}\"/>", shown(parts()[n]))
            })
            .collect();
        let parallel = file(folder, &format!("all.p{extension}"), &format!("P{kind}"), &attributes, &sources);
        let (expected, values, dims) = everything(&at_once);
        assert_eq!(dims, Some(DIMS.map(|n| n as usize)));
        for path in [in_pieces.clone(), parallel] {
            let (found, of_points, found_dims) = everything(&path);
            assert_eq!((found_dims, of_points), (dims, values.clone()), "{path}");
            assert_eq!(found.points, expected.points, "{path}");
            assert_eq!(found.tetrahedra, expected.tetrahedra, "{path}");
        }
        let note = opened(&in_pieces).unwrap().notes();
        assert!(note[0].contains("3 pieces"), "{note:?}");
        let gap = file(folder, &format!("gap.{extension}"), kind, &attributes, &pieces[1..]);
        let message = opened(&gap).err().unwrap().to_string();
        assert!(message.contains("gap.") && message.contains("in no piece"), "{message}");
    }
}

/// Two cubes whose common face is warped, each a piece; the second has a ghost of the first.
fn cubes(with_ghost: bool) -> Vec<String> {
    let corners = |first: f64| {
        let square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        [0.0, 1.0].into_iter().flat_map(move |z| {
            square.into_iter().map(move |[x, y]| [x + first, y, z + 0.3 * (x + first) * y * (1.0 - z)])
        })
    };
    let piece = |firsts: &[f64]| {
        let points: Vec<[f64; 3]> = firsts.iter().flat_map(|first| corners(*first)).collect();
        let whole = |name: &str, numbers: Vec<usize>| array(name, 1, numbers.into_iter().map(|n| n as f64));
        format!(
            "<Piece NumberOfPoints=\"{}\" NumberOfCells=\"{}\"><PointData>{}</PointData><Points>{}</Points><Cells>{}{}{}</Cells></Piece>",
            points.len(),
            firsts.len(),
            array("v", 1, points.iter().map(|p| p[0])),
            array("Points", 3, points.iter().flatten().copied()),
            whole("connectivity", (0..points.len()).collect()),
            whole("offsets", (1..=firsts.len()).map(|n| 8 * n).collect()),
            whole("types", vec![12; firsts.len()])
        )
    };
    let empty = "<Piece NumberOfPoints=\"0\" NumberOfCells=\"0\"></Piece>".to_owned();
    vec![piece(&[0.0]), empty, piece(if with_ghost { &[1.0, 0.0] } else { &[1.0] })]
}

#[test]
fn cells_in_pieces_share_the_points_between_them() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    for with_ghost in [false, true] {
        let pieces = cubes(with_ghost);
        let in_one = file(folder, "cubes.vtu", "UnstructuredGrid", "", &pieces);
        for (n, piece) in pieces.iter().enumerate() {
            file(folder, &format!("cubes{n}.vtu"), "UnstructuredGrid", "", std::slice::from_ref(piece));
        }
        let sources = [0, 2].map(|n| format!("<Piece Source=\"cubes{n}.vtu\"/>"));
        let parallel = file(folder, "cubes.pvtu", "PUnstructuredGrid", "GhostLevel=\"1\"", &sources);
        for path in [in_one, parallel] {
            let (walked, values, _) = everything(&path);
            assert_eq!(walked.census.num_duplicate, u64::from(with_ghost));
            // The surface of two cubes, no face of which lies between them.
            assert_eq!((walked.tetrahedra.len(), walked.surface().len()), (10, 20));
            assert!(close(walked.volume(), walked.census.volume));
            assert!(values.iter().zip(&walked.points).all(|(value, point)| *value == point[0]));
        }
    }
}

#[test]
fn pieces_that_do_not_fit_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut pieces = cubes(false);
    pieces[2] = pieces[2].replace("Name=\"v\"", "Name=\"w\"");
    let path = file(folder.path(), "other.vtu", "UnstructuredGrid", "", &pieces);
    let message = opened(&path).err().unwrap().to_string();
    assert!(message.contains("other.vtu") && message.contains("array \"v\""), "{message}");
    let sources = ["<Piece Source=\"nowhere.vtu\"/>".to_owned()];
    let path = file(folder.path(), "lost.pvtu", "PUnstructuredGrid", "", &sources);
    let message = opened(&path).err().unwrap().to_string();
    assert!(message.contains("nowhere.vtu"), "{message}");
    let of_cells =
        cubes(false)[0].replace("<PointData>", "<CellData>").replace("</PointData>", "</CellData>");
    let path = file(folder.path(), "cells.vtu", "UnstructuredGrid", "", &[of_cells]);
    let message = opened(&path).err().unwrap().to_string();
    assert!(message.contains("array \"v\"") && message.contains("vtkCellDataToPointData"), "{message}");
}

#[test]
fn cells_of_higher_order_are_taken_by_their_corners() {
    let mut mesh = opened(&path("mesh/quadratic.vtu").to_string_lossy()).unwrap();
    let walked = Walked::of(mesh.as_mut());
    assert_eq!(walked.census.num_curved, 1);
    assert!(walked.census.cells.tetrahedra >= 1);
}
