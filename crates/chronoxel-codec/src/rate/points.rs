//! The best way to code a brick over a run of steps, for each of several slopes: constants, uniform quantisers of one step
//! or of the mean of several, and vector palettes of one stage or more, over the dyadic partitions of the run.

use chronoxel_core::BrickLayout;

use crate::{
    CodecError, Indices, Payload, PayloadClass, SampleValue, Stage, StageClass, Table, TableClass,
    UnitWindow, VectorTable, quantize_affine, stage_to_bytes,
};

/// A table this many times coarser than the slope asks for is not worth trying.
const COARSEST_TABLE: f64 = 8.0;
/// Bytes that a vector palette takes at the very least.
const LEAST_PALETTE_BYTES: f64 = 48.0;
/// Most levels of a uniform quantiser, less one.
const MOST_LEVELS: f64 = 65535.0;

/// One way to code a brick over a run of steps.
#[derive(Debug, Clone, PartialEq)]
pub struct RatePoint {
    /// The spans, in order; together they cover the run.
    pub pieces: Vec<Piece>,
    /// Stored bytes.
    pub bytes: u64,
    /// Squared error summed over the trained samples of all steps, in squared units of the samples.
    pub squared_error: f64,
}

/// A span of a way to code a brick.
#[derive(Debug, Clone, PartialEq)]
pub struct Piece {
    /// First step, counted from that of the run.
    pub start: usize,
    /// Steps: at most the window's.
    pub len: usize,
    /// Length of the window, a power of two.
    pub window: u32,
    /// What is stored.
    pub coded: CodedPiece,
}

/// What is stored of a span.
#[derive(Debug, Clone, PartialEq)]
pub enum CodedPiece {
    /// One value for all samples and steps.
    Constant(f64),
    /// Stages; every listed table has as many rows as the window has steps.
    Payload(Payload),
}

/// A brick over a run of steps that share one mask.
#[derive(Debug, Clone, Copy)]
pub struct Run<'a, T> {
    /// For each step the samples of the full brick, masked ones padded; at least one step.
    pub steps: &'a [&'a [T]],
    /// Samples whose error counts: see [`UnitWindow::trained`].
    pub trained: &'a [u32],
    /// The layout of the brick.
    pub layout: &'a BrickLayout,
}

/// What rate control may use.
#[derive(Clone, Copy)]
pub struct RateOptions<'a> {
    /// Longest window, a power of two.
    pub max_window: u32,
    /// Most stages of a vector palette, at least 1.
    pub max_stages: usize,
    /// Entries of a table, 1 to 256: its class has as many, whether used or not.
    pub num_entries: usize,
    /// Whether all samples are integers below 2^53 in magnitude.
    pub whole_numbers: bool,
    /// Bytes that a span costs beyond its stages.
    pub span_bytes: u64,
    /// Stored length of the bytes of a stage.
    pub stored_bytes: &'a (dyn Fn(&[u8]) -> usize + Sync),
}

impl RateOptions<'_> {
    /// The classes that payloads of a window length may have.
    pub fn payload_classes(&self, window: u32) -> Vec<PayloadClass> {
        let table = TableClass::Listed { entries: self.table_entries() as u32, rows: window };
        let stage = StageClass { index_bits: 8, table, shift: 0 };
        let most_stages = if window > 1 { self.max_stages.max(1) } else { 0 };
        let listed = (1..=most_stages).map(|n| PayloadClass { stages: vec![stage; n] });
        [8, 16].map(PayloadClass::affine).into_iter().chain(listed).collect()
    }

    /// Entries of a table of 8-bit indices.
    fn table_entries(&self) -> usize {
        self.num_entries.clamp(1, 256)
    }
}

/// A way to code one piece.
#[derive(Clone)]
struct Candidate {
    coded: CodedPiece,
    bytes: u64,
    squared_error: f64,
}

impl Candidate {
    fn cost(&self, slope: f64) -> f64 {
        self.squared_error + slope * 8.0 * self.bytes as f64
    }
}

/// The candidates of one window length: `[piece, slope]`, `None` where the slope was not tried.
struct Level {
    window: usize,
    pieces: Vec<Vec<Option<Candidate>>>,
}

/// For each slope the best way to code the run, and last the run as constants.
///
/// The windows are tried from the longest to the shortest, until a shorter one costs more; of those tried, the best
/// partition is taken. A payload in memory is as large as its indices, so the points of a brick take at
/// most a byte or two for each sample, step and slope.
///
/// * `slopes`: squared error, in squared units of the samples, that one stored bit must save; increasing
///
/// # Errors
/// [`CodecError::InvalidArgument`] for what [`UnitWindow::new`] refuses.
pub fn rate_points<T: SampleValue>(
    run: &Run<T>,
    slopes: &[f64],
    options: &RateOptions,
) -> Result<Vec<RatePoint>, CodecError> {
    let mut levels: Vec<Level> = Vec::new();
    let mut least = vec![f64::INFINITY; slopes.len()];
    let mut active = vec![true; slopes.len()];
    let mut window = options.max_window.max(1).next_power_of_two();
    let mut constants = RatePoint { pieces: Vec::new(), bytes: 0, squared_error: 0.0 };
    while window >= 1 && (levels.is_empty() || active.contains(&true)) {
        let mut level = Level { window: window as usize, pieces: Vec::new() };
        let mut judged = vec![true; slopes.len()];
        for start in (0..run.steps.len()).step_by(window as usize) {
            let end = run.steps.len().min(start + window as usize);
            let unit = UnitWindow::new(&run.steps[start..end], run.trained.to_vec())?;
            let piece =
                PieceCoder { step: run.steps[start], layout: run.layout, unit: &unit, window, options };
            let constant = piece.constant();
            if levels.is_empty() {
                constants.add(&constant, start, end, window as usize);
            }
            level.pieces.push(piece.candidates(&constant, slopes, &active, &mut judged)?);
        }
        for (s, &slope) in slopes.iter().enumerate().filter(|&(s, _)| judged[s]) {
            if active[s] {
                let cost = level.pieces.iter().flat_map(|piece| &piece[s]).map(|c| c.cost(slope)).sum();
                active[s] = cost < least[s];
                least[s] = least[s].min(cost);
            }
        }
        levels.push(level);
        window /= 2;
    }
    let best = slopes.iter().enumerate().map(|(s, &slope)| {
        let mut point = RatePoint { pieces: Vec::new(), bytes: 0, squared_error: 0.0 };
        for (at, piece) in levels[0].pieces.iter().enumerate() {
            let Some(_) = piece[s] else { continue };
            for (start, window, candidate) in best_partition(&levels, at, s, slope).1 {
                point.add(candidate, start, run.steps.len().min(start + window), window);
            }
        }
        point
    });
    Ok(best.chain([constants]).collect())
}

impl RatePoint {
    fn add(&mut self, candidate: &Candidate, start: usize, end: usize, window: usize) {
        let coded = candidate.coded.clone();
        self.pieces.push(Piece { start, len: end - start, window: window as u32, coded });
        self.bytes += candidate.bytes;
        self.squared_error += candidate.squared_error;
    }
}

/// The cost of the best partition of a piece of the first level, and its candidates with their starts and windows.
fn best_partition(
    levels: &[Level],
    at: usize,
    s: usize,
    slope: f64,
) -> (f64, Vec<(usize, usize, &Candidate)>) {
    let tried = |at: usize| levels.first().and_then(|level| level.pieces.get(at)?[s].as_ref());
    let Some(whole) = tried(at) else { return (f64::INFINITY, Vec::new()) };
    let whole_cost = whole.cost(slope);
    if let Some(below) =
        levels.get(1).filter(|below| below.pieces.get(2 * at).is_some_and(|p| p[s].is_some()))
    {
        let (mut cost, mut halves) = best_partition(&levels[1..], 2 * at, s, slope);
        if 2 * at + 1 < below.pieces.len() {
            let (more, upper) = best_partition(&levels[1..], 2 * at + 1, s, slope);
            cost += more;
            halves.extend(upper);
        }
        if cost < whole_cost {
            return (cost, halves);
        }
    }
    let window = levels[0].window;
    (whole_cost, vec![(at * window, window, whole)])
}

/// What codes one piece of a run.
struct PieceCoder<'a, T> {
    /// Its first step.
    step: &'a [T],
    layout: &'a BrickLayout,
    unit: &'a UnitWindow,
    window: u32,
    options: &'a RateOptions<'a>,
}

impl<T: SampleValue> PieceCoder<'_, T> {
    /// The best candidate for each slope that is active; `judged` turns false where palettes were left out because
    /// their tables would be too coarse, so that the cost says nothing about shorter windows.
    fn candidates(
        &self,
        constant: &Candidate,
        slopes: &[f64],
        active: &[bool],
        judged: &mut [bool],
    ) -> Result<Vec<Option<Candidate>>, CodecError> {
        let mut best: Vec<Option<Candidate>> = active.iter().map(|a| a.then(|| constant.clone())).collect();
        let least_bytes = LEAST_PALETTE_BYTES + self.options.span_bytes as f64;
        let open = |best: &Option<Candidate>, slope: f64, least_error: f64| {
            best.as_ref().is_some_and(|b| b.cost(slope) > least_error + slope * 8.0 * least_bytes)
        };
        if self.unit.num_steps > 1 && slopes.iter().zip(&best).any(|(&slope, best)| open(best, slope, 0.0)) {
            let mut table = VectorTable::train(self.unit, self.options.table_entries());
            for (s, &slope) in slopes.iter().enumerate() {
                if !open(&best[s], slope, 0.0) {
                    continue;
                }
                if self.unit_slope(self.unit, slope) < self.coarsest_slope(&table) {
                    judged[s] = false;
                    continue;
                }
                let candidate = self.palette(&mut table, slope)?;
                best[s] = best[s].take().map(|b| cheaper(b, candidate, slope));
            }
        }
        let mean = self.mean_step();
        for (s, &slope) in slopes.iter().enumerate() {
            if open(&best[s], slope, mean.squared_error) {
                let candidate = self.uniform(&mean, slope)?;
                best[s] = best[s].take().map(|b| cheaper(b, candidate, slope));
            }
        }
        Ok(best)
    }

    /// A slope in the units of a window.
    fn unit_slope(&self, unit: &UnitWindow, slope: f64) -> f64 {
        if unit.width > 0.0 { slope / unit.width / unit.width } else { f64::INFINITY }
    }

    /// The slope below which a table with as many stages as there may be is too coarse: each stage divides
    /// errors by 4 for each bit per sample.
    fn coarsest_slope(&self, table: &VectorTable) -> f64 {
        let bits = 8.0 / f64::from(self.window) * (self.options.max_stages.max(1) - 1) as f64;
        table.slope() / COARSEST_TABLE * libm::exp2(-2.0 * bits)
    }

    /// The span as the mean of its trained samples.
    fn constant(&self) -> Candidate {
        let unit = self.unit;
        let trained = |t: usize| unit.trained.iter().map(move |&i| f64::from(unit.step(t)[i as usize]));
        let count = (unit.trained.len() * unit.num_steps) as f64;
        let mean = (0..unit.num_steps).map(|t| trained(t).sum::<f64>()).sum::<f64>() / count;
        let error: f64 =
            (0..unit.num_steps).map(|t| trained(t).map(|x| (x - mean).powi(2)).sum::<f64>()).sum();
        Candidate {
            coded: CodedPiece::Constant(unit.offset + unit.width * mean),
            bytes: self.options.span_bytes,
            squared_error: if unit.width > 0.0 { error * unit.width * unit.width } else { 0.0 },
        }
    }

    fn candidate(&self, stages: Vec<Stage>, squared_error: f64) -> Candidate {
        let stored = |stage| (self.options.stored_bytes)(&stage_to_bytes(stage, self.layout)) as u64;
        let bytes = self.options.span_bytes + stages.iter().map(stored).sum::<u64>();
        Candidate { coded: CodedPiece::Payload(Payload { stages }), bytes, squared_error }
    }

    /// Stages of vector palettes: another one as long as it lowers the cost.
    fn palette(&self, table: &mut VectorTable, slope: f64) -> Result<Candidate, CodecError> {
        let mut stages = Vec::new();
        let mut best = self.add_stage(&mut stages, table, self.unit, slope)?;
        let mut residual = best.1.take();
        while let Some(unit) = residual {
            let mut table = VectorTable::train(&unit, self.options.table_entries());
            let (candidate, next) = self.add_stage(&mut stages, &mut table, &unit, slope)?;
            if candidate.cost(slope) >= best.0.cost(slope) {
                break;
            }
            best.0 = candidate;
            residual = next;
        }
        Ok(best.0)
    }

    /// Adds a stage, and says what the stages are as a candidate, and what they leave if a further one may pay.
    fn add_stage(
        &self,
        stages: &mut Vec<Stage>,
        table: &mut VectorTable,
        unit: &UnitWindow,
        slope: f64,
    ) -> Result<(Candidate, Option<UnitWindow>), CodecError> {
        let unit_slope = self.unit_slope(unit, slope);
        let palette = table.priced_palette(unit_slope);
        stages.push(palette.to_stage(
            unit,
            self.layout,
            self.options.table_entries(),
            self.window as usize,
        )?);
        let candidate = self.candidate(stages.clone(), palette.squared_error(unit) * unit.width * unit.width);
        let more = stages.len() < self.options.max_stages && unit_slope < table.slope();
        Ok((candidate, more.then(|| unit.residual(&palette)).filter(|residual| residual.width > 0.0)))
    }

    /// The mean of the steps.
    fn mean_step(&self) -> MeanStep {
        let unit = self.unit;
        let mut values = unit.step(0).to_vec();
        for t in 1..unit.num_steps {
            values.iter_mut().zip(unit.step(t)).for_each(|(sum, x)| *sum += x);
        }
        values.iter_mut().for_each(|sum| *sum /= unit.num_steps as f32);
        let error = |t: usize| {
            let step = unit.step(t);
            let difference = |&i: &u32| f64::from(step[i as usize] - values[i as usize]);
            unit.trained.iter().map(|i| difference(i).powi(2)).sum::<f64>()
        };
        let squared_error = (0..unit.num_steps).map(error).sum::<f64>() * unit.width * unit.width;
        let low = values.iter().copied().fold(f32::INFINITY, f32::min);
        let high = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        MeanStep { values, squared_error, low, width: high - low }
    }

    /// A uniform quantiser of the mean of the steps, one row for all of them.
    ///
    /// A step `d` makes an error of `d^2 / 12` for each sample and step, which one bit more for each sample
    /// divides by 4: the slope gives `d^2 = 6 slope / (ln 2 steps)`.
    fn uniform(&self, mean: &MeanStep, slope: f64) -> Result<Candidate, CodecError> {
        let unit = self.unit;
        let asked =
            (6.0 * self.unit_slope(unit, slope) / (std::f64::consts::LN_2 * unit.num_steps as f64)).sqrt();
        let exact = self.options.whole_numbers && asked * unit.width <= 1.0 && unit.width <= MOST_LEVELS;
        if unit.num_steps == 1 && (exact || asked * MOST_LEVELS <= 1.0) {
            let bits = if exact && unit.width <= 255.0 { 8 } else { 16 };
            let stage = quantize_affine(self.step, self.options.whole_numbers, bits)?;
            let error = match (exact, &stage.table) {
                (false, Table::Affine { scale, .. }) => scale * scale / 12.0 * unit.trained.len() as f64,
                _ => 0.0,
            };
            return Ok(self.candidate(vec![stage], error));
        }
        let num_levels = (f64::from(mean.width) / asked).ceil().clamp(1.0, MOST_LEVELS) as f32;
        let (step, per_step) = (mean.width / num_levels, num_levels / mean.width.max(f32::MIN_POSITIVE));
        let index = |x: &f32| ((x - mean.low) * per_step).round_ties_even().clamp(0.0, num_levels);
        let difference = |&i: &u32| {
            let x = &mean.values[i as usize];
            f64::from(mean.low + step * index(x) - x)
        };
        let error = unit.trained.iter().map(|i| difference(i).powi(2)).sum::<f64>() * unit.num_steps as f64;
        let indices = match num_levels {
            n if n <= 255.0 => Indices::U8(mean.values.iter().map(|x| index(x) as u8).collect()),
            _ => Indices::U16(mean.values.iter().map(|x| index(x) as u16).collect()),
        };
        let offset = unit.offset + unit.width * f64::from(mean.low);
        let table = Table::Affine { offset, scale: unit.width * f64::from(step) };
        let squared_error = mean.squared_error + error * unit.width * unit.width;
        Ok(self.candidate(vec![Stage { indices, table, shift: 0 }], squared_error))
    }
}

/// The mean of the steps of a window, and the squared error of every step being replaced by it.
struct MeanStep {
    values: Vec<f32>,
    /// In squared units of the samples.
    squared_error: f64,
    low: f32,
    width: f32,
}

fn cheaper(a: Candidate, b: Candidate, slope: f64) -> Candidate {
    if b.cost(slope) < a.cost(slope) { b } else { a }
}
