//! Sums and sorting in compute passes: a radix sort of pairs of key and number, 8 bits a pass, stable.

use bytemuck::bytes_of;

use super::passes::{Pass, groups_for, storage_buffer};
use crate::gpu::device::{Device, storage, uniform};
use crate::gpu::host::{DigitData, ScanData};
use crate::gpu::memory::Buffer;
use crate::gpu::{GpuError, import};

/// Parts that numbers are summed in.
const NUM_PARTS: u32 = 256;
/// Digits of a pass.
const NUM_DIGITS: u32 = 256;
/// The most parts that pairs are sorted in.
const MOST_PARTS: u32 = 512;
/// The fewest pairs of a part.
const LEAST_PART: u32 = 1024;
/// Bytes from one set of parameters to the next: what WebGPU guarantees as the alignment of uniform buffers.
const ALIGNMENT: u64 = 256;
/// The most passes of a sort.
const MOST_PASSES: u64 = 4;

/// Replaces numbers by the sums of those before each.
#[derive(Debug)]
pub(super) struct Scanner {
    passes: [Pass; 3],
    params: Buffer,
    /// Of the parts, and the sum of all behind them.
    sums: Buffer,
}

impl Scanner {
    pub fn new(device: &Device) -> Result<Self, GpuError> {
        use wgpu::BufferUsages as Usage;
        let bindings = [uniform(false), storage(false), storage(false)];
        let pass = |entry| Pass::new(device, "scan.wgsl", entry, import::CELL_SCAN, &bindings, &[]);
        let params = device.buffer("sizes of sums", ALIGNMENT, Usage::UNIFORM | Usage::COPY_DST)?;
        let sums = storage_buffer(device, "sums", 4 * (u64::from(NUM_PARTS) + 1), Usage::COPY_SRC)?;
        Ok(Self { passes: [pass("sum_parts")?, pass("sum_sums")?, pass("sum_within")?], params, sums })
    }

    /// Says how many numbers [`Self::run`] finds, before what is submitted next.
    pub fn prepare(&self, device: &Device, num: u32) {
        let part = num.div_ceil(NUM_PARTS).next_multiple_of(256).max(256);
        let data = ScanData { num, part, padding: [0; 2] };
        device.upload(&self.params.raw, 0, bytes_of(&data));
    }

    pub fn run(&self, device: &Device, pass: &mut wgpu::ComputePass, numbers: &Buffer) {
        let resources = [&self.params, numbers, &self.sums].map(|b| b.raw.as_entire_binding());
        for (one, groups) in self.passes.iter().zip([NUM_PARTS, 1, NUM_PARTS]) {
            one.run(device, pass, &resources, [groups, 1]);
        }
    }

    /// Copies the sum of all numbers.
    pub fn copy_total(&self, encoder: &mut wgpu::CommandEncoder, to: &Buffer, offset: u64) {
        encoder.copy_buffer_to_buffer(&self.sums.raw, 4 * u64::from(NUM_PARTS), &to.raw, offset, 4);
    }
}

/// Sorts pairs.
#[derive(Debug)]
pub(super) struct Sorter {
    count: Pass,
    move_pairs: Pass,
    take: Pass,
    params: Buffer,
    /// [digit, part]
    counts: Buffer,
    scanner: Scanner,
}

impl Sorter {
    pub fn new(device: &Device) -> Result<Self, GpuError> {
        use wgpu::BufferUsages as Usage;
        let bindings = [uniform(false), storage(true), storage(false), storage(false)];
        let pass = |entry| Pass::new(device, "sort.wgsl", entry, import::CELL_SORT, &bindings, &[]);
        let bytes = 4 * u64::from(NUM_DIGITS * MOST_PARTS);
        Ok(Self {
            count: pass("count")?,
            move_pairs: pass("move_pairs")?,
            take: pass("take_numbers")?,
            params: device.buffer(
                "sizes of a sort",
                ALIGNMENT * MOST_PASSES,
                Usage::UNIFORM | Usage::COPY_DST,
            )?,
            counts: storage_buffer(device, "counts of a sort", bytes, Usage::empty())?,
            scanner: Scanner::new(device)?,
        })
    }

    /// Sorts the pairs of the first of two buffers by the lowest bits of their keys; returns the number of the buffer
    /// that holds them in order.
    ///
    /// It submits one command buffer; `then` appends to it, once the pairs are sorted.
    pub fn sort(
        &self,
        device: &Device,
        pairs: [&Buffer; 2],
        num: u32,
        num_bits: u32,
        then: impl FnOnce(&mut wgpu::ComputePass, usize),
    ) -> usize {
        let part = num.div_ceil(MOST_PARTS).max(LEAST_PART).next_multiple_of(256);
        let num_parts = num.div_ceil(part).max(1);
        let num_passes = num_bits.div_ceil(8).max(1);
        for number in 0..num_passes {
            let data = DigitData { num, shift: 8 * number, part, num_parts };
            device.upload(&self.params.raw, u64::from(number) * ALIGNMENT, bytes_of(&data));
        }
        self.scanner.prepare(device, NUM_DIGITS * num_parts);
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        for number in 0..num_passes {
            let [from, to] = [0, 1].map(|i| pairs[(number as usize + i) % 2]);
            let resources = self.resources(number, from, &self.counts, to);
            self.count.run(device, &mut pass, &resources, [num_parts, 1]);
            self.scanner.run(device, &mut pass, &self.counts);
            self.move_pairs.run(device, &mut pass, &resources, [num_parts, 1]);
        }
        let at = num_passes as usize % 2;
        then(&mut pass, at);
        drop(pass);
        device.queue.submit([encoder.finish()]);
        at
    }

    /// Copies the numbers of the pairs that were sorted, without their keys.
    pub fn take(
        &self,
        device: &Device,
        pass: &mut wgpu::ComputePass,
        [sorted, other]: [&Buffer; 2],
        numbers: &Buffer,
        num: u32,
    ) {
        let resources = self.resources(0, sorted, numbers, other);
        self.take.run(device, pass, &resources, groups_for(num.into()));
    }

    fn resources<'a>(
        &'a self,
        number: u32,
        from: &'a Buffer,
        counts: &'a Buffer,
        to: &'a Buffer,
    ) -> [wgpu::BindingResource<'a>; 4] {
        let params = wgpu::BindingResource::Buffer(wgpu::BufferBinding {
            buffer: &self.params.raw,
            offset: u64::from(number) * ALIGNMENT,
            size: wgpu::BufferSize::new(size_of::<DigitData>() as u64),
        });
        let [from, counts, to] = [from, counts, to].map(|b| b.raw.as_entire_binding());
        [params, from, counts, to]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::twins;

    /// Words of a buffer.
    fn read(device: &Device, from: &Buffer, num: usize) -> Vec<u32> {
        use wgpu::BufferUsages as Usage;
        let bytes = 4 * num as u64;
        let to = device.buffer("read", bytes, Usage::COPY_DST | Usage::MAP_READ).unwrap();
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(&from.raw, 0, &to.raw, 0, bytes);
        device.queue.submit([encoder.finish()]);
        let mut words = Vec::new();
        device.read(&to.raw, bytes, |b| words.extend_from_slice(bytemuck::cast_slice(b))).unwrap();
        words
    }

    #[test]
    fn sums_are_those_of_the_numbers_before() {
        use wgpu::BufferUsages as Usage;
        let Some(device) = twins::device() else { return };
        let scanner = Scanner::new(&device).unwrap();
        for num in [1, 255, 256, 257, 70_001] {
            let numbers: Vec<u32> = (0..num).map(|i: u32| i.wrapping_mul(2_654_435_761) >> 24).collect();
            let bytes = 4 * u64::from(num);
            let buffer = storage_buffer(&device, "n", bytes, Usage::COPY_DST | Usage::COPY_SRC).unwrap();
            device.upload(&buffer.raw, 0, bytemuck::cast_slice(&numbers));
            scanner.prepare(&device, num);
            let total = storage_buffer(&device, "t", 16, Usage::COPY_DST | Usage::COPY_SRC).unwrap();
            let mut encoder = device.raw.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&Default::default());
            scanner.run(&device, &mut pass, &buffer);
            drop(pass);
            scanner.copy_total(&mut encoder, &total, 4);
            device.queue.submit([encoder.finish()]);
            let mut sum = 0;
            let before = |n: &u32| {
                sum += n;
                sum - n
            };
            let expected: Vec<u32> = numbers.iter().map(before).collect();
            assert_eq!(read(&device, &buffer, num as usize), expected, "{num}");
            assert_eq!(read(&device, &total, 2)[1], sum);
        }
    }

    #[test]
    fn the_order_is_that_of_a_stable_sort() {
        use wgpu::BufferUsages as Usage;
        let Some(device) = twins::device() else { return };
        let sorter = Sorter::new(&device).unwrap();
        for (num, bits) in [(1u32, 8), (1000, 8), (1023, 16), (40_000, 24)] {
            let key = |i: u32| i.wrapping_mul(2_654_435_761) >> (32 - bits) & !3;
            let mut pairs: Vec<[u32; 2]> = (0..num).map(|i| [key(i), i]).collect();
            let usage = Usage::COPY_DST | Usage::COPY_SRC;
            let buffers = [0, 1].map(|_| storage_buffer(&device, "p", 8 * u64::from(num), usage).unwrap());
            let numbers = storage_buffer(&device, "n", 4 * u64::from(num), usage).unwrap();
            device.upload(&buffers[0].raw, 0, bytemuck::cast_slice(&pairs));
            let both = [&buffers[0], &buffers[1]];
            let at = sorter.sort(&device, both, num, bits, |pass, at| {
                sorter.take(&device, pass, [both[at], both[1 - at]], &numbers, num);
            });
            pairs.sort_by_key(|pair| pair[0]);
            assert_eq!(read(&device, both[at], 2 * num as usize), pairs.as_flattened(), "{num} {bits}");
            let expected: Vec<u32> = pairs.iter().map(|pair| pair[1]).collect();
            assert_eq!(read(&device, &numbers, num as usize), expected);
        }
    }
}
