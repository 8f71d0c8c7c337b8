//! From a draw list to bricks that can be drawn: what is resident, what is read, decoded and kept.

use std::{
    collections::{HashMap, HashSet},
    sync::Arc,
};

use anyhow::bail;
use chronoxel_codec::decode_resident;
use chronoxel_core::{
    BitMask, BrickLayout, NodeId, Octree, PayloadAddress, ResidentBrick, SpanKind, SpanRecord,
};
use chronoxel_render::{DrawBrick, DrawHow, PreparedBrick};
use chronoxel_store::{Store, StoreError};
use chronoxel_stream::{DrawItem, How};
use rayon::prelude::*;

use super::{
    BrickCounts, Faults, Session,
    held::{Held, HeldKey, read_held},
};
use crate::blend::brick_between;

/// What makes two resident bricks the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct BrickKey {
    level: u8,
    window: u32,
    content: Content,
    /// Where the mask lies; masks are stored with the window of their span.
    mask: Option<PayloadAddress>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Content {
    Coded {
        class: u8,
        at: PayloadAddress,
        step_in_span: u32,
    },
    /// A masked brick of one value, by its bits.
    Constant(u64),
}

impl BrickKey {
    fn new(level: u8, record: &SpanRecord, step: u32) -> Option<Self> {
        let content = match record.kind {
            SpanKind::Empty => return None,
            SpanKind::Constant(value) => Content::Constant(value.to_bits()),
            SpanKind::Coded { class, at } => Content::Coded { class, at, step_in_span: step - record.start },
        };
        Some(Self { level, window: record.window, content, mask: record.mask })
    }
}

impl Session {
    /// Turns items selected between two steps into bricks to draw.
    pub(super) fn fetch_between(
        &mut self,
        items: &[DrawItem],
        step: u32,
        weight: f64,
        counts: &mut BrickCounts,
    ) -> anyhow::Result<Vec<DrawBrick>> {
        let tree = Arc::clone(&self.tree);
        let records: Vec<[SpanRecord; 2]> =
            items.iter().map(|item| self.records_around(&tree, item.node, step)).collect::<Result<_, _>>()?;
        for item in items {
            match item.how {
                How::Skip => counts.skipped += 1,
                How::Constant(_) | How::ConstantColor(_) => counts.constant += 1,
                How::Payload => counts.new += 1,
            }
        }
        let (store, variable) = (&self.store, self.variable);
        let draw = |(item, records): (&DrawItem, [SpanRecord; 2])| {
            let how = match item.how {
                How::Skip => DrawHow::Skip,
                How::Constant(value) => DrawHow::Constant(value),
                How::ConstantColor(color) => in_color(color),
                How::Payload => {
                    let brick = brick_between(store, variable, item.node, records, step, weight)?;
                    DrawHow::Samples(Arc::new(PreparedBrick::new(brick, &store.header().bricks)?))
                }
            };
            Ok(DrawBrick { node: item.node, region: item.region, how })
        };
        items.par_iter().zip(records).map(draw).collect()
    }

    /// What makes the brick of an item the same as another; `None` where it has no data.
    pub(super) fn brick_key(&mut self, item: &DrawItem) -> Result<Option<BrickKey>, StoreError> {
        let tree = Arc::clone(&self.tree);
        let record = self.record(&tree, item.node, item.steps.start)?;
        Ok(self.key_at(item.node.level, &record, item.steps.start))
    }

    /// What makes a node's brick at a step the same as another: also as that of an earlier step of its span, where the payload is in memory
    /// to tell.
    fn key_at(&mut self, level: u8, record: &SpanRecord, step: u32) -> Option<BrickKey> {
        let held = HeldKey::new(level, record).and_then(|key| self.held(&key));
        let payload = held.and_then(|held| held.payload);
        let step = payload.map_or(step, |p| record.start + p.first_step_like(step - record.start));
        BrickKey::new(level, record, step)
    }

    /// How many of the next parts of a picture fit a portion of the memory budget; at least one.
    ///
    /// * `num_payloads`: bricks to decode, of each part
    pub(super) fn num_in_portion(&self, num_payloads: impl Iterator<Item = usize>) -> usize {
        let brick_bytes = PreparedBrick::estimated_bytes(&self.store.header().bricks);
        let mut left = self.portion_bytes;
        let fits = num_payloads.take_while(|num| {
            let need = num * brick_bytes;
            let fits = need <= left;
            left = left.saturating_sub(need);
            fits
        });
        fits.count().max(1)
    }

    /// Turns selected items into bricks to draw; what is not resident is read and decoded in parallel.
    pub(super) fn fetch(
        &mut self,
        items: &[DrawItem],
        counts: &mut BrickCounts,
        faults: &mut Faults,
    ) -> anyhow::Result<Vec<DrawBrick>> {
        let tree = Arc::clone(&self.tree);
        let mut ready: HashMap<NodeId, Arc<PreparedBrick>> = HashMap::new();
        let mut wanted: Vec<Wanted> = Vec::new();
        // A node may stand in for several of its descendants.
        let mut seen = HashSet::new();
        for item in items.iter().filter(|item| item.how == How::Payload) {
            if !seen.insert(item.node) {
                continue;
            }
            let step = item.steps.start;
            let record = self.record(&tree, item.node, step)?;
            let Some(key) = self.key_at(item.node.level, &record, step) else { continue };
            match self.bricks.get(&key) {
                Some(brick) => {
                    counts.reused += 1;
                    ready.insert(item.node, brick);
                }
                None => wanted.push(Wanted { node: item.node, step, record, key }),
            }
        }
        for (wanted, loaded) in self.load(&wanted) {
            counts.new += 1;
            let brick = match loaded {
                Ok(brick) => brick,
                Err(error) => {
                    faults.warn(format!("{error}; its parent is drawn instead"));
                    continue;
                }
            };
            let key = self.key_at(wanted.node.level, &wanted.record, wanted.step).unwrap_or(wanted.key);
            self.bricks.insert(key, Arc::clone(&brick), brick.num_bytes());
            ready.insert(wanted.node, brick);
        }
        items
            .iter()
            .map(|item| {
                let (node, how) = match item.how {
                    How::Skip => (item.node, DrawHow::Skip),
                    How::Constant(value) => (item.node, DrawHow::Constant(value)),
                    How::ConstantColor(color) => (item.node, in_color(color)),
                    How::Payload => match ready.get(&item.node) {
                        Some(brick) => (item.node, DrawHow::Samples(Arc::clone(brick))),
                        None => self.stand_in(&tree, item.node, item.steps.start, faults)?,
                    },
                };
                match how {
                    DrawHow::Skip => counts.skipped += 1,
                    DrawHow::Constant(_) | DrawHow::ConstantColor(..) => counts.constant += 1,
                    _ => {}
                }
                Ok(DrawBrick { node, region: item.region, how })
            })
            .collect()
    }

    /// Reads and decodes bricks: payloads of a level in as few reads as possible, decoding in parallel.
    fn load<'a>(&mut self, wanted: &'a [Wanted]) -> Vec<(&'a Wanted, Loaded)> {
        let mut loaded = Vec::with_capacity(wanted.len());
        for of_level in wanted.chunk_by(|a, b| a.node.level == b.node.level) {
            let held = self.read(of_level);
            let layout = self.store.layout();
            let prepared = of_level
                .par_iter()
                .zip(held)
                .map(|(w, held)| (w, held.and_then(|held| prepare(layout, w, held))));
            loaded.par_extend(prepared);
        }
        loaded
    }

    /// What is in memory of a span.
    fn held(&mut self, key: &HeldKey) -> Option<Held> {
        match self.given.get(key) {
            Some(held) => Some(held.clone()),
            None => self.payloads.get(key),
        }
    }

    /// What is stored of bricks of one level: what another step needed is still there, the rest is read.
    fn read(&mut self, of_level: &[Wanted]) -> Vec<anyhow::Result<Held>> {
        let level = of_level[0].node.level;
        let keys: Vec<Option<HeldKey>> = of_level.iter().map(|w| HeldKey::new(level, &w.record)).collect();
        let held: Vec<Option<Held>> = keys.iter().map(|key| self.held(key.as_ref()?)).collect();
        let missing: Vec<SpanRecord> =
            of_level.iter().zip(&held).filter(|(_, held)| held.is_none()).map(|(w, _)| w.record).collect();
        self.num_read += missing.len() as u64;
        let mut read = read_held(&self.store, self.variable, level, &missing).into_iter();
        let mut all = Vec::with_capacity(of_level.len());
        for (key, (held, wanted)) in keys.into_iter().zip(held.into_iter().zip(of_level)) {
            let held = match held {
                Some(held) => Ok(held),
                None => read.next().expect("one for each that is missing"),
            };
            // The bricks of a single step are kept instead.
            if let (Some(key), Ok(held), 2..) = (key, &held, wanted.record.window) {
                self.payloads.insert(key, held.clone(), held.num_bytes());
            }
            all.push(held.map_err(Into::into));
        }
        all
    }

    /// The nearest ancestor of a damaged node that can be drawn in its place.
    fn stand_in(
        &mut self,
        tree: &Octree,
        damaged: NodeId,
        step: u32,
        faults: &mut Faults,
    ) -> anyhow::Result<(NodeId, DrawHow)> {
        let mut node = damaged;
        while node != tree.root() {
            node = node.parent();
            let Ok(record) = self.record(tree, node, step) else { continue };
            let how = match record.kind {
                SpanKind::Empty => return Ok((node, DrawHow::Skip)),
                SpanKind::Constant(value) if record.mask.is_none() => DrawHow::Constant(value),
                _ => {
                    let Some(key) = BrickKey::new(node.level, &record, step) else { continue };
                    let wanted = Wanted { node, step, record, key };
                    let loaded = match self.bricks.get(&key) {
                        Some(brick) => Ok(brick),
                        None => load_brick(&self.store, self.variable, &wanted),
                    };
                    match loaded {
                        Ok(brick) => {
                            self.bricks.insert(key, Arc::clone(&brick), brick.num_bytes());
                            DrawHow::Samples(brick)
                        }
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

type Loaded = anyhow::Result<Arc<PreparedBrick>>;

struct Wanted {
    node: NodeId,
    step: u32,
    record: SpanRecord,
    key: BrickKey,
}

fn load_brick(store: &Store, variable: usize, wanted: &Wanted) -> Loaded {
    let level = wanted.node.level;
    let held = read_held(store, variable, level, std::slice::from_ref(&wanted.record)).pop();
    prepare(store.layout(), wanted, held.expect("one for one record")?)
}

/// Makes a brick ready to be drawn, from its payload or its constant value.
fn prepare(layout: &BrickLayout, wanted: &Wanted, Held { payload, mask }: Held) -> Loaded {
    let Wanted { node, step, record, .. } = wanted;
    let mask = mask.map(|mask| BitMask::clone(&mask));
    let resident = match (payload, record.kind) {
        (Some(payload), _) => decode_resident(&payload, layout, *step - record.start, mask)?,
        (None, SpanKind::Constant(value)) => constant_brick(value, mask, layout),
        (None, _) => bail!("brick {:?} of level {} has no payload", node.brick(), node.level),
    };
    Ok(Arc::new(PreparedBrick::new(resident, layout)?))
}

fn constant_brick(value: f64, mask: Option<BitMask>, layout: &BrickLayout) -> ResidentBrick {
    ResidentBrick { samples: vec![0; layout.num_full()], offset: value, scale: 0.0, mask }
}

fn in_color([r, g, b, opacity]: [f32; 4]) -> DrawHow {
    DrawHow::ConstantColor([r, g, b], opacity)
}
