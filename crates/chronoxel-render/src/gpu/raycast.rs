//! The ray caster on the GPU: its pipelines, and what it is given for a picture.

use std::collections::HashMap;

use bytemuck::{Zeroable, bytes_of, cast_slice};
use chronoxel_core::{PictureRays, Projection, UniformGrid};

use super::device::{Device, storage, uniform};
use super::host::{BrickData, ConstantData, LightingData, NO_LATER, ViewData};
use super::memory::{Buffer, Mirror};
use super::page_table::{CellBox, Entry, PageTable};
use super::picture::Picture;
use super::pool::Pool;
use super::read_back::{GpuPicture, ReadBack};
use super::timing::{Span, Timer};
use super::{GpuError, Interpolation, Scene, Way, import};
use crate::cpu::{LEAST_TRANSMITTANCE, table::NUM_ENTRIES};

/// What a box of a portion holds.
#[derive(Debug, Clone, Copy)]
pub(super) enum Content {
    Constant(ConstantData),
    Brick(BrickData),
}

/// What is drawn at once, all of its slots resident: boxes that do not overlap, in an order that does not depend on the
/// view.
pub(super) type Portion = Vec<(CellBox, Content)>;

/// What the ray caster holds.
#[derive(Debug)]
pub(super) struct Caster {
    layout: wgpu::BindGroupLayout,
    pipelines: HashMap<Key, wgpu::ComputePipeline>,
    sampler: wgpu::Sampler,
    view: Buffer,
    nodes: Mirror,
    bricks: Mirror,
    constants: Mirror,
    colors: Mirror,
    nothing: Buffer,
    picture: Option<Picture>,
}

/// What a portion is drawn for.
#[derive(Debug, Clone, Copy)]
pub(super) struct Shot<'a> {
    pub scene: &'a Scene,
    pub way: Way,
    pub interpolation: Interpolation,
    /// First row, and number of rows.
    pub rows: [usize; 2],
    /// Whether nothing was drawn of those rows before.
    pub is_first: bool,
}

/// What sets pipelines apart: lit, decoded at each fetch, of which some between two steps, and colours interpolated.
pub(super) type Key = [bool; 4];

/// The pipeline that a portion is drawn with.
pub(super) fn key_of(shot: &Shot, portion: &Portion) -> Key {
    let fetches = shot.way == Way::Fetch;
    let is_between = |content: &Content| matches!(content, Content::Brick(brick) if brick.later != NO_LATER);
    let blends = fetches && portion.iter().any(|(_, content)| is_between(content));
    [shot.scene.lighting.is_some(), fetches, blends, shot.interpolation == Interpolation::Color]
}

/// Where samples are found.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sources<'a> {
    pub pool: &'a Pool,
    /// Where they are decoded at each fetch.
    pub bank: Option<&'a wgpu::Buffer>,
}

impl Caster {
    /// * `lists_bytes`: what the lists of a portion may take together
    pub fn new(device: &Device, lists_bytes: u64, colors_bytes: u64) -> Result<Self, GpuError> {
        use wgpu::BufferUsages as Usage;
        let texture = wgpu::BindingType::Texture {
            sample_type: wgpu::TextureSampleType::Float { filterable: true },
            view_dimension: wgpu::TextureViewDimension::D3,
            multisampled: false,
        };
        let mut bindings = vec![uniform(false)];
        bindings.extend([storage(true); 6]);
        bindings.extend([storage(false), texture]);
        bindings.push(wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering));
        let sampler = wgpu::SamplerDescriptor {
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            ..Default::default()
        };
        let most = lists_bytes / 3;
        Ok(Self {
            layout: device.bind_group_layout("raycast", &bindings),
            pipelines: HashMap::new(),
            sampler: device.raw.create_sampler(&sampler),
            view: device.buffer(
                "the view",
                size_of::<ViewData>() as u64,
                Usage::UNIFORM | Usage::COPY_DST,
            )?,
            nodes: Mirror::new(device, "the page table", most)?,
            bricks: Mirror::new(device, "the list of bricks", most)?,
            constants: Mirror::new(device, "the list of constants", most)?,
            colors: Mirror::new(device, "the colours of the transfer function", colors_bytes)?,
            nothing: device.buffer("nothing", 16, Usage::STORAGE)?,
            picture: None,
        })
    }

    /// Makes room for as many rows of a picture as fit some bytes; returns their number.
    pub fn hold_picture(
        &mut self,
        device: &Device,
        size: [usize; 2],
        most_bytes: u64,
        read_back: ReadBack,
    ) -> Result<usize, GpuError> {
        Picture::hold(&mut self.picture, device, size, 1, most_bytes, read_back)
    }

    /// Uploads the colours of the levels drawn, one table after another.
    pub fn set_colors(&mut self, device: &Device, colors: &[u32]) -> Result<(), GpuError> {
        self.colors.set(device, colors)
    }

    /// Draws a portion behind what was drawn before.
    pub fn draw(
        &mut self,
        device: &Device,
        shot: Shot,
        portion: &Portion,
        sources: Sources,
        timer: &mut Timer,
    ) -> Result<(), GpuError> {
        let Shot { scene, rows, is_first, .. } = shot;
        let root_level = self.set_lists(device, scene, portion)?;
        let mut view = view_of(scene, rows);
        view.root_level = root_level;
        view.is_first = u32::from(is_first);
        view.per_texel = sources.pool.shape.texels().map(|n| 1.0 / n as f32);
        device.upload(&self.view.raw, 0, bytes_of(&view));
        let key = key_of(&shot, portion);
        self.hold_pipeline(device, key)?;
        let group = self.bind(device, sources);
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let span = timer.begin(&mut encoder, Span::Render);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&self.pipelines[&key]);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(view.num_columns.div_ceil(8), view.num_rows.div_ceil(8), 1);
        drop(pass);
        timer.end(&mut encoder, span);
        device.queue.submit([encoder.finish()]);
        Ok(())
    }

    /// Uploads what is in the boxes of a portion; returns the level of the page table's root.
    fn set_lists(&mut self, device: &Device, scene: &Scene, portion: &Portion) -> Result<u32, GpuError> {
        let mut portion = portion.clone();
        portion.sort_unstable_by_key(|(place, _)| *place);
        let (mut bricks, mut constants) = (Vec::new(), Vec::new());
        let entries = portion.iter().map(|(place, content)| {
            let entry = match content {
                Content::Brick(brick) => {
                    bricks.push(*brick);
                    Entry::Brick(bricks.len() as u32 - 1)
                }
                Content::Constant(constant) => {
                    constants.push(*constant);
                    Entry::Constant(constants.len() as u32 - 1)
                }
            };
            (*place, entry)
        });
        let entries: Vec<_> = entries.collect();
        let num_cells = cells_of(&scene.grid, scene.layout.edge);
        let table = PageTable::new(&entries, num_cells)?;
        self.nodes.set(device, &table.words)?;
        self.bricks.set(device, cast_slice(&bricks))?;
        self.constants.set(device, cast_slice(&constants))?;
        Ok(table.root_level)
    }

    fn hold_pipeline(&mut self, device: &Device, key: Key) -> Result<(), GpuError> {
        if !self.pipelines.contains_key(&key) {
            let [lit, fetch, blend, color] = key.map(|flag| f64::from(u8::from(flag)));
            let constants = [
                ("LIT", lit),
                ("FETCH", fetch),
                ("BLEND", blend),
                ("INTERPOLATE_COLOR", color),
                ("LEAST_TRANSMITTANCE", LEAST_TRANSMITTANCE.into()),
                ("NUM_COLORS", NUM_ENTRIES as f64),
            ];
            let pipeline = device.pipeline("raycast.wgsl", import::RAYCAST, &self.layout, &constants)?;
            self.pipelines.insert(key, pipeline);
        }
        Ok(())
    }

    fn bind(&self, device: &Device, Sources { pool, bank }: Sources) -> wgpu::BindGroup {
        let masks = pool.masks.as_ref().unwrap_or(&self.nothing);
        let picture = self.picture.as_ref().expect("room for a picture is made before it is drawn");
        let resources = [
            self.view.raw.as_entire_binding(),
            self.nodes.raw().as_entire_binding(),
            self.bricks.raw().as_entire_binding(),
            self.constants.raw().as_entire_binding(),
            self.colors.raw().as_entire_binding(),
            masks.raw.as_entire_binding(),
            bank.unwrap_or(&self.nothing.raw).as_entire_binding(),
            picture.gathered.raw.as_entire_binding(),
            wgpu::BindingResource::TextureView(&pool.texture.view),
            wgpu::BindingResource::Sampler(&self.sampler),
        ];
        device.bind_group(&self.layout, &resources)
    }

    /// Appends rows that were drawn to a picture, alpha in place of transmittance.
    pub fn read_rows(&self, device: &Device, num_rows: usize, into: &mut GpuPicture) -> Result<(), GpuError> {
        let picture = self.picture.as_ref().expect("room for a picture is made before it is drawn");
        picture.read_rows(device, num_rows, into)
    }
}

/// Cells of a grid: those that begin before its far face.
pub(super) fn cells_of(grid: &UniformGrid, edge: usize) -> [u32; 3] {
    grid.dims.map(|n| (n - 1).div_ceil(edge).max(1) as u32)
}

/// The depth of the plane where rays start.
pub(super) fn start_depth(grid: &UniformGrid, rays: &PictureRays) -> f64 {
    let bounds = grid.bounds();
    let depths = (0..8).map(|corner| {
        let along = |a: usize| (bounds[corner >> a & 1][a] - rays.position[a]) * rays.forward[a];
        (0..3).map(along).sum::<f64>()
    });
    depths.fold(f64::INFINITY, f64::min).max(0.0)
}

/// What a picture's rays have in common.
///
/// They start on the plane before the grid that is nearest to it, so that places are as exact as near the camera.
pub(super) fn view_of(scene: &Scene, [first_row, num_rows]: [usize; 2]) -> ViewData {
    let (grid, layout) = (&scene.grid, &scene.layout);
    let rays = scene.camera.rays(scene.size);
    let depth = start_depth(grid, &rays);
    let is_perspective = matches!(scene.camera.projection(), Projection::Perspective { .. });
    let spread = if is_perspective { depth } else { 1.0 };
    let voxels =
        |v: [f64; 3]| -> [f32; 3] { std::array::from_fn(|a| (spread * v[a] / grid.spacing[a]) as f32) };
    let start = std::array::from_fn(|a| rays.position[a] + depth * rays.forward[a] + spread * rays.corner[a]);
    let direction = |forward: [f64; 3], offset: [f64; 3]| -> [f32; 3] {
        std::array::from_fn(|a| (forward[a] + if is_perspective { offset[a] } else { 0.0 }) as f32)
    };
    ViewData {
        start: grid.voxel_from_world(start).map(|c| c as f32),
        cell_edge: layout.edge as f32,
        start_per_column: voxels(rays.per_column),
        start_per_row: voxels(rays.per_row),
        first_row: first_row as u32,
        direction: direction(rays.forward, rays.corner),
        num_columns: scene.size[0] as u32,
        direction_per_column: direction([0.0; 3], rays.per_column),
        num_rows: num_rows as u32,
        direction_per_row: direction([0.0; 3], rays.per_row),
        step_per_direction: grid.spacing.map(|s| (scene.step_length() / s) as f32),
        most_place: (layout.edge as f32).next_down(),
        last: grid.dims.map(|n| (n - 1) as f32),
        full_edge: layout.full_edge() as u32,
        cells: cells_of(grid, layout.edge).map(|n| n as i32),
        low_apron: layout.low as u32,
        lighting: lighting_of(scene),
        ..Zeroable::zeroed()
    }
}

fn lighting_of(scene: &Scene) -> LightingData {
    let Some(lighting) = scene.lighting else { return Zeroable::zeroed() };
    LightingData {
        world_from_difference: scene.grid.spacing.map(|s| (scene.grid.smallest_spacing() / s) as f32),
        unit_from_step: (1.0 / scene.step_voxels) as f32,
        ambient: lighting.ambient,
        diffuse: lighting.diffuse,
        specular: lighting.specular,
        specular_power: lighting.specular_power,
    }
}
