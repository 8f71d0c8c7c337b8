//! The encoder of cells: a mesh's tetrahedra as they are, and the values at its points in blocks of 64 steps.
//!
//! A block of a variable is read whole, coded by [`chronoxel_codec::encode_cells`] with the threads of the pool, measured against what was
//! read, and put. Memory is that of one block, three times, or four where an error bound may need several attempts.

use std::path::{Path, PathBuf};
use std::time::Instant;

use chronoxel_codec::{BLOCK_STEPS, CellCodecOptions, CellSpan, Workers, decode_points, paper_ratio};
use chronoxel_core::{BitMask, Samples, SpanStatistics};
use chronoxel_store::{
    CellDescription, CellGeometry, CellHeader, CellSpanWrite, CellStore, CellStoreWriter, CellTotals,
    CellVariableDescription, StoreError,
};
use rayon::prelude::*;
use serde::Serialize;
use serde_json::json;

use super::mark::{Marks, mark, width_of};
use super::output::{Begun, Output};
use super::real::Real;
use super::{EncodeOptions, Progress};
use crate::{EncodeError, MeshCensus, MeshSeries};

/// Level of zstd for stages: they are large and few.
const ZSTD_LEVEL: i32 = 9;
/// The program itself, and what threads hold.
const FIXED_BYTES: u64 = 16 << 20;

/// How values at the points of a mesh are coded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CellOptions {
    /// Entries of a table, 2 to 1024.
    pub entries: usize,
    /// Whether the store lies within the store of bricks of the same source, which is there already.
    pub nested: bool,
}

impl Default for CellOptions {
    fn default() -> Self {
        Self { entries: 256, nested: false }
    }
}

/// What an encoding of cells did.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct CellReport {
    /// What the mesh consists of.
    pub census: MeshCensus,
    /// Points of the mesh.
    pub num_points: u64,
    /// Its tetrahedra.
    pub num_tetrahedra: u64,
    /// Variables that were encoded.
    pub num_variables: usize,
    /// Bytes of the source's values, all steps and encoded variables.
    pub raw_bytes: u64,
    /// Bytes of the store.
    pub stored_bytes: u64,
    /// Raw over stored.
    pub ratio: f64,
    /// The ratio by the formula of bernardon2006, which leaves geometry out and has 4 bytes for every number.
    pub paper_ratio: f64,
    /// What is stored.
    pub totals: CellTotals,
    /// Steps read: those that a resume found finished are not among them.
    pub steps_read: usize,
    /// Steps that were finished already.
    pub steps_resumed: usize,
    /// Missing values in the steps read: NaN, infinities and fill values.
    pub num_masked: u64,
    /// Infinities among them.
    pub num_infinite: u64,
    /// Wall-clock time.
    pub wall_secs: f64,
}

/// Encodes a series on a mesh as a store of cells: `output` itself, or the folder for one within it ([`CellOptions::nested`]).
///
/// The store's bytes depend on the series and on the options that say so, not on threads or memory. While it runs the store opens up to the last
/// finished block of 64 steps. After an error nothing is left, or what was finished as `NAME.partial.cxl`, where a resume looks
/// for it too; a nested store stays where it is.
///
/// # Errors
/// [`EncodeError`]: see its variants.
pub fn encode_cells(
    mesh: &mut dyn MeshSeries,
    output: &Path,
    options: &EncodeOptions,
    cells: &CellOptions,
    progress: &mut dyn FnMut(Progress),
) -> Result<CellReport, EncodeError> {
    let started = Instant::now();
    options.check()?;
    check_entries(cells.entries)?;
    let variables = options.choose_variables(mesh.variables(), mesh.times().num_steps())?;
    let variables: Vec<Coded> =
        variables.into_iter().map(|(index, coding)| Coded { index, fill_value: coding.fill_value }).collect();
    check_memory(mesh, options)?;
    let (geometry, census) = read_geometry(mesh, Some(options.memory_bytes))?;
    let description = describe(mesh, &variables, options, cells);
    let [num_points, num_tetrahedra] = [geometry.points.len(), geometry.tetrahedra.len()].map(|n| n as u64);
    let begun = (description, geometry);
    let (place, mut writer, first) = open(output, &begun, options, cells)?;
    drop(begun);
    let mut report = CellReport {
        census,
        num_points,
        num_tetrahedra,
        num_variables: variables.len(),
        ..CellReport::default()
    };
    report.steps_resumed = first as usize;
    let run = Run { options, cells, variables: &variables };
    let root = match run.blocks(mesh, &mut writer, &mut report, progress) {
        Ok(()) => {
            report.raw_bytes = writer.header().raw_bytes();
            report.totals = writer.finish()?;
            place.keep()?
        }
        Err(error) => return Err(place.abandon(writer, error)),
    };
    report.stored_bytes = CellStore::open(&root)?.stored_bytes()?;
    report.ratio = report.raw_bytes as f64 / report.stored_bytes as f64;
    report.paper_ratio = paper_ratio(num_points as usize, mesh.times().num_steps(), cells.entries);
    report.wall_secs = started.elapsed().as_secs_f64();
    Ok(report)
}

/// The points and the tetrahedra of a mesh.
///
/// * `memory_bytes`: what both may take
fn read_geometry(
    mesh: &mut dyn MeshSeries,
    memory_bytes: Option<u64>,
) -> Result<(CellGeometry, MeshCensus), EncodeError> {
    let points = mesh.points()?;
    let point_bytes = size_of_val(points.as_slice()) as u64;
    let most = memory_bytes.map_or(u64::MAX, |given| given.saturating_sub(point_bytes) / 16);
    let mut tetrahedra = Vec::new();
    let mut num_seen = 0u64;
    let census = mesh.for_each_tetrahedron(&mut |corners| {
        num_seen += 1;
        if num_seen <= most {
            tetrahedra.push(corners);
        }
        Ok(())
    })?;
    if num_seen > most {
        return Err(EncodeError::CellMemory {
            given: memory_bytes.unwrap_or(0),
            needed: point_bytes + 16 * num_seen,
            what: format!("the mesh, with {} points and {num_seen} tetrahedra,", points.len()),
        });
    }
    Ok((CellGeometry { points, tetrahedra }, census))
}

/// Whether a mesh has the points and tetrahedra of a store.
pub(crate) fn same_geometry(mesh: &mut dyn MeshSeries, header: &CellHeader) -> Result<bool, EncodeError> {
    if mesh.num_points() as u64 != header.num_points {
        return Ok(false);
    }
    let (geometry, _) = read_geometry(mesh, None)?;
    Ok(geometry.digest() == header.geometry)
}

fn check_entries(entries: usize) -> Result<(), EncodeError> {
    match (2..=1024).contains(&entries) {
        true => Ok(()),
        false => Err(EncodeError::InvalidArgument {
            argument: "--entries",
            value: entries.to_string(),
            remedy: "use 2 to 1024".into(),
        }),
    }
}

/// Checks that a block of a variable fits: what was read, that without missing values, what stages leave of it, and that once more where
/// one attempt may not do.
fn check_memory(mesh: &dyn MeshSeries, options: &EncodeOptions) -> Result<(), EncodeError> {
    let num_steps = mesh.times().num_steps().min(BLOCK_STEPS) as u64;
    let copies = if options.max_error.is_some() { 4 } else { 3 };
    let num_points = mesh.num_points() as u64;
    let needed = FIXED_BYTES + mesh.working_bytes() + num_points * (4 * num_steps * copies + 16);
    match needed <= options.memory_bytes {
        true => Ok(()),
        false => Err(EncodeError::CellMemory {
            given: options.memory_bytes,
            needed,
            what: format!("a block of {num_steps} steps at {num_points} points"),
        }),
    }
}

fn describe(
    mesh: &dyn MeshSeries,
    variables: &[Coded],
    options: &EncodeOptions,
    cells: &CellOptions,
) -> CellDescription {
    let of_variable = |coded: &Coded| {
        let variable = &mesh.variables()[coded.index];
        CellVariableDescription {
            name: variable.name.clone(),
            units: variable.units.clone(),
            sample_type: variable.sample_type,
            fill_value: coded.fill_value,
        }
    };
    CellDescription {
        kind: mesh.grid_type().name().into(),
        times: mesh.times().clone(),
        variables: variables.iter().map(of_variable).collect(),
        zstd_level: ZSTD_LEVEL,
        encoder: json!({
            "program": concat!("chronoxel ", env!("CARGO_PKG_VERSION")),
            "source": options.source_name,
            "entries": cells.entries,
            "max_error": options.max_error,
            "range": options.range,
        }),
    }
}

/// Where the store lies: by itself, or within a store of bricks.
enum Place {
    Own(PathBuf, Output),
    Nested(PathBuf),
}

impl Place {
    fn keep(self) -> Result<PathBuf, EncodeError> {
        match self {
            Self::Own(path, output) => output.keep().map(|()| path),
            Self::Nested(path) => Ok(path),
        }
    }

    fn abandon(self, writer: CellStoreWriter, error: EncodeError) -> EncodeError {
        match self {
            Self::Own(_, output) => output.abandon(writer, error),
            Self::Nested(_) => {
                // What is finished stays where it is, and a resume finds it there.
                let _ = writer.abandon();
                error
            }
        }
    }
}

fn open(
    output: &Path,
    begun: &(CellDescription, CellGeometry),
    options: &EncodeOptions,
    cells: &CellOptions,
) -> Result<(Place, CellStoreWriter, u32), EncodeError> {
    if !cells.nested {
        let (place, writer, first) = Output::open::<CellStoreWriter>(output, begun, options)?;
        return Ok((Place::Own(output.to_owned(), place), writer, first));
    }
    let path = output.join(chronoxel_store::cells::NESTED_FOLDER);
    let (description, geometry) = begun;
    let (writer, first) = match options.resume {
        true => CellStoreWriter::resume(&path, description, geometry)?,
        false => (CellStoreWriter::create(&path, description, geometry, true)?, 0),
    };
    Ok((Place::Nested(path), writer, first))
}

impl Begun for CellStoreWriter {
    type Description = (CellDescription, CellGeometry);

    fn create(path: &Path, (description, geometry): &Self::Description) -> Result<Self, StoreError> {
        Self::create(path, description, geometry, false)
    }

    fn resume(path: &Path, (description, geometry): &Self::Description) -> Result<(Self, u32), StoreError> {
        Self::resume(path, description, geometry)
    }

    fn compare(path: &Path, (description, geometry): &Self::Description) -> Result<(), EncodeError> {
        let store = CellStore::open(path)?;
        if store.path() != path {
            return Err(EncodeError::InvalidArgument {
                argument: "--resume",
                value: path.display().to_string(),
                remedy: "it is a store of bricks: use --as both, or --overwrite".into(),
            });
        }
        let was = store.header();
        let differs = |field: &str, was: String, is: String| {
            let path = path.to_owned();
            Err(EncodeError::ResumeDiffers { path, field: field.into(), was, is })
        };
        let names = |names: Vec<&str>| names.join(", ");
        let were = names(was.variables.iter().map(|v| v.name.as_str()).collect());
        let are = names(description.variables.iter().map(|v| v.name.as_str()).collect());
        if were != are {
            return differs("variables", were, are);
        }
        if was.times != description.times {
            let steps = |n: usize| format!("{n} steps");
            let (was, is) = (was.times.num_steps(), description.times.num_steps());
            return differs("time axis", steps(was), format!("{}, or other times", steps(is)));
        }
        if was.encoder != description.encoder {
            return differs("options", was.encoder.to_string(), description.encoder.to_string());
        }
        if was.geometry != geometry.digest() {
            return differs("mesh", was.geometry.clone(), geometry.digest());
        }
        Ok(())
    }

    fn num_steps_finished(&self) -> usize {
        self.header().num_steps_finished as usize
    }

    fn abandon(self) -> Result<Option<PathBuf>, StoreError> {
        Self::abandon(self)
    }
}

/// A variable that is encoded.
struct Coded {
    /// Its index in the series.
    index: usize,
    fill_value: Option<f64>,
}

/// The blocks of a series, one after another.
struct Run<'a> {
    options: &'a EncodeOptions,
    cells: &'a CellOptions,
    variables: &'a [Coded],
}

/// The steps of a block of a variable, missing values NaN.
struct Block {
    start: usize,
    steps: Vec<Vec<f32>>,
    /// What was missing, and the range, as the source has it.
    marks: Marks,
    /// The most by which rounding to `f32` changed a value.
    rounding: f64,
}

impl Run<'_> {
    fn blocks(
        &self,
        mesh: &mut dyn MeshSeries,
        writer: &mut CellStoreWriter,
        report: &mut CellReport,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<(), EncodeError> {
        let header = writer.header().clone();
        let num_steps = mesh.times().num_steps();
        let mut done_bytes = header.raw_bytes() / num_steps as u64 * report.steps_resumed as u64;
        for start in (report.steps_resumed..num_steps).step_by(BLOCK_STEPS) {
            let end = num_steps.min(start + BLOCK_STEPS);
            for (variable, coded) in self.variables.iter().enumerate() {
                let step_bytes =
                    header.num_points * header.variables[variable].sample_type.num_bytes() as u64;
                let mut on_share = |step: usize, done_bytes: u64| {
                    progress(Progress { step, num_steps, done_bytes, raw_bytes: header.raw_bytes() });
                };
                on_share(start, done_bytes);
                let block = self.read(mesh, coded, start..end)?;
                let entry = &writer.header().variables[variable];
                let before = entry.min.zip(entry.max).map_or(Marks::NONE.range, |(min, max)| [min, max]);
                let spans = self.code(&block, before, &entry.name.clone())?;
                writer.put(variable, &spans)?;
                report.num_masked += block.marks.num_masked;
                report.num_infinite += block.marks.num_infinite;
                done_bytes += step_bytes * (end - start) as u64;
                on_share(end - 1, done_bytes);
            }
            writer.commit_block()?;
            report.steps_read += end - start;
        }
        match writer.header().variables.iter().find(|v| v.min.is_none()) {
            Some(v) => Err(EncodeError::NoData { variable: v.name.clone(), num_steps }),
            None => Ok(()),
        }
    }

    fn read(
        &self,
        mesh: &mut dyn MeshSeries,
        coded: &Coded,
        steps: std::ops::Range<usize>,
    ) -> Result<Block, EncodeError> {
        let mut block = Block { start: steps.start, steps: Vec::new(), marks: Marks::NONE, rounding: 0.0 };
        for step in steps {
            let (values, marks) = match mesh.read_values(coded.index, step)? {
                Samples::F32(mut values) => {
                    let marks = mark(&mut values, coded.fill_value);
                    (values, marks)
                }
                Samples::F64(mut values) => {
                    let mut marks = mark(&mut values, coded.fill_value);
                    let (values, rounding, num_too_large) = rounded(&values);
                    block.rounding = block.rounding.max(rounding);
                    marks.num_masked += num_too_large;
                    marks.num_infinite += num_too_large;
                    (values, marks)
                }
            };
            block.marks = block.marks.merged(marks);
            block.steps.push(values);
        }
        Ok(block)
    }

    /// * `before`: the range of the steps before the block
    fn code(
        &self,
        block: &Block,
        before: [f64; 2],
        variable: &str,
    ) -> Result<Vec<CellSpanWrite>, EncodeError> {
        let steps: Vec<&[f32]> = block.steps.iter().map(Vec::as_slice).collect();
        let [low, high] = [before[0].min(block.marks.range[0]), before[1].max(block.marks.range[1])];
        let range = self.options.range.unwrap_or([low, high]);
        let bound = self.options.max_error.map(|error| error * width_of(range) - block.rounding);
        let failed = |source| EncodeError::Block {
            variable: variable.to_owned(),
            start: block.start,
            num_steps: block.steps.len(),
            source: Box::new(source),
        };
        let bound = match bound {
            Some(bound) if bound < 0.0 => {
                return Err(EncodeError::InvalidArgument {
                    argument: "--max-error",
                    value: self.options.max_error.unwrap_or(0.0).to_string(),
                    remedy: format!(
                        "cells are kept as f32, which changes variable {variable} by up to {:e}: raise it",
                        block.rounding
                    ),
                });
            }
            bound => bound,
        };
        let options = CellCodecOptions { entries: self.cells.entries, max_error: bound };
        let spans = chronoxel_codec::encode_cells(&steps, &options, &Threads).map_err(failed)?;
        let written: Result<Vec<_>, _> =
            spans.into_par_iter().map(|span| written(span, &steps, block)).collect();
        written.map_err(failed)
    }
}

/// The threads of the ambient pool.
struct Threads;

impl Workers for Threads {
    fn map<T: Sync, R: Send>(&self, items: &[T], work: impl Fn(&T) -> R + Sync + Send) -> Vec<R> {
        items.par_iter().map(work).collect()
    }

    fn for_each_mut<T: Send>(&self, items: &mut [T], work: impl Fn(usize, &mut T) + Sync + Send) {
        items.par_iter_mut().enumerate().for_each(|(place, item)| work(place, item));
    }
}

/// Values rounded to `f32`, the most by which that changes one, and how many are too large for it.
fn rounded(values: &[f64]) -> (Vec<f32>, f64, u64) {
    let (mut rounding, mut num_too_large) = (0.0f64, 0);
    let round = |&value: &f64| {
        let near = value as f32;
        if near.is_infinite() {
            num_too_large += 1;
            return f32::MASKED;
        }
        if !value.is_nan() {
            rounding = rounding.max((f64::from(near) - value).abs());
        }
        near
    };
    let values = values.iter().map(round).collect();
    (values, rounding, num_too_large)
}

/// A span with what it decodes to and how far that is from its source.
fn written(
    span: CellSpan,
    steps: &[&[f32]],
    block: &Block,
) -> Result<CellSpanWrite, chronoxel_codec::CodecError> {
    let steps = &steps[span.start..span.start + span.num_steps];
    let mut decoded = vec![0.0; steps[0].len()];
    let mut sums = Sums::new(steps);
    for (step, values) in steps.iter().enumerate() {
        decode_points(&span.payload, step as u32, &mut decoded)?;
        let pairs = values.iter().zip(&decoded).filter(|(value, _)| !value.is_nan());
        pairs.for_each(|(&value, &found)| sums.take(value, found));
    }
    let missing: Option<BitMask> = span.missing;
    let errors = sums.errors(block.rounding);
    Ok(CellSpanWrite {
        start: (block.start + span.start) as u32,
        window: span.window as u32,
        payload: span.payload,
        missing,
        drawn_range: sums.drawn_range(),
        statistics: sums.statistics(),
        rms_error: errors[0],
        max_error: errors[1],
    })
}

/// Sums over the values of a span.
struct Sums {
    /// One of the values, from which the others are counted, so that a small deviation on a large mean keeps its digits.
    pivot: f64,
    count: u64,
    sum: f64,
    squares: f64,
    range: [f32; 2],
    drawn: [f32; 2],
    squared_errors: f64,
    max_error: f64,
}

impl Sums {
    fn new(steps: &[&[f32]]) -> Self {
        let pivot = steps.iter().flat_map(|step| step.iter()).find(|v| !v.is_nan());
        let nothing = [f32::INFINITY, f32::NEG_INFINITY];
        Self {
            pivot: f64::from(pivot.copied().unwrap_or(0.0)),
            count: 0,
            sum: 0.0,
            squares: 0.0,
            range: nothing,
            drawn: nothing,
            squared_errors: 0.0,
            max_error: 0.0,
        }
    }

    fn take(&mut self, value: f32, found: f32) {
        let from_pivot = f64::from(value) - self.pivot;
        self.count += 1;
        self.sum += from_pivot;
        self.squares += from_pivot * from_pivot;
        self.range = [self.range[0].min(value), self.range[1].max(value)];
        self.drawn = [self.drawn[0].min(found), self.drawn[1].max(found)];
        let error = f64::from(value) - f64::from(found);
        self.squared_errors += error * error;
        self.max_error = self.max_error.max(error.abs());
    }

    fn drawn_range(&self) -> [f64; 2] {
        if self.count == 0 { [f64::NAN; 2] } else { self.drawn.map(f64::from) }
    }

    fn statistics(&self) -> SpanStatistics {
        if self.count == 0 {
            let nan = f64::NAN;
            return SpanStatistics { count: 0, min: nan, max: nan, mean: nan, std: nan };
        }
        let [min, max] = self.range.map(f64::from);
        let mean = self.sum / self.count as f64;
        let variance = (self.squares / self.count as f64 - mean * mean).max(0.0);
        let mean = (self.pivot + mean).clamp(min, max);
        SpanStatistics { count: self.count, min, max, mean, std: variance.sqrt() }
    }

    /// Root mean square and largest.
    fn errors(&self, rounding: f64) -> [f64; 2] {
        if self.count == 0 {
            return [f64::NAN; 2];
        }
        [(self.squared_errors / self.count as f64).sqrt(), self.max_error + rounding]
    }
}
