//! Compute passes over the numbers of a mesh.

use crate::gpu::GpuError;
use crate::gpu::device::Device;
use crate::gpu::memory::Buffer;

/// One entry point of a shader, and what it is bound to.
#[derive(Debug)]
pub(super) struct Pass {
    layout: wgpu::BindGroupLayout,
    pipeline: wgpu::ComputePipeline,
}

impl Pass {
    /// * `bindings`: counted from 0
    pub fn new(
        device: &Device,
        label: &'static str,
        entry: &str,
        source: &str,
        bindings: &[wgpu::BindingType],
        constants: &[(&str, f64)],
    ) -> Result<Self, GpuError> {
        let layout = device.bind_group_layout(label, bindings);
        let pipeline = device.pipeline_of(label, entry, source, &layout, constants)?;
        Ok(Self { layout, pipeline })
    }

    /// Dispatches workgroups, after what was dispatched before.
    pub fn run(
        &self,
        device: &Device,
        pass: &mut wgpu::ComputePass,
        resources: &[wgpu::BindingResource],
        [across, down]: [u32; 2],
    ) {
        let group = device.bind_group(&self.layout, resources);
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, &group, &[]);
        pass.dispatch_workgroups(across, down, 1);
    }
}

/// Workgroups of 256 invocations in rows, see `flat_number` of `shared/sight.wgsl`.
pub(super) fn groups_for(num: u64) -> [u32; 2] {
    let groups = num.div_ceil(256).max(1);
    let across = groups.min(1 << 15);
    [across as u32, groups.div_ceil(across) as u32]
}

/// A storage buffer that one binding reaches.
///
/// # Errors
/// [`GpuError`] if the adapter has no such large bindings, or the budget no such room.
pub(super) fn storage_buffer(
    device: &Device,
    what: &'static str,
    bytes: u64,
    usage: wgpu::BufferUsages,
) -> Result<Buffer, GpuError> {
    let found = most_binding(device);
    if bytes > found {
        let adapter = device.info.name.clone();
        let limit = "max_storage_buffer_binding_size";
        return Err(GpuError::LimitTooSmall { adapter, limit, found, needed: bytes });
    }
    device.buffer(what, bytes, wgpu::BufferUsages::STORAGE | usage)
}

/// Bytes that one binding reaches.
pub(super) fn most_binding(device: &Device) -> u64 {
    device.limits.max_storage_buffer_binding_size.min(device.limits.max_buffer_size)
}

/// Makes sure that a buffer has room for some bytes; it may be another buffer then, of any content.
///
/// Returns whether it is another one.
pub(super) fn hold(
    device: &Device,
    held: &mut Option<Buffer>,
    what: &'static str,
    bytes: u64,
    usage: wgpu::BufferUsages,
) -> Result<bool, GpuError> {
    if held.as_ref().is_some_and(|buffer| buffer.bytes() >= bytes) {
        return Ok(false);
    }
    if held.take().is_some() {
        device.settle();
    }
    *held = Some(storage_buffer(device, what, bytes, usage)?);
    Ok(true)
}

/// Bytes that are uploaded at once, so that what the driver keeps of them until then stays small.
const MOST_AT_ONCE: usize = 16 << 20;

/// Uploads a long list.
pub(super) fn upload_all(device: &Device, buffer: &Buffer, bytes: &[u8]) {
    for (number, part) in bytes.chunks(MOST_AT_ONCE).enumerate() {
        if number > 0 {
            device.queue.submit([]);
            device.settle();
        }
        device.upload(&buffer.raw, (number * MOST_AT_ONCE) as u64, part);
    }
}
