//! Drawing on the GPU: payloads go there as they are stored, those read once staying in memory for as long as they fit.

use std::{collections::HashMap, sync::Arc, time::Instant};

use anyhow::{Context, bail};
use chronoxel_codec::{Indices, Payload, PayloadClass, Stage, Table};
use chronoxel_core::{BitMask, BrickLayout, ByteLru, NodeId, PayloadAddress, SpanKind, SpanRecord};
use chronoxel_render::{CodedBrick, GpuBrick, GpuHow, GpuInfo, GpuOptions, GpuRenderer};
use chronoxel_store::Store;
use chronoxel_stream::{DrawItem, How};

use super::{BrickCounts, Drawn, Faults, RESIDENT_SHARE, Session, View, held::payload_bytes};

/// A GPU, and what of the store is in memory for it.
pub(super) struct OnGpu {
    renderer: GpuRenderer,
    /// Numbers of payloads and masks, as the renderer knows them.
    numbers: HashMap<CodedKey, u64>,
    held: ByteLru<CodedKey, Held>,
}

/// What makes two payloads with their masks the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct CodedKey {
    level: u8,
    window: u32,
    content: CodedContent,
    mask: Option<PayloadAddress>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum CodedContent {
    Payload {
        class: u8,
        at: PayloadAddress,
    },
    /// A masked brick of one value, by its bits.
    Constant(u64),
}

/// What the GPU is given of a brick.
#[derive(Debug, Clone)]
struct Held {
    payload: Arc<Payload>,
    mask: Option<Arc<BitMask>>,
}

impl CodedKey {
    fn new(level: u8, record: &SpanRecord) -> Option<Self> {
        let content = match record.kind {
            SpanKind::Empty => return None,
            SpanKind::Constant(value) => CodedContent::Constant(value.to_bits()),
            SpanKind::Coded { class, at } => CodedContent::Payload { class, at },
        };
        Some(Self { level, window: record.window, content, mask: record.mask })
    }
}

impl Session {
    /// Draws on a GPU from now on.
    ///
    /// # Errors
    /// If there is no adapter that can be used: the message says why, and what to do.
    pub fn use_gpu(&mut self, options: &GpuOptions) -> anyhow::Result<&GpuInfo> {
        let renderer = GpuRenderer::new(options)?;
        let held = ByteLru::new((self.memory_bytes as f64 * RESIDENT_SHARE) as usize);
        let on_gpu = self.on_gpu.insert(OnGpu { renderer, numbers: HashMap::new(), held });
        Ok(on_gpu.renderer.info())
    }

    /// The GPU that draws; `None` where the CPU does.
    pub fn gpu(&self) -> Option<&GpuInfo> {
        self.on_gpu.as_ref().map(|on_gpu| on_gpu.renderer.info())
    }

    /// Draws a draw list on the GPU.
    pub(super) fn draw_on_gpu(
        &mut self,
        view: &View,
        items: &[DrawItem],
        mut faults: Faults,
    ) -> anyhow::Result<Drawn> {
        self.check_payloads_fit(items)?;
        let start = Instant::now();
        let scene = self.scene(view);
        let mut bricks = BrickCounts::default();
        let mut on_gpu = self.on_gpu.take().context("no GPU was chosen")?;
        let list = self.gpu_bricks(&mut on_gpu, items, &mut bricks, &mut faults);
        let fetch_ms = start.elapsed().as_secs_f64() * 1e3;
        let drawn = list.and_then(|list| Ok(on_gpu.renderer.draw(&scene, &list)?));
        self.on_gpu = Some(on_gpu);
        let (image, stats) = drawn?;
        let render_ms = stats.wall_ms;
        Ok(Drawn { image, bricks, faults, samples: 0, fetch_ms, render_ms, on_gpu: Some(stats) })
    }

    /// All payloads of a picture are in memory at once, on their way to the GPU.
    fn check_payloads_fit(&self, items: &[DrawItem]) -> anyhow::Result<()> {
        let header = self.store.header();
        let classes = &header.variables[self.variable].classes;
        let bytes =
            |class: &PayloadClass| class.stages.iter().map(|stage| stage.num_bytes(&header.bricks)).sum();
        let most: usize = classes.iter().map(bytes).max().unwrap_or(0);
        let needed = most as u64 * items.iter().filter(|item| item.how == How::Payload).count() as u64;
        if needed > self.memory_bytes {
            bail!(
                "the payloads of a picture may take {needed} bytes, more than --memory allows: raise it, draw a coarser --level, \
                 or draw on the CPU, which takes them in portions"
            );
        }
        Ok(())
    }

    fn gpu_bricks(
        &mut self,
        on_gpu: &mut OnGpu,
        items: &[DrawItem],
        counts: &mut BrickCounts,
        faults: &mut Faults,
    ) -> anyhow::Result<Vec<GpuBrick>> {
        let mut bricks = Vec::with_capacity(items.len());
        let mut missing: Vec<(usize, SpanRecord, CodedKey)> = Vec::new();
        for (index, item) in items.iter().enumerate() {
            let how = match item.how {
                How::Skip => GpuHow::Skip,
                How::Constant(value) => GpuHow::Constant(value),
                How::ConstantColor([r, g, b, opacity]) => GpuHow::ConstantColor([r, g, b], opacity),
                How::Payload => {
                    let tree = Arc::clone(&self.tree);
                    let record = self.record(&tree, item.node, item.steps.start)?;
                    let key = CodedKey::new(item.node.level, &record);
                    match key.and_then(|key| on_gpu.held.get(&key).map(|held| (key, held))) {
                        Some((key, held)) => {
                            counts.reused += 1;
                            GpuHow::Coded(on_gpu.coded(key, held, item.steps.start - record.start))
                        }
                        None => {
                            missing.extend(key.map(|key| (index, record, key)));
                            GpuHow::Skip
                        }
                    }
                }
            };
            match how {
                GpuHow::Skip if item.how == How::Skip => counts.skipped += 1,
                GpuHow::Constant(_) | GpuHow::ConstantColor(..) => counts.constant += 1,
                _ => {}
            }
            bricks.push(GpuBrick { node: item.node, region: octree_box(item, self.store.layout()), how });
        }
        for of_level in missing.chunk_by(|a, b| a.2.level == b.2.level) {
            self.read_missing(on_gpu, of_level, items, &mut bricks, counts, faults)?;
        }
        Ok(bricks)
    }

    /// Reads payloads of one level that are not in memory.
    fn read_missing(
        &mut self,
        on_gpu: &mut OnGpu,
        missing: &[(usize, SpanRecord, CodedKey)],
        items: &[DrawItem],
        bricks: &mut [GpuBrick],
        counts: &mut BrickCounts,
        faults: &mut Faults,
    ) -> anyhow::Result<()> {
        let level = missing[0].2.level;
        let records: Vec<SpanRecord> = missing.iter().map(|(_, record, _)| *record).collect();
        let payloads = self.store.read_payloads(self.variable, level, &records);
        for ((index, record, key), payload) in missing.iter().zip(payloads) {
            let item = &items[*index];
            let step = item.steps.start;
            counts.new += 1;
            let held = payload
                .map_err(anyhow::Error::from)
                .and_then(|payload| held(&self.store, self.variable, level, record, payload));
            match held {
                Ok(held) => {
                    let num_bytes = payload_bytes(&held.payload);
                    on_gpu.held.insert(*key, held.clone(), num_bytes);
                    bricks[*index].how = GpuHow::Coded(on_gpu.coded(*key, held, step - record.start));
                }
                Err(error) => {
                    faults.warn(format!("{error}; its parent is drawn instead"));
                    let (node, how) = self.gpu_stand_in(on_gpu, item.node, step, faults)?;
                    let region = bricks[*index].region;
                    bricks[*index] = GpuBrick { node, region, how };
                }
            }
        }
        Ok(())
    }

    /// The nearest ancestor of a damaged node that can be drawn in its place.
    fn gpu_stand_in(
        &mut self,
        on_gpu: &mut OnGpu,
        damaged: NodeId,
        step: u32,
        faults: &mut Faults,
    ) -> anyhow::Result<(NodeId, GpuHow)> {
        let tree = Arc::clone(&self.tree);
        let mut node = damaged;
        while node != tree.root() {
            node = node.parent();
            let Ok(record) = self.record(&tree, node, step) else { continue };
            let how = match (record.kind, CodedKey::new(node.level, &record)) {
                (SpanKind::Constant(value), _) if record.mask.is_none() => GpuHow::Constant(value),
                (_, None) => GpuHow::Skip,
                (_, Some(key)) => match read_held(&self.store, self.variable, node.level, &record) {
                    Ok(held) => GpuHow::Coded(on_gpu.coded(key, held, step - record.start)),
                    Err(error) => {
                        faults.warn(format!("{error}; its parent is drawn instead"));
                        continue;
                    }
                },
            };
            return Ok((node, how));
        }
        let brick = damaged.brick();
        bail!("brick {brick:?} of level {} is damaged, and so is every node above it", damaged.level)
    }
}

impl OnGpu {
    fn coded(&mut self, key: CodedKey, held: Held, step_in_span: u32) -> CodedBrick {
        let next = self.numbers.len() as u64;
        let number = *self.numbers.entry(key).or_insert(next);
        CodedBrick { key: number, payload: held.payload, step_in_span, mask: held.mask }
    }
}

/// The whole cube of the octree of which a draw list's box is the part within the grid's bricks: the node's, or one of its octants.
fn octree_box(item: &DrawItem, layout: &BrickLayout) -> [[f64; 3]; 2] {
    let size = (layout.edge << item.node.level) as f64;
    let [low, high] = item.region;
    let node_low = item.node.brick().map(|b| f64::from(b) * size);
    let is_in_first = (0..3).all(|a| high[a] <= low[a] + 0.5 * size);
    let is_octant = item.node.level > 0 && (low != node_low || is_in_first);
    let edge = if is_octant { 0.5 * size } else { size };
    [low, low.map(|v| v + edge)]
}

fn read_held(store: &Store, variable: usize, level: u8, record: &SpanRecord) -> anyhow::Result<Held> {
    let payload = match record.kind {
        SpanKind::Coded { .. } => Some(store.read_payload(variable, level, record)?),
        _ => None,
    };
    held(store, variable, level, record, payload)
}

/// What the GPU is given of a span.
///
/// * `payload`: of a coded one
fn held(
    store: &Store,
    variable: usize,
    level: u8,
    record: &SpanRecord,
    payload: Option<Payload>,
) -> anyhow::Result<Held> {
    let mask = store.read_mask(variable, level, record)?.map(Arc::new);
    let payload = match (payload, record.kind) {
        (Some(payload), _) => payload,
        (None, SpanKind::Constant(value)) => constant_payload(value, store.layout()),
        (None, _) => bail!("a brick of level {level} has no payload"),
    };
    Ok(Held { payload: Arc::new(payload), mask })
}

/// A payload that decodes to one value.
fn constant_payload(value: f64, layout: &BrickLayout) -> Payload {
    let indices = Indices::U8(vec![0; layout.num_full()]);
    Payload { stages: vec![Stage { indices, table: Table::Affine { offset: value, scale: 0.0 }, shift: 0 }] }
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
