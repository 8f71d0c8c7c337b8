//! A mesh with the variables that were asked for.

use chronoxel_core::{Samples, TimeAxis};

use super::{GridType, MeshCensus, MeshSeries, VisitTetrahedron};
use crate::{SourceError, Variable};

/// A mesh with some of its variables.
pub(crate) struct SelectedMesh {
    mesh: Box<dyn MeshSeries>,
    variables: Vec<Variable>,
    /// Per variable: which of the mesh it is.
    places: Vec<usize>,
}

impl SelectedMesh {
    /// The variables of a mesh that lie at `places`, in that order.
    pub fn new(mesh: Box<dyn MeshSeries>, places: Vec<usize>) -> Self {
        let variables = places.iter().map(|&place| mesh.variables()[place].clone()).collect();
        Self { mesh, variables, places }
    }
}

impl MeshSeries for SelectedMesh {
    fn grid_type(&self) -> GridType {
        self.mesh.grid_type()
    }

    fn dims(&self) -> Option<[usize; 3]> {
        self.mesh.dims()
    }

    fn num_points(&self) -> usize {
        self.mesh.num_points()
    }

    fn times(&self) -> &TimeAxis {
        self.mesh.times()
    }

    fn variables(&self) -> &[Variable] {
        &self.variables
    }

    fn points(&mut self) -> Result<Vec<[f64; 3]>, SourceError> {
        self.mesh.points()
    }

    fn for_each_tetrahedron(&mut self, visit: &mut VisitTetrahedron<'_>) -> Result<MeshCensus, SourceError> {
        self.mesh.for_each_tetrahedron(visit)
    }

    fn read_values(&mut self, variable: usize, step: usize) -> Result<Samples, SourceError> {
        self.mesh.read_values(self.places[variable], step)
    }

    fn working_bytes(&self) -> u64 {
        self.mesh.working_bytes()
    }

    fn notes(&self) -> Vec<String> {
        self.mesh.notes()
    }
}
