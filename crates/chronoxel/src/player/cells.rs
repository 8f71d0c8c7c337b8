//! Playing a store of cells: while a step is drawn, a thread of its own reads and decodes the steps that come next.
//!
//! What comes next is decided by `chronoxel-stream`'s [`Playback`], and with a target for the frame rate the number of faces by its
//! [`Pace`](chronoxel_stream::Pace), in [`detail`].

mod detail;
mod values;

use std::time::Instant;

use anyhow::{bail, ensure};
use chronoxel_render::{GpuPicture, ReadBack};
use chronoxel_stream::{Late, Playback, Playhead, Shown};

use crate::session::{CellPicture, CellSession, CellShot, StepValues};
pub use detail::DetailPace;
use values::{Ready, ValueLoader};

/// How to play cells.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CellPlayerOptions {
    /// Frames per second to hold by leaving out faces where need be; what the session's detail says without.
    pub target_fps: Option<f64>,
    /// What to do about late steps.
    pub late: Late,
    /// The most bytes read per second.
    pub throttle: Option<f64>,
    /// Draw every frame as if something had changed: for measuring. Else what rests is refined to all faces, and then not drawn again.
    pub redraws: bool,
    /// What comes back of pictures.
    pub read_back: ReadBack,
    /// Whether playing starts over at the end: else nothing is decoded ahead beyond it.
    pub loops: bool,
}

impl Default for CellPlayerOptions {
    fn default() -> Self {
        Self {
            target_fps: None,
            late: Late::Wait,
            throttle: None,
            redraws: false,
            read_back: ReadBack::Floats,
            loops: true,
        }
    }
}

/// A frame of cells that was played.
#[derive(Debug, Clone)]
pub struct CellPlayed {
    /// What it shows. `None` where nothing changed since the one before, and nothing was drawn.
    pub picture: Option<CellPicture<GpuPicture>>,
    /// Its place in the order of play.
    pub place: usize,
    /// Steps left out since playing began, because there was no time to decode them.
    pub num_dropped: u64,
    /// Whether the step of the frame before is shown again, because the next one is not there.
    pub is_late: bool,
    /// Time that drawing waited for values.
    pub wait_ms: f64,
    /// Whether the values were there when the frame began.
    pub is_hit: bool,
    /// The fraction of the faces within that was drawn.
    pub fraction: f64,
    /// Whether more work would not change the picture while nothing else changes.
    pub is_settled: bool,
}

/// Most steps that are decoded ahead.
const MOST_AHEAD: usize = 4;
/// Part of the memory beside the mesh that values and payloads may take.
const AHEAD_SHARE: f64 = 0.5;

/// A player of one variable of a store of cells.
pub struct CellPlayer {
    session: CellSession,
    loader: ValueLoader,
    pace: Option<DetailPace>,
    options: CellPlayerOptions,
    /// Steps in the order of play; it starts over when it is over.
    order: Vec<u32>,
    num_ahead: usize,
    before: Option<(CellShot, u32)>,
    place: Option<usize>,
    playback: Playback,
}

impl CellPlayer {
    /// A player of the steps `order` of a session's store. With a target, the session has measured which faces matter.
    ///
    /// # Errors
    /// If there are no steps, or one that is not finished, the values of two steps do not fit the memory, or the system gives no thread.
    pub fn new(session: CellSession, order: Vec<u32>, options: CellPlayerOptions) -> anyhow::Result<Self> {
        let header = session.store().header();
        let num_finished = header.num_steps_finished;
        let Some(last) = order.iter().max() else { bail!("there are no steps to play") };
        ensure!(
            options.throttle.is_none_or(|rate| rate >= 1.0),
            "--throttle 0: nothing would ever be read; allow at least a byte per second"
        );
        ensure!(
            *last < num_finished,
            "step {last} is not in the store: its steps are 0 to {}",
            num_finished - 1
        );
        // Two payloads, of two bytes an index and few stages, take no more than four steps of values.
        let step_bytes = 4 * header.num_points;
        let fitting = (session.memory_left() as f64 * AHEAD_SHARE / step_bytes as f64) as usize;
        ensure!(
            fitting > 5,
            "--memory leaves no room for the values of two steps beside the mesh; raise it by {}",
            crate::bytes::ByteSize(12 * step_bytes)
        );
        let num_ahead = (fitting - 5).min(MOST_AHEAD).min(order.len());
        let pace = match (options.target_fps, session.face_order()) {
            (None, _) => None,
            (Some(fps), Some(order)) => {
                Some(DetailPace::new(1e3 / fps, order.num_boundary(), order.num_inner()))
            }
            (Some(_), None) => bail!("which faces matter must be measured before a frame rate is held"),
        };
        let decodes = !session.is_on_gpu();
        let num_steps = order.len() as u32;
        let head = Playhead { num_steps, position: 0.0, steps_per_frame: 1.0, is_looping: options.loops };
        Ok(Self {
            loader: ValueLoader::new(session.store(), session.variable(), decodes, options.throttle)?,
            session,
            pace,
            options,
            order,
            num_ahead,
            before: None,
            place: None,
            playback: Playback::new(head, options.late),
        })
    }

    /// The session that draws.
    pub fn session(&self) -> &CellSession {
        &self.session
    }

    /// The most bytes of values and payloads that were held at once.
    pub fn bytes_ahead_peak(&self) -> usize {
        self.loader.peak_bytes()
    }

    /// The most that they may take.
    pub fn bytes_ahead_budget(&self) -> usize {
        (self.session.memory_left() as f64 * AHEAD_SHARE) as usize
    }

    /// Goes back to before the first frame; what is in memory stays.
    pub fn rewind(&mut self) {
        self.place = None;
        self.playback.set_head(Playhead { position: 0.0, ..self.playback.head() });
    }

    /// Plays the next frame.
    ///
    /// # Errors
    /// If a step is damaged or the picture cannot be drawn.
    pub fn next(&mut self, shot: &CellShot) -> anyhow::Result<CellPlayed> {
        let Some(place) = self.place else { return self.frame(shot, 0) };
        match self.options.late {
            Late::Wait => self.frame(shot, place + 1),
            Late::Drop => {
                let Self { playback, loader, order, .. } = self;
                let shown =
                    playback.advance(&mut |place| loader.is_ready(order[place as usize % order.len()]));
                let place = self.playback.step() as usize;
                Ok(CellPlayed { is_late: shown == Shown::Late, ..self.frame(shot, place)? })
            }
        }
    }

    /// Plays the frame at a place in the order of play, which goes on from there.
    ///
    /// # Errors
    /// As [`Self::next`].
    pub fn frame(&mut self, shot: &CellShot, place: usize) -> anyhow::Result<CellPlayed> {
        let num_steps = self.order.len();
        let step = self.order[place % num_steps];
        if self.playback.step() as usize != place % num_steps {
            self.playback.set_head(Playhead { position: (place % num_steps) as f64, ..self.playback.head() });
        }
        self.place = Some(place);
        self.loader.want(&self.wanted(place));
        let is_at_rest = !self.options.redraws
            && self.before.as_ref().is_some_and(|(before, at)| *at == step && before == shot);
        let mut played = CellPlayed {
            picture: None,
            place,
            num_dropped: self.playback.num_dropped(),
            is_late: false,
            wait_ms: 0.0,
            is_hit: self.loader.is_ready(step),
            fraction: self.session.detail(),
            is_settled: true,
        };
        if is_at_rest && (self.pace.is_none() || self.session.detail() >= 1.0) {
            return Ok(played);
        }
        let start = Instant::now();
        let values = self.loader.wait(step)?;
        played.wait_ms = start.elapsed().as_secs_f64() * 1e3;
        let start = Instant::now();
        if let Some(pace) = &mut self.pace {
            let fraction = if is_at_rest { pace.refined(self.session.detail()) } else { pace.fraction() };
            self.session.set_detail(fraction)?;
        }
        let values = match &values {
            Ready::Values(values) => StepValues::Decoded(values),
            Ready::Payload(payload) => StepValues::Coded(payload, step),
        };
        let picture = self.session.draw_values(shot, values, self.options.read_back)?;
        if let Some(pace) = self.pace.as_mut().filter(|_| !is_at_rest) {
            pace.measured(
                start.elapsed().as_secs_f64() * 1e3,
                picture.num_chosen,
                picture.stats.view_changed,
            );
        }
        played.fraction = self.session.detail();
        played.is_settled = self.pace.is_none() || played.fraction >= 1.0;
        played.picture = Some(CellPicture { fetch_ms: played.wait_ms, ..picture });
        self.before = Some((shot.clone(), step));
        // The span that begins with one of the next steps is sent while nobody waits for it.
        for step in self.wanted(place).into_iter().skip(1) {
            if let Some(payload) = self.loader.payload(step) {
                self.session.prepare(&payload)?;
            }
        }
        Ok(played)
    }

    /// The step to draw and those that come next, nearest first.
    fn wanted(&self, place: usize) -> Vec<u32> {
        let places: Vec<usize> = match self.options.late {
            Late::Wait => {
                let end = if self.options.loops { usize::MAX } else { self.order.len() };
                (place..=place + self.num_ahead).take_while(|at| *at == place || *at < end).collect()
            }
            Late::Drop => {
                let coming = self.playback.coming(self.num_ahead as u32);
                std::iter::once(place).chain(coming.into_iter().skip(1).map(|(at, _)| at as usize)).collect()
            }
        };
        let mut steps: Vec<u32> = Vec::with_capacity(places.len());
        for place in places {
            let step = self.order[place % self.order.len()];
            if !steps.contains(&step) {
                steps.push(step);
            }
        }
        steps
    }
}
