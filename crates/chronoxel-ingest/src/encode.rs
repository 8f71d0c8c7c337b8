//! The encoder: one pass over the steps of a series, each sample read once, into a store.
//!
//! A step streams past in slabs (`stream`); each level is filtered from the one below (`pyramid`); as soon as the
//! slices of a layer of bricks are there, its bricks are cut (`cut`), analysed (`analyse`), padded where masked
//! (`pad`), coded (`coding`) and handed to the store's writer; the finest ones are taken into the statistics of the time tree
//! (`moments`). Codecs that use time let bricks wait (`scratch`) until the
//! window of their node is over (`timing`, `windowed`). Memory and threads decide how much is done at once (`budget`), never
//! what comes out.

mod analyse;
mod budget;
mod cells;
mod choose;
mod coding;
mod cut;
pub(crate) mod mark;
mod moments;
mod node;
mod options;
mod output;
mod pad;
mod palettes;
mod pyramid;
mod rate;
pub(crate) mod real;
mod resume;
pub(crate) mod scratch;
mod slices;
mod source;
mod step;
pub(crate) mod stream;
mod timing;
mod variable;
pub(crate) mod window;
mod windowed;

use std::path::Path;
use std::time::Instant;

use chronoxel_core::{BrickLayout, SampleType, octree::levels_of};
use chronoxel_store::{Store, StoreDescription, StoreWriter, TimeTreeEntry, VariableDescription};
use serde::Deserialize;
use serde_json::{Value, json};

pub(crate) use cells::same_geometry;
pub use cells::{CellOptions, CellReport, encode_cells};
pub use options::{Codec, EncodeOptions, EncodeReport, Progress};

use crate::voxelise::{Room, VoxelOptions, Voxels};
use crate::{EncodeError, MeshSeries, TimeSeries};
use budget::Portions;
use output::Output;
use rate::Spending;
use source::Source;
use step::Stepper;
use stream::StreamPlan;
use variable::{Before, Coding, How, Places, StepTask, VariableEncoder};

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
    options.check()?;
    encode_source(Source::Volume(series), output, options, progress)
}

/// Encodes a series on a mesh into the store `output`: voxelises the mesh once, then resamples each step to bricks.
///
/// All that is said of [`encode`] holds; the bytes depend on [`EncodeOptions::voxels`] too. The series is read once more before, for
/// the variation of its values, at most.
///
/// # Errors
/// [`EncodeError`]: see its variants.
pub fn encode_mesh(
    mesh: &mut dyn MeshSeries,
    output: &Path,
    options: &EncodeOptions,
    progress: &mut dyn FnMut(Progress),
) -> Result<EncodeReport, EncodeError> {
    options.check()?;
    if options.codec == Codec::PaletteSlice {
        return Err(EncodeError::InvalidArgument {
            argument: "--codec",
            value: options.codec.name().into(),
            remedy: "a mesh has no slices: use palette".into(),
        });
    }
    let folder = output.parent().unwrap_or(Path::new("."));
    let mut voxels = voxels_of(mesh, folder, options)?;
    let report = *voxels.report();
    if Job::new(&Source::Mesh(mesh, &voxels), options).is_err() {
        // What encoding needs comes first; the map can be read from its file.
        voxels.spill()?;
    }
    let encoded = encode_source(Source::Mesh(mesh, &voxels), output, options, progress)?;
    Ok(EncodeReport { voxels: Some(report), ..encoded })
}

/// Voxelises a mesh as an encoding with these options does.
fn voxels_of(
    mesh: &mut dyn MeshSeries,
    folder: &Path,
    options: &EncodeOptions,
) -> Result<Voxels, EncodeError> {
    let layout = BrickLayout::new(options.brick_edge)?;
    let variables = options.choose_variables(mesh.variables(), mesh.times().num_steps())?;
    let variables: Vec<_> = variables.iter().map(|(index, coding)| (*index, coding.fill_value)).collect();
    voxelised(mesh, &variables, &layout, &options.voxels, folder, options.memory_bytes)
}

/// Voxelises a mesh within some memory.
///
/// * `variables`: their indices in the series, and what means "no data"
pub(crate) fn voxelised(
    mesh: &mut dyn MeshSeries,
    variables: &[(usize, Option<f64>)],
    layout: &BrickLayout,
    options: &VoxelOptions,
    folder: &Path,
    memory_bytes: u64,
) -> Result<Voxels, EncodeError> {
    let room = budget::voxel_room(mesh, layout, memory_bytes)?;
    let room = Room { folder, list_bytes: room.list_bytes, map_bytes: room.map_bytes };
    Voxels::new(mesh, variables, layout, options, room)
}

fn encode_source(
    mut source: Source<'_>,
    output: &Path,
    options: &EncodeOptions,
    progress: &mut dyn FnMut(Progress),
) -> Result<EncodeReport, EncodeError> {
    let started = Instant::now();
    let job = Job::new(&source, options)?;
    let (place, mut writer, first) = Output::open::<StoreWriter>(output, &job.description, options)?;
    let mut report = EncodeReport { raw_bytes: job.raw_bytes(), ..EncodeReport::default() };
    let folder = output.parent().unwrap_or(Path::new("."));
    match job.run(&mut source, &mut writer, first, folder, &mut report, progress) {
        Ok(()) => writer.finish()?,
        Err(error) => return Err(place.abandon(writer, error)),
    };
    place.keep()?;
    report.stored_bytes = Store::open(output)?.stored_bytes()?;
    report.wall_secs = started.elapsed().as_secs_f64();
    Ok(report)
}

/// Everything that is decided before the first step.
struct Job {
    description: StoreDescription,
    plan: StreamPlan,
    portions: Portions,
    /// For each variable of the store: its index in the series, and how it is coded.
    variables: Vec<(usize, Coding)>,
    /// Core samples inside the grid over the nodes of each level.
    samples: Vec<u64>,
    num_leaves: u64,
    /// Numbers that the source has for a step of a variable.
    num_values: u64,
    /// Samples of the finest nodes.
    finest_samples: u64,
    /// What the cores of nodes above the finest may take in memory, while the bricks of a mesh are made.
    core_bytes: u64,
    /// Whether the windows of nodes begin out of phase.
    interleaved: bool,
}

impl Job {
    fn new(source: &Source<'_>, options: &EncodeOptions) -> Result<Self, EncodeError> {
        let grid = *source.grid();
        let layout = BrickLayout::new(options.brick_edge)?;
        let levels = levels_of(&grid, &layout);
        let variables = options.choose_variables(source.variables(), source.times().num_steps())?;
        let types = variables.iter().map(|(index, _)| source.variables()[*index].sample_type);
        let sample_type = types.max_by_key(|t| t.num_bytes()).unwrap_or(SampleType::F64);
        let tree = source.tree(&levels);
        let finest_samples = source.num_finest_samples();
        let is_mesh = matches!(source, Source::Mesh(..));
        let num_threads = rayon::current_num_threads();
        let core_bytes = if is_mesh { options.memory_bytes / budget::CORE_SHARE } else { 0 };
        let nodes: Vec<u64> = levels.iter().map(|level| tree.nodes(level.level).len() as u64).collect();
        let num_leaves = source::num_leaves(&tree);
        let time_tree = TimeTreeEntry::of_samples(finest_samples);
        let most =
            |of: &dyn Fn(&How) -> u64| variables.iter().map(|(_, coding)| of(&coding.how)).max().unwrap_or(0);
        let task = budget::Task {
            levels: &levels,
            layout: &layout,
            sample_type,
            num_volumes: (variables.len() as u64).saturating_mul(source.times().num_steps() as u64),
            num_threads,
            source_bytes: source.working_bytes(sample_type, num_threads) + core_bytes,
            nodes: &nodes,
            num_leaves,
            has_slices: !is_mesh,
            window: most(&|how| u64::from(how.window())) as u32,
            copies: most(&How::copies),
            held_nodes: most(&|how| how.held_nodes(&levels[0])),
            held_payload_bytes: most(&How::held_payload_bytes),
            num_variables: variables.len() as u64,
            num_steps: source.times().num_steps() as u32,
            stride: time_tree.stride,
        };
        let portions = budget::portions(&task, options.memory_bytes)?;
        let described = variables.iter().map(|(index, coding)| {
            let variable = &source.variables()[*index];
            VariableDescription {
                name: variable.name.clone(),
                units: variable.units.clone(),
                sample_type: variable.sample_type,
                fill_value: coding.fill_value,
                windows: coding.how.windows(),
                classes: coding.how.classes(&layout),
            }
        });
        let samples = source::samples_of_levels(&tree, &levels, layout.edge);
        let description = StoreDescription {
            grid,
            times: source.times().clone(),
            layout,
            tree,
            variables: described.collect(),
            zstd_level: variables.iter().map(|(_, coding)| coding.how.zstd_level()).max().unwrap_or(1),
            time_tree: Some(time_tree),
            encoder: options.recorded(is_mesh),
            mesh: source.mesh_entry(),
        };
        let plan = StreamPlan { levels, layout, slab_slices: portions.slab_slices };
        let num_values = source.num_values();
        Ok(Self {
            description,
            plan,
            portions,
            variables,
            samples,
            num_leaves,
            num_values,
            finest_samples,
            interleaved: options.interleaved,
            core_bytes,
        })
    }

    fn num_steps(&self) -> usize {
        self.description.times.num_steps()
    }

    /// Bytes of one step of a variable in the source.
    fn step_bytes(&self, variable: usize) -> u64 {
        let bytes = self.description.variables[variable].sample_type.num_bytes() as u64;
        bytes.saturating_mul(self.num_values)
    }

    fn raw_bytes(&self) -> u64 {
        let sum = |bytes: u64, variable| bytes.saturating_add(self.step_bytes(variable));
        (0..self.variables.len()).fold(0, sum).saturating_mul(self.num_steps() as u64)
    }

    fn run(
        &self,
        source: &mut Source<'_>,
        writer: &mut StoreWriter,
        first: u32,
        folder: &Path,
        report: &mut EncodeReport,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<(), EncodeError> {
        report.steps_resumed = first as usize;
        let statistics_first = moments::first_step(writer.steps_committed(), self.num_steps() as u32);
        let start = first.min(statistics_first) as usize;
        let mut told = Progress {
            step: start,
            num_steps: self.num_steps(),
            done_bytes: report.raw_bytes / self.num_steps() as u64 * start as u64,
            raw_bytes: report.raw_bytes,
        };
        let mut encoders = self.encoders(source, writer, [start as u32, statistics_first], folder)?;
        for step in start..self.num_steps() {
            told.step = step;
            // What is read again for its statistics alone is finished.
            let is_finished = step < first as usize;
            for (variable, encoder) in encoders.iter_mut().enumerate() {
                let bytes = self.step_bytes(variable);
                let mut on_share = |share| {
                    let done_bytes = told.done_bytes + (bytes as f64 * share) as u64;
                    progress(Progress { done_bytes, ..told.clone() });
                };
                let marks =
                    encoder.encode_step(source, &self.task(step), writer, &mut self.shares(&mut on_share))?;
                told.done_bytes += bytes;
                if !is_finished {
                    report.num_masked += marks.num_masked;
                    report.num_infinite += marks.num_infinite;
                }
            }
            if !is_finished {
                writer.set_carry(carry_of(step, &encoders));
                writer.commit_step(step as u32)?;
                report.steps_read += 1;
            }
        }
        match writer.header().variables.iter().find(|v| v.min.is_none()) {
            Some(v) => Err(EncodeError::NoData { variable: v.name.clone(), num_steps: self.num_steps() }),
            None => Ok(()),
        }
    }

    /// * `start`: the step to read next
    /// * `statistics_first`: the one that statistics go on from
    fn encoders(
        &self,
        source: &Source<'_>,
        writer: &StoreWriter,
        [start, statistics_first]: [u32; 2],
        folder: &Path,
    ) -> Result<Vec<VariableEncoder<'_>>, EncodeError> {
        let places = Places {
            tree: &self.description.tree,
            num_leaves: self.num_leaves,
            samples: &self.samples,
            source_samples: self.finest_samples,
            layout: &self.description.layout,
            num_steps: self.num_steps() as u32,
            interleaved: self.interleaved,
            stride: self.description.time_tree.map_or(1, |entry| entry.stride),
            folder,
            scratch_bytes: self.portions.scratch_bytes / self.variables.len() as u64,
        };
        let encoders = self.variables.iter().enumerate().map(|(variable, (index, coding))| {
            let before = Before {
                ranges: ranges_before(writer.carry(), variable, start as usize),
                spending: Spending::deserialize(&writer.carry()["spending"][variable]).ok(),
                first: statistics_first,
            };
            let fits_f32 = source.variables()[*index].sample_type.fits_f32();
            VariableEncoder::new([*index, variable], coding, fits_f32, &places, before, writer)
        });
        encoders.collect()
    }

    fn task(&self, step: usize) -> StepTask<'_> {
        let stepper = Stepper {
            plan: &self.plan,
            tree: &self.description.tree,
            batch_bricks: self.portions.batch_bricks,
            core_bytes: self.core_bytes,
        };
        StepTask { stepper, batch_nodes: self.portions.batch_nodes, step: step as u32 }
    }

    /// Counts bricks of level 0 into the share of a step that is done.
    fn shares<'a>(&self, on_share: &'a mut dyn FnMut(f64)) -> impl FnMut(u8, usize) + 'a {
        let num_finest = self.description.tree.nodes(0).len().max(1) as f64;
        let mut finest_done = 0;
        move |level: u8, num_bricks: usize| {
            if level == 0 {
                finest_done += num_bricks;
                on_share(finest_done as f64 / num_finest);
            }
        }
    }
}

/// What a resume must know of the steps that it does not read again: the ranges of the last ones, and what was spent.
fn carry_of(step: usize, encoders: &[VariableEncoder<'_>]) -> Value {
    let ranges: Vec<&[[f64; 2]]> = encoders.iter().map(VariableEncoder::ranges).collect();
    let spending: Vec<Option<&Spending>> = encoders.iter().map(VariableEncoder::spending).collect();
    json!({ "step": step, "ranges": ranges, "spending": spending })
}

/// The ranges of a variable up to each of the steps before `first`, from a carry.
fn ranges_before(carry: &Value, variable: usize, first: usize) -> Vec<[f64; 2]> {
    let last = carry["step"].as_u64().unwrap_or(0) as usize;
    // JSON has no infinities: those of a range without samples are null.
    let ranges = Vec::<[Option<f64>; 2]>::deserialize(&carry["ranges"][variable]).unwrap_or_default();
    let num_after = (last + 1).saturating_sub(first).min(ranges.len());
    let range =
        |[low, high]: [Option<f64>; 2]| [low.unwrap_or(f64::INFINITY), high.unwrap_or(f64::NEG_INFINITY)];
    ranges[..ranges.len() - num_after].iter().copied().map(range).collect()
}
