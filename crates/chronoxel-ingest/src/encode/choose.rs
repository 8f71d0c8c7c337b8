//! The choice of `--codec auto`: the dyadic partition of a window of time, and the stages of each piece, of least stored
//! bytes whose error is nowhere above a bound.
//!
//! From single steps upwards, two neighbours in the dyadic tree become one piece where that is stored in fewer bytes:
//! as a constant, as one index per sample that serves all steps, as a table of the distinct vectors of points (see
//! [`chronoxel_codec::bounded`]), or as one static stage and a table of what remains. Every payload that is taken was
//! decoded and compared sample by sample.

use chronoxel_codec::bounded::{Cover, Lattice, Vectors};
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

/// Of so many samples one is looked at where a share of them will do; prime to the edges of bricks.
const SAMPLED: usize = 13;

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
struct Found {
    pieces: Vec<Piece>,
    bytes: usize,
    run: Run,
}

/// What is known of a run of steps.
struct Run {
    start: usize,
    len: usize,
    /// Range over steps and samples.
    range: [f64; 2],
    /// Lowest and highest point over the steps, for each sample; empty where there is no lattice.
    low: Vec<u16>,
    high: Vec<u16>,
    /// The distinct vectors of cells, where they are few.
    vectors: Option<Vectors>,
    /// Whether few boxes hold the vectors of all samples, as far as is known.
    has_cover: bool,
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
        let lattice = Lattice::within([low, high], bound, node.whole_numbers).map(|lattice| {
            let lattice =
                lattice.moved_to(node.steps.iter().flat_map(|s| s.iter().step_by(SAMPLED).copied()));
            (lattice, node.steps.iter().map(|step| lattice.points(step)).collect())
        });
        Self { node, bound, is_binding, layout, stored_len, lattice }
    }

    /// The best for places `place .. place + window`; `None` where no step is there.
    fn best(&self, place: usize, window: u32) -> Result<Option<Found>, Refusal> {
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
        let mut run = self.join(&a.run, &b.run);
        let bytes = a.bytes + b.bytes;
        let joined = if self.may_join(&a.run, &b.run) { self.joined(&mut run, window, bytes)? } else { None };
        Ok(Some(match joined {
            Some((piece, bytes)) => Found { pieces: vec![piece], bytes, run },
            None => Found { pieces: [a.pieces, b.pieces].concat(), bytes, run },
        }))
    }

    fn single(&self, at: usize) -> Result<Found, Refusal> {
        let (low, high) = range_of(self.node.steps[at]);
        let points = self.lattice.as_ref().map_or(&[][..], |(_, points)| &points[at]);
        let vectors = self.lattice.as_ref().filter(|_| self.node.window > 1).and_then(|(lattice, points)| {
            let width = lattice.width();
            Vectors::of_keys(points[at].iter().map(|&p| u64::from(p / width)), 1024)
        });
        let run = Run {
            start: at,
            len: 1,
            range: [low.to_f64(), high.to_f64()],
            low: points.to_vec(),
            high: points.to_vec(),
            vectors,
            has_cover: true,
        };
        let candidate = match self.constant(&run) {
            Some(constant) => constant,
            None => match self.fixed(&run)? {
                Some(candidate) => candidate,
                None => self.affine_within_range(at)?,
            },
        };
        let bytes = candidate.bytes;
        Ok(Found { pieces: vec![self.piece(&run, 1, candidate.choice)?], bytes, run })
    }

    /// Whether two runs may share a span: all their masks are alike.
    fn may_join(&self, a: &Run, b: &Run) -> bool {
        let masks = &self.node.masks[a.start..b.start + b.len];
        masks.iter().all(|mask| *mask == masks[0])
    }

    fn join(&self, a: &Run, b: &Run) -> Run {
        let smaller = |(&a, &b): (&u16, &u16)| a.min(b);
        let larger = |(&a, &b): (&u16, &u16)| a.max(b);
        Run {
            start: a.start,
            len: a.len + b.len,
            range: [a.range[0].min(b.range[0]), a.range[1].max(b.range[1])],
            low: a.low.iter().zip(&b.low).map(smaller).collect(),
            high: a.high.iter().zip(&b.high).map(larger).collect(),
            vectors: a.vectors.as_ref().zip(b.vectors.as_ref()).and_then(|(a, b)| a.joined(b, 1024)),
            has_cover: a.has_cover && b.has_cover,
        }
    }

    /// One piece for a run of several steps, if that takes fewer bytes than `bytes`.
    fn joined(&self, run: &mut Run, window: u32, bytes: usize) -> Result<Option<(Piece, usize)>, Refusal> {
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
                take(self.box_table(run, window)?);
                take(self.fixed_and_table(run, window)?);
            }
        }
        best.map(|best| Ok((self.piece(run, window, best.choice)?, best.bytes))).transpose()
    }

    fn constant(&self, run: &Run) -> Option<Candidate> {
        let [low, high] = run.range;
        let holds = |value: &f64| value - low <= self.bound && high - value <= self.bound;
        let ends = |(lattice, _): &(Lattice, _)| {
            let ends = run.low.iter().min().zip(run.high.iter().max())?;
            Some(lattice.value(lattice.point_for([ends.0, ends.1].map(|&p| p.into()))))
        };
        // Where there is a choice, what the lattice has in the middle of a cell.
        let value = match low == high {
            true => Some(low),
            false => {
                let middle = Some(0.5 * low + 0.5 * high).filter(holds);
                middle.and_then(|_| self.lattice.as_ref().and_then(ends).filter(holds)).or(middle)
            }
        };
        Some(Candidate { choice: Choice::Constant(value?), bytes: RECORD_BYTES })
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
    fn fixed(&self, run: &Run) -> Result<Option<Candidate>, Refusal> {
        let Some((lattice, _)) = &self.lattice else { return Ok(None) };
        let variation = run.low.iter().zip(&run.high).map(|(&low, &high)| high - low).max().unwrap_or(0);
        if variation >= lattice.width() {
            return Ok(None);
        }
        let step = lattice.width() - variation;
        let [reach, step_wide] = [lattice.reach, step].map(i32::from);
        let mut last = 0u16;
        let indices: Vec<u16> = run
            .low
            .iter()
            .zip(&run.high)
            .map(|(&low, &high)| {
                let [least, most] = [i32::from(high) - reach, i32::from(low) + reach];
                let kept = i32::from(last) * step_wide + reach;
                if kept < least || kept > most {
                    // The range has `step` points or more.
                    last = ((most - reach) / step_wide) as u16;
                }
                last
            })
            .collect();
        self.checked(run, vec![lattice.affine_stage(reach, step, &indices)])
    }

    /// A table of the distinct vectors of cells.
    fn vector_table(&self, run: &mut Run, window: u32) -> Result<Option<Candidate>, Refusal> {
        let (Some((lattice, _)), Some(vectors)) = (&self.lattice, run.vectors.clone()) else {
            return Ok(None);
        };
        let cover = vectors.cover(&self.centres(lattice, run));
        self.checked(run, vec![cover.listed_stage(lattice, window as usize)])
    }

    /// A table of one vector of points for each of a few boxes that hold the vectors of all samples.
    fn box_table(&self, run: &mut Run, window: u32) -> Result<Option<Candidate>, Refusal> {
        let Some((lattice, points)) = &self.lattice else { return Ok(None) };
        if !run.has_cover || window < 4 || lattice.reach == 0 {
            return Ok(None);
        }
        let steps: Vec<Vec<i32>> = points[run.start..run.start + run.len]
            .iter()
            .map(|points| points.iter().map(|&p| i32::from(p)).collect())
            .collect();
        let Some(cover) = Cover::of_steps(&steps, self.layout.full_edge(), lattice, 1024) else {
            run.has_cover = false;
            return Ok(None);
        };
        self.checked(run, vec![cover.listed_stage(lattice, window as usize)])
    }

    /// For each step of a run the middle of the cell of each sample.
    fn centres(&self, lattice: &Lattice, run: &Run) -> Vec<Vec<i32>> {
        let [width, reach] = [lattice.width(), lattice.reach];
        let centre = |&p: &u16| i32::from(p / width * width + reach);
        let points = self.lattice.iter().flat_map(|(_, points)| &points[run.start..run.start + run.len]);
        points.map(|step| step.iter().map(centre).collect()).collect()
    }

    /// A static stage of the middle over the steps, and a table of what remains.
    fn fixed_and_table(&self, run: &Run, window: u32) -> Result<Option<Candidate>, Refusal> {
        let Some((lattice, _)) = &self.lattice else { return Ok(None) };
        let width = lattice.width();
        let cells: Vec<u16> =
            run.low.iter().zip(&run.high).map(|(&low, &high)| (low / width + high / width) / 2).collect();
        let middle = |cell: u16| i32::from(cell * width + lattice.reach);
        let rest: Vec<Vec<i32>> = self
            .centres(lattice, run)
            .iter()
            .map(|step| step.iter().zip(&cells).map(|(&p, &cell)| p - middle(cell)).collect())
            .collect();
        let mut keys = vec![0u64; cells.len()];
        for step in &rest {
            keys.iter_mut().zip(step).for_each(|(key, &r)| {
                *key = (key.rotate_left(23) ^ r as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15);
            });
        }
        let Some(vectors) = Vectors::of_keys(keys.into_iter(), 1024) else { return Ok(None) };
        let around_zero = Lattice { offset: 0.0, ..*lattice };
        let table = vectors.cover(&rest).listed_stage(&around_zero, window as usize);
        self.checked(run, vec![lattice.affine_stage(i32::from(lattice.reach), width, &cells), table])
    }

    /// The candidate of these stages, if it holds the bound.
    fn checked(&self, run: &Run, stages: Vec<Stage>) -> Result<Option<Candidate>, Refusal> {
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

    fn piece(&self, run: &Run, window: u32, content: Choice) -> Result<Piece, Refusal> {
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
