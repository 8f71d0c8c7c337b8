//! Annotations of whole pictures: nothing overlaps, nothing is cut, units are there, and what is drawn lies where it should.

use std::path::Path;

use chronoxel_core::{Camera, ColorMap, Image, Image8, TimeAxis, TransferFunction};

use super::*;
use crate::movie::write_png;

/// A picture of a ball of fog with everything written on it.
struct Scene {
    size: [usize; 2],
    background: Background,
    bounds: [[f64; 3]; 2],
    azimuth: f64,
    elevation: f64,
    fov: Option<f64>,
    range: [f64; 2],
    transfer: &'static str,
}

impl Scene {
    fn new(size: [usize; 2]) -> Self {
        Self {
            size,
            background: Background::default(),
            bounds: [[0.0; 3], [127.0, 127.0, 127.0]],
            azimuth: 30.0,
            elevation: 20.0,
            fov: Some(30.0),
            range: [0.0, 18.4],
            transfer: "ramp",
        }
    }

    fn camera(&self) -> Camera {
        let aspect = self.size[0] as f64 / self.size[1] as f64;
        Camera::orbit(self.bounds, self.azimuth, self.elevation, 1.0, self.fov, aspect).unwrap()
    }

    fn draw(&self) -> (Image8, Vec<Label>) {
        let [width, height] = self.size;
        let style = Style::for_picture(self.size, self.background);
        let camera = self.camera();
        let axes = AxesBox { camera: &camera, bounds: self.bounds, names: ["x", "y", "z"], units: "km" };
        let mut image = Image8::of_background(width, height, self.background);
        axes.draw_behind(&mut image, &style);
        image.composite(&fog(width, height)).unwrap();
        let transfer = TransferFunction::built_in(self.transfer, ColorMap::Viridis)
            .unwrap()
            .resolve(self.range)
            .unwrap();
        let bar =
            ColorBar { transfer: &transfer, range: self.range, name: "vorticity magnitude", units: "s⁻¹" };
        let label = TimeLabel::new(&TimeAxis::regular(40, 0.2, "s").unwrap());
        let time = label.draw(&mut image, &style, 3.4, 17);
        let [title, numbers] = bar.areas(&image, &style);
        let occupied = [time.rect, title, numbers];
        let mut labels = vec![time];
        labels.extend(axes.draw_outline(&mut image, &style, &occupied));
        labels.extend(bar.draw(&mut image, &style));
        (image, labels)
    }
}

fn fog(width: usize, height: usize) -> Image {
    let mut image = Image::new(width, height).unwrap();
    let radius = 0.3 * width.min(height) as f32;
    for (i, pixel) in image.pixels.iter_mut().enumerate() {
        let (x, y) = ((i % width) as f32 - 0.5 * width as f32, (i / width) as f32 - 0.5 * height as f32);
        let alpha = (1.0 - (x * x + y * y) / (radius * radius)).max(0.0).sqrt() * 0.9;
        *pixel = [0.3 * alpha, 0.65 * alpha, 0.5 * alpha, alpha];
    }
    image
}

/// Fails where labels overlap one another or leave the picture.
fn assert_tidy(scene: &Scene, labels: &[Label]) {
    let picture = Rect { x0: 0.0, y0: 0.0, x1: scene.size[0] as f32, y1: scene.size[1] as f32 };
    for (i, label) in labels.iter().enumerate() {
        assert!(picture.contains(&label.rect), "{label:?} leaves the picture of {:?}", scene.size);
        for other in &labels[i + 1..] {
            assert!(!label.rect.intersects(&other.rect), "{label:?} overlaps {other:?} in {:?}", scene.size);
        }
    }
}

#[test]
fn labels_are_tidy_from_everywhere_and_at_every_size() {
    for size in [[256, 256], [512, 512], [1024, 768], [300, 900]] {
        for azimuth in (0..360).step_by(23) {
            for elevation in [-90.0, -35.0, 0.0, 20.0, 60.0, 90.0] {
                let mut scene = Scene::new(size);
                (scene.azimuth, scene.elevation) = (f64::from(azimuth), elevation);
                scene.bounds = [[-1.0e-3, 0.0, 5.0], [4.0e-3, 2.0e-3, 5.002]];
                let (_, labels) = scene.draw();
                assert_tidy(&scene, &labels);
            }
        }
    }
}

/// Scenes of many kinds by name.
fn scenes() -> Vec<(&'static str, Scene)> {
    let mut white = Scene::new([512, 512]);
    white.background = Background::Color([1.0; 3]);
    (white.transfer, white.range) = ("sparse", [1.2, 8.7]);
    let mut flat = Scene::new([640, 480]);
    flat.bounds = [[0.0; 3], [500.0, 200.0, 200.0]];
    flat.background = Background::Transparent;
    let mut below = Scene::new([800, 600]);
    (below.azimuth, below.elevation, below.fov, below.transfer) = (-60.0, -30.0, None, "filled");
    vec![
        ("usual", Scene::new([1024, 768])),
        ("small", Scene::new([256, 256])),
        ("white", white),
        ("flat", flat),
        ("below", below),
        ("4k", Scene::new([3840, 2160])),
    ]
}

/// Pictures to look at are written where the environment variable `CHRONOXEL_PICTURES` says.
#[test]
fn names_and_units_are_written() {
    for (name, scene) in scenes() {
        let (image, labels) = scene.draw();
        if let Some(folder) = std::env::var_os("CHRONOXEL_PICTURES") {
            write_png(&Path::new(&folder).join(format!("annotate-{name}.png")), &image).unwrap();
        }
        assert_tidy(&scene, &labels);
        let written: Vec<&str> = labels.iter().map(|label| label.text.as_str()).collect();
        for expected in
            ["x (km)", "y (km)", "z (km)", "vorticity magnitude (s⁻¹)", "t = 3.4 s · step 17", "5", "100"]
        {
            assert!(written.contains(&expected), "{name}: {expected} is not among {written:?}");
        }
    }
}

#[test]
fn ticks_of_the_axes_lie_where_the_camera_sees_them() {
    let mut scene = Scene::new([800, 600]);
    (scene.azimuth, scene.elevation, scene.fov) = (0.0, 0.0, None);
    scene.bounds = [[0.0; 3], [10.0, 10.0, 10.0]];
    let (_, labels) = scene.draw();
    let five: Vec<&Label> = labels.iter().filter(|label| label.text == "4").collect();
    // Seen from the front, x runs to the right under the box, and y up on its left.
    let [x, y, _] = scene.camera().project([4.0, 0.0, 10.0], [800, 600]).unwrap();
    let under = |label: &&&Label| (0.5 * (label.rect.x0 + label.rect.x1) - x as f32).abs() < 1.0;
    assert!(five.iter().filter(under).any(|label| label.rect.y0 > y as f32), "{five:?}");
    let [x, y, _] = scene.camera().project([0.0, 4.0, 10.0], [800, 600]).unwrap();
    let left = |label: &&&Label| (0.5 * (label.rect.y0 + label.rect.y1) - y as f32).abs() < 1.0;
    assert!(five.iter().filter(left).any(|label| label.rect.x1 < x as f32), "{five:?}");
}

#[test]
fn the_bar_shows_the_colours_of_its_values() {
    let scene = Scene::new([1024, 768]);
    let (image, labels) = scene.draw();
    let transfer =
        TransferFunction::built_in("ramp", ColorMap::Viridis).unwrap().resolve(scene.range).unwrap();
    let label = labels.iter().find(|label| label.text == "10").unwrap();
    let row = (0.5 * (label.rect.y0 + label.rect.y1)) as usize;
    let style = Style::for_picture(scene.size, scene.background);
    let column = (label.rect.x0 - 1.2 * style.em) as usize;
    let expected = transfer.evaluate(10.0);
    let found = image.pixels[row * image.width + column];
    for channel in 0..3 {
        assert!(
            (f64::from(found[channel]) / 255.0 - expected[channel]).abs() < 0.02,
            "{found:?} {expected:?}"
        );
    }
}

#[test]
fn a_transparent_picture_stays_transparent() {
    let mut scene = Scene::new([400, 300]);
    scene.background = Background::Transparent;
    let (image, _) = scene.draw();
    let clear = image.pixels.iter().filter(|pixel| pixel[3] == 0).count();
    assert!(clear > image.pixels.len() / 2, "{clear} of {} pixels are clear", image.pixels.len());
}

#[test]
fn odd_input_is_drawn_without_a_panic() {
    let mut scene = Scene::new([33, 17]);
    scene.draw();
    scene.size = [1, 1];
    scene.draw();
    scene.size = [200, 200];
    scene.range = [4.0, 4.0];
    scene.draw();
    scene.bounds = [[0.0; 3], [10.0, 0.0, 0.0]];
    scene.draw();
    scene.bounds = [[0.0; 3], [0.0; 3]];
    scene.draw();
    let inside = Camera::new(
        [5.0; 3],
        [6.0, 5.0, 5.0],
        [0.0, 1.0, 0.0],
        chronoxel_core::Projection::Perspective { fov_y_deg: 90.0 },
    )
    .unwrap();
    let style = Style::for_picture([200, 200], Background::default());
    let mut image = Image8::filled(200, 200, [0, 0, 0, 255]);
    let axes = AxesBox { camera: &inside, bounds: [[0.0; 3], [10.0; 3]], names: ["x", "y", "z"], units: "" };
    axes.draw_behind(&mut image, &style);
    assert!(axes.draw_outline(&mut image, &style, &[]).is_empty());
    assert!(image.pixels.iter().any(|pixel| pixel[0] > 0), "the far edges are seen from inside");
}

#[test]
fn the_same_input_gives_the_same_pixels() {
    assert_eq!(Scene::new([320, 240]).draw(), Scene::new([320, 240]).draw());
}
