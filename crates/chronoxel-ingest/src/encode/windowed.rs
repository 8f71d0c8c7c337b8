//! Coding through time: an external transpose. Bricks wait, step by step, until the window of their node is over; then
//! the node is coded.

use std::ops::Range;
use std::path::Path;

use chronoxel_codec::{PayloadClass, stage_to_bytes};
use chronoxel_core::{BrickLayout, LevelGeometry, NodeId, Octree};
use chronoxel_store::{SpanContent, SpanWrite, stored_len};
use rayon::prelude::*;

use super::analyse::Analysis;
use super::choose::{self, NodeWindow, within_bound};
use super::coding::{Choice, Refusal};
use super::node::{NodeSteps, Piece, core_inside};
use super::palettes::{self, PaletteKind};
use super::real::Real;
use super::scratch::{Scratch, Waiting};
use super::step::{CutBrick, TakeBatch};
use super::timing::Timing;
use crate::EncodeError;

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
    /// In the fewest bytes that hold an error bound.
    Bound {
        /// Largest error, relative to the range.
        max_error: f64,
    },
}

impl Method {
    /// Classes that payloads may have.
    pub fn classes(&self, window: u32) -> Vec<PayloadClass> {
        match self {
            Self::Palettes { num_stages, .. } => palettes::classes(window, *num_stages),
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

/// The open windows of one variable.
pub struct OpenWindows<T> {
    timing: Timing,
    scratch: Scratch,
    /// `[level][node]`
    nodes: Vec<Vec<Open<T>>>,
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
    /// Of a variable of which nothing is read yet.
    ///
    /// * `folder`: where the scratch file may lie
    /// * `memory_bytes`: what may wait in memory
    pub fn new(
        timing: Timing,
        tree: &Octree,
        layout: &BrickLayout,
        folder: &Path,
        memory_bytes: u64,
    ) -> Result<Self, EncodeError> {
        let brick_bytes = (layout.num_full() * size_of::<T>()) as u64;
        let scratch = Scratch::new(folder, brick_bytes, memory_bytes)?;
        let of_level = |level: u8| tree.nodes(level).iter().map(|_| Open { steps: Vec::new() }).collect();
        Ok(Self { timing, scratch, nodes: (0..tree.num_levels() as u8).map(of_level).collect() })
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
        for level in 0..self.nodes.len() as u8 {
            let phase = |rank: usize| self.timing.phase(coder.node(level, rank));
            let is_closing = |rank: &usize| self.timing.closes(phase(*rank), step);
            let ranks: Vec<usize> = (0..self.nodes[usize::from(level)].len()).filter(is_closing).collect();
            for batch in ranks.chunks(coder.batch_nodes) {
                let before = coded.take();
                let (spans, written) = rayon::join(
                    || self.code_batch(level, batch, step, coder),
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
        coded.map_or(Ok(()), |(level, spans)| put(level, spans))
    }

    fn code_batch(
        &self,
        level: u8,
        ranks: &[usize],
        step: u32,
        coder: &NodeCoder<'_>,
    ) -> Result<Vec<SpanWrite>, EncodeError> {
        let spans: Vec<Result<Vec<SpanWrite>, EncodeError>> =
            ranks.par_iter().map(|&rank| self.code_node(level, rank, step, coder)).collect();
        let spans: Result<Vec<Vec<SpanWrite>>, EncodeError> = spans.into_iter().collect();
        Ok(spans?.into_iter().flatten().collect())
    }

    fn code_node(
        &self,
        level: u8,
        rank: usize,
        step: u32,
        coder: &NodeCoder<'_>,
    ) -> Result<Vec<SpanWrite>, EncodeError> {
        let open = &self.nodes[usize::from(level)][rank];
        let Some(before) = open.steps.len().checked_sub(1) else { return Ok(Vec::new()) };
        let first = step - before as u32;
        let node = coder.node(level, rank);
        let brick = node.brick().map(|b| b as usize);
        let lead = self.timing.place(self.timing.phase(node), first);
        let samples = open.steps.iter().map(|(_, waiting)| self.samples(waiting, coder.layout));
        let samples = samples.collect::<Result<Vec<_>, _>>()?;
        let analyses = open.steps.iter().map(|(analysis, _)| *analysis).collect();
        let core = core_inside(brick, &coder.levels[usize::from(level)], coder.layout);
        let steps = NodeSteps::new(samples, analyses, lead, core, coder.layout);
        let refused = |source| coder.refused(source, first, level, brick);
        let mut pieces = Vec::new();
        coder.pieces(level, &steps, 0, self.timing.window, &mut pieces).map_err(refused)?;
        Ok(pieces.into_iter().map(|piece| coder.span(rank, first, &steps, piece)).collect())
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
        let [low, high] = self.range;
        // Halved before the difference and doubled after, which cannot overflow on the way.
        max_error * 2.0 * (0.5 * high - 0.5 * low).clamp(0.0, 0.5 * f64::MAX)
    }

    /// Codes the steps at places `place .. place + width` of a node: as one piece where that is possible, else in halves.
    fn pieces<T: Real>(
        &self,
        level: u8,
        node: &NodeSteps<T>,
        place: u32,
        width: u32,
        out: &mut Vec<Piece>,
    ) -> Result<(), Refusal> {
        let steps = node.steps_at(place, width);
        if steps.is_empty() {
            return Ok(());
        }
        let piece = |choice, drawn_range| Piece {
            start: steps.start,
            len: steps.len(),
            window: width,
            choice,
            drawn_range,
        };
        if steps.clone().all(|step| node.samples[step].is_none()) {
            out.push(piece(Choice::Empty, [f64::NAN; 2]));
            return Ok(());
        }
        let all_have_data = steps.clone().all(|step| node.samples[step].is_some());
        let same_mask = |step: usize| node.masks[step] == node.masks[steps.start];
        let may_differ = matches!(self.method, Method::Bound { .. });
        if !all_have_data || !(may_differ || steps.clone().all(same_mask)) {
            self.pieces(level, node, place, width / 2, out)?;
            return self.pieces(level, node, place + width / 2, width / 2, out);
        }
        if let Some(value) = node.constant(steps.clone()).filter(|_| steps.clone().all(same_mask)) {
            let value = value.to_f64();
            out.push(piece(Choice::Constant(value), [value; 2]));
            return Ok(());
        }
        match self.method {
            Method::Palettes { kind, num_stages } => {
                let piece = palettes::piece(node, steps, width, kind, num_stages, self.layout);
                out.push(piece.map_err(Refusal::Codec)?);
            }
            Method::Bound { max_error } => {
                let window = NodeWindow {
                    steps: node.samples[steps.clone()].iter().flatten().map(Vec::as_slice).collect(),
                    masks: node.masks[steps.clone()].iter().map(Option::as_ref).collect(),
                    lead: node.lead.saturating_sub(place) as usize,
                    window: width,
                    whole_numbers: node.whole_numbers,
                };
                let stored = |bytes: &[u8]| stored_len(bytes, self.zstd_level);
                let chosen = within_bound(&window, self.bound(max_error), level == 0, self.layout, &stored)?;
                out.extend(chosen.into_iter().map(|p| Piece {
                    start: steps.start + p.start,
                    len: p.len,
                    window: p.window,
                    choice: p.content,
                    drawn_range: p.drawn_range,
                }));
            }
        }
        Ok(())
    }

    fn span<T: Real>(&self, rank: usize, first: u32, node: &NodeSteps<T>, piece: Piece) -> SpanWrite {
        let steps: Range<usize> = piece.start..piece.start + piece.len;
        let mask = node.masks[piece.start].clone();
        let content = match piece.choice {
            Choice::Empty => SpanContent::Empty,
            Choice::Constant(value) => SpanContent::Constant(value),
            Choice::Coded(payload) => {
                let class =
                    PayloadClass { stages: payload.stages.iter().map(|stage| stage.class()).collect() };
                let class = self.classes.iter().position(|known| *known == class);
                SpanContent::Coded {
                    class: class.expect("codecs give payloads of the classes they announce") as u8,
                    stages: payload.stages.iter().map(|stage| stage_to_bytes(stage, self.layout)).collect(),
                }
            }
        };
        SpanWrite {
            node_rank: rank as u32,
            start: first + piece.start as u32,
            len: piece.len as u32,
            window: piece.window,
            content,
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
