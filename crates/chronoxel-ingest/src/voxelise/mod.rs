//! From a mesh to bricks (leven2002, section 4): an adaptive octree over its tetrahedra, and a map from every sample to the
//! tetrahedron that it lies in. Both are made once; a step is computed along the map.

pub mod apply;
mod build;
mod lattice;
pub mod map;
mod needs;
pub mod overlap;
mod points;
pub mod raster;
pub mod records;
mod step;

use std::path::Path;

use serde::Serialize;

use chronoxel_core::{BrickLayout, LevelGeometry, NodeId, Octree, Samples, UniformGrid, octree::levels_of};

use crate::encode::real::Real;
use crate::encode::scratch::Scratch;
use crate::{EncodeError, MeshCensus, MeshSeries};
use build::{BuildCounts, Builder, BuiltNode, Mesh};
use lattice::Lattice;
use map::MapStore;
use records::{List, Pool, Tetrahedron};

pub use points::sample_points;
pub(crate) use step::MeshStep;

/// The levels that a tree has above its finest, where nothing else is asked for.
pub const DEFAULT_MAX_DEPTH: u8 = 5;

/// How a mesh becomes bricks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VoxelOptions {
    /// A point whose values and those of its neighbours differ by more than this share of the variable's range, at any step, gets
    /// a voxel of its own.
    pub field_threshold: f64,
    /// Depth of the finest level that the tree may have; the root, one brick, has depth 0.
    pub max_depth: u8,
}

impl Default for VoxelOptions {
    fn default() -> Self {
        Self { field_threshold: 0.0, max_depth: DEFAULT_MAX_DEPTH }
    }
}

impl VoxelOptions {
    /// Checks the options in themselves.
    ///
    /// # Errors
    /// [`EncodeError::InvalidArgument`] for one that is out of range.
    pub fn check(&self, layout: &BrickLayout) -> Result<(), EncodeError> {
        if !(0.0..=1.0).contains(&self.field_threshold) {
            return Err(EncodeError::InvalidArgument {
                argument: "--field-threshold",
                value: self.field_threshold.to_string(),
                remedy: "a share of the range: 0 to 1".into(),
            });
        }
        // 2^16 samples along an axis: no more than 2^48 in all.
        let most = 16 - layout.edge.ilog2() as u8;
        if self.max_depth > most {
            return Err(EncodeError::InvalidArgument {
                argument: "--max-depth",
                value: self.max_depth.to_string(),
                remedy: format!("at most {most} with bricks of {} samples", layout.edge),
            });
        }
        Ok(())
    }
}

/// What memory and files voxelising may take.
#[derive(Debug, Clone, Copy)]
pub struct Room<'a> {
    /// Where nameless files may lie.
    pub folder: &'a Path,
    /// For lists of tetrahedra, while the tree is built.
    pub list_bytes: u64,
    /// For the maps of bricks.
    pub map_bytes: u64,
}

/// What voxelising did, for reports.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct VoxelReport {
    /// What the mesh consists of.
    pub census: MeshCensus,
    /// Nodes without children, with data or without.
    pub num_leaves: u64,
    /// Mean depth of the leaves.
    pub mean_depth: f64,
    /// Depth of the deepest.
    pub max_depth: u8,
    /// Leaves of the deepest level in which points still share a voxel.
    pub num_cut_off: u64,
    /// Tests of a tetrahedron against a node.
    pub num_tests: u64,
    /// Samples of leaves that were looked for, apron included.
    pub num_samples: u64,
    /// Those of them that lie in a tetrahedron.
    pub num_covered: u64,
    /// Bytes of the sampling map.
    pub map_bytes: u64,
    /// Time for reading the mesh and the variation of its values, for the tree and its samples.
    pub secs: [f64; 2],
}

/// Takes a node, and the samples of its core and apron, `[z, y, x]`, NaN where there is no data.
pub type TakeBrick<'a> = dyn FnMut(NodeId, &[f64]) -> Result<(), EncodeError> + 'a;

/// A mesh as bricks: the tree, and the map of its samples.
pub struct Voxels {
    grid: UniformGrid,
    layout: BrickLayout,
    levels: Vec<LevelGeometry>,
    tree: Octree,
    /// By level, finest first.
    nodes: Vec<Vec<BuiltNode>>,
    /// Of the mesh's points, in samples of the root.
    places: Vec<[f64; 3]>,
    maps: MapStore,
    report: VoxelReport,
}

/// What is kept of a node: here, in the map, and while its step is made, encoded and put; a mesh has many nodes and may have few steps, so
/// that what the writer holds of them at the end is not small beside bricks.
const NODE_BYTES: u64 = 1280;

impl Voxels {
    /// Bytes of memory for each point of a mesh while it is voxelised, at most.
    pub const BYTES_PER_POINT: u64 = needs::BYTES_PER_POINT + 24 + 1;

    /// Voxelises a mesh.
    ///
    /// * `variables`: indices of those whose variation counts
    /// * `fill_value`: for each of them, what means "no data" besides NaN
    ///
    /// # Errors
    /// Of the source, for options out of range, and for a mesh without a size.
    pub fn new(
        mesh: &mut dyn MeshSeries,
        variables: &[(usize, Option<f64>)],
        layout: &BrickLayout,
        options: &VoxelOptions,
        room: Room<'_>,
    ) -> Result<Self, EncodeError> {
        options.check(layout)?;
        let started = std::time::Instant::now();
        let points = mesh.points()?;
        let mut pool = Pool::new(room.folder)?;
        let (list, census, bounds) = read_tetrahedra(mesh, &points, &mut pool)?;
        let lattice = Lattice::new(bounds, layout.edge)?;
        let mut places = points;
        places.iter_mut().for_each(|p| *p = lattice.place(*p));
        let needs_voxel = needs::needs_voxel(mesh, variables, options.field_threshold, &list, &mut pool)?;
        let read_secs = started.elapsed().as_secs_f64();
        let mut maps = MapStore::new(room.folder, room.map_bytes)?;
        let over = Mesh {
            places: &places,
            needs_voxel: &needs_voxel,
            lattice: &lattice,
            layout,
            max_depth: options.max_depth,
        };
        let (by_depth, counts) = Builder::new(&over, &mut pool, &mut maps, room.list_bytes).build(list)?;
        let report = report_of(&by_depth, &counts, census, &maps);
        let grid = lattice.grid(by_depth.len() as u8 - 1)?;
        let nodes: Vec<Vec<BuiltNode>> = by_depth.into_iter().rev().collect();
        let mortons = nodes.iter().map(|level| level.iter().map(|node| node.morton).collect()).collect();
        let secs = [read_secs, started.elapsed().as_secs_f64() - read_secs];
        Ok(Self {
            levels: levels_of(&grid, layout),
            tree: Octree::from_levels(mortons)?,
            report: VoxelReport { secs, ..report },
            layout: *layout,
            grid,
            nodes,
            places,
            maps,
        })
    }

    /// The grid of the finest level.
    pub fn grid(&self) -> &UniformGrid {
        &self.grid
    }

    /// The nodes.
    pub fn tree(&self) -> &Octree {
        &self.tree
    }

    /// Sizes of the levels, finest first.
    pub fn levels(&self) -> &[LevelGeometry] {
        &self.levels
    }

    /// The shape of bricks.
    pub fn layout(&self) -> &BrickLayout {
        &self.layout
    }

    /// What voxelising did.
    pub fn report(&self) -> &VoxelReport {
        &self.report
    }

    /// Whether a node has no children: whether it is the finest there is.
    pub fn is_leaf(&self, level: u8, rank: usize) -> bool {
        self.nodes[usize::from(level)][rank].is_leaf
    }

    /// Core samples inside the grid over all leaves.
    pub fn num_finest_samples(&self) -> u64 {
        let of_level = |(nodes, geometry): (&Vec<BuiltNode>, &LevelGeometry)| -> u64 {
            let leaves = nodes.iter().filter(|node| node.is_leaf);
            leaves.map(|node| self.core_samples(geometry, node.morton)).sum()
        };
        self.nodes.iter().zip(&self.levels).map(of_level).sum()
    }

    /// Bytes of the maps that lie in memory, of what `num_threads` of them need when read from the file, of the points and the nodes.
    pub fn held_bytes(&self, num_threads: usize) -> u64 {
        let num_nodes: usize = self.nodes.iter().map(Vec::len).sum();
        self.maps.memory_bytes()
            + NODE_BYTES * num_nodes as u64
            + self.maps.largest_bytes() * num_threads as u64
            + size_of_val(self.places.as_slice()) as u64
    }

    /// Moves the maps from memory to the file.
    pub fn spill(&mut self) -> Result<(), EncodeError> {
        self.maps.spill()
    }

    /// Makes the bricks of one step, level by level, finest first, in Morton order.
    ///
    /// * `values`: one for each point of the mesh
    ///
    /// # Errors
    /// If the system has no room for what waits, or of `of_brick`.
    pub fn for_each_brick(&self, values: Samples, of_brick: &mut TakeBrick<'_>) -> Result<(), EncodeError> {
        match values {
            Samples::F32(values) => self.each_brick(values, of_brick),
            Samples::F64(values) => self.each_brick(values, of_brick),
        }
    }

    fn each_brick<T: Real>(&self, values: Vec<T>, of_brick: &mut TakeBrick<'_>) -> Result<(), EncodeError> {
        let mut step = MeshStep::new(self, values, None, self.core_scratch::<T>(u64::MAX)?);
        for batch in MeshStep::<T>::batches(self, 8) {
            let make = |rank: u32, _: [usize; 3], samples: &mut Vec<T>| {
                Ok((rank, samples.iter().map(|v| v.to_f64()).collect::<Vec<f64>>()))
            };
            for (rank, samples) in step.make(&batch, &make)? {
                let morton = self.tree.nodes(batch.level)[rank as usize];
                of_brick(NodeId { level: batch.level, morton }, &samples)?;
            }
        }
        Ok(())
    }

    /// Where the cores of nodes with children wait while a step is made.
    pub(crate) fn core_scratch<T: Real>(&self, memory_bytes: u64) -> Result<Scratch, EncodeError> {
        let core_bytes = (self.layout.num_core() * size_of::<T>()) as u64;
        Scratch::new(self.maps.folder(), core_bytes, memory_bytes)
    }

    fn core_samples(&self, geometry: &LevelGeometry, morton: u64) -> u64 {
        let brick = NodeId { level: geometry.level, morton }.brick();
        let along = |a: usize| geometry.dims[a].saturating_sub(brick[a] as usize * self.layout.edge);
        (0..3).map(|a| along(a).min(self.layout.edge) as u64).product()
    }

    fn depth_of(&self, level: u8) -> u8 {
        (self.levels.len() - 1) as u8 - level
    }
}

/// Reads the tetrahedra into a list; also the box of the points that they use.
fn read_tetrahedra(
    mesh: &mut dyn MeshSeries,
    points: &[[f64; 3]],
    pool: &mut Pool,
) -> Result<(List, MeshCensus, [[f64; 3]; 2]), EncodeError> {
    let mut list = List::File { blocks: Vec::new(), rest: Vec::new() };
    let mut part: Vec<Tetrahedron> = Vec::with_capacity(1 << 12);
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    // An error of the scratch file cannot pass through the reader as it is.
    let mut failed = None;
    let census = mesh.for_each_tetrahedron(&mut |vertices| {
        for vertex in vertices {
            let point = &points[vertex as usize];
            (0..3).for_each(|a| (low[a], high[a]) = (low[a].min(point[a]), high[a].max(point[a])));
        }
        part.push(Tetrahedron { vertices });
        if part.len() == part.capacity() && failed.is_none() {
            failed = pool.append(&mut list, &part).err();
            part.clear();
        }
        Ok(())
    })?;
    if let Some(error) = failed {
        return Err(error);
    }
    pool.append(&mut list, &part)?;
    Ok((list, census, [low, high]))
}

fn report_of(
    by_depth: &[Vec<BuiltNode>],
    counts: &BuildCounts,
    census: MeshCensus,
    maps: &MapStore,
) -> VoxelReport {
    let leaves = |depth: usize| by_depth[depth].iter().filter(|node| node.is_leaf).count() as u64;
    let num_leaves: u64 = (0..by_depth.len()).map(leaves).sum();
    let depths: u64 = (0..by_depth.len()).map(|depth| depth as u64 * leaves(depth)).sum();
    VoxelReport {
        census,
        num_leaves,
        mean_depth: depths as f64 / num_leaves as f64,
        max_depth: by_depth.len() as u8 - 1,
        num_cut_off: counts.num_cut_off,
        num_tests: counts.num_tests,
        num_samples: counts.num_samples,
        num_covered: counts.num_covered,
        map_bytes: maps.num_bytes(),
        secs: [0.0; 2],
    }
}
