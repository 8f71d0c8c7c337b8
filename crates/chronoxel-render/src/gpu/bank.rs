//! Payloads on the GPU: indices and tables, in storage buffers (banks) each of which one binding reaches.

use std::collections::HashMap;

use bytemuck::{Zeroable, bytes_of, cast_slice};
use chronoxel_codec::{Indices, Payload, Table};
use chronoxel_core::{BitMask, BrickLayout};

use super::device::Device;
use super::host::StageData;
use super::memory::Buffer;
use super::oldest::Oldest;
use super::{GpuError, RenderError};

/// Words of a stage's description.
const STAGE_WORDS: usize = size_of::<StageData>() / 4;

/// A payload as the shaders read it, see `shared/decode.wgsl`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Packed {
    /// The number of stages, their descriptions, their tables and indices.
    pub words: Vec<u32>,
    pub range: ValueRange,
}

impl Packed {
    /// Puts a mask behind the payload, for where there is no pool.
    pub fn append_mask(&mut self, mask: &BitMask, layout: &BrickLayout) -> Result<(), RenderError> {
        self.words.extend(mask_words(mask, layout)?);
        Ok(())
    }

    /// Puts the mask of the missing points of a mesh behind the payload; returns where it begins.
    ///
    /// # Errors
    /// [`RenderError::InvalidArgument`] if it has not one bit per point.
    pub fn append_point_mask(&mut self, mask: &BitMask, num_points: usize) -> Result<u32, RenderError> {
        if mask.bytes.len() != num_points.div_ceil(8) {
            let remedy = "it must have one bit per point of the mesh";
            return Err(RenderError::invalid("bytes of the mask of points", mask.bytes.len(), remedy));
        }
        Ok(append(&mut self.words, &mask.bytes))
    }
}

/// A mask as the shaders read it: a bit per sample, lowest first.
///
/// # Errors
/// [`RenderError::InvalidArgument`] if it has not one bit per sample of core and apron.
pub(super) fn mask_words(mask: &BitMask, layout: &BrickLayout) -> Result<Vec<u32>, RenderError> {
    if mask.bytes.len() != layout.num_full().div_ceil(8) {
        let remedy = "it must have one bit per sample of core and apron";
        return Err(RenderError::invalid("brick's bytes of mask", mask.bytes.len(), remedy));
    }
    let mut words = Vec::new();
    append(&mut words, &mask.bytes);
    Ok(words)
}

/// The least value that a payload decodes to at any of its steps, and the distance to the largest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ValueRange {
    pub low: f64,
    pub width: f64,
}

impl ValueRange {
    /// The range between two steps, and the weight of what the later one decodes to within its own.
    pub fn between(self, later: Self, weight: f64) -> (Self, f32) {
        let mix = |a: f64, b: f64| a * (1.0 - weight) + b * weight;
        let range = Self { low: mix(self.low, later.low), width: mix(self.width, later.width) };
        let share = if range.width > 0.0 { weight * later.width / range.width } else { 0.0 };
        (range, share as f32)
    }
}

/// Packs a payload, of which each step decodes to numbers from 0 to 1 within its range.
///
/// # Errors
/// [`GpuError::Payload`] for a stage that is not sound, [`GpuError::Scene`] for a range that is not finite.
pub(super) fn pack(payload: &Payload, layout: &BrickLayout) -> Result<Packed, GpuError> {
    pack_samples(payload, layout.num_full())
}

/// [`pack`] of a payload of any number of samples.
pub(super) fn pack_samples(payload: &Payload, num_samples: usize) -> Result<Packed, GpuError> {
    payload.stages.iter().try_for_each(|stage| stage.validate_samples(num_samples))?;
    let range = range_of(payload);
    if payload.stages.is_empty() || !(range.low.is_finite() && (range.low + range.width).is_finite()) {
        let value = format!("{} + {}", range.low, range.width);
        return Err(RenderError::invalid("values of a payload", value, "they must be finite").into());
    }
    let width = if range.width > 0.0 { range.width } else { 1.0 };
    let mut words = vec![0; 1 + STAGE_WORDS * payload.stages.len()];
    words[0] = payload.stages.len() as u32;
    let base: f64 = payload.stages.iter().map(|stage| parameters(&stage.table).0).sum();
    for (i, stage) in payload.stages.iter().enumerate() {
        let mut data = StageData { shift: stage.shift.into(), ..Zeroable::zeroed() };
        data.factor = (parameters(&stage.table).1 / width) as f32;
        // The first stage carries what does not depend on indices.
        data.offset = if i == 0 { ((base - range.low) / width) as f32 } else { 0.0 };
        if let Table::Listed { num_rows, entries, .. } = &stage.table {
            data.num_entries = (entries.len() / num_rows) as u32;
            data.table = append(&mut words, cast_slice(entries));
        }
        data.index_bits = stage.indices.bits().into();
        data.indices = match &stage.indices {
            Indices::U8(v) => append(&mut words, v),
            Indices::U16(v) => append(&mut words, cast_slice(v)),
        };
        let at = 1 + STAGE_WORDS * i;
        words[at..at + STAGE_WORDS].copy_from_slice(cast_slice(bytes_of(&data)));
    }
    Ok(Packed { words, range })
}

/// Appends little-endian bytes; returns the word at which they begin.
fn append(words: &mut Vec<u32>, bytes: &[u8]) -> u32 {
    let at = words.len() as u32;
    let chunks = bytes.chunks_exact(4);
    let rest = chunks.remainder();
    words.extend(chunks.map(|c| u32::from_le_bytes([c[0], c[1], c[2], c[3]])));
    if !rest.is_empty() {
        let mut last = [0; 4];
        last[..rest.len()].copy_from_slice(rest);
        words.push(u32::from_le_bytes(last));
    }
    at
}

/// Offset and scale.
fn parameters(table: &Table) -> (f64, f64) {
    match table {
        Table::Affine { offset, scale } | Table::Listed { offset, scale, .. } => (*offset, *scale),
    }
}

/// The sum of the ranges of the stages, over all rows.
fn range_of(payload: &Payload) -> ValueRange {
    let mut range = ValueRange { low: 0.0, width: 0.0 };
    for stage in &payload.stages {
        let (offset, scale) = parameters(&stage.table);
        let [least, most] = match &stage.table {
            Table::Affine { .. } => [stage.indices.smallest(), stage.indices.largest()],
            Table::Listed { num_rows, entries, .. } => {
                let used = usize::from(stage.indices.largest()) + 1;
                let rows = entries.chunks_exact(entries.len() / num_rows);
                let used = rows.flat_map(|row| &row[..used.min(row.len())]);
                used.fold([u16::MAX, 0], |[least, most], &e| [least.min(e), most.max(e)])
            }
        };
        range.low += offset + scale * f64::from(least);
        range.width += scale * f64::from(most - least);
    }
    range
}

/// Where a payload lies.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Place {
    pub bank: usize,
    pub word: u32,
    /// The number of words, of which a mask is the last.
    pub num_words: u32,
    pub range: ValueRange,
}

#[derive(Debug)]
struct Held {
    place: Place,
    last_use: u64,
}

#[derive(Debug)]
struct Bank {
    buffer: Buffer,
    /// First word and number of words of what is free, ascending, never two side by side.
    free: Vec<[u32; 2]>,
}

/// Banks within a number of bytes, made as they are needed.
#[derive(Debug)]
pub(super) struct Banks {
    banks: Vec<Bank>,
    most_banks: usize,
    most_bytes: u64,
    held: HashMap<u64, Held>,
    oldest: Oldest,
}

/// Bytes of the first bank.
const FIRST_BANK: u64 = 4 << 20;

impl Banks {
    pub fn new(most_bytes: u64, most_banks: usize) -> Self {
        Self { banks: Vec::new(), most_banks, most_bytes, held: HashMap::new(), oldest: Oldest::default() }
    }

    pub fn raw(&self, bank: usize) -> Option<&wgpu::Buffer> {
        self.banks.get(bank).map(|bank| &bank.buffer.raw)
    }

    pub fn is_empty(&self) -> bool {
        self.held.is_empty()
    }

    /// Whether a payload is here; that is not a use of it.
    pub fn holds(&self, key: u64) -> bool {
        self.held.contains_key(&key)
    }

    /// Where a payload lies, if it is here.
    pub fn get(&mut self, key: u64, now: u64) -> Option<Place> {
        let held = self.held.get_mut(&key)?;
        held.last_use = now;
        Some(held.place)
    }

    /// Uploads a payload; `None` where there is no room.
    pub fn put(
        &mut self,
        device: &Device,
        key: u64,
        packed: &Packed,
        now: u64,
    ) -> Result<Option<Place>, GpuError> {
        let num_words = packed.words.len() as u32;
        let Some((bank, word)) =
            self.take(num_words).map_or_else(|| self.grow(device, num_words), |p| Ok(Some(p)))?
        else {
            return Ok(None);
        };
        device.upload(&self.banks[bank].buffer.raw, 4 * u64::from(word), cast_slice(&packed.words));
        let place = Place { bank, word, num_words, range: packed.range };
        self.held.insert(key, Held { place, last_use: now });
        Ok(Some(place))
    }

    /// Forgets the payload that was used least recently, if that was before a moment; whether there was one.
    pub fn forget_oldest(&mut self, before: u64) -> bool {
        let held = &self.held;
        let uses = || held.iter().map(|(key, held)| (held.last_use, *key));
        let Some(key) = self.oldest.take(before, uses, |key| held.get(&key).map(|h| h.last_use)) else {
            return false;
        };
        if let Some(Held { place, .. }) = self.held.remove(&key) {
            release(&mut self.banks[place.bank].free, [place.word, place.num_words]);
        }
        true
    }

    /// The first room that is large enough.
    fn take(&mut self, num_words: u32) -> Option<(usize, u32)> {
        let fits = |bank: &Bank| bank.free.iter().position(|[_, n]| *n >= num_words);
        let (bank, at) = self.banks.iter().enumerate().find_map(|(i, b)| Some((i, fits(b)?)))?;
        let free = &mut self.banks[bank].free;
        let [start, n] = free[at];
        if n == num_words {
            free.remove(at);
        } else {
            free[at] = [start + num_words, n - num_words];
        }
        Some((bank, start))
    }

    /// Makes a bank, as large as all before, and takes room in it.
    fn grow(&mut self, device: &Device, num_words: u32) -> Result<Option<(usize, u32)>, GpuError> {
        let held: u64 = self.banks.iter().map(|bank| bank.buffer.bytes()).sum();
        let needed = (4 * u64::from(num_words)).next_multiple_of(16);
        let limits = &device.limits;
        let most = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
        let most = most.min(self.most_bytes.saturating_sub(held)).min(device.budget.left()) & !15;
        if self.banks.len() >= self.most_banks || needed > most {
            return Ok(None);
        }
        // A bank that cannot be followed by another takes all that it may.
        let wanted = if self.most_banks == 1 { most } else { held.max(FIRST_BANK).max(needed) };
        let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
        let buffer = device.buffer("a bank of payloads", wanted.min(most), usage)?;
        let free = vec![[0, (buffer.bytes() / 4) as u32]];
        self.banks.push(Bank { buffer, free });
        Ok(self.take(num_words))
    }
}

/// Puts room back, joined with what is free beside it.
fn release(free: &mut Vec<[u32; 2]>, [start, num]: [u32; 2]) {
    let at = free.partition_point(|[s, _]| *s < start);
    let joins_next = free.get(at).is_some_and(|[s, _]| start + num == *s);
    let joins_last = at > 0 && free[at - 1][0] + free[at - 1][1] == start;
    match (joins_last, joins_next) {
        (true, true) => {
            free[at - 1][1] += num + free[at][1];
            free.remove(at);
        }
        (true, false) => free[at - 1][1] += num,
        (false, true) => free[at] = [start, num + free[at][1]],
        (false, false) => free.insert(at, [start, num]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn released_room_is_joined() {
        let mut free = vec![[0, 10], [20, 5], [40, 10]];
        release(&mut free, [30, 4]);
        assert_eq!(free, [[0, 10], [20, 5], [30, 4], [40, 10]]);
        release(&mut free, [10, 10]);
        assert_eq!(free, [[0, 25], [30, 4], [40, 10]]);
        release(&mut free, [34, 6]);
        release(&mut free, [25, 5]);
        assert_eq!(free, [[0, 50]]);
    }
}
