//! The order in which boxes of the octree are drawn: front to back.

use crate::{BrickLayout, Camera, Projection, UniformGrid};

/// Where a picture is seen from, in voxels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Eye {
    /// From a point: perspective.
    Point([f64; 3]),
    /// Along a direction: orthographic.
    Direction([f64; 3]),
}

impl Eye {
    /// That of a camera.
    pub fn of(camera: &Camera, grid: &UniformGrid) -> Self {
        match camera.projection() {
            Projection::Perspective { .. } => Self::Point(grid.voxel_from_world(camera.position())),
            Projection::Orthographic { .. } => Self::Direction(camera.axes()[2]),
        }
    }

    /// The octants around a point, front to back for every ray of the camera at once: of the two halves at each plane
    /// through the point, the one on the eye's side comes first. Bit 0 of an octant is x, bit 1 y, bit 2 z.
    pub fn octants_front_to_back(&self, middle: [f64; 3]) -> [usize; 8] {
        let is_high = |a: usize| match self {
            Self::Point(point) => point[a] >= middle[a],
            Self::Direction(direction) => direction[a] < 0.0,
        };
        let nearest: usize = (0..3).filter(|&a| is_high(a)).map(|a| 1 << a).sum();
        [0, 1, 2, 4, 3, 5, 6, 7].map(|flip| nearest ^ flip)
    }
}

/// Indices of `boxes` such that no box is hidden by one that comes after it.
///
/// The boxes are nodes of an octree or octants of them, in level-0 voxels, none overlapping another. The space is
/// halved at the planes of the octree ([`Eye::octants_front_to_back`]). The order depends on the boxes alone, not on the order they are given in.
///
/// * `boxes`: lowest and highest corner, level-0 voxels
pub fn view_order(
    boxes: &[[[f64; 3]; 2]],
    camera: &Camera,
    grid: &UniformGrid,
    layout: &BrickLayout,
) -> Vec<usize> {
    let eye = Eye::of(camera, grid);
    let top = boxes.iter().flat_map(|b| b[1]).fold(1.0, f64::max);
    let mut edge = layout.edge as f64;
    while edge < top {
        edge *= 2.0;
    }
    let mut order = Vec::with_capacity(boxes.len());
    append_front_to_back(boxes, (0..boxes.len()).collect(), [0.0; 3], edge, &eye, &mut order);
    order
}

fn append_front_to_back(
    boxes: &[[[f64; 3]; 2]],
    mut inside: Vec<usize>,
    low: [f64; 3],
    edge: f64,
    eye: &Eye,
    order: &mut Vec<usize>,
) {
    if inside.len() <= 1 || edge < 1.0 {
        inside.sort_unstable();
        return order.extend(inside);
    }
    let middle = low.map(|c| c + 0.5 * edge);
    let mut octants: [Vec<usize>; 8] = Default::default();
    for i in inside {
        let centre = |a: usize| 0.5 * (boxes[i][0][a] + boxes[i][1][a]);
        let octant = (0..3).filter(|&a| centre(a) >= middle[a]).map(|a| 1 << a).sum::<usize>();
        octants[octant].push(i);
    }
    for octant in eye.octants_front_to_back(middle) {
        let corner = std::array::from_fn(|a| if octant >> a & 1 == 1 { middle[a] } else { low[a] });
        append_front_to_back(boxes, std::mem::take(&mut octants[octant]), corner, 0.5 * edge, eye, order);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Boxes of mixed levels: all of a 128³ grid at edge 8, one octant refined further than the others.
    fn mixed_boxes() -> Vec<[[f64; 3]; 2]> {
        let mut boxes = Vec::new();
        let mut tile = |low: [f64; 3], size: f64, parts: usize| {
            let edge = size / parts as f64;
            for i in 0..parts.pow(3) {
                let at = [i % parts, i / parts % parts, i / parts / parts];
                let corner: [f64; 3] = std::array::from_fn(|a| low[a] + at[a] as f64 * edge);
                boxes.push([corner, corner.map(|c| c + edge)]);
            }
        };
        for octant in 0..8 {
            let corner = std::array::from_fn(|a| f64::from(octant >> a & 1) * 64.0);
            tile(corner, 64.0, [1, 2, 4, 8][octant as usize % 4]);
        }
        boxes
    }

    /// Entry distance of a ray into a box, if it passes through more than a face of it.
    fn entry(ray: &crate::camera::Ray, [low, high]: [[f64; 3]; 2]) -> Option<f64> {
        let (mut from, mut to) = (0.0f64, f64::INFINITY);
        for a in 0..3 {
            let t = [low[a], high[a]].map(|c| (c - ray.origin[a]) / ray.direction[a]);
            from = from.max(t[0].min(t[1]));
            to = to.min(t[0].max(t[1]));
        }
        (to - from > 1e-9).then_some(from)
    }

    #[test]
    fn every_ray_meets_the_boxes_in_order() {
        let boxes = mixed_boxes();
        let grid = UniformGrid::new([129; 3], [0.0; 3], [1.0; 3]).unwrap();
        let layout = BrickLayout::new(8).unwrap();
        let inside = Camera::new(
            [40.3, 70.2, 66.6],
            [90.0, 10.0, 20.0],
            [0.0, 1.0, 0.0],
            Projection::Perspective { fov_y_deg: 120.0 },
        );
        let orbit = |azimuth, fov| Camera::orbit(grid.bounds(), azimuth, 25.0, 1.0, fov, 1.0);
        for camera in [inside, orbit(30.0, Some(60.0)), orbit(200.0, Some(20.0)), orbit(300.0, None)] {
            let camera = camera.unwrap();
            let order = view_order(&boxes, &camera, &grid, &layout);
            let mut sorted = order.clone();
            sorted.sort_unstable();
            assert!(sorted.into_iter().eq(0..boxes.len()));
            for i in 0..400 {
                let ray = camera.ray([f64::from(i % 20) + 0.5, f64::from(i / 20) + 0.5], [20, 20]);
                let entries: Vec<f64> = order.iter().filter_map(|&b| entry(&ray, boxes[b])).collect();
                assert!(entries.is_sorted(), "{entries:?}");
            }
        }
    }
}
