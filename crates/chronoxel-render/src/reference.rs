//! The reference renderer: what the right picture is.
//!
//! Double precision over a dense field, one ray after another, every sample of it: no tables, no early end, and bricks
//! only where a draw list has constants in place of samples. It is slow, and meant to be read.

use chronoxel_core::{Image, Ray, compositing};

use crate::scene::clip_to_box;
use crate::{DrawBrick, DrawHow, RenderError, Scene};

/// A dense field of samples over the scene's grid, `[z, y, x]`.
#[derive(Debug, Clone, Copy)]
pub struct DenseField<'a> {
    /// One value per sample, finite.
    pub samples: &'a [f64],
    /// One flag per sample, set where it is masked.
    pub mask: Option<&'a [bool]>,
}

/// The picture of a scene, by definition.
///
/// Samples lie one step length of the scene's finest level apart.
///
/// # Errors
/// [`RenderError`] if the scene cannot be drawn, or the field has another number of samples than the grid.
pub fn render_reference(scene: &Scene, field: &DenseField) -> Result<Image, RenderError> {
    render_reference_with(scene, field, &[])
}

/// [`render_reference`], with what a draw list puts in place of samples: nothing, or a constant.
///
/// * `bricks`: in any order; where none lies, and where one has samples or a partial image, the field is drawn
///
/// # Errors
/// As [`render_reference`].
pub fn render_reference_with(
    scene: &Scene,
    field: &DenseField,
    bricks: &[DrawBrick],
) -> Result<Image, RenderError> {
    draw(scene, field, |ray| march(scene, field, bricks, ray))
}

/// The picture of a field, given what is seen along a ray.
pub(crate) fn draw(
    scene: &Scene,
    field: &DenseField,
    seen: impl Fn(&Ray) -> [f64; 4],
) -> Result<Image, RenderError> {
    scene.check()?;
    let num_samples = scene.grid.num_samples();
    if field.samples.len() != num_samples || field.mask.is_some_and(|m| m.len() != num_samples) {
        let remedy = "give one value (and one flag) per sample of the grid";
        return Err(RenderError::invalid("number of samples", field.samples.len(), remedy));
    }
    let [width, height] = scene.size;
    let mut image = Image::new(width, height)?;
    for (i, pixel) in image.pixels.iter_mut().enumerate() {
        let centre = [(i % width) as f64 + 0.5, (i / width) as f64 + 0.5];
        *pixel = seen(&scene.camera.ray(centre, scene.size)).map(|c| c as f32);
    }
    Ok(image)
}

fn march(scene: &Scene, field: &DenseField, bricks: &[DrawBrick], ray: &Ray) -> [f64; 4] {
    let Some([entry, exit]) = clip_to_box(ray, scene.grid.bounds()) else { return [0.0; 4] };
    let dt = scene.step_length_at(scene.finest_level);
    let num_samples = ((exit - entry) / dt).round() as usize;
    let lengths = (0..num_samples).map(|k| entry + (k as f64 + 0.5) * dt);
    composite(scene, field, bricks, ray, lengths, dt)
}

/// What samples at lengths along a ray add up to, each standing for `dt` of it.
pub(crate) fn composite(
    scene: &Scene,
    field: &DenseField,
    bricks: &[DrawBrick],
    ray: &Ray,
    lengths: impl Iterator<Item = f64>,
    dt: f64,
) -> [f64; 4] {
    let mut pixel = [0.0; 4];
    for t in lengths {
        let world = std::array::from_fn(|a| ray.origin[a] + t * ray.direction[a]);
        let voxel = scene.grid.voxel_from_world(world);
        let Some(([r, g, b, opacity], (scattered, highlight))) = seen_at(scene, field, bricks, ray, voxel)
        else {
            continue;
        };
        let alpha = compositing::correct_opacity(opacity, dt, scene.opacity_unit);
        let lit = |c: f64| alpha * (c * scattered + highlight);
        compositing::accumulate(&mut pixel, [lit(r), lit(g), lit(b), alpha]);
    }
    pixel
}

/// Colour, opacity per unit and lighting at a place, by the draw list or else the field; `None` where nothing is seen.
fn seen_at(
    scene: &Scene,
    field: &DenseField,
    bricks: &[DrawBrick],
    ray: &Ray,
    voxel: [f64; 3],
) -> Option<([f64; 4], (f64, f64))> {
    let unlit = |color| Some((color, (1.0, 0.0)));
    match bricks.iter().find(|brick| owns(scene, brick, voxel)).map(|brick| &brick.how) {
        Some(DrawHow::Skip) => None,
        Some(DrawHow::Constant(value)) => unlit(scene.transfer.evaluate(*value)),
        Some(DrawHow::ConstantColor([r, g, b], opacity)) => unlit([*r, *g, *b, *opacity].map(f64::from)),
        Some(DrawHow::Samples(_) | DrawHow::Partial(_)) | None => sample(scene, field, voxel, ray),
    }
}

/// Whether a place lies in a brick's box, which is open at the grid's faces.
fn owns(scene: &Scene, brick: &DrawBrick, voxel: [f64; 3]) -> bool {
    let [low, high] = brick.region;
    (0..3).all(|a| {
        let last = (scene.grid.dims[a] - 1) as f64;
        let is_above = low[a] <= 0.0 || (low[a] < last && low[a] <= voxel[a]);
        is_above && (high[a] >= last || voxel[a] < high[a])
    })
}

/// Colour and opacity of the field at a place, and how the colour is lit; `None` where it is masked.
fn sample(scene: &Scene, field: &DenseField, voxel: [f64; 3], ray: &Ray) -> Option<([f64; 4], (f64, f64))> {
    if field.mask.is_some_and(|mask| mask[nearest(scene, voxel)]) {
        return None;
    }
    let color = scene.transfer.evaluate(interpolate(scene, voxel, |i| field.samples[i]));
    let terms = scene.lighting.map_or((1.0, 0.0), |lighting| {
        let gradient = std::array::from_fn(|axis| {
            interpolate(scene, voxel, |i| central_difference(scene, field, i, axis))
        });
        lighting.headlight_terms(gradient, ray.direction)
    });
    Some((color, terms))
}

fn nearest(scene: &Scene, voxel: [f64; 3]) -> usize {
    let [nx, ny, nz] = scene.grid.dims;
    let index = |v: f64, n: usize| (v + 0.5).floor().clamp(0.0, (n - 1) as f64) as usize;
    (index(voxel[2], nz) * ny + index(voxel[1], ny)) * nx + index(voxel[0], nx)
}

/// Trilinear interpolation of what `at` gives for a sample's index.
fn interpolate(scene: &Scene, voxel: [f64; 3], at: impl Fn(usize) -> f64) -> f64 {
    let [nx, ny, nz] = scene.grid.dims;
    let cell = |v: f64, n: usize| v.floor().clamp(0.0, (n - 2) as f64) as usize;
    let (x, y, z) = (cell(voxel[0], nx), cell(voxel[1], ny), cell(voxel[2], nz));
    let (wx, wy, wz) = (voxel[0] - x as f64, voxel[1] - y as f64, voxel[2] - z as f64);
    let mut sum = 0.0;
    for corner in 0..8 {
        let (i, j, k) = (corner & 1, corner >> 1 & 1, corner >> 2);
        let weight = |w: f64, bit: usize| if bit == 1 { w } else { 1.0 - w };
        sum += weight(wx, i) * weight(wy, j) * weight(wz, k) * at(((z + k) * ny + y + j) * nx + x + i);
    }
    sum
}

/// Central difference at a sample, world units; beyond the grid, samples are replicated outwards.
fn central_difference(scene: &Scene, field: &DenseField, index: usize, axis: usize) -> f64 {
    let dims = scene.grid.dims;
    let stride: usize = dims[..axis].iter().product();
    let i = index / stride % dims[axis];
    let before = if i > 0 { index - stride } else { index };
    let after = if i + 1 < dims[axis] { index + stride } else { index };
    (field.samples[after] - field.samples[before]) / (2.0 * scene.grid.spacing[axis])
}
