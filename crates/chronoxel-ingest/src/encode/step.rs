//! One step of one variable: from its slices to the spans of all its bricks.

use chronoxel_codec::{PayloadClass, SampleValue, stage_to_bytes};
use chronoxel_core::{LevelGeometry, NodeId, Octree};
use chronoxel_store::{SpanContent, SpanWrite};
use rayon::prelude::*;

use super::analyse::{Analysis, analyse};
use super::coding::{Choice, CodedBrick, Demand, Refusal, code};
use super::cut::cut;
use super::mark::Marks;
use super::real::Real;
use super::stream::{Layer, StreamPlan, stream};
use crate::{EncodeError, StepReader};

/// How a variable is to be coded.
#[derive(Debug, Clone, PartialEq)]
pub struct Coding {
    /// Its name, for messages.
    pub name: String,
    /// Value that means "no data".
    pub fill_value: Option<f64>,
    /// Bits per index where no error is given.
    pub bits: u8,
    /// Largest error, relative to the range.
    pub max_error: Option<f64>,
    /// The range errors refer to, where the user gave one.
    pub range: Option<[f64; 2]>,
}

impl Coding {
    /// The classes its payloads may have.
    pub fn classes(&self) -> Vec<PayloadClass> {
        match self.max_error {
            Some(_) => [8, 16].map(PayloadClass::affine).into(),
            None => vec![PayloadClass::affine(self.bits)],
        }
    }

    fn class(&self, index_bits: u8) -> u8 {
        u8::from(self.max_error.is_some() && index_bits == 16)
    }

    /// The demand on bricks of a level, the range seen so far being `seen`.
    fn demand(&self, level: u8, seen: [f64; 2]) -> Demand {
        let [low, high] = self.range.unwrap_or(seen);
        // Halved before the difference and doubled after, which cannot overflow on the way.
        let width = 2.0 * (0.5 * high - 0.5 * low).clamp(0.0, 0.5 * f64::MAX);
        Demand { bits: self.bits, bound: self.max_error.map(|e| e * width), bound_is_binding: level == 0 }
    }
}

/// What does not change from step to step.
pub struct Encoder<'a> {
    /// Slabs and levels.
    pub plan: &'a StreamPlan,
    /// The nodes, for their ranks.
    pub tree: &'a Octree,
    /// Bricks coded at once.
    pub batch_bricks: usize,
}

/// Where the spans of a batch of bricks of one level go.
pub type PutSpans<'a> = dyn FnMut(u8, Vec<SpanWrite>) -> Result<(), EncodeError> + Send + 'a;

impl Encoder<'_> {
    /// Reads a step from its first slice to its last and hands on the spans of all bricks: layer by layer as
    /// [`stream`] completes them, in Morton order within a layer.
    ///
    /// * `seen`: range of the variable over all steps before
    /// * `put`: takes batches one after the other, each while the next is coded
    /// * `on_bricks`: told how many bricks of which level were coded
    pub fn encode_step<T: Real + SampleValue>(
        &self,
        reader: Box<dyn StepReader + '_>,
        coding: &Coding,
        step: usize,
        seen: [f64; 2],
        put: &mut PutSpans<'_>,
        on_bricks: &mut dyn FnMut(u8, usize),
    ) -> Result<Marks, EncodeError> {
        let mut coded: Option<(u8, Vec<SpanWrite>)> = None;
        let marks = stream::<T, EncodeError>(reader, self.plan, coding.fill_value, &mut |layer| {
            let seen = [seen[0].min(layer.marks.range[0]), seen[1].max(layer.marks.range[1])];
            let level = layer.window.geometry.level;
            let demand = coding.demand(level, seen);
            let bricks = self.bricks_of(&layer.window.geometry, layer.z);
            for batch in bricks.chunks(self.batch_bricks) {
                let before = coded.take();
                let (spans, written) = rayon::join(
                    || self.batch(&layer, batch, coding, &demand, step),
                    || before.map_or(Ok(()), |(level, spans)| put(level, spans)),
                );
                written?;
                coded = Some((level, spans?));
                on_bricks(level, batch.len());
            }
            Ok(())
        })?;
        coded.map_or(Ok(()), |(level, spans)| put(level, spans))?;
        Ok(marks)
    }

    /// Ranks and places of the bricks of a layer, by rank.
    fn bricks_of(&self, geometry: &LevelGeometry, z: usize) -> Vec<(u32, [usize; 3])> {
        let [nx, ny, _] = geometry.bricks;
        let mut bricks: Vec<_> = (0..ny)
            .flat_map(|y| (0..nx).map(move |x| [x, y, z]))
            .filter_map(|brick| {
                let node = NodeId::new(geometry.level, brick.map(|b| b as u32));
                self.tree.rank(node).map(|rank| (rank as u32, brick))
            })
            .collect();
        bricks.sort_unstable();
        bricks
    }

    fn batch<T: Real + SampleValue>(
        &self,
        layer: &Layer<'_, T>,
        batch: &[(u32, [usize; 3])],
        coding: &Coding,
        demand: &Demand,
        step: usize,
    ) -> Result<Vec<SpanWrite>, EncodeError> {
        let layout = &self.plan.layout;
        let geometry = &layer.window.geometry;
        let spans: Vec<Result<SpanWrite, EncodeError>> = batch
            .par_iter()
            .map_init(Vec::new, |samples: &mut Vec<T>, &(rank, brick)| {
                let may_be_masked = cut(layer.window, brick, layout, samples);
                let analysis = analyse(samples, may_be_masked, brick, geometry, layout);
                let coded = code(samples, &analysis, demand, layout)
                    .map_err(|refusal| refused(refusal, coding, step, geometry.level, brick))?;
                Ok(self.span(rank, step, coded, &analysis, coding))
            })
            .collect();
        // In order, so that of several errors it is always the first.
        spans.into_iter().collect()
    }

    fn span(
        &self,
        node_rank: u32,
        step: usize,
        coded: CodedBrick,
        analysis: &Analysis,
        coding: &Coding,
    ) -> SpanWrite {
        let content = match coded.choice {
            Choice::Empty => SpanContent::Empty,
            Choice::Constant(value) => SpanContent::Constant(value),
            Choice::Coded(payload) => SpanContent::Coded {
                class: coding.class(payload.stages[0].indices.bits()),
                stages: payload.stages.iter().map(|stage| stage_to_bytes(stage, &self.plan.layout)).collect(),
            },
        };
        SpanWrite {
            node_rank,
            start: step as u32,
            len: 1,
            window: 1,
            content,
            mask: coded.mask,
            drawn_range: coded.drawn_range,
            statistics: analysis.statistics,
        }
    }
}

fn refused(refusal: Refusal, coding: &Coding, step: usize, level: u8, brick: [usize; 3]) -> EncodeError {
    let variable = coding.name.clone();
    match refusal {
        Refusal::Bound { error, bound } => EncodeError::Bound {
            variable,
            step,
            brick,
            max_error: coding.max_error.unwrap_or(0.0),
            error,
            bound,
        },
        Refusal::Codec(source) => {
            EncodeError::Brick { variable, step, level, brick, source: Box::new(source) }
        }
    }
}
