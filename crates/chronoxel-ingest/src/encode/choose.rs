//! The choice of `--codec auto`: the dyadic partition of a window of time, and the stages of each piece, of least stored
//! bytes whose error is nowhere above a bound.
//!
//! From single steps upwards, two neighbours in the dyadic tree become one piece where that is stored in fewer bytes:
//! as a constant, as one index per sample that serves all steps, as a table of the distinct vectors of points (see
//! [`chronoxel_codec::bounded`]), or as one static stage and a table of what remains. Every payload that is taken was
//! decoded and compared sample by sample.

use chronoxel_codec::bounded::{Cover, Lattice, Vectors};
use chronoxel_codec::{
    Payload, PayloadClass, SampleValue, Stage, StageClass, TableClass, decode_f64, quantize_affine,
    stage_to_bytes,
};
use chronoxel_core::{BitMask, BrickLayout};

use super::analyse::range_of;
use super::coding::{Choice, Refusal};
use super::node::{NodeSteps, Piece, Section};
use super::real::Real;

/// What a span costs beside its payload: its record, and its share of the index of a shard.
pub const RECORD_BYTES: usize = 40;

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

impl<'a, T: Real> NodeWindow<'a, T> {
    /// A section of a node's window of which every step has data.
    pub fn of_section(node: &'a NodeSteps<T>, section: &Section<T>) -> Self {
        Self {
            steps: node.samples_of(section.steps.clone()),
            masks: node.masks[section.steps.clone()].iter().map(Option::as_ref).collect(),
            lead: node.lead.saturating_sub(section.place) as usize,
            window: section.width,
            whole_numbers: node.whole_numbers,
        }
    }

    /// One of its steps by itself.
    pub fn step(&self, at: usize) -> Self {
        let Self { whole_numbers, .. } = *self;
        Self { steps: vec![self.steps[at]], masks: vec![self.masks[at]], lead: 0, window: 1, whole_numbers }
    }
}

/// Entries of the largest table.
const MOST_ENTRIES: usize = 1024;

/// The longest window coded with a static stage and a table: in longer ones too much remains for a table.
const LONGEST_OF_TWO: u32 = 4;

/// A multiplier that spreads the bits of keys.
const MIX: u64 = 0x9E37_79B9_7F4A_7C15;

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
        for bits in [8, 16].into_iter().filter(|_| rows <= LONGEST_OF_TWO) {
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
    let mut search = Search::new(node, bound, is_binding, layout, stored_len);
    if let Some(piece) = search.one_constant() {
        return Ok(vec![piece]);
    }
    search.place_on_lattice();
    let Some(found) = search.best(0, node.window)? else { return Ok(Vec::new()) };
    let pieces: Result<Vec<Vec<Piece>>, Refusal> =
        found.pieces.into_iter().map(|piece| search.checked(piece)).collect();
    Ok(pieces?.concat())
}

struct Search<'a, T> {
    node: &'a NodeWindow<'a, T>,
    bound: f64,
    is_binding: bool,
    layout: &'a BrickLayout,
    stored_len: &'a (dyn Fn(&[u8]) -> usize + Sync),
    /// Range of each step.
    ranges: Vec<[f64; 2]>,
    /// `None` where the bound is too small for it.
    lattice: Option<Lattice>,
    /// Set by [`Search::place_on_lattice`].
    on_lattice: Option<OnLattice>,
}

/// The steps on one lattice.
struct OnLattice {
    lattice: Lattice,
    /// The point of each sample, for each step.
    points: Vec<Vec<u16>>,
    /// The cell of each sample, for each step: cells are as wide as twice the bound.
    cells: Vec<Vec<u16>>,
}

impl OnLattice {
    fn new<T: Real + SampleValue>(node: &NodeWindow<'_, T>, lattice: Lattice) -> Self {
        let width = lattice.width();
        let points: Vec<Vec<u16>> = node.steps.iter().map(|step| lattice.points(step)).collect();
        let cells = points.iter().map(|points| points.iter().map(|p| p / width).collect()).collect();
        Self { lattice, points, cells }
    }

    /// The middle of cell number `cell`.
    fn middle(&self, cell: u16) -> i32 {
        i32::from(cell) * i32::from(self.lattice.width()) + i32::from(self.lattice.reach)
    }
}

/// What is best for the steps in a run of places.
struct Found {
    pieces: Vec<Unchecked>,
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

/// A piece that has not been compared with the samples yet.
#[derive(Clone)]
struct Unchecked {
    start: usize,
    len: usize,
    window: u32,
    choice: Choice,
}

impl Unchecked {
    fn new(run: &Run, window: u32, choice: Choice) -> Self {
        Self { start: run.start, len: run.len, window, choice }
    }
}

/// A payload and its price.
struct Candidate {
    choice: Choice,
    bytes: usize,
}

impl Candidate {
    fn constant(value: f64) -> Self {
        Self { choice: Choice::Constant(value), bytes: RECORD_BYTES }
    }
}

/// The range that holds all of some ranges.
fn joint(ranges: &[[f64; 2]]) -> [f64; 2] {
    ranges.iter().fold([f64::INFINITY, f64::NEG_INFINITY], |r, [low, high]| [r[0].min(*low), r[1].max(*high)])
}

impl<'a, T: Real + SampleValue> Search<'a, T> {
    fn new(
        node: &'a NodeWindow<'a, T>,
        bound: f64,
        is_binding: bool,
        layout: &'a BrickLayout,
        stored_len: &'a (dyn Fn(&[u8]) -> usize + Sync),
    ) -> Self {
        let ends = |step: &&[T]| {
            let (low, high) = range_of(step);
            [low.to_f64(), high.to_f64()]
        };
        let ranges: Vec<[f64; 2]> = node.steps.iter().map(ends).collect();
        let some = node.steps.iter().flat_map(|step| step.iter().step_by(SAMPLED).copied());
        let lattice = Lattice::within(joint(&ranges), bound, node.whole_numbers);
        let lattice = lattice.map(|lattice| lattice.moved_to(some));
        Self { node, bound, is_binding, layout, stored_len, ranges, lattice, on_lattice: None }
    }

    /// The one piece of a window that is constant, in space and time: a short cut to what the search would find.
    fn one_constant(&self) -> Option<Piece> {
        let (len, masks) = (self.node.steps.len(), &self.node.masks);
        let alike = len > 0 && masks.iter().all(|mask| *mask == masks[0]);
        let value = alike.then(|| self.constant(joint(&self.ranges))).flatten()?;
        let (first, last) = (self.node.lead as u32, (self.node.lead + len - 1) as u32);
        let window = std::iter::successors(Some(1), |w| Some(2 * w)).find(|w| first / w == last / w)?;
        Some(Piece { start: 0, len, window, choice: Choice::Constant(value), drawn_range: [value; 2] })
    }

    fn place_on_lattice(&mut self) {
        self.on_lattice = self.lattice.map(|lattice| OnLattice::new(self.node, lattice));
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
        let joined = if self.may_join(&a.run, &b.run) { self.joined(&mut run, window, bytes) } else { None };
        Ok(Some(match joined {
            Some(Candidate { choice, bytes }) => {
                Found { pieces: vec![Unchecked::new(&run, window, choice)], bytes, run }
            }
            None => Found { pieces: [a.pieces, b.pieces].concat(), bytes, run },
        }))
    }

    fn single(&self, at: usize) -> Result<Found, Refusal> {
        let points = self.on_lattice.as_ref().map(|on| on.points[at].clone()).unwrap_or_default();
        let cells = self.on_lattice.as_ref().filter(|_| self.node.window > 1).map(|on| &on.cells[at]);
        let run = Run {
            start: at,
            len: 1,
            range: self.ranges[at],
            low: points.clone(),
            high: points,
            vectors: cells.and_then(|c| Vectors::of_keys(c.iter().map(|&cell| cell.into()), MOST_ENTRIES)),
            has_cover: true,
        };
        let constant = self.constant(run.range).map(Candidate::constant);
        let candidate = match constant.or_else(|| self.fixed(&run)) {
            Some(candidate) => candidate,
            None => self.affine_within_range(at)?,
        };
        let bytes = candidate.bytes;
        Ok(Found { pieces: vec![Unchecked::new(&run, 1, candidate.choice)], bytes, run })
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
            range: joint(&[a.range, b.range]),
            low: a.low.iter().zip(&b.low).map(smaller).collect(),
            high: a.high.iter().zip(&b.high).map(larger).collect(),
            vectors: a.vectors.as_ref().zip(b.vectors.as_ref()).and_then(|(a, b)| a.joined(b, MOST_ENTRIES)),
            has_cover: a.has_cover && b.has_cover,
        }
    }

    /// One piece for a run of several steps, if that takes fewer bytes than `bytes`.
    fn joined(&self, run: &mut Run, window: u32, bytes: usize) -> Option<Candidate> {
        let candidates = match self.constant(run.range) {
            Some(value) => vec![Some(Candidate::constant(value))],
            None => vec![
                self.fixed(run),
                self.vector_table(run, window),
                self.box_table(run, window),
                self.fixed_and_table(run, window),
            ],
        };
        // Of equal ones the first.
        candidates.into_iter().flatten().filter(|c| c.bytes < bytes).min_by_key(|c| c.bytes)
    }

    /// A value within the bound of all samples of a range.
    fn constant(&self, [low, high]: [f64; 2]) -> Option<f64> {
        let holds = |value: &f64| value - low <= self.bound && high - value <= self.bound;
        if low == high {
            return Some(low);
        }
        let middle = Some(0.5 * low + 0.5 * high).filter(holds)?;
        // Where there is a choice, what the lattice has in the middle of a cell.
        let of_lattice = self.lattice.map(|lattice| {
            let ends = lattice.points(&[low, high]);
            lattice.value(lattice.point_for([ends[0], ends[1]].map(i32::from)))
        });
        of_lattice.filter(holds).or(Some(middle))
    }

    /// One index per sample that serves all steps.
    fn fixed(&self, run: &Run) -> Option<Candidate> {
        let Some(OnLattice { lattice, cells, .. }) = &self.on_lattice else {
            let steps = &self.node.steps[run.start..run.start + run.len];
            let alike = run.len > 1 && steps.iter().all(|step| *step == steps[0]);
            return alike.then(|| self.affine_within_range(run.start).ok()).flatten();
        };
        if run.len == 1 {
            let first = i32::from(lattice.reach);
            return Some(self.priced(vec![lattice.affine_stage(first, lattice.width(), &cells[run.start])]));
        }
        let variation = run.low.iter().zip(&run.high).map(|(&low, &high)| high - low).max().unwrap_or(0);
        if variation >= lattice.width() {
            return None;
        }
        let step = lattice.width() - variation;
        let [reach, step_wide] = [lattice.reach, step].map(i32::from);
        let mut last = 0u16;
        let index = |(&low, &high): (&u16, &u16)| {
            let [least, most] = [i32::from(high) - reach, i32::from(low) + reach];
            let kept = i32::from(last) * step_wide + reach;
            if kept < least || kept > most {
                // The nearest to the middle; there are `step` points or more to choose from.
                last = (((least + most) / 2 - reach + step_wide / 2).max(0) / step_wide) as u16;
            }
            last
        };
        let indices: Vec<u16> = run.low.iter().zip(&run.high).map(index).collect();
        Some(self.priced(vec![lattice.affine_stage(reach, step, &indices)]))
    }

    /// A table of the distinct vectors of cells.
    fn vector_table(&self, run: &Run, window: u32) -> Option<Candidate> {
        let (on, vectors) = (self.on_lattice.as_ref()?, run.vectors.clone()?);
        let middle = |step: usize, sample: usize| on.middle(on.cells[run.start + step][sample]);
        let cover = vectors.into_cover(run.len, middle);
        self.canonical(vec![cover.listed_stage(&on.lattice, window as usize)])
    }

    /// A table of one vector of points for each of a few boxes that hold the vectors of all samples.
    fn box_table(&self, run: &mut Run, window: u32) -> Option<Candidate> {
        let on = self.on_lattice.as_ref()?;
        if !run.has_cover || window < 4 || on.lattice.reach == 0 {
            return None;
        }
        let points = &on.points[run.start..run.start + run.len];
        let cover = Cover::of_steps(points, self.layout.full_edge(), &on.lattice, MOST_ENTRIES);
        run.has_cover = cover.is_some();
        self.canonical(vec![cover?.listed_stage(&on.lattice, window as usize)])
    }

    /// A static stage of the middle over the steps, and a table of what remains.
    fn fixed_and_table(&self, run: &Run, window: u32) -> Option<Candidate> {
        let on = self.on_lattice.as_ref()?;
        let few = run.vectors.as_ref().is_some_and(|vectors| vectors.firsts.len() <= 256);
        if few || window > LONGEST_OF_TWO {
            return None;
        }
        let width = on.lattice.width();
        let steps = &on.cells[run.start..run.start + run.len];
        let mut low = steps[0].clone();
        let mut static_cells = steps[0].clone();
        for step in &steps[1..] {
            low.iter_mut().zip(step).for_each(|(low, &cell)| *low = cell.min(*low));
            static_cells.iter_mut().zip(step).for_each(|(high, &cell)| *high = cell.max(*high));
        }
        static_cells.iter_mut().zip(&low).for_each(|(high, &low)| *high = high.midpoint(low));
        let mut keys = vec![0u64; static_cells.len()];
        for step in steps {
            for ((key, &cell), &middle) in keys.iter_mut().zip(step).zip(&static_cells) {
                *key = (key.rotate_left(23) ^ (i64::from(cell) - i64::from(middle)) as u64).wrapping_mul(MIX);
            }
        }
        let vectors = Vectors::of_keys(keys.into_iter(), MOST_ENTRIES)?;
        let rest = |step: usize, i: usize| on.middle(steps[step][i]) - on.middle(static_cells[i]);
        let around_zero = Lattice { offset: 0.0, ..on.lattice };
        let table = vectors.into_cover(run.len, rest).listed_stage(&around_zero, window as usize);
        let first = i32::from(on.lattice.reach);
        self.canonical(vec![on.lattice.affine_stage(first, width, &static_cells), table])
    }

    /// One step with 16 bits of its own range.
    fn affine_within_range(&self, at: usize) -> Result<Candidate, Refusal> {
        let stage = quantize_affine(self.node.steps[at], self.node.whole_numbers, 16);
        Ok(self.priced(vec![stage.map_err(Refusal::Codec)?]))
    }

    fn canonical(&self, stages: Vec<Stage>) -> Option<Candidate> {
        let stages: Result<Vec<Stage>, _> =
            stages.into_iter().map(|stage| stage.into_canonical(self.layout)).collect();
        Some(self.priced(stages.ok()?))
    }

    fn priced(&self, stages: Vec<Stage>) -> Candidate {
        let stored = |stage| (self.stored_len)(&stage_to_bytes(stage, self.layout));
        // With one place there is nothing to compare.
        let counted = if self.node.window > 1 { &stages[..] } else { &[] };
        let bytes = RECORD_BYTES + counted.iter().map(stored).sum::<usize>();
        Candidate { choice: Choice::Coded(Payload { stages }), bytes }
    }

    /// Checks a piece sample by sample on what it decodes to. Where that is beyond the bound, its steps get 16 bits each.
    fn checked(&self, piece: Unchecked) -> Result<Vec<Piece>, Refusal> {
        let Unchecked { start, len, window, choice } = piece;
        let (error, drawn_range) = self.error_and_range(start, len, &choice)?;
        if error <= self.bound || len == 1 && !self.is_binding {
            return Ok(vec![Piece { start, len, window, choice, drawn_range }]);
        }
        let single = |at: usize| {
            let choice = self.affine_within_range(at)?.choice;
            let (error, drawn_range) = self.error_and_range(at, 1, &choice)?;
            if self.is_binding && error > self.bound {
                return Err(Refusal::Bound { error, bound: self.bound });
            }
            Ok(Piece { start: at, len: 1, window: 1, choice, drawn_range })
        };
        (start..start + len).map(single).collect()
    }

    /// The largest difference between an unmasked sample and its decoded value, and the range of the decoded samples.
    fn error_and_range(&self, start: usize, len: usize, choice: &Choice) -> Result<(f64, [f64; 2]), Refusal> {
        let Choice::Coded(payload) = choice else {
            // A constant was chosen by the range of all samples.
            let Choice::Constant(value) = choice else { return Ok((0.0, [f64::NAN; 2])) };
            return Ok((0.0, [*value; 2]));
        };
        let mut error = 0.0f64;
        let mut range = [f64::INFINITY, f64::NEG_INFINITY];
        for row in 0..len {
            let decoded = decode_f64(payload, self.layout, row as u32).map_err(Refusal::Codec)?;
            let mask = self.node.masks[start + row];
            for (at, (sample, &decoded)) in self.node.steps[start + row].iter().zip(&decoded).enumerate() {
                range = [range[0].min(decoded), range[1].max(decoded)];
                let difference = (decoded - sample.to_f64()).abs();
                if difference > error && mask.is_none_or(|mask| !mask.get(at)) {
                    error = difference;
                }
            }
        }
        Ok((error, range))
    }
}

#[cfg(test)]
mod tests;
