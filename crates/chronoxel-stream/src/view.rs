//! What of the volume a camera can see, in voxel coordinates.

use chronoxel_core::{Camera, Projection, UniformGrid};

/// The visible part of space: a camera and the half-spaces that bound its picture.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewVolume {
    /// From where it is seen.
    pub camera: Camera,
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
        Self { camera: *camera, planes: planes.collect() }
    }

    /// Whether a box may be visible: false only where it lies wholly outside one of the half-spaces.
    pub fn may_see(&self, [low, high]: [[f64; 3]; 2]) -> bool {
        self.planes.iter().all(|plane| {
            let farthest: f64 =
                (0..3).map(|a| plane[a] * if plane[a] >= 0.0 { high[a] } else { low[a] }).sum();
            farthest + plane[3] >= 0.0
        })
    }

    /// Pixels that a voxel of a level is wide in the picture where a box is nearest to the camera: the screen-space error of leven2002, section 5.1.
    ///
    /// Nearer than one voxel counts as one voxel away.
    ///
    /// * `region`: the box, in voxels of the grid
    /// * `height`: of the picture in pixels
    pub fn pixels_per_voxel(
        &self,
        region: [[f64; 3]; 2],
        level: u8,
        grid: &UniformGrid,
        height: usize,
    ) -> f64 {
        let voxel = grid.spacing.into_iter().fold(0.0, f64::max) * f64::from(level).exp2();
        let half = self.camera.half_height();
        let visible_height = match self.camera.projection() {
            Projection::Orthographic { .. } => 2.0 * half,
            Projection::Perspective { .. } => 2.0 * half * self.nearest_depth(region, grid).max(voxel),
        };
        voxel * height as f64 / visible_height
    }

    /// Least distance of a box from the camera along the direction of view, in world units; negative behind the camera.
    pub fn nearest_depth(&self, region: [[f64; 3]; 2], grid: &UniformGrid) -> f64 {
        let [_, _, forward] = self.camera.axes();
        (0..3)
            .map(|a| {
                let along = forward[a] * grid.spacing[a];
                let nearest = region[usize::from(along < 0.0)][a];
                along * nearest + forward[a] * (grid.origin[a] - self.camera.position()[a])
            })
            .sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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

    /// Against where the two ends of a voxel, put across the line of sight, come to lie in the picture.
    #[test]
    fn pixels_per_voxel_are_those_of_the_projection() {
        let grid = UniformGrid::new([65, 65, 65], [-4.0, 2.0, 0.0], [1.0, 0.5, 0.5]).unwrap();
        for (fov, distance) in [(Some(30.0), 1.0), (Some(70.0), 1.0), (None, 1.0)] {
            let camera = Camera::orbit(grid.bounds(), 40.0, 25.0, distance, fov, 1.5).unwrap();
            let view = ViewVolume::of_camera(&camera, 1.5, &grid);
            let region = [[8.0, 16.0, 8.0], [24.0, 32.0, 24.0]];
            let corners = (0..8).map(|i| std::array::from_fn(|a| region[i >> a & 1][a]));
            let worlds: Vec<[f64; 3]> = corners.map(|c| grid.world_from_voxel(c)).collect();
            let nearest =
                worlds.iter().map(|w| camera.project(*w, [300, 200]).unwrap()[2]).fold(f64::MAX, f64::min);
            assert!((view.nearest_depth(region, &grid) - nearest).abs() < 1e-9);
            let at = |offset: f64| {
                let [right, _, forward] = camera.axes();
                let p = camera.position();
                let world = std::array::from_fn(|a| p[a] + nearest * forward[a] + offset * right[a]);
                camera.project(world, [300, 200]).unwrap()[0]
            };
            // A voxel of level 2 is four times the longest edge of one of the grid.
            let found = view.pixels_per_voxel(region, 2, &grid, 200);
            assert!((found - (at(4.0) - at(0.0))).abs() < 1e-9, "{found}");
        }
    }

    #[test]
    fn pixels_per_voxel_stay_finite_around_the_eye() {
        let grid = UniformGrid::new([9; 3], [0.0; 3], [1.0; 3]).unwrap();
        let projection = Projection::Perspective { fov_y_deg: 90.0 };
        let camera = Camera::new([4.0; 3], [9.0, 4.0, 4.0], [0.0, 1.0, 0.0], projection).unwrap();
        let view = ViewVolume::of_camera(&camera, 1.0, &grid);
        assert!((view.pixels_per_voxel([[0.0; 3], [8.0; 3]], 0, &grid, 100) - 50.0).abs() < 1e-9);
    }
}
