//! A store opened for drawing: from a view and a step to a picture.
//!
//! For each picture: select the nodes to draw, fetch what is not resident, draw front to back. Bricks stay resident
//! over a budget of bytes; where the bricks of one picture exceed it, they are drawn in portions, so
//! that a volume of any size can be drawn at full resolution.

mod borders;
mod bricks;
mod cells;
mod gpu;
mod held;
mod images;
mod reference;
mod select;

use std::{collections::HashMap, path::Path, sync::Arc, time::Instant};

use anyhow::{Context, bail};
use chronoxel_core::{
    ByteImage, ByteLru, CacheCounts, Camera, Image, Lighting, NodeStatistics, Octree, ResolvedTransfer,
    SpanRecord, TimeNode, TransferFunction, UniformGrid,
};
use chronoxel_render::{
    CpuOptions, Frame, GpuPicture, GpuStats, PreparedBrick, ReadBack, RenderStats, Scene,
};
use chronoxel_store::Store;
use chronoxel_stream::{DrawItem, How, Shares, Tolerances};

use bricks::BrickKey;
pub use cells::{CellPicture, CellSession, CellShot, Importance};
pub(crate) use cells::{StepValues, decode_into, warning_of};
use gpu::{GpuShot, OnGpu};
pub(crate) use held::{Held, HeldKey, read_held};
use images::Images;
use select::Colors;
pub use select::{CoherenceView, Metric};

/// What a picture shows, but for the step.
#[derive(Debug, Clone, PartialEq)]
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
    /// Coherence in space and time to make use of; without it each step is drawn by itself.
    pub coherence: Option<CoherenceView>,
    /// How bricks of different levels meet.
    pub level_borders: LevelBorders,
}

/// How bricks of different levels meet, in stores with an adaptive tree and where a player draws some parts finer than others.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LevelBorders {
    /// Each as it interpolates its own samples.
    #[default]
    Sharp,
    /// Without a jump: the finer takes the values of the coarser on what they share. On the CPU.
    Filtered,
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
    /// Composited from partial images that were kept.
    pub composited: usize,
    /// Drawn from memory.
    pub reused: usize,
    /// Read and decoded for this picture.
    pub new: usize,
}

impl BrickCounts {
    fn add(&mut self, other: &Self) {
        self.skipped += other.skipped;
        self.constant += other.constant;
        self.composited += other.composited;
        self.reused += other.reused;
        self.new += other.new;
    }

    /// Bricks that were drawn.
    pub fn drawn(&self) -> usize {
        self.constant + self.composited + self.reused + self.new
    }
}

/// A picture, and what it took.
#[derive(Debug, Clone)]
pub struct Picture<I = Image> {
    /// The volume over nothing.
    pub image: I,
    /// Samples taken, transparent space left out.
    pub samples: u64,
    /// Bricks by what became of them.
    pub bricks: BrickCounts,
    /// Samples of the grid by how they are drawn.
    pub shares: Shares,
    /// Time to select, read and decode, in milliseconds.
    pub fetch_ms: f64,
    /// Time to draw, in milliseconds.
    pub render_ms: f64,
    /// What the GPU did, where one drew.
    pub on_gpu: Option<GpuStats>,
    /// What went wrong and was made up for: each names the brick.
    pub warnings: Vec<String>,
}

/// The spans of one level at one step, in the order of its nodes.
pub(crate) type Spans = Arc<Vec<SpanRecord>>;

/// An open store, one variable of which is drawn.
pub struct Session {
    store: Arc<Store>,
    tree: Arc<Octree>,
    variable: usize,
    bricks: ByteLru<BrickKey, Arc<PreparedBrick>>,
    /// Payloads of several steps: the next step of each is decoded without reading it again.
    payloads: ByteLru<HeldKey, Held>,
    /// What a player has in memory: it comes before [`Self::payloads`].
    given: HashMap<HeldKey, Held>,
    /// Spans that were read because they were not in memory.
    num_read: u64,
    spans: ByteLru<(u8, u32), Spans>,
    statistics: ByteLru<TimeNode, Arc<Vec<NodeStatistics>>>,
    colors: Colors,
    images: Images,
    on_gpu: Option<OnGpu>,
    portion_bytes: usize,
    memory_bytes: u64,
}

/// Share of the memory budget that resident bricks may take; the rest is for what is being decoded.
const RESIDENT_SHARE: f64 = 0.45;
/// Share of the memory budget for payloads that later steps need as well.
const PAYLOAD_SHARE: f64 = 0.1;
/// Share of the memory budget that the bricks of one portion of a picture may take.
const PORTION_SHARE: f64 = 0.2;
/// Bytes that a pixel takes while a picture is made: what is gathered, tiles in flight, and the bytes shown.
const BYTES_PER_PIXEL: u64 = 40;
/// Share for the records of spans, and for the statistics of time nodes.
const SPANS_SHARE: f64 = 0.05;
/// Share of payloads where a player decides what is in memory, with a GPU to draw.
const PLAYED_ON_GPU_SHARE: f64 = 0.65;
/// The same without.
const PLAYED_SHARE: f64 = 0.45;
/// Share of bricks ready to be drawn, and of those of one portion of a picture, there.
const PLAYED_BRICKS_SHARE: f64 = 0.15;
/// Share for what the store keeps of its indexes.
const STORE_SHARE: f64 = 0.1;

impl Session {
    /// Opens a store to draw a variable of it, the first where none is named.
    ///
    /// # Errors
    /// If the store cannot be opened, has no such variable, or has no finished step yet.
    pub fn open(path: &Path, variable: Option<&str>, memory_bytes: u64) -> anyhow::Result<Self> {
        let share = |part: f64| (memory_bytes as f64 * part) as usize;
        let store = Arc::new(Store::open_within(path, share(STORE_SHARE))?);
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
        Ok(Self {
            tree: Arc::new(store.tree().clone()),
            store,
            variable,
            bricks: ByteLru::new(share(RESIDENT_SHARE)),
            payloads: ByteLru::new(share(PAYLOAD_SHARE)),
            given: HashMap::new(),
            num_read: 0,
            spans: ByteLru::new(share(SPANS_SHARE)),
            statistics: ByteLru::new(share(SPANS_SHARE)),
            colors: Colors::default(),
            images: Images::new(0),
            on_gpu: None,
            portion_bytes: share(PORTION_SHARE),
            memory_bytes,
        })
    }

    /// Keeps partial images of what does not change while the view stands still, up to so many bytes; none are kept without.
    ///
    /// A picture that is composited from them differs from one that is drawn by less than a level of 8 bits.
    pub fn keep_images(&mut self, budget_bytes: u64) {
        self.images = Images::new(usize::try_from(budget_bytes).unwrap_or(usize::MAX));
    }

    /// The most bytes that partial images took so far in this view.
    pub fn image_bytes_peak(&self) -> usize {
        self.images.peak_bytes()
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

    /// Forgets all bricks and payloads: the next picture reads and decodes them anew. What is known of colours stays.
    pub fn forget_bricks(&mut self) {
        let share = |part: f64| (self.memory_bytes as f64 * part) as usize;
        self.bricks = ByteLru::new(share(RESIDENT_SHARE));
        self.payloads = ByteLru::new(share(PAYLOAD_SHARE));
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

    /// Draws a moment at a step or between two. Between steps the CPU keeps nothing in memory, and a damaged brick is an
    /// error.
    ///
    /// # Errors
    /// As [`Self::draw`].
    pub fn draw_moment(&mut self, view: &View, moment: Moment) -> anyhow::Result<Picture> {
        let picture = self.draw_as(view, moment, ReadBack::Floats)?;
        Ok(picture.map(|image| match image {
            GpuPicture::Floats(image) => image,
            _ => unreachable!("floats were asked for"),
        }))
    }

    /// Draws a moment for a screen, in 8 bits: from a GPU, a quarter of the bytes come back.
    ///
    /// # Errors
    /// As [`Self::draw`].
    pub fn draw_bytes(&mut self, view: &View, moment: Moment) -> anyhow::Result<Picture<ByteImage>> {
        let picture = self.draw_as(view, moment, ReadBack::Bytes)?;
        Ok(picture.map(|image| match image {
            GpuPicture::Bytes(image) => image,
            _ => unreachable!("bytes were asked for"),
        }))
    }

    /// Draws a moment that nobody looks at: on a GPU the picture stays there.
    ///
    /// # Errors
    /// As [`Self::draw`].
    pub fn draw_unseen(&mut self, view: &View, moment: Moment) -> anyhow::Result<Picture<()>> {
        Ok(self.draw_as(view, moment, ReadBack::Nothing)?.map(|_| ()))
    }

    fn draw_as(
        &mut self,
        view: &View,
        moment: Moment,
        read_back: ReadBack,
    ) -> anyhow::Result<Picture<GpuPicture>> {
        let num_steps = self.store.header().num_steps_finished as usize;
        let Moment { step, weight } = moment;
        let last = step + usize::from(weight > 0.0);
        if last >= num_steps || !(0.0..1.0).contains(&weight) {
            bail!("step {last} is not in the store: its steps are 0 to {}", num_steps - 1);
        }
        if weight > 0.0 && view.coherence.is_some_and(|c| c.tolerances != Tolerances::default()) {
            bail!("tolerances are for steps: give none with --blend-steps, which draws between two");
        }
        let picture_bytes = view.size[0] as u64 * view.size[1] as u64 * BYTES_PER_PIXEL;
        if picture_bytes > self.memory_bytes {
            let [width, height] = view.size;
            bail!("--size {width}x{height} takes {picture_bytes} bytes, more than --memory allows; raise it");
        }
        anyhow::ensure!(
            view.level_borders == LevelBorders::Sharp || self.on_gpu.is_none(),
            "levels are filtered at their borders on the CPU: take --backend cpu, or --level-borders sharp"
        );
        let start = Instant::now();
        let mut faults = Faults::default();
        let items = self.select(view, step as u32, weight, &mut faults, None)?;
        let select_ms = start.elapsed().as_secs_f64() * 1e3;
        let picture = self.draw_selected(view, (step as u32, weight), &items, read_back, faults)?;
        Ok(Picture { fetch_ms: picture.fetch_ms + select_ms, ..picture })
    }

    /// Draws a draw list of a moment.
    pub(crate) fn draw_selected(
        &mut self,
        view: &View,
        (step, weight): (u32, f64),
        items: &[DrawItem],
        read_back: ReadBack,
        faults: Faults,
    ) -> anyhow::Result<Picture<GpuPicture>> {
        let shares = Shares::of(items, step, &self.store.header().grid);
        let drawn = match self.on_gpu {
            Some(_) => self.draw_on_gpu(GpuShot { view, items, step, weight, read_back }, faults)?,
            None => {
                let drawn = self.draw_on_cpu(view, step, weight, items, faults)?;
                drawn.map(|image| match read_back {
                    ReadBack::Floats => GpuPicture::Floats(image),
                    ReadBack::Bytes => GpuPicture::Bytes(image.to_bytes()),
                    ReadBack::Nothing => GpuPicture::Nothing,
                })
            }
        };
        let Drawn { image, bricks, faults, samples, fetch_ms, render_ms, on_gpu } = drawn;
        let warnings = faults.warnings;
        Ok(Picture { image, samples, bricks, shares, fetch_ms, render_ms, on_gpu, warnings })
    }
}

/// What of the memory is for a player to fill.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Lent {
    /// For payloads and masks.
    pub payload_bytes: usize,
    /// For the records of spans.
    pub spans_bytes: usize,
}

/// For a player, which decides what is in memory.
impl Session {
    pub(crate) fn store_shared(&self) -> &Arc<Store> {
        &self.store
    }

    pub(crate) fn tree(&self) -> &Arc<Octree> {
        &self.tree
    }

    /// Gives up keeping payloads, and most of keeping bricks: says how much a player may keep instead.
    pub(crate) fn lend_memory(&mut self) -> Lent {
        let memory_bytes = self.memory_bytes as f64;
        let share = |part: f64| (memory_bytes * part) as usize;
        let [bricks, portion, payloads] = match self.on_gpu {
            Some(_) => [0.0, 0.0, PLAYED_ON_GPU_SHARE],
            None => [PLAYED_BRICKS_SHARE, PLAYED_BRICKS_SHARE, PLAYED_SHARE],
        };
        self.bricks = ByteLru::new(share(bricks));
        self.portion_bytes = share(portion);
        self.payloads = ByteLru::new(0);
        self.keep_no_payloads_for_gpu();
        Lent { payload_bytes: share(payloads), spans_bytes: share(SPANS_SHARE) }
    }

    /// Keeps what is stored of a span until it is taken back.
    pub(crate) fn give(&mut self, key: HeldKey, held: Held) {
        self.given.insert(key, held);
    }

    pub(crate) fn take_back(&mut self, key: &HeldKey) {
        self.given.remove(key);
    }

    pub(crate) fn has(&self, key: &HeldKey) -> bool {
        self.given.contains_key(key)
    }

    /// Spans of a step, level by level, as far as they are known.
    pub(crate) fn give_spans(&mut self, of_levels: &[Option<Spans>], step: u32) {
        for (level, spans) in of_levels.iter().enumerate() {
            if let Some(spans) = spans {
                let num_bytes = spans.len() * size_of::<SpanRecord>();
                self.spans.insert((level as u8, step), Arc::clone(spans), num_bytes);
            }
        }
    }

    /// Spans that drawing itself had to read, because nobody had given them.
    pub fn num_read_in_drawing(&self) -> u64 {
        self.num_read
    }
}

impl<I> Picture<I> {
    fn map<J>(self, change: impl FnOnce(I) -> J) -> Picture<J> {
        let Self { image, samples, bricks, shares, fetch_ms, render_ms, on_gpu, warnings } = self;
        Picture { image: change(image), samples, bricks, shares, fetch_ms, render_ms, on_gpu, warnings }
    }
}

/// A picture that was drawn, and what it took.
struct Drawn<I> {
    image: I,
    bricks: BrickCounts,
    faults: Faults,
    samples: u64,
    fetch_ms: f64,
    render_ms: f64,
    on_gpu: Option<GpuStats>,
}

impl<I> Drawn<I> {
    fn map<J>(self, change: impl FnOnce(I) -> J) -> Drawn<J> {
        let Self { image, bricks, faults, samples, fetch_ms, render_ms, on_gpu } = self;
        Drawn { image: change(image), bricks, faults, samples, fetch_ms, render_ms, on_gpu }
    }
}

/// A picture being drawn.
struct Drawing<'a> {
    frame: Frame<'a>,
    bricks: BrickCounts,
    faults: Faults,
    fetch_ms: f64,
}

impl Session {
    fn draw_on_cpu(
        &mut self,
        view: &View,
        step: u32,
        weight: f64,
        items: &[DrawItem],
        faults: Faults,
    ) -> anyhow::Result<Drawn<Image>> {
        let scene = self.scene(view);
        let mut drawing = Drawing {
            frame: Frame::new(&scene, CpuOptions::default())?,
            bricks: BrickCounts::default(),
            faults,
            fetch_ms: 0.0,
        };
        if view.level_borders == LevelBorders::Filtered {
            self.draw_filtered(items, step, weight, &mut drawing)?;
        } else if self.images.are_kept() && weight == 0.0 {
            self.draw_parts(view, step, items, &mut drawing)?;
        } else {
            self.draw_items(items, step, weight, &mut drawing)?;
        }
        let Drawing { frame, bricks, faults, fetch_ms } = drawing;
        let (image, RenderStats { num_samples: samples, render_ms, .. }) = frame.finish();
        Ok(Drawn { image, bricks, faults, samples, fetch_ms, render_ms, on_gpu: None })
    }

    /// Draws a part of a draw list, in portions that fit the memory.
    fn draw_items(
        &mut self,
        items: &[DrawItem],
        step: u32,
        weight: f64,
        drawing: &mut Drawing<'_>,
    ) -> anyhow::Result<()> {
        let mut rest = items;
        while !rest.is_empty() {
            let start = Instant::now();
            let num_payloads = rest.iter().map(|item| usize::from(item.how == How::Payload));
            let (portion, after) = rest.split_at(self.num_in_portion(num_payloads));
            rest = after;
            let draws = match weight > 0.0 {
                false => self.fetch(portion, &mut drawing.bricks, &mut drawing.faults)?,
                true => self.fetch_between(portion, step, weight, &mut drawing.bricks)?,
            };
            drawing.fetch_ms += start.elapsed().as_secs_f64() * 1e3;
            drawing.frame.draw(&draws)?;
        }
        Ok(())
    }

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
}

/// Warnings of one picture; a flood of them is cut short.
#[derive(Default)]
pub(crate) struct Faults {
    warnings: Vec<String>,
}

impl Faults {
    const MOST: usize = 20;

    pub(crate) fn warn(&mut self, warning: String) {
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
    orbit_camera_of(grid.bounds(), angles_deg, zoom, fov_y_deg, size)
}

/// As [`orbit_camera`], around a box.
///
/// # Errors
/// As [`orbit_camera`].
pub fn orbit_camera_of(
    bounds: [[f64; 3]; 2],
    angles_deg: [f64; 2],
    zoom: f64,
    fov_y_deg: Option<f64>,
    size: [usize; 2],
) -> anyhow::Result<Camera> {
    let aspect = size[0] as f64 / size[1] as f64;
    Ok(Camera::orbit(bounds, angles_deg[0], angles_deg[1], zoom, fov_y_deg, aspect)?)
}
