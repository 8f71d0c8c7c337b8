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

#[test]
fn levels_are_filtered_at_their_borders_where_that_is_asked_for() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    done(
        folder,
        "encode sim:twist?dims=17&steps=2 --brick 8 --max-depth 3 --field-threshold 0.1 -o t.cxl -q",
    );
    let picture = "render t.cxl --size 80x60 --tf filled --step 0.25";
    done(folder, &format!("{picture} --backend cpu -o sharp.png -q"));
    let report = json(folder, &format!("{picture} --level-borders filtered -o filtered.png"));
    assert_eq!(report["backend"], "cpu");
    let compared = json(folder, "compare sharp.png filtered.png");
    // They differ at the borders and nowhere else.
    let psnr = compared["psnr_db"].as_f64().unwrap();
    assert!((30.0..90.0).contains(&psnr), "{compared}");
    done(folder, "play t.cxl --size 40x30 --level-borders filtered --target-fps 200 -q");
    refused(
        folder,
        &format!("{picture} --level-borders filtered --backend gpu -o x.png"),
        &["--level-borders filtered", "leave out --backend gpu"],
    );
}
