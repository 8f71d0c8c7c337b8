//! What is encoded: a volume that streams past in slices, or a mesh that was voxelised.

use chronoxel_core::{LevelGeometry, NodeId, Octree, SampleType, TimeAxis, UniformGrid};
use chronoxel_store::MeshEntry;

use super::step::Feed;
use crate::voxelise::Voxels;
use crate::{EncodeError, MeshSeries, TimeSeries, Variable};

/// A series, whatever its grid.
pub enum Source<'a> {
    /// Samples on a uniform grid.
    Volume(&'a mut dyn TimeSeries),
    /// Values at the points of a mesh, and the tree over it.
    Mesh(&'a mut dyn MeshSeries, &'a Voxels),
}

impl Source<'_> {
    /// The grid of the finest level.
    pub fn grid(&self) -> &UniformGrid {
        match self {
            Self::Volume(series) => series.grid(),
            Self::Mesh(_, voxels) => voxels.grid(),
        }
    }

    /// Times of the steps.
    pub fn times(&self) -> &TimeAxis {
        match self {
            Self::Volume(series) => series.times(),
            Self::Mesh(mesh, _) => mesh.times(),
        }
    }

    /// The variables.
    pub fn variables(&self) -> &[Variable] {
        match self {
            Self::Volume(series) => series.variables(),
            Self::Mesh(mesh, _) => mesh.variables(),
        }
    }

    /// Numbers that the source has for a step of a variable.
    pub fn num_values(&self) -> u64 {
        match self {
            Self::Volume(series) => series.grid().num_samples() as u64,
            Self::Mesh(mesh, _) => mesh.num_points() as u64,
        }
    }

    /// The nodes.
    pub fn tree(&self, levels: &[LevelGeometry]) -> Octree {
        match self {
            Self::Volume(_) => Octree::full(levels),
            Self::Mesh(_, voxels) => voxels.tree().clone(),
        }
    }

    /// Samples of a step in the finest bricks there are.
    pub fn num_finest_samples(&self) -> u64 {
        match self {
            Self::Volume(series) => series.grid().num_samples() as u64,
            Self::Mesh(_, voxels) => voxels.num_finest_samples(),
        }
    }

    /// What the store says of a mesh.
    pub fn mesh_entry(&self) -> Option<MeshEntry> {
        let Self::Mesh(mesh, voxels) = self else { return None };
        Some(MeshEntry {
            kind: mesh.grid_type().name().into(),
            num_cells: voxels.report().census.cells.total(),
            num_points: mesh.num_points() as u64,
        })
    }

    /// Bytes that are held besides what is being encoded.
    ///
    /// * `sample_type`: the widest of the variables
    pub fn working_bytes(&self, sample_type: SampleType, num_threads: usize) -> u64 {
        match self {
            Self::Volume(series) => series.working_bytes(),
            Self::Mesh(mesh, voxels) => {
                // As they are read, and without those that are masked.
                let values = 2 * sample_type.num_bytes().max(4) as u64 * mesh.num_points() as u64;
                mesh.working_bytes() + values + voxels.held_bytes(num_threads)
            }
        }
    }

    /// Starts to read a step.
    pub fn feed(&mut self, variable: usize, step: usize) -> Result<Feed<'_>, EncodeError> {
        Ok(match self {
            Self::Volume(series) => Feed::Slices(series.open_step(variable, step)?),
            Self::Mesh(mesh, voxels) => Feed::Mesh { values: mesh.read_values(variable, step)?, voxels },
        })
    }
}

/// Nodes without children.
pub fn num_leaves(tree: &Octree) -> u64 {
    let of_level = |level: u8| {
        let nodes = tree.nodes(level).iter().map(move |&morton| NodeId { level, morton });
        nodes.filter(|node| tree.is_leaf(*node)).count() as u64
    };
    (0..tree.num_levels() as u8).map(of_level).sum()
}

/// Core samples inside the grid over the nodes of each level.
pub fn samples_of_levels(tree: &Octree, levels: &[LevelGeometry], edge: usize) -> Vec<u64> {
    let of_node = |geometry: &LevelGeometry, morton: u64| -> u64 {
        let brick = NodeId { level: geometry.level, morton }.brick();
        let along = |a: usize| geometry.dims[a].saturating_sub(brick[a] as usize * edge).min(edge) as u64;
        (0..3).map(along).product()
    };
    let of_level = |geometry: &LevelGeometry| -> u64 {
        tree.nodes(geometry.level).iter().map(|&morton| of_node(geometry, morton)).sum()
    };
    levels.iter().map(of_level).collect()
}
