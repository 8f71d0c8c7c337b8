//! Rows of a picture on the GPU, and how they come back.

use bytemuck::cast_slice;
use rayon::prelude::*;

use super::GpuError;
use super::device::Device;
use super::memory::Buffer;
use super::read_back::{Drawn, GpuPicture, Packer, ReadBack};

/// Rows of the picture, from first to last, of which pixels are held at a time.
#[derive(Debug)]
pub(super) struct Picture {
    width: u32,
    rows: u32,
    /// Premultiplied colours and transmittances, row by row.
    pub gathered: Buffer,
    back: Back,
}

/// What a picture is read back by.
#[derive(Debug)]
enum Back {
    Floats(Buffer),
    Bytes(Packer),
    Nothing,
}

impl Back {
    fn is(&self, read_back: ReadBack) -> bool {
        let own = match self {
            Self::Floats(_) => ReadBack::Floats,
            Self::Bytes(_) => ReadBack::Bytes,
            Self::Nothing => ReadBack::Nothing,
        };
        own == read_back
    }
}

impl Picture {
    /// Makes room for as many rows of a picture as fit some bytes; returns their number.
    ///
    /// * `multiple`: of which the number of rows is one, unless it is that of all
    pub fn hold(
        held: &mut Option<Self>,
        device: &Device,
        [width, height]: [usize; 2],
        multiple: u64,
        most_bytes: u64,
        read_back: ReadBack,
    ) -> Result<usize, GpuError> {
        let row_bytes = 16 * width as u64;
        let limits = &device.limits;
        let of_binding = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size) / row_bytes;
        let mut most_rows = (most_bytes / 2 / row_bytes).min(of_binding);
        most_rows = if most_rows >= height as u64 { height as u64 } else { most_rows / multiple * multiple };
        if most_rows == 0 {
            let (what, needed) = ("a row of the picture", 2 * multiple * row_bytes);
            let given = device.budget.limit();
            let least = given.saturating_mul(needed).div_ceil(most_bytes.max(1));
            return Err(GpuError::MemoryTooSmall { given, what, needed, least });
        }
        let (width, rows) = (width as u32, most_rows as u32);
        let is_held = |p: &Self| [p.width, p.rows] == [width, rows] && p.back.is(read_back);
        if !held.as_ref().is_some_and(is_held) {
            if held.take().is_some() {
                device.settle();
            }
            *held = Some(Self::new(device, width, rows, read_back)?);
        }
        Ok(most_rows as usize)
    }

    fn new(device: &Device, width: u32, rows: u32, read_back: ReadBack) -> Result<Self, GpuError> {
        use wgpu::BufferUsages as Usage;
        let bytes = 16 * u64::from(width) * u64::from(rows);
        let gathered = device.buffer("the picture", bytes, Usage::STORAGE | Usage::COPY_SRC)?;
        let back = match read_back {
            ReadBack::Floats => {
                let usage = Usage::COPY_DST | Usage::MAP_READ;
                Back::Floats(device.buffer("the picture to read", bytes, usage)?)
            }
            ReadBack::Bytes => Back::Bytes(Packer::new(device, Drawn::Rays(&gathered.raw), bytes / 16)?),
            ReadBack::Nothing => Back::Nothing,
        };
        Ok(Self { width, rows, gathered, back })
    }

    /// Appends rows that were drawn to a picture, alpha in place of transmittance.
    pub fn read_rows(&self, device: &Device, num_rows: usize, into: &mut GpuPicture) -> Result<(), GpuError> {
        let num_pixels = u64::from(self.width) * num_rows as u64;
        match (&self.back, into) {
            (Back::Floats(read), GpuPicture::Floats(image)) => {
                let mut encoder = device.raw.create_command_encoder(&Default::default());
                encoder.copy_buffer_to_buffer(&self.gathered.raw, 0, &read.raw, 0, 16 * num_pixels);
                device.queue.submit([encoder.finish()]);
                device.read(&read.raw, 16 * num_pixels, |bytes| {
                    let gathered = cast_slice::<u8, [f32; 4]>(bytes).par_iter();
                    let pixel = |[r, g, b, transmittance]: &[f32; 4]| [*r, *g, *b, 1.0 - transmittance];
                    image.pixels.par_extend(gathered.with_min_len(4096).map(pixel));
                })
            }
            (Back::Bytes(packer), GpuPicture::Bytes(image)) => {
                packer.read(device, Drawn::Rays(&self.gathered.raw), num_pixels, &mut image.pixels)
            }
            _ => Ok(()),
        }
    }
}
