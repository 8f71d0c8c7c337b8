//! Real data from file to picture, by the command that a user runs: two data sets are encoded, held against the
//! numbers of the index that comes with them, verified against their files, and drawn.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use chronoxel_ingest::decode_step;
use chronoxel_store::Store;
use serde_json::Value;

/// Largest error, in units of the variable's range.
const MAX_ERROR: f64 = 0.001;

/// The folder of data sets, or `None` where it is absent and need not be there.
fn data() -> Option<PathBuf> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data");
    let folder = PathBuf::from(std::env::var_os("CHRONOXEL_DATA").unwrap_or_else(|| default.into()));
    if folder.join("isabel").is_dir() {
        return Some(folder);
    }
    let is_required = std::env::var_os("CHRONOXEL_REQUIRE_DATA").is_some_and(|v| v == "1");
    assert!(!is_required, "CHRONOXEL_REQUIRE_DATA=1, but there is no data in {}", folder.display());
    println!("skipped: there is no data in {}; set CHRONOXEL_DATA", folder.display());
    None
}

/// Runs the command and gives what it prints with `--json`.
fn chronoxel(arguments: &[&str]) -> Value {
    let output =
        Command::new(env!("CARGO_BIN_EXE_chronoxel")).args(arguments).arg("--json").output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {errors}");
    serde_json::from_slice(&output.stdout).unwrap()
}

/// A data set, encoded.
struct Encoded {
    folder: tempfile::TempDir,
    source: String,
}

impl Encoded {
    fn new(source: &Path) -> Self {
        let encoded =
            Self { folder: tempfile::tempdir().unwrap(), source: source.to_string_lossy().into_owned() };
        let max_error = MAX_ERROR.to_string();
        chronoxel(&["encode", &encoded.source, "-o", &encoded.store(), "--max-error", &max_error]);
        encoded
    }

    fn store(&self) -> String {
        self.folder.path().join("a.cxl").to_string_lossy().into_owned()
    }

    /// Holds minimum, maximum and mean of a step against the index, which gives six digits: what the store decodes to
    /// within the bound on errors, and within what the store says of the source over the spans that hold the step.
    fn check_step(&self, step: u32, [min, max, mean]: [f64; 3]) {
        let store = Store::open(Path::new(&self.store())).unwrap();
        let (mut found, mut count) = ([f64::INFINITY, f64::NEG_INFINITY], 0);
        for span in store.spans(0, 0, step).unwrap() {
            found = [found[0].min(span.statistics.min), found[1].max(span.statistics.max)];
            assert_eq!(span.statistics.count % u64::from(span.len), 0);
            count += span.statistics.count / u64::from(span.len);
        }
        assert_eq!(count as usize, store.header().grid.num_samples());
        let near = 1e-6 * (max - min);
        assert!(
            found[0] <= min + near && found[1] >= max - near,
            "step {step}: {found:?} for {min} to {max}"
        );

        let range = store.header().variables[0].max.unwrap() - store.header().variables[0].min.unwrap();
        let samples = decode_step(&store, 0, step as usize).unwrap();
        let low = samples.iter().copied().fold(f64::INFINITY, f64::min);
        let high = samples.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let decoded = [low, high, samples.iter().sum::<f64>() / samples.len() as f64];
        assert_near(step, decoded, [min, max, mean], 1e-6 + MAX_ERROR * range);
    }

    /// Checks that no sample is further off than was asked for.
    fn check_errors(&self, variable: &str, at_least_db: f64) {
        let report = chronoxel(&["verify", &self.store(), "--against", &self.source]);
        assert_eq!(report["ok"], true, "{report}");
        let errors = &report["variables"][variable];
        let largest = errors["max_abs_error"].as_f64().unwrap();
        assert!(largest > 0.0 && largest <= MAX_ERROR, "{report}");
        assert!(errors["psnr_db"].as_f64().unwrap() >= at_least_db, "{report}");
    }

    /// Draws a step as wide as it is high, seen along an axis and without lighting; gives the brightness of pixels.
    fn draw(&self, step: u32, azimuth: &str) -> Vec<Vec<f64>> {
        let path = self.folder.path().join("picture.png").to_string_lossy().into_owned();
        let step = step.to_string();
        let view =
            ["--ortho", "--elevation", "0", "--size", "64x64", "--lighting", "off", "--azimuth", azimuth];
        let fixed =
            ["render", &self.store(), "-t", &step, "-o", &path, "--tf", "filled", "--colormap", "gray"];
        chronoxel(&[&fixed[..], &view[..]].concat());
        let decoder = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path).unwrap()));
        let mut reader = decoder.read_info().unwrap();
        let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut bytes).unwrap();
        assert_eq!((info.width, info.height), (64, 64));
        let samples = info.color_type.samples();
        let pixel = |pixel: &[u8]| f64::from(pixel[0]) + f64::from(pixel[1]) + f64::from(pixel[2]);
        bytes.chunks(64 * samples).take(64).map(|row| row.chunks(samples).map(pixel).collect()).collect()
    }
}

fn assert_near(step: u32, found: [f64; 3], listed: [f64; 3], tolerance: f64) {
    for (found, listed) in found.into_iter().zip(listed) {
        let message = format!("decoded, step {step}: {found} where the index has {listed}");
        assert!((found - listed).abs() <= tolerance, "{message}");
    }
}

/// Average brightness of a part of a picture.
fn brightness(picture: &[Vec<f64>], rows: std::ops::Range<usize>, columns: std::ops::Range<usize>) -> f64 {
    let count = rows.len() * columns.len();
    picture[rows].iter().flat_map(|row| &row[columns.clone()]).sum::<f64>() / count as f64
}

#[test]
fn viscous_fingers_from_files_to_pictures() {
    let Some(data) = data() else { return };
    let encoded = Encoded::new(&data.join("viscousfingers/*.vti"));
    let info = chronoxel(&["info", &encoded.store()]);
    assert_eq!(info["grid"]["dims"], serde_json::json!([64, 64, 64]));
    assert_eq!((&info["num_steps"], &info["complete"]), (&40.into(), &true.into()));
    encoded.check_step(0, [0.0, 76.763237, 3.882204]);
    encoded.check_step(39, [0.0, 113.590172, 9.950352]);
    encoded.check_errors("ImageFile", 60.0);

    // The salt enters at the end of z, over a disc of the cylinder that the box is around.
    let along_z = encoded.draw(0, "0");
    let (centre, corner) = (brightness(&along_z, 28..36, 28..36), brightness(&along_z, 14..16, 14..16));
    assert!(centre > 20.0 && centre > 1.5 * corner, "centre {centre}, corner of the box {corner}");
    let along_x = encoded.draw(0, "90");
    let (late, early) = (brightness(&along_x, 28..36, 14..20), brightness(&along_x, 28..36, 44..50));
    assert!(
        late > 20.0 && late > 2.0 * early,
        "from +x z grows to the left: {late} there, {early} at the right"
    );
}

#[test]
fn hurricane_isabel_from_files_to_pictures() {
    let Some(data) = data() else { return };
    let encoded = Encoded::new(&data.join("isabel/*.vti"));
    let info = chronoxel(&["info", &encoded.store()]);
    assert_eq!(info["grid"]["dims"], serde_json::json!([125, 125, 25]));
    // The hours between the two runs are missing.
    assert_eq!(info["times"], serde_json::json!([2.0, 3.0, 4.0, 5.0, 30.0, 31.0, 32.0, 33.0]));
    encoded.check_step(0, [0.0, 68.245478, 10.207427]);
    encoded.check_errors("velocityMag", 60.0);

    let picture = encoded.draw(4, "0");
    let (inside, outside) = (brightness(&picture, 20..44, 20..44), brightness(&picture, 0..4, 0..64));
    assert!(inside > 20.0 && outside == 0.0, "{inside} over the storm, {outside} beside the box");
}
