//! PLOT3D in all its forms.

use chronoxel_core::SampleType;
use chronoxel_ingest::sources::{SourceOptions, open_mesh};
use chronoxel_ingest::{GridType, MeshSeries, SourceError};

use crate::conformity::Walked;
use crate::files::path;

fn open_files(names: &[String], options: &SourceOptions) -> Result<Box<dyn MeshSeries>, SourceError> {
    let inputs: Vec<String> =
        names.iter().map(|name| path(&format!("plot3d/{name}")).to_string_lossy().into_owned()).collect();
    open_mesh(&inputs, options)
}

/// The forms that `make_meshes.py` writes.
fn forms() -> impl Iterator<Item = [bool; 5]> {
    (0..32).map(|bits| std::array::from_fn(|bit| bits >> bit & 1 == 1))
}

fn name([big, wide, records, iblank, counted]: [bool; 5]) -> String {
    let word = |is, yes: &'static str, no: &'static str| if is { yes } else { no };
    [
        word(big, "big", "little"),
        word(wide, "f8", "f4"),
        word(records, "records", "plain"),
        word(iblank, "iblank", "all"),
        word(counted, "blocks", "one"),
    ]
    .join("_")
}

/// Indices of the points of a block.
fn indices([nx, ny, nz]: [usize; 3]) -> impl Iterator<Item = [f64; 3]> {
    (0..nx * ny * nz).map(move |p| [p % nx, p / nx % ny, p / (nx * ny)].map(|n| n as f64))
}

#[test]
fn every_form_is_found_and_read() {
    for form @ [_, wide, _, iblank, counted] in forms() {
        let name = name(form);
        let files = [format!("{name}.q"), format!("{name}.xyz")];
        let mut mesh =
            open_files(&files, &SourceOptions::default()).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(mesh.grid_type(), GridType::Curvilinear);
        assert_eq!(mesh.dims(), (!counted).then_some([4, 3, 3]));
        assert_eq!(mesh.times().times, [1.25]);
        let sample_type = if wide { SampleType::F64 } else { SampleType::F32 };
        assert!(mesh.variables().iter().all(|v| v.sample_type == sample_type));
        let walked = Walked::of(mesh.as_mut());
        let blocks: &[([usize; 3], f64)] =
            if counted { &[([4, 3, 3], 0.0), ([3, 3, 2], 100.0)] } else { &[([4, 3, 3], 0.0)] };
        let all = || blocks.iter().flat_map(|(dims, shift)| indices(*dims).map(move |p| (p, *shift)));
        assert_eq!(walked.points.len(), all().count());
        for (point, ([i, j, k], shift)) in walked.points.iter().zip(all()) {
            let expected = [i + 0.1 * j * k + shift, 2.0 * j + 0.2 * i, k + 0.05 * i * j];
            assert!((0..3).all(|axis| (point[axis] - expected[axis]).abs() < 1e-5), "{name}: {point:?}");
        }
        // One corner of every block is blanked, and a cell with it.
        let (num_cells, num_blocks) = if counted { (12 + 4, 2) } else { (12, 1) };
        let num_blanked = if iblank { num_blocks } else { 0 };
        assert_eq!((walked.census.cells.hexahedra, walked.census.num_blanked), (num_cells, num_blanked));
        assert_eq!(walked.census.num_tetrahedra, 5 * (num_cells - num_blanked));
        walked.volume();
        walked.surface();
        check_values(mesh.as_mut(), &all().map(|(index, _)| index).collect::<Vec<_>>());
    }
}

/// A variable by its name, and its value at the indices of a point.
type Expected<'a> = (&'a str, &'a dyn Fn([f64; 3]) -> f64);

fn check_values(mesh: &mut dyn MeshSeries, points: &[[f64; 3]]) {
    let expected: [Expected<'_>; 6] = [
        ("density", &|[i, j, k]| i + 10.0 * j + 100.0 * k + 1.0),
        ("momentum_x", &|[i, ..]| i + 3.0),
        ("momentum_y", &|[_, j, _]| 4.0 * j),
        ("momentum_z", &|_| 0.0),
        ("momentum_magnitude", &|[i, j, _]| (i + 3.0).hypot(4.0 * j)),
        ("energy", &|[i, ..]| 1000.0 + i),
    ];
    for (variable, (name, value)) in expected.into_iter().enumerate() {
        assert_eq!(mesh.variables()[variable].name, name);
        for (read, point) in mesh.read_values(variable, 0).unwrap().to_f64().iter().zip(points) {
            assert!((read - value(*point)).abs() <= 1e-6, "{name} at {point:?}: {read}");
        }
    }
}

#[test]
fn several_solutions_are_a_series() {
    let files = ["big_f4_plain_all_one.xyz", "big_f4_plain_all_one.q", "little_f4_records_all_one.q"];
    let files = files.map(str::to_owned);
    let refused = open_files(&files, &SourceOptions::default()).err().unwrap().to_string();
    assert!(refused.contains("time is 1.25") && refused.contains("--dt"), "{refused}");
    let options = SourceOptions { dt: Some(0.5), ..SourceOptions::default() };
    let mut mesh = open_files(&files, &options).unwrap();
    assert_eq!(mesh.times().times, [0.0, 0.5]);
    assert_eq!(mesh.read_values(0, 0).unwrap(), mesh.read_values(0, 1).unwrap());
}

#[test]
fn what_does_not_belong_together_is_refused() {
    let refused = |names: &[&str]| {
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        let message = open_files(&names, &SourceOptions::default()).err().unwrap().to_string();
        assert!(!message.contains('\n'), "{message}");
        message
    };
    let alone = refused(&["big_f4_plain_all_one.xyz"]);
    assert!(alone.contains("name its solution files too"), "{alone}");
    let no_grid = refused(&["big_f4_plain_all_one.q"]);
    assert!(
        no_grid.contains("no binary PLOT3D grid") && no_grid.contains("4 x 3 x 3 would need 444"),
        "{no_grid}"
    );
    let other = refused(&["big_f4_plain_all_one.xyz", "big_f4_plain_all_blocks.q"]);
    assert!(other.contains("number of blocks is 2") && other.contains("has 1"), "{other}");
    let two = refused(&["big_f4_plain_all_one.xyz", "big_f8_plain_all_one.xyz"]);
    assert!(two.contains("a second PLOT3D grid"), "{two}");
}

#[test]
fn bin_files_are_plot3d_unless_dims_are_given() {
    let folder = tempfile::tempdir().unwrap();
    let copy = |from: &str, to: &str| {
        let to = folder.path().join(to);
        std::fs::copy(path(&format!("plot3d/{from}")), &to).unwrap();
        to.to_string_lossy().into_owned()
    };
    let inputs = [copy("big_f4_plain_all_one.xyz", "xyz.bin"), copy("big_f4_plain_all_one.q", "q.bin")];
    assert_eq!(open_mesh(&inputs, &SourceOptions::default()).unwrap().num_points(), 36);
    let options = SourceOptions { dims: Some([4, 3, 3]), ..SourceOptions::default() };
    let refused = open_mesh(&inputs, &options).err().unwrap().to_string();
    assert!(refused.contains("--dtype is missing"), "{refused}");
    let alone = open_mesh(&inputs[1..], &SourceOptions::default()).err().unwrap().to_string();
    assert!(alone.contains("--dims is missing"), "{alone}");
}
