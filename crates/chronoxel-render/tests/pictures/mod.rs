//! Fields, the bricks they are cut into, and the comparison of pictures.

#![allow(dead_code, reason = "every test file uses a part of it")]

#[cfg(feature = "gpu")]
pub mod cases;

use std::path::PathBuf;
use std::sync::Arc;

use chronoxel_core::{
    Background, BitMask, BrickLayout, Camera, ColorMap, Image, Lighting, NodeId, ResidentBrick,
    TransferFunction, UniformGrid, octree::levels_of, view_order,
};
use chronoxel_render::{DrawBrick, DrawHow, PreparedBrick, Scene};

/// How samples become 16-bit ones.
#[derive(Clone, Copy)]
pub enum Quantise {
    /// Within each brick's own range.
    PerBrick,
    /// Whole numbers from 0 to 65535, as they are.
    Exact,
}

/// A field over a grid, `[z, y, x]`.
#[derive(Clone)]
pub struct Field {
    pub grid: UniformGrid,
    pub samples: Vec<f64>,
    pub mask: Option<Vec<bool>>,
}

impl Field {
    /// A field from a function of voxel coordinates.
    pub fn new(grid: UniformGrid, at: impl Fn([f64; 3]) -> f64) -> Self {
        let [nx, ny, nz] = grid.dims;
        let place = |i: usize| [i % nx, i / nx % ny, i / (nx * ny)].map(|c| c as f64);
        Self { grid, samples: (0..nx * ny * nz).map(|i| at(place(i))).collect(), mask: None }
    }

    pub fn range(&self) -> [f64; 2] {
        self.samples.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |r, &s| [r[0].min(s), r[1].max(s)])
    }

    fn index(&self, place: [i64; 3]) -> usize {
        let [x, y, z]: [usize; 3] =
            std::array::from_fn(|a| place[a].clamp(0, self.grid.dims[a] as i64 - 1) as usize);
        (z * self.grid.dims[1] + y) * self.grid.dims[0] + x
    }

    /// The brick of a node of level `l`, whose samples are every 2^l-th of the field, replicated outwards.
    pub fn brick(&self, node: NodeId, layout: &BrickLayout, quantise: Quantise) -> ResidentBrick {
        let (full, low) = (layout.full_edge(), layout.low as i64);
        let origin = node.brick().map(|b| i64::from(b) * layout.edge as i64 - low);
        let indices: Vec<usize> = (0..layout.num_full())
            .map(|i| {
                let at = [i % full, i / full % full, i / (full * full)];
                self.index(std::array::from_fn(|a| (origin[a] + at[a] as i64) << node.level))
            })
            .collect();
        let values = indices.iter().map(|&i| self.samples[i]);
        let (offset, scale) = match quantise {
            Quantise::Exact => (0.0, 1.0),
            Quantise::PerBrick => {
                let [min, max] = values
                    .clone()
                    .fold([f64::INFINITY, f64::NEG_INFINITY], |r, s| [r[0].min(s), r[1].max(s)]);
                (min, if max > min { (max - min) / 65535.0 } else { 1.0 })
            }
        };
        let mask = self.mask.as_ref().map(|mask| BitMask::from_flags(indices.iter().map(|&i| mask[i])));
        let samples = values.map(|v| ((v - offset) / scale).round() as u16).collect();
        ResidentBrick { samples, offset, scale, mask }
    }

    /// The nodes of a level.
    pub fn nodes(&self, scene: &Scene, level: u8) -> Vec<NodeId> {
        let bricks = levels_of(&self.grid, &scene.layout)[usize::from(level)].bricks;
        let nodes = (0..bricks.iter().product::<usize>()).map(|i| {
            let at = [i % bricks[0], i / bricks[0] % bricks[1], i / (bricks[0] * bricks[1])];
            NodeId::new(level, at.map(|b| b as u32))
        });
        nodes.collect()
    }

    /// All bricks of a level, in the order of a scene's camera.
    pub fn draw_list(&self, scene: &Scene, level: u8, quantise: Quantise) -> Vec<DrawBrick> {
        let nodes = self.nodes(scene, level).into_iter();
        let list = nodes.map(|node| self.draw_brick(scene, node, region_of(node, &scene.layout), quantise));
        in_view_order(scene, list.collect())
    }

    pub fn draw_brick(
        &self,
        scene: &Scene,
        node: NodeId,
        region: [[f64; 3]; 2],
        quantise: Quantise,
    ) -> DrawBrick {
        let brick = self.brick(node, &scene.layout, quantise);
        let prepared = PreparedBrick::new(brick, &scene.layout).unwrap();
        DrawBrick { node, region, how: DrawHow::Samples(Arc::new(prepared)) }
    }
}

/// The box of a node in level-0 voxels.
pub fn region_of(node: NodeId, layout: &BrickLayout) -> [[f64; 3]; 2] {
    let edge = (layout.edge << node.level) as f64;
    let low = node.brick().map(|b| f64::from(b) * edge);
    [low, low.map(|c| c + edge)]
}

/// A draw list front to back.
pub fn in_view_order(scene: &Scene, list: Vec<DrawBrick>) -> Vec<DrawBrick> {
    in_order(scene, list, |brick| brick.region)
}

/// What lies in regions, front to back.
pub fn in_order<T: Clone>(scene: &Scene, list: Vec<T>, region: impl Fn(&T) -> [[f64; 3]; 2]) -> Vec<T> {
    let regions: Vec<_> = list.iter().map(region).collect();
    let order = view_order(&regions, &scene.camera, &scene.grid, &scene.layout);
    order.into_iter().map(|i| list[i].clone()).collect()
}

/// A smooth field with structure of several sizes, from 0 to 65535 in whole numbers.
pub fn waves(grid: UniformGrid) -> Field {
    Field::new(grid, |[x, y, z]| {
        let wave = (0.31 * x + 0.11 * y).sin() * (0.23 * y - 0.17 * z).cos() + (0.4 * z + 0.05 * x).sin();
        ((wave + 2.0) / 4.0 * 65535.0).round()
    })
}

/// The scene that tests start from: a field's whole box, a built-in transfer function, 120 x 100 pixels.
pub fn scene_of(field: &Field, edge: usize, function: &str, lit: bool) -> Scene {
    let transfer = TransferFunction::built_in(function, ColorMap::Viridis).unwrap();
    Scene {
        grid: field.grid,
        layout: BrickLayout::new(edge).unwrap(),
        camera: Camera::orbit(field.grid.bounds(), 30.0, 20.0, 1.2, Some(30.0), 1.2).unwrap(),
        transfer: transfer.resolve(field.range()).unwrap(),
        size: [120, 100],
        step_voxels: 0.5,
        finest_level: 0,
        lighting: lit.then(Lighting::default),
        opacity_unit: field.grid.smallest_spacing(),
    }
}

/// How two pictures differ, over a black background, components from 0 to 1.
#[derive(Debug)]
pub struct Difference {
    pub psnr_db: f64,
    /// Pixels with a component more than 2/255 off.
    pub num_failed: usize,
    pub max: f64,
}

pub fn difference(actual: &Image, expected: &Image) -> Difference {
    assert_eq!((actual.width, actual.height), (expected.width, expected.height));
    let (mut square_sum, mut num_failed, mut max) = (0.0, 0, 0.0f64);
    for (a, e) in actual.pixels.iter().zip(&expected.pixels) {
        let worst = a.iter().zip(e).map(|(a, e)| f64::from((a - e).abs())).fold(0.0, f64::max);
        square_sum += a.iter().zip(e).map(|(a, e)| f64::from(a - e).powi(2)).sum::<f64>();
        num_failed += usize::from(worst > 2.0 / 255.0);
        max = max.max(worst);
    }
    let mse = square_sum / (4 * actual.pixels.len()) as f64;
    Difference { psnr_db: -10.0 * mse.max(1e-30).log10(), num_failed, max }
}

/// Fails, leaving the two pictures and their difference in a folder that the message names.
#[track_caller]
pub fn assert_similar(name: &str, actual: &Image, expected: &Image, psnr_db: f64, num_failed: usize) {
    let found = difference(actual, expected);
    let is_blank = expected.pixels.iter().all(|p| p[3] == 0.0);
    if found.psnr_db >= psnr_db && found.num_failed <= num_failed && !is_blank {
        return;
    }
    let folder = write_pictures(name, actual, expected);
    panic!(
        "{name}: {found:?}, but at least {psnr_db} dB and at most {num_failed} failed pixels were expected{}; \
         pictures in {}",
        if is_blank { " of a picture that is not blank" } else { "" },
        folder.display()
    );
}

#[track_caller]
pub fn assert_identical(name: &str, actual: &Image, expected: &Image) {
    let num_other = actual.pixels.iter().zip(&expected.pixels).filter(|(a, e)| a != e).count();
    let is_blank = expected.pixels.iter().all(|p| p[3] == 0.0);
    if num_other > 0 || is_blank {
        let folder = write_pictures(name, actual, expected);
        let found = difference(actual, expected);
        panic!(
            "{name}: {num_other} pixels differ (blank: {is_blank}), {found:?}; pictures in {}",
            folder.display()
        );
    }
}

fn write_pictures(name: &str, actual: &Image, expected: &Image) -> PathBuf {
    let folder = std::env::temp_dir().join("chronoxel-pictures").join(name);
    std::fs::create_dir_all(&folder).unwrap();
    let mut off = actual.clone();
    for (pixel, e) in off.pixels.iter_mut().zip(&expected.pixels) {
        let amplified: [f32; 3] = std::array::from_fn(|c| ((pixel[c] - e[c]).abs() * 32.0).min(1.0));
        *pixel = [amplified[0], amplified[1], amplified[2], 1.0];
    }
    for (file, image) in [("actual", actual), ("expected", expected), ("difference", &off)] {
        let path = folder.join(format!("{file}.png"));
        std::fs::write(path, image.to_png(Background::default())).unwrap();
    }
    folder
}
