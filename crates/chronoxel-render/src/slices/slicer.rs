//! The incremental slicer: planes swept through boxes.

use std::ops::Range;

use chronoxel_core::{Camera, UniformGrid};

use super::active::{ActiveEdges, Edge, MAX_EDGES};
use super::list::SliceList;
use crate::RenderError;

/// Most slices that one box can be cut into.
pub const MAX_SLICES_PER_BOX: usize = 1 << 20;

/// Slices are counted to this many on either side of the origin.
const MAX_SLICE: f64 = (1 << 30) as f64;

/// Largest magnitude of a coordinate, with room for products of several in double precision.
const MAX_COORDINATE: f64 = 1e30;

/// A component of the normal that is this small beside the largest is rounding: the planes lie along that axis.
const SMALLEST_COMPONENT: f64 = 1e-12;

/// In which order the slices of a box are given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SliceOrder {
    /// The farthest first, as they are blended over each other.
    #[default]
    BackToFront,
    /// The nearest first.
    FrontToBack,
}

/// Cuts boxes by the planes of a view, see the [module](super).
#[derive(Debug, Clone)]
pub struct Slicer {
    normal: [f64; 3],
    origin: [f64; 3],
    distance: f64,
    per_distance: f64,
    order: SliceOrder,
    /// Planes before this one are left out.
    first_slice: i32,
    /// The axes of the [`ActiveEdges`], counter-clockwise at the corner that is passed first.
    axes: [usize; 3],
    /// Along each axis, what an edge's crossing moves from slice to slice, and for a unit of depth.
    slopes: [f64; 3],
    per_depth: [f64; 3],
}

impl Slicer {
    /// A slicer of all planes `normal · (p − origin) = k · distance`, `k` whole.
    ///
    /// * `normal`: along the direction of view, away from the eye; of any length: that of depth is its own
    /// * `origin`: a point of the plane 0; give the same for all boxes
    /// * `distance`: between slices, in the units of depth
    ///
    /// # Errors
    /// [`RenderError::InvalidArgument`] if the normal is zero, the distance is not positive, or a number is not finite
    /// or out of all proportion (beyond 1e30, or 1e-30).
    pub fn new(
        normal: [f64; 3],
        origin: [f64; 3],
        distance: f64,
        order: SliceOrder,
    ) -> Result<Self, RenderError> {
        let largest = normal.iter().fold(0.0f64, |m, n| m.max(n.abs()));
        let is_finite = normal.iter().all(|n| n.is_finite());
        if !(is_finite && (1.0 / MAX_COORDINATE..=MAX_COORDINATE).contains(&largest)) {
            let remedy = "give a vector along the direction of view, neither zero nor huge";
            return Err(RenderError::invalid("normal of the slices", format!("{normal:?}"), remedy));
        }
        if !origin.iter().all(|c| c.abs() <= MAX_COORDINATE) {
            let remedy = "each coordinate must be a number below 1e30";
            return Err(RenderError::invalid("origin of the slices", format!("{origin:?}"), remedy));
        }
        if !(1.0 / MAX_COORDINATE..=MAX_COORDINATE).contains(&distance) {
            let remedy = "it must be a positive length between 1e-30 and 1e30";
            return Err(RenderError::invalid("slice distance", distance, remedy));
        }
        let normal = normal.map(|n| if n.abs() < SMALLEST_COMPONENT * largest { 0.0 } else { n });
        let num_falling = normal.iter().filter(|n| **n < 0.0).count();
        Ok(Self {
            normal,
            origin,
            distance,
            per_distance: 1.0 / distance,
            order,
            first_slice: i32::MIN,
            // From the corner nearest to the eye, x, y and z appear clockwise where all of them lead away from it.
            axes: if num_falling % 2 == 0 { [0, 2, 1] } else { [0, 1, 2] },
            slopes: normal.map(|n| distance / n),
            per_depth: normal.map(|n| 1.0 / n),
        })
    }

    /// A slicer of boxes in world coordinates, as a camera sees them: plane `k` lies `k · distance` in front of the
    /// camera's position, perpendicular to its direction of view, and those with `k < 1` are left out.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn of_camera(camera: &Camera, distance: f64, order: SliceOrder) -> Result<Self, RenderError> {
        let [_, _, forward] = camera.axes();
        Ok(Self { first_slice: 1, ..Self::new(forward, camera.position(), distance, order)? })
    }

    /// The planes of [`Self::of_camera`], for boxes in the voxel coordinates of a grid; `distance` is in world units.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn of_camera_in_voxels(
        camera: &Camera,
        grid: &UniformGrid,
        distance: f64,
        order: SliceOrder,
    ) -> Result<Self, RenderError> {
        let [_, _, forward] = camera.axes();
        let normal = std::array::from_fn(|a| forward[a] * grid.spacing[a]);
        let origin = grid.voxel_from_world(camera.position());
        Ok(Self { first_slice: 1, ..Self::new(normal, origin, distance, order)? })
    }

    /// Adds the polygons of a box to `list`, in the order of the slicer, and says how many.
    ///
    /// A box that is empty along an axis has none. Boxes are drawn over each other in the order in which they are
    /// given: it must be that of the slices.
    ///
    /// * `bounds`: lowest and highest corner
    ///
    /// # Errors
    /// [`RenderError::InvalidArgument`] if a coordinate is not a number below 1e30, or the slice distance is so small
    /// beside the box that there would be more than [`MAX_SLICES_PER_BOX`] slices, or more than 2^30 up to it, or
    /// more than 2^32 vertices in the list. The list stays as it is then.
    pub fn slice(&self, bounds: [[f64; 3]; 2], list: &mut SliceList) -> Result<usize, RenderError> {
        if !bounds.as_flattened().iter().all(|c| c.abs() <= MAX_COORDINATE) {
            let remedy = "each coordinate must be a number below 1e30";
            return Err(RenderError::invalid("box to slice", format!("{bounds:?}"), remedy));
        }
        if (0..3).any(|a| bounds[0][a] >= bounds[1][a]) {
            return Ok(0);
        }
        let cut = BoxToCut::new(self, bounds);
        let Some(slices) = self.slices_of(&cut, list)? else { return Ok(0) };
        let num_before = list.num_polygons();
        self.sweep(&cut, slices, list);
        Ok(list.num_polygons() - num_before)
    }

    /// The slices of a box.
    fn slices_of(&self, cut: &BoxToCut, list: &SliceList) -> Result<Option<Range<i32>>, RenderError> {
        let [near, far] = [cut.depth(cut.nearest), cut.depth(7 ^ cut.nearest)];
        let remedy = "give a larger slice distance, or smaller boxes";
        let magnitude = near.abs().max(far.abs()) * self.per_distance;
        if magnitude > MAX_SLICE {
            return Err(RenderError::invalid("number of slices up to a box", magnitude, remedy));
        }
        let slices = self.first_at(near).max(self.first_slice)..self.first_at(far);
        let num_slices = slices.len();
        if num_slices > MAX_SLICES_PER_BOX {
            return Err(RenderError::invalid("number of slices of a box", num_slices, remedy));
        }
        if u32::try_from(list.positions.len() + MAX_EDGES * num_slices).is_err() {
            let remedy = "draw the list and clear it, or give a larger slice distance";
            return Err(RenderError::invalid("number of vertices of slices", list.positions.len(), remedy));
        }
        Ok((num_slices > 0).then_some(slices))
    }

    /// The first plane at a depth or beyond, which passes a corner there: the least `k` whose `k · distance`, rounded,
    /// is not below. It follows from the depth alone, so that boxes agree about the corners they share.
    #[inline]
    fn first_at(&self, depth: f64) -> i32 {
        let k = (depth * self.per_distance).ceil();
        let k = if (k - 1.0) * self.distance >= depth { k - 1.0 } else { k };
        let k = if k * self.distance < depth { k + 1.0 } else { k };
        k as i32
    }

    /// Passes the corners of a box one after another, and writes the slices between each and the next.
    fn sweep(&self, cut: &BoxToCut, slices: Range<i32>, list: &mut SliceList) {
        let corners = self.corners_in_order(cut);
        let mut active = ActiveEdges::default();
        for pair in corners.windows(2) {
            active.pass((pair[0] & 7) as u8);
            // Shifted, the keys are the planes that pass the two corners; the ends of the planes' range are theirs, too.
            let [from, to] = [(pair[0] >> 3) as i32, (pair[1] >> 3) as i32];
            let run = match self.order {
                SliceOrder::FrontToBack => from.max(slices.start)..to,
                SliceOrder::BackToFront => (1 - to).max(slices.start)..1 - from,
            };
            if !run.is_empty() {
                self.write_run(cut, &active, run, list);
            }
        }
    }

    /// The corners in the order in which the planes pass them, as numbers of [`ActiveEdges`], below what they are
    /// sorted by: the first plane that has passed them, planes being counted downwards from back to front. Where
    /// several are passed at once, those with fewer bits come first, since their numbers are smaller.
    fn corners_in_order(&self, cut: &BoxToCut) -> [i64; 8] {
        let [a, b, c] = self.axes;
        let mut corners: [i64; 8] = std::array::from_fn(|number| {
            let bits = (number & 1) << a | (number >> 1 & 1) << b | (number >> 2) << c;
            let first = self.first_at(cut.depth(bits ^ cut.first));
            let key = match self.order {
                SliceOrder::FrontToBack => first,
                SliceOrder::BackToFront => 1 - first,
            };
            i64::from(key) << 3 | number as i64
        });
        corners.sort_unstable();
        corners
    }

    fn write_run(&self, cut: &BoxToCut, active: &ActiveEdges, run: Range<i32>, list: &mut SliceList) {
        let mut lines = [EdgeLine::default(); MAX_EDGES];
        let mut num_lines = 0;
        for (line, edge) in lines.iter_mut().zip(active.iter()) {
            *line = self.line_of(cut, edge);
            num_lines += 1;
        }
        let first = list.positions.len();
        let num_vertices = num_lines * run.len();
        list.firsts.extend((first..first + num_vertices).step_by(num_lines).map(|v| v as u32));
        match self.order {
            SliceOrder::FrontToBack => list.slices.extend(run.clone()),
            SliceOrder::BackToFront => list.slices.extend(run.clone().rev()),
        }
        list.positions.resize(first + num_vertices, [0.0; 3]);
        let slices = &list.slices[list.slices.len() - run.len()..];
        let positions = &mut list.positions[first..];
        match lines {
            [a, b, c, ..] if num_lines == 3 => write_polygons(&[a, b, c], slices, positions),
            [a, b, c, d, ..] if num_lines == 4 => write_polygons(&[a, b, c, d], slices, positions),
            [a, b, c, d, e, _] if num_lines == 5 => write_polygons(&[a, b, c, d, e], slices, positions),
            _ => write_polygons(&lines, slices, positions),
        }
    }

    fn line_of(&self, cut: &BoxToCut, edge: Edge) -> EdgeLine {
        let [a, b, c] = self.axes;
        let number = usize::from(edge.corner);
        let bits = ((number & 1) << a | (number >> 1 & 1) << b | (number >> 2) << c) ^ cut.first;
        let axis = self.axes[usize::from(edge.axis)];
        let [u, v] = OTHER_AXES[axis];
        let depth = cut.terms[bits >> u & 1][u] + cut.terms[bits >> v & 1][v];
        EdgeLine {
            corner: std::array::from_fn(|a| cut.bounds[bits >> a & 1][a] as f32),
            axis,
            at_origin: self.origin[axis] - depth * self.per_depth[axis],
            slope: self.slopes[axis],
            low: cut.bounds[0][axis],
            high: cut.bounds[1][axis],
        }
    }
}

/// For each axis, the two others, lower first.
const OTHER_AXES: [[usize; 2]; 3] = [[1, 2], [0, 2], [0, 1]];

/// A box, and the depths of its corners. Bit `a` of a corner's number is set where it lies on the high face of axis `a`.
struct BoxToCut {
    bounds: [[f64; 3]; 2],
    /// What each face adds to the depth of its corners.
    terms: [[f64; 3]; 2],
    nearest: usize,
    /// The corner that the planes pass first: the nearest, or the farthest.
    first: usize,
}

impl BoxToCut {
    fn new(slicer: &Slicer, bounds: [[f64; 3]; 2]) -> Self {
        let terms =
            bounds.map(|face| std::array::from_fn(|a| slicer.normal[a] * (face[a] - slicer.origin[a])));
        let nearest = (0..3).map(|a| usize::from(slicer.normal[a] < 0.0) << a).sum();
        let first = match slicer.order {
            SliceOrder::FrontToBack => nearest,
            SliceOrder::BackToFront => 7 ^ nearest,
        };
        Self { bounds, terms, nearest, first }
    }

    /// Always summed in the same order, so that boxes agree about the corners they share. Rounding cannot order two
    /// ends of an edge wrongly: sums grow with their terms.
    #[inline]
    fn depth(&self, corner: usize) -> f64 {
        self.terms[corner & 1][0] + self.terms[corner >> 1 & 1][1] + self.terms[corner >> 2][2]
    }
}

/// Where the planes cross an edge: at `at_origin + k · slope` along its axis.
#[derive(Debug, Clone, Copy, Default)]
struct EdgeLine {
    corner: [f32; 3],
    axis: usize,
    at_origin: f64,
    slope: f64,
    low: f64,
    high: f64,
}

/// Writes the polygons of slices that cross the same `N` edges.
#[inline]
fn write_polygons<const N: usize>(lines: &[EdgeLine; N], slices: &[i32], positions: &mut [[f32; 3]]) {
    let (polygons, _) = positions.as_chunks_mut::<N>();
    for (polygon, &slice) in polygons.iter_mut().zip(slices) {
        for (vertex, line) in polygon.iter_mut().zip(lines) {
            let place = line.at_origin + f64::from(slice) * line.slope;
            *vertex = line.corner;
            vertex[line.axis] = place.max(line.low).min(line.high) as f32;
        }
    }
}
