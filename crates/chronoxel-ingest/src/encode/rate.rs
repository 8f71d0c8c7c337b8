//! Nodes at a rate: the windows and stages of least error, chosen for a group of nodes together.
//!
//! What a group leaves of its share is spread over all groups to come, so that the series as a whole meets the rate, and
//! quiet times save for busy ones.

use chronoxel_codec::rate::{CodedPiece, RateOptions, RatePoint, Run, choose_points, rate_points};
use chronoxel_codec::{CodecError, PayloadClass, decode_f64, decoded_range, stage_to_bytes};
use chronoxel_store::stored_len;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::choose::{self, NodeWindow, RECORD_BYTES, within_bound};
use super::coding::Choice;
use super::node::{NodeSteps, Piece};
use super::palettes;
use super::real::Real;
use super::windowed::{CHOOSING_LEVEL, NodeCoder};

/// Nodes that share a budget. Fixed, since what comes out depends on it.
pub const GROUP: usize = 8;
/// What a store takes beside its spans: the header, and the metadata of the arrays of a level.
const HEADER_BYTES: f64 = 4096.0;
const LEVEL_BYTES: f64 = 14336.0;
const MAX_STAGES: usize = 3;
const NUM_ENTRIES: usize = 256;
const SPAN_BYTES: u64 = RECORD_BYTES as u64;

/// The classes of the payloads that [`pieces`] gives.
pub fn classes(window: u32) -> Vec<PayloadClass> {
    let mut classes = vec![PayloadClass::affine(8), PayloadClass::affine(16)];
    classes.extend(palettes::classes(window, MAX_STAGES));
    for class in choose::classes(window) {
        if !classes.contains(&class) {
            classes.push(class);
        }
    }
    classes
}

/// What was spent of the bytes of a variable: what is left is spread evenly over what is to come.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Spending {
    /// Bytes for everything.
    budget_bytes: f64,
    /// Samples of all levels and steps.
    num_samples: f64,
    spent_bytes: f64,
    coded_samples: f64,
    /// Squared error that a bit saved in the group before: where the search begins.
    slope: Option<f64>,
}

impl Spending {
    /// At the start of a series.
    ///
    /// * `bits`: stored bits per finest sample and step, on average over the series
    /// * `finest`: number of finest samples
    /// * `levels`: number of samples of each level
    pub fn new(bits: f64, finest: u64, levels: &[u64], num_steps: u32) -> Self {
        let num_steps = f64::from(num_steps);
        let all = bits / 8.0 * finest as f64 * num_steps;
        let overhead = HEADER_BYTES + LEVEL_BYTES * levels.len() as f64;
        Self {
            budget_bytes: (all - overhead).max(0.5 * all),
            num_samples: levels.iter().map(|&n| n as f64).sum::<f64>() * num_steps,
            spent_bytes: 0.0,
            coded_samples: 0.0,
            slope: None,
        }
    }

    /// To what the share of a group may stretch: a part of what is left for all that follow.
    fn stretched(&self, share: u64) -> u64 {
        let left = (self.budget_bytes - self.spent_bytes).max(0.0) as u64;
        (3 * share).min(share + left.saturating_sub(share) / 4)
    }

    /// Bytes for some samples.
    fn share(&self, num_samples: f64) -> u64 {
        let left = (self.num_samples - self.coded_samples).max(num_samples);
        ((self.budget_bytes - self.spent_bytes).max(0.0) * num_samples / left) as u64
    }
}

/// A section of which the samples differ, and what its error counts over.
struct Coded<'a, T> {
    node: usize,
    /// Its first step, counted from the node's.
    start: usize,
    window: NodeWindow<'a, T>,
    trained: Vec<u32>,
}

/// The pieces of each node of a group, with the least squared error for their share of the bytes.
///
/// # Errors
/// The place of a node that the codecs refuse, and why.
pub fn pieces<T: Real>(
    nodes: &[&NodeSteps<T>],
    spending: &mut Spending,
    coder: &NodeCoder<'_>,
) -> Result<Vec<Vec<Piece>>, (usize, CodecError)> {
    let mut pieces: Vec<Vec<Piece>> = vec![Vec::new(); nodes.len()];
    let mut coded = Vec::new();
    for (at, node) in nodes.iter().enumerate() {
        for section in node.sections(coder.window, true) {
            match section.piece() {
                Some(piece) => pieces[at].push(piece),
                None => coded.push(Coded {
                    node: at,
                    start: section.steps.start,
                    window: NodeWindow::of_section(node, &section),
                    trained: node.trained(section.steps.start),
                }),
            }
        }
    }
    let num_samples = nodes.iter().map(|node| (node.core.len() * node.samples.len()) as f64).sum();
    let simple_bytes = pieces.iter().map(|pieces| pieces.len() as u64).sum::<u64>() * SPAN_BYTES;
    let budget = spending.share(num_samples).saturating_sub(simple_bytes);
    let chosen = choose(&coded, budget, spending, coder)?;
    spending.coded_samples += num_samples;
    spending.spent_bytes += (simple_bytes + chosen.iter().map(|point| point.bytes).sum::<u64>()) as f64;
    for (coded, point) in coded.iter().zip(chosen) {
        for piece in point.pieces {
            let piece = coded.piece(piece, coder).map_err(|source| (coded.node, source))?;
            pieces[coded.node].push(piece);
        }
    }
    pieces.iter_mut().for_each(|pieces| pieces.sort_by_key(|piece| piece.start));
    Ok(pieces)
}

/// One point for each section, within the budget together.
fn choose<T: Real>(
    coded: &[Coded<'_, T>],
    budget: u64,
    spending: &mut Spending,
    coder: &NodeCoder<'_>,
) -> Result<Vec<RatePoint>, (usize, CodecError)> {
    if coded.is_empty() {
        return Ok(Vec::new());
    }
    let [low, high] = coder.range;
    let range = (high - low).clamp(f64::MIN_POSITIVE, 0.5 * f64::MAX.sqrt());
    let evaluate = |bricks: &[usize], slopes: &[f64]| {
        let points = bricks
            .par_iter()
            .map(|&at| coded[at].points(slopes, coder).map_err(|source| (coded[at].node, source)));
        points.collect::<Vec<_>>().into_iter().collect()
    };
    let most = spending.stretched(budget);
    let (chosen, slope) = choose_points(coded.len(), range, budget, spending.slope, most, evaluate)?;
    // None is suggested by a group without a choice.
    spending.slope = Some(slope).filter(|slope| *slope > 0.0);
    Ok(chosen)
}

impl<T: Real> Coded<'_, T> {
    fn points(&self, slopes: &[f64], coder: &NodeCoder<'_>) -> Result<Vec<RatePoint>, CodecError> {
        let stored = |bytes: &[u8]| stored_len(bytes, coder.zstd_level);
        let options = RateOptions {
            max_window: self.window.window,
            max_stages: MAX_STAGES,
            num_entries: NUM_ENTRIES,
            whole_numbers: self.window.whole_numbers,
            span_bytes: SPAN_BYTES,
            stored_bytes: &stored,
        };
        let run = Run { steps: &self.window.steps, trained: &self.trained, layout: coder.layout };
        let mut points = rate_points(&run, slopes, &options)?;
        for (point, &slope) in points.iter_mut().zip(slopes) {
            let cost = |point: &RatePoint| point.squared_error + slope * 8.0 * point.bytes as f64;
            if let Some(bounded) = self.bounded_point(slope, coder)?.filter(|found| cost(found) < cost(point))
            {
                *point = bounded;
            }
        }
        Ok(points)
    }

    /// The fewest bytes within the bound that suits a slope: best where samples move slowly and quality is high.
    ///
    /// A uniform quantiser of step `2 E` errs by `E² / 3` on average, and one more bit for each sample saves `2 ln 2` of that.
    fn bounded_point(&self, slope: f64, coder: &NodeCoder<'_>) -> Result<Option<RatePoint>, CodecError> {
        let bound = (3.0 * slope / (2.0 * std::f64::consts::LN_2)).sqrt();
        let weighed = |bytes: &[u8]| stored_len(bytes, CHOOSING_LEVEL);
        let Ok(pieces) = within_bound(&self.window, bound, false, coder.layout, &weighed) else {
            return Ok(None);
        };
        let mut point = RatePoint { pieces: Vec::new(), bytes: 0, squared_error: 0.0 };
        for piece in pieces {
            point.bytes += SPAN_BYTES;
            let coded = match piece.choice {
                Choice::Coded(payload) => {
                    let bytes = payload.stages.iter().map(|stage| stage_to_bytes(stage, coder.layout));
                    point.bytes +=
                        bytes.map(|bytes| stored_len(&bytes, coder.zstd_level) as u64).sum::<u64>();
                    CodedPiece::Payload(payload)
                }
                Choice::Constant(value) => CodedPiece::Constant(value),
                Choice::Empty => return Ok(None),
            };
            for step in 0..piece.len {
                let samples = self.window.steps[piece.start + step];
                point.squared_error += match &coded {
                    CodedPiece::Constant(value) => self.squared_error(samples, |_| *value),
                    CodedPiece::Payload(payload) => {
                        let decoded = decode_f64(payload, coder.layout, step as u32)?;
                        self.squared_error(samples, |i| decoded[i])
                    }
                };
            }
            let (start, len, window) = (piece.start, piece.len, piece.window);
            point.pieces.push(chronoxel_codec::rate::Piece { start, len, window, coded });
        }
        Ok(Some(point))
    }

    fn squared_error(&self, samples: &[T], decoded: impl Fn(usize) -> f64) -> f64 {
        let error = |&i: &u32| (decoded(i as usize) - samples[i as usize].to_f64()).powi(2);
        self.trained.iter().map(error).sum()
    }

    fn piece(&self, piece: chronoxel_codec::rate::Piece, coder: &NodeCoder<'_>) -> Result<Piece, CodecError> {
        let (choice, drawn_range) = match piece.coded {
            CodedPiece::Constant(value) => (Choice::Constant(value), [value; 2]),
            CodedPiece::Payload(payload) => {
                let drawn_range = decoded_range(&payload, coder.layout, piece.len as u32)?;
                (Choice::Coded(payload), drawn_range)
            }
        };
        let start = self.start + piece.start;
        Ok(Piece { start, len: piece.len, window: piece.window, choice, drawn_range })
    }
}
