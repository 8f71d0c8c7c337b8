//! A mesh that is held in memory: geometry and values.

use std::path::Path;

use chronoxel_core::{Samples, TimeAxis};

use super::sieve::{MAX_POINTS, check_points};
use super::{
    Blanked, Block, Blocks, CellList, CheckedCells, DEFAULT_FLAT_THRESHOLD, GridType, MeshCensus, MeshSeries,
    VisitTetrahedron,
};
use crate::{SourceError, Variable};

/// What messages name in place of a file.
const NAME: &str = "mesh in memory";

/// A mesh in memory, as a series.
pub struct MemoryMesh {
    points: Vec<[f64; 3]>,
    topology: Topology,
    times: TimeAxis,
    variables: Vec<Variable>,
    /// Per variable and step: one value per point.
    values: Vec<Vec<Samples>>,
    flat_threshold: f64,
}

/// What lies between points.
enum Topology {
    Lattice([usize; 3]),
    Cells(CheckedCells),
}

impl MemoryMesh {
    /// A lattice of points, x fastest.
    ///
    /// # Errors
    /// [`SourceError`] for too few points or ones that are not finite.
    pub fn curvilinear(
        dims: [usize; 3],
        points: Vec<[f64; 3]>,
        times: TimeAxis,
    ) -> Result<Self, SourceError> {
        let expected = dims.iter().try_fold(1usize, |product, n| product.checked_mul(*n));
        if expected != Some(points.len()) {
            let remedy = format!("{} points were given", points.len());
            return Err(SourceError::argument("dimensions", format!("{dims:?}"), remedy));
        }
        Self::new(points, Topology::Lattice(dims), times)
    }

    /// Points, and cells between them.
    ///
    /// # Errors
    /// [`SourceError`] for corners that do not exist and points that are not finite.
    pub fn unstructured(
        points: Vec<[f64; 3]>,
        cells: CellList,
        times: TimeAxis,
    ) -> Result<Self, SourceError> {
        let cells = CheckedCells::new(Path::new(NAME), cells, points.len())?;
        Self::new(points, Topology::Cells(cells), times)
    }

    fn new(points: Vec<[f64; 3]>, topology: Topology, times: TimeAxis) -> Result<Self, SourceError> {
        if points.is_empty() || points.len() as u64 > MAX_POINTS {
            let remedy = format!("a mesh has 1 to {MAX_POINTS} points");
            return Err(SourceError::argument("number of points", points.len(), remedy));
        }
        check_points(Path::new(NAME), 0, &points)?;
        let (variables, values) = (Vec::new(), Vec::new());
        Ok(Self { points, topology, times, variables, values, flat_threshold: DEFAULT_FLAT_THRESHOLD })
    }

    /// Adds a variable with its values, one run per step.
    ///
    /// # Errors
    /// [`SourceError`] if the numbers of steps or points differ from the mesh's.
    pub fn with_variable(mut self, variable: Variable, steps: Vec<Samples>) -> Result<Self, SourceError> {
        if steps.len() != self.times.num_steps() || steps.iter().any(|s| s.len() != self.points.len()) {
            let remedy = format!("give {} steps of {} values", self.times.num_steps(), self.points.len());
            return Err(SourceError::argument("values of", &variable.name, remedy));
        }
        self.variables.push(variable);
        self.values.push(steps);
        Ok(self)
    }

    /// The same with another share of the cubed longest edge up to which a tetrahedron is flat.
    pub fn with_flat_threshold(self, flat_threshold: f64) -> Self {
        Self { flat_threshold, ..self }
    }
}

impl MeshSeries for MemoryMesh {
    fn grid_type(&self) -> GridType {
        match self.topology {
            Topology::Lattice(_) => GridType::Curvilinear,
            Topology::Cells(_) => GridType::Unstructured,
        }
    }

    fn dims(&self) -> Option<[usize; 3]> {
        match self.topology {
            Topology::Lattice(dims) => Some(dims),
            Topology::Cells(_) => None,
        }
    }

    fn num_points(&self) -> usize {
        self.points.len()
    }

    fn times(&self) -> &TimeAxis {
        &self.times
    }

    fn variables(&self) -> &[Variable] {
        &self.variables
    }

    fn points(&mut self) -> Result<Vec<[f64; 3]>, SourceError> {
        Ok(self.points.clone())
    }

    fn for_each_tetrahedron(&mut self, visit: &mut VisitTetrahedron<'_>) -> Result<MeshCensus, SourceError> {
        match &self.topology {
            Topology::Lattice(dims) => {
                let blocks = Blocks {
                    blocks: vec![Block { dims: *dims, first_point: 0, is_exchanged: false }],
                    blanked: Blanked::default(),
                };
                blocks.for_each_tetrahedron(Path::new(NAME), &self.points, self.flat_threshold, visit)
            }
            Topology::Cells(cells) => {
                cells.for_each_tetrahedron(Path::new(NAME), &self.points, self.flat_threshold, visit)
            }
        }
    }

    fn read_values(&mut self, variable: usize, step: usize) -> Result<Samples, SourceError> {
        Ok(self.values[variable][step].clone())
    }

    fn working_bytes(&self) -> u64 {
        let values = self.values.iter().flatten().map(|s| match s {
            Samples::F32(v) => 4 * v.len(),
            Samples::F64(v) => 8 * v.len(),
        });
        let cells = match &self.topology {
            Topology::Lattice(_) => 0,
            Topology::Cells(cells) => cells.most_bytes(self.points.len()),
        };
        (24 * self.points.len() + values.sum::<usize>()) as u64 + cells
    }
}
