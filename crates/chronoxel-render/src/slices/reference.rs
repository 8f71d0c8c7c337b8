//! The picture of slices, by definition.
//!
//! Double precision, one ray after another, no polygons: the ray of a pixel meets the planes of the view at known
//! lengths, and what is drawn of a plane at that pixel is the sample there. Rays meet the planes of a perspective
//! camera at an angle, so that a sample stands for more of the ray than the slice distance; its opacity is that of the
//! length between two planes along the ray.

use chronoxel_core::{Image, Ray};

use crate::reference::{composite, draw};
use crate::scene::clip_to_box;
use crate::{DenseField, DrawBrick, RenderError, Scene};

/// The picture of a scene drawn as slices, which are one step length of the scene's finest level apart: those that a
/// [`Slicer`](super::Slicer) of its camera cuts the grid's box into.
///
/// # Errors
/// [`RenderError`] if the scene cannot be drawn, or the field has another number of samples than the grid.
pub fn render_slices_reference(scene: &Scene, field: &DenseField) -> Result<Image, RenderError> {
    render_slices_reference_with(scene, field, &[])
}

/// [`render_slices_reference`], with what a draw list puts in place of samples: nothing, or a constant.
///
/// * `bricks`: in any order; where none lies, and where one has samples or a partial image, the field is drawn
///
/// # Errors
/// As [`render_slices_reference`].
pub fn render_slices_reference_with(
    scene: &Scene,
    field: &DenseField,
    bricks: &[DrawBrick],
) -> Result<Image, RenderError> {
    draw(scene, field, |ray| {
        let distance = scene.step_length_at(scene.finest_level);
        let crossing = SliceCrossings::new(scene, ray, distance);
        let Some(span) = clip_to_box(ray, scene.grid.bounds()) else { return [0.0; 4] };
        composite(scene, field, bricks, ray, crossing.lengths_in(span), distance / crossing.cosine)
    })
}

/// Where a ray crosses the planes of a view.
struct SliceCrossings {
    /// Between the ray and the direction of view.
    cosine: f64,
    /// Depth of the ray's origin: 0 but for rounding.
    depth: f64,
    distance: f64,
}

impl SliceCrossings {
    fn new(scene: &Scene, ray: &Ray, distance: f64) -> Self {
        let [_, _, forward] = scene.camera.axes();
        let position = scene.camera.position();
        let cosine = (0..3).map(|a| forward[a] * ray.direction[a]).sum();
        let depth = (0..3).map(|a| forward[a] * (ray.origin[a] - position[a])).sum();
        Self { cosine, depth, distance }
    }

    /// The lengths from `entry` on and before `exit` at which the ray crosses planes in front of the camera.
    fn lengths_in(&self, [entry, exit]: [f64; 2]) -> impl Iterator<Item = f64> {
        // The first plane from a length on. Rounding must not decide about planes in the faces of the box.
        let first_at = |length: f64| {
            ((self.depth + length * self.cosine) / self.distance - ROUNDING_IN_SLICES).ceil() as i64
        };
        let length = |k: i64| (k as f64 * self.distance - self.depth) / self.cosine;
        (first_at(entry).max(1)..first_at(exit)).map(length)
    }
}

/// How far a plane that lies in a face may seem to lie off it, in slice distances.
const ROUNDING_IN_SLICES: f64 = 1e-9;
