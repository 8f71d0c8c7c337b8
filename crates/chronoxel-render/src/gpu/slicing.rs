//! Slices on the GPU: polygons of the bricks, back to front, blended into the picture.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, HashMap};

use bytemuck::{bytes_of, cast_slice};
use chronoxel_core::Projection;

use super::device::{Device, storage, uniform};
use super::host::{BoxData, CONSTANT, PlanesData, VertexData, ViewData};
use super::memory::{Buffer, Mirror};
use super::page_table::CellBox;
use super::raycast::{Content, Key, Portion, Shot, Sources, key_of, start_depth, view_of};
use super::read_back::{GpuPicture, ReadBack};
use super::target::{Target, format_of};
use super::timing::{Span, Timer};
use super::{GpuError, Scene, import};
use crate::cpu::table::NUM_ENTRIES;
use crate::{SliceList, SliceOrder, Slicer};

/// What draws slices.
#[derive(Debug)]
pub(super) struct Slicing {
    layout: wgpu::BindGroupLayout,
    pipelines: HashMap<Key, wgpu::RenderPipeline>,
    sampler: wgpu::Sampler,
    view: Buffer,
    planes: Buffer,
    bricks: Mirror,
    constants: Mirror,
    boxes: Mirror,
    colors: Mirror,
    nothing: Buffer,
    polygons: Polygons,
    target: Option<Target>,
}

/// Polygons that are drawn at once.
#[derive(Debug)]
struct Polygons {
    vertices: Vec<VertexData>,
    /// Three for each triangle.
    indices: Vec<u32>,
    most_vertices: usize,
    vertex_buffer: Buffer,
    index_buffer: Buffer,
}

/// Most bytes of polygons: beyond it, drawing at once gains nothing.
const MOST_POLYGON_BYTES: u64 = 8 << 20;
/// Indices for each vertex, at most: a polygon of six vertices has four triangles.
const INDICES_PER_VERTEX: usize = 2;

impl Polygons {
    fn new(device: &Device, most_bytes: u64) -> Result<Self, GpuError> {
        use wgpu::BufferUsages as Usage;
        let vertex_bytes = size_of::<VertexData>() + INDICES_PER_VERTEX * size_of::<u32>();
        let most_vertices = (most_bytes.min(MOST_POLYGON_BYTES) as usize / vertex_bytes).max(6);
        let bytes = |each: usize| (each * most_vertices) as u64;
        Ok(Self {
            vertices: Vec::new(),
            indices: Vec::new(),
            most_vertices,
            vertex_buffer: device.buffer(
                "the vertices of slices",
                bytes(size_of::<VertexData>()),
                Usage::VERTEX | Usage::COPY_DST,
            )?,
            index_buffer: device.buffer(
                "the triangles of slices",
                bytes(INDICES_PER_VERTEX * size_of::<u32>()),
                Usage::INDEX | Usage::COPY_DST,
            )?,
        })
    }

    fn has_room_for(&self, polygon: &[[f32; 3]]) -> bool {
        self.vertices.len() + polygon.len() <= self.most_vertices
    }

    fn push(&mut self, polygon: &[[f32; 3]], depth: f32, number: u32) {
        let first = self.vertices.len() as u32;
        self.vertices.extend(polygon.iter().map(|&position| VertexData { position, depth, number }));
        self.indices.extend((first + 1..self.vertices.len() as u32 - 1).flat_map(|v| [first, v, v + 1]));
    }
}

/// With what polygons are drawn.
struct Pass {
    key: Key,
    group: wgpu::BindGroup,
    /// Whether the picture holds what was drawn before, or nothing, rather than another picture.
    is_clear: bool,
}

/// A brick to cut.
struct Cut {
    region: [[f64; 3]; 2],
    level: u8,
}

impl Slicing {
    /// * `lists_bytes`: what the lists of a portion, and polygons, may take together
    pub fn new(device: &Device, lists_bytes: u64, colors_bytes: u64) -> Result<Self, GpuError> {
        use wgpu::BufferUsages as Usage;
        let sampler = wgpu::SamplerDescriptor {
            mag_filter: wgpu::FilterMode::Linear,
            min_filter: wgpu::FilterMode::Linear,
            ..Default::default()
        };
        let uniform =
            |what, bytes: usize| device.buffer(what, bytes as u64, Usage::UNIFORM | Usage::COPY_DST);
        Ok(Self {
            layout: layout_of(device),
            pipelines: HashMap::new(),
            sampler: device.raw.create_sampler(&sampler),
            view: uniform("the view", size_of::<ViewData>())?,
            planes: uniform("the planes of slices", size_of::<PlanesData>())?,
            bricks: Mirror::new(device, "the list of bricks", lists_bytes / 6)?,
            constants: Mirror::new(device, "the list of constants", lists_bytes / 6)?,
            boxes: Mirror::new(device, "the list of boxes", lists_bytes / 6)?,
            colors: Mirror::new(device, "the colours of the transfer function", colors_bytes)?,
            nothing: device.buffer("nothing", 16, Usage::STORAGE)?,
            polygons: Polygons::new(device, lists_bytes / 2)?,
            target: None,
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
        let (width, rows) = (size[0] as u32, Target::rows_within(device, size, most_bytes)?);
        if !self.target.as_ref().is_some_and(|t| t.is([width, rows], read_back)) {
            if self.target.take().is_some() {
                device.settle();
            }
            self.target = Some(Target::new(device, [width, rows], read_back)?);
        }
        Ok(rows as usize)
    }

    /// Uploads the colours of the levels drawn, one table after another.
    pub fn set_colors(&mut self, device: &Device, colors: &[u32]) -> Result<(), GpuError> {
        self.colors.set(device, colors)
    }

    /// Draws a portion, whose bricks are in order from back to front, in front of what was drawn before.
    pub fn draw(
        &mut self,
        device: &Device,
        shot: Shot,
        portion: &Portion,
        sources: Sources,
        timer: &mut Timer,
    ) -> Result<(), GpuError> {
        let Shot { scene, rows, is_first, .. } = shot;
        let mut view = view_of(scene, rows);
        view.per_texel = sources.pool.shape.texels().map(|n| 1.0 / n as f32);
        device.upload(&self.view.raw, 0, bytes_of(&view));
        device.upload(&self.planes.raw, 0, bytes_of(&planes_of(scene, rows)));
        let cuts = self.set_lists(device, scene, portion)?;
        let key = key_of(&shot, portion);
        self.hold_pipeline(device, key)?;
        let mut pass = Pass { key, group: self.bind(device, sources), is_clear: !is_first };
        self.cut(device, scene, &cuts, &mut pass, timer)?;
        if !pass.is_clear || !self.polygons.indices.is_empty() {
            self.flush(device, &mut pass, timer);
        }
        Ok(())
    }

    /// Cuts bricks into polygons, and draws these whenever there is no room for more.
    fn cut(
        &mut self,
        device: &Device,
        scene: &Scene,
        cuts: &[Cut],
        pass: &mut Pass,
        timer: &mut Timer,
    ) -> Result<(), GpuError> {
        let (start, mut slicers, mut list) = (start_of(scene), BTreeMap::new(), SliceList::default());
        let margin = margin_of(scene);
        for (number, cut) in (0..).zip(cuts) {
            if let Entry::Vacant(place) = slicers.entry(cut.level) {
                let (distance, order) = (scene.step_length_at(cut.level), SliceOrder::BackToFront);
                place.insert(Slicer::of_camera_in_voxels(&scene.camera, &scene.grid, distance, order)?);
            }
            list.clear();
            // The planes are those of the box, the polygons reach beyond it.
            let owned = slicers[&cut.level].numbers(cut.region)?;
            let [low, high] = cut.region;
            let larger = std::array::from_fn(|a| low[a] - margin[a]);
            slicers[&cut.level].slice([larger, std::array::from_fn(|a| high[a] + margin[a])], &mut list)?;
            for (i, slice) in list.slices().iter().enumerate().filter(|(_, slice)| owned.contains(slice)) {
                let polygon = list.polygon(i);
                if !self.polygons.has_room_for(polygon) {
                    self.flush(device, pass, timer);
                }
                let depth = f64::from(*slice) * (1u64 << cut.level) as f64 - start;
                self.polygons.push(polygon, depth as f32, number);
            }
        }
        Ok(())
    }

    /// Uploads what is in the boxes of a portion; returns what is to be cut, in order.
    fn set_lists(&mut self, device: &Device, scene: &Scene, portion: &Portion) -> Result<Vec<Cut>, GpuError> {
        let (mut bricks, mut constants, mut boxes) = (Vec::new(), Vec::new(), Vec::new());
        let is_across = axes_across(scene);
        let cuts = portion.iter().map(|(place, content)| {
            let (scale, content) = match content {
                Content::Brick(brick) => {
                    bricks.push(*brick);
                    (brick.scale, bricks.len() as u32 - 1)
                }
                Content::Constant(constant) => {
                    constants.push(*constant);
                    (constant.scale, CONSTANT | (constants.len() as u32 - 1))
                }
            };
            let region = region_of(scene, place);
            let plane =
                |side: usize, a: usize| if is_across[a] { BEYOND[side] } else { region[side][a] as f32 };
            boxes.push(BoxData {
                low: std::array::from_fn(|a| plane(0, a)),
                content,
                high: std::array::from_fn(|a| plane(1, a)),
                padding: 0,
            });
            Cut { region, level: (1.0 / scale).log2().round() as u8 }
        });
        let cuts: Vec<Cut> = cuts.collect();
        self.bricks.set(device, cast_slice(&bricks))?;
        self.constants.set(device, cast_slice(&constants))?;
        self.boxes.set(device, cast_slice(&boxes))?;
        Ok(cuts)
    }

    /// Draws the polygons that were gathered.
    fn flush(&mut self, device: &Device, of: &mut Pass, timer: &mut Timer) {
        let polygons = &mut self.polygons;
        device.upload(&polygons.vertex_buffer.raw, 0, cast_slice(&polygons.vertices));
        device.upload(&polygons.index_buffer.raw, 0, cast_slice(&polygons.indices));
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let span = timer.begin(&mut encoder, Span::Render);
        let target = self.target.as_ref().expect("room for a picture is made before it is drawn");
        let load = match of.is_clear {
            true => wgpu::LoadOp::Load,
            false => wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT),
        };
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some("slices"),
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &target.view,
                depth_slice: None,
                resolve_target: None,
                ops: wgpu::Operations { load, store: wgpu::StoreOp::Store },
            })],
            ..Default::default()
        });
        pass.set_pipeline(&self.pipelines[&of.key]);
        pass.set_bind_group(0, &of.group, &[]);
        pass.set_vertex_buffer(0, polygons.vertex_buffer.raw.slice(..));
        pass.set_index_buffer(polygons.index_buffer.raw.slice(..), wgpu::IndexFormat::Uint32);
        pass.draw_indexed(0..polygons.indices.len() as u32, 0, 0..1);
        drop(pass);
        timer.end(&mut encoder, span);
        device.queue.submit([encoder.finish()]);
        polygons.vertices.clear();
        polygons.indices.clear();
        of.is_clear = true;
    }

    fn hold_pipeline(&mut self, device: &Device, key: Key) -> Result<(), GpuError> {
        if !self.pipelines.contains_key(&key) {
            let pipeline = pipeline_of(device, &self.layout, key)?;
            self.pipelines.insert(key, pipeline);
        }
        Ok(())
    }

    fn bind(&self, device: &Device, Sources { pool, bank }: Sources) -> wgpu::BindGroup {
        let masks = pool.masks.as_ref().unwrap_or(&self.nothing);
        let resources = [
            (0, self.view.raw.as_entire_binding()),
            (1, self.planes.raw.as_entire_binding()),
            (2, self.bricks.raw().as_entire_binding()),
            (3, self.constants.raw().as_entire_binding()),
            (4, self.colors.raw().as_entire_binding()),
            (5, masks.raw.as_entire_binding()),
            (6, bank.unwrap_or(&self.nothing.raw).as_entire_binding()),
            (7, self.boxes.raw().as_entire_binding()),
            (8, wgpu::BindingResource::TextureView(&pool.texture.view)),
            (9, wgpu::BindingResource::Sampler(&self.sampler)),
        ];
        let entries = resources.map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource });
        let descriptor =
            wgpu::BindGroupDescriptor { label: Some("slices"), layout: &self.layout, entries: &entries };
        device.raw.create_bind_group(&descriptor)
    }

    /// Appends rows that were drawn to a picture.
    pub fn read_rows(&self, device: &Device, num_rows: usize, into: &mut GpuPicture) -> Result<(), GpuError> {
        let target = self.target.as_ref().expect("room for a picture is made before it is drawn");
        target.read_rows(device, num_rows as u32, into)
    }
}

fn layout_of(device: &Device) -> wgpu::BindGroupLayout {
    let texture = wgpu::BindingType::Texture {
        sample_type: wgpu::TextureSampleType::Float { filterable: true },
        view_dimension: wgpu::TextureViewDimension::D3,
        multisampled: false,
    };
    let sampler = wgpu::BindingType::Sampler(wgpu::SamplerBindingType::Filtering);
    let mut bindings = vec![(0, uniform(false)), (1, uniform(false))];
    bindings.extend((2..8).map(|binding| (binding, storage(true))));
    bindings.extend([(8, texture), (9, sampler)]);
    let entries = bindings.into_iter().map(|(binding, ty)| {
        let visibility = match binding {
            1 => wgpu::ShaderStages::VERTEX,
            _ => wgpu::ShaderStages::FRAGMENT,
        };
        wgpu::BindGroupLayoutEntry { binding, visibility, ty, count: None }
    });
    let entries: Vec<_> = entries.collect();
    let descriptor = wgpu::BindGroupLayoutDescriptor { label: Some("slices"), entries: &entries };
    device.raw.create_bind_group_layout(&descriptor)
}

fn pipeline_of(
    device: &Device,
    layout: &wgpu::BindGroupLayout,
    key: Key,
) -> Result<wgpu::RenderPipeline, GpuError> {
    let [lit, fetch, blend, color] = key.map(|flag| f64::from(u8::from(flag)));
    let constants = [
        ("LIT", lit),
        ("FETCH", fetch),
        ("BLEND", blend),
        ("INTERPOLATE_COLOR", color),
        ("NUM_COLORS", NUM_ENTRIES as f64),
    ];
    let options = wgpu::PipelineCompilationOptions { constants: &constants, ..Default::default() };
    let over = wgpu::BlendState::PREMULTIPLIED_ALPHA_BLENDING;
    let target = wgpu::ColorTargetState {
        format: format_of(device),
        blend: Some(over),
        write_mask: wgpu::ColorWrites::ALL,
    };
    let vertices = wgpu::VertexBufferLayout {
        array_stride: size_of::<VertexData>() as u64,
        step_mode: wgpu::VertexStepMode::Vertex,
        attributes: &wgpu::vertex_attr_array![0 => Float32x4, 1 => Uint32],
    };
    let text = import::with_imports(import::SLICES);
    device.attempt("the shader slices.wgsl", || {
        let module = device.raw.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some("slices.wgsl"),
            source: wgpu::ShaderSource::Wgsl(text.into()),
        });
        let layout = device.raw.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some("slices"),
            bind_group_layouts: &[Some(layout)],
            immediate_size: 0,
        });
        device.raw.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some("slices"),
            layout: Some(&layout),
            vertex: wgpu::VertexState {
                module: &module,
                entry_point: Some("place_vertex"),
                compilation_options: options.clone(),
                buffers: &[Some(vertices)],
            },
            primitive: wgpu::PrimitiveState::default(),
            depth_stencil: None,
            multisample: wgpu::MultisampleState::default(),
            fragment: Some(wgpu::FragmentState {
                module: &module,
                entry_point: Some("shade"),
                compilation_options: options,
                targets: &[Some(target)],
            }),
            multiview_mask: None,
            cache: None,
        })
    })
}

/// What of a box lies in the grid, level-0 voxels.
fn region_of(scene: &Scene, place: &CellBox) -> [[f64; 3]; 2] {
    let edge = scene.layout.edge as f64;
    let low = place.low.map(|c| f64::from(c) * edge);
    let size = edge * (1u64 << place.level) as f64;
    let high = std::array::from_fn(|a| (low[a] + size).min((scene.grid.dims[a] - 1) as f64));
    [low, high]
}

/// Below and above every plane.
const BEYOND: [f32; 2] = [-1e15, 1e15];
/// How much of a pixel polygons reach beyond their boxes: WebGPU rounds vertices to no less than a 256th of one.
const MARGIN_PIXELS: f64 = 1.0 / 32.0;
/// And how much of the grid, for the sake of rounding in 32 bits.
const MARGIN_OF_GRID: f64 = 1e-5;

/// By how much boxes are larger than they are when they are cut, along each axis, voxels.
fn margin_of(scene: &Scene) -> [f64; 3] {
    let (grid, rays) = (&scene.grid, scene.camera.rays(scene.size));
    let length = |v: [f64; 3]| v.iter().map(|c| c * c).sum::<f64>().sqrt();
    let pixel = length(rays.per_column).max(length(rays.per_row));
    let is_perspective = matches!(scene.camera.projection(), Projection::Perspective { .. });
    let bounds = grid.bounds();
    let depth_of = |corner: usize| -> f64 {
        (0..3).map(|a| (bounds[corner >> a & 1][a] - rays.position[a]) * rays.forward[a]).sum()
    };
    // Pixels are largest at the far end of the grid.
    let farthest = (0..8).map(depth_of).fold(0.0, f64::max);
    let world = MARGIN_PIXELS * pixel * if is_perspective { farthest } else { 1.0 };
    std::array::from_fn(|a| world / grid.spacing[a] + MARGIN_OF_GRID * grid.dims[a] as f64)
}

/// Along which axis slices lie in the faces of boxes, so that numbers decide whose a whole plane is, and not where its
/// points are, which is rounded.
fn axes_across(scene: &Scene) -> [bool; 3] {
    let normal: [f64; 3] = std::array::from_fn(|a| {
        scene.camera.axes()[2][a] * scene.grid.spacing[a] * scene.grid.dims[a] as f64
    });
    // What a plane that is across here moves by along the axis, over the grid, in voxels.
    std::array::from_fn(|a| {
        let others: f64 = (0..3).filter(|b| *b != a).map(|b| normal[b].abs()).sum();
        others * (scene.grid.dims[a] as f64) < 1e-3 * normal[a].abs()
    })
}

/// The depth where rays start, in step lengths.
fn start_of(scene: &Scene) -> f64 {
    start_depth(&scene.grid, &scene.camera.rays(scene.size)) / scene.step_length()
}

/// How vertices come to the rows of the picture that are drawn.
fn planes_of(scene: &Scene, [first_row, num_rows]: [usize; 2]) -> PlanesData {
    let (grid, rays) = (&scene.grid, scene.camera.rays(scene.size));
    let dot = |a: [f64; 3], b: [f64; 3]| (0..3).map(|i| a[i] * b[i]).sum::<f64>();
    let is_perspective = matches!(scene.camera.projection(), Projection::Perspective { .. });
    // In perspective, depth is counted in step lengths, so that a plane's is exact.
    let unit = if is_perspective { scene.step_length() } else { 1.0 };
    let per_pixel = |per: [f64; 3]| per.map(|c| c / (dot(per, per) * unit));
    let from_eye: [f64; 3] = std::array::from_fn(|a| grid.origin[a] - rays.position[a]);
    // Rows and columns, multiplied by depth: `along · (p − position) − depth · (corner · along)`.
    let to_clip = |along: [f64; 3], factor: f64, offset: f64| {
        let corner = unit * dot(rays.corner, along);
        (
            std::array::from_fn(|a| (factor * along[a] * grid.spacing[a]) as f32),
            (factor * dot(from_eye, along)) as f32,
            (offset - factor * corner) as f32,
        )
    };
    let (width, height) = (scene.size[0] as f64, num_rows as f64);
    let (column, column_offset, column_per_depth) = to_clip(per_pixel(rays.per_column), 2.0 / width, -1.0);
    let (row, row_offset, row_per_depth) =
        to_clip(per_pixel(rays.per_row), -2.0 / height, 1.0 + 2.0 * first_row as f64 / height);
    PlanesData {
        column,
        column_offset,
        row,
        row_offset,
        column_per_depth,
        row_per_depth,
        start: start_of(scene) as f32,
        is_perspective: u32::from(is_perspective),
    }
}
