//! Nodes at a rate: the windows and stages of least error, chosen for a group of nodes together.

use chronoxel_codec::rate::{
    CodedPiece, RateOptions, RatePoint, Run, allocate, first_slopes, rate_points, slopes_for,
};
use chronoxel_codec::{CodecError, PayloadClass, decoded_range};
use chronoxel_store::stored_len;
use rayon::prelude::*;

use super::coding::Choice;
use super::node::{NodeSteps, Piece, Section};
use super::palettes;
use super::real::Real;
use super::windowed::{CHOOSING_LEVEL, NodeCoder};

/// Nodes that share a budget. Fixed, since what comes out depends on it.
pub const GROUP: usize = 16;
/// Of so many sections of a group one is tried at first, to find the slopes near the budget.
const TRIED: usize = 6;
const MAX_STAGES: usize = 3;
const NUM_ENTRIES: usize = 256;
/// What a span costs beside its payload: its record, and its share of the index of a shard.
const SPAN_BYTES: u64 = 40;

/// The classes of the payloads that [`pieces`] gives.
pub fn classes(window: u32) -> Vec<PayloadClass> {
    let mut classes = vec![PayloadClass::affine(8), PayloadClass::affine(16)];
    classes.extend(palettes::classes(window, MAX_STAGES));
    classes
}

/// A section of which the samples differ, and what its error counts over.
struct Coded<'a, T> {
    node: usize,
    section: Section<T>,
    steps: Vec<&'a [T]>,
    trained: Vec<u32>,
    whole_numbers: bool,
}

/// The pieces of each node of a group, with the least squared error at `bits` stored bits per sample and step.
///
/// # Errors
/// The place of a node that the codecs refuse, and why.
pub fn pieces<T: Real>(
    nodes: &[&NodeSteps<T>],
    bits: f64,
    coder: &NodeCoder<'_>,
) -> Result<Vec<Vec<Piece>>, (usize, CodecError)> {
    let mut pieces: Vec<Vec<Piece>> = vec![Vec::new(); nodes.len()];
    let mut coded = Vec::new();
    let mut num_samples = 0;
    for (at, node) in nodes.iter().enumerate() {
        num_samples += node.core.len() * node.samples.len();
        for section in node.sections(coder.window, true) {
            match section.piece() {
                Some(piece) => pieces[at].push(piece),
                None => coded.push(Coded {
                    node: at,
                    steps: node.samples_of(section.steps.clone()),
                    trained: node.trained(section.steps.start),
                    whole_numbers: node.whole_numbers,
                    section,
                }),
            }
        }
    }
    let num_simple = pieces.iter().map(|pieces| pieces.len() as u64).sum::<u64>();
    let budget = (bits / 8.0 * num_samples as f64) as u64;
    let chosen = choose(&coded, budget.saturating_sub(num_simple * SPAN_BYTES), coder)?;
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
    coder: &NodeCoder<'_>,
) -> Result<Vec<RatePoint>, (usize, CodecError)> {
    let [low, high] = coder.range;
    let first = first_slopes((high - low).clamp(f64::MIN_POSITIVE, 0.5 * f64::MAX.sqrt()));
    let points_at = |coded: &Coded<'_, T>, slopes: &[f64]| {
        coded.points(slopes, coder).map_err(|source| (coded.node, source))
    };
    let tried: Vec<&Coded<'_, T>> = coded.iter().step_by(TRIED).collect();
    let of_tried: Vec<_> = tried.par_iter().map(|coded| points_at(coded, &first)).collect();
    let of_tried = of_tried.into_iter().collect::<Result<Vec<_>, _>>()?;
    // What the bricks tried take stands for what all do.
    let size = |coded: &Coded<'_, T>| (coded.steps.len() * coded.trained.len()) as f64;
    let share = tried.iter().map(|c| size(c)).sum::<f64>() / coded.iter().map(size).sum::<f64>().max(1.0);
    let bytes: Vec<u64> =
        (0..first.len()).map(|s| of_tried.iter().map(|points| points[s].bytes).sum()).collect();
    drop(of_tried);
    let near = slopes_for(&first, &bytes, (budget as f64 * share) as u64);
    let points: Vec<_> = coded.par_iter().map(|coded| points_at(coded, &near)).collect();
    let points = points.into_iter().collect::<Result<Vec<_>, _>>()?;
    let chosen = allocate(&points, budget);
    let take = |(mut points, at): (Vec<RatePoint>, usize)| points.swap_remove(at);
    Ok(points.into_iter().zip(chosen).map(take).collect())
}

impl<T: Real> Coded<'_, T> {
    fn points(&self, slopes: &[f64], coder: &NodeCoder<'_>) -> Result<Vec<RatePoint>, CodecError> {
        let stored = |bytes: &[u8]| stored_len(bytes, CHOOSING_LEVEL);
        let options = RateOptions {
            max_window: self.section.width,
            max_stages: MAX_STAGES,
            num_entries: NUM_ENTRIES,
            whole_numbers: self.whole_numbers,
            span_bytes: SPAN_BYTES,
            stored_bytes: &stored,
        };
        rate_points(
            &Run { steps: &self.steps, trained: &self.trained, layout: coder.layout },
            slopes,
            &options,
        )
    }

    fn piece(&self, piece: chronoxel_codec::rate::Piece, coder: &NodeCoder<'_>) -> Result<Piece, CodecError> {
        let (choice, drawn_range) = match piece.coded {
            CodedPiece::Constant(value) => (Choice::Constant(value), [value; 2]),
            CodedPiece::Payload(payload) => {
                let drawn_range = decoded_range(&payload, coder.layout, piece.len as u32)?;
                (Choice::Coded(payload), drawn_range)
            }
        };
        let start = self.section.steps.start + piece.start;
        Ok(Piece { start, len: piece.len, window: piece.window, choice, drawn_range })
    }
}
