//! The bricks of one step: leaves along the map, level by level the nodes above them, and every apron.
//!
//! A node with children has the core that they are filtered to (weights 1 2 1, samples without data left out), octant by octant, from
//! their samples with aprons; a leaf has what lies in its tetrahedra. What a sample of the depth is follows from its place alone: where a leaf
//! has it or shares it, or where there is no node, it is what lies in the tetrahedra. So neighbours of the same depth agree on the
//! samples they share, and a node with children takes the borders of the leaves beside it and hands them on to what is filtered from it
//! (leven2002, figure 8).

use chronoxel_core::{BrickLayout, NodeId};
use rayon::prelude::*;

use super::Voxels;
use super::apply::{BrickPlace, apply};
use crate::EncodeError;
use crate::encode::mark::{Marks, mark};
use crate::encode::real::Real;
use crate::encode::scratch::{Scratch, Waiting};

/// Takes a node's rank, brick and samples; called in parallel.
pub type OfNode<'a, T, R> = dyn Fn(u32, [usize; 3], &mut Vec<T>) -> Result<R, EncodeError> + Sync + 'a;

/// One step of one variable, as bricks.
pub struct MeshStep<'a, T> {
    voxels: &'a Voxels,
    /// At all points; masked ones are NaN.
    values: Vec<T>,
    /// Masked and infinite values among them; the range is not known yet.
    marks: Marks,
    /// Cores of nodes with children.
    scratch: Scratch,
    /// Of the level being made: the core of each node with children.
    cores: Vec<Waiting<T>>,
    /// Of the level above: those whose children are done.
    above: Vec<Waiting<T>>,
}

/// Some consecutive nodes of a level, and all children of their parents among them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LevelBatch {
    /// The level.
    pub level: u8,
    /// Ranks of its nodes.
    pub ranks: std::ops::Range<usize>,
}

impl<'a, T: Real> MeshStep<'a, T> {
    /// A step from its values at the points.
    ///
    /// * `scratch`: where cores wait
    pub fn new(voxels: &'a Voxels, mut values: Vec<T>, fill_value: Option<f64>, scratch: Scratch) -> Self {
        let marks = Marks { range: Marks::NONE.range, ..mark(&mut values, fill_value) };
        Self { voxels, values, marks, scratch, cores: Vec::new(), above: Vec::new() }
    }

    /// Masked and infinite values.
    pub fn marks(&self) -> Marks {
        self.marks
    }

    /// The batches of all levels, in the order in which they must be made. Families are never torn.
    ///
    /// * `batch_bricks`: about how many nodes a batch has
    pub fn batches(voxels: &Voxels, batch_bricks: usize) -> Vec<LevelBatch> {
        let mut batches = Vec::new();
        for level in 0..voxels.levels.len() as u8 {
            let nodes = voxels.tree.nodes(level);
            let mut start = 0;
            while start < nodes.len() {
                let mut end = nodes.len().min(start + batch_bricks.max(1));
                while end < nodes.len() && nodes[end] >> 3 == nodes[end - 1] >> 3 {
                    end += 1;
                }
                batches.push(LevelBatch { level, ranks: start..end });
                start = end;
            }
        }
        batches
    }

    /// Makes a batch. Batches of a level come after those of the level below.
    ///
    /// * `of_brick`: called in parallel with a node's rank, brick and samples, which it may take
    pub fn make<R: Send>(
        &mut self,
        batch: &LevelBatch,
        of_brick: &OfNode<'_, T, R>,
    ) -> Result<Vec<R>, EncodeError> {
        if batch.ranks.start == 0 {
            self.begin(batch.level);
        }
        let this = &*self;
        let made: Vec<_> = batch
            .ranks
            .clone()
            .into_par_iter()
            .map_init(Vec::new, |samples: &mut Vec<T>, rank| {
                this.full_brick(batch.level, rank, samples)?;
                let octant = this.octant(batch.level, samples);
                let brick = this.node(batch.level, rank).brick().map(|b| b as usize);
                Ok::<_, EncodeError>((of_brick(rank as u32, brick, samples)?, octant))
            })
            .collect();
        let mut results = Vec::with_capacity(made.len());
        let mut octants = Vec::with_capacity(made.len());
        for one in made {
            let (result, octant) = one?;
            results.push(result);
            octants.push(octant);
        }
        self.take_octants(batch, octants)?;
        Ok(results)
    }

    /// Before the first node of a level.
    fn begin(&mut self, level: u8) {
        let done = std::mem::take(&mut self.above);
        for waiting in std::mem::replace(&mut self.cores, done) {
            self.scratch.forget(&waiting);
        }
        let num_above = self.voxels.nodes.get(usize::from(level) + 1).map_or(0, Vec::len);
        self.above = (0..num_above).map(|_| Waiting::Uniform(None)).collect();
    }

    fn node(&self, level: u8, rank: usize) -> NodeId {
        NodeId { level, morton: self.voxels.nodes[usize::from(level)][rank].morton }
    }

    /// Core and apron of a node.
    fn full_brick(&self, level: u8, rank: usize, samples: &mut Vec<T>) -> Result<(), EncodeError> {
        let Voxels { layout, maps, places, nodes, .. } = self.voxels;
        let built = nodes[usize::from(level)][rank];
        let node = self.node(level, rank);
        samples.clear();
        samples.resize(layout.num_full(), T::MASKED);
        let at = BrickPlace { depth: self.voxels.depth_of(level), brick: node.brick() };
        maps.with(built.map, |map| apply(map, at, layout, places, &self.values, samples))?;
        let around = self.nodes_around(node);
        for owner in 0..27 {
            if let Some((rank, false)) = around[owner] {
                self.copy_core(rank, owner, &around, samples)?;
            }
        }
        Ok(())
    }

    /// The ranks of a node and those around it, and whether they are leaves: where there are any.
    fn nodes_around(&self, node: NodeId) -> [Option<(usize, bool)>; 27] {
        std::array::from_fn(|cell| {
            let shift = [cell % 3, cell / 3 % 3, cell / 9].map(|s| s as i32 - 1);
            let rank = self.neighbour(node, shift)?;
            Some((rank, self.voxels.nodes[usize::from(node.level)][rank].is_leaf))
        })
    }

    fn neighbour(&self, node: NodeId, shift: [i32; 3]) -> Option<usize> {
        let mut brick = node.brick();
        for a in 0..3 {
            brick[a] = brick[a].checked_add_signed(shift[a])?;
            if brick[a] as usize >= self.voxels.levels[usize::from(node.level)].bricks[a] {
                return None;
            }
        }
        self.voxels.tree.rank(NodeId::new(node.level, brick))
    }

    /// Copies what the core of a node with children, itself or one around it, has in common with a full brick, but for what leaves share.
    fn copy_core(
        &self,
        rank: usize,
        owner: usize,
        around: &[Option<(usize, bool)>; 27],
        samples: &mut [T],
    ) -> Result<(), EncodeError> {
        let layout = &self.voxels.layout;
        let read;
        let core = match &self.cores[rank] {
            Waiting::Uniform(value) => Core::Uniform(value.unwrap_or(T::MASKED)),
            Waiting::Memory(core) => Core::Samples(core),
            Waiting::File(block) => {
                read = self.scratch.read::<T>(*block, layout.num_core())?;
                Core::Samples(&read)
            }
        };
        let [x, y, z] = [owner % 3, owner / 3 % 3, owner / 9].map(|cell| parts_along(cell, layout));
        for z in &z {
            for y in &y {
                for x in &x {
                    let shares = |i: usize, j: usize, k: usize| {
                        matches!(around[x.cells[i] + 3 * y.cells[j] + 9 * z.cells[k]], Some((_, true)))
                    };
                    if !(0..8).any(|c| shares(c & 1, c >> 1 & 1, c >> 2)) {
                        core.copy([x, y, z], layout, samples);
                    }
                }
            }
        }
        Ok(())
    }

    /// A brick filtered to the octant of its parent; `None` where it has no data, or no parent.
    fn octant(&self, level: u8, samples: &[T]) -> Option<Vec<T>> {
        let has_parent = usize::from(level) + 1 < self.voxels.levels.len();
        (has_parent && samples.iter().any(|v| !v.is_masked()))
            .then(|| filtered(samples, self.voxels.layout.full_edge(), self.voxels.layout.edge))
    }

    /// Puts the octants of a batch together: the cores of the parents.
    fn take_octants(&mut self, batch: &LevelBatch, octants: Vec<Option<Vec<T>>>) -> Result<(), EncodeError> {
        let above = usize::from(batch.level) + 1;
        if above == self.voxels.levels.len() {
            return Ok(());
        }
        let edge = self.voxels.layout.edge;
        let mortons = &self.voxels.tree.nodes(batch.level)[batch.ranks.clone()];
        let mut children = mortons.iter().zip(octants).peekable();
        while let Some((first, _)) = children.peek() {
            let parent = **first >> 3;
            let mut core: Option<Vec<T>> = None;
            while let Some((morton, octant)) = children.next_if(|(m, _)| **m >> 3 == parent) {
                if let Some(octant) = octant {
                    let core = core.get_or_insert_with(|| vec![T::MASKED; edge.pow(3)]);
                    place_octant(core, edge, morton & 7, &octant);
                }
            }
            let rank = self.voxels.tree.rank(NodeId { level: above as u8, morton: parent });
            if let Some(core) = core {
                self.above[rank.expect("every node has its parent")] = self.scratch.keep(core)?;
            }
        }
        Ok(())
    }
}

/// The core of a node with children.
enum Core<'a, T> {
    Uniform(T),
    Samples(&'a [T]),
}

/// Samples of a full brick along an axis that the same nodes have.
struct PartAlong {
    /// The first, in the full brick.
    first: usize,
    /// The first, in the core of the node that has it.
    in_core: usize,
    num: usize,
    /// The nodes whose closed boxes hold it: 0 is the one before, 1 the brick itself, 2 the one after.
    cells: [usize; 2],
}

/// What of a full brick lies in the core of the node before it, its own, or that of the one after it.
fn parts_along(cell: usize, layout: &BrickLayout) -> Vec<PartAlong> {
    let BrickLayout { edge, low, high } = *layout;
    let inner = |first, in_core, num| PartAlong { first, in_core, num, cells: [cell; 2] };
    let shared = |first| PartAlong { first, in_core: 0, num: 1, cells: [cell - 1, cell] };
    match cell {
        0 => vec![inner(0, edge - low, low)],
        1 => vec![shared(low), inner(low + 1, 1, edge - 1)],
        _ => vec![shared(low + edge), inner(low + edge + 1, 1, high - 1)],
    }
}

impl<T: Copy> Core<'_, T> {
    fn copy(&self, [x, y, z]: [&PartAlong; 3], layout: &BrickLayout, samples: &mut [T]) {
        let (full, edge) = (layout.full_edge(), layout.edge);
        for k in 0..z.num {
            for j in 0..y.num {
                let row = &mut samples[x.first + full * (y.first + j + full * (z.first + k))..][..x.num];
                match self {
                    Self::Uniform(value) => row.fill(*value),
                    Self::Samples(core) => {
                        let from = x.in_core + edge * (y.in_core + j + edge * (z.in_core + k));
                        row.copy_from_slice(&core[from..][..x.num]);
                    }
                }
            }
        }
    }
}

fn place_octant<T: Copy>(core: &mut [T], edge: usize, octant: u64, samples: &[T]) {
    let half = edge / 2;
    let first: [usize; 3] = std::array::from_fn(|a| if octant >> a & 1 != 0 { half } else { 0 });
    for (r, row) in samples.chunks(half).enumerate() {
        let (y, z) = (first[1] + r % half, first[2] + r / half);
        core[first[0] + edge * (y + edge * z)..][..half].copy_from_slice(row);
    }
}

/// Every second core sample averaged with its 26 neighbours, weights 1 2 1 along each axis; those without data are left out and
/// the others' weights renormalised.
///
/// * `samples`: core and apron of a brick; one apron sample lies before the core
fn filtered<T: Real>(samples: &[T], full: usize, edge: usize) -> Vec<T> {
    const WEIGHTS: [f64; 3] = [0.25, 0.5, 0.25];
    let half = edge / 2;
    // Sums and weights along x, then y, then z: each pass halves an axis.
    let rows = edge + 1;
    let mut along_x = vec![[0.0f64; 2]; half * rows * rows];
    for z in 0..rows {
        for y in 0..rows {
            let row = &samples[full * (y + full * z)..][..rows];
            let out = &mut along_x[half * (y + rows * z)..][..half];
            for (x, out) in out.iter_mut().enumerate() {
                for (v, weight) in row[2 * x..2 * x + 3].iter().zip(WEIGHTS) {
                    let is_masked = v.is_masked();
                    out[0] += if is_masked { 0.0 } else { weight * v.to_f64() };
                    out[1] += if is_masked { 0.0 } else { weight };
                }
            }
        }
    }
    let sum = |of: [[f64; 2]; 3]| -> [f64; 2] {
        std::array::from_fn(|i| WEIGHTS[0] * of[0][i] + WEIGHTS[1] * of[1][i] + WEIGHTS[2] * of[2][i])
    };
    let mut along_y = vec![[0.0f64; 2]; half * half * rows];
    for z in 0..rows {
        for y in 0..half {
            for x in 0..half {
                let at = |dy: usize| along_x[x + half * (2 * y + dy + rows * z)];
                along_y[x + half * (y + half * z)] = sum([at(0), at(1), at(2)]);
            }
        }
    }
    let largest = T::LARGEST.to_f64();
    let mut out = Vec::with_capacity(half.pow(3));
    for z in 0..half {
        for i in 0..half * half {
            let at = |dz: usize| along_y[i + half * half * (2 * z + dz)];
            let [total, weight] = sum([at(0), at(1), at(2)]);
            out.push(match weight > 0.0 {
                true => T::from_f64((total / weight).clamp(-largest, largest)),
                false => T::MASKED,
            });
        }
    }
    out
}
