//! `render` and `compare`.

use std::{fs, path::Path};

use chronoxel_core::{Background, BrickLayout, Camera, Image8, Lighting, TransferFunction, UniformGrid};
use chronoxel_render::{DenseField, Scene, render_reference};
use serde_json::json;
use tempfile::tempdir;

use crate::{
    command::{at, done, json, number, refused, run},
    files::{mean_difference, picture, write_u8_steps},
};

const DIMS: [usize; 3] = [40, 24, 20];

/// Two blobs on a slope, one of which moves.
fn sample(step: usize, place: [usize; 3]) -> u8 {
    let [x, y, z] = place.map(|i| i as f64);
    let blob = |cx: f64, r: f64| (-((x - cx).powi(2) + (y - 12.0).powi(2) + (z - 9.0).powi(2)) / r).exp();
    (20.0 + x + 120.0 * blob(28.0, 40.0) + 60.0 * blob(8.0 + 4.0 * step as f64, 25.0)) as u8
}

/// A folder with `run.cxl` of three steps, bricks of 16 samples, and their source.
fn store_in(folder: &Path) {
    write_u8_steps(&folder.join("source.npy"), 3, DIMS, sample);
    done(folder, "encode source.npy -o run.cxl --brick 16 --dt 2 -q");
}

fn largest_difference(a: &Image8, b: &Image8) -> u8 {
    let pairs = a.pixels.iter().flatten().zip(b.pixels.iter().flatten());
    pairs.map(|(&a, &b)| a.abs_diff(b)).max().unwrap()
}

#[test]
fn a_picture_is_the_one_that_the_reference_renderer_draws() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let function = r#"{"domain":"variable","points":[{"x":0.1,"color":[0,0.2,1],"opacity":0},
        {"x":0.5,"color":[1,1,0],"opacity":0.05},{"x":1,"color":[1,0,0],"opacity":0.4}]}"#;
    fs::write(folder.join("tf.json"), function).unwrap();
    let cameras = [
        r#"{"position":[70,40,-50],"look_at":[19,12,10],"up":[0,1,0],"fov_y_deg":35}"#,
        r#"{"position":[-30,60,70],"look_at":[19,12,10],"up":[0,0,1],"ortho_height":50}"#,
    ];
    let size = [80, 60];
    let grid = UniformGrid::new(DIMS, [0.0; 3], [1.0; 3]).unwrap();
    let samples: Vec<f64> =
        (0..grid.num_samples()).map(|i| f64::from(sample(1, [i % 40, i / 40 % 24, i / 960]))).collect();
    let all = (0..3).flat_map(|s| (0..19200).map(move |i| sample(s, [i % 40, i / 40 % 24, i / 960])));
    let range = [all.clone().min().unwrap(), all.max().unwrap()].map(f64::from);
    for (camera, lighting) in cameras.iter().zip(["on", "off"]) {
        fs::write(folder.join("camera.json"), camera).unwrap();
        let line = format!(
            "render run.cxl -o a.png -t 1 --size 80x60 --camera camera.json --tf tf.json --lighting {lighting}"
        );
        let report = json(folder, &line);
        assert_eq!([at(&report, "step"), at(&report, "time")], [&json!(1), &json!(2.0)]);
        let scene = Scene {
            grid,
            layout: BrickLayout::new(16).unwrap(),
            camera: Camera::from_json(camera).unwrap(),
            transfer: TransferFunction::from_json(function).unwrap().resolve(range).unwrap(),
            size,
            step_voxels: 0.5,
            finest_level: 0,
            lighting: (lighting == "on").then(Lighting::default),
            opacity_unit: 1.0,
        };
        let due = render_reference(&scene, &DenseField { samples: &samples, mask: None }).unwrap();
        let due = Image8::from_image(&due, Background::Color([0.0; 3]));
        let drawn = picture(folder.join("a.png"));
        let (largest, mean) = (largest_difference(&drawn, &due), mean_difference(&drawn, &due));
        assert!(largest <= 3 && mean < 0.1, "{camera}: {largest} of 255, mean {mean}");
        assert!(due.pixels.iter().any(|p| p[0] > 150), "the picture shows something");
    }
}

#[test]
fn render_says_what_scripts_rely_on() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let report = json(folder, "render run.cxl -o new/folder/a.png -t 2 --size 64x48");
    assert_eq!(at(&report, "backend"), "cpu");
    assert!(at(&report, "adapter").is_string());
    assert!(number(&report, "wall_secs") > 0.0 && number(&report, "render_ms") > 0.0);
    assert!(number(&report, "samples") > 1000.0);
    let bricks =
        ["skipped", "constant", "reused", "new", "drawn"].map(|k| number(&report, &format!("bricks.{k}")));
    assert_eq!(bricks[0] + bricks[4], 12.0, "3 × 2 × 2 bricks: {report}");
    assert_eq!(bricks[1] + bricks[2] + bricks[3], bricks[4]);
    assert_eq!(at(&report, "opacity_unit"), 1.0);
    assert_eq!(at(&report, "size"), &json!([64, 48]));
    assert_eq!([at(&report, "step"), at(&report, "time")], [&json!(2), &json!(4.0)]);
    let drawn = picture(folder.join("new/folder/a.png"));
    assert_eq!([drawn.width, drawn.height], [64, 48]);
}

#[test]
fn transfer_functions_are_those_that_the_documents_say() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let draw = |name: &str, options: &str| {
        done(folder, &format!("render run.cxl -o {name}.png --size 60x50 -q {options}"));
        picture(folder.join(format!("{name}.png")))
    };
    let gray = |points: &[[f64; 2]], domain: &str| {
        let points: Vec<_> = points
            .iter()
            .map(|&[x, opacity]| json!({ "x": x, "color": [x, x, x], "opacity": opacity }))
            .collect();
        json!({ "points": points, "domain": domain }).to_string()
    };
    let sparse = [
        [0.0, 0.0],
        [0.5, 0.0],
        [0.55, 0.08],
        [0.6, 0.0],
        [0.75, 0.0],
        [0.85, 0.35],
        [0.95, 0.0],
        [1.0, 0.0],
    ];
    for (name, points) in [
        ("ramp", &[[0.0, 0.0], [1.0, 0.05]][..]),
        ("filled", &[[0.0, 0.02], [1.0, 0.10]]),
        ("sparse", &sparse),
    ] {
        fs::write(folder.join("tf.json"), gray(points, "variable")).unwrap();
        let built_in = draw(name, &format!("--tf {name} --colormap gray"));
        assert!(largest_difference(&built_in, &draw("file", "--tf tf.json")) <= 1, "{name}");
        assert!(built_in.pixels.iter().any(|p| p[0] > 10), "{name} shows something");
    }
    let maps =
        ["viridis", "inferno", "turbo", "coolwarm", "gray"].map(|m| draw(m, &format!("--colormap {m}")));
    for (i, a) in maps.iter().enumerate() {
        assert!(maps[..i].iter().all(|b| mean_difference(a, b) > 0.5), "two colour maps give one picture");
    }
    assert_eq!(maps[0], draw("default", ""), "viridis and ramp are the defaults");

    // A ParaView preset, and the same in our words.
    let preset = json!([{ "Name": "p", "ColorSpace": "RGB", "RGBPoints": [20, 0, 0, 1, 60, 0, 1, 0, 150, 1, 0, 0],
        "Points": [20, 0, 0.5, 0, 60, 0.02, 0.5, 0, 150, 0.3, 0.5, 0] }]);
    let ours = json!({ "points": [{ "x": 20, "color": [0, 0, 1], "opacity": 0 },
        { "x": 60, "color": [0, 1, 0], "opacity": 0.02 }, { "x": 150, "color": [1, 0, 0], "opacity": 0.3 }] });
    fs::write(folder.join("preset.json"), preset.to_string()).unwrap();
    fs::write(folder.join("ours.json"), ours.to_string()).unwrap();
    let [preset, ours] = ["preset", "ours"].map(|name| draw(name, &format!("--tf {name}.json")));
    assert_eq!(preset, ours);
    // Opacities per two units of length let more through than per one.
    let thin = draw("thin", "--tf ours.json --opacity-unit 2");
    let sum = |image: &Image8| image.pixels.iter().flatten().map(|&c| u64::from(c)).sum::<u64>();
    assert!(sum(&thin) < sum(&ours));
    refused(folder, "render run.cxl -o x.png --tf ours.json --colormap gray", &["--colormap", "ours.json"]);
}

#[test]
fn backgrounds_and_annotations() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let draw = |options: &str| {
        done(folder, &format!("render run.cxl -o a.png --size 200x150 -q {options}"));
        picture(folder.join("a.png"))
    };
    for (options, corner) in [
        ("", [0, 0, 0, 255]),
        ("--background transparent", [0, 0, 0, 0]),
        ("--background white", [255, 255, 255, 255]),
        ("--background '#ff8001'", [255, 128, 1, 255]),
    ] {
        let drawn = draw(options);
        assert_eq!(drawn.pixels[0], corner, "{options}");
        let middle = drawn.pixels[75 * 200 + 100];
        assert!(middle != corner && middle[3] > 0, "{options}: {middle:?}");
    }
    let plain = draw("");
    let mut seen = vec![plain.clone()];
    for option in [
        "--axes",
        "--colorbar",
        "--time-label",
        "--axes --colorbar --time-label",
        "--ortho",
        "--azimuth 100",
        "--elevation -40",
        "--zoom 2",
        "--fov 60",
        "--lighting off",
        "--step 1.5",
        "--level 1",
        "-t 1",
    ] {
        let drawn = draw(option);
        assert!(seen.iter().all(|other| *other != drawn), "{option} changes nothing");
        seen.push(drawn);
    }
    // Steps are at 0, 2 and 4.
    let second = draw("-t 1");
    for time in ["2", "1.2", "2.9"] {
        assert_eq!(draw(&format!("--time {time}")), second, "{time}");
    }
    assert_eq!(draw("--azimuth 390"), plain, "30 degrees are the default");
    // A coarser level is close to the picture, and no more than that.
    assert!((0.05..6.0).contains(&mean_difference(&draw("--level 1"), &plain)));
}

#[test]
fn threads_and_memory_do_not_change_a_pixel() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    let pictures = ["--threads 1", "--threads 3", "--threads 2 --memory 100KiB"].map(|options| {
        done(folder, &format!("render run.cxl -o a.png --size 48x36 -q {options}"));
        fs::read(folder.join("a.png")).unwrap()
    });
    assert!(pictures[0] == pictures[1] && pictures[0] == pictures[2]);
}

#[test]
fn pictures_are_compared() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    for (name, options) in [("a", "--size 40x30"), ("b", "--size 40x30 -t 2"), ("c", "--size 30x40")] {
        done(folder, &format!("render run.cxl -o {name}.png -q {options}"));
    }
    let same = json(folder, "compare a.png a.png");
    assert_eq!(at(&same, "psnr_db"), &json!(null));
    assert_eq!([number(&same, "ssim"), number(&same, "luv_mean"), number(&same, "luv_max")], [1.0, 0.0, 0.0]);
    assert_eq!(at(&same, "differing_pixels"), 0);
    let other = json(folder, "compare a.png b.png -o difference.png");
    let (a, b) = (picture(folder.join("a.png")), picture(folder.join("b.png")));
    let num_differing = a.pixels.iter().zip(&b.pixels).filter(|(a, b)| a != b).count();
    assert_eq!(at(&other, "differing_pixels"), num_differing);
    let squares = a
        .pixels
        .iter()
        .zip(&b.pixels)
        .flat_map(|(a, b)| (0..3).map(|c| f64::from(a[c].abs_diff(b[c])).powi(2)));
    let mse = squares.sum::<f64>() / (3 * a.pixels.len()) as f64;
    assert!((number(&other, "psnr_db") - 10.0 * (255.0 * 255.0 / mse).log10()).abs() < 1e-9);
    assert!(number(&other, "ssim") < 1.0 && number(&other, "luv_mean") < number(&other, "luv_max"));
    assert_eq!(picture(folder.join("difference.png")).pixels.len(), 1200);
    refused(folder, "compare a.png c.png", &["40", "30"]);
    refused(folder, "compare a.png lost.png", &["lost.png", "No such file"]);
    refused(folder, "compare a.png source.npy", &["source.npy", "not a readable PNG"]);
}

#[test]
fn views_that_cannot_be_drawn_are_refused() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    store_in(folder);
    fs::write(folder.join("file"), "").unwrap();
    for (name, text) in [
        ("not.json", "position: 3"),
        ("half.json", r#"{"position":[1,2,3],"#),
        ("two.json", r#"{"position":[1,2],"look_at":[0,0,0],"fov_y_deg":30}"#),
        ("same.json", r#"{"position":[1,2,3],"look_at":[1,2,3],"fov_y_deg":30}"#),
        ("wide.json", r#"{"position":[1,2,3],"look_at":[0,0,0],"fov_y_deg":200}"#),
        ("both.json", r#"{"position":[1,2,3],"look_at":[0,0,0],"fov_y_deg":30,"ortho_height":3}"#),
        ("empty.json", ""),
    ] {
        fs::write(folder.join(name), text).unwrap();
        refused(folder, &format!("render run.cxl -o x.png --camera {name}"), &[name, "camera"]);
    }
    for (name, text) in [
        ("not.tf", "red"),
        ("no.tf", r#"{"points":[]}"#),
        ("color.tf", r#"{"points":[{"x":0,"color":[0,1],"opacity":0.5}]}"#),
        ("opacity.tf", r#"{"points":[{"x":0,"color":[0,1,0],"opacity":7}]}"#),
        (
            "order.tf",
            r#"{"points":[{"x":1,"color":[0,1,0],"opacity":0},{"x":0,"color":[0,1,0],"opacity":0}]}"#,
        ),
        ("huge.tf", r#"{"points":[{"x":1e999,"color":[0,1,0],"opacity":0}]}"#),
        ("preset.tf", r#"[{"RGBPoints":[0,1,1]}]"#),
    ] {
        fs::write(folder.join(name), text).unwrap();
        refused(folder, &format!("render run.cxl -o x.png --tf {name}"), &[name]);
    }
    for (options, says) in [
        ("-o x.png --camera lost.json", &["lost.json", "No such file"][..]),
        ("-o x.png --tf lost", &["lost", "ramp, sparse, filled"]),
        ("-o x.png -t 3", &["run.cxl", "step 3", "0 to 2"]),
        ("-o x.png --variable heat", &["run.cxl", "heat", "source"]),
        ("-o x.png --level 9", &["run.cxl", "--level is 9", "0 to 2"]),
        ("-o x.jpg", &["x.jpg", ".png"]),
        ("-o run.cxl", &["run.cxl", ".png"]),
        ("-o file/x.png", &["file/x.png", "ot a directory"]),
    ] {
        refused(folder, &format!("render run.cxl {options}"), says);
    }
    fs::create_dir(folder.join("folder.png")).unwrap();
    refused(folder, "render run.cxl -o folder.png", &["folder.png", "folder"]);
    // A camera that looks away draws nothing, and says nothing.
    fs::write(folder.join("away.json"), r#"{"position":[99,99,99],"look_at":[199,199,199],"fov_y_deg":30}"#)
        .unwrap();
    assert_eq!(run(folder, "render run.cxl -o x.png --camera away.json --size 20x20").status, 0);
    assert!(picture(folder.join("x.png")).pixels.iter().all(|p| *p == [0, 0, 0, 255]));
}
