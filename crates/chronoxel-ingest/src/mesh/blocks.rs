//! Structured blocks: lattices of points whose hexahedra are split into five tetrahedra each.
//!
//! The corners of a lattice are coloured like a chess board by the sum of their indices. The diagonals of all faces
//! join corners of the even colour, so that neighbouring cells agree on their common face: one tetrahedron has the four even corners of a cell, and
//! each odd corner is cut off by one of its own.

use std::collections::HashMap;
use std::path::Path;

use xxhash_rust::xxh3::Xxh3Builder;

use super::{CellKind, MeshCensus, Sieve, VisitTetrahedron};
use crate::SourceError;

/// One lattice of points, x fastest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Block {
    /// Points along the three axes.
    pub dims: [usize; 3],
    /// Number of its first point in the mesh.
    pub first_point: usize,
    /// Whether the colours of its points are exchanged, for the sake of a neighbouring block.
    pub is_exchanged: bool,
}

/// The blocks of a structured grid.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Blocks {
    /// In the order of their points.
    pub blocks: Vec<Block>,
    /// What is left out of them.
    pub blanked: Blanked,
}

/// What is left out of blocks.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Blanked {
    /// Per point of all blocks: whether cells with it are left out. Empty where none is.
    pub points: Vec<bool>,
    /// Per cell of all blocks: whether it is left out. Empty where none is.
    pub cells: Vec<bool>,
}

impl Blanked {
    /// From flags per point and per cell, of which there may be none.
    pub fn new(points: Vec<bool>, cells: Vec<bool>) -> Self {
        let or_empty = |flags: Vec<bool>| if flags.contains(&true) { flags } else { Vec::new() };
        Self { points: or_empty(points), cells: or_empty(cells) }
    }
}

/// The five tetrahedra of a cell whose first corner is even, corners being numbered `x + 2 y + 4 z`; right-handed in a right-handed lattice.
const EVEN: [[usize; 4]; 5] = [[0, 5, 3, 6], [1, 3, 0, 5], [2, 0, 3, 6], [4, 5, 0, 6], [7, 3, 5, 6]];

/// The same where the first corner is odd.
const ODD: [[usize; 4]; 5] = [[1, 2, 4, 7], [0, 1, 2, 4], [3, 2, 1, 7], [5, 1, 4, 7], [6, 4, 2, 7]];

impl Blocks {
    /// Exchanges the colours of blocks so that those whose outer points lie at the same places split the faces between them alike, and no crack opens between
    /// them. Where blocks in a ring cannot agree, those that come first do.
    pub fn match_colours(&mut self, points: &[[f64; 3]]) {
        if self.blocks.len() < 2 {
            return;
        }
        // The block of each outer place, and whether its point is odd there.
        let mut known: HashMap<[u64; 3], (usize, bool), Xxh3Builder> = HashMap::default();
        // Per block: one that it hangs together with, and whether their colours are exchanged against each other.
        let mut hangs_on: Vec<(usize, bool)> = (0..self.blocks.len()).map(|block| (block, false)).collect();
        for (number, block) in self.blocks.iter().enumerate() {
            for [i, j, k] in outer_points(block.dims) {
                let point = points[block.first_point + i + block.dims[0] * (j + block.dims[1] * k)];
                let is_odd = (i + j + k) % 2 == 1;
                // Zeros of both signs lie at one place.
                let place = point.map(|v| (v + 0.0).to_bits());
                let (other, other_is_odd) = *known.entry(place).or_insert((number, is_odd));
                let [(a, a_flip), (b, b_flip)] = [number, other].map(|block| root_of(&hangs_on, block));
                if a != b {
                    hangs_on[a.max(b)] = (a.min(b), a_flip ^ b_flip ^ is_odd ^ other_is_odd);
                }
            }
        }
        for (number, block) in self.blocks.iter_mut().enumerate() {
            block.is_exchanged = root_of(&hangs_on, number).1;
        }
    }

    /// Hands the tetrahedra of all blocks to `visit`.
    pub fn for_each_tetrahedron(
        &self,
        path: &Path,
        points: &[[f64; 3]],
        flat_threshold: f64,
        visit: &mut VisitTetrahedron<'_>,
    ) -> Result<MeshCensus, SourceError> {
        let mut sieve = Sieve::new(points.len(), flat_threshold, visit);
        for block in &self.blocks {
            let layer_points = block.dims[0] * block.dims[1];
            for_each_of_block(*block, &self.blanked, &mut sieve, &mut |layer, out| {
                let start = block.first_point + layer * layer_points;
                out.extend_from_slice(&points[start..start + layer_points]);
                Ok(())
            })?;
        }
        sieve.finish(path)
    }
}

/// The first of the blocks that one hangs together with, and whether their colours are exchanged against each other.
fn root_of(hangs_on: &[(usize, bool)], mut block: usize) -> (usize, bool) {
    let mut is_exchanged = false;
    while hangs_on[block].0 != block {
        is_exchanged ^= hangs_on[block].1;
        block = hangs_on[block].0;
    }
    (block, is_exchanged)
}

/// Indices of the points on the faces of a lattice.
fn outer_points([nx, ny, nz]: [usize; 3]) -> impl Iterator<Item = [usize; 3]> {
    (0..nz).flat_map(move |k| {
        (0..ny).flat_map(move |j| {
            let is_outer = k == 0 || k + 1 == nz || j == 0 || j + 1 == ny;
            let step = if is_outer { 1 } else { nx.saturating_sub(1).max(1) };
            (0..nx).step_by(step).map(move |i| [i, j, k])
        })
    })
}

/// Hands over the points of one layer of constant k by appending them.
pub(crate) type ReadLayer<'a> = dyn FnMut(usize, &mut Vec<[f64; 3]>) -> Result<(), SourceError> + 'a;

/// Takes the tetrahedra of one block through a sieve, holding two layers of its points at a time.
pub(crate) fn for_each_of_block(
    block: Block,
    blanked: &Blanked,
    sieve: &mut Sieve<'_, '_>,
    read_layer: &mut ReadLayer<'_>,
) -> Result<(), SourceError> {
    let [nx, ny, nz] = block.dims;
    if nx < 2 || ny < 2 || nz < 2 {
        return Ok(());
    }
    let (mut lower, mut upper) = (Vec::new(), Vec::new());
    read_layer(0, &mut upper)?;
    for k in 0..nz - 1 {
        std::mem::swap(&mut lower, &mut upper);
        upper.clear();
        read_layer(k + 1, &mut upper)?;
        for (j, i) in (0..ny - 1).flat_map(|j| (0..nx - 1).map(move |i| (j, i))) {
            let in_layer = |corner: usize| (i + (corner & 1)) + nx * (j + (corner >> 1 & 1));
            let index = |corner: usize| block.first_point + nx * ny * (k + (corner >> 2)) + in_layer(corner);
            let cell = sieve.census.cells.hexahedra as usize;
            sieve.census.cells.hexahedra += 1;
            let has_blanked_corner = || (0..8).any(|corner| blanked.points[index(corner)]);
            if !blanked.points.is_empty() && has_blanked_corner()
                || blanked.cells.get(cell).copied().unwrap_or(false)
            {
                sieve.census.num_blanked += 1;
                continue;
            }
            let corners: [[f64; 3]; 8] =
                std::array::from_fn(|c| if c < 4 { lower[in_layer(c)] } else { upper[in_layer(c)] });
            for tetrahedron in if (i + j + k + usize::from(block.is_exchanged)) % 2 == 0 { EVEN } else { ODD }
            {
                let points = tetrahedron.map(|c| index(c) as u32);
                sieve.take(CellKind::Hexahedron, points, tetrahedron.map(|c| corners[c]))?;
            }
        }
    }
    Ok(())
}
