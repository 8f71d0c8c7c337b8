//! One variable on its way through the steps: how it is coded, what waits, and the range seen so far.

use std::path::Path;

use chronoxel_codec::PayloadClass;
use chronoxel_core::{BrickLayout, LevelGeometry, Octree};
use chronoxel_store::{SpanWrite, StoreWriter};

use super::coding::{CodedBrick, code};
use super::mark::{Marks, width_of};
use super::moments::{self, TimeMoments};
use super::rate::{self, Spending};
use super::real::Real;
use super::source::Source;
use super::step::{CutBrick, Feed, Stepper};
use super::timing::Timing;
use super::windowed::{Arrival, Method, NodeCoder, OpenWindows};
use crate::EncodeError;

/// How a variable is to be coded.
#[derive(Debug, Clone, PartialEq)]
pub struct Coding {
    /// Its name, for messages.
    pub name: String,
    /// Value that means "no data".
    pub fill_value: Option<f64>,
    /// The range errors refer to, where the user gave one.
    pub range: Option<[f64; 2]>,
    /// The method.
    pub how: How,
}

/// One step at a time, or windows of them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum How {
    /// Each step by itself, quantised within the range of each brick.
    Steps {
        /// Bits of an index.
        bits: u8,
    },
    /// Windows of steps.
    Windows {
        /// Steps of the longest: a power of two.
        window: u32,
        /// How they are coded.
        method: Method,
    },
}

impl How {
    /// Nodes that are coded together.
    pub fn held_nodes(&self, finest: &LevelGeometry) -> u64 {
        match self {
            Self::Windows { method: Method::Slices, .. } => {
                (finest.bricks[0] as u64).saturating_mul(finest.bricks[1] as u64)
            }
            Self::Windows { method: Method::Rate { .. }, .. } => rate::GROUP as u64,
            _ => 0,
        }
    }

    /// Bytes of what such a node may be coded as, for each sample and step.
    pub fn held_payload_bytes(&self) -> u64 {
        match self {
            // Indices of a few slopes; the more bits, the more stages or the shorter windows.
            Self::Windows { method: Method::Rate { bits }, .. } => 4 + bits.clamp(1.0, 16.0) as u64,
            _ => 4,
        }
    }

    /// Level of zstd: payloads of whole windows are few against what is read, and may take longer to compress.
    pub fn zstd_level(&self) -> i32 {
        match self {
            Self::Steps { .. } => 1,
            Self::Windows { method: Method::Palettes { .. } | Method::Slices, .. } => 3,
            Self::Windows { method: Method::Bound { .. } | Method::Rate { .. }, .. } => 9,
        }
    }

    /// Window lengths that spans may have.
    pub fn windows(&self) -> Vec<u32> {
        match self {
            Self::Steps { .. } => vec![1],
            Self::Windows { window, .. } => (0..=window.ilog2()).map(|log| 1 << log).collect(),
        }
    }

    /// Steps of the longest window.
    pub fn window(&self) -> u32 {
        match self {
            Self::Steps { .. } => 1,
            Self::Windows { window, .. } => *window,
        }
    }

    /// Copies of a window's samples that coding one node holds; 0 where nothing waits.
    pub fn copies(&self) -> u64 {
        match self {
            Self::Steps { .. } => 0,
            // The samples; in units of their range, or as points; what is left of them; indices and tables.
            Self::Windows { .. } => 5,
        }
    }

    /// Classes that payloads may have.
    pub fn classes(&self, layout: &BrickLayout) -> Vec<PayloadClass> {
        match self {
            Self::Steps { bits } => vec![PayloadClass::affine(*bits)],
            Self::Windows { window, method } => method.classes(*window, layout),
        }
    }
}

/// A variable and what the encoder keeps of it from step to step.
pub struct VariableEncoder<'a> {
    /// Its index in the series.
    index: usize,
    /// Its index in the store.
    variable: usize,
    coding: &'a Coding,
    classes: Vec<PayloadClass>,
    open: OpenSteps,
    /// Range of the source up to each of the last steps; the last is that of the last step read.
    ranges: Vec<[f64; 2]>,
}

/// What is open between steps, in the number type of the source.
enum OpenSteps {
    F32(Open<f32>),
    F64(Open<f64>),
}

struct Open<T> {
    /// Of codecs that use time.
    windows: Option<OpenWindows<T>>,
    moments: TimeMoments<T>,
}

/// What a variable goes on from.
pub struct Before {
    /// Range of the source up to each of the last steps before the one to read next.
    pub ranges: Vec<[f64; 2]>,
    /// What was spent up to the last commit, where there is a rate to meet.
    pub spending: Option<Spending>,
    /// The step that statistics go on from.
    pub first: u32,
}

/// What coding a step needs besides the variable.
pub struct StepTask<'a> {
    /// Slabs, levels, nodes.
    pub stepper: Stepper<'a>,
    /// Nodes whose windows are coded at once.
    pub batch_nodes: usize,
    /// The step.
    pub step: u32,
}

impl<'a> VariableEncoder<'a> {
    /// Before the first step, or as an interrupted run left it.
    ///
    /// * `index`, `variable`: its index in the series, and in the store
    pub fn new(
        [index, variable]: [usize; 2],
        coding: &'a Coding,
        fits_f32: bool,
        places: &Places<'_>,
        before: Before,
        writer: &StoreWriter,
    ) -> Result<Self, EncodeError> {
        let Before { ranges, spending, first } = before;
        let spending = match coding.how {
            How::Windows { method: Method::Rate { bits }, .. } => spending.or(Some(Spending::new(
                bits,
                places.source_samples,
                places.samples,
                places.num_steps,
            ))),
            _ => None,
        };
        let open = match fits_f32 {
            true => OpenSteps::F32(Open::new(variable, coding, places, spending, first, writer)?),
            false => OpenSteps::F64(Open::new(variable, coding, places, spending, first, writer)?),
        };
        Ok(Self { index, variable, coding, classes: coding.how.classes(places.layout), open, ranges })
    }

    /// What was spent, where there is a rate to meet: what a resume needs.
    pub fn spending(&self) -> Option<&Spending> {
        match &self.open {
            OpenSteps::F32(open) => open.windows.as_ref()?.spending(),
            OpenSteps::F64(open) => open.windows.as_ref()?.spending(),
        }
    }

    /// Ranges of the source up to each of the last steps: what a resume needs.
    pub fn ranges(&self) -> &[[f64; 2]] {
        &self.ranges
    }

    /// Reads a step and puts the spans and statistics that it completes.
    pub fn encode_step(
        &mut self,
        source: &mut Source<'_>,
        task: &StepTask<'_>,
        writer: &mut StoreWriter,
        on_bricks: &mut dyn FnMut(u8, usize),
    ) -> Result<Marks, EncodeError> {
        let feed = source.feed(self.index, task.step as usize)?;
        let Self { variable, coding, classes, ranges, .. } = self;
        let run = VariableStep { variable: *variable, coding, classes, task };
        match &mut self.open {
            OpenSteps::F32(open) => run.read(feed, open, ranges, writer, on_bricks),
            OpenSteps::F64(open) => run.read(feed, open, ranges, writer, on_bricks),
        }
    }
}

impl<T: Real> Open<T> {
    fn new(
        variable: usize,
        coding: &Coding,
        places: &Places<'_>,
        spending: Option<Spending>,
        first: u32,
        writer: &StoreWriter,
    ) -> Result<Self, EncodeError> {
        // Half of the memory, if that is enough.
        let moments_bytes = TimeMoments::<T>::short_bytes(places);
        let in_memory = moments_bytes <= places.scratch_bytes / 2;
        let moments = TimeMoments::new(variable, places, first, in_memory, writer)?;
        let left = places.scratch_bytes - if in_memory { moments_bytes } else { 0 };
        let places = &Places { scratch_bytes: left, ..*places };
        let windows = match coding.how {
            How::Steps { .. } => None,
            How::Windows { window, .. } => {
                let timing = Timing { window, num_steps: places.num_steps };
                Some(OpenWindows::new(timing, places, spending)?)
            }
        };
        Ok(Self { windows, moments })
    }
}

/// What all variables share.
#[derive(Clone, Copy)]
pub struct Places<'a> {
    /// The nodes.
    pub tree: &'a Octree,
    /// Nodes without children.
    pub num_leaves: u64,
    /// Core samples inside the grid, over the nodes of each level.
    pub samples: &'a [u64],
    /// Source samples of a step.
    pub source_samples: u64,
    /// The shape of bricks.
    pub layout: &'a BrickLayout,
    /// Steps of the series.
    pub num_steps: u32,
    /// Every so many samples along each axis take part in the temporal error.
    pub stride: u32,
    /// Where scratch files may lie.
    pub folder: &'a Path,
    /// What may wait in memory, of each variable.
    pub scratch_bytes: u64,
}

/// What looks at every brick of a step before it is coded; called in parallel.
type Observe<'a, T> = dyn Fn(&CutBrick<'_, T>) -> Result<(), EncodeError> + Sync + 'a;

/// One step of one variable.
struct VariableStep<'a> {
    variable: usize,
    coding: &'a Coding,
    classes: &'a [PayloadClass],
    task: &'a StepTask<'a>,
}

impl VariableStep<'_> {
    fn read<T: Real>(
        &self,
        feed: Feed<'_>,
        open: &mut Open<T>,
        ranges: &mut Vec<[f64; 2]>,
        writer: &mut StoreWriter,
        on_bricks: &mut dyn FnMut(u8, usize),
    ) -> Result<Marks, EncodeError> {
        let Open { windows, moments } = open;
        let StepTask { stepper, step, .. } = self.task;
        moments.begin(*step, writer)?;
        // Over the steps before this one: known while its bricks arrive.
        let range = self.coding.range.or(ranges.last().copied()).map_or(0.0, width_of);
        let observe = |brick: &CutBrick<'_, T>| moments.take(brick, *step, range);
        let marks = match windows {
            None => self.steps(feed, &observe, ranges, writer, on_bricks)?,
            Some(open) => self.windows(feed, &observe, open, ranges, writer, on_bricks)?,
        };
        moments.end(*step, stepper.tree, writer)?;
        Ok(marks)
    }

    /// Each brick is coded at once.
    fn steps<T: Real>(
        &self,
        feed: Feed<'_>,
        observe: &Observe<'_, T>,
        ranges: &mut Vec<[f64; 2]>,
        writer: &mut StoreWriter,
        on_bricks: &mut dyn FnMut(u8, usize),
    ) -> Result<Marks, EncodeError> {
        // A resume reads some steps again, for their statistics alone: all nodes of such a step were put.
        let is_put = writer.covered_until(self.variable, 0, 0) > self.task.step;
        let of_brick = |brick: CutBrick<'_, T>| {
            observe(&brick)?;
            if is_put { Ok(None) } else { self.span(brick).map(Some) }
        };
        let mut put = |level, spans: Vec<Option<SpanWrite>>| match is_put {
            true => Ok(()),
            false => Ok(writer.put(self.variable, level, spans.into_iter().flatten().collect())?),
        };
        let fill_value = self.coding.fill_value;
        let marks = self.task.stepper.each_brick(feed, fill_value, &of_brick, &mut put, on_bricks)?;
        self.see(&marks, ranges);
        Ok(marks)
    }

    /// Takes the range of a step to those before it.
    fn see(&self, marks: &Marks, ranges: &mut Vec<[f64; 2]>) {
        let [low, high] = ranges.last().copied().unwrap_or([f64::INFINITY, f64::NEG_INFINITY]);
        ranges.push([low.min(marks.range[0]), high.max(marks.range[1])]);
        // A resume goes back to the first step of an open window at most, or to where statistics go on.
        if ranges.len() > self.coding.how.window().max(moments::KEPT_STEPS) as usize + 1 {
            ranges.remove(0);
        }
    }

    fn span<T: Real>(&self, brick: CutBrick<'_, T>) -> Result<SpanWrite, EncodeError> {
        let layout = &self.task.stepper.plan.layout;
        let How::Steps { bits } = self.coding.how else { unreachable!("windows are coded when they end") };
        let step = self.task.step;
        let CodedBrick { choice, mask, drawn_range } = code(brick.samples, &brick.analysis, bits, layout)
            .map_err(|refusal| {
                refusal.into_error(&self.coding.name, step as usize, brick.geometry.level, brick.brick, 0.0)
            })?;
        Ok(SpanWrite {
            node_rank: brick.rank,
            start: step,
            len: 1,
            window: 1,
            content: choice.into_content(self.classes, layout),
            mask,
            drawn_range,
            statistics: brick.analysis.statistics,
        })
    }

    /// Bricks wait; those whose windows end with the step are coded once it is read.
    fn windows<T: Real>(
        &self,
        feed: Feed<'_>,
        observe: &Observe<'_, T>,
        open: &mut OpenWindows<T>,
        ranges: &mut Vec<[f64; 2]>,
        writer: &mut StoreWriter,
        on_bricks: &mut dyn FnMut(u8, usize),
    ) -> Result<Marks, EncodeError> {
        let How::Windows { window, method } = self.coding.how else {
            unreachable!("single steps have no windows")
        };
        let StepTask { stepper, batch_nodes, step } = self.task;
        // A resume reads some steps again: what was put of them already does not wait.
        let is_put = |level, rank| writer.covered_until(self.variable, level, rank) > *step;
        let of_brick = |brick: CutBrick<'_, T>| {
            observe(&brick)?;
            Ok((!is_put(brick.geometry.level, brick.rank)).then(|| Arrival::new(brick)))
        };
        let mut wait =
            |level, arrivals: Vec<Option<Arrival<T>>>| open.wait(level, arrivals.into_iter().flatten());
        let marks = stepper.each_brick(feed, self.coding.fill_value, &of_brick, &mut wait, on_bricks)?;
        self.see(&marks, ranges);
        let coder = NodeCoder {
            layout: &stepper.plan.layout,
            levels: &stepper.plan.levels,
            tree: stepper.tree,
            method,
            range: self.coding.range.unwrap_or(ranges[ranges.len() - 1]),
            zstd_level: writer.header().zstd_level,
            classes: self.classes,
            variable: &self.coding.name,
            window,
            batch_nodes: *batch_nodes,
        };
        let mut put = |level, spans| Ok(writer.put(self.variable, level, spans)?);
        open.close(*step, &coder, &mut put)?;
        Ok(marks)
    }
}
