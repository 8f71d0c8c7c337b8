//! Cells into tetrahedra such that neighbours agree on the diagonals of their common faces.
//!
//! The diagonal of a face with four corners starts at the one that comes first in an order of all points (Dompierre et
//! al., "How to subdivide pyramids, prisms, and hexahedra into tetrahedra", 1999): what two cells do with a face follows from the face alone. Within a cell,
//! tetrahedra join its first corner with the triangles of the faces that it is not on.

/// A face with four corners, in order around it as seen from outside.
type Quad = [usize; 4];

/// Faces of a hexahedron with VTK's order of corners.
pub(super) const HEXAHEDRON: [Quad; 6] =
    [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [2, 3, 7, 6], [1, 2, 6, 5], [0, 4, 7, 3]];

/// Faces with four corners of a wedge.
const WEDGE: [Quad; 3] = [[0, 3, 4, 1], [1, 4, 5, 2], [2, 5, 3, 0]];

/// Splits a pyramid: a base of four corners, then the tip. `rank` gives each corner its place in the order of points.
pub(super) fn pyramid(rank: [u64; 5]) -> Vec<[usize; 4]> {
    halves([0, 1, 2, 3], &rank).map(|[a, b, c]| [a, b, c, 4]).to_vec()
}

/// Splits a wedge: a triangle, then the one opposite.
pub(super) fn wedge(rank: [u64; 6]) -> Vec<[usize; 4]> {
    let first = first_of(&rank);
    // The triangle opposite, seen from the first corner.
    let [a, b, c] = if first < 3 { [3, 5, 4] } else { [0, 1, 2] };
    let mut tetrahedra = vec![[a, c, b, first]];
    for quad in WEDGE.into_iter().filter(|quad| !quad.contains(&first)) {
        tetrahedra.extend(halves(quad, &rank).map(|[a, b, c]| [a, c, b, first]));
    }
    tetrahedra
}

/// Splits a hexahedron: into five tetrahedra if the diagonals of its faces allow it, else into six.
pub(super) fn hexahedron(rank: [u64; 8]) -> Vec<[usize; 4]> {
    let first = first_of(&rank);
    // The corner across the hexahedron shares no face with the first.
    const ACROSS: [usize; 8] = [6, 7, 4, 5, 2, 3, 0, 1];
    let across = ACROSS[first];
    let triangles: Vec<[usize; 3]> = HEXAHEDRON
        .into_iter()
        .filter(|quad| !quad.contains(&first))
        .flat_map(|quad| halves(quad, &rank))
        .collect();
    let (at_corner, others): (Vec<[usize; 3]>, Vec<[usize; 3]>) =
        triangles.iter().partition(|t| t.contains(&across));
    if at_corner.len() > 3 {
        return triangles.iter().map(|&[a, b, c]| [a, c, b, first]).collect();
    }
    // No diagonal meets the corner across: it is cut off, and the cut is one more triangle.
    let mut tetrahedra: Vec<[usize; 4]> = others.iter().map(|&[a, b, c]| [a, c, b, first]).collect();
    // What is left of each of its three triangles is an edge of the cut.
    let edges: Vec<[usize; 2]> = at_corner
        .iter()
        .map(|&[a, b, c]| {
            if a == across {
                [b, c]
            } else if b == across {
                [c, a]
            } else {
                [a, b]
            }
        })
        .collect();
    let [a, b] = edges[0];
    let [_, c] = edges.into_iter().find(|edge| edge[0] == b).expect("the edges go around");
    tetrahedra.extend([[a, b, c, across], [a, c, b, first]]);
    tetrahedra
}

/// The corner that comes first.
fn first_of(rank: &[u64]) -> usize {
    (0..rank.len()).min_by_key(|&corner| rank[corner]).expect("cells have corners")
}

/// The two triangles of a face, which turn as it does, on both sides of the diagonal from its first corner.
fn halves(quad: Quad, rank: &[u64]) -> [[usize; 3]; 2] {
    let start = (0..4).min_by_key(|&corner| rank[quad[corner]]).expect("there are four");
    let [a, b, c, d] = std::array::from_fn(|i| quad[(start + i) % 4]);
    [[a, b, c], [a, c, d]]
}
