//! Stores of cells on the command line: made, described, verified, exported.

use serde_json::json;
use tempfile::tempdir;

use crate::command::{at, done, json, number, refused, run};

const SOURCE: &str = "'sim:twist?dims=8&steps=70'";

#[test]
fn cells_are_encoded_described_and_verified() {
    let folder = tempdir().unwrap();
    let report =
        json(folder.path(), &format!("encode {SOURCE} -o a.cxl --as cells --entries 32 --max-error 0.01"));
    assert_eq!(number(&report, "raw_bytes"), (2 * 70 * 512 * 4) as f64);
    assert_eq!(number(&report, "cells.num_tetrahedra"), (5 * 7 * 7 * 7) as f64);
    assert_eq!(number(&report, "steps_read"), 70.0);
    assert!(number(&report, "ratio") > 1.0 && number(&report, "cells.paper_ratio") > 1.0);

    let info = json(folder.path(), "info a.cxl");
    assert_eq!((at(&info, "kind"), at(&info, "grid.type")), (&json!("store"), &json!("curvilinear")));
    assert_eq!(number(&info, "cells.num_points"), 512.0);
    assert_eq!((number(&info, "num_levels"), number(&info, "payloads.empty")), (0.0, 0.0));
    assert!(number(&info, "payloads.coded") >= 2.0 * 2.0);
    assert_eq!(number(&info, "stored_bytes"), number(&report, "stored_bytes"));
    let text = done(folder.path(), "info a.cxl").stdout;
    for word in ["512 from (", "1715 tetrahedra", "bernardon2006", "pulse"] {
        assert!(text.contains(word), "{word:?} is missing in {text}");
    }

    let found = json(folder.path(), &format!("verify a.cxl --against {SOURCE}"));
    assert_eq!(at(&found, "ok"), &json!(true));
    for variable in ["pulse", "slope"] {
        let errors = at(at(&found, "variables"), variable);
        assert_eq!(errors, at(at(&found, "cells"), variable));
        assert!(number(errors, "max_abs_error") <= 0.01, "{errors}");
        assert_eq!(errors["snr_db"].as_array().unwrap().len(), 2, "{errors}");
    }
    let text = done(folder.path(), &format!("verify a.cxl --against {SOURCE} --steps 3:5")).stdout;
    assert!(text.contains("a.cxl: sound") && text.contains("SNR of blocks"), "{text}");

    let export = json(folder.path(), "export a.cxl --steps 66 -o step.vtu --variable slope");
    assert_eq!((at(&export, "variable"), at(&export, "sample_type")), (&json!("slope"), &json!("f32")));
    // What was exported is a mesh that can be read again.
    let again = json(folder.path(), "info step.vtu");
    assert_eq!(number(&again, "grid.num_cells"), 1715.0);
    done(folder.path(), "export a.cxl --steps 60:68:3 -o some.pvd");
    assert_eq!(number(&json(folder.path(), "info some.pvd"), "num_steps"), 3.0);
    refused(folder.path(), "export a.cxl -o all.vtu", &["number of time steps is 70", ".pvd"]);
    refused(folder.path(), "export a.cxl -o all.npy", &["cells are exported as .vtu or .pvd"]);
    refused(folder.path(), "verify a.cxl --against 'sim:twist?dims=9&steps=70'", &["number of points 729"]);
    refused(folder.path(), &format!("encode {SOURCE} -o a.cxl --as cells"), &["already exists"]);

    let damaged = folder.path().join("a.cxl/pulse/C0/S0/c.0.0");
    let mut bytes = std::fs::read(&damaged).unwrap();
    bytes[9] ^= 4;
    std::fs::write(&damaged, bytes).unwrap();
    let ran = run(folder.path(), "verify a.cxl");
    assert!(ran.status == 1 && ran.stdout.contains("pulse/C0/S0/c.0.0"), "{ran:#?}");
}

#[test]
fn bricks_and_cells_live_in_one_store() {
    let folder = tempdir().unwrap();
    let source = "'sim:twist?dims=8&steps=2'";
    let line = format!("encode {source} -o a.cxl --as both --brick 8 --max-depth 1 --variable pulse");
    let report = json(folder.path(), &line);
    assert_eq!(number(&report, "cells.num_points"), 512.0);
    assert!(folder.path().join("a.cxl/_cells/zarr.json").is_file());
    let info = json(folder.path(), "info a.cxl");
    assert!(number(&info, "brick.edge") == 8.0 && number(&info, "cells.num_points") == 512.0);
    // Its bricks are counted without its cells.
    assert_eq!(number(&info, "stored_bytes"), number(&report, "stored_bytes"));
    let text = done(folder.path(), "info a.cxl").stdout;
    assert!(text.contains("levels of bricks") && text.contains("1715 tetrahedra"), "{text}");
    assert_eq!(at(&json(folder.path(), &format!("verify a.cxl --against {source}")), "ok"), &json!(true));
    done(folder.path(), "export a.cxl --steps 1 -o step.vtu");
    done(folder.path(), "export a.cxl --steps 1 -o step.vti");
    // A resume finds all of it done.
    let again = json(folder.path(), &format!("{line} --resume"));
    assert_eq!((number(&again, "steps_read"), number(&again, "cells.steps_read")), (0.0, 0.0));
    let overwritten = json(folder.path(), &format!("encode {source} -o a.cxl --as cells --overwrite"));
    assert_eq!(number(&overwritten, "cells.steps_read"), 2.0);
    assert!(!folder.path().join("a.cxl/nodes").exists());
    refused(folder.path(), "export a.cxl --steps 1 -o step.nrrd", &[".vtu or .pvd"]);
}

#[test]
fn what_cells_do_not_have_is_refused() {
    let folder = tempdir().unwrap();
    let uniform = "encode 'sim:vortex?dims=8&steps=2' -o a.cxl --as cells";
    refused(folder.path(), uniform, &["uniform grid", "leave --as out"]);
    for (option, of) in [("--bits 4", "bricks"), ("--codec vq", "bricks"), ("--max-depth 2", "bricks")] {
        let ran = run(folder.path(), &format!("encode {SOURCE} -o a.cxl --as cells {option}"));
        assert!(ran.status == 2 && ran.stderr.contains(of), "{ran:#?}");
    }
    let ran = run(folder.path(), &format!("encode {SOURCE} -o a.cxl --entries 4"));
    assert!(ran.status == 2 && ran.stderr.contains("--entries is of cells"), "{ran:#?}");
    let few = format!("encode {SOURCE} -o a.cxl --as cells --entries 1");
    refused(folder.path(), &few, &["--entries 1", "2 to 1024"]);
}
