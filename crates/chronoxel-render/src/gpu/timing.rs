//! How long the GPU took, by its own clock where it has one.

use super::GpuError;
use super::device::Device;
use super::memory::Buffer;

/// What is timed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Span {
    Decode,
    Render,
    /// Projecting, sorting and binning.
    View,
}

/// Kinds of spans.
const NUM_KINDS: usize = 3;

/// Times of a picture; what is beyond this number of spans is not timed.
const MOST_SPANS: u32 = 512;

/// Timestamps at the beginning and the end of spans.
#[derive(Debug)]
pub(super) struct Timer {
    clock: Option<Clock>,
    spans: Vec<Span>,
}

#[derive(Debug)]
struct Clock {
    set: wgpu::QuerySet,
    resolved: Buffer,
    read: Buffer,
    ns_per_tick: f32,
}

impl Timer {
    pub fn new(device: &Device) -> Result<Self, GpuError> {
        use wgpu::BufferUsages as Usage;
        let bytes = 16 * u64::from(MOST_SPANS);
        let clock = if device.info.has_timestamps {
            Some(Clock {
                set: device.raw.create_query_set(&wgpu::QuerySetDescriptor {
                    label: Some("times"),
                    ty: wgpu::QueryType::Timestamp,
                    count: 2 * MOST_SPANS,
                }),
                resolved: device.buffer("times", bytes, Usage::QUERY_RESOLVE | Usage::COPY_SRC)?,
                read: device.buffer("times to read", bytes, Usage::COPY_DST | Usage::MAP_READ)?,
                ns_per_tick: device.queue.get_timestamp_period(),
            })
        } else {
            None
        };
        Ok(Self { clock, spans: Vec::new() })
    }

    /// Begins a span, by a pass that does nothing else.
    pub fn begin(&mut self, encoder: &mut wgpu::CommandEncoder, span: Span) -> Option<u32> {
        let clock = self.clock.as_ref()?;
        let number = self.spans.len() as u32;
        if number >= MOST_SPANS {
            return None;
        }
        self.spans.push(span);
        stamp(clock, encoder, 2 * number);
        Some(number)
    }

    /// Ends a span that was begun.
    pub fn end(&mut self, encoder: &mut wgpu::CommandEncoder, number: Option<u32>) {
        if let (Some(clock), Some(number)) = (&self.clock, number) {
            stamp(clock, encoder, 2 * number + 1);
        }
    }

    /// Begins a span in a submission of its own.
    pub fn begin_alone(&mut self, device: &Device, span: Span) -> Option<u32> {
        self.clock.as_ref()?;
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let number = self.begin(&mut encoder, span);
        device.queue.submit([encoder.finish()]);
        number
    }

    /// Ends a span in a submission of its own.
    pub fn end_alone(&mut self, device: &Device, number: Option<u32>) {
        if number.is_some() {
            let mut encoder = device.raw.create_command_encoder(&Default::default());
            self.end(&mut encoder, number);
            device.queue.submit([encoder.finish()]);
        }
    }

    /// The milliseconds of all spans of each kind since the last call, in the order of [`Span`]; `None` without a clock.
    pub fn finish(&mut self, device: &Device) -> Result<Option<[f64; NUM_KINDS]>, GpuError> {
        let spans = std::mem::take(&mut self.spans);
        let Some(clock) = &self.clock else { return Ok(None) };
        let num = 2 * spans.len() as u32;
        if num == 0 {
            return Ok(Some([0.0; NUM_KINDS]));
        }
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        encoder.resolve_query_set(&clock.set, 0..num, &clock.resolved.raw, 0);
        let bytes = 8 * u64::from(num);
        encoder.copy_buffer_to_buffer(&clock.resolved.raw, 0, &clock.read.raw, 0, bytes);
        device.queue.submit([encoder.finish()]);
        let mut sums = [0.0; NUM_KINDS];
        device.read(&clock.read.raw, bytes, |bytes| {
            let ticks: &[u64] = bytemuck::cast_slice(bytes);
            for (span, times) in spans.iter().zip(ticks.chunks_exact(2)) {
                let elapsed = times[1].saturating_sub(times[0]) as f64 * f64::from(clock.ns_per_tick);
                sums[*span as usize] += elapsed * 1e-6;
            }
        })?;
        Ok(Some(sums))
    }
}

fn stamp(clock: &Clock, encoder: &mut wgpu::CommandEncoder, query: u32) {
    encoder.begin_compute_pass(&wgpu::ComputePassDescriptor {
        label: None,
        timestamp_writes: Some(wgpu::ComputePassTimestampWrites {
            query_set: &clock.set,
            beginning_of_pass_write_index: None,
            end_of_pass_write_index: Some(query),
        }),
    });
}
