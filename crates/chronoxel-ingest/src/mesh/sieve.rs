//! Which tetrahedra are kept, and how they are oriented.

use std::path::Path;

use super::{CellKind, MeshCensus, VisitTetrahedron};
use crate::SourceError;

/// Tetrahedra whose volume is at most this share of the cube of their longest edge are flat.
///
/// A regular tetrahedron has a share of 0.118, a corner of a box with edges 1, 1 and 900 one of 2.1e-7, of one with
/// edges 1, 1000 and 1000 one of 5.9e-5.
pub const DEFAULT_FLAT_THRESHOLD: f64 = 1.8e-7;

/// Larger coordinates would overflow the volumes.
const MAX_COORDINATE: f64 = 1e100;

/// More points than this have no index of 32 bits.
pub(crate) const MAX_POINTS: u64 = u32::MAX as u64;

/// Counts tetrahedra, leaves out flat ones, turns left-handed ones, and hands over the rest.
pub(crate) struct Sieve<'a, 'b> {
    /// What was counted so far.
    pub census: MeshCensus,
    flat_threshold: f64,
    /// Kept tetrahedra by the kind of their cell: how many, and how many were left-handed.
    handedness: [[u64; 2]; CellKind::ALL.len()],
    visit: &'a mut VisitTetrahedron<'b>,
}

impl<'a, 'b> Sieve<'a, 'b> {
    /// A sieve through which nothing went yet.
    pub fn new(num_points: usize, flat_threshold: f64, visit: &'a mut VisitTetrahedron<'b>) -> Self {
        let census = MeshCensus { num_points: num_points as u64, ..MeshCensus::default() };
        Self { census, flat_threshold, handedness: Default::default(), visit }
    }

    /// Takes a tetrahedron of a cell with the positions of its corners.
    pub fn take(
        &mut self,
        kind: CellKind,
        tetrahedron: [u32; 4],
        corners: [[f64; 3]; 4],
    ) -> Result<(), SourceError> {
        self.census.num_split += 1;
        let sixfold = sixfold_volume(corners);
        let longest = longest_edge_squared(corners);
        let volume = sixfold.abs() / 6.0;
        // Written so that a NaN, which only an overflow could give, counts as flat.
        let is_solid = volume > self.flat_threshold * longest * longest.sqrt();
        if !is_solid {
            self.census.num_flat += 1;
            return Ok(());
        }
        self.census.num_tetrahedra += 1;
        self.census.volume += volume;
        let [num_kept, num_left_handed] = &mut self.handedness[kind as usize];
        *num_kept += 1;
        *num_left_handed += u64::from(sixfold < 0.0);
        let [a, b, c, d] = tetrahedron;
        if sixfold > 0.0 { (self.visit)([a, b, c, d]) } else { (self.visit)([a, c, b, d]) }
    }

    /// The census at the end; an error where nothing is left.
    pub fn finish(self, path: &Path) -> Result<MeshCensus, SourceError> {
        let mut census = self.census;
        census.num_inverted = self.handedness.iter().map(|[kept, left]| (*left).min(kept - left)).sum();
        if census.num_tetrahedra > 0 {
            return Ok(census);
        }
        let problem = format!(
            "of {} cells, {} hold no volume, {} are blanked, and the {} tetrahedra of the others are flat; check the \
             coordinates",
            census.cells.total(),
            census.cells.without_volume,
            census.num_blanked,
            census.num_flat
        );
        Err(SourceError::corrupt(path, "volume of the mesh", 0, problem))
    }
}

/// Six times the signed volume: `(b - a) × (c - a) · (d - a)`.
pub(crate) fn sixfold_volume([a, b, c, d]: [[f64; 3]; 4]) -> f64 {
    let [u, v, w] = [b, c, d].map(|p| [p[0] - a[0], p[1] - a[1], p[2] - a[2]]);
    (u[1] * v[2] - u[2] * v[1]) * w[0]
        + (u[2] * v[0] - u[0] * v[2]) * w[1]
        + (u[0] * v[1] - u[1] * v[0]) * w[2]
}

/// The square of the longest of the six edges.
fn longest_edge_squared(corners: [[f64; 3]; 4]) -> f64 {
    const EDGES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];
    let squared = |[i, j]: [usize; 2]| {
        let d: [f64; 3] = std::array::from_fn(|axis| corners[i][axis] - corners[j][axis]);
        d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    };
    EDGES.map(squared).into_iter().fold(0.0, f64::max)
}

/// Refuses points that are not finite, or too far away to compute with.
pub(crate) fn check_points(path: &Path, first: usize, points: &[[f64; 3]]) -> Result<(), SourceError> {
    let is_wrong = |p: &[f64; 3]| p.iter().any(|x| x.is_nan() || x.abs() > MAX_COORDINATE);
    match points.iter().position(is_wrong) {
        None => Ok(()),
        Some(index) => {
            let [x, y, z] = points[index];
            let field = format!("position of point {}", first + index);
            let problem = format!("coordinates must be finite, and at most {MAX_COORDINATE:e}");
            Err(SourceError::corrupt(path, field, format!("{x:?}, {y:?}, {z:?}"), problem))
        }
    }
}
