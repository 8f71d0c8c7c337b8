//! How a picture comes back from the GPU.

use chronoxel_core::{ByteImage, Image};

use super::device::{Device, storage};
use super::memory::Buffer;
use super::{GpuError, import};

/// As what a picture is read back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ReadBack {
    /// 32-bit floats: 16 bytes a pixel.
    #[default]
    Floats,
    /// 8 bits, packed on the GPU: 4 bytes a pixel.
    Bytes,
    /// Not at all: it is drawn, and stays where it is.
    Nothing,
}

/// A picture as it was read back.
#[derive(Debug, Clone, PartialEq)]
pub enum GpuPicture {
    /// [`ReadBack::Floats`]
    Floats(Image),
    /// [`ReadBack::Bytes`]
    Bytes(ByteImage),
    /// [`ReadBack::Nothing`]
    Nothing,
}

impl GpuPicture {
    /// A picture without rows.
    pub(super) fn empty(read_back: ReadBack, [width, height]: [usize; 2]) -> Self {
        let num = width * height;
        match read_back {
            ReadBack::Floats => Self::Floats(Image { width, height, pixels: Vec::with_capacity(num) }),
            ReadBack::Bytes => Self::Bytes(ByteImage { width, height, pixels: Vec::with_capacity(num) }),
            ReadBack::Nothing => Self::Nothing,
        }
    }
}

/// What is drawn, and packed from there.
#[derive(Debug, Clone, Copy)]
pub(super) enum Drawn<'a> {
    Rays(&'a wgpu::Buffer),
    Slices(&'a wgpu::TextureView),
}

/// Packs pictures into 8 bits.
#[derive(Debug)]
pub(super) struct Packer {
    layout: wgpu::BindGroupLayout,
    pipeline: wgpu::ComputePipeline,
    packed: Buffer,
    read: Buffer,
    num_pixels: u64,
}

/// Workgroups of a dispatch along its first axis.
const GROUPS_ALONG: u64 = 1 << 15;

impl Packer {
    /// * `num_pixels`: those that are held at a time
    pub fn new(device: &Device, drawn: Drawn, num_pixels: u64) -> Result<Self, GpuError> {
        use wgpu::BufferUsages as Usage;
        let (binding, ty, entry) = match drawn {
            Drawn::Rays(_) => (0, storage(true), "pack_rays"),
            Drawn::Slices(_) => {
                let sample_type = wgpu::TextureSampleType::Float { filterable: false };
                let view_dimension = wgpu::TextureViewDimension::D2;
                (
                    2,
                    wgpu::BindingType::Texture { sample_type, view_dimension, multisampled: false },
                    "pack_slices",
                )
            }
        };
        let visibility = wgpu::ShaderStages::COMPUTE;
        let entries = [(binding, ty), (1, storage(false))].map(|(binding, ty)| wgpu::BindGroupLayoutEntry {
            binding,
            visibility,
            ty,
            count: None,
        });
        let descriptor = wgpu::BindGroupLayoutDescriptor { label: Some("bytes"), entries: &entries };
        let layout = device.raw.create_bind_group_layout(&descriptor);
        let pipeline = device.pipeline_of("bytes.wgsl", entry, import::BYTES, &layout, &[])?;
        let bytes = 4 * num_pixels;
        Ok(Self {
            layout,
            pipeline,
            packed: device.buffer("the picture in bytes", bytes, Usage::STORAGE | Usage::COPY_SRC)?,
            read: device.buffer("the bytes to read", bytes, Usage::COPY_DST | Usage::MAP_READ)?,
            num_pixels,
        })
    }

    /// Appends the first pixels of what was drawn.
    pub fn read(
        &self,
        device: &Device,
        drawn: Drawn,
        num_pixels: u64,
        pixels: &mut Vec<[u8; 4]>,
    ) -> Result<(), GpuError> {
        let (binding, resource) = match drawn {
            Drawn::Rays(gathered) => (0, gathered.as_entire_binding()),
            Drawn::Slices(view) => (2, wgpu::BindingResource::TextureView(view)),
        };
        let entries = [(binding, resource), (1, self.packed.raw.as_entire_binding())]
            .map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource });
        let descriptor =
            wgpu::BindGroupDescriptor { label: Some("bytes"), layout: &self.layout, entries: &entries };
        let group = device.raw.create_bind_group(&descriptor);
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &group, &[]);
        let groups = self.num_pixels.div_ceil(64);
        let along = groups.min(GROUPS_ALONG);
        pass.dispatch_workgroups(along as u32, groups.div_ceil(along) as u32, 1);
        drop(pass);
        let bytes = 4 * num_pixels;
        encoder.copy_buffer_to_buffer(&self.packed.raw, 0, &self.read.raw, 0, bytes);
        device.queue.submit([encoder.finish()]);
        device.read(&self.read.raw, bytes, |bytes| pixels.extend_from_slice(bytemuck::cast_slice(bytes)))
    }
}
