//! What cannot be drawn is refused in one line that names the field and the value.

mod pictures;

use chronoxel_core::{BrickLayout, UniformGrid};
use chronoxel_render::{DenseField, DrawHow, PreparedBrick, Scene, render, render_reference};
use pictures::{Field, Quantise, scene_of, waves};

fn field() -> Field {
    waves(UniformGrid::new([20; 3], [0.0; 3], [1.0; 3]).unwrap())
}

#[track_caller]
fn assert_refused(scene: &Scene, list: &[chronoxel_render::DrawBrick], words: &str) {
    let message = render(scene, list).unwrap_err().to_string();
    assert!(message.contains(words) && !message.contains('\n'), "{message}");
}

#[test]
fn scenes() {
    let field = field();
    let scene = scene_of(&field, 16, "ramp", true);
    let flat = UniformGrid::new([20, 20, 1], [0.0; 3], [1.0; 3]).unwrap();
    assert_refused(&Scene { grid: flat, ..scene.clone() }, &[], "20 x 20 x 1");
    assert_refused(&Scene { step_voxels: 0.0, ..scene.clone() }, &[], "step length is 0");
    assert_refused(&Scene { step_voxels: f64::NAN, ..scene.clone() }, &[], "step length is NaN");
    assert_refused(&Scene { opacity_unit: -1.0, ..scene.clone() }, &[], "opacity unit is -1");
    assert_refused(&Scene { finest_level: 32, ..scene.clone() }, &[], "finest level is 32");
    assert_refused(&Scene { size: [0, 9], ..scene.clone() }, &[], "0x9");
    let few = DenseField { samples: &field.samples[1..], mask: None };
    assert!(render_reference(&scene, &few).unwrap_err().to_string().contains("7999"));
}

#[test]
fn bricks() {
    let field = field();
    let scene = scene_of(&field, 16, "ramp", true);
    let list = field.draw_list(&scene, 0, Quantise::Exact);
    let other = Scene { layout: BrickLayout::new(8).unwrap(), ..scene.clone() };
    assert_refused(&other, &list, "brick's layout");
    let mut bad = list.clone();
    bad[0].region[1][0] = f64::NAN;
    assert_refused(&scene, &bad, "brick's region");
    let mut deep = list.clone();
    deep[0].node.level = 200;
    assert_refused(&scene, &deep, "brick's level is 200");

    let layout = scene.layout;
    let whole = field.brick(list[0].node, &layout, Quantise::Exact);
    let mut short = whole.clone();
    short.samples.pop();
    assert!(PreparedBrick::new(short, &layout).is_err());
    let mut infinite = whole;
    infinite.scale = f64::INFINITY;
    assert!(PreparedBrick::new(infinite, &layout).is_err());
}

#[test]
fn nothing_to_draw_is_an_empty_picture() {
    let field = field();
    let scene = scene_of(&field, 16, "ramp", false);
    let mut list = field.draw_list(&scene, 0, Quantise::Exact);
    list.iter_mut().for_each(|brick| brick.how = DrawHow::Skip);
    let (image, stats) = render(&scene, &list).unwrap();
    assert!(image.pixels.iter().all(|p| *p == [0.0; 4]));
    assert_eq!((stats.num_samples, stats.bricks_skipped), (0, 8));
}
