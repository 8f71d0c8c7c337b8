//! What cells of an unstructured grid have in common: corners, faces, and a colouring of their points.

use super::{CellKind, CellList};

/// Cells that are left out, by what other cells have.
pub(super) struct Excluded {
    /// Per cell whether it is left out; empty where none is.
    is_excluded: Vec<bool>,
    /// Cells with the corners of an earlier one.
    pub num_duplicate: u64,
    /// Cells with a face that two earlier ones have.
    pub num_non_manifold: u64,
}

impl Excluded {
    /// Compares all cells.
    pub fn of(cells: &CellList) -> Self {
        let mut excluded = Self { is_excluded: Vec::new(), num_duplicate: 0, num_non_manifold: 0 };
        for cell in duplicates(cells) {
            excluded.num_duplicate += u64::from(excluded.exclude(cell, cells.len()));
        }
        for cell in behind_full_faces(cells, &excluded) {
            excluded.num_non_manifold += u64::from(excluded.exclude(cell, cells.len()));
        }
        excluded
    }

    /// Leaves a cell out; `false` if it was before.
    fn exclude(&mut self, cell: usize, num_cells: usize) -> bool {
        self.is_excluded.resize(num_cells, false);
        !std::mem::replace(&mut self.is_excluded[cell], true)
    }

    /// Whether a cell is left out.
    pub fn contains(&self, cell: usize) -> bool {
        self.is_excluded.get(cell).copied().unwrap_or(false)
    }

    /// The most bytes held while cells are compared.
    pub fn most_bytes(num_cells: usize, num_faces: usize) -> u64 {
        (num_cells + (num_cells * size_of::<([u32; 8], u32)>()).max(num_faces * size_of::<([u32; 4], u32)>()))
            as u64
    }
}

/// Cells with the same corners as an earlier one, whatever their order.
fn duplicates(cells: &CellList) -> Vec<usize> {
    let mut keys: Vec<([u32; 8], u32)> = Vec::with_capacity(cells.len());
    for (cell, (_, corners)) in cells.iter().enumerate() {
        let mut key = [u32::MAX; 8];
        key[..corners.len()].copy_from_slice(corners);
        key.sort_unstable();
        keys.push((key, cell as u32));
    }
    keys.sort_unstable();
    keys.windows(2).filter(|pair| pair[0].0 == pair[1].0).map(|pair| pair[1].1 as usize).collect()
}

/// Cells with a face that two earlier ones have already.
fn behind_full_faces(cells: &CellList, excluded: &Excluded) -> Vec<usize> {
    let num_faces = cells.iter().map(|(kind, _)| kind.faces().len()).sum();
    let mut keys: Vec<([u32; 4], u32)> = Vec::with_capacity(num_faces);
    for (cell, (kind, corners)) in cells.iter().enumerate() {
        if excluded.contains(cell) {
            continue;
        }
        for face in kind.faces() {
            // A face that has collapsed to an edge or a point lies between no two cells.
            if let Some(key) = face_key(face.map(|corner| corners[corner])) {
                keys.push((key, cell as u32));
            }
        }
    }
    keys.sort_unstable();
    keys.dedup();
    keys.windows(3).filter(|run| run[0].0 == run[2].0).map(|run| run[2].1 as usize).collect()
}

/// The distinct corners of a face in increasing order, whatever cell it is seen from; `None` if they are fewer than three.
fn face_key(mut corners: [u32; 4]) -> Option<[u32; 4]> {
    corners.sort_unstable();
    let (mut key, mut num_distinct) = ([u32::MAX; 4], 0);
    for corner in corners {
        if num_distinct == 0 || key[num_distinct - 1] != corner {
            key[num_distinct] = corner;
            num_distinct += 1;
        }
    }
    (num_distinct >= 3).then_some(key)
}

/// Two colours for the points such that the edges of hexahedra join different ones, where that can be.
///
/// Where it can, the diagonals of all faces of hexahedra join points of one colour, which come first in the order of points, and each hexahedron gives
/// five tetrahedra. Hexahedra that hang together and cannot be coloured so have the order of their points alone.
pub(super) struct Colours {
    /// Per point: whether it has the second colour. Empty where all have the first.
    is_second: Vec<bool>,
}

impl Colours {
    /// Colours the points of all hexahedra that are not left out.
    pub fn of(cells: &CellList, excluded: &Excluded, num_points: usize) -> Self {
        let is_hexahedron = |kind: CellKind| kind == CellKind::Hexahedron;
        if !cells.iter().any(|(kind, _)| is_hexahedron(kind)) {
            return Self { is_second: Vec::new() };
        }
        let mut parts = Parts::new(num_points);
        for (cell, (kind, corners)) in cells.iter().enumerate() {
            if is_hexahedron(kind) && !excluded.contains(cell) {
                const EDGES: [[usize; 2]; 12] = [
                    [0, 1],
                    [1, 2],
                    [2, 3],
                    [3, 0],
                    [4, 5],
                    [5, 6],
                    [6, 7],
                    [7, 4],
                    [0, 4],
                    [1, 5],
                    [2, 6],
                    [3, 7],
                ];
                for edge in EDGES {
                    let [a, b] = edge.map(|corner| corners[corner]);
                    // An edge of no length sets nothing apart.
                    if a != b {
                        parts.set_apart(a, b);
                    }
                }
            }
        }
        Self { is_second: (0..num_points as u32).map(|point| parts.is_second(point)).collect() }
    }

    /// The place of a point in the order of points.
    pub fn rank(&self, point: u32) -> u64 {
        let is_second = self.is_second.get(point as usize).copied().unwrap_or(false);
        u64::from(is_second) << 32 | u64::from(point)
    }

    /// The most bytes held.
    pub fn most_bytes(num_points: usize) -> u64 {
        (num_points * (size_of::<u32>() + 3)) as u64
    }
}

/// Points that hang together, each with a parity against the first of its part (union-find).
struct Parts {
    parent: Vec<u32>,
    /// Whether the colour differs from that of the parent.
    differs: Vec<bool>,
    /// Per first point: whether its part cannot be coloured.
    is_odd: Vec<bool>,
}

impl Parts {
    fn new(num_points: usize) -> Self {
        let parent = (0..num_points as u32).collect();
        Self { parent, differs: vec![false; num_points], is_odd: vec![false; num_points] }
    }

    /// The first point of the part, and whether the colours differ.
    fn find(&mut self, point: u32) -> (u32, bool) {
        let (mut root, mut differs) = (point, false);
        while self.parent[root as usize] != root {
            differs ^= self.differs[root as usize];
            root = self.parent[root as usize];
        }
        // The way is made short for the next time.
        let (mut at, mut to_root) = (point, differs);
        while self.parent[at as usize] != root && at != root {
            let next = self.parent[at as usize];
            self.parent[at as usize] = root;
            let step = std::mem::replace(&mut self.differs[at as usize], to_root);
            to_root ^= step;
            at = next;
        }
        (root, differs)
    }

    /// Joins the parts of two points that need different colours.
    fn set_apart(&mut self, a: u32, b: u32) {
        let ((root_a, differs_a), (root_b, differs_b)) = (self.find(a), self.find(b));
        if root_a == root_b {
            self.is_odd[root_a as usize] |= differs_a == differs_b;
            return;
        }
        // The smaller number stays first, so that colours do not depend on the order of cells.
        let (first, second) = (root_a.min(root_b), root_a.max(root_b));
        self.parent[second as usize] = first;
        self.differs[second as usize] = differs_a == differs_b;
        self.is_odd[first as usize] |= self.is_odd[second as usize];
    }

    fn is_second(&mut self, point: u32) -> bool {
        let (root, differs) = self.find(point);
        differs && !self.is_odd[root as usize]
    }
}
