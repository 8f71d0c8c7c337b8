//! The right picture of a mesh, by definition: every ray cut by every tetrahedron, and its segments sorted.
//!
//! Double precision, no tables, no early end, no faces: a segment belongs to one tetrahedron, and so what is between two
//! parts of a mesh is empty. It is slow, and meant to be read.

use chronoxel_core::{Image, Ray, compositing};

use super::gradient::unit_gradients;
use super::mesh::{cross, dot, sub};
use super::segment::integrate_segment;
use super::{CellMesh, CellScene};
use crate::RenderError;

/// The part of a ray in one tetrahedron.
struct Segment {
    /// Lengths along the ray.
    ends: [f64; 2],
    values: [f64; 2],
    /// Mean of the cosines between gradient and ray at both ends.
    cosine: f64,
}

/// The picture of a mesh.
///
/// # Errors
/// As [`super::CellRenderer::render`].
pub fn render_cells_reference(
    mesh: &CellMesh,
    scene: &CellScene,
    values: &[f32],
) -> Result<Image, RenderError> {
    scene.check(mesh, values.len())?;
    let gradients = scene.lighting.map(|_| unit_gradients(mesh, values));
    let [width, height] = scene.size;
    let rays = scene.camera.rays(scene.size);
    let mut segments: Vec<Vec<Segment>> = Vec::new();
    segments.resize_with(width * height, Vec::new);
    for cell in &mesh.tetrahedra {
        let corners = cell.map(|p| mesh.points[p as usize]);
        let [columns, rows] = pixels_of(scene, corners);
        for (y, x) in rows.flat_map(|y| columns.clone().map(move |x| (y, x))) {
            let ray = rays.ray([x as f64 + 0.5, y as f64 + 0.5]);
            segments[y * width + x].extend(cut(&ray, *cell, corners, values, gradients.as_deref()));
        }
    }
    let mut image = Image::new(width, height)?;
    for (pixel, segments) in image.pixels.iter_mut().zip(&mut segments) {
        segments.sort_by(|a, b| a.ends[0].total_cmp(&b.ends[0]));
        let mut sum = [0.0; 4];
        for segment in segments {
            let light = scene.lighting.map_or((1.0, 0.0), |lighting| {
                // Cosines lie between -1 and 1: a gradient of that cosine along the ray.
                let side = (1.0 - segment.cosine.powi(2)).max(0.0).sqrt();
                lighting.headlight_terms([segment.cosine, side, 0.0], [1.0, 0.0, 0.0])
            });
            let length = segment.ends[1] - segment.ends[0];
            let color = integrate_segment(&scene.transfer, segment.values, length, scene.opacity_unit, light);
            compositing::accumulate(&mut sum, color);
        }
        *pixel = sum.map(|c| c as f32);
    }
    Ok(image)
}

/// Columns and rows of the picture that a tetrahedron may touch.
fn pixels_of(scene: &CellScene, corners: [[f64; 3]; 4]) -> [std::ops::Range<usize>; 2] {
    let projected = corners.map(|p| scene.camera.project(p, scene.size));
    if projected.iter().any(Option::is_none) {
        return scene.size.map(|n| 0..n);
    }
    std::array::from_fn(|axis| {
        let places = || projected.iter().flatten().map(|p| p[axis]);
        let low = places().fold(f64::INFINITY, f64::min).floor().max(0.0) as usize;
        let high = places().fold(0.0, f64::max).ceil() as usize;
        low.min(scene.size[axis])..high.min(scene.size[axis])
    })
}

/// The part of a ray in a tetrahedron, if it has any length and values at all four corners.
fn cut(
    ray: &Ray,
    cell: [u32; 4],
    corners: [[f64; 3]; 4],
    values: &[f32],
    gradients: Option<&[[f32; 3]]>,
) -> Option<Segment> {
    let (mut entry, mut exit) = (0.0f64, f64::INFINITY);
    // Each corner's coordinate is its distance from the opposite side, 1 at the corner: linear along the ray.
    let mut coordinates = [[0.0; 2]; 4];
    for i in 0..4 {
        let [a, b, c] = [1, 2, 3].map(|j| corners[(i + j) % 4]);
        let normal = cross(sub(b, a), sub(c, a));
        let scale = 1.0 / dot(normal, sub(corners[i], a));
        let start = dot(normal, sub(ray.origin, a)) * scale;
        let slope = dot(normal, ray.direction) * scale;
        if slope > 0.0 {
            entry = entry.max(-start / slope);
        } else if slope < 0.0 {
            exit = exit.min(-start / slope);
        } else if start < 0.0 {
            return None;
        }
        coordinates[i] = [start, slope];
    }
    if entry >= exit {
        return None;
    }
    let at = |t: f64| coordinates.map(|[start, slope]| start + slope * t);
    let ends = [entry, exit];
    let weighted = |t: f64, of: &dyn Fn(usize) -> f64| {
        at(t).iter().zip(cell).map(|(w, p)| w * of(p as usize)).sum::<f64>()
    };
    let cosine = gradients.map_or(0.0, |gradients| {
        let along = |p: usize| dot(gradients[p].map(f64::from), ray.direction);
        0.5 * ends.map(|t| weighted(t, &along).abs()).iter().sum::<f64>()
    });
    let ends_values = ends.map(|t| weighted(t, &|p| f64::from(values[p])));
    ends_values.iter().all(|v| !v.is_nan()).then_some(Segment { ends, values: ends_values, cosine })
}
