//! Drawing on the GPU: payloads go there as they are stored, those read once staying in memory for as long as they fit.

use std::{borrow::Cow, collections::HashMap, ops::Range, sync::Arc, time::Instant};

use anyhow::{Context, bail};
use chronoxel_codec::Payload;
use chronoxel_core::{BitMask, BrickLayout, ByteLru, NodeId, PayloadAddress, SpanKind, SpanRecord};
use chronoxel_render::{
    CodedBrick, GpuBrick, GpuHow, GpuInfo, GpuOptions, GpuPicture, GpuRenderer, LaterStep, ReadBack,
};
use chronoxel_store::Store;
use chronoxel_stream::{DrawItem, How};

use super::{
    BrickCounts, Drawn, Faults, HeldKey, RESIDENT_SHARE, Session, View,
    held::{constant_payload, payload_bytes},
};

/// A GPU, and what of the store is in memory for it.
pub(super) struct OnGpu {
    renderer: GpuRenderer,
    payloads: Payloads,
}

/// Share of the memory budget for the payloads of a part of a picture on their way to the GPU; as many may be forgotten
/// for them while they are in use, and as many wait in the driver.
const PART_SHARE: f64 = 0.12;

/// Payloads and masks in memory, and their numbers as the renderer knows them.
struct Payloads {
    numbers: HashMap<CodedKey, u64>,
    held: ByteLru<CodedKey, Held>,
    most_bytes: u64,
}

/// Where a mask lies: its window, and its place among masks.
type MaskPlace = (u32, PayloadAddress);

/// What makes two payloads with their masks the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct CodedKey {
    level: u8,
    window: u32,
    content: CodedContent,
    /// Those of both steps, between two.
    masks: [Option<MaskPlace>; 2],
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum CodedContent {
    Payload {
        class: u8,
        at: PayloadAddress,
    },
    /// A brick of one value, by its bits: masked, or beside one that varies.
    Constant(u64),
}

/// What the GPU is given of a brick.
#[derive(Debug, Clone)]
struct Held {
    payload: Arc<Payload>,
    mask: Option<Arc<BitMask>>,
}

impl CodedKey {
    /// * `masked_by`: the spans whose masks it has
    fn new(level: u8, record: &SpanRecord, masked_by: &[SpanRecord]) -> Option<Self> {
        let content = match record.kind {
            SpanKind::Empty => return None,
            SpanKind::Constant(value) => CodedContent::Constant(value.to_bits()),
            SpanKind::Coded { class, at } => CodedContent::Payload { class, at },
        };
        let place = |i: usize| masked_by.get(i).and_then(|r| r.mask.map(|at| (r.window, at)));
        Some(Self { level, window: record.window, content, masks: [place(0), place(1)] })
    }
}

/// A payload that a brick is drawn from.
#[derive(Debug, Clone)]
struct Need {
    record: SpanRecord,
    key: CodedKey,
    step_in_span: u32,
    /// The spans whose masks it has.
    masked_by: Vec<SpanRecord>,
}

/// An item of the draw list, and the payload of its step or those of the two around its time.
type Needs = Vec<Need>;

/// What is drawn, and how it comes back.
#[derive(Debug, Clone, Copy)]
pub(super) struct GpuShot<'a> {
    pub view: &'a View,
    pub items: &'a [DrawItem],
    pub step: u32,
    /// Of the next step; 0 at a step.
    pub weight: f64,
    pub read_back: ReadBack,
}

impl Session {
    /// Draws on a GPU from now on.
    ///
    /// # Errors
    /// If there is no adapter that can be used: the message says why, and what to do.
    pub fn use_gpu(&mut self, options: &GpuOptions) -> anyhow::Result<&GpuInfo> {
        let renderer = GpuRenderer::new(options)?;
        let held_bytes = (self.memory_bytes as f64 * RESIDENT_SHARE) as usize;
        let payloads = Payloads {
            numbers: HashMap::new(),
            held: ByteLru::new(held_bytes),
            most_bytes: (self.memory_bytes as f64 * PART_SHARE) as u64,
        };
        let on_gpu = self.on_gpu.insert(OnGpu { renderer, payloads });
        Ok(on_gpu.renderer.info())
    }

    /// The GPU that draws; `None` where the CPU does.
    pub fn gpu(&self) -> Option<&GpuInfo> {
        self.on_gpu.as_ref().map(|on_gpu| on_gpu.renderer.info())
    }

    /// Draws a draw list on the GPU, in parts where its payloads do not fit the memory together.
    pub(super) fn draw_on_gpu(
        &mut self,
        shot: GpuShot,
        mut faults: Faults,
    ) -> anyhow::Result<Drawn<GpuPicture>> {
        let start = Instant::now();
        let scene = self.scene(shot.view);
        let mut bricks = BrickCounts::default();
        let mut on_gpu = self.on_gpu.take().context("no GPU was chosen")?;
        let OnGpu { renderer, payloads } = &mut on_gpu;
        let drawn = self.needs(&shot).and_then(|needs| {
            let is_given =
                |need: &Need| Self::given_held_key(need).is_some_and(|key| self.given.contains_key(&key));
            let parts = payloads.parts(&needs, &self.store, self.variable, &is_given);
            let mut fetch_ms = start.elapsed().as_secs_f64() * 1e3;
            let mut is_counted = vec![false; parts.len()];
            let mut part = |number: usize| {
                let start = Instant::now();
                let range = parts[number].clone();
                let mut counts = BrickCounts::default();
                let (items, needs) = (&shot.items[range.clone()], &needs[range]);
                let list = self.gpu_bricks(payloads, &shot, items, needs, &mut counts, &mut faults)?;
                if !std::mem::replace(&mut is_counted[number], true) {
                    bricks.add(&counts);
                }
                fetch_ms += start.elapsed().as_secs_f64() * 1e3;
                anyhow::Ok(Cow::Owned(list))
            };
            let listing_ms = start.elapsed().as_secs_f64() * 1e3;
            let (image, stats) = renderer.draw_in_parts(&scene, shot.read_back, parts.len(), &mut part)?;
            Ok((image, stats, listing_ms, fetch_ms))
        });
        self.on_gpu = Some(on_gpu);
        let (image, stats, listing_ms, fetch_ms) = drawn?;
        // What was read for a part was read while the picture was drawn.
        let render_ms = stats.wall_ms - (fetch_ms - listing_ms).max(0.0);
        Ok(Drawn { image, bricks, faults, samples: 0, fetch_ms, render_ms, on_gpu: Some(stats) })
    }

    /// The payloads that each item of a draw list is drawn from; none where it has no samples.
    fn needs(&mut self, shot: &GpuShot) -> anyhow::Result<Vec<Needs>> {
        let tree = Arc::clone(&self.tree);
        let needs = shot.items.iter().map(|item| {
            if item.how != How::Payload {
                return Ok(Needs::new());
            }
            let level = item.node.level;
            let (records, step) = match shot.weight > 0.0 {
                false => (vec![self.record(&tree, item.node, item.steps.start)?], item.steps.start),
                true => (self.records_around(&tree, item.node, shot.step)?.to_vec(), shot.step),
            };
            let need = |(i, record): (usize, &SpanRecord)| {
                // The first has the masks of both.
                let is_masked = |record: &&SpanRecord| i == 0 && record.mask.is_some();
                let masked_by: Vec<SpanRecord> = records.iter().filter(is_masked).copied().collect();
                let key = CodedKey::new(level, record, &masked_by)?;
                let step_in_span = step + i as u32 - record.start;
                Some(Need { record: *record, key, step_in_span, masked_by })
            };
            // Where one is empty, nothing is there between the two.
            let needs: Option<Needs> = records.iter().enumerate().map(need).collect();
            Ok(needs.unwrap_or_default())
        });
        needs.collect()
    }

    fn gpu_bricks(
        &mut self,
        payloads: &mut Payloads,
        shot: &GpuShot,
        items: &[DrawItem],
        needs: &[Needs],
        counts: &mut BrickCounts,
        faults: &mut Faults,
    ) -> anyhow::Result<Vec<GpuBrick>> {
        let fetched = self.fetch_payloads(payloads, needs);
        let mut bricks = Vec::with_capacity(items.len());
        for (item, needs) in items.iter().zip(needs) {
            let mut node = item.node;
            let how = match (item.how, needs.as_slice()) {
                (How::Constant(value), _) => GpuHow::Constant(value),
                (How::ConstantColor([r, g, b, opacity]), _) => GpuHow::ConstantColor([r, g, b], opacity),
                (How::Skip, _) | (How::Payload, []) => GpuHow::Skip,
                (How::Payload, [first, rest @ ..]) => {
                    let is_new = needs.iter().any(|need| fetched[&need.key].1);
                    *(if is_new { &mut counts.new } else { &mut counts.reused }) += 1;
                    let found: Result<Vec<&Held>, &anyhow::Error> =
                        needs.iter().map(|need| fetched[&need.key].0.as_ref()).collect();
                    match found {
                        Ok(held) => {
                            let mut coded = payloads.coded(first, held[0]);
                            coded.later = rest.first().map(|later| LaterStep {
                                key: payloads.number(later.key),
                                payload: Arc::clone(&held[1].payload),
                                step_in_span: later.step_in_span,
                                weight: shot.weight,
                            });
                            GpuHow::Coded(coded)
                        }
                        Err(error) if !rest.is_empty() => bail!("{error:#}"),
                        Err(error) => {
                            faults.warn(format!("{error:#}; its parent is drawn instead"));
                            let (ancestor, how) =
                                self.gpu_stand_in(payloads, item.node, item.steps.start, faults)?;
                            node = ancestor;
                            how
                        }
                    }
                }
            };
            match how {
                GpuHow::Skip => counts.skipped += 1,
                GpuHow::Constant(_) | GpuHow::ConstantColor(..) => counts.constant += 1,
                GpuHow::Coded(_) => {}
            }
            bricks.push(GpuBrick { node, region: octree_box(item, self.store.layout()), how });
        }
        Ok(bricks)
    }

    /// The payloads of some items, from memory or read, those of a level in as few reads as possible; and whether each
    /// was read.
    fn fetch_payloads(
        &mut self,
        payloads: &mut Payloads,
        needs: &[Needs],
    ) -> HashMap<CodedKey, (anyhow::Result<Held>, bool)> {
        let mut fetched = HashMap::new();
        let mut missing: Vec<&Need> = Vec::new();
        for need in needs.iter().flatten() {
            if fetched.contains_key(&need.key) {
                continue;
            }
            let given = self.given_held(need);
            match given.or_else(|| payloads.held.get(&need.key)) {
                Some(held) => {
                    fetched.insert(need.key, (Ok(held), false));
                }
                None => missing.push(need),
            }
        }
        self.num_read += missing.len() as u64;
        for of_level in missing.chunk_by(|a, b| a.key.level == b.key.level) {
            let level = of_level[0].key.level;
            let records: Vec<SpanRecord> = of_level.iter().map(|need| need.record).collect();
            let read = self.store.read_payloads(self.variable, level, &records);
            for (need, payload) in of_level.iter().zip(read) {
                let held = payload
                    .map_err(anyhow::Error::from)
                    .and_then(|payload| held(&self.store, self.variable, need, payload));
                if let Ok(held) = &held {
                    payloads.held.insert(need.key, held.clone(), held.num_bytes());
                }
                fetched.insert(need.key, (held, true));
            }
        }
        fetched
    }

    /// The key under which a player gives a payload.
    fn given_held_key(need: &Need) -> Option<HeldKey> {
        // Between two steps a payload may have the masks of both.
        if need.masked_by.len() > 1 { None } else { HeldKey::new(need.key.level, &need.record) }
    }

    /// What a player has given of a payload.
    fn given_held(&self, need: &Need) -> Option<Held> {
        let given = self.given.get(&Self::given_held_key(need)?)?;
        let payload = match (&given.payload, need.record.kind) {
            (Some(payload), _) => Arc::clone(payload),
            (None, SpanKind::Constant(value)) => Arc::new(constant_payload(value, self.store.layout())),
            (None, _) => return None,
        };
        Some(Held { payload, mask: given.mask.clone() })
    }

    /// What drawing a node at a step needs on the GPU; `None` where the CPU draws, or nothing is needed.
    fn need_at(&mut self, node: NodeId, step: u32) -> Option<Need> {
        let tree = Arc::clone(&self.tree);
        let record = self.record(&tree, node, step).ok()?;
        let key = CodedKey::new(node.level, &record, &[record])?;
        Some(Need { record, key, step_in_span: step - record.start, masked_by: vec![record] })
    }

    /// Bytes that drawing a node at a step would send to the GPU: none where it holds the payload.
    pub(crate) fn upload_bytes(&mut self, node: NodeId, step: u32) -> u64 {
        let Some(need) = self.need_at(node, step) else { return 0 };
        let num_bytes = need.num_bytes(&self.store, self.variable);
        let Some(OnGpu { renderer, payloads }) = &mut self.on_gpu else { return 0 };
        if renderer.holds(payloads.number(need.key)) { 0 } else { num_bytes }
    }

    /// Sends what a node needs at a step to the GPU, if it is in memory and there is room: says how many bytes that took.
    pub(crate) fn upload_ahead(&mut self, node: NodeId, step: u32) -> anyhow::Result<Option<u64>> {
        let Some(need) = self.need_at(node, step) else { return Ok(Some(0)) };
        let Some(held) = self.given_held(&need) else { return Ok(Some(0)) };
        let Some(OnGpu { renderer, payloads }) = &mut self.on_gpu else { return Ok(Some(0)) };
        let key = payloads.number(need.key);
        Ok(renderer.upload_ahead(key, &held.payload, self.store.layout())?)
    }

    /// Leaves it to a player to keep payloads.
    pub(super) fn keep_no_payloads_for_gpu(&mut self) {
        if let Some(on_gpu) = &mut self.on_gpu {
            on_gpu.payloads.held = ByteLru::new(0);
        }
    }

    /// The nearest ancestor of a damaged node that can be drawn in its place.
    fn gpu_stand_in(
        &mut self,
        payloads: &mut Payloads,
        damaged: NodeId,
        step: u32,
        faults: &mut Faults,
    ) -> anyhow::Result<(NodeId, GpuHow)> {
        let tree = Arc::clone(&self.tree);
        let mut node = damaged;
        while node != tree.root() {
            node = node.parent();
            let Ok(record) = self.record(&tree, node, step) else { continue };
            let how = match (record.kind, CodedKey::new(node.level, &record, &[record])) {
                (SpanKind::Constant(value), _) if record.mask.is_none() => GpuHow::Constant(value),
                (_, None) => GpuHow::Skip,
                (_, Some(key)) => {
                    let step_in_span = step - record.start;
                    let need = Need { record, key, step_in_span, masked_by: vec![record] };
                    match read_held(&self.store, self.variable, &need) {
                        Ok(held) => GpuHow::Coded(payloads.coded(&need, &held)),
                        Err(error) => {
                            faults.warn(format!("{error}; its parent is drawn instead"));
                            continue;
                        }
                    }
                }
            };
            return Ok((node, how));
        }
        let brick = damaged.brick();
        bail!("brick {brick:?} of level {} is damaged, and so is every node above it", damaged.level)
    }
}

impl Payloads {
    fn number(&mut self, key: CodedKey) -> u64 {
        let next = self.numbers.len() as u64;
        *self.numbers.entry(key).or_insert(next)
    }

    fn coded(&mut self, need: &Need, held: &Held) -> CodedBrick {
        CodedBrick {
            key: self.number(need.key),
            payload: Arc::clone(&held.payload),
            step_in_span: need.step_in_span,
            mask: held.mask.clone(),
            later: None,
        }
    }

    /// Cuts a draw list into parts, of each of which as many bytes of payloads are in use at once as may be.
    ///
    /// * `is_given`: whether a payload is in memory in any case
    fn parts(
        &mut self,
        needs: &[Needs],
        store: &Store,
        variable: usize,
        is_given: &dyn Fn(&Need) -> bool,
    ) -> Vec<Range<usize>> {
        let bytes_of = |need: &Need| if is_given(need) { 0 } else { need.num_bytes(store, variable) };
        let total: u64 = needs.iter().flatten().map(bytes_of).sum();
        // What is held is counted there, if none of it must go for the rest of the picture.
        let stay = total <= self.held.budget_bytes() as u64;
        let (mut parts, mut start, mut bytes) = (Vec::new(), 0, 0);
        for (at, needs) in needs.iter().enumerate() {
            let is_counted = |held: &mut ByteLru<_, _>, need: &Need| !(stay && held.get(&need.key).is_some());
            let of_item: u64 =
                needs.iter().map(|n| if is_counted(&mut self.held, n) { bytes_of(n) } else { 0 }).sum();
            if at > start && bytes + of_item > self.most_bytes {
                parts.push(start..at);
                (start, bytes) = (at, 0);
            }
            bytes += of_item;
        }
        parts.push(start..needs.len());
        parts
    }
}

impl Need {
    /// Bytes of the payload and its mask in memory.
    fn num_bytes(&self, store: &Store, variable: usize) -> u64 {
        let layout = store.layout();
        let payload = match self.record.kind {
            SpanKind::Coded { class, .. } => {
                let classes = &store.header().variables[variable].classes;
                let stages = classes.get(usize::from(class)).map_or(&[][..], |class| &class.stages);
                stages.iter().map(|stage| stage.num_bytes(layout)).sum()
            }
            _ => layout.num_full(),
        };
        let is_masked = self.key.masks.iter().any(Option::is_some);
        let mask = if is_masked { layout.num_full().div_ceil(8) } else { 0 };
        (payload + mask) as u64
    }
}

impl Held {
    fn num_bytes(&self) -> usize {
        payload_bytes(&self.payload) + self.mask.as_ref().map_or(0, |mask| mask.bytes.len())
    }
}

/// The smallest cube of the octree of which a draw list's box is the part within the grid's bricks: the node's, or that of one below it for
/// which it stands in.
fn octree_box(item: &DrawItem, layout: &BrickLayout) -> [[f64; 3]; 2] {
    let [low, high] = item.region;
    let extent = (0..3).map(|a| high[a] - low[a]).fold(0.0, f64::max);
    let mut edge = layout.edge as f64;
    while edge < extent {
        edge *= 2.0;
    }
    [low, low.map(|v| v + edge)]
}

fn read_held(store: &Store, variable: usize, need: &Need) -> anyhow::Result<Held> {
    let payload = match need.record.kind {
        SpanKind::Coded { .. } => Some(store.read_payload(variable, need.key.level, &need.record)?),
        _ => None,
    };
    held(store, variable, need, payload)
}

/// What the GPU is given of a span.
///
/// * `payload`: of a coded one
fn held(store: &Store, variable: usize, need: &Need, payload: Option<Payload>) -> anyhow::Result<Held> {
    let level = need.key.level;
    let mut mask: Option<BitMask> = None;
    for record in &need.masked_by {
        let Some(other) = store.read_mask(variable, level, record)? else { continue };
        match &mut mask {
            Some(mask) => mask.bytes.iter_mut().zip(other.bytes).for_each(|(a, b)| *a |= b),
            None => mask = Some(other),
        }
    }
    let payload = match (payload, need.record.kind) {
        (Some(payload), _) => payload,
        (None, SpanKind::Constant(value)) => constant_payload(value, store.layout()),
        (None, _) => bail!("a brick of level {level} has no payload"),
    };
    Ok(Held { payload: Arc::new(payload), mask: mask.map(Arc::new) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boxes_are_whole_cubes_of_the_octree() {
        let layout = BrickLayout::new(8).unwrap();
        let cube = |level, brick, low: [f64; 3], high: [f64; 3]| {
            let node = NodeId::new(level, brick);
            octree_box(&DrawItem { node, region: [low, high], steps: 0..1, how: How::Payload }, &layout)
        };
        // A brick; a node cut at the end of the grid; an octant of a node, and one that is cut.
        assert_eq!(
            cube(0, [2, 0, 1], [16.0, 0.0, 8.0], [24.0, 8.0, 16.0]),
            [[16.0, 0.0, 8.0], [24.0, 8.0, 16.0]]
        );
        assert_eq!(
            cube(1, [1, 0, 0], [16.0, 0.0, 0.0], [24.0, 16.0, 16.0]),
            [[16.0, 0.0, 0.0], [32.0, 16.0, 16.0]]
        );
        assert_eq!(
            cube(1, [0, 0, 0], [8.0, 8.0, 0.0], [16.0, 16.0, 8.0]),
            [[8.0, 8.0, 0.0], [16.0, 16.0, 8.0]]
        );
        assert_eq!(cube(2, [0, 0, 0], [0.0, 0.0, 0.0], [16.0, 16.0, 8.0]), [[0.0; 3], [16.0; 3]]);
    }
}
