//! The brick pool: a 3-D texture of slots of one size, each of which holds the decoded samples of a brick at a step.

use std::collections::HashMap;

use chronoxel_core::BrickLayout;

use super::GpuError;
use super::bank::ValueRange;
use super::device::Device;
use super::memory::{Buffer, Texture};
use super::oldest::Oldest;

/// How slots lie in the pool. A slot has two samples a word, so that a row of it ends with a word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct PoolShape {
    pub full_edge: u32,
    /// Words along a row of a slot.
    pub pairs: u32,
    /// Slots along x, y and z.
    pub along: [u32; 3],
}

impl PoolShape {
    /// Bytes of a slot.
    pub fn slot_bytes(layout: &BrickLayout) -> u64 {
        let full = layout.full_edge() as u64;
        4 * full.div_ceil(2) * full * full
    }

    /// As many slots as there should be at most, in a texture of at most `edge` texels a side; at least one.
    pub fn new(layout: &BrickLayout, num_slots: u64, edge: u32) -> Self {
        let full_edge = layout.full_edge() as u32;
        let pairs = full_edge.div_ceil(2);
        let most = [edge / (2 * pairs), edge / full_edge, edge / full_edge].map(u64::from);
        // Of the row lengths that leave room for all rows, the one that wastes least.
        let best = |num: u64, most: u64, rest: u64| {
            let longest = most.min(num).max(1);
            let least = num.div_ceil(rest.max(1)).min(longest).max(longest.div_ceil(2));
            (least..=longest).max_by_key(|n| (num / n).min(rest) * n).unwrap_or(1)
        };
        let x = best(num_slots, most[0], most[1] * most[2]);
        let lines = (num_slots / x).clamp(1, most[1] * most[2]);
        let y = best(lines, most[1], most[2]);
        let z = (lines / y).clamp(1, most[2]);
        Self { full_edge, pairs, along: [x, y, z].map(|n| n as u32) }
    }

    pub fn num_slots(&self) -> u32 {
        self.along.iter().product()
    }

    /// Texels along x, y and z.
    pub fn texels(&self) -> [u32; 3] {
        let [x, y, z] = self.along;
        [x * 2 * self.pairs, y * self.full_edge, z * self.full_edge]
    }

    /// The first texel of a slot.
    pub fn origin(&self, slot: u32) -> [u32; 3] {
        let (x, line) = (slot % self.along[0], slot / self.along[0]);
        let (y, z) = (line % self.along[1], line / self.along[1]);
        [x * 2 * self.pairs, y * self.full_edge, z * self.full_edge]
    }

    /// Bytes from row to row of a line of slots in a buffer from which it is copied.
    pub fn row_bytes(&self) -> u64 {
        (4 * u64::from(self.pairs) * u64::from(self.along[0]))
            .next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT.into())
    }

    /// Bytes of a line of slots in such a buffer.
    pub fn line_bytes(&self) -> u64 {
        self.row_bytes() * u64::from(self.full_edge).pow(2)
    }
}

/// When the samples of a slot are of: a step, or between one and a later one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct When {
    pub step: u32,
    /// The later payload's key, its step, and the bits of its weight.
    pub later: Option<(u64, u32, u64)>,
}

#[derive(Debug, Clone, Copy)]
struct Slot {
    key: u64,
    when: When,
    range: ValueRange,
    last_use: u64,
}

/// What a brick finds in the pool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Found {
    pub slot: u32,
    /// Whether the slot had the samples of another brick, or of none, rather than another step's.
    pub is_new: bool,
}

/// Slots, and who has them.
#[derive(Debug)]
pub(super) struct Pool {
    pub shape: PoolShape,
    pub texture: Texture,
    /// One bit per sample, `mask_words` words per slot; absent while no brick has a mask.
    pub masks: Option<Buffer>,
    pub mask_words: u32,
    slots: Vec<Slot>,
    of_key: HashMap<u64, Vec<u32>>,
    oldest: Oldest,
}

impl Pool {
    pub fn new(device: &Device, layout: &BrickLayout, shape: PoolShape) -> Result<Self, GpuError> {
        let format =
            if device.info.has_unorm { wgpu::TextureFormat::R16Unorm } else { wgpu::TextureFormat::R16Float };
        let texture = device.texture("the brick pool", shape.texels(), format)?;
        Ok(Self {
            shape,
            texture,
            masks: None,
            mask_words: layout.num_full().div_ceil(32) as u32,
            slots: Vec::new(),
            of_key: HashMap::new(),
            oldest: Oldest::default(),
        })
    }

    /// Makes room for masks, if there is none yet.
    pub fn hold_masks(&mut self, device: &Device) -> Result<(), GpuError> {
        if self.masks.is_none() {
            let bytes = 4 * u64::from(self.mask_words) * u64::from(self.shape.num_slots());
            let usage = wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::COPY_DST;
            self.masks = Some(device.buffer("the masks of the brick pool", bytes, usage)?);
        }
        Ok(())
    }

    /// The slot that holds a payload decoded at a step, and its range of values.
    pub fn find(&mut self, key: u64, when: When, now: u64) -> Option<(u32, ValueRange)> {
        let of_key = self.of_key.get(&key)?;
        let slot = *of_key.iter().find(|slot| self.slots[**slot as usize].when == when)?;
        self.slots[slot as usize].last_use = now;
        Some((slot, self.slots[slot as usize].range))
    }

    /// A slot for a payload at a step that no slot holds; `None` where all were used since a moment.
    ///
    /// One that holds the payload at another step is taken first: all but its row is where it was.
    pub fn place(&mut self, key: u64, when: When, range: ValueRange, since: u64, now: u64) -> Option<Found> {
        let of_key = self.of_key.get(&key).map_or(&[][..], Vec::as_slice);
        if let Some(&slot) = of_key.iter().find(|slot| self.slots[**slot as usize].last_use < since) {
            self.slots[slot as usize] = Slot { key, when, range, last_use: now };
            return Some(Found { slot, is_new: false });
        }
        let slot = if (self.slots.len() as u32) < self.shape.num_slots() {
            self.slots.push(Slot { key, when, range, last_use: now });
            self.slots.len() as u32 - 1
        } else {
            let slots = &self.slots;
            let uses = || slots.iter().enumerate().map(|(i, slot)| (slot.last_use, i as u64));
            let slot = self.oldest.take(since, uses, |i| slots.get(i as usize).map(|s| s.last_use))? as u32;
            self.forget_key(slot);
            slot
        };
        self.of_key.entry(key).or_default().push(slot);
        self.slots[slot as usize] = Slot { key, when, range, last_use: now };
        Some(Found { slot, is_new: true })
    }

    fn forget_key(&mut self, slot: u32) {
        let key = self.slots[slot as usize].key;
        if let Some(slots) = self.of_key.get_mut(&key) {
            slots.retain(|other| *other != slot);
            if slots.is_empty() {
                self.of_key.remove(&key);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_hold_about_what_was_asked_for() {
        for edge in [8, 16, 32, 64] {
            let layout = BrickLayout::new(edge).unwrap();
            for num in [1, 2, 7, 56, 57, 100, 997, 3000] {
                let shape = PoolShape::new(&layout, num, 2048);
                let (slots, texels) = (u64::from(shape.num_slots()), shape.texels());
                assert!(slots <= num && (slots as f64) > 0.8 * num as f64, "{edge} {num} {shape:?}");
                assert!(texels.iter().all(|n| *n <= 2048), "{edge} {num} {shape:?}");
                let last = shape.origin(shape.num_slots() - 1);
                let size = [2 * shape.pairs, shape.full_edge, shape.full_edge];
                assert_eq!(std::array::from_fn(|a| last[a] + size[a]), texels);
            }
        }
    }

    #[test]
    fn full_textures_bound_the_slots() {
        let layout = BrickLayout::new(128).unwrap();
        let shape = PoolShape::new(&layout, u64::MAX, 2048);
        assert_eq!(shape.along, [15; 3]);
    }
}
