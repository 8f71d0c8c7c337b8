//! A store opened for drawing: from a view and a step to a picture.
//!
//! For each picture: select the nodes to draw, fetch what is not resident, draw front to back. Bricks stay resident
//! over a budget of bytes; where the bricks of one picture exceed it, they are drawn in portions, so
//! that a volume of any size can be drawn at full resolution.

use std::{collections::HashMap, path::Path, sync::Arc, time::Instant};

use anyhow::{Context, bail};
use rayon::prelude::*;

use chronoxel_codec::{Indices, Payload, Stage, Table, decode_resident};
use chronoxel_core::{
    BitMask, BrickLayout, ByteLru, CacheCounts, Camera, Image, Lighting, NodeId, Octree, PayloadAddress,
    ResidentBrick, ResolvedTransfer, SpanKind, SpanRecord, TransferFunction, UniformGrid,
};
use chronoxel_render::{CpuOptions, DrawBrick, DrawHow, Frame, PreparedBrick, RenderStats, Scene};
use chronoxel_store::{Store, StoreError};
use chronoxel_stream::{DrawItem, How, Selector, ViewVolume};

use crate::blend::{brick_between, record_between};

/// What a picture shows, but for the step.
#[derive(Debug, Clone)]
pub struct View {
    /// From where.
    pub camera: Camera,
    /// Colours and opacities, x in data units.
    pub transfer: ResolvedTransfer,
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// Distance between samples along a ray, in voxels of the smallest spacing.
    pub step_voxels: f64,
    /// Lighting, or none.
    pub lighting: Option<Lighting>,
    /// Path length that opacities refer to, world units.
    pub opacity_unit: f64,
    /// Finest level to draw.
    pub level: u8,
}

/// A moment of a series: a step, or a place between it and the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment {
    /// The step, or the earlier of the two.
    pub step: usize,
    /// Weight of the next step, in [0, 1).
    pub weight: f64,
}

impl Moment {
    /// The moment of a step.
    pub fn at(step: usize) -> Self {
        Self { step, weight: 0.0 }
    }

    /// The moment of a time: between the two steps around it, or the first or last step beyond them.
    pub fn of_time(times: &[f64], time: f64) -> Self {
        let after = times.partition_point(|&t| t <= time);
        match after {
            0 => Self::at(0),
            n if n == times.len() => Self::at(n - 1),
            n => Self { step: n - 1, weight: (time - times[n - 1]) / (times[n] - times[n - 1]) },
        }
    }

    /// Its time, on the axis of a series.
    pub fn time(self, times: &[f64]) -> f64 {
        match self.weight > 0.0 {
            false => times[self.step],
            true => times[self.step] + self.weight * (times[self.step + 1] - times[self.step]),
        }
    }
}

/// Where the bricks of a picture came from.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct BrickCounts {
    /// Not drawn: no data, transparent, or outside the picture.
    pub skipped: usize,
    /// Drawn as one value.
    pub constant: usize,
    /// Drawn from memory.
    pub reused: usize,
    /// Read and decoded for this picture.
    pub new: usize,
}

impl BrickCounts {
    /// Bricks that were drawn.
    pub fn drawn(&self) -> usize {
        self.constant + self.reused + self.new
    }
}

/// A picture, and what it took.
#[derive(Debug, Clone)]
pub struct Picture {
    /// The volume over nothing.
    pub image: Image,
    /// Samples taken, transparent space left out.
    pub samples: u64,
    /// Bricks by what became of them.
    pub bricks: BrickCounts,
    /// Time to select, read and decode, in milliseconds.
    pub fetch_ms: f64,
    /// Time to draw, in milliseconds.
    pub render_ms: f64,
    /// What went wrong and was made up for: each names the brick.
    pub warnings: Vec<String>,
}

/// What makes two resident bricks the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct BrickKey {
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

/// What makes two payloads the same; those of a single step are not kept, as their bricks are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct PayloadKey {
    level: u8,
    window: u32,
    class: u8,
    at: PayloadAddress,
}

impl PayloadKey {
    fn new(level: u8, record: &SpanRecord) -> Option<Self> {
        match record.kind {
            SpanKind::Coded { class, at } if record.window > 1 => {
                Some(Self { level, window: record.window, class, at })
            }
            _ => None,
        }
    }
}

/// The spans of one level at one step, in the order of its nodes.
type Spans = Arc<Vec<SpanRecord>>;

/// An open store, one variable of which is drawn.
pub struct Session {
    store: Store,
    tree: Arc<Octree>,
    variable: usize,
    bricks: ByteLru<BrickKey, Arc<PreparedBrick>>,
    /// Payloads of several steps: the next step of each is decoded without reading it again.
    payloads: ByteLru<PayloadKey, Arc<Payload>>,
    spans: ByteLru<(u8, u32), Spans>,
    portion_bytes: usize,
    memory_bytes: u64,
}

/// Share of the memory budget that resident bricks may take; the rest is for what is being decoded.
const RESIDENT_SHARE: f64 = 0.5;
/// Share of the memory budget for payloads that later steps need as well.
const PAYLOAD_SHARE: f64 = 0.1;
/// Share of the memory budget that the bricks of one portion of a picture may take.
const PORTION_SHARE: f64 = 0.25;
/// Bytes that a pixel takes while a picture is made: what is gathered, tiles in flight, and the bytes shown.
const BYTES_PER_PIXEL: u64 = 40;
/// Share for the records of spans.
const SPANS_SHARE: f64 = 0.05;

impl Session {
    /// Opens a store to draw a variable of it, the first where none is named.
    ///
    /// # Errors
    /// If the store cannot be opened, has no such variable, or has no finished step yet.
    pub fn open(path: &Path, variable: Option<&str>, memory_bytes: u64) -> anyhow::Result<Self> {
        let store = Store::open(path)?;
        let variable = match variable {
            None => 0,
            Some(name) => store.header().variable(name).with_context(|| {
                let names: Vec<&str> = store.header().variables.iter().map(|v| v.name.as_str()).collect();
                format!("{}: no variable {name:?}; it has {}", path.display(), names.join(", "))
            })?,
        };
        if store.header().num_steps_finished == 0 {
            bail!("{}: no time step is finished yet; finish it with encode --resume", path.display());
        }
        let share = |part: f64| (memory_bytes as f64 * part) as usize;
        Ok(Self {
            tree: Arc::new(store.tree().clone()),
            store,
            variable,
            bricks: ByteLru::new(share(RESIDENT_SHARE)),
            payloads: ByteLru::new(share(PAYLOAD_SHARE)),
            spans: ByteLru::new(share(SPANS_SHARE)),
            portion_bytes: share(PORTION_SHARE),
            memory_bytes,
        })
    }

    /// The store.
    pub fn store(&self) -> &Store {
        &self.store
    }

    /// Index of the variable that is drawn.
    pub fn variable(&self) -> usize {
        self.variable
    }

    /// The range of the variable over the steps that are finished.
    pub fn variable_range(&self) -> [f64; 2] {
        let variable = &self.store.header().variables[self.variable];
        [variable.min.unwrap_or(0.0), variable.max.unwrap_or(0.0)]
    }

    /// A transfer function over the variable's range.
    ///
    /// # Errors
    /// If a point of the function overflows.
    pub fn resolve(&self, transfer: &TransferFunction) -> anyhow::Result<ResolvedTransfer> {
        Ok(transfer.resolve(self.variable_range())?)
    }

    /// How many steps of full resolution stay resident, at least.
    pub fn num_resident_steps(&self) -> usize {
        let brick_bytes = PreparedBrick::estimated_bytes(&self.store.header().bricks);
        let step_bytes = brick_bytes.saturating_mul(self.tree.nodes(0).len());
        (self.memory_bytes as f64 * RESIDENT_SHARE) as usize / step_bytes.max(1)
    }

    /// What the cache of bricks did so far.
    pub fn cache_counts(&self) -> CacheCounts {
        self.bricks.counts()
    }

    /// Bytes of payloads, masks and spans that were read so far.
    pub fn bytes_from_disk(&self) -> u64 {
        self.store.bytes_read()
    }

    /// Draws a step.
    ///
    /// A brick whose bytes are damaged is replaced by its parent, with a warning that names it.
    ///
    /// # Errors
    /// If a step is out of range, the view cannot be drawn, or damage leaves nothing to draw from.
    pub fn draw(&mut self, view: &View, step: usize) -> anyhow::Result<Picture> {
        self.draw_moment(view, Moment::at(step))
    }

    /// Draws a moment at a step or between two. Between steps nothing is kept in memory, and a damaged brick is an error.
    ///
    /// # Errors
    /// As [`Self::draw`].
    pub fn draw_moment(&mut self, view: &View, moment: Moment) -> anyhow::Result<Picture> {
        let num_steps = self.store.header().num_steps_finished as usize;
        let Moment { step, weight } = moment;
        let last = step + usize::from(weight > 0.0);
        if last >= num_steps || !(0.0..1.0).contains(&weight) {
            bail!("step {last} is not in the store: its steps are 0 to {}", num_steps - 1);
        }
        let picture_bytes = view.size[0] as u64 * view.size[1] as u64 * BYTES_PER_PIXEL;
        if picture_bytes > self.memory_bytes {
            let [width, height] = view.size;
            bail!("--size {width}x{height} takes {picture_bytes} bytes, more than --memory allows; raise it");
        }
        let step = step as u32;
        let start = Instant::now();
        let mut faults = Faults::default();
        let items = self.select(view, step, weight, &mut faults)?;
        let mut fetch_ms = start.elapsed().as_secs_f64() * 1e3;

        let scene = self.scene(view);
        let mut frame = Frame::new(&scene, CpuOptions::default())?;
        let mut bricks = BrickCounts::default();
        let mut rest = &items[..];
        while !rest.is_empty() {
            let start = Instant::now();
            let (portion, after) = rest.split_at(self.portion_len(rest));
            rest = after;
            let draws = match weight > 0.0 {
                false => self.fetch(portion, step, &mut bricks, &mut faults)?,
                true => self.fetch_between(portion, step, weight, &mut bricks)?,
            };
            fetch_ms += start.elapsed().as_secs_f64() * 1e3;
            frame.draw(&draws)?;
        }
        let (image, stats) = frame.finish();
        let RenderStats { num_samples, render_ms, .. } = stats;
        Ok(Picture { image, samples: num_samples, bricks, fetch_ms, render_ms, warnings: faults.warnings })
    }
}

impl Session {
    fn scene(&self, view: &View) -> Scene {
        let header = self.store.header();
        Scene {
            grid: header.grid,
            layout: header.bricks,
            camera: view.camera,
            transfer: view.transfer.clone(),
            size: view.size,
            step_voxels: view.step_voxels,
            finest_level: view.level.min(self.store.tree().num_levels() as u8 - 1),
            lighting: view.lighting,
            opacity_unit: view.opacity_unit,
        }
    }

    /// The draw list of a step. Damaged records of a level make the next coarser one stand in.
    fn select(
        &mut self,
        view: &View,
        step: u32,
        weight: f64,
        faults: &mut Faults,
    ) -> anyhow::Result<Vec<DrawItem>> {
        let num_levels = self.store.tree().num_levels() as u8;
        let grid = self.store.header().grid;
        let aspect = view.size[0] as f64 / view.size[1] as f64;
        let volume = ViewVolume::of_camera(&view.camera, aspect, &grid);
        let mut level = view.level.min(num_levels - 1);
        loop {
            let tree = Arc::clone(&self.tree);
            let layout = self.store.header().bricks;
            let selector = Selector { tree: &tree, layout: &layout, grid: &grid, level, view: &volume };
            let list = selector.draw_list(
                |node| match weight > 0.0 {
                    false => self.record(&tree, node, step),
                    true => Ok(record_between(self.records_around(&tree, node, step)?, weight)),
                },
                |range| view.transfer.is_transparent_over(range),
            );
            match list {
                Ok(items) => return Ok(items),
                Err(error) if level + 1 < num_levels => {
                    faults.warn(format!("{error}; drawing level {} instead of {level}", level + 1));
                    level += 1;
                }
                Err(error) => return Err(error).context("no level of the store can be drawn"),
            }
        }
    }

    /// The record of a node at a step.
    fn record(&mut self, tree: &Octree, node: NodeId, step: u32) -> Result<SpanRecord, StoreError> {
        let rank = tree.rank(node).expect("only nodes of the tree are asked for");
        let key = (node.level, step);
        let spans = match self.spans.get(&key) {
            Some(spans) => spans,
            None => {
                let spans = Arc::new(self.store.spans(self.variable, node.level, step)?);
                let num_bytes = spans.len() * size_of::<SpanRecord>();
                self.spans.insert(key, Arc::clone(&spans), num_bytes);
                spans
            }
        };
        Ok(spans[rank])
    }

    /// The records of a node at a step and the next.
    fn records_around(
        &mut self,
        tree: &Octree,
        node: NodeId,
        step: u32,
    ) -> Result<[SpanRecord; 2], StoreError> {
        Ok([self.record(tree, node, step)?, self.record(tree, node, step + 1)?])
    }

    /// Turns items selected between two steps into bricks to draw.
    fn fetch_between(
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
                How::Constant(_) => counts.constant += 1,
                How::Payload => counts.new += 1,
            }
        }
        let (store, variable) = (&self.store, self.variable);
        let draw = |(item, records): (&DrawItem, [SpanRecord; 2])| {
            let how = match item.how {
                How::Skip => DrawHow::Skip,
                How::Constant(value) => DrawHow::Constant(value),
                How::Payload => {
                    let brick = brick_between(store, variable, item.node, records, step, weight)?;
                    DrawHow::Samples(Arc::new(PreparedBrick::new(brick, &store.header().bricks)?))
                }
            };
            Ok(DrawBrick { node: item.node, region: item.region, how })
        };
        items.par_iter().zip(records).map(draw).collect()
    }

    /// How many of the next items fit a portion of the memory budget; at least one.
    fn portion_len(&self, items: &[DrawItem]) -> usize {
        let brick_bytes = PreparedBrick::estimated_bytes(&self.store.header().bricks);
        let mut left = self.portion_bytes;
        let fits = items.iter().take_while(|item| {
            let need = if item.how == How::Payload { brick_bytes } else { 0 };
            let fits = need <= left;
            left = left.saturating_sub(need);
            fits
        });
        fits.count().max(1)
    }

    /// Turns selected items into bricks to draw; what is not resident is read and decoded in parallel.
    fn fetch(
        &mut self,
        items: &[DrawItem],
        step: u32,
        counts: &mut BrickCounts,
        faults: &mut Faults,
    ) -> anyhow::Result<Vec<DrawBrick>> {
        let tree = Arc::clone(&self.tree);
        let mut ready: HashMap<NodeId, Arc<PreparedBrick>> = HashMap::new();
        let mut wanted: Vec<Wanted> = Vec::new();
        for item in items.iter().filter(|item| item.how == How::Payload) {
            let record = self.record(&tree, item.node, step)?;
            let Some(key) = BrickKey::new(item.node.level, &record, step) else { continue };
            match self.bricks.get(&key) {
                Some(brick) => {
                    counts.reused += 1;
                    ready.insert(item.node, brick);
                }
                None => wanted.push(Wanted { node: item.node, record, key }),
            }
        }
        for (wanted, loaded) in self.load(&wanted, step) {
            counts.new += 1;
            let brick = match loaded {
                Ok(brick) => brick,
                Err(error) => {
                    faults.warn(format!("{error}; its parent is drawn instead"));
                    continue;
                }
            };
            self.bricks.insert(wanted.key, Arc::clone(&brick), brick.num_bytes());
            ready.insert(wanted.node, brick);
        }
        items
            .iter()
            .map(|item| {
                let (node, how) = match item.how {
                    How::Skip => (item.node, DrawHow::Skip),
                    How::Constant(value) => (item.node, DrawHow::Constant(value)),
                    How::Payload => match ready.get(&item.node) {
                        Some(brick) => (item.node, DrawHow::Samples(Arc::clone(brick))),
                        None => self.stand_in(&tree, item.node, step, faults)?,
                    },
                };
                match how {
                    DrawHow::Skip => counts.skipped += 1,
                    DrawHow::Constant(_) => counts.constant += 1,
                    _ => {}
                }
                Ok(DrawBrick { node, region: item.region, how })
            })
            .collect()
    }

    /// Reads and decodes bricks: payloads of a level in as few reads as possible, decoding in parallel.
    fn load<'a>(&mut self, wanted: &'a [Wanted], step: u32) -> Vec<(&'a Wanted, Loaded)> {
        let mut loaded = Vec::with_capacity(wanted.len());
        for of_level in wanted.chunk_by(|a, b| a.node.level == b.node.level) {
            let payloads = self.payloads(of_level);
            let (store, variable) = (&self.store, self.variable);
            let prepared = of_level.par_iter().zip(payloads).map(|(w, payload)| {
                let prepare = |p: Option<Arc<Payload>>| prepare(store, variable, w, p.as_deref(), step);
                (w, payload.map_err(Into::into).and_then(prepare))
            });
            loaded.par_extend(prepared);
        }
        loaded
    }

    /// The payloads of bricks of one level: those that another step needed are still there, the others are read.
    fn payloads(&mut self, of_level: &[Wanted]) -> Vec<Result<Option<Arc<Payload>>, StoreError>> {
        let level = of_level[0].node.level;
        let keys: Vec<Option<PayloadKey>> =
            of_level.iter().map(|wanted| PayloadKey::new(level, &wanted.record)).collect();
        let held: Vec<Option<Arc<Payload>>> =
            keys.iter().map(|key| key.and_then(|key| self.payloads.get(&key))).collect();
        let missing: Vec<SpanRecord> =
            of_level.iter().zip(&held).filter(|(_, held)| held.is_none()).map(|(w, _)| w.record).collect();
        let mut read = self.store.read_payloads(self.variable, level, &missing).into_iter();
        let mut payloads = Vec::with_capacity(of_level.len());
        for (key, held) in keys.into_iter().zip(held) {
            let payload = match held {
                Some(payload) => Ok(Some(payload)),
                None => read.next().expect("one for each that is missing").map(|p| p.map(Arc::new)),
            };
            if let (Some(key), Ok(Some(payload))) = (key, &payload) {
                self.payloads.insert(key, Arc::clone(payload), payload_bytes(payload));
            }
            payloads.push(payload);
        }
        payloads
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
                    let wanted = Wanted { node, record, key };
                    let loaded = match self.bricks.get(&key) {
                        Some(brick) => Ok(brick),
                        None => load_brick(&self.store, self.variable, &wanted, step),
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
    record: SpanRecord,
    key: BrickKey,
}

fn load_brick(store: &Store, variable: usize, wanted: &Wanted, step: u32) -> Loaded {
    let payload = match wanted.record.kind {
        SpanKind::Coded { .. } => Some(store.read_payload(variable, wanted.node.level, &wanted.record)?),
        _ => None,
    };
    prepare(store, variable, wanted, payload.as_ref(), step)
}

/// Bytes that a payload takes in memory, but for what is small.
fn payload_bytes(payload: &Payload) -> usize {
    let stage_bytes = |stage: &Stage| {
        let indices = match &stage.indices {
            Indices::U8(indices) => indices.len(),
            Indices::U16(indices) => 2 * indices.len(),
        };
        let entries = match &stage.table {
            Table::Affine { .. } => 0,
            Table::Listed { entries, .. } => 2 * entries.len(),
        };
        size_of::<Stage>() + indices + entries
    };
    size_of::<Payload>() + payload.stages.iter().map(stage_bytes).sum::<usize>()
}

/// Makes a brick ready to be drawn, from its payload or its constant value.
fn prepare(store: &Store, variable: usize, wanted: &Wanted, payload: Option<&Payload>, step: u32) -> Loaded {
    let Wanted { node, record, .. } = wanted;
    let layout = &store.header().bricks;
    let mask = store.read_mask(variable, node.level, record)?;
    let resident = match (payload, record.kind) {
        (Some(payload), _) => decode_resident(payload, layout, step - record.start, mask)?,
        (None, SpanKind::Constant(value)) => constant_brick(value, mask, layout),
        (None, _) => bail!("brick {:?} of level {} has no payload", node.brick(), node.level),
    };
    Ok(Arc::new(PreparedBrick::new(resident, layout)?))
}

fn constant_brick(value: f64, mask: Option<BitMask>, layout: &BrickLayout) -> ResidentBrick {
    ResidentBrick { samples: vec![0; layout.num_full()], offset: value, scale: 0.0, mask }
}

/// Warnings of one picture; a flood of them is cut short.
#[derive(Default)]
struct Faults {
    warnings: Vec<String>,
}

impl Faults {
    const MOST: usize = 20;

    fn warn(&mut self, warning: String) {
        match self.warnings.len() {
            n if n < Self::MOST => self.warnings.push(warning),
            Self::MOST => self.warnings.push("more bricks are damaged; run verify to list them".into()),
            _ => {}
        }
    }
}

/// A camera that shows the whole grid.
///
/// # Errors
/// If an angle, the zoom or the field of view is out of range.
pub fn orbit_camera(
    grid: &UniformGrid,
    angles_deg: [f64; 2],
    zoom: f64,
    fov_y_deg: Option<f64>,
    size: [usize; 2],
) -> anyhow::Result<Camera> {
    let aspect = size[0] as f64 / size[1] as f64;
    Ok(Camera::orbit(grid.bounds(), angles_deg[0], angles_deg[1], zoom, fov_y_deg, aspect)?)
}
