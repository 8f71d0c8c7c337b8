//! What of a draw list is drawn at once: its payloads are uploaded, its slots decoded, its boxes described.

use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;

use bytemuck::cast_slice;
use chronoxel_codec::{Payload, Table as CodedTable};
use chronoxel_core::{BitMask, BrickLayout, ResolvedTransfer};

use super::bank::{Banks, Place, ValueRange, mask_words, pack};
use super::decode::{Decoder, Job};
use super::device::Device;
use super::host::{BrickData, ConstantData, NO_LATER, NO_MASK};
use super::page_table::CellBox;
use super::pool::{Found, Pool, PoolShape, When};
use super::raycast::{Content, Portion, Sources};
use super::timing::Timer;
use super::{CodedBrick, GpuBrick, GpuError, GpuHow, GpuStats, LaterStep, RenderError, Scene, Way};
use crate::cpu::table::{NUM_ENTRIES, Table, premultiplied};
use crate::scene::MAX_LEVELS;

/// The tables of colours of the levels that are drawn, the same that the CPU reads.
#[derive(Debug, Default)]
pub(super) struct Colors {
    of: Option<(ResolvedTransfer, f64, f64)>,
    tables: BTreeMap<u8, Table>,
    levels: Vec<u8>,
    /// All of them, one level after another.
    pub words: Vec<u32>,
}

impl Colors {
    /// Makes those that a scene's bricks need.
    pub fn set(&mut self, scene: &Scene, bricks: &[GpuBrick]) -> Result<(), RenderError> {
        let of = (scene.transfer.clone(), scene.step_length(), scene.opacity_unit);
        if self.of.as_ref() != Some(&of) {
            *self = Self { of: Some(of), ..Self::default() };
        }
        let mut levels = Vec::new();
        for brick in bricks {
            let level = brick.node.level;
            if level >= MAX_LEVELS {
                return Err(RenderError::invalid("brick's level", level, "it must be below 32"));
            }
            if matches!(brick.how, GpuHow::Coded(_)) && !levels.contains(&level) {
                levels.push(level);
            }
        }
        levels.sort_unstable();
        for &level in &levels {
            let table = || Table::new(&scene.transfer, scene.step_length_at(level), scene.opacity_unit);
            self.tables.entry(level).or_insert_with(table);
        }
        if self.levels != levels {
            let tables = levels.iter().flat_map(|level| &self.tables[level].entries);
            self.words = tables.flatten().map(|c| c.to_bits()).collect();
            self.levels = levels;
        }
        Ok(())
    }

    /// A level's table, and its first entry among those of all levels.
    fn of_level(&self, level: u8) -> (&Table, u32) {
        let at = self.levels.binary_search(&level).unwrap_or_default();
        (&self.tables[&level], (at * NUM_ENTRIES) as u32)
    }
}

/// What is at hand while portions are made.
#[derive(Debug)]
pub(super) struct Making<'a> {
    pub device: &'a Device,
    pub timer: &'a mut Timer,
    pub stats: &'a mut GpuStats,
}

/// What lies on the GPU from picture to picture.
#[derive(Debug)]
pub(super) struct Residency {
    memory_bytes: u64,
    way: Way,
    pub(super) here: Option<Here>,
    /// Counts uses.
    pub(super) now: u64,
    /// Its count when the last list was begun.
    pub(super) began: u64,
}

#[derive(Debug)]
pub(super) struct Here {
    pub(super) layout: BrickLayout,
    pub(super) banks: Banks,
    /// Absent for a moment, while it grows.
    slots: Option<Slots>,
    most_slots: u64,
}

#[derive(Debug)]
struct Slots {
    pool: Pool,
    decoder: Decoder,
    /// The payloads of uses before this need not be kept: what they are for was submitted.
    submitted: u64,
}

impl Slots {
    /// What is said of the samples in a slot.
    fn samples(&self, slot: u32, range: ValueRange) -> Samples {
        Samples { slot, payload: 0, step: 0, later: None, mask: slot * self.pool.mask_words, range }
    }
}

/// What became of a brick of the list.
enum Placed {
    Content(CellBox, Content),
    /// It is not seen.
    Nothing,
    /// It has to wait for the next portion.
    NoRoom,
}

/// Where the samples of a brick are.
struct Samples {
    slot: u32,
    /// Where it is decoded at each fetch: the first word of its payload, and its step.
    payload: u32,
    step: u32,
    /// The same of the later of two steps, and the weight of what it decodes to.
    later: Option<(u32, u32, f32)>,
    /// The first word of the mask, if there is one.
    mask: u32,
    range: ValueRange,
}

/// Bytes that one entry of a list may take on the GPU, nodes of the page table included.
const ENTRY_BYTES: u64 = 512;

impl Residency {
    pub fn new(memory_bytes: u64, way: Way) -> Self {
        Self { memory_bytes, way, here: None, now: 0, began: 0 }
    }

    /// Forgets what is resident: after a list that could not be drawn, slots may have been taken and not decoded.
    pub fn forget(&mut self) {
        self.here = None;
    }

    pub fn num_slots(&self) -> usize {
        let slots = self.here.as_ref().and_then(|here| here.slots.as_ref());
        slots.map_or(0, |slots| slots.pool.shape.num_slots() as usize)
    }

    /// What the ray caster reads: the pool and, where it decodes at each fetch, the bank.
    pub fn sources(&self) -> Sources<'_> {
        let here = self.here.as_ref().expect("made before a portion is gathered");
        let bank = if self.way == Way::Fetch { here.banks.raw(0) } else { None };
        Sources { pool: &here.slots().pool, bank }
    }

    /// Makes room for the bricks of a list, as far as the budget goes.
    pub fn hold(&mut self, device: &Device, scene: &Scene, bricks: &[GpuBrick]) -> Result<(), GpuError> {
        let layout = &scene.layout;
        if layout.low < 1 || layout.high < 2 {
            let remedy = "it must have at least 1 sample before and 2 after";
            return Err(RenderError::invalid("brick's apron", layout.low, remedy).into());
        }
        if self.here.as_ref().is_none_or(|here| here.layout != *layout) {
            if self.here.take().is_some() {
                device.settle();
            }
            self.here = Some(Here::new(device, self.memory_bytes, self.way, layout)?);
        }
        self.began = self.now + 1;
        let here = self.here.as_mut().expect("made above");
        let coded = |brick: &GpuBrick| match &brick.how {
            GpuHow::Coded(coded) => Some((coded.key, When::of(coded))),
            _ => None,
        };
        let num_held = here.slots.as_ref().map_or(0, |slots| slots.pool.shape.num_slots() as usize);
        let wanted = match self.way {
            Way::Fetch => 1,
            Way::Pool if bricks.iter().filter_map(coded).count() <= num_held => num_held,
            Way::Pool => bricks.iter().filter_map(coded).collect::<HashSet<_>>().len(),
        };
        here.hold_slots(device, wanted as u64)?;
        let has_mask = |brick: &GpuBrick| matches!(&brick.how, GpuHow::Coded(coded) if coded.mask.is_some());
        if self.way == Way::Pool && bricks.iter().any(has_mask) {
            here.slots_mut().pool.hold_masks(device)?;
        }
        Ok(())
    }

    /// Takes bricks from a list until no more fit, and makes them ready.
    ///
    /// * `drawn`: how many of the list were taken, before and after
    pub fn gather(
        &mut self,
        making: &mut Making,
        scene: &Scene,
        bricks: &[GpuBrick],
        drawn: &mut usize,
        colors: &Colors,
    ) -> Result<Portion, GpuError> {
        let since = self.now + 1;
        let most = (self.memory_bytes / 8 / ENTRY_BYTES).max(1);
        let mut portion = Portion::new();
        let from = *drawn;
        while *drawn < bricks.len() && (portion.len() as u64) < most {
            let brick = &bricks[*drawn];
            match self.place(making, scene, brick, colors, since)? {
                Placed::NoRoom if portion.is_empty() && *drawn == from => {
                    let (given, what) = (self.memory_bytes, "the payloads of a brick");
                    return Err(GpuError::MemoryTooSmall { given, what, needed: given, least: 2 * given });
                }
                Placed::NoRoom => break,
                Placed::Nothing => making.stats.bricks_skipped += 1,
                Placed::Content(place, content) => {
                    match content {
                        Content::Brick(_) => making.stats.bricks_drawn += 1,
                        Content::Constant(_) => making.stats.bricks_constant += 1,
                    }
                    portion.push((place, content));
                }
            }
            *drawn += 1;
        }
        let now = self.now;
        let here = self.here.as_mut().expect("made before a portion is gathered");
        here.flush(making, now)?;
        Ok(portion)
    }

    fn place(
        &mut self,
        making: &mut Making,
        scene: &Scene,
        brick: &GpuBrick,
        colors: &Colors,
        since: u64,
    ) -> Result<Placed, GpuError> {
        let place = CellBox::of_region(brick.region, scene.layout.edge)?;
        if (0..3).any(|a| brick.region[0][a] >= (scene.grid.dims[a] - 1) as f64) {
            return Ok(Placed::Nothing);
        }
        let constant = |color: [f64; 4]| match constant_of(scene, brick, color) {
            Some(constant) => Placed::Content(place, Content::Constant(constant)),
            None => Placed::Nothing,
        };
        match &brick.how {
            GpuHow::Skip => Ok(Placed::Nothing),
            GpuHow::Constant(value) => Ok(constant(scene.transfer.evaluate(*value))),
            GpuHow::ConstantColor([r, g, b], opacity) => Ok(constant([*r, *g, *b, *opacity].map(f64::from))),
            GpuHow::Coded(coded) => {
                let (table, first_color) = colors.of_level(brick.node.level);
                let is_seen =
                    |range: ValueRange| !table.is_transparent_between([range.low, range.low + range.width]);
                self.now += 1;
                let way = self.way;
                let here = self.here.as_mut().expect("made before a portion is gathered");
                match here.samples(making, coded, way, is_seen, [since, self.now])? {
                    Err(placed) => Ok(placed),
                    Ok(samples) => {
                        let mut data = brick_of(scene, brick, coded, here, &samples);
                        let is_float = way == Way::Pool && !making.device.info.has_unorm;
                        data.index_from_texel = index_from_texel(table, samples.range, is_float);
                        data.colors = first_color;
                        Ok(Placed::Content(place, Content::Brick(data)))
                    }
                }
            }
        }
    }
}

impl Here {
    /// The shares of the budget: a quarter is for the picture, an eighth for lists, a sixteenth for colours; of the rest,
    /// three fifths are for the pool and what decodes into it, and two for banks.
    fn new(device: &Device, memory_bytes: u64, way: Way, layout: &BrickLayout) -> Result<Self, GpuError> {
        let share = memory_bytes / 16 * 9;
        let (pool_bytes, bank_bytes) = (share / 5 * 3, share / 5 * 2);
        let banks = match way {
            Way::Pool => Banks::new(bank_bytes, usize::MAX),
            Way::Fetch => Banks::new(bank_bytes, 1),
        };
        let edge = device.limits.max_texture_dimension_3d;
        let mask_bytes = 4 * layout.num_full().div_ceil(32) as u64;
        let slot_bytes = PoolShape::slot_bytes(layout) + mask_bytes;
        let of_masks = device.limits.max_storage_buffer_binding_size / mask_bytes;
        let mut most_slots = (pool_bytes / slot_bytes).min(of_masks);
        // What decodes grows with the lines of the pool.
        let fits = |num: u64| {
            let shape = PoolShape::new(layout, num, edge);
            u64::from(shape.num_slots()) * slot_bytes + Decoder::num_bytes(&shape) <= pool_bytes
        };
        while most_slots > 0 && !fits(most_slots) {
            most_slots = most_slots * 15 / 16;
        }
        if most_slots == 0 {
            let needed = slot_bytes + Decoder::num_bytes(&PoolShape::new(layout, 1, edge));
            let (given, what) = (memory_bytes, "a brick");
            return Err(GpuError::MemoryTooSmall {
                given,
                what,
                needed,
                least: needed * 5 * 16 / (3 * 9) + 16,
            });
        }
        Ok(Self { layout: *layout, banks, slots: None, most_slots })
    }

    fn slots(&self) -> &Slots {
        self.slots.as_ref().expect("made before bricks are placed")
    }

    fn slots_mut(&mut self) -> &mut Slots {
        self.slots.as_mut().expect("made before bricks are placed")
    }

    /// Makes a pool of enough slots, or of as many as may be.
    fn hold_slots(&mut self, device: &Device, wanted: u64) -> Result<(), GpuError> {
        let held = self.slots.as_ref().map_or(0, |slots| u64::from(slots.pool.shape.num_slots()));
        let edge = device.limits.max_texture_dimension_3d;
        let most = u64::from(PoolShape::new(&self.layout, self.most_slots, edge).num_slots());
        if self.slots.is_some() && (held >= wanted || held >= most) {
            return Ok(());
        }
        // A quarter to spare, so that a moving cut does not make the pool anew each time.
        let wanted = (wanted + wanted / 4).max(8).min(self.most_slots);
        if self.slots.take().is_some() {
            device.settle();
        }
        let shape = PoolShape::new(&self.layout, wanted, edge);
        let pool = Pool::new(device, &self.layout, shape)?;
        let spare = self.most_slots.saturating_sub(wanted) * PoolShape::slot_bytes(&self.layout);
        let decoder = Decoder::new(device, &shape, spare)?;
        self.slots = Some(Slots { pool, decoder, submitted: 0 });
        Ok(())
    }

    /// Decodes what was noted.
    fn flush(&mut self, making: &mut Making, now: u64) -> Result<(), GpuError> {
        let Some(slots) = &mut self.slots else { return Ok(()) };
        slots.submitted = now + 1;
        let Making { device, timer, stats } = making;
        stats.slots_decoded += slots.decoder.flush(device, &self.banks, &slots.pool, timer)?;
        Ok(())
    }

    /// Where the samples of a brick are, or what becomes of it instead.
    ///
    /// * `since`, `now`: the moment at which the portion began, and that of this use
    fn samples(
        &mut self,
        making: &mut Making,
        coded: &CodedBrick,
        way: Way,
        is_seen: impl Fn(ValueRange) -> bool,
        [since, now]: [u64; 2],
    ) -> Result<Result<Samples, Placed>, GpuError> {
        let CodedBrick { key, step_in_span: step, .. } = *coded;
        let when = When::of(coded);
        if way == Way::Pool
            && let Some((slot, range)) = self.slots_mut().pool.find(key, when, now)
        {
            let samples = self.slots().samples(slot, range);
            return Ok(if is_seen(range) { Ok(samples) } else { Err(Placed::Nothing) });
        }
        check_step(&coded.payload, step)?;
        let keeps_all_since = if way == Way::Fetch { Some(since) } else { None };
        let Some((place, later)) = self.payloads(making, coded, keeps_all_since, now)? else {
            return Ok(Err(Placed::NoRoom));
        };
        let (range, weight) = match (&coded.later, later) {
            (Some(of), Some(later)) => place.range.between(later.range, of.weight),
            _ => (place.range, 0.0),
        };
        if !is_seen(range) {
            return Ok(Err(Placed::Nothing));
        }
        let later = coded.later.as_ref().zip(later).map(|(of, later)| (later, of.step_in_span));
        if way == Way::Fetch {
            let payload = place.word;
            let mask = place.word + place.num_words - self.layout.num_full().div_ceil(32) as u32;
            let later = later.map(|(later, step)| (later.word, step, weight));
            return Ok(Ok(Samples { slot: 0, payload, step, later, mask, range }));
        }
        let layout = self.layout;
        let Slots { pool, decoder, .. } = self.slots_mut();
        let (slot, is_new) = match pool.place(key, when, range, since, now) {
            None => return Ok(Err(Placed::NoRoom)),
            Some(Found { slot, is_new }) => (slot, is_new),
        };
        decoder.push(Job { slot, bank: place.bank, step, is_later: false }, place.word);
        if let Some((later, step)) = later {
            decoder.push_later(Job { slot, bank: later.bank, step, is_later: true }, later.word, weight);
        }
        if let (true, Some(mask)) = (is_new, &coded.mask) {
            pool.upload_mask(making.device, slot, &mask_words(mask, &layout)?);
        }
        Ok(Ok(self.slots().samples(slot, range)))
    }

    /// Where the payload of a brick is, and that of the later of two steps.
    fn payloads(
        &mut self,
        making: &mut Making,
        coded: &CodedBrick,
        keeps_all_since: Option<u64>,
        now: u64,
    ) -> Result<Option<(Place, Option<Place>)>, GpuError> {
        let first = |here: &mut Self, making: &mut Making| {
            here.payload(making, coded.key, &coded.payload, coded.mask.as_ref(), keeps_all_since, now)
        };
        let Some(place) = first(self, making)? else { return Ok(None) };
        let Some(later) = &coded.later else { return Ok(Some((place, None))) };
        if !(0.0..=1.0).contains(&later.weight) {
            let remedy = "it must be from 0 to 1";
            return Err(RenderError::invalid("brick's weight of the later step", later.weight, remedy).into());
        }
        check_step(&later.payload, later.step_in_span)?;
        let of_later = self.payload(making, later.key, &later.payload, None, keeps_all_since, now)?;
        // Room for the one may have been made where the other was.
        let (Some(_), Some(place)) = (of_later, first(self, making)?) else { return Ok(None) };
        match self.banks.get(later.key, now) {
            Some(of_later) => Ok(Some((place, Some(of_later)))),
            None => {
                let (given, what) = (making.device.budget.limit(), "two payloads");
                Err(GpuError::MemoryTooSmall { given, what, needed: given, least: 2 * given })
            }
        }
    }

    /// Where a payload is, which is uploaded if need be; `None` where there is no room for it until what was used since
    /// a moment may go.
    fn payload(
        &mut self,
        making: &mut Making,
        key: u64,
        payload: &Payload,
        mask: Option<&Arc<BitMask>>,
        keeps_all_since: Option<u64>,
        now: u64,
    ) -> Result<Option<Place>, GpuError> {
        if let Some(place) = self.banks.get(key, now) {
            return Ok(Some(place));
        }
        let mut packed = pack(payload, &self.layout)?;
        if let (Some(_), Some(mask)) = (keeps_all_since, mask) {
            packed.append_mask(mask, &self.layout)?;
        }
        loop {
            if let Some(place) = self.banks.put(making.device, key, &packed, now)? {
                making.stats.payloads_uploaded += 1;
                return Ok(Some(place));
            }
            let before = keeps_all_since.unwrap_or(self.slots().submitted);
            if self.banks.forget_oldest(before) {
                continue;
            }
            if self.banks.is_empty() {
                let needed = 4 * packed.words.len() as u64;
                let (given, what) = (making.device.budget.limit(), "a payload");
                let least = needed.saturating_mul(5 * 16).div_ceil(2 * 9) + 16;
                return Err(GpuError::MemoryTooSmall { given, what, needed, least: least.max(given + 1) });
            }
            if keeps_all_since.is_some() {
                return Ok(None);
            }
            self.flush(making, now)?;
        }
    }
}

impl When {
    fn of(coded: &CodedBrick) -> Self {
        let later = |later: &LaterStep| (later.key, later.step_in_span, later.weight.to_bits());
        Self { step: coded.step_in_span, later: coded.later.as_ref().map(later) }
    }
}

/// Checks that a payload has a row for a step.
pub(super) fn check_step(payload: &Payload, step: u32) -> Result<(), RenderError> {
    for stage in &payload.stages {
        if let CodedTable::Listed { num_rows, .. } = &stage.table
            && step.checked_shr(stage.shift.into()).unwrap_or(0) as usize >= *num_rows
        {
            let remedy = "its payload has a table of fewer rows";
            return Err(RenderError::invalid("brick's step in its span", step, remedy));
        }
    }
    Ok(())
}

/// A box of one colour; `None` where it is transparent.
fn constant_of(scene: &Scene, brick: &GpuBrick, color: [f64; 4]) -> Option<ConstantData> {
    let level = brick.node.level.min(scene.finest_level);
    let color = premultiplied(color, scene.step_length_at(level), scene.opacity_unit);
    let alpha = f64::from(color[3]);
    (alpha > 0.0).then(|| ConstantData {
        color,
        log_transmittance: if alpha < 1.0 { f64::ln_1p(-alpha) as f32 } else { 0.0 },
        scale: 1.0 / (1u64 << level) as f32,
        padding: [0; 2],
    })
}

/// A brick as the shader reads it, but for its colours.
fn brick_of(
    scene: &Scene,
    brick: &GpuBrick,
    coded: &CodedBrick,
    here: &Here,
    samples: &Samples,
) -> BrickData {
    let (edge, pool) = (scene.layout.edge, &here.slots().pool);
    let low = scene.layout.low as u32;
    let mask = coded.mask.as_ref().map_or(NO_MASK, |_| samples.mask);
    BrickData {
        origin: brick.node.brick().map(|b| (f64::from(b) * edge as f64) as f32),
        scale: 1.0 / (1u64 << brick.node.level) as f32,
        texel: pool.shape.origin(samples.slot).map(|c| (c + low) as f32),
        colors: 0,
        index_from_texel: [0.0; 2],
        mask,
        payload: samples.payload,
        step: samples.step,
        later: samples.later.map_or(NO_LATER, |later| later.0),
        later_step: samples.later.map_or(0, |later| later.1),
        later_weight: samples.later.map_or(0.0, |later| later.2),
    }
}

/// Factor and offset from what the pool holds to the index of a colour.
fn index_from_texel(table: &Table, range: ValueRange, is_float: bool) -> [f32; 2] {
    if is_float {
        // From -1 to 1.
        table.index_from_number(range.low + 0.5 * range.width, 0.5 * range.width)
    } else {
        table.index_from_number(range.low, range.width)
    }
}

impl Pool {
    /// Uploads the mask of a slot.
    fn upload_mask(&self, device: &Device, slot: u32, words: &[u32]) {
        let offset = 4 * u64::from(slot) * u64::from(self.mask_words);
        if let Some(masks) = &self.masks {
            device.upload(&masks.raw, offset, cast_slice(words));
        }
    }
}
