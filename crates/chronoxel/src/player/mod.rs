//! Playing a store that is larger than memory: what to draw, what to have in memory, and what to read ahead are decided by
//! `chronoxel-stream`; this asks it, frame by frame, and does what it says.
//!
//! The thread that draws decides and draws; threads of their own read and decode entropy (`loader`). What is in memory of the store is what the
//! state machine says, at every moment.

mod cells;
mod loader;
mod nodes;
mod path;
mod reading;
mod spans;
mod uploads;
mod wants;

use std::{
    collections::{BTreeMap, HashMap, HashSet},
    sync::Arc,
    time::{Duration, Instant},
};

use anyhow::bail;
use chronoxel_core::{NodeId, SpanRecord};
use chronoxel_render::{GpuPicture, ReadBack};
use chronoxel_stream::{
    ActiveCut, CutLimits, DrawItem, How, NodeView, Pace, Playback, Playhead, Residency, Shown, State,
    ViewVolume,
};

use crate::session::{Faults, HeldKey, Picture, Session, Spans, View};
pub use cells::{CellPlayed, CellPlayer, CellPlayerOptions, DetailPace};
pub use chronoxel_stream::Late;
use loader::Loader;
use nodes::{ColorErrors, FrameNodes, SomeRays, StepSpans, key_of};
pub use path::CameraPath;

/// How to play.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlayerOptions {
    /// Frames per second to hold by drawing coarser bricks where need be; at full quality without.
    pub target_fps: Option<f64>,
    /// What to do about late steps.
    pub late: Late,
    /// The most bytes read per second.
    pub throttle: Option<f64>,
    /// The most bytes sent to the GPU per frame.
    pub upload_limit: Option<u64>,
    /// Draw every frame as if something had changed: for measuring. Else what rests is refined to full quality, and then not drawn again.
    pub redraws: bool,
    /// What comes back of pictures.
    pub read_back: ReadBack,
    /// Whether playing starts over at the end: else nothing is read ahead beyond it.
    pub loops: bool,
}

impl Default for PlayerOptions {
    fn default() -> Self {
        Self {
            target_fps: None,
            late: Late::Wait,
            throttle: None,
            upload_limit: None,
            redraws: false,
            read_back: ReadBack::Floats,
            loops: true,
        }
    }
}

/// A frame that was played.
#[derive(Debug, Clone)]
pub struct Played {
    /// What it shows. `None` where nothing changed since the one before, and nothing was drawn.
    pub picture: Option<Picture<GpuPicture>>,
    /// Its place in the order of play.
    pub place: usize,
    /// Steps left out since playing began, because there was no time to load them.
    pub num_dropped: u64,
    /// Whether the step of the frame before is shown again, because the next one is not there.
    pub is_late: bool,
    /// Time that drawing waited for data.
    pub wait_ms: f64,
    /// Payloads that it needed and that were in memory when it began.
    pub hits: u64,
    /// Payloads that were not.
    pub misses: u64,
    /// Boxes for which a coarser brick stood in because their own was not there.
    pub num_stand_ins: usize,
    /// Nodes on the active cut, and those of them that are drawn from samples.
    pub num_nodes: usize,
    /// Of these.
    pub num_drawn: usize,
    /// Of these, those that are coarser than was asked for, and would look different finer.
    pub num_coarse: usize,
    /// What drawing them was expected to cost: samples along rays, and a quarter of those to decode.
    pub expected_cost: f64,
    /// Mean edge of a voxel in pixels over the nodes that are drawn.
    pub pixels_per_voxel: f64,
    /// The largest of them.
    pub most_pixels_per_voxel: f64,
    /// Whether more work would not change the picture while nothing else changes.
    pub is_settled: bool,
}

/// Threads that read: one reads while another decodes.
const NUM_LOADERS: usize = 2;
/// Payloads asked for at once.
const MOST_IN_FLIGHT: usize = 64;
/// Payloads read in one go.
const BATCH: usize = 16;
/// Part of the time of a frame that is aimed for: frames vary, and most are to be in time.
const AIM: f64 = 0.92;
/// Part of the memory for payloads that the coarsest level of all steps may take.
const COARSE_SHARE: f64 = 0.15;
/// Part of the memory for payloads that those of one picture may take: the rest is for what comes next.
const CUT_SHARE: f64 = 0.7;
/// Most steps that are read ahead.
const MOST_AHEAD: usize = 64;
/// How long to listen for an answer before looking whether one can still come.
const PATIENCE: Duration = Duration::from_millis(200);
/// Steps of the coarsest level whose spans are asked for in one frame.
const COARSE_STEPS_PER_FRAME: usize = 8;

/// A player of one variable of a store.
pub struct Player {
    session: Session,
    loader: Loader,
    residency: Residency<HeldKey>,
    cut: ActiveCut,
    pace: Option<Pace>,
    options: PlayerOptions,
    /// Steps in the order of play; it starts over when it is over.
    order: Vec<u32>,
    /// Spans in memory, by step and level.
    spans: HashMap<(u32, u8), Spans>,
    /// Spans that a thread reads.
    spans_asked: HashSet<(u32, u8)>,
    /// Spans that cannot be read: drawing finds out why.
    spans_failed: HashSet<(u32, u8)>,
    num_ahead: usize,
    coarse_asked: usize,
    wanted: HashMap<HeldKey, SpanRecord>,
    errors: Option<ColorErrors>,
    before: Option<(View, u32, bool)>,
    place: Option<usize>,
    playback: Playback,
    warnings: Vec<String>,
    /// Bytes of payloads sent to the GPU for the last frame, under a limit; and of all else.
    payload_upload: u64,
    upload_overhead: u64,
}

impl Player {
    /// A player of the steps `order` of a session's store. What the session had in memory is forgotten; back ends are chosen before.
    ///
    /// # Errors
    /// If there are no steps, or one that is not finished, or the system gives no threads.
    pub fn new(mut session: Session, order: Vec<u32>, options: PlayerOptions) -> anyhow::Result<Self> {
        let store = Arc::clone(session.store_shared());
        let num_steps = store.header().num_steps_finished;
        let Some(last) = order.iter().max() else { bail!("there are no steps to play") };
        anyhow::ensure!(
            options.throttle.is_none_or(|rate| rate >= 1.0),
            "--throttle 0: nothing would ever be read; allow at least a byte per second"
        );
        anyhow::ensure!(
            *last < num_steps,
            "step {last} is not in the store: its steps are 0 to {}",
            num_steps - 1
        );
        let num_steps = order.len() as u32;
        let head = Playhead { num_steps, position: 0.0, steps_per_frame: 1.0, is_looping: options.loops };
        let budgets = session.lend_memory();
        let tree = store.tree();
        let num_nodes: usize = (0..tree.num_levels()).map(|level| tree.nodes(level as u8).len()).sum();
        let bytes_per_step = num_nodes * size_of::<SpanRecord>();
        let num_ahead = (budgets.spans_bytes / bytes_per_step.max(1)).saturating_sub(2).clamp(2, MOST_AHEAD);
        let coarse_bytes = (budgets.payload_bytes as f64 * COARSE_SHARE) as usize;
        Ok(Self {
            loader: Loader::new(Arc::clone(&store), session.variable(), NUM_LOADERS, options.throttle)?,
            residency: Residency::new(budgets.payload_bytes, coarse_bytes, MOST_IN_FLIGHT),
            cut: ActiveCut::new(tree, &store.header().grid, store.layout()),
            pace: options.target_fps.map(|fps| Pace::new(AIM * 1e3 / fps)),
            num_ahead: num_ahead.min(order.len()),
            session,
            options,
            order,
            spans: HashMap::new(),
            spans_asked: HashSet::new(),
            spans_failed: HashSet::new(),
            coarse_asked: 0,
            wanted: HashMap::new(),
            errors: None,
            before: None,
            place: None,
            playback: Playback::new(head, options.late),
            warnings: Vec::new(),
            payload_upload: 0,
            upload_overhead: 0,
        })
    }

    /// The session that draws.
    pub fn session(&self) -> &Session {
        &self.session
    }

    /// The most bytes that payloads took at once, and those that they may take.
    pub fn payload_bytes(&self) -> [usize; 2] {
        [self.residency.peak_bytes(), self.residency.budget_bytes()]
    }

    /// Goes back to before the first frame; what is in memory stays.
    pub fn rewind(&mut self) {
        self.place = None;
        self.playback.set_head(Playhead { position: 0.0, ..self.playback.head() });
    }

    /// Plays the next frame.
    ///
    /// # Errors
    /// If the view cannot be drawn, or damage leaves nothing to draw from.
    pub fn next(&mut self, view: &View) -> anyhow::Result<Played> {
        let Some(place) = self.place else { return self.frame(view, 0) };
        match self.options.late {
            Late::Wait => self.frame(view, place + 1),
            Late::Drop => {
                self.listen();
                let mut playback = self.playback;
                let shown = playback.advance(&mut |place| self.is_ready(view, place as usize));
                self.playback = playback;
                let played = self.frame(view, playback.step() as usize)?;
                Ok(Played { is_late: shown == Shown::Late, ..played })
            }
        }
    }

    /// Plays the frame at a place in the order of play, which goes on from there: for dragging a time slider, or standing still.
    ///
    /// # Errors
    /// As [`Self::next`].
    pub fn frame(&mut self, view: &View, place: usize) -> anyhow::Result<Played> {
        let step = self.step_at(place);
        let num_dropped = self.playback.num_dropped();
        if self.playback.step() as usize != place % self.order.len() {
            self.playback
                .set_head(Playhead { position: (place % self.order.len()) as f64, ..self.playback.head() });
        }
        self.place = Some(place);
        self.listen();
        let mut waited = Waited::default();
        let spans = self.spans_of(place, &mut waited)?;
        let is_as_before = |(before, at, _): &(View, u32, bool)| *at == step && before == view;
        let is_at_rest = !self.options.redraws && self.before.as_ref().is_some_and(is_as_before);
        if is_at_rest && self.before.as_ref().is_some_and(|(.., is_settled)| *is_settled) {
            return Ok(Played { picture: None, place, num_dropped, is_settled: true, ..Played::nothing() });
        }
        let adapted = self.adapt(view, &spans, is_at_rest);
        let mut faults = Faults::default();
        self.warnings.drain(..).for_each(|warning| faults.warn(warning));
        let items = self.session.select(view, step, 0.0, &mut faults, Some(&self.cut))?;
        let needed = self.needed(&items);
        let [hits, misses] = self.count(&needed);
        self.want(view, place, &spans, &needed, (&adapted.wanted, is_at_rest));
        self.request();
        self.wait_for(&needed, place, &mut waited)?;
        // What failed, or does not fit, will not come.
        let [_, num_late] = self.count(&needed);
        let is_all_there = num_late == 0 || self.residency.num_in_flight() == 0;
        let (mut items, num_missing) = self.with_stand_ins(items, step);
        let num_unsent = match self.options.upload_limit {
            Some(limit) => self.limit_uploads(&mut items, place, limit)?,
            None => 0,
        };
        let start = Instant::now();
        let picture =
            self.session.draw_selected(view, (step, 0.0), &items, self.options.read_back, faults)?;
        if let Some(pace) = &mut self.pace {
            pace.measured(start.elapsed().as_secs_f64() * 1e3 + adapted.ms, adapted.cost);
        }
        if let Some(on_gpu) = picture.on_gpu {
            self.upload_overhead = on_gpu.bytes_uploaded.saturating_sub(self.payload_upload);
        }
        let is_refined = is_at_rest || self.pace.is_none();
        let is_settled = adapted.is_settled && is_refined && is_all_there && num_unsent == 0;
        self.before = Some((view.clone(), step, is_settled));
        Ok(Played {
            picture: Some(picture),
            place,
            num_dropped,
            is_late: false,
            wait_ms: waited.ms,
            hits,
            misses,
            num_stand_ins: num_missing + num_unsent,
            num_nodes: adapted.num_nodes,
            num_drawn: adapted.num_drawn,
            num_coarse: adapted.num_coarse,
            expected_cost: adapted.cost,
            pixels_per_voxel: adapted.pixels_per_voxel,
            most_pixels_per_voxel: adapted.most_pixels_per_voxel,
            is_settled,
        })
    }

    fn step_at(&self, place: usize) -> u32 {
        self.order[place % self.order.len()]
    }

    /// Places whose steps will be shown next, nearest first.
    fn coming(&self, place: usize) -> Vec<usize> {
        match self.options.late {
            Late::Wait => {
                let end = if self.options.loops { usize::MAX } else { self.order.len() };
                (1..=self.num_ahead)
                    .map(|distance| place + distance)
                    .take_while(|place| *place < end)
                    .collect()
            }
            Late::Drop => {
                let coming = self.playback.coming(self.num_ahead as u32);
                coming.into_iter().skip(1).map(|(place, _)| place as usize).collect()
            }
        }
    }

    /// Whether everything that a frame needs is in memory.
    fn is_ready(&mut self, view: &View, place: usize) -> bool {
        let step = self.step_at(place);
        let Some(of_levels) = self.spans_in_memory(step) else { return false };
        let spans = StepSpans::new(self.session.tree(), of_levels);
        let Self { session, residency, errors, cut, .. } = self;
        let Some(errors) = errors else { return false };
        let volume = session.view_volume(view);
        let rays = SomeRays::of(view);
        let mut nodes = frame_nodes(session, view, &volume, &spans, residency, errors, &rays);
        drawn_nodes(cut).all(|node| nodes.is_resident(node))
    }
}

/// What adapting the cut found.
struct Adapted {
    wanted: Vec<NodeId>,
    cost: f64,
    num_nodes: usize,
    num_drawn: usize,
    num_coarse: usize,
    pixels_per_voxel: f64,
    most_pixels_per_voxel: f64,
    is_settled: bool,
    ms: f64,
}

/// Time spent waiting.
#[derive(Default)]
struct Waited {
    ms: f64,
}

impl Played {
    fn nothing() -> Self {
        Self {
            picture: None,
            place: 0,
            num_dropped: 0,
            is_late: false,
            wait_ms: 0.0,
            hits: 0,
            misses: 0,
            num_stand_ins: 0,
            num_nodes: 0,
            num_drawn: 0,
            num_coarse: 0,
            expected_cost: 0.0,
            pixels_per_voxel: 0.0,
            most_pixels_per_voxel: 0.0,
            is_settled: false,
        }
    }
}

fn frame_nodes<'a>(
    session: &'a Session,
    view: &'a View,
    volume: &'a ViewVolume,
    spans: &'a StepSpans,
    residency: &'a Residency<HeldKey>,
    errors: &'a mut ColorErrors,
    rays: &'a SomeRays,
) -> FrameNodes<'a> {
    let store = session.store();
    FrameNodes {
        tree: store.tree(),
        store,
        variable: session.variable(),
        grid: &store.header().grid,
        layout: store.layout(),
        view,
        volume,
        spans,
        next: None,
        residency,
        errors,
        rays,
        assumes_resident: false,
    }
}

/// Nodes of which something is drawn: those on the cut, and those that children are missing of.
fn drawn_nodes(cut: &ActiveCut) -> impl Iterator<Item = NodeId> + '_ {
    cut.nodes().chain(cut.partial_nodes())
}

/// The cut and what it needs.
impl Player {
    fn adapt(&mut self, view: &View, spans: &StepSpans, is_at_rest: bool) -> Adapted {
        let start = Instant::now();
        if !self.errors.as_ref().is_some_and(|errors| errors.fits(view)) {
            self.errors = Some(ColorErrors::new(view, self.session.variable_range()));
        }
        let next =
            self.place.and_then(|place| self.spans_in_memory(self.step_at(*self.coming(place).first()?)));
        let Self { session, residency, errors, cut, pace, .. } = self;
        let volume = session.view_volume(view);
        let tree = session.store().tree();
        let errors = errors.as_mut().expect("made above");
        let rays = SomeRays::of(view);
        let mut nodes = FrameNodes {
            next: next.as_deref().filter(|_| !is_at_rest),
            // What is missing at full quality is waited for, or stood in for.
            assumes_resident: pace.is_none(),
            ..frame_nodes(session, view, &volume, spans, residency, errors, &rays)
        };
        let limits = CutLimits {
            cost: pace.as_ref().filter(|_| !is_at_rest).map_or(f64::INFINITY, Pace::cost_limit),
            bytes: (residency.budget_bytes() as f64 * CUT_SHARE) as usize,
            finest_level: view.level,
            most_splits_per_frame: if pace.is_none() { usize::MAX } else { MOST_SPLITS },
        };
        let change = cut.adapt(tree, &limits, &mut nodes);
        let (mut cost, mut num_nodes, mut num_drawn, mut num_coarse) = (0.0, 0, 0, 0);
        let has_children = |node: NodeId| {
            (0..8).filter_map(|octant| node.child(octant)).any(|child| tree.rank(child).is_some())
        };
        for node in cut.nodes().filter(|node| node.level > view.level && has_children(*node)) {
            num_coarse += usize::from(nodes.error(node) > 0.0);
        }
        let (mut pixels, mut most_pixels) = (0.0, 0.0f64);
        for node in drawn_nodes(cut) {
            num_nodes += 1;
            if nodes.drawn(node).is_some() {
                num_drawn += 1;
                cost += nodes.cost(node);
                let of_node = nodes.pixels_per_voxel(node);
                pixels += of_node;
                most_pixels = most_pixels.max(of_node);
            }
        }
        Adapted {
            wanted: change.wanted,
            cost,
            num_nodes,
            num_drawn,
            num_coarse,
            pixels_per_voxel: pixels / f64::from(num_drawn.max(1) as u32),
            most_pixels_per_voxel: most_pixels,
            is_settled: change.is_settled,
            ms: start.elapsed().as_secs_f64() * 1e3,
        }
    }

    /// What must be in memory to draw a list.
    fn needed(&mut self, items: &[DrawItem]) -> BTreeMap<HeldKey, SpanRecord> {
        let tree = Arc::clone(self.session.tree());
        let mut needed = BTreeMap::new();
        for item in items.iter().filter(|item| item.how == How::Payload) {
            // Records that cannot be read are dealt with in drawing.
            let Ok(record) = self.session.record(&tree, item.node, item.steps.start) else { continue };
            if let Some(key) = key_of(item.node.level, &record) {
                needed.insert(key, record);
            }
        }
        needed
    }

    fn count(&self, needed: &BTreeMap<HeldKey, SpanRecord>) -> [u64; 2] {
        let hits = needed.keys().filter(|key| self.residency.state(key) == State::Resident).count() as u64;
        [hits, needed.len() as u64 - hits]
    }
}

/// Most splits of the cut in a frame with a target.
const MOST_SPLITS: usize = 64;
