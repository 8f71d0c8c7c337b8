//! Camera paths: key frames, and the cameras between them.

use std::path::Path;

use anyhow::{Context, bail, ensure};
use chronoxel_core::{Camera, Projection};
use serde_json::Value;

/// A flight of the camera over a series of frames.
#[derive(Debug, Clone)]
pub struct CameraPath {
    /// Places on the path, in [0, 1] and increasing, and the camera there.
    keys: Vec<(f64, Camera)>,
}

/// Most key frames: more are a mistake.
const MOST_KEYS: usize = 10_000;

impl CameraPath {
    /// Reads `{"keys": [{"at": 0.0, "position": …, "look_at": …, …}, …]}`: cameras as camera files have them, each with its place on the
    /// path; without places they are spread evenly.
    ///
    /// # Errors
    /// If the text is no such path: the message says which key frame, and what it needs.
    pub fn from_json(text: &str) -> anyhow::Result<Self> {
        let value: Value = serde_json::from_str(text).context("not JSON")?;
        let keys = value.get("keys").and_then(Value::as_array).context("\"keys\": give a list of cameras")?;
        ensure!(
            (2..=MOST_KEYS).contains(&keys.len()),
            "\"keys\": {} of them: give 2 to {MOST_KEYS}",
            keys.len()
        );
        let num_placed = keys.iter().filter(|key| key.get("at").is_some()).count();
        ensure!(
            num_placed == 0 || num_placed == keys.len(),
            "\"at\": give it for every key frame, or for none"
        );
        let mut path: Vec<(f64, Camera)> = Vec::with_capacity(keys.len());
        for (number, key) in keys.iter().enumerate() {
            let what = || format!("key frame {number}");
            let mut camera = key.as_object().with_context(what)?.clone();
            let at = match camera.remove("at") {
                None => number as f64 / (keys.len() - 1) as f64,
                Some(at) => at
                    .as_f64()
                    .with_context(|| format!("key frame {number}: \"at\" is {at}: give a number"))?,
            };
            ensure!(
                (0.0..=1.0).contains(&at),
                "key frame {number}: \"at\" is {at}: give a number from 0 to 1"
            );
            if let Some((before, _)) = path.last().filter(|(before, _)| *before >= at) {
                bail!("key frame {number}: \"at\" is {at}, after {before}: they must increase");
            }
            let camera = Camera::from_json(&Value::Object(camera).to_string()).with_context(what)?;
            let is_same_kind = |(_, first): &(f64, Camera)| {
                std::mem::discriminant(&first.projection()) == std::mem::discriminant(&camera.projection())
            };
            ensure!(
                path.first().is_none_or(is_same_kind),
                "key frame {number}: give fov_y_deg, or ortho_height, for all"
            );
            path.push((at, camera));
        }
        Ok(Self { keys: path })
    }

    /// Reads a path from a file.
    ///
    /// # Errors
    /// As [`Self::from_json`], naming the file; or if it cannot be read.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let text =
            std::fs::read_to_string(path).with_context(|| format!("{}: cannot read", path.display()))?;
        Self::from_json(&text).with_context(|| path.display().to_string())
    }

    /// The camera at a place on the path: on a smooth curve (Catmull-Rom) through the key frames around it.
    ///
    /// * `at`: in [0, 1]; before the first key frame and after the last the camera stands still
    ///
    /// # Errors
    /// If the camera between two key frames cannot be, such as one that looks along its own up vector.
    pub fn camera(&self, at: f64) -> anyhow::Result<Camera> {
        let after = self.keys.partition_point(|(place, _)| *place <= at);
        if after == 0 || after == self.keys.len() {
            return Ok(self.keys[after.saturating_sub(1)].1);
        }
        let key = |number: usize| &self.keys[number.min(self.keys.len() - 1)];
        let around = [key(after.saturating_sub(2)), key(after - 1), key(after), key(after + 1)];
        let u = (at - around[1].0) / (around[2].0 - around[1].0);
        let between =
            |value: &dyn Fn(&Camera) -> f64| smooth(around.map(|(place, camera)| (*place, value(camera))), u);
        let vector =
            |value: fn(&Camera) -> [f64; 3]| std::array::from_fn(|a| between(&|camera| value(camera)[a]));
        let projection = match around[1].1.projection() {
            Projection::Perspective { .. } => {
                Projection::Perspective { fov_y_deg: between(&extent).clamp(0.001, 179.0) }
            }
            Projection::Orthographic { .. } => {
                Projection::Orthographic { height: between(&extent).max(f64::MIN_POSITIVE) }
            }
        };
        let position = vector(Camera::position);
        let camera = Camera::new(position, vector(Camera::look_at), vector(Camera::up), projection);
        camera.with_context(|| format!("the camera at {at} of its path"))
    }
}

/// Angle or height of the picture.
fn extent(camera: &Camera) -> f64 {
    match camera.projection() {
        Projection::Perspective { fov_y_deg } => fov_y_deg,
        Projection::Orthographic { height } => height,
    }
}

/// A cubic through the second and the third of four points, its slopes there those of the chords between their neighbours.
///
/// * `u`: from the second point (0) to the third (1)
fn smooth(points: [(f64, f64); 4], u: f64) -> f64 {
    let [(t0, p0), (t1, p1), (t2, p2), (t3, p3)] = points;
    let slope =
        |(ta, pa): (f64, f64), (tb, pb): (f64, f64)| if tb > ta { (pb - pa) / (tb - ta) } else { 0.0 };
    let (m1, m2) = (slope((t0, p0), (t2, p2)) * (t2 - t1), slope((t1, p1), (t3, p3)) * (t2 - t1));
    let (u2, u3) = (u * u, u * u * u);
    (2.0 * u3 - 3.0 * u2 + 1.0) * p1 + (u3 - 2.0 * u2 + u) * m1 + (3.0 * u2 - 2.0 * u3) * p2 + (u3 - u2) * m2
}

#[cfg(test)]
mod tests {
    use super::*;

    fn path(ats: [&str; 3]) -> String {
        let key = |at: &str, x: f64| {
            format!(r#"{{{at}"position":[{x},0,10],"look_at":[{x},0,0],"up":[0,1,0],"fov_y_deg":30}}"#)
        };
        format!(r#"{{"keys":[{},{},{}]}}"#, key(ats[0], 0.0), key(ats[1], 1.0), key(ats[2], 4.0))
    }

    #[test]
    fn cameras_pass_through_their_key_frames() {
        let path = CameraPath::from_json(&path([r#""at":0.1,"#, r#""at":0.5,"#, r#""at":0.9,"#])).unwrap();
        let x = |at: f64| path.camera(at).unwrap().position()[0];
        for (at, place) in [(0.0, 0.0), (0.1, 0.0), (0.5, 1.0), (0.9, 4.0), (1.0, 4.0)] {
            assert!((x(at) - place).abs() < 1e-12, "{at}: {}", x(at));
        }
        assert!(x(0.3) > 0.0 && x(0.3) < 1.0 && x(0.7) > 1.0 && x(0.7) < 4.0);
        // The slope at a key frame is the same from both sides.
        let (before, after) = ((x(0.5) - x(0.4999)) / 1e-4, (x(0.5001) - x(0.5)) / 1e-4);
        assert!((before - after).abs() < 1e-2, "{before} {after}");
    }

    #[test]
    fn what_is_no_path_is_refused() {
        assert!(CameraPath::from_json(&path(["", "", ""])).is_ok());
        for (ats, problem) in [
            ([r#""at":0.1,"#, "", ""], "every key frame"),
            ([r#""at":0.5,"#, r#""at":0.1,"#, r#""at":0.9,"#], "must increase"),
            ([r#""at":0.5,"#, r#""at":0.7,"#, r#""at":1.9,"#], "from 0 to 1"),
        ] {
            let error = format!("{:#}", CameraPath::from_json(&path(ats)).unwrap_err());
            assert!(error.contains(problem), "{error}");
        }
        for text in ["", "[]", r#"{"keys":[1,2]}"#, r#"{"keys":[]}"#] {
            assert!(CameraPath::from_json(text).is_err(), "{text}");
        }
    }
}
