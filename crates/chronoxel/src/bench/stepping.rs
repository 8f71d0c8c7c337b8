//! Stepping through a store with the renderer: frames per second, and what a new step costs before it is drawn.

use std::{path::Path, time::Instant};

use chronoxel_core::{Camera, ColorMap, TransferFunction, UniformGrid};

use crate::{
    interrupt,
    process::forget_cached_files,
    session::{Session, View, orbit_camera},
};

/// Size of the pictures, as in lum2001.
pub(super) const SIZE: [usize; 2] = [512, 512];
/// Share of the picture that the box of the volume covers at most.
const SHARE: f64 = 1.0 / 3.0;
const AZIMUTH_DEG: f64 = 30.0;
const ELEVATION_DEG: f64 = 20.0;
const FOV_Y_DEG: f64 = 30.0;
/// One sample per slice, as slices drawn as polygons have it.
pub(super) const STEP_VOXELS: f64 = 1.0;

/// What stepping through a store took.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stepping {
    /// Frames per second, a new step each, all of them in memory.
    pub fps_in_core: f64,
    /// Steps that are in memory at once.
    pub num_steps_in_core: usize,
    /// Frames per second, a new step each, read and decoded for it.
    pub fps_out_of_core: f64,
    /// Bytes read for a new step.
    pub bytes_per_step: f64,
    /// Time to select, read and decode a new step, in milliseconds.
    pub fetch_ms_per_step: f64,
    /// Share of the picture that the box of the volume covers.
    pub window_share: f64,
}

impl Stepping {
    /// Frames that [`Self::measure`] draws of a store of so many steps, at most.
    pub const fn num_frames(num_steps: usize) -> u64 {
        3 * num_steps as u64
    }

    /// Steps through a store twice: first as it lies on disk, then through the steps that fit memory.
    ///
    /// # Errors
    /// If a step cannot be drawn, or Ctrl-C was pressed.
    pub fn measure(store: &Path, memory_bytes: u64, on_frame: &mut dyn FnMut()) -> anyhow::Result<Self> {
        forget_cached_files(store);
        let mut session = Session::open(store, None, memory_bytes)?;
        let grid = session.store().header().grid;
        let num_steps = session.store().header().num_steps_finished as usize;
        let (camera, window_share) = camera_for_share(&grid)?;
        let view = View {
            camera,
            transfer: session.resolve(&TransferFunction::built_in("ramp", ColorMap::Viridis)?)?,
            size: SIZE,
            step_voxels: STEP_VOXELS,
            lighting: None,
            opacity_unit: grid.smallest_spacing(),
            level: 0,
            coherence: None,
            level_borders: Default::default(),
        };
        let mut draw = |session: &mut Session, step: usize| {
            interrupt::check()?;
            let picture = session.draw(&view, step)?;
            on_frame();
            anyhow::Ok(picture.fetch_ms)
        };

        draw(&mut session, 0)?;
        let bytes_before = session.bytes_from_disk();
        let new_steps = 1.min(num_steps - 1)..num_steps;
        let num_new = new_steps.len() as f64;
        let (fps_out_of_core, fetch_ms) = timed(new_steps, |step| draw(&mut session, step))?;
        let bytes_per_step = (session.bytes_from_disk() - bytes_before) as f64 / num_new;

        let num_steps_in_core = session.num_resident_steps().clamp(1, num_steps);
        for step in 0..num_steps_in_core {
            draw(&mut session, step)?;
        }
        let (fps_in_core, _) = timed(0..num_steps_in_core, |step| draw(&mut session, step))?;
        Ok(Self {
            fps_in_core,
            num_steps_in_core,
            fps_out_of_core,
            bytes_per_step,
            fetch_ms_per_step: fetch_ms / num_new,
            window_share,
        })
    }
}

/// Frames per second over some steps, and the sum of the times to fetch them.
fn timed(
    steps: std::ops::Range<usize>,
    mut draw: impl FnMut(usize) -> anyhow::Result<f64>,
) -> anyhow::Result<(f64, f64)> {
    let start = Instant::now();
    let num_frames = steps.len() as f64;
    let mut fetch_ms = 0.0;
    for step in steps {
        fetch_ms += draw(step)?;
    }
    Ok((num_frames / start.elapsed().as_secs_f64(), fetch_ms))
}

/// A camera that shows all of a grid's box as large as possible, but not over [`SHARE`] of the picture; and its share.
pub(super) fn camera_for_share(grid: &UniformGrid) -> anyhow::Result<(Camera, f64)> {
    let at_zoom = |zoom: f64| {
        let camera = orbit_camera(grid, [AZIMUTH_DEG, ELEVATION_DEG], zoom, Some(FOV_Y_DEG), SIZE)?;
        let share = covered_share(&camera, grid);
        anyhow::Ok((camera, share))
    };
    // A zoom of 1 shows the whole box.
    let (mut low, mut high) = (0.01, 4.0);
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        match at_zoom(middle)?.1 {
            Some(share) if share <= SHARE => low = middle,
            _ => high = middle,
        }
    }
    let (camera, share) = at_zoom(low)?;
    Ok((camera, share.unwrap_or(0.0)))
}

/// Share of the picture that the outline of a box covers; `None` unless the whole box is in the picture.
fn covered_share(camera: &Camera, grid: &UniformGrid) -> Option<f64> {
    let bounds = grid.bounds();
    let [width, height] = SIZE.map(|n| n as f64);
    let mut corners = Vec::new();
    for corner in 0..8usize {
        let world = std::array::from_fn(|axis| bounds[corner >> axis & 1][axis]);
        let [x, y, _] = camera.project(world, SIZE)?;
        if !(0.0..=width).contains(&x) || !(0.0..=height).contains(&y) {
            return None;
        }
        corners.push([x, y]);
    }
    Some(hull_area(&mut corners) / (width * height))
}

/// Area of the convex hull of points in the plane (Andrew's monotone chain).
fn hull_area(points: &mut [[f64; 2]]) -> f64 {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    let turn =
        |o: [f64; 2], a: [f64; 2], b: [f64; 2]| (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0]);
    let chain = |points: &mut dyn Iterator<Item = [f64; 2]>| {
        let mut chain: Vec<[f64; 2]> = Vec::new();
        for point in points {
            while chain.len() > 1 && turn(chain[chain.len() - 2], chain[chain.len() - 1], point) <= 0.0 {
                chain.pop();
            }
            chain.push(point);
        }
        chain
    };
    let hull = [chain(&mut points.iter().copied()), chain(&mut points.iter().rev().copied())].concat();
    let shoelace = |(i, a): (usize, &[f64; 2])| {
        let b = hull[(i + 1) % hull.len()];
        a[0] * b[1] - a[1] * b[0]
    };
    0.5 * hull.iter().enumerate().map(shoelace).sum::<f64>().abs()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn areas_of_hulls() {
        let mut square = [[0.0, 0.0], [2.0, 0.0], [1.0, 1.0], [2.0, 2.0], [0.0, 2.0]];
        assert_eq!(hull_area(&mut square), 4.0);
        let mut triangle = [[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]];
        assert_eq!(hull_area(&mut triangle), 6.0);
    }

    #[test]
    fn a_cube_covers_a_third_and_a_long_box_what_it_can() {
        let grid = |dims| UniformGrid::new(dims, [0.0; 3], [1.0; 3]).unwrap();
        let (_, share) = camera_for_share(&grid([64; 3])).unwrap();
        assert!((share - SHARE).abs() < 1e-6, "{share}");
        let (_, share) = camera_for_share(&grid([640, 16, 16])).unwrap();
        assert!((0.01..0.2).contains(&share), "{share}");
    }
}
