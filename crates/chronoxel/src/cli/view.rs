//! The options that say what a picture shows: variable, camera, transfer function, size.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

use super::args::{parse_finite, parse_not_negative, parse_picture_size, parse_positive};

/// Options of `render`, `movie` and `play`.
#[derive(Debug, Clone, Args)]
pub struct ViewArgs {
    /// Variable to draw [default: the first]
    #[arg(long, value_name = "NAME")]
    pub variable: Option<String>,
    /// Picture size in pixels
    #[arg(long, value_name = "WxH", default_value = "1024x768", value_parser = parse_picture_size)]
    pub size: [usize; 2],
    #[command(flatten)]
    pub camera: CameraArgs,
    #[command(flatten)]
    pub transfer: TransferArgs,
    /// Distance between samples along a ray, in voxels
    #[arg(long, value_name = "VOXELS", default_value_t = 0.5, value_parser = parse_positive)]
    pub step: f64,
    /// Ambient, diffuse and specular lighting
    #[arg(long, value_name = "SWITCH", default_value = "on")]
    pub lighting: Switch,
    /// How the volume is drawn
    #[arg(long, value_name = "METHOD", default_value = "raycast")]
    pub method: Method,
    /// What draws it
    #[arg(long, value_name = "BACKEND", default_value = "auto")]
    pub backend: Backend,
    /// Finest octree level to draw; 0 is full resolution
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub level: u8,
    /// Background: a name, #RRGGBB, or transparent
    #[arg(long, value_name = "COLOR", default_value = "black", value_parser = parse_background)]
    pub background: Background,
    /// Draw the volume's box with its coordinates
    #[arg(long)]
    pub axes: bool,
    /// Draw a colour bar with the variable's name and units
    #[arg(long)]
    pub colorbar: bool,
}

/// From where the volume is seen.
#[derive(Debug, Clone, Args)]
pub struct CameraArgs {
    /// Camera file (JSON), in place of the angles
    #[arg(long, value_name = "FILE", conflicts_with_all = ["azimuth", "elevation", "zoom", "fov", "ortho"])]
    pub camera: Option<PathBuf>,
    /// Turn about the vertical axis, in degrees
    #[arg(long, value_name = "DEG", default_value_t = 30.0, allow_hyphen_values = true, value_parser = parse_finite)]
    pub azimuth: f64,
    /// Height above the horizon, in degrees
    #[arg(long, value_name = "DEG", default_value_t = 20.0, allow_hyphen_values = true, value_parser = parse_finite)]
    pub elevation: f64,
    /// 1 shows the whole box; 2 twice as large
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = parse_positive)]
    pub zoom: f64,
    /// Vertical field of view, in degrees
    #[arg(long, value_name = "DEG", default_value_t = 30.0, value_parser = parse_positive)]
    pub fov: f64,
    /// Orthographic instead of perspective
    #[arg(long, conflicts_with = "fov")]
    pub ortho: bool,
}

/// How values become colours and opacities.
#[derive(Debug, Clone, Args)]
pub struct TransferArgs {
    /// Transfer function: ramp, sparse, filled, or a file (ours or a ParaView preset)
    #[arg(long, value_name = "NAME|FILE", default_value = "ramp")]
    pub tf: String,
    /// Colour map of the built-in functions: viridis, inferno, turbo, coolwarm, gray [default: viridis]
    #[arg(long, value_name = "NAME")]
    pub colormap: Option<String>,
    /// Path length, in world units, that opacities refer to [default: the smallest spacing]
    #[arg(long, value_name = "LENGTH", value_parser = parse_positive)]
    pub opacity_unit: Option<f64>,
}

/// Which time step a picture shows.
#[derive(Debug, Clone, Args)]
pub struct StepArgs {
    /// Time step, from 0 [default: the first]
    #[arg(short = 't', long = "time-step", value_name = "STEP", conflicts_with = "time")]
    pub step: Option<usize>,
    /// Time, in the source's units; the nearest step is drawn
    #[arg(long, value_name = "T", allow_hyphen_values = true, value_parser = parse_finite)]
    pub time: Option<f64>,
}

/// On or off.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[allow(missing_docs)]
pub enum Switch {
    On,
    Off,
}

/// Ways to draw a volume.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Method {
    /// Rays from the eye through every pixel.
    Raycast,
}

/// What draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Backend {
    /// The best there is; what was taken is reported.
    Auto,
    /// The processor, with all its threads.
    Cpu,
}

/// What is behind the volume.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Background {
    /// Nothing: the picture keeps its alpha.
    Transparent,
    /// An sRGB colour, each part in [0, 1].
    Color([f32; 3]),
}

fn parse_background(text: &str) -> Result<Background, String> {
    let named = [
        ("black", [0, 0, 0]),
        ("white", [255, 255, 255]),
        ("gray", [128, 128, 128]),
        ("darkgray", [40, 40, 40]),
        ("navy", [12, 18, 40]),
    ];
    if text == "transparent" {
        return Ok(Background::Transparent);
    }
    let rgb = match named.iter().find(|(name, _)| *name == text) {
        Some((_, rgb)) => Some(*rgb),
        None => text.strip_prefix('#').filter(|hex| hex.len() == 6).and_then(|hex| {
            let value = u32::from_str_radix(hex, 16).ok()?;
            Some([(value >> 16) as u8, (value >> 8) as u8, value as u8])
        }),
    };
    rgb.map(|rgb| Background::Color(rgb.map(|c| f32::from(c) / 255.0))).ok_or_else(|| {
        format!("{text:?} is not a colour; use #RRGGBB, transparent, {}", named.map(|(name, _)| name).join(", "))
    })
}

impl ViewArgs {
    /// Distance between samples in voxels, kept within what makes sense.
    ///
    /// # Errors
    /// A message if the step is so small that a picture would never be done.
    pub fn checked_step(&self) -> anyhow::Result<f64> {
        anyhow::ensure!(
            (0.01..=64.0).contains(&self.step),
            "--step is {}: use a length from 0.01 to 64 voxels",
            self.step
        );
        Ok(self.step)
    }
}

/// A number of frames per second.
pub fn parse_fps(text: &str) -> Result<f64, String> {
    parse_not_negative(text).and_then(|fps| match fps {
        0.1..=240.0 => Ok(fps),
        _ => Err(format!("{fps} frames per second are outside 0.1 to 240")),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn backgrounds() {
        assert_eq!(parse_background("#ff0080"), Ok(Background::Color([1.0, 0.0, 128.0 / 255.0])));
        assert_eq!(parse_background("transparent"), Ok(Background::Transparent));
        assert!(["#ff", "pinkish", "#gggggg"].iter().all(|t| parse_background(t).is_err()));
    }
}
