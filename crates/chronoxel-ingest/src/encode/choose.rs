//! The choice of `--codec auto`: the dyadic partition of a window of time, and the stages of each piece, of least stored
//! bytes whose error is nowhere above a bound.
//!
//! From single steps upwards, two neighbours in the dyadic tree become one piece where that is stored in fewer bytes:
//! as a constant, as one index per sample that serves all steps, as a table of the distinct vectors of points (see
//! [`chronoxel_codec::bounded`]), or as one static stage and a table of what remains. Every payload that is taken was
//! decoded and compared sample by sample.

use chronoxel_codec::bounded::{Lattice, Vectors};
use chronoxel_codec::{
    Payload, PayloadClass, SampleValue, Stage, StageClass, TableClass, decode_f64, decoded_range,
    quantize_affine, stage_to_bytes,
};
use chronoxel_core::{BitMask, BrickLayout};

use super::analyse::range_of;
use super::coding::{Choice, Refusal};
use super::real::Real;

/// What a span costs beside its payload: its record, and its share of the index of a shard.
const RECORD_BYTES: usize = 40;

/// One node over one window of time, ready to be coded.
#[derive(Debug, Clone)]
pub struct NodeWindow<'a, T> {
    /// Samples of the full brick for each step that exists: masked ones padded, all finite.
    pub steps: Vec<&'a [T]>,
    /// Masked samples of each step.
    pub masks: Vec<Option<&'a BitMask>>,
    /// Steps missing at the start of the window, the series beginning inside it: step `i` has place `lead + i`, and the
    /// dyadic partition is one of places.
    pub lead: usize,
    /// Places of the window: a power of two, at least `lead + steps.len()`.
    pub window: u32,
    /// Whether every sample is an integer below 2^53.
    pub whole_numbers: bool,
}

/// A run of steps that becomes one span.
#[derive(Debug, Clone, PartialEq)]
pub struct Piece {
    /// Its first step, of those of the window that exist.
    pub start: usize,
    /// Its steps.
    pub len: usize,
    /// Its window length: 1, 2, 4 …; above `len` where the series begins or ends inside it.
    pub window: u32,
    /// Its payload: [`Choice::Constant`] or [`Choice::Coded`].
    pub content: Choice,
    /// Range of the decoded samples.
    pub drawn_range: [f64; 2],
}

/// Entries of the two sizes of listed tables, and the bits of their indices.
const TABLES: [(u32, u8); 2] = [(256, 8), (1024, 16)];

/// The classes of the payloads that [`within_bound`] gives for windows up to `max_window`, a power of two.
pub fn classes(max_window: u32) -> Vec<PayloadClass> {
    let mut classes = vec![PayloadClass::affine(8), PayloadClass::affine(16)];
    let windows = std::iter::successors(Some(2), |w| Some(2 * w)).take_while(|&w| w <= max_window);
    for rows in windows {
        let listed = |(entries, index_bits)| StageClass {
            index_bits,
            table: TableClass::Listed { entries, rows },
            shift: 0,
        };
        classes.extend(TABLES.map(|table| PayloadClass { stages: vec![listed(table)] }));
        for bits in [8, 16] {
            let stages = |table| vec![StageClass::affine(bits), listed(table)];
            classes.extend(TABLES.map(|table| PayloadClass { stages: stages(table) }));
        }
    }
    classes
}

/// Chooses the pieces of a window: a partition of its steps of least stored bytes, each unmasked sample of core and apron
/// within `bound` of what its piece decodes to.
///
/// * `is_binding`: whether a bound that 16 bits cannot hold is an error; else 16 bits are taken as the best there is
/// * `stored_len`: bytes that the store would keep of the bytes of a stage
///
/// # Errors
/// [`Refusal::Bound`] as said; [`Refusal::Codec`] for samples that cannot be coded at all.
pub fn within_bound<T: Real + SampleValue>(
    node: &NodeWindow<'_, T>,
    bound: f64,
    is_binding: bool,
    layout: &BrickLayout,
    stored_len: &(dyn Fn(&[u8]) -> usize + Sync),
) -> Result<Vec<Piece>, Refusal> {
    let search = Search::new(node, bound, is_binding, layout, stored_len);
    let best = search.best(0, node.window)?;
    Ok(best.map_or_else(Vec::new, |found| found.pieces))
}

struct Search<'a, T> {
    node: &'a NodeWindow<'a, T>,
    bound: f64,
    is_binding: bool,
    layout: &'a BrickLayout,
    stored_len: &'a (dyn Fn(&[u8]) -> usize + Sync),
    /// One lattice for all steps, and their points; `None` where the bound is too small for it.
    lattice: Option<(Lattice, Vec<Vec<u16>>)>,
}

/// What is best for the steps in a run of places.
struct Found<T> {
    pieces: Vec<Piece>,
    bytes: usize,
    run: Run<T>,
}

/// What is known of a run of steps.
struct Run<T> {
    start: usize,
    len: usize,
    /// Range over steps and samples.
    range: [f64; 2],
    /// Largest difference of two samples at the same place in the brick.
    variation: f64,
    /// Smallest and largest sample over the steps, at each place in the brick; empty once `variation` is too large.
    low: Vec<T>,
    high: Vec<T>,
    /// The distinct vectors of points, where they are few.
    vectors: Option<Vectors>,
}

/// A payload and its price.
struct Candidate {
    choice: Choice,
    bytes: usize,
}

impl<'a, T: Real + SampleValue> Search<'a, T> {
    fn new(
        node: &'a NodeWindow<'a, T>,
        bound: f64,
        is_binding: bool,
        layout: &'a BrickLayout,
        stored_len: &'a (dyn Fn(&[u8]) -> usize + Sync),
    ) -> Self {
        let ranges = node.steps.iter().map(|step| range_of(step));
        let [low, high] = ranges.fold([f64::INFINITY, f64::NEG_INFINITY], |r, (low, high)| {
            [r[0].min(low.to_f64()), r[1].max(high.to_f64())]
        });
        let lattice = Lattice::within([low, high], bound, node.whole_numbers)
            .map(|lattice| (lattice, node.steps.iter().map(|step| lattice.points(step)).collect()));
        Self { node, bound, is_binding, layout, stored_len, lattice }
    }

    /// The best for places `place .. place + window`; `None` where no step is there.
    fn best(&self, place: usize, window: u32) -> Result<Option<Found<T>>, Refusal> {
        if window == 1 {
            let exists = place >= self.node.lead && place - self.node.lead < self.node.steps.len();
            return exists.then(|| self.single(place - self.node.lead)).transpose();
        }
        let half = window / 2;
        let (a, b) = match (self.best(place, half)?, self.best(place + half as usize, half)?) {
            (Some(a), Some(b)) => (a, b),
            // One half alone is no worse off in a shorter window.
            (one, other) => return Ok(one.or(other)),
        };
        let run = self.join(&a.run, &b.run);
        let bytes = a.bytes + b.bytes;
        let joined = if self.may_join(&a.run, &b.run) { self.joined(&run, window, bytes)? } else { None };
        Ok(Some(match joined {
            Some((piece, bytes)) => Found { pieces: vec![piece], bytes, run },
            None => Found { pieces: [a.pieces, b.pieces].concat(), bytes, run },
        }))
    }

    fn single(&self, at: usize) -> Result<Found<T>, Refusal> {
        let step = self.node.steps[at];
        let (low, high) = range_of(step);
        let vectors = self
            .lattice
            .as_ref()
            .filter(|_| self.node.window > 1)
            .and_then(|(_, points)| Vectors::of_keys(points[at].iter().map(|&p| u64::from(p)), 1024));
        let run = Run {
            start: at,
            len: 1,
            range: [low.to_f64(), high.to_f64()],
            variation: 0.0,
            low: step.to_vec(),
            high: step.to_vec(),
            vectors,
        };
        let candidate = match self.constant(&run) {
            Some(constant) => constant,
            None => match self.on_lattice(&run)? {
                Some(candidate) => candidate,
                None => self.affine_within_range(at)?,
            },
        };
        let bytes = candidate.bytes;
        Ok(Found { pieces: vec![self.piece(&run, 1, candidate.choice)?], bytes, run })
    }

    /// Whether two runs may share a span: all their masks are alike.
    fn may_join(&self, a: &Run<T>, b: &Run<T>) -> bool {
        let masks = &self.node.masks[a.start..b.start + b.len];
        masks.iter().all(|mask| *mask == masks[0])
    }

    fn join(&self, a: &Run<T>, b: &Run<T>) -> Run<T> {
        let mut run = Run {
            start: a.start,
            len: a.len + b.len,
            range: [a.range[0].min(b.range[0]), a.range[1].max(b.range[1])],
            variation: f64::INFINITY,
            low: Vec::new(),
            high: Vec::new(),
            vectors: None,
        };
        if a.variation <= 2.0 * self.bound && b.variation <= 2.0 * self.bound {
            run.low = a.low.iter().zip(&b.low).map(|(&a, &b)| if b < a { b } else { a }).collect();
            run.high = a.high.iter().zip(&b.high).map(|(&a, &b)| if b > a { b } else { a }).collect();
            let variation = run.low.iter().zip(&run.high).map(|(&low, &high)| high.minus(low));
            run.variation = variation.fold(T::from_f64(0.0), |m, v| if v > m { v } else { m }).to_f64();
        }
        if let (Some(a), Some(b)) = (&a.vectors, &b.vectors) {
            run.vectors = a.joined(b, 1024);
        }
        run
    }

    /// One piece for a run of several steps, if that takes fewer bytes than `bytes`.
    fn joined(&self, run: &Run<T>, window: u32, bytes: usize) -> Result<Option<(Piece, usize)>, Refusal> {
        let mut best: Option<Candidate> = None;
        let mut take = |candidate: Option<Candidate>| {
            if let Some(new) = candidate
                && new.bytes < best.as_ref().map_or(bytes, |best| best.bytes)
            {
                best = Some(new);
            }
        };
        match self.constant(run) {
            Some(constant) => take(Some(constant)),
            None => {
                take(self.fixed(run)?);
                take(self.vector_table(run, window)?);
                take(self.fixed_and_table(run, window)?);
            }
        }
        best.map(|best| Ok((self.piece(run, window, best.choice)?, best.bytes))).transpose()
    }

    fn constant(&self, run: &Run<T>) -> Option<Candidate> {
        let [low, high] = run.range;
        let value = if low == high { low } else { 0.5 * low + 0.5 * high };
        (value - low <= self.bound && high - value <= self.bound)
            .then_some(Candidate { choice: Choice::Constant(value), bytes: RECORD_BYTES })
    }

    /// One step on the lattice of all steps.
    fn on_lattice(&self, run: &Run<T>) -> Result<Option<Candidate>, Refusal> {
        let Some((lattice, points)) = &self.lattice else { return Ok(None) };
        self.checked(run, vec![lattice.affine_stage(&points[run.start])])
    }

    /// One step with 16 bits of its own range.
    fn affine_within_range(&self, at: usize) -> Result<Candidate, Refusal> {
        let stage =
            quantize_affine(self.node.steps[at], self.node.whole_numbers, 16).map_err(Refusal::Codec)?;
        let stages = vec![stage];
        let bytes = self.stored(&stages);
        let payload = Payload { stages };
        let error = if self.is_binding { self.largest_error(at, 1, &payload)? } else { 0.0 };
        if error > self.bound {
            return Err(Refusal::Bound { error, bound: self.bound });
        }
        Ok(Candidate { choice: Choice::Coded(payload), bytes })
    }

    /// One index per sample that serves all steps.
    fn fixed(&self, run: &Run<T>) -> Result<Option<Candidate>, Refusal> {
        if run.variation > 2.0 * self.bound {
            return Ok(None);
        }
        let middle: Vec<f64> =
            run.low.iter().zip(&run.high).map(|(l, h)| 0.5 * l.to_f64() + 0.5 * h.to_f64()).collect();
        let room = self.bound - 0.5 * run.variation;
        let whole = self.node.whole_numbers && run.variation == 0.0;
        let Some(lattice) = Lattice::within(run.range, room, whole) else {
            return Ok(None);
        };
        self.checked(run, vec![lattice.affine_stage(&lattice.points(&middle))])
    }

    /// A table of the distinct vectors of points.
    fn vector_table(&self, run: &Run<T>, window: u32) -> Result<Option<Candidate>, Refusal> {
        let (Some((lattice, points)), Some(vectors)) = (&self.lattice, &run.vectors) else { return Ok(None) };
        let steps: Vec<Vec<i32>> = points[run.start..run.start + run.len]
            .iter()
            .map(|points| points.iter().map(|&p| i32::from(p)).collect())
            .collect();
        self.checked(run, vec![vectors.listed_stage(lattice, &steps, window as usize)])
    }

    /// A static stage of the middle over the steps, and a table of what remains.
    fn fixed_and_table(&self, run: &Run<T>, window: u32) -> Result<Option<Candidate>, Refusal> {
        let Some((lattice, points)) = &self.lattice else { return Ok(None) };
        let points = &points[run.start..run.start + run.len];
        let mut low = points[0].clone();
        let mut high = points[0].clone();
        for step in &points[1..] {
            low.iter_mut().zip(step).for_each(|(low, &p)| *low = (*low).min(p));
            high.iter_mut().zip(step).for_each(|(high, &p)| *high = (*high).max(p));
        }
        let middle: Vec<u16> = low.iter().zip(&high).map(|(&low, &high)| low + (high - low) / 2).collect();
        let rest: Vec<Vec<i32>> = points
            .iter()
            .map(|step| step.iter().zip(&middle).map(|(&p, &m)| i32::from(p) - i32::from(m)).collect())
            .collect();
        let mut keys = vec![0u64; middle.len()];
        for step in &rest {
            keys.iter_mut().zip(step).for_each(|(key, &r)| {
                *key = (key.rotate_left(23) ^ r as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            });
        }
        let Some(vectors) = Vectors::of_keys(keys.into_iter(), 1024) else { return Ok(None) };
        let around_zero = Lattice { offset: 0.0, ..*lattice };
        let table = vectors.listed_stage(&around_zero, &rest, window as usize);
        self.checked(run, vec![lattice.affine_stage(&middle), table])
    }

    /// The candidate of these stages, if it holds the bound.
    fn checked(&self, run: &Run<T>, stages: Vec<Stage>) -> Result<Option<Candidate>, Refusal> {
        let stages: Result<Vec<Stage>, _> =
            stages.into_iter().map(|stage| stage.into_canonical(self.layout)).collect();
        let payload = Payload { stages: stages.map_err(Refusal::Codec)? };
        if self.largest_error(run.start, run.len, &payload)? > self.bound {
            return Ok(None);
        }
        let bytes = self.stored(&payload.stages);
        Ok(Some(Candidate { choice: Choice::Coded(payload), bytes }))
    }

    fn stored(&self, stages: &[Stage]) -> usize {
        let stored = |stage| (self.stored_len)(&stage_to_bytes(stage, self.layout));
        RECORD_BYTES + stages.iter().map(stored).sum::<usize>()
    }

    /// The largest difference between an unmasked sample and its decoded value.
    fn largest_error(&self, start: usize, len: usize, payload: &Payload) -> Result<f64, Refusal> {
        let mut largest = 0.0f64;
        for row in 0..len {
            let decoded = decode_f64(payload, self.layout, row as u32).map_err(Refusal::Codec)?;
            let mask = self.node.masks[start + row];
            for (at, (sample, decoded)) in self.node.steps[start + row].iter().zip(decoded).enumerate() {
                let error = (decoded - sample.to_f64()).abs();
                if error > largest && mask.is_none_or(|mask| !mask.get(at)) {
                    largest = error;
                }
            }
        }
        Ok(largest)
    }

    fn piece(&self, run: &Run<T>, window: u32, content: Choice) -> Result<Piece, Refusal> {
        let drawn_range = match &content {
            Choice::Empty => [f64::NAN; 2],
            Choice::Constant(value) => [*value; 2],
            Choice::Coded(payload) => {
                decoded_range(payload, self.layout, run.len as u32).map_err(Refusal::Codec)?
            }
        };
        Ok(Piece { start: run.start, len: run.len, window, content, drawn_range })
    }
}
