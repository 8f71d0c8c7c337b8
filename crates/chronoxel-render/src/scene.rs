//! What is drawn, from where, and how: the same words for every renderer.

use std::sync::Arc;

use chronoxel_core::{
    BrickLayout, Camera, Lighting, NodeId, Ray, ResolvedTransfer, UniformGrid, image::check_size,
};

use crate::{PartialImage, PreparedBrick, RenderError};

/// Everything about a picture but the samples.
///
/// A ray takes samples at `t_k = t_entry + (k + ½) · dt`, where `t_entry` is where it enters the box of the grid and
/// `k` counts from 0 to `round((t_exit − t_entry) / dt)`; a brick of level `l` is sampled at the same rule with
/// `dt · 2^l`. Each brick owns the samples inside its box, by a rule that depends on the planes of the box alone.
/// Constants own samples of the picture's finest level, whatever their own: between them and its bricks, no sample is
/// lost or taken twice.
#[derive(Debug, Clone)]
pub struct Scene {
    /// Where samples lie.
    pub grid: UniformGrid,
    /// The shape of the bricks.
    pub layout: BrickLayout,
    /// Where it is seen from.
    pub camera: Camera,
    /// Colour and opacity of a value.
    pub transfer: ResolvedTransfer,
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// Distance between samples at level 0, in multiples of the grid's smallest spacing; up to 2.
    pub step_voxels: f64,
    /// The finest level that the picture draws, by whose step length constants are crossed; below 32.
    pub finest_level: u8,
    /// How samples are lit; `None` draws their own colours.
    pub lighting: Option<Lighting>,
    /// Path length that the transfer function's opacities refer to, world units.
    pub opacity_unit: f64,
}

/// Levels that a draw list may have: more than any grid of 2^31 samples along an axis.
pub(crate) const MAX_LEVELS: u8 = 32;

impl Scene {
    /// Distance between samples at level 0, world units.
    pub fn step_length(&self) -> f64 {
        self.step_voxels * self.grid.smallest_spacing()
    }

    /// Distance between samples at a level below [`MAX_LEVELS`], world units.
    pub(crate) fn step_length_at(&self, level: u8) -> f64 {
        self.step_length() * (1u64 << level) as f64
    }

    /// Checks that the scene can be drawn.
    ///
    /// # Errors
    /// [`RenderError`] naming what cannot be used.
    pub fn check(&self) -> Result<(), RenderError> {
        check_size(self.size)?;
        if self.grid.num_cells() == 0 {
            return Err(RenderError::FlatGrid { dims: self.grid.dims });
        }
        if !(0.01..=2.0).contains(&self.step_voxels) {
            let remedy = "use a number of voxels between 0.01 and 2";
            return Err(RenderError::invalid("step length", self.step_voxels, remedy));
        }
        if self.finest_level >= MAX_LEVELS {
            return Err(RenderError::invalid("finest level", self.finest_level, "it must be below 32"));
        }
        if !(self.opacity_unit.is_finite() && self.opacity_unit > 0.0) {
            let remedy = "it must be a finite and positive length";
            return Err(RenderError::invalid("opacity unit", self.opacity_unit, remedy));
        }
        Ok(self.lighting.map_or(Ok(()), |lighting| lighting.check())?)
    }
}

/// The part of a ray inside a box, in front of the camera: lengths along it.
pub(crate) fn clip_to_box(ray: &Ray, [low, high]: [[f64; 3]; 2]) -> Option<[f64; 2]> {
    let (mut entry, mut exit) = (0.0f64, f64::INFINITY);
    for a in 0..3 {
        if ray.direction[a] == 0.0 {
            if !(low[a]..=high[a]).contains(&ray.origin[a]) {
                return None;
            }
            continue;
        }
        let inverse = 1.0 / ray.direction[a];
        let (t0, t1) = ((low[a] - ray.origin[a]) * inverse, (high[a] - ray.origin[a]) * inverse);
        entry = entry.max(t0.min(t1));
        exit = exit.min(t0.max(t1));
    }
    (entry < exit).then_some([entry, exit])
}

/// One entry of a draw list: a box, and what is in it.
#[derive(Debug, Clone)]
pub struct DrawBrick {
    /// The node whose data is drawn.
    pub node: NodeId,
    /// The half-open box to draw it in, in level-0 voxels: the node's own, or the octant of a finer node that
    /// is absent.
    pub region: [[f64; 3]; 2],
    /// What is in it.
    pub how: DrawHow,
}

impl DrawBrick {
    /// Whether it is drawn from samples.
    pub fn is_sampled(&self) -> bool {
        matches!(self.how, DrawHow::Samples(_))
    }
}

/// What a draw list says of a box.
#[derive(Debug, Clone)]
pub enum DrawHow {
    /// Nothing is seen there.
    Skip,
    /// One value everywhere, crossed in closed form and unlit.
    Constant(f64),
    /// One sRGB colour and opacity per unit length everywhere, whatever the transfer function: crossed in closed form,
    /// unlit.
    ConstantColor([f32; 3], f32),
    /// Samples.
    Samples(Arc<PreparedBrick>),
    /// What was recorded of it, and of those that follow it, in an earlier picture of the same view; wherever the box
    /// lies.
    Partial(Arc<PartialImage>),
}

/// What it took to make a picture.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RenderStats {
    /// Samples interpolated and classified.
    pub num_samples: u64,
    /// Bricks of the list that were sampled.
    pub bricks_drawn: usize,
    /// Bricks crossed in closed form.
    pub bricks_constant: usize,
    /// Partial images composited.
    pub bricks_composited: usize,
    /// Bricks left out: absent, transparent, or outside the picture.
    pub bricks_skipped: usize,
    /// Wall-clock time.
    pub render_ms: f64,
}
