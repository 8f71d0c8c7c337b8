//! Built-in simulations: real solvers that are sources like any other, `sim:NAME?key=value&…`.
//!
//! | name | what is solved | variable |
//! | --- | --- | --- |
//! | `plume` | advection, diffusion and settling of a discharge in a tidal current | `concentration` |
//! | `vortex` | incompressible turbulence that decays in a periodic box | `vorticity_magnitude` |
//! | `shockbubble` | compressible gas: a shock runs over a light bubble | `density` |
//! | `twist` | nothing: a twisted curvilinear mesh with fields in closed form | `pulse`, `slope` |
//! | `fade` | nothing: the first step of a mesh in files, fading linearly to zero | those of the files |
//!
//! All but `fade`, which takes `mesh` (files between commas), know `dims` (`128` or `160x64x64`) and `steps`. A run covers the same stretch of physical time whatever
//! `steps` is, so more steps show it more finely. A step is computed when it is opened: the state advances from
//! the last opened step, and going back starts over.
//!
//! The numbers are the same on every machine and for any number of threads: work is divided into independent
//! slices and pencils, sums are taken in a fixed order, and transcendental functions come from `libm`.

pub mod euler;
mod fade;
mod fourier;
pub mod navier_stokes;
mod plume;
mod shockbubble;
mod spec;
pub mod transport;
pub mod twist;
mod vortex;

use chronoxel_core::{SampleType, Samples, TimeAxis, UniformGrid};

use crate::mesh::Opened;
use crate::{SourceError, StepReader, TimeSeries, Variable};
use spec::{Spec, invalid};

const NAMES: &str = "plume, vortex, shockbubble, twist, fade";

/// Opens a built-in simulation on a uniform grid as a source; nothing is computed yet.
///
/// # Errors
/// [`SourceError::InvalidArgument`] for a name, key or value that does not exist, saying which do.
pub fn open(spec: &str) -> Result<Box<dyn TimeSeries>, SourceError> {
    match open_any(spec)? {
        Opened::Volume(series) => Ok(series),
        Opened::Mesh(_) => Err(invalid("simulation", spec, "it is a mesh where a uniform grid is needed")),
    }
}

/// Opens whatever is built in as a source: a simulation, or a mesh.
///
/// # Errors
/// As [`open`].
pub fn open_any(spec: &str) -> Result<Opened, SourceError> {
    let spec = Spec::parse(spec)?;
    let series = match spec.name.as_str() {
        "plume" => plume::open(&spec)?,
        "vortex" => vortex::open(&spec)?,
        "shockbubble" => shockbubble::open(&spec)?,
        "fade" => return Ok(Opened::Mesh(fade::open(&spec)?)),
        "twist" => return Ok(Opened::Mesh(twist::open(&spec)?)),
        _ => {
            return Err(invalid(
                "simulation",
                format!("sim:{}", spec.name),
                format!("there is no such simulation; there are {NAMES}"),
            ));
        }
    };
    Ok(Opened::Volume(Box::new(series)))
}

/// A simulation under way.
trait Run: Send {
    /// Advances the state to a later time; called for each step of the series in turn.
    fn advance_to(&mut self, time: f64);

    /// Samples of the present state, `[z, y, x]`, for `count` slices from slice `first` on.
    fn slices(&mut self, first: usize, count: usize) -> Vec<f32>;
}

/// What a scene hands over: everything known before the first step, and how to start.
struct SimulatedSeries {
    grid: UniformGrid,
    times: TimeAxis,
    variable: Variable,
    working: WorkingBytes,
    start: Box<dyn Fn() -> Box<dyn Run> + Send>,
    current: Option<(usize, Box<dyn Run>)>,
}

/// Memory of a simulation.
#[derive(Debug, Clone, Copy)]
struct WorkingBytes {
    /// State, and buffers that all threads share.
    shared: u64,
    /// Buffers that each thread has.
    per_thread: u64,
}

impl SimulatedSeries {
    fn new(
        grid: UniformGrid,
        times: TimeAxis,
        [name, units]: [&str; 2],
        working: WorkingBytes,
        start: Box<dyn Fn() -> Box<dyn Run> + Send>,
    ) -> Self {
        let variable = Variable {
            name: name.to_owned(),
            units: units.to_owned(),
            sample_type: SampleType::F32,
            fill_value: None,
        };
        Self { grid, times, variable, working, start, current: None }
    }

    /// The state at `step`; every step on the way is stopped at, so that the result does not depend on which
    /// steps were opened.
    fn run_to(&mut self, step: usize) -> &mut dyn Run {
        let resumable = self.current.take().filter(|(reached, _)| *reached <= step);
        let (reached, mut run) = resumable.unwrap_or_else(|| {
            let mut run = (self.start)();
            run.advance_to(self.times.times[0]);
            (0, run)
        });
        for &time in &self.times.times[reached + 1..=step] {
            run.advance_to(time);
        }
        self.current.insert((step, run)).1.as_mut()
    }
}

impl TimeSeries for SimulatedSeries {
    fn grid(&self) -> &UniformGrid {
        &self.grid
    }

    fn times(&self) -> &TimeAxis {
        &self.times
    }

    fn variables(&self) -> &[Variable] {
        std::slice::from_ref(&self.variable)
    }

    fn working_bytes(&self) -> u64 {
        self.working.shared + self.working.per_thread * rayon::current_num_threads() as u64
    }

    fn open_step<'a>(
        &'a mut self,
        variable: usize,
        step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError> {
        assert!(variable == 0 && step < self.times.num_steps(), "variable {variable}, step {step}");
        Ok(Box::new(SimulatedStep { run: self.run_to(step), next_slice: 0 }))
    }
}

struct SimulatedStep<'a> {
    run: &'a mut dyn Run,
    next_slice: usize,
}

impl StepReader for SimulatedStep<'_> {
    fn read_slices(&mut self, num_slices: usize) -> Result<Samples, SourceError> {
        let samples = self.run.slices(self.next_slice, num_slices);
        self.next_slice += num_slices;
        Ok(Samples::F32(samples))
    }
}
