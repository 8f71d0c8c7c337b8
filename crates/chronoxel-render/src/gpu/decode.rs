//! The decode pass: slots of the pool are filled from indices and tables on the GPU.
//!
//! Textures of 16 bits a texel cannot be written by shaders within WebGPU's guarantees: slots are decoded into a buffer
//! that is laid out like some lines of the pool, and copied from there.

use bytemuck::{bytes_of, cast_slice};

use super::bank::Banks;
use super::device::{Device, storage, uniform};
use super::host::{BatchData, JobData};
use super::memory::{Buffer, Mirror};
use super::pool::{Pool, PoolShape};
use super::timing::{Span, Timer};
use super::{GpuError, import};

/// A slot that is to be decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Job {
    pub slot: u32,
    pub bank: usize,
    pub step: u32,
    /// Whether it is the later of two steps, decoded after the earlier one.
    pub is_later: bool,
}

/// Bytes from one batch's parameters to the next's.
const BATCH_STRIDE: u64 = 256;
/// Dispatches of a submission.
const MOST_DISPATCHES: usize = 256;
/// About as many bytes are decoded at a time.
const STAGING_BYTES: u64 = 32 << 20;

/// What the decode pass needs.
#[derive(Debug)]
pub(super) struct Decoder {
    pipelines: [wgpu::ComputePipeline; 2],
    layout: wgpu::BindGroupLayout,
    staging: Buffer,
    num_lines: u32,
    jobs: Buffer,
    batches: Buffer,
    /// For each slot, the first word of its payload.
    payloads: Mirror,
    payload_words: Vec<u32>,
    /// For each slot between two steps, the first word of the later payload, and the bits of its weight.
    laters: Mirror,
    later_words: Vec<u32>,
    pending: Vec<Job>,
}

impl Decoder {
    /// Bytes that it holds beside the pool.
    pub fn num_bytes(shape: &PoolShape) -> u64 {
        let per_slot = 2 * size_of::<JobData>() as u64 + 16;
        shape.line_bytes()
            + per_slot * u64::from(shape.num_slots())
            + BATCH_STRIDE * MOST_DISPATCHES as u64
            + 6144
    }

    /// * `spare_bytes`: what it may take beyond [`Self::num_bytes`]
    pub fn new(device: &Device, shape: &PoolShape, spare_bytes: u64) -> Result<Self, GpuError> {
        use wgpu::BufferUsages as Usage;
        let [read, written] = [storage(true), storage(false)];
        let bindings = [uniform(true), read, read, read, written, read];
        let layout = device.bind_group_layout("decode", &bindings);
        let pipeline = |is_later: bool| {
            let flag = |is: bool| f64::from(u8::from(is));
            let constants = [("IS_UNORM", flag(device.info.has_unorm)), ("IS_LATER", flag(is_later))];
            device.pipeline("decode.wgsl", import::DECODE, &layout, &constants)
        };
        let pipelines = [pipeline(false)?, pipeline(true)?];
        let num_slots = u64::from(shape.num_slots());
        let most_bytes = device.limits.max_storage_buffer_binding_size.min(STAGING_BYTES);
        let lines = (spare_bytes.min(most_bytes) / shape.line_bytes()).max(1);
        let num_lines = (lines as u32).min(shape.along[1] * shape.along[2]);
        let staging_bytes = u64::from(num_lines) * shape.line_bytes();
        let job_bytes = 2 * num_slots * size_of::<JobData>() as u64;
        let batch_bytes = BATCH_STRIDE * MOST_DISPATCHES as u64;
        Ok(Self {
            pipelines,
            layout,
            staging: device.buffer(
                "the buffer of decoded slots",
                staging_bytes,
                Usage::STORAGE | Usage::COPY_SRC,
            )?,
            num_lines,
            jobs: device.buffer(
                "the list of slots to decode",
                job_bytes,
                Usage::STORAGE | Usage::COPY_DST,
            )?,
            batches: device.buffer(
                "the parameters of decoding",
                batch_bytes,
                Usage::UNIFORM | Usage::COPY_DST,
            )?,
            payloads: Mirror::new(device, "the list of payloads of slots", 4 * num_slots)?,
            payload_words: vec![0; num_slots as usize],
            laters: Mirror::new(device, "the list of later payloads of slots", 8 * num_slots)?,
            later_words: Vec::new(),
            pending: Vec::new(),
        })
    }

    /// Notes a slot to decode, of a payload that begins at a word of its bank.
    pub fn push(&mut self, job: Job, word: u32) {
        self.payload_words[job.slot as usize] = word;
        self.pending.push(job);
    }

    /// Notes the later payload of a slot that was noted, and the weight of what it decodes to.
    pub fn push_later(&mut self, job: Job, word: u32, weight: f32) {
        self.later_words.resize(2 * self.payload_words.len(), 0);
        let at = 2 * job.slot as usize;
        self.later_words[at..at + 2].copy_from_slice(&[word, weight.to_bits()]);
        self.pending.push(job);
    }

    /// Decodes what was noted; returns the number of slots.
    pub fn flush(
        &mut self,
        device: &Device,
        banks: &Banks,
        pool: &Pool,
        timer: &mut Timer,
    ) -> Result<usize, GpuError> {
        let mut jobs = std::mem::take(&mut self.pending);
        if jobs.is_empty() {
            return Ok(0);
        }
        jobs.sort_unstable();
        self.payloads.set(device, &self.payload_words)?;
        self.laters.set(device, &self.later_words)?;
        let batches = split(&mut jobs, pool.shape.along[0], self.num_lines);
        let mut rest = batches.as_slice();
        while !rest.is_empty() {
            let (mut num, mut dispatches) = (0, 0);
            while num < rest.len() && (num == 0 || dispatches + rest[num].groups.len() <= MOST_DISPATCHES) {
                dispatches += rest[num].groups.len();
                num += 1;
            }
            self.submit(device, banks, pool, &rest[..num], &jobs, timer);
            rest = &rest[num..];
        }
        Ok(jobs.iter().filter(|job| !job.is_later).count())
    }

    /// Decodes some batches of jobs.
    fn submit(
        &self,
        device: &Device,
        banks: &Banks,
        pool: &Pool,
        batches: &[Batch],
        jobs: &[Job],
        timer: &mut Timer,
    ) {
        let data: Vec<JobData> = jobs.iter().map(|job| JobData { slot: job.slot, step: job.step }).collect();
        device.upload(&self.jobs.raw, 0, cast_slice(&data));
        let shape = &pool.shape;
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let span = timer.begin(&mut encoder, Span::Decode);
        let mut parameters = Vec::new();
        for batch in batches {
            for Group { bank, is_later, jobs: range } in &batch.groups {
                let offset = parameters.len() as u32;
                let data = self.batch_data(shape, batch.first_line, range.start);
                parameters.extend_from_slice(bytes_of(&data));
                parameters.resize(parameters.len().next_multiple_of(BATCH_STRIDE as usize), 0);
                let Some(bank) = banks.raw(*bank) else { continue };
                let group = self.bind(device, bank);
                let mut pass = encoder.begin_compute_pass(&Default::default());
                pass.set_pipeline(&self.pipelines[usize::from(*is_later)]);
                pass.set_bind_group(0, &group, &[offset]);
                let words = shape.pairs * shape.full_edge * shape.full_edge;
                pass.dispatch_workgroups(words.div_ceil(64), range.len() as u32, 1);
            }
            for run in runs(&jobs[batch.range()], shape.along[0]) {
                self.copy(&mut encoder, pool, batch.first_line, run);
            }
        }
        device.upload(&self.batches.raw, 0, &parameters);
        timer.end(&mut encoder, span);
        device.queue.submit([encoder.finish()]);
    }

    fn batch_data(&self, shape: &PoolShape, first_line: u32, first_job: usize) -> BatchData {
        BatchData {
            full_edge: shape.full_edge,
            pairs: shape.pairs,
            slots_along: shape.along[0],
            row_words: (shape.row_bytes() / 4) as u32,
            first_line,
            first_job: first_job as u32,
        }
    }

    fn bind(&self, device: &Device, bank: &wgpu::Buffer) -> wgpu::BindGroup {
        let batch = wgpu::BufferBinding {
            buffer: &self.batches.raw,
            offset: 0,
            size: wgpu::BufferSize::new(size_of::<BatchData>() as u64),
        };
        let resources = [
            wgpu::BindingResource::Buffer(batch),
            bank.as_entire_binding(),
            self.payloads.raw().as_entire_binding(),
            self.jobs.raw.as_entire_binding(),
            self.staging.raw.as_entire_binding(),
            self.laters.raw().as_entire_binding(),
        ];
        device.bind_group(&self.layout, &resources)
    }

    /// Copies a run of neighbouring slots of a line to the pool.
    fn copy(&self, encoder: &mut wgpu::CommandEncoder, pool: &Pool, first_line: u32, run: [u32; 2]) {
        let shape = &pool.shape;
        let [first, num] = run;
        let (line, x) = (first / shape.along[0] - first_line, first % shape.along[0]);
        let [origin_x, origin_y, origin_z] = shape.origin(first);
        encoder.copy_buffer_to_texture(
            wgpu::TexelCopyBufferInfo {
                buffer: &self.staging.raw,
                layout: wgpu::TexelCopyBufferLayout {
                    offset: u64::from(line) * shape.line_bytes() + 4 * u64::from(x * shape.pairs),
                    bytes_per_row: Some(shape.row_bytes() as u32),
                    rows_per_image: Some(shape.full_edge),
                },
            },
            wgpu::TexelCopyTextureInfo {
                texture: &pool.texture.raw,
                mip_level: 0,
                origin: wgpu::Origin3d { x: origin_x, y: origin_y, z: origin_z },
                aspect: wgpu::TextureAspect::All,
            },
            wgpu::Extent3d {
                width: num * 2 * shape.pairs,
                height: shape.full_edge,
                depth_or_array_layers: shape.full_edge,
            },
        );
    }
}

/// Jobs that are decoded into the buffer at a time.
#[derive(Debug, PartialEq)]
struct Batch {
    /// The line of slots that the buffer begins with.
    first_line: u32,
    groups: Vec<Group>,
}

/// Jobs whose payloads are in one bank; those of later steps come after all others.
#[derive(Debug, PartialEq)]
struct Group {
    bank: usize,
    is_later: bool,
    jobs: std::ops::Range<usize>,
}

impl Batch {
    fn range(&self) -> std::ops::Range<usize> {
        let start = self.groups.first().map_or(0, |group| group.jobs.start);
        start..self.groups.last().map_or(start, |group| group.jobs.end)
    }
}

/// Splits jobs, sorted by slot, into batches of at most some lines, and sorts those by bank.
fn split(jobs: &mut [Job], slots_along: u32, num_lines: u32) -> Vec<Batch> {
    let (mut batches, mut start) = (Vec::new(), 0);
    while start < jobs.len() {
        let first_line = jobs[start].slot / slots_along;
        let is_in = |job: &Job| job.slot / slots_along < first_line + num_lines;
        let end = start + jobs[start..].partition_point(is_in);
        let of_batch = &mut jobs[start..end];
        of_batch.sort_unstable_by_key(|job| (job.is_later, job.bank, job.slot));
        let (mut groups, mut at) = (Vec::new(), start);
        for group in of_batch.chunk_by(|a, b| (a.is_later, a.bank) == (b.is_later, b.bank)) {
            let Job { bank, is_later, .. } = group[0];
            groups.push(Group { bank, is_later, jobs: at..at + group.len() });
            at += group.len();
        }
        batches.push(Batch { first_line, groups });
        start = end;
    }
    batches
}

/// First slot and number of slots of each run of neighbours within a line.
fn runs(jobs: &[Job], slots_along: u32) -> Vec<[u32; 2]> {
    let mut slots: Vec<u32> = jobs.iter().map(|job| job.slot).collect();
    slots.sort_unstable();
    slots.dedup();
    let joins = |a: &u32, b: &u32| a + 1 == *b && !b.is_multiple_of(slots_along);
    slots.chunk_by(joins).map(|run| [run[0], run.len() as u32]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn batches_and_runs_cover_every_job_once() {
        let slots = [0, 1, 2, 4, 5, 6, 7, 9, 20, 21];
        let mut jobs: Vec<Job> = slots
            .iter()
            .map(|&slot| Job { slot, bank: slot as usize % 2, step: 0, is_later: false })
            .collect();
        jobs.extend([4, 20].map(|slot| Job { slot, bank: 0, step: 1, is_later: true }));
        jobs.sort_unstable();
        let batches = split(&mut jobs, 5, 2);
        assert_eq!(batches.iter().map(|b| b.first_line).collect::<Vec<_>>(), [0, 4]);
        assert_eq!(batches.iter().map(Batch::range).collect::<Vec<_>>(), [0..9, 9..12]);
        for batch in &batches {
            for Group { bank, is_later, jobs: range } in &batch.groups {
                let of_group = |job: &Job| (job.bank, job.is_later) == (*bank, *is_later);
                assert!(jobs[range.clone()].iter().all(of_group));
            }
            // What is later finds the earlier step decoded.
            assert!(batch.groups.is_sorted_by_key(|group| group.is_later));
            assert!(batch.groups.iter().any(|group| group.is_later));
        }
        assert_eq!(runs(&jobs[batches[0].range()], 5), [[0, 3], [4, 1], [5, 3], [9, 1]]);
        assert_eq!(runs(&jobs[batches[1].range()], 5), [[20, 2]]);
    }
}
