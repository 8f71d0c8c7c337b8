//! Coding through time: an external transpose. Bricks wait, step by step, until the window of their node is over; then
//! the node is coded.

use std::ops::Range;

use chronoxel_codec::PayloadClass;
use chronoxel_core::{BrickLayout, LevelGeometry, NodeId, Octree};
use chronoxel_store::{SpanWrite, stored_len};
use rayon::prelude::*;

use super::analyse::Analysis;
use super::choose::{self, NodeWindow, within_bound};
use super::coding::Refusal;
use super::mark::width_of;
use super::node::{NodeSteps, Piece, Section};
use super::palettes::{self, PaletteKind};
use super::rate::{self, Spending};
use super::real::Real;
use super::scratch::{Scratch, Waiting};
use super::slices;
use super::step::{CutBrick, TakeBatch};
use super::timing::Timing;
use super::variable::Places;
use crate::EncodeError;

/// Level of zstd at which candidates within a bound are weighed: what is stored at a higher level ranks them alike, but for less time.
pub const CHOOSING_LEVEL: i32 = 1;

/// How windows are coded.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Method {
    /// As palettes over whole windows.
    Palettes {
        /// How they are made.
        kind: PaletteKind,
        /// Stages of each.
        num_stages: usize,
    },
    /// As lum2001's palettes with one quantiser for each slice of the volume.
    Slices,
    /// With the least error at a rate.
    Rate {
        /// Stored bits per sample and step, on average.
        bits: f64,
    },
    /// In the fewest bytes that hold an error bound.
    Bound {
        /// Largest error, relative to the range.
        max_error: f64,
    },
}

impl Method {
    /// Classes that payloads may have.
    pub fn classes(&self, window: u32, layout: &BrickLayout) -> Vec<PayloadClass> {
        match self {
            Self::Palettes { num_stages, .. } => palettes::classes(window, *num_stages),
            Self::Slices => slices::classes(window, layout),
            Self::Rate { .. } => rate::classes(window),
            Self::Bound { .. } => choose::classes(window),
        }
    }
}

/// A brick of a step that is to wait.
pub struct Arrival<T> {
    rank: u32,
    analysis: Analysis,
    /// `None` where all is masked, or one value.
    samples: Option<Vec<T>>,
    uniform: Option<T>,
}

/// The steps of a node that wait.
struct Open<T> {
    steps: Vec<(Analysis, Waiting<T>)>,
}

/// A node whose window is over.
struct Loaded<T> {
    rank: usize,
    /// Its first step.
    first: u32,
    brick: [usize; 3],
    steps: NodeSteps<T>,
}

/// The open windows of one variable.
pub struct OpenWindows<T> {
    timing: Timing,
    scratch: Scratch,
    /// `[level][node]`
    nodes: Vec<Vec<Open<T>>>,
    /// Of a codec that meets a rate.
    spending: Option<Spending>,
}

/// What coding a node needs besides its samples.
pub struct NodeCoder<'a> {
    /// The shape of bricks.
    pub layout: &'a BrickLayout,
    /// The levels, finest first.
    pub levels: &'a [LevelGeometry],
    /// The nodes.
    pub tree: &'a Octree,
    /// How.
    pub method: Method,
    /// The range that relative errors refer to.
    pub range: [f64; 2],
    /// Level of zstd in the store.
    pub zstd_level: i32,
    /// The classes that payloads may have.
    pub classes: &'a [PayloadClass],
    /// Name of the variable, for messages.
    pub variable: &'a str,
    /// Steps of a window.
    pub window: u32,
    /// Nodes coded at once. Changes memory and speed, never what comes out.
    pub batch_nodes: usize,
}

impl<T: Real> Arrival<T> {
    /// Takes a brick, whose samples are only copied where they differ.
    pub fn new(brick: CutBrick<'_, T>) -> Self {
        let is_uniform = brick.analysis.is_constant && brick.analysis.num_masked == 0;
        let uniform = is_uniform.then(|| brick.samples[0]);
        let is_empty = brick.analysis.range.is_none();
        let samples = (!is_uniform && !is_empty).then(|| std::mem::take(brick.samples));
        Self { rank: brick.rank, analysis: brick.analysis, samples, uniform }
    }
}

impl<T: Real> OpenWindows<T> {
    /// Of a variable of which nothing waits yet.
    ///
    /// * `spending`: what was spent so far, where there is a rate to meet
    pub fn new(timing: Timing, places: &Places<'_>, spending: Option<Spending>) -> Result<Self, EncodeError> {
        let Places { tree, layout, folder, scratch_bytes, .. } = *places;
        let brick_bytes = (layout.num_full() * size_of::<T>()) as u64;
        let scratch = Scratch::new(folder, brick_bytes, scratch_bytes)?;
        let of_level = |level: u8| tree.nodes(level).iter().map(|_| Open { steps: Vec::new() }).collect();
        let nodes = (0..tree.num_levels() as u8).map(of_level).collect();
        Ok(Self { timing, scratch, nodes, spending })
    }

    /// What was spent, where there is a rate to meet.
    pub fn spending(&self) -> Option<&Spending> {
        self.spending.as_ref()
    }

    /// Lets bricks of a level wait for the end of their windows.
    pub fn wait(&mut self, level: u8, arrivals: impl Iterator<Item = Arrival<T>>) -> Result<(), EncodeError> {
        for arrival in arrivals {
            let waiting = match arrival.samples {
                Some(samples) => self.scratch.keep(samples)?,
                None => Waiting::Uniform(arrival.uniform),
            };
            self.nodes[usize::from(level)][arrival.rank as usize].steps.push((arrival.analysis, waiting));
        }
        Ok(())
    }

    /// Codes the nodes whose windows end with `step`, level by level in Morton order.
    ///
    /// * `put`: takes the spans of some nodes of a level, each batch while the next is coded
    pub fn close(
        &mut self,
        step: u32,
        coder: &NodeCoder<'_>,
        put: &mut TakeBatch<'_, SpanWrite>,
    ) -> Result<(), EncodeError> {
        let mut coded: Option<(u8, Vec<SpanWrite>)> = None;
        let mut spending = self.spending.take();
        for level in 0..self.nodes.len() as u8 {
            for batch in &coder.closing(self.timing, level, step) {
                let before = coded.take();
                let (spans, written) = rayon::join(
                    || self.code_batch(level, batch, step, coder, &mut spending),
                    || before.map_or(Ok(()), |(level, spans)| put(level, spans)),
                );
                written?;
                coded = Some((level, spans?));
                for &rank in batch {
                    let steps = std::mem::take(&mut self.nodes[usize::from(level)][rank].steps);
                    steps.iter().for_each(|(_, waiting)| self.scratch.forget(waiting));
                }
            }
        }
        self.spending = spending;
        coded.map_or(Ok(()), |(level, spans)| put(level, spans))
    }

    fn code_batch(
        &self,
        level: u8,
        ranks: &[usize],
        step: u32,
        coder: &NodeCoder<'_>,
        spending: &mut Option<Spending>,
    ) -> Result<Vec<SpanWrite>, EncodeError> {
        let refused = |loaded: &Loaded<T>, at: usize, refusal| {
            coder.refused(refusal, loaded.first + at as u32, level, loaded.brick)
        };
        if let Method::Palettes { .. } | Method::Bound { .. } = coder.method {
            let code = |&rank: &usize| {
                let Some(loaded) = self.load(level, rank, step, coder)? else { return Ok(Vec::new()) };
                let pieces = coder.pieces(level, &loaded.steps);
                Ok(coder.spans(&loaded, pieces.map_err(|(at, refusal)| refused(&loaded, at, refusal))?))
            };
            let spans: Vec<Result<Vec<SpanWrite>, EncodeError>> = ranks.par_iter().map(code).collect();
            // In order, so that of several errors it is always the first.
            return Ok(spans.into_iter().collect::<Result<Vec<_>, _>>()?.into_iter().flatten().collect());
        }
        let loaded: Vec<_> = ranks.par_iter().map(|&rank| self.load(level, rank, step, coder)).collect();
        let loaded = loaded.into_iter().collect::<Result<Vec<_>, EncodeError>>()?;
        let loaded: Vec<Loaded<T>> = loaded.into_iter().flatten().collect();
        let steps: Vec<&NodeSteps<T>> = loaded.iter().map(|loaded| &loaded.steps).collect();
        let pieces = match spending {
            Some(spending) => rate::pieces(&steps, spending, coder),
            None => slices::pieces(&steps, self.timing.window, coder.layout),
        };
        let pieces = pieces.map_err(|(node, source)| refused(&loaded[node], 0, Refusal::Codec(source)))?;
        let spans = loaded.iter().zip(pieces).map(|(loaded, pieces)| coder.spans(loaded, pieces));
        Ok(spans.flatten().collect())
    }

    /// What waits of a node, padded where masked; `None` where nothing does.
    fn load(
        &self,
        level: u8,
        rank: usize,
        step: u32,
        coder: &NodeCoder<'_>,
    ) -> Result<Option<Loaded<T>>, EncodeError> {
        let open = &self.nodes[usize::from(level)][rank];
        let Some(before) = open.steps.len().checked_sub(1) else { return Ok(None) };
        let first = step - before as u32;
        let node = coder.node(level, rank);
        let brick = node.brick().map(|b| b as usize);
        let lead = self.timing.place(coder.phase(self.timing, node), first);
        let samples = open.steps.iter().map(|(_, waiting)| self.samples(waiting, coder.layout));
        let samples = samples.collect::<Result<Vec<_>, _>>()?;
        let analyses = open.steps.iter().map(|(analysis, _)| *analysis).collect();
        let core = coder.levels[usize::from(level)].core_inside(brick, coder.layout);
        let steps = NodeSteps::new(samples, analyses, lead, core, coder.layout);
        Ok(Some(Loaded { rank, first, brick, steps }))
    }

    /// The samples of a step; `None` where all are masked.
    fn samples(&self, waiting: &Waiting<T>, layout: &BrickLayout) -> Result<Option<Vec<T>>, EncodeError> {
        Ok(match waiting {
            Waiting::Uniform(value) => value.map(|value| vec![value; layout.num_full()]),
            Waiting::Memory(samples) => Some(samples.clone()),
            Waiting::File(block) => Some(self.scratch.read(*block, layout.num_full())?),
        })
    }
}

impl NodeCoder<'_> {
    fn node(&self, level: u8, rank: usize) -> NodeId {
        NodeId { level, morton: self.tree.nodes(level)[rank] }
    }

    /// The largest absolute error for one that is relative to the range.
    fn bound(&self, max_error: f64) -> f64 {
        max_error * width_of(self.range)
    }

    /// Phase of a node: by layers of bricks where a whole slice is coded at once.
    fn phase(&self, timing: Timing, node: NodeId) -> u32 {
        match self.method {
            Method::Slices => timing.phase_of(node.brick()[2].into()),
            _ => timing.phase(node),
        }
    }

    /// The nodes of a level whose windows end with a step, in batches of what is coded at once.
    fn closing(&self, timing: Timing, level: u8, step: u32) -> Vec<Vec<usize>> {
        let num_nodes = self.tree.nodes(level).len();
        let closes = |&rank: &usize| timing.closes(self.phase(timing, self.node(level, rank)), step);
        let mut ranks: Vec<usize> = (0..num_nodes).filter(closes).collect();
        let layer = |rank: usize| self.node(level, rank).brick()[2];
        match self.method {
            Method::Slices => {
                ranks.sort_by_key(|&rank| layer(rank));
                ranks.chunk_by(|&a, &b| layer(a) == layer(b)).map(<[usize]>::to_vec).collect()
            }
            Method::Rate { .. } => ranks.chunks(rate::GROUP).map(<[usize]>::to_vec).collect(),
            _ => ranks.chunks(self.batch_nodes).map(<[usize]>::to_vec).collect(),
        }
    }

    /// Codes a node by itself.
    ///
    /// # Errors
    /// The step that is refused, counted from the node's first, and why.
    fn pieces<T: Real>(&self, level: u8, node: &NodeSteps<T>) -> Result<Vec<Piece>, (usize, Refusal)> {
        let one_mask = matches!(self.method, Method::Palettes { .. });
        let mut pieces = Vec::new();
        for section in node.sections(self.window, one_mask) {
            let start = section.steps.start;
            match (section.piece(), self.method) {
                (Some(piece), _) => pieces.push(piece),
                (None, Method::Palettes { kind, num_stages }) => {
                    let piece =
                        palettes::piece(node, section.steps, section.width, kind, num_stages, self.layout);
                    pieces.push(piece.map_err(|source| (start, Refusal::Codec(source)))?);
                }
                (None, Method::Bound { max_error }) => {
                    pieces.extend(self.bounded_pieces(level, node, &section, max_error)?);
                }
                (None, Method::Rate { .. } | Method::Slices) => unreachable!("coded in groups"),
            }
        }
        Ok(pieces)
    }

    /// A section in the fewest bytes that hold the bound.
    fn bounded_pieces<T: Real>(
        &self,
        level: u8,
        node: &NodeSteps<T>,
        section: &Section<T>,
        max_error: f64,
    ) -> Result<Vec<Piece>, (usize, Refusal)> {
        let bound = self.bound(max_error);
        let stored = |bytes: &[u8]| stored_len(bytes, CHOOSING_LEVEL);
        let choose =
            |window: &NodeWindow<'_, T>| within_bound(window, bound, level == 0, self.layout, &stored);
        let window = NodeWindow::of_section(node, section);
        let chosen = choose(&window).map_err(|refusal| {
            // It looked at the whole window: find the step that it stumbled over.
            let refused = |&at: &usize| choose(&window.step(at)).is_err();
            (section.steps.start + (0..window.steps.len()).find(refused).unwrap_or(0), refusal)
        })?;
        let from_first = |piece: Piece| Piece { start: section.steps.start + piece.start, ..piece };
        Ok(chosen.into_iter().map(from_first).collect())
    }

    fn spans<T: Real>(&self, loaded: &Loaded<T>, pieces: Vec<Piece>) -> Vec<SpanWrite> {
        pieces.into_iter().map(|piece| self.span(loaded.rank, loaded.first, &loaded.steps, piece)).collect()
    }

    fn span<T: Real>(&self, rank: usize, first: u32, node: &NodeSteps<T>, piece: Piece) -> SpanWrite {
        let steps: Range<usize> = piece.start..piece.start + piece.len;
        let mask = node.masks[piece.start].clone();
        SpanWrite {
            node_rank: rank as u32,
            start: first + piece.start as u32,
            len: piece.len as u32,
            window: piece.window,
            content: piece.choice.into_content(self.classes, self.layout),
            mask,
            drawn_range: piece.drawn_range,
            statistics: node.statistics(steps),
        }
    }

    fn refused(&self, refusal: Refusal, step: u32, level: u8, brick: [usize; 3]) -> EncodeError {
        let max_error = if let Method::Bound { max_error } = self.method { max_error } else { 0.0 };
        refusal.into_error(self.variable, step as usize, level, brick, max_error)
    }
}
