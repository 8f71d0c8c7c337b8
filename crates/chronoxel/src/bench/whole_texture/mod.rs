//! What Chronoxel's GPU renderer is measured against: a plain ray caster over one 3-D texture of the whole volume, in 8 bits, which is
//! uploaded anew for each step.

use anyhow::{Context, anyhow};
use bytemuck::{Pod, Zeroable, bytes_of, cast_slice};
use chronoxel_core::{ByteImage, Projection, UniformGrid, compositing::correct_opacity};

use crate::session::View;

/// Colours of the table, as many as Chronoxel's renderers have.
const NUM_COLORS: usize = 4096;
/// A ray ends where less than this much would be seen of what lies behind, as in Chronoxel's renderers.
const LEAST_TRANSMITTANCE: f32 = 1.0 / 512.0;
/// Bytes that are handed over at once.
const UPLOAD_BYTES: usize = 32 << 20;

/// `View` of `raycast.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
struct ViewData {
    start: [f32; 3],
    num_columns: u32,
    start_per_column: [f32; 3],
    num_rows: u32,
    start_per_row: [f32; 3],
    is_lit: u32,
    direction: [f32; 3],
    least_transmittance: f32,
    direction_per_column: [f32; 3],
    index_factor: f32,
    direction_per_row: [f32; 3],
    index_offset: f32,
    step_per_direction: [f32; 3],
    ambient: f32,
    last: [f32; 3],
    diffuse: f32,
    world_from_difference: [f32; 3],
    specular: f32,
    unit_from_step: f32,
    specular_power: f32,
    padding: [u32; 2],
}

/// A whole volume on a GPU, and what draws it.
#[derive(Debug)]
pub struct WholeTexture {
    grid: UniformGrid,
    /// What 0 and 255 stand for.
    range: [f64; 2],
    device: wgpu::Device,
    queue: wgpu::Queue,
    volume: wgpu::Texture,
    pipeline: wgpu::ComputePipeline,
    view: wgpu::Buffer,
    colors: wgpu::Buffer,
    /// The size of the picture, its pixels, and what they are read by.
    picture: Option<([usize; 2], [wgpu::Buffer; 2])>,
    sampler: wgpu::Sampler,
}

impl WholeTexture {
    /// Makes room for a volume on an adapter of some name.
    ///
    /// * `range`: the values that 0 and 255 stand for
    ///
    /// # Errors
    /// If there is no such adapter, or the volume is too large for a texture of it.
    pub fn new(adapter: &str, grid: UniformGrid, range: [f64; 2]) -> anyhow::Result<Self> {
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
        let adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::all()));
        let adapter = adapters
            .into_iter()
            .find(|a| a.get_info().name == adapter)
            .with_context(|| format!("the adapter {adapter} is gone"))?;
        let offered = adapter.limits();
        let limits = wgpu::Limits {
            max_texture_dimension_3d: offered.max_texture_dimension_3d,
            max_buffer_size: offered.max_buffer_size,
            ..wgpu::Limits::default()
        };
        let most = limits.max_texture_dimension_3d as usize;
        anyhow::ensure!(
            grid.dims.iter().all(|n| *n <= most),
            "a volume of {:?} samples is too large for one texture of {}: {most} along an edge",
            grid.dims,
            adapter.get_info().name
        );
        let request =
            adapter.request_device(&wgpu::DeviceDescriptor { required_limits: limits, ..Default::default() });
        let (device, queue) = pollster::block_on(request)?;
        let scope = device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let volume = device.create_texture(&wgpu::TextureDescriptor {
            label: Some("the whole volume"),
            size: extent_of(&grid, grid.dims[2]),
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D3,
            format: wgpu::TextureFormat::R8Unorm,
            usage: wgpu::TextureUsages::COPY_DST | wgpu::TextureUsages::TEXTURE_BINDING,
            view_formats: &[],
        });
        if let Some(error) = pollster::block_on(scope.pop()) {
            return Err(anyhow!("the whole volume does not fit the GPU's memory: {error}"));
        }
        let buffer = |size: usize, usage| {
            let usage = usage | wgpu::BufferUsages::COPY_DST;
            let size = size as u64;
            device.create_buffer(&wgpu::BufferDescriptor {
                label: None,
                size,
                usage,
                mapped_at_creation: false,
            })
        };
        Ok(Self {
            pipeline: pipeline_of(&device),
            view: buffer(size_of::<ViewData>(), wgpu::BufferUsages::UNIFORM),
            colors: buffer(16 * NUM_COLORS, wgpu::BufferUsages::STORAGE),
            sampler: device.create_sampler(&wgpu::SamplerDescriptor {
                mag_filter: wgpu::FilterMode::Linear,
                min_filter: wgpu::FilterMode::Linear,
                ..Default::default()
            }),
            grid,
            range,
            volume,
            picture: None,
            device,
            queue,
        })
    }

    /// Uploads a step, `[z, y, x]`; it is there when the next picture is drawn.
    ///
    /// # Panics
    /// If it has not one byte per sample of the grid.
    pub fn upload(&self, step: &[u8]) {
        let slice = self.grid.dims[0] * self.grid.dims[1];
        assert_eq!(step.len(), slice * self.grid.dims[2]);
        let at_once = (UPLOAD_BYTES / slice).max(1);
        for (i, slices) in step.chunks(at_once * slice).enumerate() {
            let mut to = self.volume.as_image_copy();
            to.origin.z = (i * at_once) as u32;
            let layout = wgpu::TexelCopyBufferLayout {
                offset: 0,
                bytes_per_row: Some(self.grid.dims[0] as u32),
                rows_per_image: Some(self.grid.dims[1] as u32),
            };
            self.queue.write_texture(to, slices, layout, extent_of(&self.grid, slices.len() / slice));
        }
    }

    /// Waits until all that was handed over is done.
    ///
    /// # Errors
    /// If the device was lost.
    pub fn settle(&self) -> anyhow::Result<()> {
        self.queue.submit([]);
        self.device.poll(wgpu::PollType::wait_indefinitely())?;
        Ok(())
    }

    /// Uploads the colours of a view.
    pub fn set_colors(&self, view: &View) {
        let dt = view.step_voxels * self.grid.smallest_spacing();
        let [low, high] = self.range;
        let color = |i: usize| {
            let value = low + (high - low) * i as f64 / (NUM_COLORS - 1) as f64;
            let [r, g, b, opacity] = view.transfer.evaluate(value);
            let alpha = correct_opacity(opacity, dt, view.opacity_unit);
            [r * alpha, g * alpha, b * alpha, alpha].map(|c| c as f32)
        };
        let colors: Vec<[f32; 4]> = (0..NUM_COLORS).map(color).collect();
        self.queue.write_buffer(&self.colors, 0, cast_slice(&colors));
    }

    /// Draws the step that was uploaded last, and waits until it is drawn.
    ///
    /// # Errors
    /// If the device was lost.
    pub fn draw(&mut self, view: &View) -> anyhow::Result<()> {
        if self.picture.as_ref().is_none_or(|(size, _)| *size != view.size) {
            use wgpu::BufferUsages as Usage;
            let size = 4 * (view.size[0] * view.size[1]) as u64;
            let buffer = |usage| {
                let mapped_at_creation = false;
                let label = Some("the picture");
                self.device.create_buffer(&wgpu::BufferDescriptor { label, size, usage, mapped_at_creation })
            };
            let buffers = [Usage::STORAGE | Usage::COPY_SRC, Usage::COPY_DST | Usage::MAP_READ].map(buffer);
            self.picture = Some((view.size, buffers));
        }
        let (_, [pixels, _]) = self.picture.as_ref().expect("made above");
        self.queue.write_buffer(&self.view, 0, bytes_of(&view_of(view, &self.grid)));
        let texture = self.volume.create_view(&Default::default());
        let resources = [
            self.view.as_entire_binding(),
            self.colors.as_entire_binding(),
            pixels.as_entire_binding(),
            wgpu::BindingResource::TextureView(&texture),
            wgpu::BindingResource::Sampler(&self.sampler),
        ];
        let entries: Vec<_> = (0..)
            .zip(resources)
            .map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource })
            .collect();
        let layout = &self.pipeline.get_bind_group_layout(0);
        let descriptor = wgpu::BindGroupDescriptor { label: None, layout, entries: &entries };
        let group = self.device.create_bind_group(&descriptor);
        let mut encoder = self.device.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(view.size[0].div_ceil(8) as u32, view.size[1].div_ceil(8) as u32, 1);
        drop(pass);
        self.queue.submit([encoder.finish()]);
        self.settle()
    }

    /// The picture that was drawn last.
    ///
    /// # Errors
    /// If none was, or it cannot be read.
    pub fn picture(&self) -> anyhow::Result<ByteImage> {
        let ([width, height], [pixels, read]) = self.picture.as_ref().context("nothing was drawn")?;
        let mut encoder = self.device.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(pixels, 0, read, 0, read.size());
        self.queue.submit([encoder.finish()]);
        read.slice(..).map_async(wgpu::MapMode::Read, |_| ());
        self.settle()?;
        let mapped = read.slice(..).get_mapped_range()?;
        let pixels = cast_slice(&mapped).to_vec();
        drop(mapped);
        read.unmap();
        Ok(ByteImage { width: *width, height: *height, pixels })
    }
}

/// Slices of a grid.
fn extent_of(grid: &UniformGrid, num_slices: usize) -> wgpu::Extent3d {
    let [width, height, depth_or_array_layers] = [grid.dims[0], grid.dims[1], num_slices].map(|n| n as u32);
    wgpu::Extent3d { width, height, depth_or_array_layers }
}

fn pipeline_of(device: &wgpu::Device) -> wgpu::ComputePipeline {
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some("whole_texture/raycast.wgsl"),
        source: wgpu::ShaderSource::Wgsl(include_str!("raycast.wgsl").into()),
    });
    device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some("the whole volume"),
        layout: None,
        module: &module,
        entry_point: Some("main"),
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    })
}

fn view_of(view: &View, grid: &UniformGrid) -> ViewData {
    let rays = view.camera.rays(view.size);
    let is_perspective = matches!(view.camera.projection(), Projection::Perspective { .. });
    // Rays go out from a point, or from the plane of the picture.
    let [spread, turn] = if is_perspective { [0.0, 1.0] } else { [1.0, 0.0] };
    let voxels = |v: [f64; 3]| std::array::from_fn(|a| (spread * v[a] / grid.spacing[a]) as f32);
    let turned = |v: [f64; 3]| v.map(|c| (turn * c) as f32);
    let start = std::array::from_fn(|a| rays.position[a] + spread * rays.corner[a]);
    let lighting = view.lighting.unwrap_or_default();
    let step = view.step_voxels * grid.smallest_spacing();
    ViewData {
        start: grid.voxel_from_world(start).map(|c| c as f32),
        num_columns: view.size[0] as u32,
        start_per_column: voxels(rays.per_column),
        num_rows: view.size[1] as u32,
        start_per_row: voxels(rays.per_row),
        is_lit: view.lighting.is_some().into(),
        direction: std::array::from_fn(|a| (rays.forward[a] + turn * rays.corner[a]) as f32),
        least_transmittance: LEAST_TRANSMITTANCE,
        direction_per_column: turned(rays.per_column),
        index_factor: (NUM_COLORS - 1) as f32,
        direction_per_row: turned(rays.per_row),
        index_offset: 0.5,
        step_per_direction: grid.spacing.map(|s| (step / s) as f32),
        ambient: lighting.ambient,
        last: grid.dims.map(|n| (n - 1) as f32),
        diffuse: lighting.diffuse,
        world_from_difference: grid.spacing.map(|s| (grid.smallest_spacing() / s) as f32),
        specular: lighting.specular,
        unit_from_step: (1.0 / view.step_voxels) as f32,
        specular_power: lighting.specular_power as f32,
        padding: [0; 2],
    }
}

#[cfg(test)]
mod tests {
    use naga::valid::{Capabilities, ValidationFlags, Validator};

    use super::*;

    #[test]
    fn the_shader_is_valid_and_shares_its_struct() {
        let text = include_str!("raycast.wgsl");
        let module =
            naga::front::wgsl::parse_str(text).unwrap_or_else(|e| panic!("{}", e.emit_to_string(text)));
        let mut validator = Validator::new(ValidationFlags::all(), Capabilities::empty());
        validator.validate(&module).unwrap_or_else(|e| panic!("{}", e.emit_to_string(text)));
        let ty = module.types.iter().find(|(_, ty)| ty.name.as_deref() == Some("View")).unwrap().1;
        let naga::TypeInner::Struct { members, span } = &ty.inner else { panic!("View is a struct") };
        assert_eq!(*span as usize, size_of::<ViewData>());
        let offset = |name: &str| {
            members.iter().find(|member| member.name.as_deref() == Some(name)).unwrap().offset as usize
        };
        assert_eq!(offset("is_lit"), std::mem::offset_of!(ViewData, is_lit));
        assert_eq!(offset("index_offset"), std::mem::offset_of!(ViewData, index_offset));
        assert_eq!(offset("last"), std::mem::offset_of!(ViewData, last));
        assert_eq!(offset("specular_power"), std::mem::offset_of!(ViewData, specular_power));
    }
}
