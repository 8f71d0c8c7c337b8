//! A generated mesh: a bar twisted about its axis, with a pulse that goes around in it.
//!
//! The points of a lattice over the box `[-0.5, 0.5]² × [0, 1]` are turned about the z axis by an angle that grows with z, and drawn
//! together a little towards the ends. Nothing is held but two layers of points, whatever the number of cells.

use std::f64::consts::TAU;
use std::path::Path;

use chronoxel_core::{SampleType, Samples, TimeAxis};

use super::spec::Spec;
use crate::mesh::{
    Blanked, Block, DEFAULT_FLAT_THRESHOLD, GridType, MeshCensus, MeshSeries, Sieve, VisitTetrahedron,
    for_each_of_block,
};
use crate::{SourceError, Variable};

/// How far the end of the bar is turned against its start, in turns.
const TURNS: f64 = 0.25;

/// Standard deviation of the pulse.
const PULSE_WIDTH: f64 = 0.15;

/// The field that a pulse is at a point of the world: a bell curve whose centre goes around once from time 0 to 1.
pub fn pulse(point: [f64; 3], time: f64) -> f64 {
    let (sin, cos) = (libm::sin(TAU * time), libm::cos(TAU * time));
    let centre = [0.2 * cos, 0.2 * sin, 0.5 + 0.25 * sin];
    let squared: f64 = (0..3).map(|axis| (point[axis] - centre[axis]) * (point[axis] - centre[axis])).sum();
    libm::exp(-0.5 * squared / (PULSE_WIDTH * PULSE_WIDTH))
}

/// A field that is linear in space and changes with time.
pub fn slope(point: [f64; 3], time: f64) -> f64 {
    1.0 + time + point[0] + 2.0 * point[1] - 0.5 * point[2]
}

/// A field of the mesh by its name.
type Field = (&'static str, fn([f64; 3], f64) -> f64);

/// All fields.
const FIELDS: [Field; 2] = [("pulse", pulse), ("slope", slope)];

/// The twisted bar.
struct Twist {
    dims: [usize; 3],
    times: TimeAxis,
    variables: Vec<Variable>,
}

/// Opens the mesh of a specification.
pub(super) fn open(spec: &Spec) -> Result<Box<dyn MeshSeries>, SourceError> {
    spec.check_keys(&["dims", "steps"])?;
    let dims = spec.dims([33; 3], 2)?;
    let num_steps = spec.steps(16)?;
    let times = (0..num_steps).map(|step| step as f64 / num_steps as f64).collect();
    let times = TimeAxis::new(times, "")
        .map_err(|e| SourceError::argument("option steps", num_steps, e.to_string()))?;
    let variables = FIELDS.map(|(name, _)| Variable {
        name: name.to_owned(),
        units: String::new(),
        sample_type: SampleType::F32,
        fill_value: None,
    });
    Ok(Box::new(Twist { dims, times, variables: variables.into() }))
}

/// Appends the points of one layer of constant k.
fn push_layer(dims: [usize; 3], k: usize, out: &mut Vec<[f64; 3]>) {
    let share = |index: usize, axis: usize| index as f64 / (dims[axis] - 1) as f64;
    let w = share(k, 2);
    let (sin, cos) = (libm::sin(TAU * TURNS * w), libm::cos(TAU * TURNS * w));
    let scale = 0.75 + w * (1.0 - w);
    for j in 0..dims[1] {
        let v = scale * (share(j, 1) - 0.5);
        out.extend((0..dims[0]).map(|i| {
            let u = scale * (share(i, 0) - 0.5);
            [u * cos - v * sin, u * sin + v * cos, w]
        }));
    }
}

impl MeshSeries for Twist {
    fn grid_type(&self) -> GridType {
        GridType::Curvilinear
    }

    fn dims(&self) -> Option<[usize; 3]> {
        Some(self.dims)
    }

    fn num_points(&self) -> usize {
        self.dims.iter().product()
    }

    fn times(&self) -> &TimeAxis {
        &self.times
    }

    fn variables(&self) -> &[Variable] {
        &self.variables
    }

    fn points(&mut self) -> Result<Vec<[f64; 3]>, SourceError> {
        let mut points = Vec::with_capacity(self.num_points());
        (0..self.dims[2]).for_each(|k| push_layer(self.dims, k, &mut points));
        Ok(points)
    }

    fn for_each_tetrahedron(&mut self, visit: &mut VisitTetrahedron<'_>) -> Result<MeshCensus, SourceError> {
        let mut sieve = Sieve::new(self.num_points(), DEFAULT_FLAT_THRESHOLD, visit);
        let block = Block { dims: self.dims, first_point: 0, is_exchanged: false };
        for_each_of_block(block, &Blanked::default(), &mut sieve, &mut |k, out| {
            push_layer(self.dims, k, out);
            Ok(())
        })?;
        sieve.finish(Path::new("sim:twist"))
    }

    fn read_values(&mut self, variable: usize, step: usize) -> Result<Samples, SourceError> {
        let (_, field) = FIELDS[variable];
        let time = self.times.times[step];
        let (mut values, mut layer) = (Vec::with_capacity(self.num_points()), Vec::new());
        for k in 0..self.dims[2] {
            layer.clear();
            push_layer(self.dims, k, &mut layer);
            values.extend(layer.iter().map(|&point| field(point, time) as f32));
        }
        Ok(Samples::F32(values))
    }

    fn working_bytes(&self) -> u64 {
        (2 * 24 * self.dims[0] * self.dims[1]) as u64
    }
}
