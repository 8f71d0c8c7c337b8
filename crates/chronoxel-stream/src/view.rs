//! What of the volume a camera can see, in voxel coordinates.

use chronoxel_core::{Camera, Projection, UniformGrid};

/// From where the volume is seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Eye {
    /// A perspective eye at a point, in voxel coordinates.
    At([f64; 3]),
    /// An orthographic view along a direction, in voxel coordinates.
    Along([f64; 3]),
}

impl Eye {
    /// For each axis, whether the eye is on the high side of the plane `mid`.
    fn high_side(&self, mid: [f64; 3]) -> [bool; 3] {
        std::array::from_fn(|a| match self {
            Self::At(eye) => eye[a] >= mid[a],
            Self::Along(direction) => direction[a] < 0.0,
        })
    }

    /// The octants around `mid`, front to back (bit 0 of an octant is x, bit 1 y, bit 2 z).
    ///
    /// The octant that holds the eye comes first, then those across one plane, two and three: no ray
    /// from the eye meets them in another order.
    pub fn octants_front_to_back(&self, mid: [f64; 3]) -> [u8; 8] {
        let near = self.high_side(mid).iter().rev().fold(0u8, |bits, &high| bits << 1 | u8::from(high));
        [0u8, 1, 2, 4, 3, 5, 6, 7].map(|across| near ^ across)
    }
}

/// The visible part of space: an eye and the half-spaces that bound the picture.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewVolume {
    /// Where from.
    pub eye: Eye,
    /// Half-spaces `n · p + d >= 0` as `[nx, ny, nz, d]`, in voxel coordinates.
    pub planes: Vec<[f64; 4]>,
}

impl ViewVolume {
    /// What a camera sees in a picture of `aspect` (width over height).
    pub fn of_camera(camera: &Camera, aspect: f64, grid: &UniformGrid) -> Self {
        let [right, up, forward] = camera.axes();
        let half = camera.half_height();
        let perspective = matches!(camera.projection(), Projection::Perspective { .. });
        // Each half-space as weights of (right, up, forward) and a constant, relative to the camera.
        let sides =
            [[1.0, 0.0, half * aspect], [-1.0, 0.0, half * aspect], [0.0, 1.0, half], [0.0, -1.0, half]];
        let relative = sides.map(|[r, u, reach]| match perspective {
            true => [r, u, reach, 0.0],
            false => [r, u, 0.0, reach],
        });
        let planes = relative.into_iter().chain([[0.0, 0.0, 1.0, 0.0]]).map(|[r, u, f, constant]| {
            let normal: [f64; 3] = std::array::from_fn(|a| r * right[a] + u * up[a] + f * forward[a]);
            let offset: f64 = (0..3).map(|a| normal[a] * (grid.origin[a] - camera.position()[a])).sum();
            let [x, y, z] = std::array::from_fn(|a| normal[a] * grid.spacing[a]);
            [x, y, z, constant + offset]
        });
        let eye = match perspective {
            true => Eye::At(grid.voxel_from_world(camera.position())),
            false => Eye::Along(forward),
        };
        Self { eye, planes: planes.collect() }
    }

    /// Whether a box may be visible: false only where it lies wholly outside one of the half-spaces.
    pub fn may_see(&self, [low, high]: [[f64; 3]; 2]) -> bool {
        self.planes.iter().all(|plane| {
            let farthest: f64 =
                (0..3).map(|a| plane[a] * if plane[a] >= 0.0 { high[a] } else { low[a] }).sum();
            farthest + plane[3] >= 0.0
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two octants are in the right order if no separating plane has the eye on the later one's side.
    fn hides(eye: [f64; 3], mid: [f64; 3], first: u8, second: u8) -> bool {
        (0..3).any(|a| {
            let (f, s) = (first >> a & 1, second >> a & 1);
            f != s && f == u8::from(eye[a] >= mid[a])
        })
    }

    #[test]
    fn octants_come_front_to_back_for_eyes_everywhere() {
        let mid = [8.0, 8.0, 8.0];
        for i in 0..216 {
            let eye = [i % 6, i / 6 % 6, i / 36].map(|k| f64::from(k) * 4.0 - 2.0);
            let order = Eye::At(eye).octants_front_to_back(mid);
            for (n, &first) in order.iter().enumerate() {
                assert!(order[n + 1..].iter().all(|&second| hides(eye, mid, first, second)));
            }
        }
    }

    #[test]
    fn orthographic_order_follows_the_direction() {
        let order = Eye::Along([1.0, -1.0, 1.0]).octants_front_to_back([0.0; 3]);
        assert_eq!((order[0], order[7]), (0b010, 0b101));
    }

    #[test]
    fn a_box_is_seen_exactly_where_its_corners_project() {
        let grid = UniformGrid::new([9, 9, 9], [-4.0, 2.0, 0.0], [1.0, 0.5, 2.0]).unwrap();
        for fov in [Some(30.0), None] {
            let camera = Camera::orbit(grid.bounds(), 40.0, 25.0, 3.0, fov, 1.5).unwrap();
            let view = ViewVolume::of_camera(&camera, 1.5, &grid);
            for i in 0..729 {
                let point = [i % 9, i / 9 % 9, i / 81].map(f64::from);
                let [x, y, _] = camera.project(grid.world_from_voxel(point), [150, 100]).unwrap();
                let inside = (0.0..=150.0).contains(&x) && (0.0..=100.0).contains(&y);
                assert_eq!(view.may_see([point, point]), inside, "{point:?} at {x}, {y}");
            }
        }
    }

    #[test]
    fn boxes_outside_a_half_space_are_not_seen() {
        let view = ViewVolume { eye: Eye::At([0.0; 3]), planes: vec![[1.0, 0.0, 0.0, -4.0]] };
        assert!(!view.may_see([[0.0; 3], [3.9, 9.0, 9.0]]));
        assert!(view.may_see([[0.0; 3], [4.1, 9.0, 9.0]]));
    }
}
