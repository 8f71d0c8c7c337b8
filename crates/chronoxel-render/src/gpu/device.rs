//! The adapter, its device, and what can go wrong with them.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};

use super::error::one_line;
use super::memory::Budget;
use super::{GpuError, GpuOptions, import};

/// Which adapter draws, and what it offers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GpuInfo {
    /// The adapter's name.
    pub name: String,
    /// Vulkan, Metal, Dx12, …
    pub backend: String,
    /// The driver and its version.
    pub driver: String,
    /// Discrete, integrated, virtual, or on the CPU.
    pub kind: &'static str,
    /// Whether it is a program on the CPU: the CPU's own ray caster is faster.
    pub is_software: bool,
    /// Whether the pool holds 16-bit fractions, of which WebGPU does not guarantee the format, in place of 16-bit floats.
    pub has_unorm: bool,
    /// Whether slices are blended in 32-bit floats, which WebGPU does not guarantee, in place of 16-bit ones.
    pub has_blendable_floats: bool,
    /// Whether times are measured on the GPU; else they are those of the host.
    pub has_timestamps: bool,
}

/// A device, and what it reported.
#[derive(Debug)]
pub(super) struct Device {
    pub raw: wgpu::Device,
    pub queue: wgpu::Queue,
    pub info: GpuInfo,
    pub limits: wgpu::Limits,
    pub budget: Arc<Budget>,
    uploaded: AtomicU64,
    /// The first fault, if any.
    fault: Arc<Mutex<Option<String>>>,
}

impl Device {
    /// Opens a device on the adapter that suits best, or on the one asked for.
    pub fn new(options: &GpuOptions) -> Result<Self, GpuError> {
        let adapter = choose(options)?;
        let limits = limits_of(&adapter.get_info().name, adapter.limits(), options.guaranteed_only)?;
        let features = wanted_features(options) & adapter.features();
        let info = info_of(&adapter.get_info(), features);
        let request = adapter.request_device(&wgpu::DeviceDescriptor {
            label: Some("chronoxel"),
            required_features: features,
            required_limits: limits.clone(),
            ..Default::default()
        });
        let (raw, queue) = pollster::block_on(request).map_err(|e| GpuError::Setup {
            adapter: info.name.clone(),
            reason: one_line(&format!("no device: {e}")),
        })?;
        let fault = Arc::new(Mutex::new(None));
        listen(&raw, &fault);
        let budget = Budget::new(options.memory_bytes);
        Ok(Self { raw, queue, info, limits, budget, uploaded: AtomicU64::new(0), fault })
    }

    /// Fails where the device reported a fault.
    pub fn check(&self) -> Result<(), GpuError> {
        match &*self.fault.lock().unwrap_or_else(|e| e.into_inner()) {
            None => Ok(()),
            Some(reason) => Err(GpuError::Lost { adapter: self.info.name.clone(), reason: reason.clone() }),
        }
    }

    /// Writes bytes to a buffer before what is submitted next, and counts them.
    pub fn upload(&self, buffer: &wgpu::Buffer, offset: u64, bytes: &[u8]) {
        self.uploaded.fetch_add(bytes.len() as u64, Relaxed);
        self.queue.write_buffer(buffer, offset, bytes);
    }

    /// Bytes uploaded since the last call.
    pub fn take_uploaded(&self) -> u64 {
        self.uploaded.swap(0, Relaxed)
    }

    /// Waits until all that was submitted is done, so that what was given up is free.
    pub fn settle(&self) {
        if let Err(e) = self.raw.poll(wgpu::PollType::wait_indefinitely()) {
            note(&self.fault, format!("waiting for the GPU failed: {e}"));
        }
    }

    /// Reads the first bytes of a buffer that can be mapped, once all that was submitted is done.
    pub fn read(&self, buffer: &wgpu::Buffer, bytes: u64, take: impl FnOnce(&[u8])) -> Result<(), GpuError> {
        let slice = buffer.slice(..bytes);
        slice.map_async(wgpu::MapMode::Read, |_| ());
        self.settle();
        self.check()?;
        match slice.get_mapped_range() {
            Ok(mapped) => take(&mapped),
            Err(e) => note(&self.fault, format!("reading from the GPU failed: {e}")),
        }
        buffer.unmap();
        self.check()
    }

    /// Does what may be refused by the driver, and says what was.
    pub fn attempt<T>(&self, what: &str, make: impl FnOnce() -> T) -> Result<T, GpuError> {
        let scopes = [wgpu::ErrorFilter::Validation, wgpu::ErrorFilter::Internal]
            .map(|filter| self.raw.push_error_scope(filter));
        let made = make();
        let mut found = None;
        for scope in scopes.into_iter().rev() {
            found = pollster::block_on(scope.pop()).or(found);
        }
        match found {
            None => Ok(made),
            Some(e) => Err(GpuError::Setup {
                adapter: self.info.name.clone(),
                reason: one_line(&format!("{what}: {e}")),
            }),
        }
    }

    /// A compute pipeline of a shader's `main`.
    pub fn pipeline(
        &self,
        label: &'static str,
        source: &str,
        layout: &wgpu::BindGroupLayout,
        constants: &[(&str, f64)],
    ) -> Result<wgpu::ComputePipeline, GpuError> {
        self.pipeline_of(label, "main", source, layout, constants)
    }

    /// A compute pipeline of one of a shader's entry points.
    pub fn pipeline_of(
        &self,
        label: &'static str,
        entry: &str,
        source: &str,
        layout: &wgpu::BindGroupLayout,
        constants: &[(&str, f64)],
    ) -> Result<wgpu::ComputePipeline, GpuError> {
        let text = import::with_imports(source);
        self.attempt(&format!("the shader {label}"), || {
            let module = self.raw.create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(label),
                source: wgpu::ShaderSource::Wgsl(text.into()),
            });
            let layout = self.raw.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
                label: Some(label),
                bind_group_layouts: &[Some(layout)],
                immediate_size: 0,
            });
            self.raw.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(label),
                layout: Some(&layout),
                module: &module,
                entry_point: Some(entry),
                compilation_options: wgpu::PipelineCompilationOptions { constants, ..Default::default() },
                cache: None,
            })
        })
    }

    /// The layout of a bind group for compute shaders, bindings counted from 0.
    pub fn bind_group_layout(
        &self,
        label: &'static str,
        bindings: &[wgpu::BindingType],
    ) -> wgpu::BindGroupLayout {
        let entries: Vec<_> = (0..)
            .zip(bindings)
            .map(|(binding, ty)| wgpu::BindGroupLayoutEntry {
                binding,
                visibility: wgpu::ShaderStages::COMPUTE,
                ty: *ty,
                count: None,
            })
            .collect();
        let descriptor = wgpu::BindGroupLayoutDescriptor { label: Some(label), entries: &entries };
        self.raw.create_bind_group_layout(&descriptor)
    }

    /// A bind group, bindings counted from 0.
    pub fn bind_group(
        &self,
        layout: &wgpu::BindGroupLayout,
        resources: &[wgpu::BindingResource],
    ) -> wgpu::BindGroup {
        let entries: Vec<_> = (0..)
            .zip(resources)
            .map(|(binding, resource)| wgpu::BindGroupEntry { binding, resource: resource.clone() })
            .collect();
        let descriptor = wgpu::BindGroupDescriptor { label: None, layout, entries: &entries };
        self.raw.create_bind_group(&descriptor)
    }
}

/// A storage buffer, read or also written by shaders.
pub(super) fn storage(read_only: bool) -> wgpu::BindingType {
    let ty = wgpu::BufferBindingType::Storage { read_only };
    wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None }
}

/// A uniform buffer.
pub(super) fn uniform(has_dynamic_offset: bool) -> wgpu::BindingType {
    let ty = wgpu::BufferBindingType::Uniform;
    wgpu::BindingType::Buffer { ty, has_dynamic_offset, min_binding_size: None }
}

/// Keeps the first fault that a device reports.
fn listen(device: &wgpu::Device, fault: &Arc<Mutex<Option<String>>>) {
    let of_errors = fault.clone();
    device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| match error {
        wgpu::Error::OutOfMemory { .. } => note(&of_errors, "its memory is full, allow less of it".into()),
        error => note(&of_errors, error.to_string()),
    }));
    let of_loss = fault.clone();
    device.set_device_lost_callback(move |reason, message| {
        note(&of_loss, format!("{reason:?}: {message}"));
    });
}

fn note(fault: &Mutex<Option<String>>, message: String) {
    let mut fault = fault.lock().unwrap_or_else(|e| e.into_inner());
    fault.get_or_insert_with(|| one_line(&message));
}

/// What the adapter that suits best is.
pub(super) fn find(options: &GpuOptions) -> Result<GpuInfo, GpuError> {
    let adapter = choose(options)?;
    Ok(info_of(&adapter.get_info(), wanted_features(options) & adapter.features()))
}

/// Features that are used where they are offered.
fn wanted_features(options: &GpuOptions) -> wgpu::Features {
    match options.guaranteed_only {
        true => wgpu::Features::empty(),
        false => {
            wgpu::Features::TEXTURE_FORMAT_16BIT_NORM
                | wgpu::Features::TIMESTAMP_QUERY
                | wgpu::Features::FLOAT32_BLENDABLE
        }
    }
}

/// The adapter that suits best: a real GPU before a program on the CPU, a discrete one before others.
fn choose(options: &GpuOptions) -> Result<wgpu::Adapter, GpuError> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle());
    let mut adapters = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::all()));
    let names: Vec<String> = adapters.iter().map(|a| a.get_info().name).collect();
    if let Some(name) = &options.adapter {
        let name = name.to_lowercase();
        adapters.retain(|a| a.get_info().name.to_lowercase().contains(&name));
    }
    let best = adapters.into_iter().min_by_key(|a| match a.get_info().device_type {
        wgpu::DeviceType::DiscreteGpu => 0,
        wgpu::DeviceType::IntegratedGpu => 1,
        wgpu::DeviceType::VirtualGpu => 2,
        wgpu::DeviceType::Other => 3,
        wgpu::DeviceType::Cpu => 4,
    });
    best.ok_or_else(|| GpuError::NoAdapter {
        wanted: options.adapter.as_ref().map_or("at all".into(), |name| format!("named {name:?}")),
        found: if names.is_empty() { "none".into() } else { names.join(", ") },
    })
}

fn info_of(info: &wgpu::AdapterInfo, features: wgpu::Features) -> GpuInfo {
    GpuInfo {
        name: info.name.clone(),
        backend: info.backend.to_string(),
        driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
        kind: match info.device_type {
            wgpu::DeviceType::DiscreteGpu => "discrete GPU",
            wgpu::DeviceType::IntegratedGpu => "integrated GPU",
            wgpu::DeviceType::VirtualGpu => "virtual GPU",
            wgpu::DeviceType::Cpu => "software",
            wgpu::DeviceType::Other => "other",
        },
        is_software: info.device_type == wgpu::DeviceType::Cpu,
        has_unorm: features.contains(wgpu::Features::TEXTURE_FORMAT_16BIT_NORM),
        has_blendable_floats: features.contains(wgpu::Features::FLOAT32_BLENDABLE),
        has_timestamps: features.contains(wgpu::Features::TIMESTAMP_QUERY),
    }
}

/// The limits to ask for: those that WebGPU guarantees, and larger buffers and textures where they are offered.
pub(super) fn limits_of(
    adapter: &str,
    offered: wgpu::Limits,
    guaranteed_only: bool,
) -> Result<wgpu::Limits, GpuError> {
    let mut limits = wgpu::Limits::default();
    let pairs = [
        (
            "max_texture_dimension_3d",
            offered.max_texture_dimension_3d.into(),
            limits.max_texture_dimension_3d.into(),
        ),
        ("max_buffer_size", offered.max_buffer_size, limits.max_buffer_size),
        (
            "max_storage_buffer_binding_size",
            offered.max_storage_buffer_binding_size,
            limits.max_storage_buffer_binding_size,
        ),
        (
            "max_storage_buffers_per_shader_stage",
            offered.max_storage_buffers_per_shader_stage.into(),
            limits.max_storage_buffers_per_shader_stage.into(),
        ),
        (
            "max_compute_workgroups_per_dimension",
            offered.max_compute_workgroups_per_dimension.into(),
            limits.max_compute_workgroups_per_dimension.into(),
        ),
    ];
    for (limit, found, needed) in pairs {
        if found < needed {
            return Err(GpuError::LimitTooSmall { adapter: adapter.to_owned(), limit, found, needed });
        }
    }
    if !guaranteed_only {
        // Below 2 GiB, so that offsets in words and in bytes fit 32 bits.
        let most = (2 << 30) - 4096;
        limits.max_buffer_size = offered.max_buffer_size.min(most);
        limits.max_storage_buffer_binding_size = offered.max_storage_buffer_binding_size.min(most);
        limits.max_texture_dimension_3d = offered.max_texture_dimension_3d;
    }
    Ok(limits)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_that_are_too_small_are_refused() {
        let guaranteed = wgpu::Limits::default();
        assert_eq!(limits_of("any", guaranteed.clone(), false), Ok(guaranteed.clone()));
        let small = wgpu::Limits { max_texture_dimension_3d: 256, ..guaranteed.clone() };
        let refused = limits_of("an old card", small, false).unwrap_err();
        let expected = "an old card has a max_texture_dimension_3d of 256, but 2048 is needed: draw on another \
                        adapter or on the CPU";
        assert_eq!(refused.to_string(), expected);
        for small in [
            wgpu::Limits { max_buffer_size: 1 << 20, ..guaranteed.clone() },
            wgpu::Limits { max_storage_buffer_binding_size: 1 << 20, ..guaranteed.clone() },
            wgpu::Limits { max_storage_buffers_per_shader_stage: 4, ..guaranteed.clone() },
        ] {
            assert!(matches!(limits_of("a", small, true), Err(GpuError::LimitTooSmall { .. })));
        }
    }

    #[test]
    fn more_is_used_where_it_is_offered() {
        let offered = wgpu::Limits { max_buffer_size: 1 << 30, ..Default::default() };
        assert_eq!(limits_of("a", offered.clone(), false).unwrap().max_buffer_size, 1 << 30);
        assert_eq!(limits_of("a", offered, true), Ok(wgpu::Limits::default()));
    }

    #[test]
    fn shaders_that_are_refused_are_reported() {
        let Some(device) = crate::gpu::twins::device() else { return };
        let layout = device.bind_group_layout("none", &[]);
        let refused = device.pipeline("broken.wgsl", "fn main() { let x = ; }", &layout, &[]).unwrap_err();
        let message = refused.to_string();
        assert!(message.contains("broken.wgsl") && message.contains(&device.info.name), "{message}");
        assert!(!message.contains('\n') && message.contains("draw on the CPU"), "{message}");
        device.check().unwrap();
    }
}
