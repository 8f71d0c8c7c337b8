//! What `info` says about grids that are not uniform.

use serde_json::json;
use tempfile::tempdir;

use crate::{
    command::{done, json, refused},
    files::fixture,
};

#[test]
fn info_counts_what_a_mesh_consists_of() {
    let folder = tempdir().unwrap();
    let mixed = fixture("mesh/raw_zlib_32.vtu");
    let report = json(folder.path(), &format!("info {mixed}"));
    let grid = &report["grid"];
    assert_eq!((&grid["type"], &grid["num_cells"]), (&json!("tetrahedral"), &json!(9)));
    assert_eq!(grid["bounds"], json!([[0.0, 0.0, 0.0], [2.0, 1.0, 2.0]]));
    assert_eq!(grid["cells_left_out"]["without_volume"], 4);
    assert_eq!((&grid["tetrahedra"]["kept"], &grid["tetrahedra"]["flat"]), (&json!(16), &json!(0)));
    assert!((grid["tetrahedra"]["volume"].as_f64().unwrap() - 3.0).abs() < 1e-12);
    assert_eq!(report["variables"]["scalar"]["max"], 11.5);

    let text = done(folder.path(), &format!("info {mixed}")).stdout;
    for line in ["source     tetrahedral\n", "1 wedges", "tetrahedra 16 kept; volume 3\n", "4 without volume"]
    {
        assert!(text.contains(line), "{line:?} is missing in {text}");
    }
}

#[test]
fn info_knows_plot3d_and_rectilinear_grids() {
    let folder = tempdir().unwrap();
    let pair = ["xyz", "q"].map(|kind| fixture(&format!("plot3d/big_f4_plain_iblank_one.{kind}")));
    let report = json(folder.path(), &format!("info {}", pair.join(" ")));
    assert_eq!(
        (&report["grid"]["type"], &report["grid"]["dims"]),
        (&json!("curvilinear"), &json!([4, 3, 3]))
    );
    assert_eq!(report["grid"]["cells_left_out"]["blanked"], 1);
    assert_eq!(report["times"], json!([1.25]));
    let even = done(folder.path(), &format!("info {}", fixture("mesh/even.vtr"))).stdout;
    assert!(even.contains("rectilinear 4 x 3 x 3") && even.contains("evenly spaced"), "{even}");
    refused(folder.path(), &format!("info {}", pair[0]), &["name its solution files too"]);
}
