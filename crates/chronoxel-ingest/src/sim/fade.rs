//! A series made of one step: the values of a mesh in files, fading linearly to zero.
//!
//! bernardon2006 makes its time-varying Blunt Fin so, with 64 steps: step `s` of `n` is the first one times `1 - s / (n - 1)`.

use chronoxel_core::{Samples, TimeAxis};

use super::spec::Spec;
use crate::mesh::{GridType, MeshCensus, MeshSeries, VisitTetrahedron};
use crate::sources::{SourceOptions, open_mesh};
use crate::{SourceError, Variable};

/// A mesh whose first step fades.
struct Fade {
    mesh: Box<dyn MeshSeries>,
    times: TimeAxis,
}

/// Opens the mesh that a specification names.
pub(super) fn open(spec: &Spec) -> Result<Box<dyn MeshSeries>, SourceError> {
    spec.check_keys(&["mesh", "steps"])?;
    let remedy = "name the files of a mesh, as in sim:fade?mesh=grid.xyz,flow.q&steps=64";
    let inputs: Vec<String> = spec.needed("mesh", remedy)?.split(',').map(str::to_owned).collect();
    let num_steps = spec.steps(64)?;
    let mesh = open_mesh(&inputs, &SourceOptions::default())?;
    let times = TimeAxis::regular(num_steps, 1.0, "")
        .map_err(|e| SourceError::argument("option steps", num_steps, e.to_string()))?;
    Ok(Box::new(Fade { mesh, times }))
}

impl MeshSeries for Fade {
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
        &self.times
    }

    fn variables(&self) -> &[Variable] {
        self.mesh.variables()
    }

    fn points(&mut self) -> Result<Vec<[f64; 3]>, SourceError> {
        self.mesh.points()
    }

    fn for_each_tetrahedron(&mut self, visit: &mut VisitTetrahedron<'_>) -> Result<MeshCensus, SourceError> {
        self.mesh.for_each_tetrahedron(visit)
    }

    fn read_values(&mut self, variable: usize, step: usize) -> Result<Samples, SourceError> {
        let last = (self.times.num_steps() - 1).max(1);
        let left = (last - step) as f64 / last as f64;
        Ok(match self.mesh.read_values(variable, 0)? {
            Samples::F32(v) => Samples::F32(v.into_iter().map(|x| (f64::from(x) * left) as f32).collect()),
            Samples::F64(v) => Samples::F64(v.into_iter().map(|x| x * left).collect()),
        })
    }

    fn working_bytes(&self) -> u64 {
        self.mesh.working_bytes()
    }

    fn notes(&self) -> Vec<String> {
        self.mesh.notes()
    }
}
