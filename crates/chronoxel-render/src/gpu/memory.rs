//! The budget of GPU memory: every buffer and texture is counted before it is made.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use super::GpuError;
use super::device::Device;

/// Bytes in use, never more than the budget.
#[derive(Debug)]
pub(super) struct Budget {
    limit: u64,
    used: AtomicU64,
    peak: AtomicU64,
}

impl Budget {
    pub fn new(limit: u64) -> Arc<Self> {
        Arc::new(Self { limit, used: AtomicU64::new(0), peak: AtomicU64::new(0) })
    }

    pub fn limit(&self) -> u64 {
        self.limit
    }

    pub fn used(&self) -> u64 {
        self.used.load(Relaxed)
    }

    /// The most bytes that were ever in use.
    pub fn peak(&self) -> u64 {
        self.peak.load(Relaxed)
    }

    /// Bytes that may still be taken.
    pub fn left(&self) -> u64 {
        self.limit - self.used()
    }

    /// Takes bytes out of the budget until the share is dropped.
    pub fn take(self: &Arc<Self>, bytes: u64, what: &'static str) -> Result<Share, GpuError> {
        let take = |used: u64| used.checked_add(bytes).filter(|sum| *sum <= self.limit);
        match self.used.fetch_update(Relaxed, Relaxed, take) {
            Ok(before) => {
                self.peak.fetch_max(before + bytes, Relaxed);
                Ok(Share { budget: self.clone(), bytes })
            }
            Err(used) => {
                let least = used.saturating_add(bytes);
                Err(GpuError::MemoryTooSmall { given: self.limit, what, needed: bytes, least })
            }
        }
    }
}

/// Bytes of the budget that something holds.
#[derive(Debug)]
pub(super) struct Share {
    budget: Arc<Budget>,
    pub bytes: u64,
}

impl Drop for Share {
    fn drop(&mut self) {
        self.budget.used.fetch_sub(self.bytes, Relaxed);
    }
}

/// A buffer within the budget.
#[derive(Debug)]
pub(super) struct Buffer {
    pub raw: wgpu::Buffer,
    share: Share,
}

impl Buffer {
    pub fn bytes(&self) -> u64 {
        self.share.bytes
    }
}

impl Drop for Buffer {
    fn drop(&mut self) {
        self.raw.destroy();
    }
}

/// A 3-D texture within the budget.
#[derive(Debug)]
pub(super) struct Texture {
    pub raw: wgpu::Texture,
    pub view: wgpu::TextureView,
    _share: Share,
}

impl Drop for Texture {
    fn drop(&mut self) {
        self.raw.destroy();
    }
}

impl Device {
    /// A buffer of at least a multiple of 16 bytes.
    pub fn buffer(
        &self,
        what: &'static str,
        bytes: u64,
        usage: wgpu::BufferUsages,
    ) -> Result<Buffer, GpuError> {
        let size = bytes.max(16).next_multiple_of(16);
        let share = self.budget.take(size, what)?;
        let descriptor = wgpu::BufferDescriptor { label: Some(what), size, usage, mapped_at_creation: false };
        Ok(Buffer { raw: self.raw.create_buffer(&descriptor), share })
    }

    /// A 3-D texture of two bytes a texel that is copied to and sampled.
    pub fn texture(
        &self,
        what: &'static str,
        size: [u32; 3],
        format: wgpu::TextureFormat,
    ) -> Result<Texture, GpuError> {
        let share = self.budget.take(2 * size.iter().map(|n| u64::from(*n)).product::<u64>(), what)?;
        let raw = self.raw.create_texture(&wgpu::TextureDescriptor {
            label: Some(what),
            size: wgpu::Extent3d { width: size[0], height: size[1], depth_or_array_layers: size[2] },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D3,
            format,
            usage: wgpu::TextureUsages::COPY_DST | wgpu::TextureUsages::TEXTURE_BINDING,
            view_formats: &[],
        });
        let view = raw.create_view(&Default::default());
        Ok(Texture { raw, view, _share: share })
    }
}

/// A storage buffer and what it holds: only what changes is uploaded.
#[derive(Debug)]
pub(super) struct Mirror {
    what: &'static str,
    buffer: Buffer,
    held: Vec<u32>,
    /// The most bytes that it may grow to.
    most_bytes: u64,
}

/// Words that are compared and uploaded together.
const CHUNK: usize = 64;

impl Mirror {
    /// A buffer of a few words.
    pub fn new(device: &Device, what: &'static str, most_bytes: u64) -> Result<Self, GpuError> {
        let bytes = 1024.min(most_bytes);
        let buffer = device.buffer(what, bytes, Self::USAGE)?;
        Ok(Self { what, buffer, held: Vec::new(), most_bytes })
    }

    const USAGE: wgpu::BufferUsages = wgpu::BufferUsages::STORAGE.union(wgpu::BufferUsages::COPY_DST);

    pub fn raw(&self) -> &wgpu::Buffer {
        &self.buffer.raw
    }

    /// Makes the buffer begin with some words; it may be another buffer then.
    pub fn set(&mut self, device: &Device, words: &[u32]) -> Result<(), GpuError> {
        let bytes = 4 * words.len() as u64;
        if bytes > self.buffer.bytes() {
            let wanted = bytes.next_power_of_two().min(self.most_bytes.max(bytes));
            // The old one goes first, so that never both are held.
            let smallest = device.buffer(self.what, 16, Self::USAGE)?;
            self.buffer = smallest;
            device.settle();
            self.buffer = device.buffer(self.what, wanted, Self::USAGE)?;
            self.held.clear();
        }
        let num_held = self.held.len();
        let mut from = None;
        for (at, chunk) in words.chunks(CHUNK).enumerate() {
            let start = at * CHUNK;
            let is_held = start + chunk.len() <= num_held && self.held[start..start + chunk.len()] == *chunk;
            match (is_held, from) {
                (false, None) => from = Some(start),
                (true, Some(first)) => {
                    self.write(device, words, first..start);
                    from = None;
                }
                _ => {}
            }
        }
        if let Some(first) = from {
            self.write(device, words, first..words.len());
        }
        let common = num_held.min(words.len());
        self.held[..common].copy_from_slice(&words[..common]);
        self.held.extend_from_slice(&words[common..]);
        Ok(())
    }

    fn write(&self, device: &Device, words: &[u32], range: std::ops::Range<usize>) {
        device.upload(&self.buffer.raw, 4 * range.start as u64, bytemuck::cast_slice(&words[range]));
    }
}
