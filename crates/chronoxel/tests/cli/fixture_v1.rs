//! The committed store of format version 1 through the command line: listed tables, windows of four steps, masks,
//! empty bricks, and two bricks of level 0 that only their parents have.
//!
//! Its samples have a closed form, written down beside the program that made it (`chronoxel-store/tests/fixture`).

use std::{fs, path::Path};

use tempfile::tempdir;

use crate::{
    command::{at, done, json},
    files::{copy_folder, picture},
};

const DIMS: [usize; 3] = [24, 16, 8];
const NUM_STEPS: usize = 10;

fn fixture_in(folder: &Path) {
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("../chronoxel-store/tests/fixtures/v1.cxl");
    copy_folder(&fixture, &folder.join("v1.cxl"));
}

/// `temperature` at a place of level 0; the bricks (0, 1, 0) and (2, 1, 0) are those of level 1, between its samples.
fn temperature(step: usize, [x, y, z]: [usize; 3]) -> Option<f64> {
    if x / 8 == 1 {
        // The windows of brick (1, 0, 0) begin at steps 0, 1, 5, 9; of (1, 1, 0) at 0, 4, 8.
        let start = if y < 8 { if step == 0 { 0 } else { (step - 1) / 4 * 4 + 1 } } else { step / 4 * 4 };
        return Some(200.0 + 0.25 * ((x * y + z + 7 * ((step - start) >> 1)) % 300) as f64);
    }
    let even = x % 2 == 0 && y % 2 == 0 && z % 2 == 0;
    (y < 8 || even).then_some(280.0 + 0.5 * (x + 2 * y + 3 * z) as f64 + 0.125 * ((x + step) % 8) as f64)
}

/// `dye`, where 255 is missing; `None` between the samples of level 1.
fn dye(step: usize, [x, y, z]: [usize; 3]) -> Option<u8> {
    let slope = 3 * x + 5 * y + 7 * z;
    let even = x % 2 == 0 && y % 2 == 0 && z % 2 == 0;
    Some(match (x / 8, y / 8) {
        (0, 0) => ((slope + step % 2) % 250) as u8,
        (1, 0) if x >= 12 => 255,
        (1, 0) => (7 + (y + step) % 5) as u8,
        (1, _) => 17,
        (2, 0) if step % 2 == 1 && z != 0 => 42,
        (2, 0) => 255,
        _ if even => (slope % 250) as u8,
        _ => return None,
    })
}

/// Every step and place, in the order of the file, with its number.
fn places() -> impl Iterator<Item = (usize, usize, [usize; 3])> {
    let num_samples = DIMS.iter().product::<usize>();
    let place = |i: usize| [i % 24, i / 24 % 16, i / 384];
    (0..NUM_STEPS).flat_map(move |s| (0..num_samples).map(move |i| (s * num_samples + i, s, place(i))))
}

#[test]
fn it_is_sound_and_exported_as_its_closed_form() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    fixture_in(folder);
    assert_eq!(at(&json(folder, "verify v1.cxl"), "ok"), true);
    let info = json(folder, "info v1.cxl");
    assert_eq!([at(&info, "format_version"), at(&info, "num_steps")], [1, NUM_STEPS]);
    done(folder, "export v1.cxl -o temperature.npy -q");
    done(folder, "export v1.cxl --variable dye -o dye.npy -q");
    let samples = |name: &str, sample_bytes: usize| {
        let bytes = fs::read(folder.join(name)).unwrap();
        bytes[bytes.len() - sample_bytes * NUM_STEPS * DIMS.iter().product::<usize>()..].to_vec()
    };
    let temperatures = samples("temperature.npy", 4);
    let dyes = samples("dye.npy", 1);
    let mut num_checked = 0;
    for (number, step, place) in places() {
        if let Some(due) = temperature(step, place) {
            let found = f32::from_le_bytes(temperatures[4 * number..][..4].try_into().unwrap());
            assert_eq!(f64::from(found), due, "temperature, step {step}, {place:?}");
            num_checked += 1;
        }
        if let Some(due) = dye(step, place) {
            assert_eq!(dyes[number], due, "dye, step {step}, {place:?}");
        }
    }
    // Four bricks whole, of two others every eighth sample.
    assert_eq!(num_checked, NUM_STEPS * (4 * 512 + 2 * 64));
}

/// Seen along z from below with an opaque function, a pixel shows the first sample of its ray: a sixteenth of a voxel
/// above z = 0 in a brick of level 0, an eighth in one of level 1.
#[test]
fn it_is_drawn_as_its_closed_form() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    fixture_in(folder);
    let camera = r#"{"position":[0.15,2,-100],"look_at":[0.15,2,11],"up":[0,1,0],"ortho_height":3.2}"#;
    fs::write(folder.join("camera.json"), camera).unwrap();
    let function = |low: f64, high: f64| {
        let text = format!(
            r#"{{"points":[{{"x":{low},"color":[0,0,0],"opacity":1}},{{"x":{high},"color":[1,1,1],"opacity":1}}]}}"#
        );
        fs::write(folder.join("tf.json"), text).unwrap();
    };
    let draw = |variable: &str, step: usize| {
        let line = format!(
            "render v1.cxl -o a.png --variable {variable} -t {step} --size 240x320 --camera camera.json --tf tf.json \
             --lighting off --background transparent -q"
        );
        done(folder, &line);
        picture(folder.join("a.png"))
    };
    // 100 pixels per world unit; x runs to the left.
    let pixel = |image: &chronoxel_core::Image8, [x, y]: [f64; 2]| {
        let [column, row] = [120.0 - (0.1 * x - 1.15) * 100.0, 160.0 - (0.2 * y - 1.5) * 100.0];
        image.pixels[row as usize * 240 + column as usize]
    };
    let check = |image: &chronoxel_core::Image8, place: [f64; 2], due: Option<f64>| {
        let [red, .., alpha] = pixel(image, place);
        match due {
            None => assert_eq!(alpha, 0, "{place:?}"),
            Some(due) => {
                assert_eq!(alpha, 255, "{place:?}");
                assert!((f64::from(red) - 255.0 * due).abs() < 2.0, "{place:?}: {red}, not {}", 255.0 * due);
            }
        }
    };
    function(200.0, 300.0);
    for step in [0, 3] {
        let image = draw("temperature", step);
        let slope = |x: f64, y: f64, z: f64| {
            0.8 + 0.005 * (x + 2.0 * y + 3.0 * z) + 0.00125 * ((x + step as f64) % 8.0)
        };
        check(&image, [4.0, 4.0], Some(slope(4.0, 4.0, 0.0625)));
        check(&image, [20.0, 4.0], Some(slope(20.0, 4.0, 0.0625)));
        check(&image, [4.0, 12.0], Some(slope(4.0, 12.0, 0.125)));
        let rows = if step == 0 { 0.0 } else { 7.0 };
        check(&image, [12.0, 4.0], Some(0.0025 * (48.0 + 0.0625 + rows)));
    }
    function(0.0, 250.0);
    for step in [0, 1] {
        let image = draw("dye", step);
        let slope = |x: f64, y: f64, z: f64| (3.0 * x + 5.0 * y + 7.0 * z) / 250.0;
        check(&image, [4.0, 4.0], Some(slope(4.0, 4.0, 0.0625) + step as f64 / 250.0));
        check(&image, [10.0, 4.0], Some((7 + (4 + step) % 5) as f64 / 250.0));
        check(&image, [13.0, 4.0], None);
        check(&image, [12.0, 12.0], Some(17.0 / 250.0));
        check(&image, [20.0, 4.0], (step == 1).then_some(42.0 / 250.0));
        check(&image, [4.0, 12.0], Some(slope(4.0, 12.0, 0.125)));
        check(&image, [20.0, 12.0], Some(slope(20.0, 12.0, 0.125)));
    }
}
