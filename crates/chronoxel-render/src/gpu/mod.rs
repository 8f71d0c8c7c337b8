//! The renderer on the GPU, by wgpu: payloads are decoded there, and rays cast through a page table.
//!
//! Indices and tables of payloads lie in storage buffers (banks). A pass decodes the bricks of a picture into slots of a
//! 3-D texture (the brick pool); a step of time changes the row of their tables and nothing else, so that no more than
//! row numbers are uploaded. The page table, an octree of the boxes of the draw list, says of each place whether it is
//! empty, constant or in a slot; rays go through it box by box and take the samples that the CPU takes.
//!
//! What WebGPU guarantees suffices; 16-bit fractions, larger buffers and timestamps are used where they are offered.

mod ahead;
mod bank;
mod cells;
mod decode;
mod device;
mod error;
mod host;
mod import;
mod memory;
mod oldest;
mod page_table;
mod picture;
mod pool;
mod portion;
mod raycast;
mod read_back;
#[cfg(test)]
mod shader_tests;
mod slicing;
mod target;
mod timing;
#[cfg(test)]
mod twins;

use std::borrow::Cow;
use std::sync::Arc;
use std::time::Instant;

use chronoxel_codec::Payload;
use chronoxel_core::{BitMask, Image, NodeId};

use crate::{RenderError, Scene};
pub use cells::{CellWay, GpuCellOptions, GpuCellRenderer, GpuCellStats, GpuCellValues};
use device::Device;
pub use device::GpuInfo;
pub use error::GpuError;
use portion::{Colors, Making, Residency};
use raycast::{Caster, Shot};
pub use read_back::{GpuPicture, ReadBack};
use slicing::Slicing;
use timing::Timer;

/// How the GPU is used.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GpuOptions {
    /// GPU memory that buffers and textures may take together.
    pub memory_bytes: u64,
    /// A part of the adapter's name, in any case; `None` takes the one that suits best.
    pub adapter: Option<String>,
    /// Use no more than WebGPU guarantees everywhere.
    pub guaranteed_only: bool,
    /// What is drawn of bricks.
    pub method: Method,
    /// When payloads are decoded; `None` for what is faster on adapters of the kind, see [`Way::for_adapter`].
    pub way: Option<Way>,
    /// What is interpolated.
    pub interpolation: Interpolation,
}

impl Default for GpuOptions {
    fn default() -> Self {
        Self {
            memory_bytes: 1 << 30,
            adapter: None,
            guaranteed_only: false,
            method: Method::default(),
            way: None,
            interpolation: Interpolation::default(),
        }
    }
}

/// What is drawn of bricks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Method {
    /// Samples along rays, front to back.
    #[default]
    Raycast,
    /// Polygons across the direction of view, blended back to front, see [`slices`](mod@crate::slices).
    Slices,
}

/// When payloads are decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// Once per step, into the brick pool, which the GPU's filters interpolate.
    Pool,
    /// At each fetch: eight indices are looked up in their tables for each sample that is taken.
    Fetch,
}

impl Way {
    /// The faster way on adapters of a kind; `chronoxel bench gpu-playback` measures both.
    ///
    /// Programs on the CPU decode a step in less time than one picture takes that is decoded at each fetch. GPUs have
    /// filters for what [`Way::Fetch`] computes; none has been measured.
    pub fn for_adapter(_info: &GpuInfo) -> Self {
        Self::Pool
    }
}

/// What is interpolated between samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Interpolation {
    /// Scalars, before they are looked up in the transfer function.
    #[default]
    Scalar,
    /// Colours, after it (lum2001), for comparison.
    Color,
}

/// One entry of a draw list: a box of the octree, and what is in it.
#[derive(Debug, Clone)]
pub struct GpuBrick {
    /// The node whose data is drawn.
    pub node: NodeId,
    /// The half-open box to draw it in, in level-0 voxels: the node's own, or the octant of a finer node that is
    /// absent.
    pub region: [[f64; 3]; 2],
    /// What is in it.
    pub how: GpuHow,
}

/// What a draw list says of a box.
#[derive(Debug, Clone)]
pub enum GpuHow {
    /// Nothing is seen there.
    Skip,
    /// One value everywhere, crossed in closed form and unlit.
    Constant(f64),
    /// One sRGB colour and opacity per unit length everywhere, whatever the transfer function: crossed in closed form,
    /// unlit.
    ConstantColor([f32; 3], f32),
    /// Samples, as they are coded.
    Coded(CodedBrick),
}

/// A payload at a step.
#[derive(Debug, Clone)]
pub struct CodedBrick {
    /// The caller's: equal keys have equal payloads and masks.
    pub key: u64,
    /// Indices and tables.
    pub payload: Arc<Payload>,
    /// The step, counted from the first of the payload's span.
    pub step_in_span: u32,
    /// Masked samples, over core and apron.
    pub mask: Option<Arc<BitMask>>,
    /// Between two steps, the later one.
    pub later: Option<LaterStep>,
}

/// The later of two steps between which a brick is drawn: its samples are interpolated in time.
#[derive(Debug, Clone)]
pub struct LaterStep {
    /// The caller's: as that of a [`CodedBrick`] of this payload without a mask.
    pub key: u64,
    /// Indices and tables: the same payload, or that of the next window.
    pub payload: Arc<Payload>,
    /// The step, counted from the first of the payload's span.
    pub step_in_span: u32,
    /// Its weight, from 0 to 1.
    pub weight: f64,
}

/// What it took to make a picture.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GpuStats {
    /// Bricks of the list that were sampled.
    pub bricks_drawn: usize,
    /// Bricks crossed in closed form.
    pub bricks_constant: usize,
    /// Bricks left out: absent, transparent, or outside the grid.
    pub bricks_skipped: usize,
    /// Parts in which the list was drawn, because not all of its slots were there at once, or not all of the picture.
    pub num_portions: usize,
    /// Slots of the brick pool.
    pub num_slots: usize,
    /// Slots that were decoded.
    pub slots_decoded: usize,
    /// Payloads that were uploaded.
    pub payloads_uploaded: usize,
    /// Bytes uploaded, of payloads and all else.
    pub bytes_uploaded: u64,
    /// GPU memory in use.
    pub gpu_bytes: u64,
    /// The most GPU memory that was ever in use.
    pub gpu_bytes_peak: u64,
    /// Time to decode, by the GPU's clock; 0 where it has none.
    pub decode_ms: f64,
    /// Time to cast rays, by the GPU's clock; where it has none, of the whole picture.
    pub render_ms: f64,
    /// Wall-clock time, until the picture was read back.
    pub wall_ms: f64,
}

/// What draws, by the method.
#[derive(Debug)]
enum Drawing {
    Raycast(Box<Caster>),
    Slices(Box<Slicing>),
}

impl Drawing {
    fn new(device: &Device, options: &GpuOptions) -> Result<Self, GpuError> {
        let (lists_bytes, colors_bytes) = (options.memory_bytes / 8, options.memory_bytes / 16);
        Ok(match options.method {
            Method::Raycast => Self::Raycast(Box::new(Caster::new(device, lists_bytes, colors_bytes)?)),
            Method::Slices => Self::Slices(Box::new(Slicing::new(device, lists_bytes, colors_bytes)?)),
        })
    }

    fn set_colors(&mut self, device: &Device, colors: &[u32]) -> Result<(), GpuError> {
        match self {
            Self::Raycast(caster) => caster.set_colors(device, colors),
            Self::Slices(slicing) => slicing.set_colors(device, colors),
        }
    }

    fn hold_picture(
        &mut self,
        device: &Device,
        size: [usize; 2],
        most_bytes: u64,
        read_back: ReadBack,
    ) -> Result<usize, GpuError> {
        match self {
            Self::Raycast(caster) => caster.hold_picture(device, size, most_bytes, read_back),
            Self::Slices(slicing) => slicing.hold_picture(device, size, most_bytes, read_back),
        }
    }

    fn read_rows(&self, device: &Device, num: usize, into: &mut GpuPicture) -> Result<(), GpuError> {
        match self {
            Self::Raycast(caster) => caster.read_rows(device, num, into),
            Self::Slices(slicing) => slicing.read_rows(device, num, into),
        }
    }
}

/// A renderer on one adapter, and what is resident there.
#[derive(Debug)]
pub struct GpuRenderer {
    options: GpuOptions,
    way: Way,
    residency: Residency,
    drawing: Drawing,
    colors: Colors,
    timer: Timer,
    device: Device,
}

impl GpuRenderer {
    /// A renderer on the adapter that suits best, or on the one that the options name.
    ///
    /// # Errors
    /// [`GpuError`] if there is no such adapter, it cannot be used, or the memory is too small.
    pub fn new(options: &GpuOptions) -> Result<Self, GpuError> {
        let device = Device::new(options)?;
        let timer = Timer::new(&device)?;
        let drawing = Drawing::new(&device, options)?;
        let way = options.way.unwrap_or_else(|| Way::for_adapter(&device.info));
        let residency = Residency::new(options.memory_bytes, way);
        Ok(Self {
            options: options.clone(),
            way,
            residency,
            drawing,
            colors: Colors::default(),
            timer,
            device,
        })
    }

    /// The adapter that [`Self::new`] would draw on.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`] if there is none.
    pub fn adapter(options: &GpuOptions) -> Result<GpuInfo, GpuError> {
        device::find(options)
    }

    /// Which adapter it is, and what it offers.
    pub fn info(&self) -> &GpuInfo {
        &self.device.info
    }

    /// When it decodes.
    pub fn way(&self) -> Way {
        self.way
    }

    /// Draws a scene from its bricks.
    ///
    /// * `bricks`: boxes that do not overlap, front to back
    ///
    /// # Errors
    /// [`GpuError`] if the scene or a brick cannot be drawn, the memory is too small, or the device is lost: then
    /// make another renderer.
    pub fn draw(&mut self, scene: &Scene, bricks: &[GpuBrick]) -> Result<(Image, GpuStats), GpuError> {
        match self.draw_as(scene, bricks, ReadBack::Floats)? {
            (GpuPicture::Floats(image), stats) => Ok((image, stats)),
            _ => unreachable!("floats were asked for"),
        }
    }

    /// Draws a scene from its bricks, and reads it back as it is asked for.
    ///
    /// * `bricks`: boxes that do not overlap, front to back
    ///
    /// # Errors
    /// As [`Self::draw`].
    pub fn draw_as(
        &mut self,
        scene: &Scene,
        bricks: &[GpuBrick],
        read_back: ReadBack,
    ) -> Result<(GpuPicture, GpuStats), GpuError> {
        self.draw_in_parts(scene, read_back, 1, &mut |_| Ok(Cow::Borrowed(bricks)))
    }

    /// Draws a scene from a list that comes in parts, of which no more than one is kept: for lists whose payloads do
    /// not fit the caller's memory at once.
    ///
    /// * `part`: the bricks of a part, front to back; parts too are counted from front to back. They are asked for in
    ///   the order in which they are drawn, and again for each band of a picture that is drawn in bands
    ///
    /// # Errors
    /// As [`Self::draw`], and whatever keeps a part from being made.
    pub fn draw_in_parts<'b, E: From<GpuError>>(
        &mut self,
        scene: &Scene,
        read_back: ReadBack,
        num_parts: usize,
        part: &mut dyn FnMut(usize) -> Result<Cow<'b, [GpuBrick]>, E>,
    ) -> Result<(GpuPicture, GpuStats), E> {
        let drawn = self.try_draw(scene, read_back, num_parts, part);
        if drawn.is_err() {
            self.residency.forget();
        }
        drawn
    }

    fn try_draw<'b, E: From<GpuError>>(
        &mut self,
        scene: &Scene,
        read_back: ReadBack,
        num_parts: usize,
        part: &mut dyn FnMut(usize) -> Result<Cow<'b, [GpuBrick]>, E>,
    ) -> Result<(GpuPicture, GpuStats), E> {
        let start = Instant::now();
        self.device.check()?;
        scene.check().map_err(GpuError::from)?;
        let mut stats = GpuStats::default();
        let most_bytes = self.options.memory_bytes / 4;
        let rows = self.drawing.hold_picture(&self.device, scene.size, most_bytes, read_back)?;
        let mut picture = GpuPicture::empty(read_back, scene.size);
        let height = scene.size[1];
        for first_row in (0..height).step_by(rows) {
            let num_rows = rows.min(height - first_row);
            // An empty list is drawn as well: it makes the picture blank.
            for number in 0..num_parts.max(1) {
                let bricks = match num_parts {
                    0 => Cow::Borrowed(&[][..]),
                    // Rays gather from front to back, slices are laid over each other from back to front.
                    _ if self.options.method == Method::Slices => {
                        let mut bricks = part(num_parts - 1 - number)?.into_owned();
                        bricks.reverse();
                        Cow::Owned(bricks)
                    }
                    _ => part(number)?,
                };
                self.draw_part(scene, &bricks, [first_row, num_rows], number == 0, &mut stats)?;
                if num_parts > 1 {
                    // What was uploaded of it is held until it was used.
                    self.device.settle();
                }
            }
            self.drawing.read_rows(&self.device, num_rows, &mut picture)?;
        }
        self.finish(&mut stats, start)?;
        Ok((picture, stats))
    }

    /// Draws rows of the picture from a part of the list, in as many portions as it takes.
    ///
    /// * `bricks`: in the order in which they are drawn
    /// * `is_first`: whether nothing was drawn of those rows before
    fn draw_part(
        &mut self,
        scene: &Scene,
        bricks: &[GpuBrick],
        rows: [usize; 2],
        mut is_first: bool,
        stats: &mut GpuStats,
    ) -> Result<(), GpuError> {
        let (way, interpolation) = (self.way, self.options.interpolation);
        self.colors.set(scene, bricks)?;
        self.drawing.set_colors(&self.device, &self.colors.words)?;
        self.residency.hold(&self.device, scene, bricks)?;
        let mut drawn = 0;
        while is_first || drawn < bricks.len() {
            let mut found = GpuStats::default();
            let mut making = Making { device: &self.device, timer: &mut self.timer, stats: &mut found };
            let portion = self.residency.gather(&mut making, scene, bricks, &mut drawn, &self.colors)?;
            stats.slots_decoded += found.slots_decoded;
            stats.payloads_uploaded += found.payloads_uploaded;
            if rows[0] == 0 {
                stats.bricks_drawn += found.bricks_drawn;
                stats.bricks_constant += found.bricks_constant;
                stats.bricks_skipped += found.bricks_skipped;
            }
            let shot = Shot { scene, way, interpolation, rows, is_first };
            let sources = self.residency.sources();
            let (device, timer) = (&self.device, &mut self.timer);
            match &mut self.drawing {
                Drawing::Raycast(caster) => caster.draw(device, shot, &portion, sources, timer)?,
                Drawing::Slices(slicing) => {
                    slicing.draw(device, shot, &portion, sources, timer)?;
                }
            }
            stats.num_portions += 1;
            is_first = false;
        }
        Ok(())
    }

    fn finish(&mut self, stats: &mut GpuStats, start: Instant) -> Result<(), GpuError> {
        let times = self.timer.finish(&self.device)?;
        stats.wall_ms = start.elapsed().as_secs_f64() * 1e3;
        [stats.decode_ms, stats.render_ms, _] = times.unwrap_or([0.0, stats.wall_ms, 0.0]);
        stats.num_slots = self.residency.num_slots();
        stats.bytes_uploaded = self.device.take_uploaded();
        stats.gpu_bytes = self.device.budget.used();
        stats.gpu_bytes_peak = self.device.budget.peak();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use chronoxel_core::{BrickLayout, Camera, ColorMap, TransferFunction, UniformGrid};

    use super::*;

    #[test]
    fn a_lost_device_is_reported() {
        if twins::device().is_none() {
            return;
        }
        let mut gpu = GpuRenderer::new(&GpuOptions { memory_bytes: 16 << 20, ..Default::default() }).unwrap();
        let grid = UniformGrid::new([20; 3], [0.0; 3], [1.0; 3]).unwrap();
        let scene = Scene {
            grid,
            layout: BrickLayout::new(8).unwrap(),
            camera: Camera::orbit(grid.bounds(), 0.0, 0.0, 1.0, None, 1.0).unwrap(),
            transfer: TransferFunction::built_in("ramp", ColorMap::Viridis)
                .unwrap()
                .resolve([0.0, 1.0])
                .unwrap(),
            size: [16, 16],
            step_voxels: 1.0,
            finest_level: 0,
            lighting: None,
            opacity_unit: 1.0,
        };
        gpu.draw(&scene, &[]).unwrap();
        gpu.device.raw.destroy();
        // At once or at the next picture, as the driver tells it.
        let refused = gpu.draw(&scene, &[]).and_then(|_| gpu.draw(&scene, &[])).unwrap_err();
        let message = refused.to_string();
        assert!(matches!(refused, GpuError::Lost { .. }), "{message}");
        assert!(message.contains("new device") && !message.contains('\n'), "{message}");
    }
}
