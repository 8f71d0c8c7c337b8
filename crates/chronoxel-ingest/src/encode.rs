//! The encoder: one pass over the steps of a series, each sample read once, into a store.
//!
//! A step streams past in slabs (`stream`); each level is filtered from the one below (`pyramid`); as soon as the
//! slices of a layer of bricks are there, its bricks are cut (`cut`), analysed (`analyse`), padded where masked
//! (`pad`), coded (`coding`) and handed to the store's writer. Memory and threads decide how much is done at once
//! (`budget`), never what comes out.

mod analyse;
mod budget;
#[cfg_attr(not(test), expect(dead_code, reason = "the pipeline of windows through time calls it"))]
mod choose;
mod coding;
mod cut;
mod mark;
mod options;
mod output;
mod pad;
mod pyramid;
pub(crate) mod real;
mod resume;
mod step;
pub(crate) mod stream;
pub(crate) mod window;

use std::path::Path;
use std::time::Instant;

use chronoxel_core::{BrickLayout, Octree, SampleType, octree::levels_of};
use chronoxel_store::{StoreDescription, StoreWriter, VariableDescription};

pub use options::{Codec, EncodeOptions, EncodeReport, Progress};

use crate::{EncodeError, TimeSeries};
use output::Output;
use step::{Coding, Encoder};
use stream::StreamPlan;

/// Encodes a series into the store `output`.
///
/// Each step is read once, in order, front to back. Runs on the ambient rayon pool and one more thread, which reads
/// ahead. The store's bytes depend on the series and on the options that say so, not on threads or memory.
///
/// While it runs the store lies at `output` and opens up to the last finished step. After an error nothing is left
/// there: without a finished step it is removed, otherwise kept as `NAME.partial.cxl`, where a resume looks for it too.
///
/// # Errors
/// [`EncodeError`]: see its variants.
pub fn encode(
    series: &mut dyn TimeSeries,
    output: &Path,
    options: &EncodeOptions,
    progress: &mut dyn FnMut(Progress),
) -> Result<EncodeReport, EncodeError> {
    let started = Instant::now();
    options.check()?;
    let job = Job::new(series, options)?;
    let (place, mut writer) = Output::open(output, &job.description, options)?;
    let mut report = EncodeReport { raw_bytes: job.raw_bytes(), ..EncodeReport::default() };
    match job.run(series, &mut writer, &mut report, progress) {
        Ok(()) => writer.finish()?,
        Err(error) => return Err(place.abandon(writer, error)),
    };
    report.stored_bytes = place.keep()?;
    report.wall_secs = started.elapsed().as_secs_f64();
    Ok(report)
}

/// Everything that is decided before the first step.
struct Job {
    description: StoreDescription,
    plan: StreamPlan,
    batch_bricks: usize,
    /// For each variable of the store: its index in the series, and how it is coded.
    variables: Vec<(usize, Coding)>,
}

impl Job {
    fn new(series: &dyn TimeSeries, options: &EncodeOptions) -> Result<Self, EncodeError> {
        let grid = *series.grid();
        let layout = BrickLayout::new(options.brick_edge)?;
        let levels = levels_of(&grid, &layout);
        let variables = options.choose_variables(series.variables())?;
        let types = variables.iter().map(|(index, _)| series.variables()[*index].sample_type);
        let task = budget::Task {
            levels: &levels,
            layout: &layout,
            sample_type: types.max_by_key(|t| t.num_bytes()).unwrap_or(SampleType::F64),
            num_volumes: (variables.len() as u64).saturating_mul(series.times().num_steps() as u64),
            num_threads: rayon::current_num_threads(),
            source_bytes: series.working_bytes(),
        };
        let portions = budget::portions(&task, options.memory_bytes)?;
        let described = variables.iter().map(|(index, coding)| {
            let variable = &series.variables()[*index];
            VariableDescription {
                name: variable.name.clone(),
                units: variable.units.clone(),
                sample_type: variable.sample_type,
                fill_value: coding.fill_value,
                windows: vec![1],
                classes: coding.classes(),
            }
        });
        let description = StoreDescription {
            grid,
            times: series.times().clone(),
            layout,
            tree: Octree::full(&levels),
            variables: described.collect(),
            encoder: options.recorded(),
        };
        let plan = StreamPlan { levels, layout, slab_slices: portions.slab_slices };
        Ok(Self { description, plan, batch_bricks: portions.batch_bricks, variables })
    }

    fn num_steps(&self) -> usize {
        self.description.times.num_steps()
    }

    /// Bytes of one step of a variable in the source.
    fn step_bytes(&self, variable: usize) -> u64 {
        let bytes = self.description.variables[variable].sample_type.num_bytes() as u64;
        bytes.saturating_mul(self.description.grid.num_samples() as u64)
    }

    fn raw_bytes(&self) -> u64 {
        let sum = |bytes: u64, variable| bytes.saturating_add(self.step_bytes(variable));
        (0..self.variables.len()).fold(0, sum).saturating_mul(self.num_steps() as u64)
    }

    fn run(
        &self,
        series: &mut dyn TimeSeries,
        writer: &mut StoreWriter,
        report: &mut EncodeReport,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<(), EncodeError> {
        let first = writer.header().num_steps_finished as usize;
        report.steps_resumed = first;
        let mut told = Progress {
            step: first,
            num_steps: self.num_steps(),
            done_bytes: report.raw_bytes / self.num_steps() as u64 * first as u64,
            raw_bytes: report.raw_bytes,
        };
        for step in first..self.num_steps() {
            told.step = step;
            for variable in 0..self.variables.len() {
                let bytes = self.step_bytes(variable);
                let marks = self.encode_one(series, writer, variable, step, &mut |share| {
                    let done_bytes = told.done_bytes + (bytes as f64 * share) as u64;
                    progress(Progress { done_bytes, ..told.clone() });
                })?;
                told.done_bytes += bytes;
                report.num_masked += marks.num_masked;
                report.num_infinite += marks.num_infinite;
            }
            writer.commit_step(step as u32)?;
            report.steps_read += 1;
        }
        match writer.header().variables.iter().find(|v| v.min.is_none()) {
            Some(v) => Err(EncodeError::NoData { variable: v.name.clone(), num_steps: self.num_steps() }),
            None => Ok(()),
        }
    }

    /// One step of one variable; `share` is told which part of it is done.
    fn encode_one(
        &self,
        series: &mut dyn TimeSeries,
        writer: &mut StoreWriter,
        variable: usize,
        step: usize,
        share: &mut dyn FnMut(f64),
    ) -> Result<mark::Marks, EncodeError> {
        let (index, coding) = &self.variables[variable];
        let fits_f32 = series.variables()[*index].sample_type.fits_f32();
        // The writer's, not our own: after a resume it is what it would have been without.
        let seen = &writer.header().variables[variable];
        let seen = [seen.min.unwrap_or(f64::INFINITY), seen.max.unwrap_or(f64::NEG_INFINITY)];
        let encoder =
            Encoder { plan: &self.plan, tree: &self.description.tree, batch_bricks: self.batch_bricks };
        let num_finest = self.description.tree.nodes(0).len() as f64;
        let mut finest_done = 0;
        let mut on_bricks = |level: u8, num_bricks: usize| {
            if level == 0 {
                finest_done += num_bricks;
                share(finest_done as f64 / num_finest);
            }
        };
        let mut put = |level, spans| Ok(writer.put(variable, level, spans)?);
        let reader = series.open_step(*index, step)?;
        match fits_f32 {
            true => encoder.encode_step::<f32>(reader, coding, step, seen, &mut put, &mut on_bricks),
            false => encoder.encode_step::<f64>(reader, coding, step, seen, &mut put, &mut on_bricks),
        }
    }
}
