//! A flight of the camera over a store at a target frame rate: from afar to where the Blunt Fin's shock meets the fin, along the fin, and away.

use std::{path::Path, time::Instant};

use chronoxel_core::{ColorMap, TransferFunction};
use chronoxel_render::ReadBack;
use serde_json::{Map, Value, json};

use super::{
    Row, Size, object,
    plot::{Line, Panel, Plot},
};
use crate::{
    interrupt,
    player::{CameraPath, Player, PlayerOptions},
    session::{Session, View},
};

/// Frames per second to hold, as the paper has them.
pub const TARGET_FPS: f64 = 10.0;
/// Pixels per voxel below which more samples would not show.
pub const FINE_ENOUGH: f64 = 1.0;
/// Where the shock meets the fin in the Blunt Fin, as shares of the box around the grid.
const GOAL: [f64; 3] = [0.353, 0.03, 0.2];

/// What the frames of a flight took.
pub struct Flight {
    size: [usize; 2],
    fps: Vec<f64>,
    num_nodes: Vec<f64>,
    pixels_per_voxel: Vec<f64>,
    most_pixels_per_voxel: Vec<f64>,
}

impl Flight {
    /// Flies over the first variable of a store, around the box of its mesh.
    ///
    /// # Errors
    /// If the store cannot be opened or drawn, or Ctrl-C was pressed.
    pub fn over(store: &Path, bounds: [[f64; 3]; 2], size: Size, memory_bytes: u64) -> anyhow::Result<Self> {
        let (num_frames, picture) = match size {
            Size::Tiny => (6, [64, 48]),
            Size::Small => (150, [640, 480]),
            Size::Full => (400, [640, 480]),
        };
        let session = Session::open(store, None, memory_bytes)?;
        let path = path_around(bounds)?;
        let view = View {
            camera: path.camera(0.0)?,
            transfer: session.resolve(&TransferFunction::built_in("ramp", ColorMap::Viridis)?)?,
            size: picture,
            step_voxels: 1.0,
            lighting: None,
            opacity_unit: session.store().header().opacity_unit(),
            level: 0,
            coherence: None,
            level_borders: Default::default(),
        };
        let num_steps = session.store().header().num_steps_finished;
        let options = PlayerOptions {
            target_fps: Some(TARGET_FPS),
            redraws: true,
            read_back: ReadBack::Bytes,
            ..PlayerOptions::default()
        };
        let mut player = Player::new(session, (0..num_steps).collect(), options)?;
        let mut flight = Self {
            size: picture,
            fps: Vec::new(),
            num_nodes: Vec::new(),
            pixels_per_voxel: Vec::new(),
            most_pixels_per_voxel: Vec::new(),
        };
        for frame in 0..num_frames {
            interrupt::check()?;
            let camera = path.camera(frame as f64 / (num_frames - 1) as f64)?;
            let view = View { camera, ..view.clone() };
            let start = Instant::now();
            let played = player.next(&view)?;
            flight.fps.push(1.0 / start.elapsed().as_secs_f64());
            flight.num_nodes.push(played.num_drawn as f64);
            flight.pixels_per_voxel.push(played.pixels_per_voxel);
            flight.most_pixels_per_voxel.push(played.most_pixels_per_voxel);
        }
        Ok(flight)
    }

    /// Rows of a table: frames per second, nodes drawn, and pixels per voxel.
    pub fn rows(&self, label: &str) -> Vec<Row> {
        let row = |name: &str, values: &[f64], mean: f64, aim: Option<(f64, f64)>| {
            let mut sorted = values.to_vec();
            sorted.sort_by(f64::total_cmp);
            let mut here = object(json!({
                "mean": mean,
                "median": sorted[sorted.len() / 2],
                "min": sorted[0],
                "max": sorted[sorted.len() - 1],
            }));
            let mut paper = Map::new();
            if let Some((aim, share)) = aim {
                paper.insert("aim".to_owned(), Value::from(aim));
                here.insert("share_met".to_owned(), Value::from(100.0 * share));
            }
            Row { label: format!("{label}: {name}"), paper, here }
        };
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        let share = |values: &[f64], is_met: &dyn Fn(f64) -> bool| {
            values.iter().filter(|v| is_met(**v)).count() as f64 / values.len() as f64
        };
        let secs: f64 = self.fps.iter().map(|fps| 1.0 / fps).sum();
        let in_time = share(&self.fps, &|fps| fps >= TARGET_FPS);
        let is_fine = |pixels: f64| pixels <= FINE_ENOUGH;
        let (fine, all_fine) =
            (share(&self.pixels_per_voxel, &is_fine), share(&self.most_pixels_per_voxel, &is_fine));
        vec![
            row("frames per second", &self.fps, self.fps.len() as f64 / secs, Some((TARGET_FPS, in_time))),
            row("nodes drawn", &self.num_nodes, mean(&self.num_nodes), None),
            row(
                "pixels per voxel, mean of nodes",
                &self.pixels_per_voxel,
                mean(&self.pixels_per_voxel),
                Some((FINE_ENOUGH, fine)),
            ),
            row(
                "pixels per voxel, largest",
                &self.most_pixels_per_voxel,
                mean(&self.most_pixels_per_voxel),
                Some((FINE_ENOUGH, all_fine)),
            ),
        ]
    }

    /// The three of them over the path.
    pub fn plot(&self, file: String, label: &str) -> Plot {
        let line = |name: &str, values: &[f64]| Line { name: name.to_owned(), values: values.to_vec() };
        let panel = |label: &str, lines, mark: Option<(f64, &str)>, is_log| Panel {
            label: label.to_owned(),
            lines,
            mark: mark.map(|(value, name)| (value, name.to_owned())),
            is_log,
        };
        let [width, height] = self.size;
        Plot {
            file,
            title: format!(
                "Flight over {label}, {width} x {height} pixels, target {TARGET_FPS} frames per second"
            ),
            x_label: "frame of the flight".to_owned(),
            x_step: 1.0,
            panels: vec![
                panel("frame rate (1/s)", vec![line("", &self.fps)], Some((TARGET_FPS, "target")), true),
                panel("nodes drawn (number)", vec![line("", &self.num_nodes)], None, false),
                panel(
                    "voxel edge (pixels)",
                    vec![
                        line("mean of nodes", &self.pixels_per_voxel),
                        line("largest", &self.most_pixels_per_voxel),
                    ],
                    Some((FINE_ENOUGH, "1 pixel")),
                    true,
                ),
            ],
        }
    }
}

/// Half the diagonal of a box.
fn radius([low, high]: [[f64; 3]; 2]) -> f64 {
    (0..3).map(|a| (high[a] - low[a]).powi(2)).sum::<f64>().sqrt() / 2.0
}

/// The flight around a box.
fn path_around(bounds: [[f64; 3]; 2]) -> anyhow::Result<CameraPath> {
    let [low, high] = bounds;
    let at = |shares: [f64; 3]| std::array::from_fn(|a| low[a] + shares[a] * (high[a] - low[a]));
    let (centre, goal): ([f64; 3], [f64; 3]) = (at([0.5; 3]), at(GOAL));
    let radius = radius(bounds);
    let away = |from: [f64; 3], direction: [f64; 3], radii: f64| -> [f64; 3] {
        let length = direction.iter().map(|c| c * c).sum::<f64>().sqrt();
        std::array::from_fn(|a| from[a] + direction[a] / length * radii * radius)
    };
    let key = |place: f64, position: [f64; 3], look_at: [f64; 3]| json!({"at": place, "position": position, "look_at": look_at, "up": [0.0, 0.0, 1.0], "fov_y_deg": 30.0});
    let keys = [
        key(0.0, away(centre, [-0.5, 0.8, 0.5], 5.0), centre),
        key(0.25, away(centre, [-0.6, 0.7, 0.5], 2.2), centre),
        key(0.45, away(goal, [-0.7, 0.6, 0.5], 0.5), goal),
        key(0.6, away(goal, [-0.8, 0.5, 0.3], 0.12), goal),
        key(0.75, away(goal, [-0.2, 1.0, 0.5], 0.5), at([0.6, 0.05, 0.2])),
        key(1.0, away(centre, [0.6, 0.8, 0.6], 4.0), centre),
    ];
    CameraPath::from_json(&json!({ "keys": keys }).to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_flight_leads_into_the_box_and_out_again() {
        let bounds = [[-7.8, 0.0, 0.0], [14.4, 8.3, 5.7]];
        let path = path_around(bounds).unwrap();
        let is_inside = |at: f64| {
            let position = path.camera(at).unwrap().position();
            (0..3).all(|a| (bounds[0][a]..=bounds[1][a]).contains(&position[a]))
        };
        assert!(!is_inside(0.0) && is_inside(0.6) && !is_inside(1.0));
    }
}
