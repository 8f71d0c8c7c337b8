//! One series from one or many files: the same grid and variables in all, times in increasing order.

use chronoxel_core::{TimeAxis, UniformGrid};

use super::SourceOptions;
use super::volume_file::{FileHeader, FileTimes, VolumeFile, checked_grid, checked_steps, dims_text};
use crate::{SourceError, StepReader, TimeSeries, Variable};

/// Relative difference of origin or spacing that two writers may differ by for the same grid.
const GRID_TOLERANCE: f64 = 1e-6;

/// Files one after the other in time.
pub(crate) struct FileSeries {
    files: Vec<Box<dyn VolumeFile>>,
    grid: UniformGrid,
    times: TimeAxis,
    variables: Vec<Variable>,
    /// Per file: where each variable of the series is in it.
    variable_in_file: Vec<Vec<usize>>,
    /// First step of each file, and the number of steps at the end.
    first_steps: Vec<usize>,
    /// The file that was read last.
    last_file: usize,
}

impl FileSeries {
    /// Joins files whose headers were read; there is at least one.
    pub fn new(files: Vec<Box<dyn VolumeFile>>, options: &SourceOptions) -> Result<Self, SourceError> {
        let first = files[0].header();
        let all_variables = named_variables(first, files.len() > 1);
        let wanted = select_variables(&all_variables, &options.variables)?;
        let mut first_steps = vec![0];
        let mut variable_in_file = Vec::with_capacity(files.len());
        for file in &files {
            let header = file.header();
            check_same_grid(first, header)?;
            let places = check_same_variables(first, header)?;
            variable_in_file.push(wanted.iter().map(|&v| places[v]).collect());
            let end = first_steps[first_steps.len() - 1] + header.num_steps;
            first_steps.push(checked_steps(&header.path, "number of time steps", end)?);
        }
        let mut variables: Vec<Variable> = wanted.iter().map(|&v| all_variables[v].clone()).collect();
        if let Some(fill) = options.fill_value {
            variables.iter_mut().for_each(|v| v.fill_value = Some(fill));
        }
        let grid = checked_grid(
            &first.path,
            first.grid.dims,
            options.origin.unwrap_or(first.grid.origin),
            options.spacing.unwrap_or(first.grid.spacing),
        )?;
        let headers: Vec<&FileHeader> = files.iter().map(|file| file.header()).collect();
        let times = time_axis(&headers, options)?;
        Ok(Self { files, grid, times, variables, variable_in_file, first_steps, last_file: 0 })
    }
}

impl TimeSeries for FileSeries {
    fn grid(&self) -> &UniformGrid {
        &self.grid
    }

    fn times(&self) -> &TimeAxis {
        &self.times
    }

    fn variables(&self) -> &[Variable] {
        &self.variables
    }

    fn working_bytes(&self) -> u64 {
        // One file at a time holds anything.
        self.files.iter().map(|file| file.working_bytes()).max().unwrap_or(0)
    }

    fn open_step<'a>(
        &'a mut self,
        variable: usize,
        step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError> {
        let file = self.first_steps.partition_point(|&first| first <= step) - 1;
        if file != self.last_file {
            self.files[self.last_file].forget();
            self.last_file = file;
        }
        let in_file = self.variable_in_file[file][variable];
        self.files[file].open_step(in_file, step - self.first_steps[file])
    }
}

/// The variables of the first file, a name being found for the one that has none.
pub(crate) fn named_variables<G>(header: &FileHeader<G>, in_series: bool) -> Vec<Variable> {
    let stem = header.path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let stem = match in_series {
        true => stem.trim_end_matches(|c: char| c.is_ascii_digit() || "._- ".contains(c)),
        false => &stem,
    };
    let stem = if stem.is_empty() { "data" } else { stem };
    let mut variables = header.variables.clone();
    variables.iter_mut().for_each(|v| {
        if v.name.is_empty() || v.name.starts_with('_') && v.name[1..].parse::<usize>().is_ok() {
            v.name = format!("{stem}{}", v.name);
        }
    });
    variables
}

/// Indices of the wanted variables, in the order wanted; all of them where none is named.
pub(crate) fn select_variables(variables: &[Variable], wanted: &[String]) -> Result<Vec<usize>, SourceError> {
    if wanted.is_empty() {
        return Ok((0..variables.len()).collect());
    }
    let names: Vec<&str> = variables.iter().map(|v| v.name.as_str()).collect();
    let mut found = Vec::with_capacity(wanted.len());
    for name in wanted {
        let Some(index) = names.iter().position(|n| n == name) else {
            return Err(SourceError::argument(
                "--variable",
                name,
                format!("the source has {}", names.join(", ")),
            ));
        };
        if found.contains(&index) {
            return Err(SourceError::argument("--variable", name, "name it once"));
        }
        found.push(index);
    }
    Ok(found)
}

/// Every file of a series has the grid of the first.
fn check_same_grid(first: &FileHeader, header: &FileHeader) -> Result<(), SourceError> {
    let differs = |field: &str, ours: String, firsts: String| {
        let problem = format!("{} has {firsts}; all files of a series must agree", first.path.display());
        Err(SourceError::corrupt(&header.path, field, ours, problem))
    };
    if header.grid.dims != first.grid.dims {
        return differs("dimensions", dims_text(header.grid.dims), dims_text(first.grid.dims));
    }
    let near = |a: [f64; 3], b: [f64; 3]| {
        (0..3).all(|i| (a[i] - b[i]).abs() <= GRID_TOLERANCE * first.grid.spacing[i])
    };
    if !near(header.grid.spacing, first.grid.spacing) {
        return differs("spacing", format!("{:?}", header.grid.spacing), format!("{:?}", first.grid.spacing));
    }
    if !near(header.grid.origin, first.grid.origin) {
        return differs("origin", format!("{:?}", header.grid.origin), format!("{:?}", first.grid.origin));
    }
    Ok(())
}

/// Every file of a series has the variables of the first; gives where each of them is in this file.
pub(crate) fn check_same_variables<G>(
    first: &FileHeader<G>,
    header: &FileHeader<G>,
) -> Result<Vec<usize>, SourceError> {
    let names =
        |h: &FileHeader<G>| h.variables.iter().map(|v| v.name.as_str()).collect::<Vec<_>>().join(", ");
    let problem =
        |what: String| format!("{} has {what}; all files of a series must agree", first.path.display());
    let mut places = Vec::with_capacity(first.variables.len());
    for variable in &first.variables {
        let place = header.variables.iter().position(|v| v.name == variable.name);
        let Some(place) = place.filter(|_| header.variables.len() == first.variables.len()) else {
            return Err(SourceError::corrupt(
                &header.path,
                "variables",
                names(header),
                problem(names(first)),
            ));
        };
        let ours = &header.variables[place];
        if ours.sample_type != variable.sample_type {
            let field = format!("type of {:?}", variable.name);
            let problem = problem(variable.sample_type.to_string());
            return Err(SourceError::corrupt(&header.path, field, ours.sample_type, problem));
        }
        if ours.fill_value.map(f64::to_bits) != variable.fill_value.map(f64::to_bits) {
            let field = format!("fill value of {:?}", variable.name);
            let problem = problem(format!("{:?}", variable.fill_value));
            return Err(SourceError::corrupt(&header.path, field, format!("{:?}", ours.fill_value), problem));
        }
        places.push(place);
    }
    Ok(places)
}

/// The times of all steps: `dt` where the caller gives it, else the files' own, else the step's number.
pub(crate) fn time_axis<G>(
    files: &[&FileHeader<G>],
    options: &SourceOptions,
) -> Result<TimeAxis, SourceError> {
    let num_steps = files.iter().map(|f| f.num_steps).sum();
    let units = files[0].time_units.clone();
    let dt = options.dt.unwrap_or(1.0);
    if !(dt.is_finite() && dt > 0.0) {
        return Err(SourceError::argument("--dt", dt, "the time between steps must be finite and positive"));
    }
    let known = if options.dt.is_some() { None } else { known_times(files)? };
    let times = match known {
        Some(times) => times,
        None => match step_numbers(files) {
            Some(numbers) => numbers.iter().map(|n| n * dt).collect(),
            None => (0..num_steps).map(|step| step as f64 * dt).collect(),
        },
    };
    check_increasing(files, &times)?;
    TimeAxis::new(times, units).map_err(|e| SourceError::corrupt(&files[0].path, "times", e, "check them"))
}

/// The times the files give; all of them or none must.
fn known_times<G>(files: &[&FileHeader<G>]) -> Result<Option<Vec<f64>>, SourceError> {
    let mut all = Vec::new();
    for file in files {
        if let FileTimes::Known(times) = &file.times {
            all.extend_from_slice(times);
        } else if !all.is_empty() {
            let problem =
                "the files before it have one; give every file its time, or number the steps with --dt";
            return Err(SourceError::corrupt(&file.path, "time", "missing", problem));
        }
    }
    let num_steps: usize = files.iter().map(|f| f.num_steps).sum();
    match all.len() {
        0 => Ok(None),
        n if n == num_steps => Ok(Some(all)),
        _ => {
            let problem = "later files have one; give every file its time, or number the steps with --dt";
            Err(SourceError::corrupt(&files[0].path, "time", "missing", problem))
        }
    }
}

/// The step numbers the files give, where each has one and they increase.
fn step_numbers<G>(files: &[&FileHeader<G>]) -> Option<Vec<f64>> {
    let number = |header: &FileHeader<G>| match header.times {
        FileTimes::StepNumber(number) => Some(number),
        _ => None,
    };
    let numbers: Vec<f64> = files.iter().map(|f| number(f)).collect::<Option<_>>()?;
    numbers.windows(2).all(|pair| pair[0] < pair[1]).then_some(numbers)
}

/// Times increase from step to step; the error names the file where they do not.
fn check_increasing<G>(files: &[&FileHeader<G>], times: &[f64]) -> Result<(), SourceError> {
    let mut step = 0;
    for file in files {
        let header = file;
        for _ in 0..header.num_steps {
            let time = times[step];
            if !time.is_finite() {
                return Err(SourceError::corrupt(&header.path, "time", time, "times must be finite"));
            }
            if step > 0 && time <= times[step - 1] {
                let problem = format!(
                    "step {step} must be later than the step before it, at {}; order the files, or number the steps \
                     with --dt",
                    times[step - 1]
                );
                return Err(SourceError::corrupt(&header.path, "time", time, problem));
            }
            step += 1;
        }
    }
    Ok(())
}
