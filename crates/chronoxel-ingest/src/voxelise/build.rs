//! The octree over the tetrahedra, top-down and out of core (leven2002, section 4.2), and the sampling map of its nodes.
//!
//! A node holds the tetrahedra that its samples, apron included, may lie in. It is split as long as a point that needs a voxel of
//! its own shares it with another, or until the deepest level; of its octants those become nodes that a tetrahedron reaches. So an
//! octant without a node has no data, and a node with children is filtered from them alone; from the tetrahedra it needs its
//! borders, for where none with children lies beside it.
//!
//! Depth first, in Morton order: a list is gone once its node is split, and short ones stay in memory. Subtrees that fit there
//! are built in parallel; what comes out does not depend on it.

use std::sync::atomic::{AtomicU64, Ordering};

use chronoxel_core::{BrickLayout, NodeId};
use rayon::prelude::*;

use super::lattice::{Lattice, SAME_POINT, TOLERANCE};
use super::map::{BrickMap, MapStore};
use super::overlap::Shape;
use super::raster::{Raster, Wanted};
use super::records::{List, Pool, Tetrahedron};
use crate::EncodeError;

/// What is built over.
pub struct Mesh<'a> {
    /// Of all points, in samples of the root.
    pub places: &'a [[f64; 3]],
    /// For each point, whether it needs a voxel of its own.
    pub needs_voxel: &'a [bool],
    /// The lattice.
    pub lattice: &'a Lattice,
    /// The shape of bricks.
    pub layout: &'a BrickLayout,
    /// The deepest level; the root has depth 0.
    pub max_depth: u8,
}

/// A node of the tree, with its map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BuiltNode {
    /// Its place among the bricks of its depth.
    pub morton: u64,
    /// Whether it has no children.
    pub is_leaf: bool,
    /// The number of its map.
    pub map: usize,
}

/// What building did.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct BuildCounts {
    /// Tests of a tetrahedron against a node.
    pub num_tests: u64,
    /// Samples of leaves, apron included, that were looked for.
    pub num_samples: u64,
    /// Core samples and apron samples that lie in a tetrahedron.
    pub num_covered: u64,
    /// Leaves of the deepest level in which points still share a voxel.
    pub num_cut_off: u64,
}

/// A node that is decided and not sampled yet.
struct Job {
    depth: u8,
    brick: [u32; 3],
    is_leaf: bool,
    tetrahedra: Vec<Tetrahedron>,
}

/// Length of a list below which a subtree is built in parallel, and what part of the longest list in memory it is at most: all lists
/// of a subtree, in which a tetrahedron can be many times, are there together.
const SUBTREE: usize = 1 << 15;
const SUBTREE_SHARE: usize = 64;
/// Nodes and tetrahedra that wait to be sampled together.
const BATCH_NODES: usize = 256;
const BATCH_TETRAHEDRA: usize = 1 << 20;
/// Tetrahedra of a list that a thread tests at a time.
const PART: usize = 1 << 11;

/// Builds the tree.
pub struct Builder<'a> {
    mesh: &'a Mesh<'a>,
    pool: &'a mut Pool,
    maps: &'a mut MapStore,
    /// Longest list that is held in memory.
    most_in_memory: usize,
    jobs: Vec<Job>,
    num_waiting: usize,
    num_tests: AtomicU64,
    counts: BuildCounts,
    /// By depth, each in Morton order.
    nodes: Vec<Vec<BuiltNode>>,
}

impl<'a> Builder<'a> {
    /// * `list_bytes`: what lists may take in memory
    pub fn new(mesh: &'a Mesh<'a>, pool: &'a mut Pool, maps: &'a mut MapStore, list_bytes: u64) -> Self {
        // A list, those of its children, and those that wait.
        let most = list_bytes / (4 * size_of::<Tetrahedron>() as u64);
        Self {
            mesh,
            pool,
            maps,
            most_in_memory: usize::try_from(most).unwrap_or(usize::MAX).max(1 << 10),
            jobs: Vec::new(),
            num_waiting: 0,
            num_tests: AtomicU64::new(0),
            counts: BuildCounts::default(),
            nodes: vec![Vec::new(); usize::from(mesh.max_depth) + 1],
        }
    }

    /// Builds the tree over all tetrahedra. Returns the nodes by depth, in Morton order; there is always a root.
    pub fn build(mut self, all: List) -> Result<(Vec<Vec<BuiltNode>>, BuildCounts), EncodeError> {
        self.node(0, [0; 3], all)?;
        self.flush()?;
        while self.nodes.len() > 1 && self.nodes.last().is_some_and(Vec::is_empty) {
            self.nodes.pop();
        }
        self.counts.num_tests = self.num_tests.into_inner();
        Ok((self.nodes, self.counts))
    }

    fn node(&mut self, depth: u8, brick: [u32; 3], list: List) -> Result<(), EncodeError> {
        if list.num_tetrahedra() <= self.most_in_memory {
            let all = self.pool.load(list)?;
            return self.node_in_memory(depth, brick, all);
        }
        let must_split = self.must_split(depth, brick, &list)?;
        let is_leaf = !must_split || depth == self.mesh.max_depth;
        let which = if is_leaf { Wanted::All } else { Wanted::Borders };
        let mut raster = Raster::new(depth, brick, self.mesh.layout, which);
        let (mesh, num_tests) = (self.mesh, &self.num_tests);
        let mut children = Children::new(mesh, depth, brick);
        self.pool.each(&list, &mut |block, pool| {
            raster.push(block, mesh.places);
            if !is_leaf {
                for part in children.parts_of(block, num_tests) {
                    children.take(part, pool)?;
                }
            }
            Ok(true)
        })?;
        self.pool.forget(list);
        self.flush()?;
        self.put(depth, brick, is_leaf, raster.finish())?;
        self.counts.num_cut_off += u64::from(is_leaf && must_split);
        for (octant, list) in children.into_lists(self.pool) {
            self.node(depth + 1, child_of(brick, octant), list)?;
        }
        Ok(())
    }

    fn must_split(&mut self, depth: u8, brick: [u32; 3], list: &List) -> Result<bool, EncodeError> {
        let mut voxels = Voxels::new(self.mesh, depth, brick);
        let mut found = false;
        self.pool.each(list, &mut |block, _| {
            found = found || voxels.are_shared(block);
            Ok(!found)
        })?;
        Ok(found)
    }

    fn node_in_memory(
        &mut self,
        depth: u8,
        brick: [u32; 3],
        all: Vec<Tetrahedron>,
    ) -> Result<(), EncodeError> {
        if all.len() <= SUBTREE.min(self.most_in_memory / SUBTREE_SHARE) {
            let mut num_cut_off = 0;
            let jobs = subtree(self.mesh, depth, brick, all, &self.num_tests, &mut num_cut_off);
            self.counts.num_cut_off += num_cut_off;
            return jobs.into_iter().try_for_each(|job| self.wait(job));
        }
        let must_split = Voxels::new(self.mesh, depth, brick).are_shared(&all);
        if !must_split || depth == self.mesh.max_depth {
            self.counts.num_cut_off += u64::from(must_split);
            return self.wait(Job { depth, brick, is_leaf: true, tetrahedra: all });
        }
        let mut children = Children::in_memory(self.mesh, depth, brick);
        for part in children.parts_of(&all, &self.num_tests) {
            children.take(part, self.pool)?;
        }
        // The tetrahedra at the borders are few: only what is sampled waits.
        let mut raster = Raster::new(depth, brick, self.mesh.layout, Wanted::Borders);
        raster.push(&all, self.mesh.places);
        drop(all);
        self.flush()?;
        self.put(depth, brick, false, raster.finish())?;
        for (octant, list) in children.into_lists(self.pool) {
            self.node(depth + 1, child_of(brick, octant), list)?;
        }
        Ok(())
    }

    fn wait(&mut self, job: Job) -> Result<(), EncodeError> {
        self.num_waiting += job.tetrahedra.len();
        self.jobs.push(job);
        match self.jobs.len() >= BATCH_NODES || self.num_waiting >= BATCH_TETRAHEDRA.min(self.most_in_memory)
        {
            true => self.flush(),
            false => Ok(()),
        }
    }

    /// Samples what waits, in parallel, and puts it in order.
    fn flush(&mut self) -> Result<(), EncodeError> {
        self.num_waiting = 0;
        let mesh = self.mesh;
        let jobs = std::mem::take(&mut self.jobs);
        for jobs in jobs.chunks(4 * rayon::current_num_threads()) {
            let sampled: Vec<BrickMap> = jobs.par_iter().map(|job| job.sampled(mesh)).collect();
            for (job, map) in jobs.iter().zip(sampled) {
                self.put(job.depth, job.brick, job.is_leaf, map)?;
            }
        }
        Ok(())
    }

    fn put(&mut self, depth: u8, brick: [u32; 3], is_leaf: bool, map: BrickMap) -> Result<(), EncodeError> {
        if is_leaf {
            self.counts.num_samples += self.mesh.layout.num_full() as u64;
            self.counts.num_covered += map.num_covered();
        }
        let map = self.maps.push(map)?;
        let morton = NodeId::new(0, brick).morton;
        self.nodes[usize::from(depth)].push(BuiltNode { morton, is_leaf, map });
        Ok(())
    }
}

impl Job {
    fn sampled(&self, mesh: &Mesh<'_>) -> BrickMap {
        let which = if self.is_leaf { Wanted::All } else { Wanted::Borders };
        let mut raster = Raster::new(self.depth, self.brick, mesh.layout, which);
        raster.push(&self.tetrahedra, mesh.places);
        raster.finish()
    }
}

/// The nodes of a subtree, depth first in Morton order.
fn subtree(
    mesh: &Mesh<'_>,
    depth: u8,
    brick: [u32; 3],
    all: Vec<Tetrahedron>,
    num_tests: &AtomicU64,
    num_cut_off: &mut u64,
) -> Vec<Job> {
    let must_split = Voxels::new(mesh, depth, brick).are_shared(&all);
    if !must_split || depth == mesh.max_depth {
        *num_cut_off += u64::from(must_split);
        return vec![Job { depth, brick, is_leaf: true, tetrahedra: all }];
    }
    let mut children: [Vec<Tetrahedron>; 8] = std::array::from_fn(|_| Vec::new());
    let boxes = Boxes::of_children(mesh, depth, brick);
    let mut reached = [false; 8];
    let mut tested = 0;
    for tetrahedron in &all {
        let octants = boxes.octants(tetrahedron, mesh, &mut reached, &mut tested);
        for (octant, child) in children.iter_mut().enumerate() {
            if octants >> octant & 1 != 0 {
                child.push(*tetrahedron);
            }
        }
    }
    num_tests.fetch_add(tested, Ordering::Relaxed);
    let children: Vec<(u8, Vec<Tetrahedron>)> =
        (0u8..8).zip(children).filter(|(octant, _)| reached[usize::from(*octant)]).collect();
    // Of the node itself only what the samples at its borders can lie in.
    let mut jobs = vec![Job { depth, brick, is_leaf: false, tetrahedra: boxes.at_borders(all, mesh) }];
    let below: Vec<(Vec<Job>, u64)> = children
        .into_par_iter()
        .map(|(octant, list)| {
            let mut cut_off = 0;
            (subtree(mesh, depth + 1, child_of(brick, octant), list, num_tests, &mut cut_off), cut_off)
        })
        .collect();
    for (more, cut_off) in below {
        jobs.extend(more);
        *num_cut_off += cut_off;
    }
    jobs
}

fn child_of(brick: [u32; 3], octant: u8) -> [u32; 3] {
    std::array::from_fn(|a| 2 * brick[a] + u32::from(octant >> a & 1))
}

/// The voxels of a node and the points in them.
struct Voxels<'a> {
    mesh: &'a Mesh<'a>,
    per_root: f64,
    first: [f64; 3],
    /// The number of the first point of each voxel, counted from 1.
    of_voxel: Vec<u32>,
}

impl<'a> Voxels<'a> {
    fn new(mesh: &'a Mesh<'a>, depth: u8, brick: [u32; 3]) -> Self {
        let edge = mesh.layout.edge;
        Self {
            mesh,
            per_root: f64::from(1u32 << depth),
            first: brick.map(|b| f64::from(b) * edge as f64),
            of_voxel: vec![0; edge.pow(3)],
        }
    }

    /// Takes the points of tetrahedra; whether one that needs a voxel shares it.
    fn are_shared(&mut self, tetrahedra: &[Tetrahedron]) -> bool {
        tetrahedra.iter().flat_map(|t| t.vertices).any(|point| self.is_shared(point))
    }

    #[inline]
    fn is_shared(&mut self, point: u32) -> bool {
        let Mesh { places, needs_voxel, layout, .. } = self.mesh;
        let place = places[point as usize];
        let mut index = [0; 3];
        for a in 0..3 {
            let at = (place[a] * self.per_root).floor() - self.first[a];
            if !(at >= 0.0 && at < layout.edge as f64) {
                return false;
            }
            index[a] = at as usize;
        }
        let voxel = &mut self.of_voxel[index[0] + layout.edge * (index[1] + layout.edge * index[2])];
        if *voxel == 0 {
            *voxel = point + 1;
            return false;
        }
        let other = *voxel - 1;
        // One that needs no voxel gives way, so that what follows is held against one that does.
        if needs_voxel[point as usize] && !needs_voxel[other as usize] {
            *voxel = point + 1;
        }
        other != point
            && (needs_voxel[point as usize] || needs_voxel[other as usize])
            && (0..3).any(|a| (places[other as usize][a] - place[a]).abs() > SAME_POINT)
    }
}

/// The boxes of a node's children.
struct Boxes {
    /// Around all samples, apron included.
    full: [[[f64; 3]; 2]; 8],
    /// What the child draws.
    drawn: [[[f64; 3]; 2]; 8],
    /// Whether the child holds a sample of the grid.
    is_in_grid: [bool; 8],
    /// Of the node itself: inside this, a tetrahedron reaches no sample of the apron, nor of the core's low faces.
    inner: [[f64; 3]; 2],
}

impl Boxes {
    fn of_children(mesh: &Mesh<'_>, depth: u8, brick: [u32; 3]) -> Self {
        let (edge, low, high) = (mesh.layout.edge as f64, mesh.layout.low as f64, mesh.layout.high as f64);
        let spacing = 0.5 / f64::from(1u32 << depth);
        let margin = 2.0 * TOLERANCE;
        let of = |octant: usize, before: f64, after: f64| {
            let first = child_of(brick, octant as u8).map(|b| f64::from(b) * edge);
            [
                first.map(|v| (v - before) * spacing - margin),
                first.map(|v| (v + edge + after) * spacing + margin),
            ]
        };
        let first = brick.map(|b| f64::from(b) * edge * 2.0 * spacing);
        let last = brick.map(|b| (f64::from(b + 1) * edge - 1.0) * 2.0 * spacing);
        Self {
            full: std::array::from_fn(|octant| of(octant, low, high - 1.0)),
            drawn: std::array::from_fn(|octant| of(octant, 0.0, 0.0)),
            is_in_grid: std::array::from_fn(|octant| {
                mesh.lattice.has_brick(depth + 1, child_of(brick, octant as u8), mesh.layout.edge)
            }),
            inner: [first, last],
        }
    }

    /// The octants whose samples a tetrahedron may hold, as bits; and which octants are reached by what they draw.
    fn octants(
        &self,
        tetrahedron: &Tetrahedron,
        mesh: &Mesh<'_>,
        reached: &mut [bool; 8],
        num_tests: &mut u64,
    ) -> u8 {
        let shape = Shape::new(tetrahedron.corners(mesh.places));
        let mut octants = 0;
        for (octant, reached) in reached.iter_mut().enumerate().filter(|(octant, _)| self.is_in_grid[*octant])
        {
            let [low, high] = self.full[octant];
            *num_tests += 1;
            if shape.overlaps(low, high) {
                octants |= 1 << octant;
                let [low, high] = self.drawn[octant];
                *reached = *reached || shape.overlaps(low, high);
            }
        }
        octants
    }

    /// What may hold a sample of the node's apron, or of the low faces of its core.
    fn at_borders(&self, mut all: Vec<Tetrahedron>, mesh: &Mesh<'_>) -> Vec<Tetrahedron> {
        let [low, high] = self.inner;
        all.retain(|tetrahedron| {
            let corners = tetrahedron.corners(mesh.places);
            !corners.iter().all(|c| (0..3).all(|a| c[a] > low[a] + TOLERANCE && c[a] < high[a] - TOLERANCE))
        });
        all.shrink_to_fit();
        all
    }
}

/// The lists of a node's children while they are made.
struct Children<'a> {
    mesh: &'a Mesh<'a>,
    boxes: Boxes,
    reached: [bool; 8],
    lists: [List; 8],
}

/// What becomes of a part of a list: for each octant its tetrahedra.
struct Part {
    children: [Vec<Tetrahedron>; 8],
    reached: [bool; 8],
}

impl<'a> Children<'a> {
    fn new(mesh: &'a Mesh<'a>, depth: u8, brick: [u32; 3]) -> Self {
        let lists = std::array::from_fn(|_| List::File { blocks: Vec::new(), rest: Vec::new() });
        Self { mesh, boxes: Boxes::of_children(mesh, depth, brick), reached: [false; 8], lists }
    }

    fn in_memory(mesh: &'a Mesh<'a>, depth: u8, brick: [u32; 3]) -> Self {
        let lists = std::array::from_fn(|_| List::Memory(Vec::new()));
        Self { lists, ..Self::new(mesh, depth, brick) }
    }

    fn parts_of(&self, tetrahedra: &[Tetrahedron], num_tests: &AtomicU64) -> Vec<Part> {
        let of_part = |tetrahedra: &[Tetrahedron]| {
            let mut part = Part { children: std::array::from_fn(|_| Vec::new()), reached: [false; 8] };
            let mut tested = 0;
            for tetrahedron in tetrahedra {
                let octants = self.boxes.octants(tetrahedron, self.mesh, &mut part.reached, &mut tested);
                for (octant, child) in part.children.iter_mut().enumerate() {
                    if octants >> octant & 1 != 0 {
                        child.push(*tetrahedron);
                    }
                }
            }
            num_tests.fetch_add(tested, Ordering::Relaxed);
            part
        };
        tetrahedra.par_chunks(PART).map(of_part).collect()
    }

    fn take(&mut self, part: Part, pool: &mut Pool) -> Result<(), EncodeError> {
        for (octant, more) in part.children.iter().enumerate() {
            self.reached[octant] |= part.reached[octant];
            pool.append(&mut self.lists[octant], more)?;
        }
        Ok(())
    }

    /// The lists of the octants that are reached; those of the others were for aprons.
    fn into_lists(self, pool: &mut Pool) -> Vec<(u8, List)> {
        let mut lists = Vec::new();
        for (octant, list) in (0u8..8).zip(self.lists) {
            match self.reached[usize::from(octant)] {
                true => lists.push((octant, list)),
                false => pool.forget(list),
            }
        }
        lists
    }
}
