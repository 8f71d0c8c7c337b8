//! Wrong usage: status 2, and a message that says what would be right.

use tempfile::tempdir;

use crate::command::{done, run};

#[test]
fn wrong_usage_has_status_2_and_says_what_would_be_right() {
    let folder = tempdir().unwrap();
    for (line, says) in [
        ("", "Usage"),
        ("paint", "unrecognized subcommand"),
        ("encode", "--output"),
        ("encode a.npy -o b", ".cxl"),
        ("encode a.npy -o b.cxl --codec raw --bits 12", "8 or 16"),
        ("encode a.npy -o b.cxl --bits 0", "0.01 to 32"),
        ("encode a.npy -o b.cxl --codec vq --bits 1", "--window and --stages"),
        ("encode a.npy -o b.cxl --codec palette --window 5", "1, 2, 4, 8 or 16"),
        ("encode a.npy -o b.cxl --codec raw --window 4", "each step by itself"),
        ("encode a.npy -o b.cxl --codec vq --stages 9", "1, 2 or 3"),
        ("encode a.npy -o b.cxl --codec vq --max-error 0.1", "--codec auto"),
        ("encode a.npy -o b.cxl --codec zip", "possible values"),
        ("encode a.npy -o b.cxl --bits 8 --max-error 0.1", "cannot be used with"),
        ("encode a.npy -o b.cxl --brick 33", "8, 16, 32, 64 or 128"),
        ("encode a.npy -o b.cxl --codec jpeg", "possible values"),
        ("encode a.npy -o b.cxl --resume --overwrite", "cannot be used with"),
        ("encode a.npy -o b.cxl --range 2:1", "MIN:MAX"),
        ("encode a.npy -o b.cxl --max-error -1", "-1"),
        ("encode a.npy -o b.cxl --spacing 1,2", "X,Y,Z"),
        ("encode a.raw -o b.cxl --dims 3x4", "NXxNYxNZ"),
        ("encode a.raw -o b.cxl --dtype u12", "u12"),
        ("encode a.npy -o b.cxl --dt 0", "above zero"),
        ("info", "<SOURCE>"),
        ("info ''", "a value is required"),
        ("encode '' -o b.cxl", "a value is required"),
        ("movie a.cxl -o ''", "a value is required"),
        ("verify", "<STORE>"),
        ("verify a.cxl --steps 0:2", "--against"),
        ("export a.cxl", "--output"),
        ("export a.cxl -o b.npy --steps 1:2:0", "0:10:2"),
        ("render a.cxl", "--output"),
        ("render a.cxl -o b.png -t -1", "\"-1\" is not a time step"),
        ("render a.cxl -o b.png -t 1 --time 2", "cannot be used with"),
        ("render a.cxl -o b.png --size 0x4", "1024x768"),
        ("render a.cxl -o b.png --size 640", "WxH"),
        ("render a.cxl -o b.png --background pink", "#RRGGBB"),
        ("render a.cxl -o b.png --colormap jet", "viridis"),
        ("render a.cxl -o b.png --step 0", "0.01 to 2"),
        ("render a.cxl -o b.png --step 3", "0.01 to 2"),
        ("render a.cxl -o b.png --fov 180", "179"),
        ("render a.cxl -o b.png --zoom 0", "above zero"),
        ("render a.cxl -o b.png --azimuth north", "not a number"),
        ("render a.cxl -o b.png --ortho --fov 20", "cannot be used with"),
        ("render a.cxl -o b.png --camera c.json --azimuth 20", "cannot be used with"),
        ("render a.cxl -o b.png --lighting dim", "possible values"),
        ("render a.cxl -o b.png --method magic", "possible values"),
        ("render a.cxl -o b.png --backend abacus", "possible values"),
        ("render a.cxl -o b.png --opacity-unit -2", "-2"),
        ("render a.cxl -o b.png --metric taste", "color-approximate"),
        ("render a.cxl -o b.png --spatial-tolerance -1", "-1"),
        ("render a.cxl -o b.png --temporal-tolerance some", "not a number"),
        ("play a.cxl --image-cache much", "512MiB"),
        ("bench ellsworth1999", "ellsworth2000"),
        ("render a.cxl -o b.png --threads 0", "1 to 1024"),
        ("render a.cxl -o b.png --memory lots", "512MiB"),
        ("render a.cxl -o b.png -v -q", "cannot be used with"),
        ("movie a.cxl -o b.gif --fps 0", "0.1 to 240"),
        ("movie a.cxl -o b.gif --frames 0", "100000"),
        ("movie a.cxl -o b.gif --orbit nan", "not a number"),
        ("movie a.cxl -o b.gif --steps -1", "0:10:2"),
        ("play a.cxl --warm perhaps", "possible values"),
        ("compare a.png", "<B>"),
        ("demo --size huge", "possible values"),
        ("bench", "<NAME>"),
        ("bench nonsense", "lum2001"),
        ("bench lum2001 --size huge", "possible values"),
        ("bench lum2001 --source ''", "a value is required"),
    ] {
        let ran = run(folder.path(), line);
        assert_eq!(ran.status, 2, "{line}: {ran:#?}");
        assert_eq!(ran.stdout, "", "{line}: {ran:#?}");
        assert!(ran.stderr.contains(says), "no {says:?} in {line}: {ran:#?}");
    }
    assert!(crate::files::names_in(folder.path()).is_empty());
}

#[test]
fn every_verb_explains_itself_with_an_example() {
    let folder = tempdir().unwrap();
    assert!(done(folder.path(), "--version").stdout.starts_with("chronoxel 0"));
    let overview = done(folder.path(), "--help").stdout;
    for verb in ["demo", "encode", "info", "verify", "export", "render", "movie", "play", "compare", "bench"]
    {
        assert!(overview.contains(&format!("  {verb} ")), "{overview}");
        let help = done(folder.path(), &format!("{verb} --help")).stdout;
        assert!(help.contains(&format!("  chronoxel {verb} ")), "{help}");
        for option in ["--json", "--threads", "--memory", "--verbose", "--quiet"] {
            assert!(help.contains(option), "{verb}: {help}");
        }
    }
}

#[test]
fn quiet_is_quiet() {
    let folder = tempdir().unwrap();
    for line in [
        "encode 'sim:plume?dims=8&steps=2' -o p.cxl -q",
        "export p.cxl -o p.npy -q",
        "render p.cxl -o p.png --size 16x16 -q",
        "movie p.cxl -o p.gif --size 16x16 -q",
    ] {
        assert_eq!(done(folder.path(), line).stdout, "", "{line}");
    }
}
