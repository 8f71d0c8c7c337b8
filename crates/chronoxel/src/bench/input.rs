//! The data of a bench: a source as the user names it. A simulation is run once, and its steps are kept in a file, so that what
//! is measured is not the simulation.

use std::path::Path;

use chronoxel_core::{Samples, TimeAxis, UniformGrid};
use chronoxel_ingest::{
    SourceError, StepReader, TimeSeries, Variable,
    export::{self, ExportDescription},
    sources::{self, SourceOptions},
};

use super::Workplace;
use crate::interrupt;

/// A source of a bench, opened; its first variable is measured.
pub struct Input {
    name: String,
    series: Box<dyn TimeSeries>,
}

impl Input {
    /// Opens a source: a path, a glob, or a simulation.
    ///
    /// # Errors
    /// Whatever keeps it from being read.
    pub fn open(name: &str, options: &SourceOptions) -> anyhow::Result<Self> {
        let series = sources::open(&[name.to_owned()], options)?;
        Ok(Self { name: name.to_owned(), series })
    }

    /// A series that is made here.
    pub fn of(name: &str, series: Box<dyn TimeSeries>) -> Self {
        Self { name: name.to_owned(), series }
    }

    /// The source in the user's words.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Whether the steps are computed when they are read.
    pub fn is_simulated(&self) -> bool {
        self.name.starts_with("sim:")
    }

    /// Whether it is the built-in simulation of a name.
    pub fn is_simulation(&self, name: &str) -> bool {
        let spec = self.name.strip_prefix("sim:").unwrap_or_default();
        spec.split('?').next() == Some(name)
    }

    /// Number of steps.
    pub fn num_steps(&self) -> usize {
        self.series.times().num_steps()
    }

    /// Samples of one step.
    pub fn num_samples(&self) -> usize {
        self.series.grid().num_samples()
    }

    /// The variable that is measured.
    pub fn variable(&self) -> &Variable {
        &self.series.variables()[0]
    }

    /// The series, which ends with an error at the next step once Ctrl-C was pressed.
    pub fn series(&mut self) -> impl TimeSeries {
        Interruptible(self.series.as_mut())
    }

    /// Runs a simulation, keeps its steps in a file, and reads them from there from now on; other sources stay as they are.
    ///
    /// # Errors
    /// If the file cannot be written, or Ctrl-C was pressed.
    pub fn record(&mut self, place: &Workplace, on_step: &mut dyn FnMut()) -> anyhow::Result<()> {
        if !self.is_simulated() {
            return Ok(());
        }
        let path = place.path("recorded.npy");
        let description = write_steps(&mut self.series(), &path, on_step)?;
        let times = &description.times.times;
        let options = SourceOptions {
            spacing: Some(description.grid.spacing),
            origin: Some(description.grid.origin),
            dt: times.get(1).map(|second| second - times[0]),
            ..SourceOptions::default()
        };
        self.series = sources::open(&[path.to_string_lossy().into_owned()], &options)?;
        Ok(())
    }
}

/// Writes the first variable of a series.
fn write_steps(
    series: &mut dyn TimeSeries,
    path: &Path,
    on_step: &mut dyn FnMut(),
) -> anyhow::Result<ExportDescription> {
    let variable = series.variables()[0].clone();
    let description = ExportDescription {
        grid: *series.grid(),
        times: series.times().clone(),
        name: variable.name,
        units: variable.units,
        sample_type: variable.sample_type,
        fill_value: variable.fill_value,
    };
    let num_slices = description.grid.dims[2];
    let mut writer = export::create(path, &description)?;
    for step in 0..description.times.num_steps() {
        let samples: Samples = series.open_step(0, step)?.read_slices(num_slices)?;
        writer.write_step(step, &samples.to_f64())?;
        on_step();
    }
    writer.finish()?;
    Ok(description)
}

/// A series that cannot be read any more once Ctrl-C was pressed: what reads it ends and cleans up.
struct Interruptible<'a>(&'a mut dyn TimeSeries);

impl TimeSeries for Interruptible<'_> {
    fn grid(&self) -> &UniformGrid {
        self.0.grid()
    }

    fn times(&self) -> &TimeAxis {
        self.0.times()
    }

    fn variables(&self) -> &[Variable] {
        self.0.variables()
    }

    fn working_bytes(&self) -> u64 {
        self.0.working_bytes()
    }

    fn open_step<'a>(
        &'a mut self,
        variable: usize,
        step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError> {
        if interrupt::check().is_err() {
            let source = std::io::ErrorKind::Interrupted.into();
            return Err(SourceError::Io { path: "source".into(), action: "read", source });
        }
        self.0.open_step(variable, step)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all_samples(series: &mut dyn TimeSeries) -> Vec<Vec<f64>> {
        let num_slices = series.grid().dims[2];
        let steps = 0..series.times().num_steps();
        steps.map(|s| series.open_step(0, s).unwrap().read_slices(num_slices).unwrap().to_f64()).collect()
    }

    #[test]
    fn a_recorded_simulation_has_the_same_samples_grid_and_times() {
        let parent = tempfile::tempdir().unwrap();
        let place = Workplace::within(parent.path()).unwrap();
        let mut input = Input::open("sim:vortex?dims=16&steps=3", &SourceOptions::default()).unwrap();
        let expected = all_samples(&mut input.series());
        let place_in_space_and_time = |input: &mut Input| {
            let series = input.series();
            (*series.grid(), series.times().times.clone())
        };
        let before = place_in_space_and_time(&mut input);
        let mut num_recorded = 0;
        input.record(&place, &mut || num_recorded += 1).unwrap();
        assert_eq!(num_recorded, 3);
        assert_eq!(all_samples(&mut input.series()), expected);
        assert_eq!(place_in_space_and_time(&mut input), before);
        assert!(
            input.is_simulation("vortex") && !input.is_simulation("vor") && !input.is_simulation("plume")
        );
    }
}
