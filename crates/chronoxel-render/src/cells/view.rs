//! A mesh as it is seen from somewhere: projected points, and faces sorted by depth and binned to tiles.
//!
//! None of it depends on values, so that steps of a series are drawn with one view. Turning the camera sorts anew, and in a
//! perspective moving it; zooming only projects and bins.

use std::collections::HashMap;

use chronoxel_core::{Camera, Projection};
use rayon::prelude::*;

use super::mesh::Face;
use super::tile::{TILE_HEIGHT, TILE_WIDTH};
use super::{CellMesh, FaceChoice, visibility};

/// Parts of the sorted faces that are binned on their own.
const NUM_BINS: usize = 16;
/// The nearest that a perspective camera sees, in longest edges.
const NEAREST: f64 = 1e-3;

/// A face in the picture: its points, ascending, and [`Face::net`] as its bits.
pub(crate) type ViewFace = [u32; 4];

/// A point where an edge enters what is in front of the camera.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Cut {
    pub ends: [u32; 2],
    /// Weight of the second end.
    pub weight: f32,
}

/// A part of the sorted faces, and which of them each tile may see.
#[derive(Debug, Default)]
pub(super) struct Bin {
    /// Faces that cover the centre of a pixel.
    pub num_faces: usize,
    /// Where the list of each tile starts in `list`, and the end.
    pub starts: Vec<u32>,
    /// The faces themselves, tile after tile: a tile then reads one run of memory.
    pub list: Vec<ViewFace>,
}

/// A mesh as it is seen from somewhere.
#[derive(Debug)]
pub struct CellView {
    camera: Camera,
    size: [usize; 2],
    /// Faces that are drawn, by number.
    chosen: Vec<u32>,
    /// The same by depth.
    order: Vec<u32>,
    /// See [`Seen`].
    pub(super) points: Vec<[f32; 3]>,
    pub(super) cuts: Vec<Cut>,
    pub(super) bins: Vec<Bin>,
}

/// Points and sorted faces as a camera sees them.
pub(crate) struct Seen {
    /// Column, row, and depth (or, in a perspective, its inverse) of the mesh's points and then of the cuts; NaN
    /// behind the camera.
    pub points: Vec<[f32; 3]>,
    pub cuts: Vec<Cut>,
    /// Faces in order, in parts.
    pub parts: Vec<Vec<ViewFace>>,
}

impl CellView {
    /// A mesh as a camera sees it.
    ///
    /// * `choice`: faces that are drawn; all where there is none
    pub fn new(mesh: &CellMesh, camera: &Camera, size: [usize; 2], choice: Option<&FaceChoice>) -> Self {
        let chosen: Vec<u32> = match choice {
            None => (0..mesh.faces.len() as u32).collect(),
            Some(choice) => {
                choice.faces.iter().copied().filter(|f| (*f as usize) < mesh.faces.len()).collect()
            }
        };
        let mut view = Self {
            camera: *camera,
            size,
            order: visibility::order(mesh, camera, &chosen),
            chosen,
            points: Vec::new(),
            cuts: Vec::new(),
            bins: Vec::new(),
        };
        view.project(mesh);
        view
    }

    /// Sees the same faces of the same mesh from another place, and says whether anything changed; sorts them again
    /// only if the direction did, or in a perspective the eye.
    pub fn look(&mut self, mesh: &CellMesh, camera: &Camera, size: [usize; 2]) -> bool {
        if self.camera == *camera && self.size == size {
            return false;
        }
        let is_turned = visibility::depends_on(&self.camera) != visibility::depends_on(camera);
        (self.camera, self.size) = (*camera, size);
        if is_turned {
            self.order = visibility::order(mesh, camera, &self.chosen);
        }
        self.project(mesh);
        true
    }

    /// Where it is seen from.
    pub fn camera(&self) -> &Camera {
        &self.camera
    }

    /// Width and height of the picture.
    pub fn size(&self) -> [usize; 2] {
        self.size
    }

    /// Faces that are drawn, in the picture or not.
    pub fn num_faces(&self) -> usize {
        self.order.len()
    }

    /// Bytes held in memory.
    pub fn num_bytes(&self) -> usize {
        let of_bin = |bin: &Bin| 4 * bin.starts.len() + 16 * bin.list.len();
        8 * self.order.len() + 12 * self.points.len() + self.bins.iter().map(of_bin).sum::<usize>()
    }

    pub(super) fn is_perspective(&self) -> bool {
        matches!(self.camera.projection(), Projection::Perspective { .. })
    }

    pub(super) fn num_tiles(&self) -> [usize; 2] {
        [self.size[0].div_ceil(TILE_WIDTH), self.size[1].div_ceil(TILE_HEIGHT)]
    }

    fn project(&mut self, mesh: &CellMesh) {
        let Seen { points, cuts, parts } = Seen::new(mesh, &self.camera, self.size, &self.order);
        (self.points, self.cuts) = (points, cuts);
        let this = &*self;
        self.bins = parts.into_par_iter().with_max_len(1).map(|faces| this.bin(faces)).collect();
    }

    /// The lists of the tiles.
    fn bin(&self, faces: Vec<ViewFace>) -> Bin {
        let [across, down] = self.num_tiles();
        let mut starts = vec![0u32; across * down + 1];
        let mut seen = Vec::with_capacity(faces.len());
        for face in faces {
            let Some(range) = self.tiles_of(&face) else { continue };
            tiles_in(range, across).for_each(|tile| starts[tile + 1] += 1);
            seen.push((face, range));
        }
        (1..starts.len()).for_each(|i| starts[i] += starts[i - 1]);
        let mut next = starts.clone();
        let mut list = vec![[0; 4]; starts[across * down] as usize];
        for &(face, range) in &seen {
            for tile in tiles_in(range, across) {
                list[next[tile] as usize] = face;
                next[tile] += 1;
            }
        }
        Bin { num_faces: seen.len(), starts, list }
    }

    /// First and last column and row of the tiles that have a pixel's centre in the face's box.
    fn tiles_of(&self, face: &ViewFace) -> Option<[[u16; 2]; 2]> {
        let corners = [0, 1, 2].map(|i| self.points[face[i] as usize]);
        let tile = [TILE_WIDTH, TILE_HEIGHT];
        let mut range = [[0; 2]; 2];
        for axis in 0..2 {
            let [a, b, c] = corners.map(|p| p[axis]);
            if (a + b + c).is_nan() {
                return None;
            }
            // Centres lie half a pixel in.
            let first = (a.min(b).min(c) - 0.5).ceil().max(0.0);
            let last = (a.max(b).max(c) - 0.5).floor().min(self.size[axis] as f32 - 1.0);
            if first > last {
                return None;
            }
            range[axis] = [first, last].map(|pixel| (pixel as usize / tile[axis]) as u16);
        }
        Some(range)
    }
}

impl Seen {
    /// * `order`: numbers of the faces by depth
    pub fn new(mesh: &CellMesh, camera: &Camera, size: [usize; 2], order: &[u32]) -> Self {
        let projector = Projector::new(camera, size, mesh.longest_edge);
        let depths = depths_of(mesh, camera);
        let points = mesh.points.par_iter().zip(&depths).with_min_len(1 << 12);
        let points = points.map(|(p, depth)| projector.project(*p, *depth)).collect();
        let numbers = HashMap::new();
        let mut clipper = Clipper { mesh, depths: &depths, projector, numbers, points, cuts: Vec::new() };
        let mut parts = vec![clipper.caps()];
        let clipped = clipper.clipped_faces(order);
        let part_len = order.len().div_ceil(NUM_BINS).max(1);
        let whole = |number: &u32| {
            let Face { points: [a, b, c], net, .. } = mesh.faces[*number as usize];
            [a, b, c, i32::from(net) as u32]
        };
        let pieces = |number: &u32| clipped.get(number).cloned().unwrap_or_else(|| vec![whole(number)]);
        if clipped.is_empty() {
            // The usual case, without a list for each face.
            parts.par_extend(order.par_chunks(part_len).map(|part| part.iter().map(whole).collect()));
        } else {
            parts.par_extend(order.par_chunks(part_len).map(|part| part.iter().flat_map(pieces).collect()));
        }
        Self { points: clipper.points, cuts: clipper.cuts, parts }
    }
}

/// Numbers of the tiles between a first and a last column and row.
fn tiles_in([columns, rows]: [[u16; 2]; 2], across: usize) -> impl Iterator<Item = usize> {
    (rows[0]..=rows[1]).flat_map(move |row| {
        (columns[0]..=columns[1]).map(move |column| usize::from(row) * across + usize::from(column))
    })
}

/// Whether everything that is drawn lies where the camera sees: nothing needs to be cut.
#[cfg(feature = "gpu")]
pub(crate) fn is_all_seen(mesh: &CellMesh, camera: &Camera) -> bool {
    let (forward, eye, bounds) = (camera.axes()[2], camera.position(), mesh.bounds());
    let depth =
        |corner: usize| -> f64 { (0..3).map(|a| (bounds[corner >> a & 1][a] - eye[a]) * forward[a]).sum() };
    // With a margin for what is rounded.
    (0..8).all(|corner| depth(corner) > 2.0 * NEAREST * mesh.longest_edge)
}

/// Depths of the points along the direction of view, from the camera.
fn depths_of(mesh: &CellMesh, camera: &Camera) -> Vec<f64> {
    let (forward, eye) = (camera.axes()[2], camera.position());
    let depth = |p: &[f64; 3]| (0..3).map(|a| (p[a] - eye[a]) * forward[a]).sum();
    mesh.points.par_iter().with_min_len(1 << 12).map(depth).collect()
}

/// From the world to columns and rows.
#[derive(Clone, Copy)]
struct Projector {
    eye: [f64; 3],
    axes: [[f64; 3]; 3],
    /// Pixels per unit, at depth 1 in a perspective.
    scale: f64,
    half: [f64; 2],
    is_perspective: bool,
    near: f64,
}

impl Projector {
    fn new(camera: &Camera, size: [usize; 2], longest_edge: f64) -> Self {
        let is_perspective = matches!(camera.projection(), Projection::Perspective { .. });
        Self {
            eye: camera.position(),
            axes: camera.axes(),
            scale: 0.5 * size[1] as f64 / camera.half_height(),
            half: size.map(|n| 0.5 * n as f64),
            is_perspective,
            near: if is_perspective { NEAREST * longest_edge } else { 0.0 },
        }
    }

    fn project(&self, p: [f64; 3], depth: f64) -> [f32; 3] {
        if depth < self.near {
            return [f32::NAN; 3];
        }
        let along = |axis: usize| (0..3).map(|a| (p[a] - self.eye[a]) * self.axes[axis][a]).sum::<f64>();
        let inverse = if self.is_perspective { 1.0 / depth } else { 1.0 };
        let scale = self.scale * inverse;
        let w = if self.is_perspective { inverse } else { depth };
        [self.half[0] + along(0) * scale, self.half[1] - along(1) * scale, w].map(|c| c as f32)
    }
}

/// Cuts faces at the plane where the camera begins to see, and closes the tetrahedra there.
struct Clipper<'a> {
    mesh: &'a CellMesh,
    depths: &'a [f64],
    projector: Projector,
    /// Numbers of the cuts of edges.
    numbers: HashMap<[u32; 2], u32>,
    points: Vec<[f32; 3]>,
    cuts: Vec<Cut>,
}

impl Clipper<'_> {
    fn is_seen(&self, point: u32) -> bool {
        self.depths[point as usize] >= self.projector.near
    }

    /// Whether some of the points are seen and some are not.
    fn is_cut(&self, points: &[u32]) -> bool {
        let num = points.iter().filter(|p| self.is_seen(**p)).count();
        num > 0 && num < points.len()
    }

    /// The point where an edge with one end in sight is cut.
    fn cut(&mut self, a: u32, b: u32) -> u32 {
        let ends = [a.min(b), a.max(b)];
        if let Some(number) = self.numbers.get(&ends) {
            return *number;
        }
        let [da, db] = ends.map(|p| self.depths[p as usize]);
        let weight = (self.projector.near - da) / (db - da);
        let [pa, pb] = ends.map(|p| self.mesh.points[p as usize]);
        let place = std::array::from_fn(|i| pa[i] + weight * (pb[i] - pa[i]));
        let number = self.points.len() as u32;
        self.points.push(self.projector.project(place, self.projector.near));
        self.cuts.push(Cut { ends, weight: weight as f32 });
        self.numbers.insert(ends, number);
        number
    }

    /// Faces in the plane, through which rays enter tetrahedra that are cut by it.
    fn caps(&mut self) -> Vec<ViewFace> {
        let mut caps = Vec::new();
        let cut: Vec<[u32; 4]> =
            self.mesh.tetrahedra.iter().filter(|cell| self.is_cut(cell.as_slice())).copied().collect();
        for cell in cut {
            let (seen, hidden): (Vec<u32>, Vec<u32>) = cell.iter().partition(|p| self.is_seen(**p));
            let corners: Vec<u32> = match (seen.as_slice(), hidden.as_slice()) {
                (&[a], &[b, c, d]) | (&[b, c, d], &[a]) => [b, c, d].map(|p| self.cut(a, p)).to_vec(),
                (&[a, b], &[c, d]) => {
                    vec![self.cut(a, c), self.cut(a, d), self.cut(b, d), self.cut(b, c)]
                }
                _ => continue,
            };
            for i in 1..corners.len() - 1 {
                let [a, b, c] = ascending([corners[0], corners[i], corners[i + 1]], 1).0;
                let [pa, pb, pc] = [a, b, c].map(|p| self.points[p as usize].map(f64::from));
                let area = (pb[0] - pa[0]) * (pc[1] - pa[1]) - (pb[1] - pa[1]) * (pc[0] - pa[0]);
                let net = if area > 0.0 { 1i32 } else { -1 };
                caps.push([a, b, c, net as u32]);
            }
        }
        caps
    }

    /// What is left in sight of the faces of the order that the plane cuts.
    fn clipped_faces(&mut self, order: &[u32]) -> HashMap<u32, Vec<ViewFace>> {
        let mut pieces = HashMap::new();
        let cut: Vec<u32> = {
            let this = &*self;
            let is_cut = |face: &&u32| this.is_cut(&this.mesh.faces[**face as usize].points);
            order.iter().filter(is_cut).copied().collect()
        };
        for number in cut {
            let Face { points, net, .. } = self.mesh.faces[number as usize];
            let mut polygon = Vec::with_capacity(4);
            for i in 0..3 {
                let (from, to) = (points[i], points[(i + 1) % 3]);
                if self.is_seen(from) {
                    polygon.push(from);
                }
                if self.is_seen(from) != self.is_seen(to) {
                    polygon.push(self.cut(from, to));
                }
            }
            let triangle = |i: usize| {
                let ([a, b, c], net) = ascending([polygon[0], polygon[i], polygon[i + 1]], net);
                [a, b, c, i32::from(net) as u32]
            };
            pieces.insert(number, (1..polygon.len() - 1).map(triangle).collect());
        }
        pieces
    }
}

/// Three points in rising order, and what turning the triangle over does to the net number of its tetrahedra.
fn ascending(mut points: [u32; 3], mut net: i8) -> ([u32; 3], i8) {
    for [i, j] in [[0, 1], [1, 2], [0, 1]] {
        if points[i] > points[j] {
            points.swap(i, j);
            net = -net;
        }
    }
    (points, net)
}
