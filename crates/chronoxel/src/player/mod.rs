//! Playing a store that is larger than memory: what to draw, what to have in memory, and what to read ahead are decided by
//! `chronoxel-stream`; this asks it, frame by frame, and does what it says.
//!
//! The thread that draws decides and draws; threads of their own read and decode entropy (`loader`). What is in memory of the store is what the
//! state machine says, at every moment.

mod loader;
mod nodes;
mod path;

use std::{
    collections::{BTreeMap, HashMap, HashSet},
    sync::Arc,
    time::{Duration, Instant},
};

use anyhow::bail;
use chronoxel_core::{NodeId, Octree, SpanKind, SpanRecord};
use chronoxel_stream::{
    ActiveCut, CutLimits, DrawItem, How, NodeView, Pace, Residency, State, Tier, ViewVolume, Want,
};

use crate::session::{Faults, Held, HeldKey, Picture, Session, Spans, View};
use loader::{Answer, Job, Loader};
use nodes::{ColorErrors, FrameNodes, StepSpans, key_of};
pub use path::CameraPath;

/// What to do about a step whose data is not there in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Late {
    /// Leave it out, and go on with one that is there.
    Drop,
    /// Wait for it: every step is shown.
    Wait,
}

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
}

impl Default for PlayerOptions {
    fn default() -> Self {
        Self { target_fps: None, late: Late::Wait, throttle: None, upload_limit: None, redraws: false }
    }
}

/// A frame that was played.
#[derive(Debug, Clone)]
pub struct Played {
    /// What it shows. `None` where nothing changed since the one before, and nothing was drawn.
    pub picture: Option<Picture>,
    /// Its place in the order of play.
    pub place: usize,
    /// Steps left out between the frame before and this one.
    pub num_dropped: usize,
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
    /// Mean edge of a voxel in pixels over the nodes that are drawn.
    pub pixels_per_voxel: f64,
    /// Whether more work would not change the picture while nothing else changes.
    pub is_settled: bool,
}

/// Threads that read: one reads while another decodes.
const NUM_LOADERS: usize = 2;
/// Payloads asked for at once.
const MOST_IN_FLIGHT: usize = 64;
/// Payloads read in one go.
const BATCH: usize = 16;
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
    warnings: Vec<String>,
    started: Instant,
    num_frames: u64,
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
            *last < num_steps,
            "step {last} is not in the store: its steps are 0 to {}",
            num_steps - 1
        );
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
            pace: options.target_fps.map(|fps| Pace::new(1e3 / fps)),
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
            warnings: Vec::new(),
            started: Instant::now(),
            num_frames: 0,
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
        self.num_frames = 0;
    }

    /// Plays the next frame.
    ///
    /// # Errors
    /// If the view cannot be drawn, or damage leaves nothing to draw from.
    pub fn next(&mut self, view: &View) -> anyhow::Result<Played> {
        let next = self.place.map_or(0, |place| place + 1);
        self.num_frames += 1;
        if self.num_frames == 1 {
            self.started = Instant::now();
        }
        let place = match self.options.late {
            Late::Wait => next,
            Late::Drop => self.place_in_time(view, next)?,
        };
        self.frame(view, place)
    }

    /// Plays the frame at a place in the order of play, which goes on from there: for dragging a time slider, or standing still.
    ///
    /// # Errors
    /// As [`Self::next`].
    pub fn frame(&mut self, view: &View, place: usize) -> anyhow::Result<Played> {
        let next = self.place.map_or(place, |before| before + 1);
        let num_dropped = place.saturating_sub(next);
        let step = self.step_at(place);
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
        self.want(view, place, &spans, &needed, &adapted.wanted);
        self.request();
        self.wait_for(&needed, place, &mut waited)?;
        let (items, num_stand_ins) = self.with_stand_ins(items, step);
        let start = Instant::now();
        let picture = self.session.draw_selected(view, step, 0.0, &items, faults)?;
        if let Some(pace) = &mut self.pace {
            pace.measured(start.elapsed().as_secs_f64() * 1e3 + adapted.ms, adapted.cost);
        }
        let is_refined = is_at_rest || self.pace.is_none();
        let is_settled = adapted.is_settled && is_refined && num_stand_ins == 0;
        self.before = Some((view.clone(), step, is_settled));
        Ok(Played {
            picture: Some(picture),
            place,
            num_dropped,
            wait_ms: waited.ms,
            hits,
            misses,
            num_stand_ins,
            num_nodes: adapted.num_nodes,
            num_drawn: adapted.num_drawn,
            pixels_per_voxel: adapted.pixels_per_voxel,
            is_settled,
        })
    }

    fn step_at(&self, place: usize) -> u32 {
        self.order[place % self.order.len()]
    }

    /// The place to show now: by the clock where frames have one, else the next that is there.
    fn place_in_time(&mut self, view: &View, next: usize) -> anyhow::Result<usize> {
        if let Some(fps) = self.options.target_fps {
            let due = (self.started.elapsed().as_secs_f64() * fps) as usize;
            return Ok(next.max(due));
        }
        if next == 0 {
            return Ok(0);
        }
        self.listen();
        let ready = (next..next + self.num_ahead).find(|place| self.is_ready(view, *place));
        Ok(ready.unwrap_or(next))
    }

    /// Whether everything that a frame needs is in memory.
    fn is_ready(&mut self, view: &View, place: usize) -> bool {
        let step = self.step_at(place);
        let Some(of_levels) = self.spans_in_memory(step) else { return false };
        let spans = StepSpans::new(self.session.tree(), of_levels);
        let Self { session, residency, errors, cut, .. } = self;
        let Some(errors) = errors else { return false };
        let volume = session.view_volume(view);
        let mut nodes = frame_nodes(session, view, &volume, &spans, residency, errors, false);
        cut.nodes().all(|node| nodes.is_resident(node))
    }
}

/// What adapting the cut found.
struct Adapted {
    wanted: Vec<NodeId>,
    cost: f64,
    num_nodes: usize,
    num_drawn: usize,
    pixels_per_voxel: f64,
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
            wait_ms: 0.0,
            hits: 0,
            misses: 0,
            num_stand_ins: 0,
            num_nodes: 0,
            num_drawn: 0,
            pixels_per_voxel: 0.0,
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
    assumes_resident: bool,
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
        residency,
        errors,
        assumes_resident,
    }
}

/// Spans: what of each node is stored, step by step.
impl Player {
    fn num_levels(&self) -> u8 {
        self.session.store().tree().num_levels() as u8
    }

    /// Spans of all levels of a step, if none is missing that can be read.
    fn spans_in_memory(&self, step: u32) -> Option<Vec<Option<Spans>>> {
        let of_levels = (0..self.num_levels()).map(|level| match self.spans.get(&(step, level)) {
            Some(spans) => Some(Some(Arc::clone(spans))),
            None => self.spans_failed.contains(&(step, level)).then_some(None),
        });
        of_levels.collect()
    }

    /// Spans of the step to draw, waiting for them; those of the steps after it are asked for.
    fn spans_of(&mut self, place: usize, waited: &mut Waited) -> anyhow::Result<StepSpans> {
        let ahead: Vec<u32> = (0..=self.num_ahead).map(|d| self.step_at(place + d)).collect();
        let top = self.num_levels() - 1;
        self.spans.retain(|(step, level), _| *level == top || ahead.contains(step));
        for (distance, step) in ahead.iter().enumerate() {
            for level in 0..self.num_levels() {
                self.ask_for_spans(*step, level, distance == 0);
            }
        }
        self.ask_for_coarse_spans();
        let start = Instant::now();
        loop {
            if let Some(of_levels) = self.spans_in_memory(ahead[0]) {
                waited.ms += start.elapsed().as_secs_f64() * 1e3;
                let spans = StepSpans::new(self.session.tree(), of_levels);
                self.session.give_spans(spans.of_levels(), ahead[0]);
                return Ok(spans);
            }
            self.hear()?;
        }
    }

    /// The coarsest level of all steps, a few more each frame.
    fn ask_for_coarse_spans(&mut self) {
        let top = self.num_levels() - 1;
        let end = self.order.len().min(self.coarse_asked + COARSE_STEPS_PER_FRAME);
        for place in self.coarse_asked..end {
            self.ask_for_spans(self.step_at(place), top, false);
        }
        self.coarse_asked = end;
    }

    fn ask_for_spans(&mut self, step: u32, level: u8, is_urgent: bool) {
        let key = (step, level);
        let is_known = self.spans.contains_key(&key) || self.spans_failed.contains(&key);
        if !is_known && self.spans_asked.insert(key) {
            self.loader.begin(Job::Spans { level, step }, is_urgent);
        }
    }
}

/// The cut and what it needs.
impl Player {
    fn adapt(&mut self, view: &View, spans: &StepSpans, is_at_rest: bool) -> Adapted {
        let start = Instant::now();
        if !self.errors.as_ref().is_some_and(|errors| errors.fits(view)) {
            self.errors = Some(ColorErrors::new(view, self.session.variable_range()));
        }
        let Self { session, residency, errors, cut, pace, .. } = self;
        let volume = session.view_volume(view);
        let tree = session.store().tree();
        let errors = errors.as_mut().expect("made above");
        let mut nodes = frame_nodes(session, view, &volume, spans, residency, errors, pace.is_none());
        let limits = CutLimits {
            cost: pace.as_ref().filter(|_| !is_at_rest).map_or(f64::INFINITY, Pace::cost_limit),
            bytes: (residency.budget_bytes() as f64 * CUT_SHARE) as usize,
            finest_level: view.level,
            most_splits_per_frame: if pace.is_none() { usize::MAX } else { MOST_SPLITS },
        };
        let change = cut.adapt(tree, &limits, &mut nodes);
        let (mut cost, mut num_nodes, mut num_drawn, mut pixels) = (0.0, 0, 0, 0.0);
        for node in cut.nodes() {
            num_nodes += 1;
            if nodes.drawn(node).is_some() {
                num_drawn += 1;
                cost += nodes.cost(node);
                pixels += nodes.pixels_per_voxel(node);
            }
        }
        Adapted {
            wanted: change.wanted,
            cost,
            num_nodes,
            num_drawn,
            pixels_per_voxel: pixels / f64::from(num_drawn.max(1) as u32),
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

    /// Tells the state machine what this frame needs and what the next ones will.
    ///
    /// * `of_splits`: nodes for which the cut waits
    fn want(
        &mut self,
        view: &View,
        place: usize,
        spans: &StepSpans,
        needed: &BTreeMap<HeldKey, SpanRecord>,
        of_splits: &[NodeId],
    ) {
        let mut wants =
            Wants::new(self.session.store(), self.session.variable(), self.residency.budget_bytes());
        needed.iter().for_each(|(key, record)| wants.add(*key, record, Tier::Needed));
        let tree = Arc::clone(self.session.tree());
        // The coarsest brick of the step stands in for everything that is late.
        if let Some((key, record)) =
            spans.record(&tree, tree.root()).and_then(|r| Some((key_of(tree.root().level, r)?, r)))
        {
            wants.add(key, record, Tier::Needed);
        }
        for node in of_splits {
            if let Some((key, record)) =
                spans.record(&tree, *node).and_then(|r| Some((key_of(node.level, r)?, r)))
            {
                wants.add(key, record, Tier::Coming(0));
            }
        }
        self.want_ahead(view, place, &tree, &mut wants);
        for place in 0..self.order.len() {
            let Some(of_root) = self.spans.get(&(self.order[place], tree.root().level)) else { continue };
            if let Some(key) = key_of(tree.root().level, &of_root[0]) {
                wants.add(key, &of_root[0], Tier::Coarse);
            }
        }
        self.wanted = wants.records;
        self.residency.set_wants(wants.list);
        let withdrawn: HashSet<HeldKey> = self.residency.take_withdrawn().into_iter().collect();
        if !withdrawn.is_empty() {
            for key in self.loader.withdraw(&|key| withdrawn.contains(key)) {
                self.residency.cancelled(key);
            }
        }
    }

    /// What the nodes on the cut will need at the next steps, nearest first, as far as it fits.
    fn want_ahead(&self, view: &View, place: usize, tree: &Octree, wants: &mut Wants<'_>) {
        let volume = self.session.view_volume(view);
        let header = self.session.store().header();
        let on_cut: Vec<NodeId> =
            self.cut.nodes().filter(|node| volume.may_see(box_of(*node, header))).collect();
        // The span of each that was wanted last.
        let mut last: Vec<Option<SpanRecord>> = vec![None; on_cut.len()];
        for distance in 1..=self.num_ahead {
            let step = self.step_at(place + distance);
            let Some(spans) = self.spans_in_memory(step) else { continue };
            let record_of = |node: NodeId| spans[usize::from(node.level)].as_ref()?.get(tree.rank(node)?);
            for (node, last) in on_cut.iter().zip(&mut last) {
                if last.is_some_and(|last| (last.start..last.start + last.len).contains(&step)) {
                    continue;
                }
                let Some(record) = record_of(*node) else { continue };
                *last = Some(*record);
                let is_seen = !view.transfer.is_transparent_over(record.drawn_range);
                if let Some(key) = key_of(node.level, record).filter(|_| is_seen) {
                    wants.add(key, record, Tier::Coming(distance as u32));
                }
            }
            if wants.is_full() {
                return;
            }
        }
    }
}

/// Most splits of the cut in a frame with a target.
const MOST_SPLITS: usize = 64;

/// Wants of a frame, each once, at its most urgent.
struct Wants<'a> {
    store: &'a chronoxel_store::Store,
    variable: usize,
    list: Vec<Want<HeldKey>>,
    records: HashMap<HeldKey, SpanRecord>,
    left_bytes: usize,
}

impl<'a> Wants<'a> {
    fn new(store: &'a chronoxel_store::Store, variable: usize, budget_bytes: usize) -> Self {
        Self { store, variable, list: Vec::new(), records: HashMap::new(), left_bytes: budget_bytes }
    }

    /// Adds one; more urgent ones come first.
    fn add(&mut self, key: HeldKey, record: &SpanRecord, tier: Tier) {
        if self.records.insert(key, *record).is_none() {
            let num_bytes = Held::most_bytes(self.store, self.variable, record);
            self.left_bytes = self.left_bytes.saturating_sub(num_bytes);
            self.list.push(Want { key, tier, num_bytes });
        }
    }

    fn is_full(&self) -> bool {
        self.left_bytes == 0
    }
}

/// The box of a node in voxels.
fn box_of(node: NodeId, header: &chronoxel_store::Header) -> [[f64; 3]; 2] {
    let size = (header.bricks.edge << node.level) as f64;
    let low = node.brick().map(|b| f64::from(b) * size);
    [low, low.map(|v| v + size)]
}

/// Reading.
impl Player {
    /// Begins what the state machine says, and forgets what it says.
    fn request(&mut self) {
        let mut requests = self.residency.next_requests();
        for key in self.residency.take_evicted() {
            self.session.take_back(&key);
        }
        // Urgent ones first; those of a batch in the order in which they lie in the store.
        for batch in requests.chunks_mut(BATCH) {
            batch.sort_unstable();
            for same in batch.chunk_by(|a, b| a.level() == b.level()) {
                let wanted: Vec<_> =
                    same.iter().filter_map(|key| Some((*key, *self.wanted.get(key)?))).collect();
                self.loader.begin(Job::Held { level: same[0].level(), wanted }, false);
            }
        }
    }

    /// Takes the answers that are there.
    fn listen(&mut self) {
        while let Some(answer) = self.loader.try_answer() {
            self.take(answer);
        }
    }

    /// Waits for an answer, and begins what it makes room for.
    fn hear(&mut self) -> anyhow::Result<()> {
        if let Some(answer) = self.loader.wait(PATIENCE)? {
            self.take(answer);
            self.listen();
            self.request();
        }
        Ok(())
    }

    fn take(&mut self, answer: Answer) {
        match answer {
            Answer::Spans { level, step, spans } => {
                self.spans_asked.remove(&(step, level));
                match spans {
                    Ok(spans) => drop(self.spans.insert((step, level), Arc::new(spans))),
                    Err(_) => drop(self.spans_failed.insert((step, level))),
                }
            }
            Answer::Held { key, held: Ok(held) } => {
                if self.residency.loaded(key, held.num_bytes()) {
                    self.session.give(key, held);
                }
            }
            Answer::Held { key, held: Err(error) } => {
                self.residency.failed(key);
                if self.residency.state(&key) == State::Failed {
                    self.warnings.push(format!("{error}; a coarser brick is drawn instead"));
                }
            }
        }
    }

    /// Waits until a frame can be drawn as it should be, or as it may be.
    fn wait_for(
        &mut self,
        needed: &BTreeMap<HeldKey, SpanRecord>,
        place: usize,
        waited: &mut Waited,
    ) -> anyhow::Result<()> {
        let start = Instant::now();
        let tree = Arc::clone(self.session.tree());
        let root = tree.root();
        let root_key = match self.session.record(&tree, root, self.step_at(place)) {
            Ok(record) => key_of(root.level, &record),
            Err(_) => None,
        };
        let mut missing: Vec<HeldKey> = match self.options.late {
            Late::Wait => needed.keys().copied().chain(root_key).collect(),
            Late::Drop => root_key.into_iter().collect(),
        };
        loop {
            missing.retain(|key| !matches!(self.residency.state(key), State::Resident | State::Failed));
            if missing.is_empty() {
                break;
            }
            if self.residency.num_in_flight() == 0 && self.spans_asked.is_empty() {
                // What does not fit beside the rest is stood in for.
                break;
            }
            self.hear()?;
        }
        waited.ms += start.elapsed().as_secs_f64() * 1e3;
        Ok(())
    }

    /// The list with the nearest ancestor that is in memory in place of what is not.
    fn with_stand_ins(&mut self, mut items: Vec<DrawItem>, step: u32) -> (Vec<DrawItem>, usize) {
        let tree = Arc::clone(self.session.tree());
        let mut num_stand_ins = 0;
        for item in items.iter_mut().filter(|item| item.how == How::Payload) {
            if self.can_draw(&tree, item.node, item.steps.start) {
                continue;
            }
            let mut node = item.node;
            while node != tree.root() {
                node = node.parent();
                let Ok(record) = self.session.record(&tree, node, step) else { continue };
                let how = match (record.kind, record.mask) {
                    (SpanKind::Empty, _) => How::Skip,
                    (SpanKind::Constant(value), None) => How::Constant(value),
                    _ if self.can_draw(&tree, node, step) => How::Payload,
                    _ => continue,
                };
                num_stand_ins += 1;
                *item = DrawItem { node, region: item.region, steps: step..step + 1, how };
                break;
            }
        }
        (items, num_stand_ins)
    }

    fn can_draw(&mut self, tree: &Octree, node: NodeId, step: u32) -> bool {
        let Ok(record) = self.session.record(tree, node, step) else { return false };
        key_of(node.level, &record).is_none_or(|key| self.session.has(&key))
    }
}
