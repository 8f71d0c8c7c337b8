//! The geometry of a mesh, and its faces, each once.

use std::sync::OnceLock;

use rayon::prelude::*;

use crate::RenderError;

/// A triangle between tetrahedra, or at the mesh's boundary.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Face {
    /// Points, ascending.
    pub points: [u32; 3],
    /// Tetrahedra on the side that `(b - a) × (c - a)` points to, less those on the other side.
    pub net: i8,
    /// Whether it has tetrahedra on one side only, or more than one on a side.
    pub is_boundary: bool,
}

/// The points and tetrahedra of a mesh, made ready once for many pictures.
#[derive(Debug)]
pub struct CellMesh {
    pub(crate) points: Vec<[f64; 3]>,
    pub(crate) tetrahedra: Vec<[u32; 4]>,
    pub(crate) faces: Vec<Face>,
    /// The tetrahedron on the side of each face that its normal points to, and that on the other, or [`NO_CELL`].
    pub(crate) sides: Vec<[u32; 2]>,
    /// Faces of each tetrahedron.
    pub(super) faces_of_cells: Vec<[u32; 4]>,
    pub(crate) longest_edge: f64,
    bounds: [[f64; 3]; 2],
    num_flat: usize,
    cells_of_point: OnceLock<CellsOfPoints>,
}

/// In place of a tetrahedron where there is none.
pub(super) const NO_CELL: u32 = u32::MAX;

/// The tetrahedra around each point, as runs of one list.
#[derive(Debug)]
pub(crate) struct CellsOfPoints {
    pub starts: Vec<u32>,
    pub cells: Vec<u32>,
}

/// Most tetrahedra of a mesh: four times as many faces must be numbers of 32 bits.
const MAX_TETRAHEDRA: usize = 1 << 29;

impl CellMesh {
    /// A mesh from its points and its tetrahedra, in any orientation.
    ///
    /// Flat tetrahedra hold nothing that could be seen, and are left out.
    ///
    /// # Errors
    /// [`RenderError::InvalidArgument`] if a coordinate is not finite or above 1e100, a tetrahedron names a point that does not
    /// exist, there are too many, or none is left.
    pub fn new(points: Vec<[f64; 3]>, tetrahedra: &[[u32; 4]]) -> Result<Self, RenderError> {
        if let Some(at) = points.iter().position(|p| p.iter().any(|c| c.is_nan() || c.abs() > 1e100)) {
            let value = format!("{:?} at point {at}", points[at]);
            return Err(RenderError::invalid("coordinate of the mesh", value, "it must be finite"));
        }
        let is_missing = |cell: &&[u32; 4]| cell.iter().any(|&p| p as usize >= points.len());
        if let Some(cell) = tetrahedra.iter().find(is_missing) {
            let value = format!("{cell:?} of {} points", points.len());
            return Err(RenderError::invalid("tetrahedron", value, "its points must exist"));
        }
        let oriented: Vec<[u32; 4]> =
            tetrahedra.iter().filter_map(|cell| positively_oriented(&points, *cell)).collect();
        if oriented.is_empty() || oriented.len() > MAX_TETRAHEDRA {
            let remedy = "there must be at least one that is not flat, and at most 2^29";
            return Err(RenderError::invalid("number of tetrahedra", oriented.len(), remedy));
        }
        let Faces { faces, sides, of_cells } = unique_faces(&oriented);
        let length = |[a, b]: [u32; 2]| {
            let d = sub(points[a as usize], points[b as usize]);
            dot(d, d)
        };
        let longest = |face: &Face| {
            let [a, b, c] = face.points;
            length([a, b]).max(length([b, c])).max(length([a, c]))
        };
        let longest_edge = faces.par_iter().map(longest).reduce(|| 0.0, f64::max).sqrt();
        let used = faces.iter().flat_map(|face| face.points).map(|p| points[p as usize]);
        let bounds = used.fold([[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]], |[low, high], p| {
            [std::array::from_fn(|a| low[a].min(p[a])), std::array::from_fn(|a| high[a].max(p[a]))]
        });
        let num_flat = tetrahedra.len() - oriented.len();
        Ok(Self {
            points,
            tetrahedra: oriented,
            faces,
            sides,
            faces_of_cells: of_cells,
            longest_edge,
            bounds,
            num_flat,
            cells_of_point: OnceLock::new(),
        })
    }

    /// Number of points: of values of a step.
    pub fn num_points(&self) -> usize {
        self.points.len()
    }

    /// Tetrahedra that are drawn.
    pub fn num_tetrahedra(&self) -> usize {
        self.tetrahedra.len()
    }

    /// Tetrahedra that were left out because they are flat.
    pub fn num_flat(&self) -> usize {
        self.num_flat
    }

    /// Faces, each counted once.
    pub fn num_faces(&self) -> usize {
        self.faces.len()
    }

    /// Faces at the boundary.
    pub fn num_boundary_faces(&self) -> usize {
        self.faces.iter().filter(|face| face.is_boundary).count()
    }

    /// Lowest and highest corner of the box around what is drawn.
    pub fn bounds(&self) -> [[f64; 3]; 2] {
        self.bounds
    }

    /// The longest segment for which colours are integrated: the longest edge, or half the mesh where faces are left out.
    pub(crate) fn longest_segment(&self, faces_are_left_out: bool) -> f64 {
        if !faces_are_left_out {
            return self.longest_edge;
        }
        let diagonal = sub(self.bounds[1], self.bounds[0]);
        (0.5 * dot(diagonal, diagonal).sqrt()).max(self.longest_edge)
    }

    /// Bytes held in memory.
    pub fn num_bytes(&self) -> usize {
        size_of_val(self.points.as_slice())
            + size_of_val(self.tetrahedra.as_slice())
            + size_of_val(self.faces.as_slice())
            + size_of_val(self.sides.as_slice())
            + size_of_val(self.faces_of_cells.as_slice())
            + self.cells_of_point.get().map_or(0, |c| 4 * (c.starts.len() + c.cells.len()))
    }

    /// The tetrahedra around each point; found when first asked for.
    pub(crate) fn cells_of_points(&self) -> &CellsOfPoints {
        self.cells_of_point.get_or_init(|| {
            let mut starts = vec![0u32; self.points.len() + 1];
            self.tetrahedra.iter().flatten().for_each(|&p| starts[p as usize + 1] += 1);
            (1..starts.len()).for_each(|i| starts[i] += starts[i - 1]);
            let mut next = starts.clone();
            let mut cells = vec![0u32; 4 * self.tetrahedra.len()];
            for (number, cell) in (0u32..).zip(&self.tetrahedra) {
                for &p in cell {
                    cells[next[p as usize] as usize] = number;
                    next[p as usize] += 1;
                }
            }
            CellsOfPoints { starts, cells }
        })
    }
}

/// The tetrahedron so that `(b - a) × (c - a) · (d - a) > 0`; `None` if it is flat.
fn positively_oriented(points: &[[f64; 3]], [a, b, c, d]: [u32; 4]) -> Option<[u32; 4]> {
    let volume = six_volumes(points, [a, b, c, d]);
    if volume > 0.0 { Some([a, b, c, d]) } else { (volume < 0.0).then_some([a, c, b, d]) }
}

/// Six times the volume of a tetrahedron, positive if it is positively oriented.
pub(super) fn six_volumes(points: &[[f64; 3]], cell: [u32; 4]) -> f64 {
    let [a, b, c, d] = cell.map(|p| points[p as usize]);
    dot(cross(sub(b, a), sub(c, a)), sub(d, a))
}

/// One of the four sides of a tetrahedron.
#[derive(Clone, Copy)]
struct HalfFace {
    points: [u32; 3],
    cell: u32,
    /// 1 where the tetrahedron lies on the side that the normal of the ascending points has.
    side: i8,
}

/// The faces of a mesh, each once, and what lies at them.
struct Faces {
    faces: Vec<Face>,
    sides: Vec<[u32; 2]>,
    of_cells: Vec<[u32; 4]>,
}

fn unique_faces(tetrahedra: &[[u32; 4]]) -> Faces {
    let numbered = tetrahedra.par_iter().enumerate();
    let mut halves: Vec<HalfFace> = numbered.flat_map_iter(|(n, cell)| half_faces(n as u32, *cell)).collect();
    halves.par_sort_unstable_by_key(|half| (half.points, half.side, half.cell));
    let num = halves.chunk_by(|a, b| a.points == b.points).count();
    let (faces, sides) = (Vec::with_capacity(num), Vec::with_capacity(num));
    let mut found = Faces { faces, sides, of_cells: vec![[NO_CELL; 4]; tetrahedra.len()] };
    for same in halves.chunk_by(|a, b| a.points == b.points) {
        let number = found.faces.len() as u32;
        let on = |side: i8| same.iter().filter(move |half| half.side == side);
        let (above, below) = (on(1).count(), on(-1).count());
        let net = (above as i64 - below as i64).clamp(-7, 7) as i8;
        found.faces.push(Face { points: same[0].points, net, is_boundary: above != 1 || below != 1 });
        found.sides.push([1, -1].map(|side| on(side).next().map_or(NO_CELL, |half| half.cell)));
        for half in same {
            let of_cell = &mut found.of_cells[half.cell as usize];
            if let Some(place) = of_cell.iter_mut().find(|face| **face == NO_CELL) {
                *place = number;
            }
        }
    }
    found
}

/// The sides of a positively oriented tetrahedron.
fn half_faces(cell: u32, [a, b, c, d]: [u32; 4]) -> [HalfFace; 4] {
    // The normal of each of these points into the tetrahedron.
    [[a, b, c], [a, d, b], [a, c, d], [b, d, c]].map(|mut points| {
        let mut side = 1;
        for [i, j] in [[0, 1], [1, 2], [0, 1]] {
            if points[i] > points[j] {
                points.swap(i, j);
                side = -side;
            }
        }
        HalfFace { points, cell, side }
    })
}

pub(super) fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|i| a[i] - b[i])
}

pub(super) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points() -> Vec<[f64; 3]> {
        vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 1.0]]
    }

    #[test]
    fn shared_faces_are_counted_once() {
        let mesh = CellMesh::new(points(), &[[0, 1, 2, 3], [1, 2, 3, 4]]).unwrap();
        assert_eq!((mesh.num_tetrahedra(), mesh.num_faces(), mesh.num_boundary_faces()), (2, 7, 6));
        let shared = mesh.faces.iter().find(|f| f.points == [1, 2, 3]).unwrap();
        assert_eq!((shared.net, shared.is_boundary), (0, false));
        for face in mesh.faces.iter().filter(|f| f.is_boundary) {
            // The mesh's centre lies on the side that the net number says.
            let [a, b, c] = face.points.map(|p| mesh.points[p as usize]);
            let inside = dot(cross(sub(b, a), sub(c, a)), sub([0.4; 3], a));
            assert_eq!(inside.signum(), f64::from(face.net), "{face:?}");
        }
        assert!((mesh.longest_edge - 2f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn orientation_does_not_matter_and_flat_ones_are_left_out() {
        let mut flat = points();
        flat.push([1.0, 1.0, 0.0]);
        let mesh = CellMesh::new(flat, &[[1, 0, 2, 3], [0, 1, 2, 5], [2, 1, 3, 4]]).unwrap();
        assert_eq!((mesh.num_tetrahedra(), mesh.num_flat(), mesh.num_faces()), (2, 1, 7));
        assert!(mesh.tetrahedra.iter().all(|cell| six_volumes(&mesh.points, *cell) > 0.0));
    }

    #[test]
    fn unusable_meshes_are_refused() {
        assert!(CellMesh::new(points(), &[]).is_err());
        let error = CellMesh::new(points(), &[[0, 1, 2, 9]]).unwrap_err().to_string();
        assert_eq!(error, "tetrahedron is [0, 1, 2, 9] of 5 points: its points must exist");
        let mut holed = points();
        holed[2][1] = f64::NAN;
        assert!(CellMesh::new(holed, &[[0, 1, 2, 3]]).is_err());
    }
}
