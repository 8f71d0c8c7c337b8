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
    /// Its corners: along each axis of the box, whether on the low or the high face.
    corners: [[usize; 3]; 8],
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
        // From the corner nearest to the eye, x, y and z appear clockwise where all of them lead away from it; so they
        // do at the farthest corner, from which they lead the other way.
        let is_falling = normal.map(|n| n < 0.0);
        let axes = if is_falling.iter().filter(|f| **f).count() % 2 == 0 { [0, 2, 1] } else { [0, 1, 2] };
        let is_high = is_falling.map(|f| f != (order == SliceOrder::BackToFront));
        Ok(Self {
            normal,
            origin,
            distance,
            per_distance: 1.0 / distance,
            order,
            first_slice: i32::MIN,
            axes,
            corners: std::array::from_fn(|number| corner_of(number, axes, is_high)),
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
        check_bounds(bounds)?;
        if (0..3).any(|a| bounds[0][a] >= bounds[1][a]) {
            return Ok(0);
        }
        let cut = BoxToCut::new(self, bounds);
        let slices = self.slices_of(&cut, list)?;
        if !slices.is_empty() {
            self.sweep(&cut, slices.clone(), list);
        }
        Ok(slices.len())
    }

    /// The numbers of the slices that [`Self::slice`] gives of a box.
    ///
    /// # Errors
    /// As [`Self::slice`].
    pub fn numbers(&self, bounds: [[f64; 3]; 2]) -> Result<Range<i32>, RenderError> {
        check_bounds(bounds)?;
        if (0..3).any(|a| bounds[0][a] >= bounds[1][a]) {
            return Ok(0..0);
        }
        self.slices_of(&BoxToCut::new(self, bounds), &SliceList::default())
    }

    /// The slices of a box.
    #[inline]
    fn slices_of(&self, cut: &BoxToCut, list: &SliceList) -> Result<Range<i32>, RenderError> {
        let remedy = "give a larger slice distance, or smaller boxes";
        let [a, b] = [cut.depths[0], cut.depths[7]];
        let magnitude = a.abs().max(b.abs()) * self.per_distance;
        if magnitude > MAX_SLICE {
            return Err(RenderError::invalid("number of slices up to a box", magnitude, remedy));
        }
        let slices = self.first_at(a.min(b)).max(self.first_slice)..self.first_at(a.max(b));
        let num_slices = slices.len();
        if num_slices > MAX_SLICES_PER_BOX {
            return Err(RenderError::invalid("number of slices of a box", num_slices, remedy));
        }
        if u32::try_from(list.positions.len() + MAX_EDGES * num_slices).is_err() {
            let remedy = "draw the list and clear it, or give a larger slice distance";
            return Err(RenderError::invalid("number of vertices of slices", list.positions.len(), remedy));
        }
        Ok(slices)
    }

    /// The first plane at a depth or beyond, which passes a corner there: the least `k` whose `k · distance`, rounded,
    /// is not below. It follows from the depth alone, so that boxes agree about the corners they share.
    #[inline]
    fn first_at(&self, depth: f64) -> i32 {
        // Rounded towards zero, it is never far below; `ceil` is a call where the processor's kind is not known.
        let k = (depth * self.per_distance) as i32 - 1;
        let is_before = |k: i32| i32::from(f64::from(k) * self.distance < depth);
        k + is_before(k) + is_before(k + 1) + is_before(k + 2)
    }

    /// Passes the corners of a box one after another, and writes the slices between each and the next.
    fn sweep(&self, cut: &BoxToCut, slices: Range<i32>, list: &mut SliceList) {
        let corners = self.corners_in_order(cut);
        let mut active = ActiveEdges::default();
        let mut lines = [EdgeLine::default(); MAX_EDGES];
        for pair in corners.windows(2) {
            active.pass((pair[0] & 7) as u8, |place, edge| lines[place] = self.line_of(cut, edge));
            // Below the corner's number is the first plane that has passed it, or before which it has been passed.
            let [from, to] = [(pair[0] >> 3) as i32, (pair[1] >> 3) as i32];
            let run = match self.order {
                SliceOrder::FrontToBack => from.max(slices.start)..to,
                SliceOrder::BackToFront => (1 - to).max(slices.start)..1 - from,
            };
            if !run.is_empty() {
                self.write_run(cut, &active, &lines, run, list);
            }
        }
    }

    /// The corners in the order in which the planes pass them, as numbers of [`ActiveEdges`], below what they are
    /// sorted by: the first plane that has passed them, planes being counted downwards from back to front. Where
    /// several are passed at once, those with fewer bits come first, since their numbers are smaller.
    #[inline]
    fn corners_in_order(&self, cut: &BoxToCut) -> [i64; 8] {
        sorted_between(std::array::from_fn(|number| {
            let first = self.first_at(cut.depths[number]);
            let key = match self.order {
                SliceOrder::FrontToBack => first,
                SliceOrder::BackToFront => 1 - first,
            };
            i64::from(key) << 3 | number as i64
        }))
    }

    #[inline]
    fn line_of(&self, cut: &BoxToCut, edge: Edge) -> EdgeLine {
        let axis = self.axes[usize::from(edge.axis)];
        let term = |i: usize| cut.terms[i][usize::from(edge.corner >> i & 1)];
        let depth = match edge.axis {
            0 => term(1) + term(2),
            1 => term(2) + term(0),
            _ => term(0) + term(1),
        };
        EdgeLine {
            at_origin: self.origin[axis] - depth * self.per_depth[axis],
            corner: cut.vertices[usize::from(edge.corner)],
            axis: axis as u32,
        }
    }

    /// Writes slices that cross the same edges.
    fn write_run(
        &self,
        cut: &BoxToCut,
        active: &ActiveEdges,
        lines: &[EdgeLine; MAX_EDGES],
        run: Range<i32>,
        list: &mut SliceList,
    ) {
        let (num_slices, first) = (run.len(), list.positions.len());
        list.firsts.extend((0..num_slices).map(|i| (first + i * active.len()) as u32));
        match self.order {
            SliceOrder::FrontToBack => list.slices.extend(run),
            SliceOrder::BackToFront => list.slices.extend(run.rev()),
        }
        list.positions.resize(first + num_slices * active.len(), [0.0; 3]);
        let slices = &list.slices[list.slices.len() - num_slices..];
        let positions = &mut list.positions[first..];
        match active.len() {
            3 => write_polygons::<3>(cut, active, lines, slices, positions),
            4 => write_polygons::<4>(cut, active, lines, slices, positions),
            5 => write_polygons::<5>(cut, active, lines, slices, positions),
            _ => write_polygons::<6>(cut, active, lines, slices, positions),
        }
    }
}

fn check_bounds(bounds: [[f64; 3]; 2]) -> Result<(), RenderError> {
    if bounds.as_flattened().iter().all(|c| c.abs() <= MAX_COORDINATE) {
        return Ok(());
    }
    let remedy = "each coordinate must be a number below 1e30";
    Err(RenderError::invalid("box to slice", format!("{bounds:?}"), remedy))
}

/// On which faces the corner of a number lies, given those of corner 0: bit `i` puts it on the other face of `axes[i]`.
fn corner_of(number: usize, axes: [usize; 3], is_high: [bool; 3]) -> [usize; 3] {
    let mut corner = is_high.map(usize::from);
    (0..3).for_each(|i| corner[axes[i]] ^= number >> i & 1);
    corner
}

/// A box, and what its slices have in common.
struct BoxToCut {
    /// What each face adds to the depth of its corners: for each axis of [`ActiveEdges`], that of the first corner, and
    /// the other.
    terms: [[f64; 2]; 3],
    /// Depths and places of the corners, by the numbers of [`ActiveEdges`].
    depths: [f64; 8],
    vertices: [[f32; 3]; 8],
    axes: [EdgeAxis; 3],
}

/// What edges along an axis have in common.
struct EdgeAxis {
    slope: f64,
    low: f64,
    high: f64,
}

impl BoxToCut {
    /// Depths are always summed in the same order, so that boxes agree about the corners they share. Rounding cannot
    /// order two ends of an edge wrongly: sums grow with their terms.
    #[inline]
    fn new(slicer: &Slicer, bounds: [[f64; 3]; 2]) -> Self {
        let terms: [[f64; 3]; 2] =
            bounds.map(|face| std::array::from_fn(|a| slicer.normal[a] * (face[a] - slicer.origin[a])));
        let rounded = bounds.map(|face| face.map(|c| c as f32));
        let is_high = slicer.corners[0];
        Self {
            terms: slicer.axes.map(|a| [terms[is_high[a] & 1][a], terms[1 - (is_high[a] & 1)][a]]),
            depths: slicer.corners.map(|[x, y, z]| terms[x & 1][0] + terms[y & 1][1] + terms[z & 1][2]),
            vertices: slicer
                .corners
                .map(|[x, y, z]| [rounded[x & 1][0], rounded[y & 1][1], rounded[z & 1][2]]),
            axes: std::array::from_fn(|a| EdgeAxis {
                slope: slicer.slopes[a],
                low: bounds[0][a],
                high: bounds[1][a],
            }),
        }
    }
}

/// Where the planes cross an edge: at `at_origin + k · slope` along its axis.
#[derive(Debug, Clone, Copy, Default)]
struct EdgeLine {
    at_origin: f64,
    corner: [f32; 3],
    axis: u32,
}

/// Sorts the keys between the first and the last, which are the least and the greatest, by a network of comparisons.
#[inline]
fn sorted_between(mut keys: [i64; 8]) -> [i64; 8] {
    const NETWORK: [[usize; 2]; 12] =
        [[1, 6], [2, 4], [3, 5], [2, 3], [4, 5], [1, 4], [3, 6], [1, 2], [3, 4], [5, 6], [2, 3], [4, 5]];
    for [i, j] in NETWORK {
        (keys[i], keys[j]) = (keys[i].min(keys[j]), keys[i].max(keys[j]));
    }
    keys
}

/// Writes the polygons of slices that cross the same `N` edges.
#[inline]
fn write_polygons<const N: usize>(
    cut: &BoxToCut,
    active: &ActiveEdges,
    lines: &[EdgeLine; MAX_EDGES],
    slices: &[i32],
    positions: &mut [[f32; 3]],
) {
    let mut ring = [EdgeLine::default(); N];
    ring.iter_mut().zip(active.places()).for_each(|(line, place)| *line = lines[place]);
    let (polygons, _) = positions.as_chunks_mut::<N>();
    for (polygon, &slice) in polygons.iter_mut().zip(slices) {
        for (vertex, line) in polygon.iter_mut().zip(&ring) {
            let axis = line.axis as usize;
            let EdgeAxis { slope, low, high } = cut.axes[axis];
            let place = line.at_origin + f64::from(slice) * slope;
            // Both are one instruction, which `max` and `min` are not for the sake of numbers that cannot be here.
            let place = if place > low { place } else { low };
            let place = if place < high { place } else { high };
            *vertex = line.corner;
            vertex[axis] = place as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_those_of_the_slices() {
        for order in [SliceOrder::FrontToBack, SliceOrder::BackToFront] {
            let slicer = Slicer::new([0.3, -0.5, 0.8], [1.0, 2.0, 3.0], 0.37, order).unwrap();
            for bounds in
                [[[0.0; 3], [8.0; 3]], [[-5.0, 3.0, 2.0], [-4.9, 3.1, 2.05]], [[1.0; 3], [1.0, 2.0, 2.0]]]
            {
                let mut list = SliceList::default();
                slicer.slice(bounds, &mut list).unwrap();
                let mut slices = list.slices().to_vec();
                slices.sort_unstable();
                assert_eq!(slicer.numbers(bounds).unwrap().collect::<Vec<_>>(), slices);
            }
            assert!(slicer.numbers([[0.0; 3], [f64::NAN; 3]]).is_err());
        }
    }

    #[test]
    fn the_network_sorts() {
        // A network that sorts all sequences of two values sorts all sequences.
        for bits in 0..64 {
            let bit = |i: i64| bits >> (i - 1) & 1;
            let keys = [-1, bit(1), bit(2), bit(3), bit(4), bit(5), bit(6), 2];
            assert!(sorted_between(keys).is_sorted(), "{keys:?}");
        }
    }
}
