//! Tetrahedra drawn on the GPU, the picture of [`CellRenderer`](crate::CellRenderer).
//!
//! Points and faces stay there. A camera that turns costs a sort of the faces, any new camera a projection and the lists of
//! the tiles, all in compute passes; a step costs one value per point, or a row number where a pass decodes it.
//! A workgroup takes a tile, and each of its invocations a pixel, with a buffer of `k` fragments in registers.

mod order;
mod passes;
mod resident;
mod sight;
mod sorter;
mod tiles;
mod values;

use std::sync::Arc;
use std::time::Instant;

use chronoxel_codec::Payload;
use chronoxel_core::{BitMask, Image};

use super::device::Device;
use super::picture::Picture;
use super::read_back::{GpuPicture, ReadBack};
use super::timing::Timer;
use super::{GpuError, GpuInfo, GpuOptions};
use crate::cells::raster::check_k;
use crate::cells::{CellMesh, CellScene, CellStats, FaceChoice};
use resident::Resident;
use sight::{Sight, TILE};
use tiles::Tiles;
use values::Values;

/// Where a part of the work is done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CellWay {
    /// In the threads of rayon's current pool.
    Cpu,
    /// In compute passes.
    Gpu,
}

impl CellWay {
    /// The faster way to decode on adapters of a kind.
    pub fn for_decoding(_info: &GpuInfo) -> Self {
        Self::Gpu
    }

    /// The faster way to sort on adapters of a kind: programs on the CPU take several times as long for it as the CPU itself.
    pub fn for_sorting(info: &GpuInfo) -> Self {
        if info.is_software { Self::Cpu } else { Self::Gpu }
    }
}

/// How the renderer goes about it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GpuCellOptions {
    /// Fragments that a pixel can put into order: 2, 6 or 16.
    pub k: usize,
    /// Where payloads are decoded; `None` for [`CellWay::for_decoding`].
    pub decoding: Option<CellWay>,
    /// Where faces are sorted by depth; `None` for [`CellWay::for_sorting`]. Cameras within a mesh sort on the CPU.
    pub sorting: Option<CellWay>,
}

impl Default for GpuCellOptions {
    fn default() -> Self {
        Self { k: 6, decoding: None, sorting: None }
    }
}

/// Values at the points of a mesh.
#[derive(Debug, Clone)]
pub enum GpuCellValues<'a> {
    /// One per point; where one is NaN, the segments around it are not drawn.
    Decoded(&'a [f32]),
    /// A step of a payload.
    Coded {
        /// Indices and tables, one index per point and stage.
        payload: Arc<Payload>,
        /// The caller's: equal keys have equal payloads and missing points.
        key: u64,
        /// The step, counted from the first of the payload's span.
        step_in_span: u32,
        /// Points without a value: one bit each.
        missing: Option<Arc<BitMask>>,
    },
}

impl GpuCellValues<'_> {
    /// Their number.
    fn num(&self) -> usize {
        match self {
            Self::Decoded(values) => values.len(),
            Self::Coded { payload, .. } => payload.stages.first().map_or(0, |stage| stage.indices.len()),
        }
    }
}

/// What it took to make a picture.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GpuCellStats {
    /// Faces, fragments, and what changed.
    pub cells: CellStats,
    /// Faces in the lists of the tiles, counted in each.
    pub num_listed: u64,
    /// Parts in which the picture was drawn, because not all lists or not all of it had room at once.
    pub num_portions: usize,
    /// Payloads that were uploaded.
    pub payloads_uploaded: usize,
    /// Bytes uploaded, of values and all else.
    pub bytes_uploaded: u64,
    /// GPU memory in use.
    pub gpu_bytes: u64,
    /// The most GPU memory that was ever in use.
    pub gpu_bytes_peak: u64,
    /// Time to give points their values and gradients, by the GPU's clock; 0 where it has none.
    pub decode_ms: f64,
    /// Time to project, sort and bin, likewise.
    pub view_ms: f64,
    /// Time to draw the tiles, likewise; where there is no clock, of the whole picture.
    pub render_ms: f64,
    /// Wall-clock time, until the picture was read back.
    pub wall_ms: f64,
}

/// Draws pictures of one mesh on one adapter, and keeps there what the next one can use.
#[derive(Debug)]
pub struct GpuCellRenderer {
    resident: Resident,
    sight: Sight,
    values: Values,
    tiles: Tiles,
    picture: Option<Picture>,
    /// Whether the cosines are those of the values and the camera.
    is_lit: bool,
    timer: Timer,
    memory_bytes: u64,
    device: Device,
}

impl GpuCellRenderer {
    /// A renderer of a mesh on the adapter that suits best, or on the one that the options name.
    ///
    /// * `gpu`: which adapter, and how much of its memory
    ///
    /// # Errors
    /// [`GpuError`] if there is no such adapter, it cannot be used, or it or the memory is too small for the mesh; or
    /// if `k` is none of 2, 6 and 16.
    pub fn new(mesh: Arc<CellMesh>, gpu: &GpuOptions, options: GpuCellOptions) -> Result<Self, GpuError> {
        check_k(options.k)?;
        let device = Device::new(gpu)?;
        let timer = Timer::new(&device)?;
        let decoding = options.decoding.unwrap_or_else(|| CellWay::for_decoding(&device.info));
        let sorting = options.sorting.unwrap_or_else(|| CellWay::for_sorting(&device.info));
        Ok(Self {
            resident: Resident::new(&device, mesh)?,
            sight: Sight::new(&device, sorting)?,
            values: Values::new(&device, decoding, gpu.memory_bytes / 4)?,
            tiles: Tiles::new(&device, options.k)?,
            picture: None,
            is_lit: false,
            timer,
            memory_bytes: gpu.memory_bytes,
            device,
        })
    }

    /// The mesh.
    pub fn mesh(&self) -> &Arc<CellMesh> {
        &self.resident.mesh
    }

    /// Which adapter it is, and what it offers.
    pub fn info(&self) -> &GpuInfo {
        &self.device.info
    }

    /// Draws only some of the faces from now on, or all.
    pub fn choose(&mut self, choice: Option<FaceChoice>) {
        self.sight.choose(choice, self.resident.mesh.num_faces());
    }

    /// Where payloads are decoded from now on.
    pub fn set_decoding(&mut self, decoding: CellWay) {
        if self.values.decoding != decoding {
            self.values.decoding = decoding;
            self.values.forget();
        }
    }

    /// Where faces are sorted from now on.
    pub fn set_sorting(&mut self, sorting: CellWay) {
        self.sight.set_sorting(sorting);
    }

    /// Uploads the payload of values that will be drawn, where payloads are decoded in compute passes.
    ///
    /// # Errors
    /// [`GpuError`] if it cannot be decoded, or there is no room for it.
    pub fn prepare(&mut self, values: &GpuCellValues) -> Result<(), GpuError> {
        if let (GpuCellValues::Coded { payload, key, missing, .. }, CellWay::Gpu) =
            (values, self.values.decoding)
        {
            let num_points = self.resident.mesh.num_points();
            self.values.hold_payload(&self.device, *key, payload, missing.as_deref(), num_points)?;
        }
        Ok(())
    }

    /// Draws a step.
    ///
    /// # Errors
    /// [`GpuError`] if the scene or the values cannot be drawn, the memory is too small, or the device is lost: then
    /// make another renderer.
    pub fn render(
        &mut self,
        scene: &CellScene,
        values: &GpuCellValues,
    ) -> Result<(Image, GpuCellStats), GpuError> {
        match self.render_as(scene, values, ReadBack::Floats)? {
            (GpuPicture::Floats(image), stats) => Ok((image, stats)),
            _ => unreachable!("floats were asked for"),
        }
    }

    /// Draws a step, and reads it back as it is asked for.
    ///
    /// # Errors
    /// As [`Self::render`].
    pub fn render_as(
        &mut self,
        scene: &CellScene,
        values: &GpuCellValues,
        read_back: ReadBack,
    ) -> Result<(GpuPicture, GpuCellStats), GpuError> {
        let drawn = self.try_render(scene, values, read_back);
        if drawn.is_err() {
            self.sight.forget();
            self.values.forget();
        }
        drawn
    }

    fn try_render(
        &mut self,
        scene: &CellScene,
        values: &GpuCellValues,
        read_back: ReadBack,
    ) -> Result<(GpuPicture, GpuCellStats), GpuError> {
        let start = Instant::now();
        self.device.check()?;
        scene.check(&self.resident.mesh, values.num())?;
        let mut stats = GpuCellStats::default();
        let most_bytes = self.memory_bytes / 4;
        let (device, picture) = (&self.device, &mut self.picture);
        let rows = Picture::hold(picture, device, scene.size, TILE as u64, most_bytes, read_back)?;
        self.make_ready(scene, values, &mut stats)?;
        let mut drawn = GpuPicture::empty(read_back, scene.size);
        self.tiles.begin(&self.device);
        for first_row in (0..scene.size[1]).step_by(rows) {
            let num_rows = rows.min(scene.size[1] - first_row);
            self.sight.data.first_row = first_row as u32;
            self.draw_rows([first_row / TILE, num_rows.div_ceil(TILE)].map(|n| n as u32), &mut stats)?;
            if let Some(picture) = &self.picture {
                picture.read_rows(&self.device, num_rows, &mut drawn)?;
            }
        }
        let counts = self.tiles.finish(&self.device)?;
        (stats.cells.num_fragments, stats.cells.num_misordered) = (counts.fragments, counts.misordered);
        self.finish(&mut stats, start)?;
        Ok((drawn, stats))
    }

    /// Does all that comes before drawing.
    fn make_ready(
        &mut self,
        scene: &CellScene,
        values: &GpuCellValues,
        stats: &mut GpuCellStats,
    ) -> Result<(), GpuError> {
        let Self { resident, sight, values: giving, tiles, timer, device, .. } = self;
        let longest = resident.mesh.longest_segment(sight.leaves_out());
        let key = (scene.transfer.clone(), scene.value_range, [scene.opacity_unit, longest]);
        stats.cells.table_changed = tiles.set_table(device, key)?;
        tiles.set_lighting(device, scene.lighting);
        let looked = sight.look(device, resident, &scene.camera, scene.size, timer)?;
        stats.cells.view_changed = looked.has_changed;
        sight.data.per_half_longest = (2.0 / longest) as f32;
        if looked.lost_values {
            giving.forget();
        }
        let has_new_values = giving.give(device, sight, tiles.table(), values, timer)?;
        self.is_lit &= !has_new_values && !looked.has_changed && scene.lighting.is_some();
        if scene.lighting.is_some() && !self.is_lit {
            giving.light(device, sight, resident, timer)?;
            self.is_lit = true;
        }
        Ok(())
    }

    /// Draws some rows of tiles, in as many portions as their lists take.
    ///
    /// * `rows`: the first, and how many
    fn draw_rows(&mut self, rows: [u32; 2], stats: &mut GpuCellStats) -> Result<(), GpuError> {
        let Self { resident, sight, values, tiles, picture, timer, device, .. } = self;
        let Some(picture) = picture else { return Ok(()) };
        let mut waiting = vec![rows];
        while let Some([first, num]) = waiting.pop() {
            if !sight.list(device, resident, [first, num], timer)? {
                let half = num / 2;
                waiting.extend([[first + half, num - half], [first, half]]);
                continue;
            }
            tiles.draw(device, sight, resident, values.cosines(), &picture.gathered, timer)?;
            stats.cells.num_faces += sight.num_seen as usize;
            stats.num_listed += u64::from(sight.num_pairs);
            stats.num_portions += 1;
        }
        Ok(())
    }

    fn finish(&mut self, stats: &mut GpuCellStats, start: Instant) -> Result<(), GpuError> {
        let times = self.timer.finish(&self.device)?;
        stats.wall_ms = start.elapsed().as_secs_f64() * 1e3;
        stats.cells.render_ms = stats.wall_ms;
        [stats.decode_ms, stats.render_ms, stats.view_ms] = times.unwrap_or([0.0, stats.wall_ms, 0.0]);
        stats.payloads_uploaded = std::mem::take(&mut self.values.num_payloads_uploaded);
        stats.bytes_uploaded = self.device.take_uploaded();
        stats.gpu_bytes = self.device.budget.used();
        stats.gpu_bytes_peak = self.device.budget.peak();
        Ok(())
    }
}
