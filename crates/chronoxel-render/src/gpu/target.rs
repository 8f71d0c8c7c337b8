//! The picture into which slices are blended.

use super::GpuError;
use super::device::Device;
use super::memory::{Buffer, Share};
use super::read_back::{Drawn, GpuPicture, Packer, ReadBack};

/// Rows of the picture that are drawn at a time, and a buffer to read them from.
#[derive(Debug)]
pub(super) struct Target {
    pub width: u32,
    pub rows: u32,
    raw: wgpu::Texture,
    pub view: wgpu::TextureView,
    back: Back,
    _share: Share,
}

/// What it is read back by.
#[derive(Debug)]
enum Back {
    Floats(Buffer),
    Bytes(Packer),
    Nothing,
}

impl Drop for Target {
    fn drop(&mut self) {
        self.raw.destroy();
    }
}

/// 32-bit floats where they can be blended, else 16-bit ones: every layer is rounded to the format.
pub(super) fn format_of(device: &Device) -> wgpu::TextureFormat {
    match device.info.has_blendable_floats {
        true => wgpu::TextureFormat::Rgba32Float,
        false => wgpu::TextureFormat::Rgba16Float,
    }
}

/// Bytes of a row of pixels, and of a row in a buffer to which it is copied.
fn row_bytes(device: &Device, width: u64) -> [u64; 2] {
    let texel = if device.info.has_blendable_floats { 16 } else { 8 };
    [texel * width, (texel * width).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT.into())]
}

impl Target {
    /// How many rows of a picture fit some bytes.
    ///
    /// # Errors
    /// [`GpuError`] if there is not a row that does, or it is too long for a texture.
    pub fn rows_within(
        device: &Device,
        [width, height]: [usize; 2],
        most_bytes: u64,
    ) -> Result<u32, GpuError> {
        let most_edge = u64::from(device.limits.max_texture_dimension_2d);
        if width as u64 > most_edge {
            return Err(GpuError::LimitTooSmall {
                adapter: device.info.name.clone(),
                limit: "max_texture_dimension_2d",
                found: most_edge,
                needed: width as u64,
            });
        }
        let [drawn, read] = row_bytes(device, width as u64);
        let rows = (most_bytes / (drawn + read)).min(device.limits.max_buffer_size / read);
        if rows == 0 {
            let (what, needed) = ("a row of the picture", drawn + read);
            let given = device.budget.limit();
            let least = given.saturating_mul(needed).div_ceil(most_bytes.max(1));
            return Err(GpuError::MemoryTooSmall { given, what, needed, least });
        }
        Ok(rows.min(most_edge).min(height as u64) as u32)
    }

    /// Whether it is one of a size that is read back so.
    pub fn is(&self, size: [u32; 2], read_back: ReadBack) -> bool {
        let own = match self.back {
            Back::Floats(_) => ReadBack::Floats,
            Back::Bytes(_) => ReadBack::Bytes,
            Back::Nothing => ReadBack::Nothing,
        };
        own == read_back && [self.width, self.rows] == size
    }

    pub fn new(device: &Device, [width, rows]: [u32; 2], read_back: ReadBack) -> Result<Self, GpuError> {
        use wgpu::TextureUsages as Usage;
        let [drawn, read] = row_bytes(device, width.into()).map(|bytes| bytes * u64::from(rows));
        let share = device.budget.take(drawn, "the picture")?;
        let raw = device.raw.create_texture(&wgpu::TextureDescriptor {
            label: Some("the picture"),
            size: wgpu::Extent3d { width, height: rows, depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: format_of(device),
            usage: Usage::RENDER_ATTACHMENT | Usage::COPY_SRC | Usage::TEXTURE_BINDING,
            view_formats: &[],
        });
        let view = raw.create_view(&Default::default());
        let back = match read_back {
            ReadBack::Floats => {
                let usage = wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::MAP_READ;
                Back::Floats(device.buffer("the picture to read", read, usage)?)
            }
            ReadBack::Bytes => {
                let num_pixels = u64::from(width) * u64::from(rows);
                Back::Bytes(Packer::new(device, Drawn::Slices(&view), num_pixels)?)
            }
            ReadBack::Nothing => Back::Nothing,
        };
        Ok(Self { width, rows, raw, view, back, _share: share })
    }

    /// Appends rows that were drawn to a picture.
    pub fn read_rows(&self, device: &Device, num_rows: u32, into: &mut GpuPicture) -> Result<(), GpuError> {
        match (&self.back, into) {
            (Back::Floats(read), GpuPicture::Floats(image)) => {
                self.read_floats(device, read, num_rows, &mut image.pixels)
            }
            (Back::Bytes(packer), GpuPicture::Bytes(image)) => {
                let num_pixels = u64::from(self.width) * u64::from(num_rows);
                packer.read(device, Drawn::Slices(&self.view), num_pixels, &mut image.pixels)
            }
            _ => Ok(()),
        }
    }

    fn read_floats(
        &self,
        device: &Device,
        read: &Buffer,
        num_rows: u32,
        pixels: &mut Vec<[f32; 4]>,
    ) -> Result<(), GpuError> {
        let [drawn, stride] = row_bytes(device, self.width.into());
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let layout = wgpu::TexelCopyBufferLayout {
            offset: 0,
            bytes_per_row: Some(stride as u32),
            rows_per_image: None,
        };
        encoder.copy_texture_to_buffer(
            self.raw.as_image_copy(),
            wgpu::TexelCopyBufferInfo { buffer: &read.raw, layout },
            wgpu::Extent3d { width: self.width, height: num_rows, depth_or_array_layers: 1 },
        );
        device.queue.submit([encoder.finish()]);
        let is_wide = device.info.has_blendable_floats;
        device.read(&read.raw, stride * u64::from(num_rows), |bytes| {
            for row in bytes.chunks_exact(stride as usize).map(|row| &row[..drawn as usize]) {
                if is_wide {
                    pixels.extend_from_slice(bytemuck::cast_slice(row));
                } else {
                    let halves: &[[u16; 4]] = bytemuck::cast_slice(row);
                    pixels.extend(halves.iter().map(|pixel| pixel.map(f32_from_half)));
                }
            }
        })
    }
}

/// A finite 16-bit float.
fn f32_from_half(bits: u16) -> f32 {
    let magnitude = f32::from_bits(u32::from(bits & 0x7fff) << 13) * 2f32.powi(112);
    if bits >> 15 == 1 { -magnitude } else { magnitude }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn halves_are_read() {
        let pairs = [(0x0000, 0.0), (0x3c00, 1.0), (0x3555, 0.333_251_95), (0x0001, 5.960_464_5e-8)];
        for (bits, value) in pairs {
            assert_eq!(f32_from_half(bits), value);
            assert_eq!(f32_from_half(bits | 0x8000), -value);
        }
        assert_eq!(f32_from_half(0x7bff), 65504.0);
    }
}
