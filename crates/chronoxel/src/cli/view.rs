//! The options that say what a picture shows: variable, camera, transfer function, size.

use std::path::{Path, PathBuf};

use anyhow::Context;
use chronoxel_core::{
    Camera, ColorMap, Image, Image8, Lighting, ResolvedTransfer, TimeAxis, TransferFunction, UniformGrid,
    metrics::ColorSpace,
};
use chronoxel_render::{GpuOptions, GpuRenderer, Interpolation};
use chronoxel_stream::Tolerances;
use clap::{Args, ValueEnum};

use super::args::{parse_finite, parse_not_negative, parse_picture_size, parse_positive, parse_step};
use super::cells::CellArgs;
use crate::{
    annotate::{AxesBox, ColorBar, Style, TimeLabel},
    bytes::ByteSize,
    session::{CoherenceView, LevelBorders, Metric, Moment, Picture, Session, View, orbit_camera_of},
};

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
    /// Distance between samples along a ray, in voxels [default: 0.5]
    #[arg(long, value_name = "VOXELS", allow_hyphen_values = true, value_parser = parse_step_length)]
    pub step: Option<f64>,
    /// Ambient, diffuse and specular lighting
    #[arg(long, value_name = "SWITCH", default_value = "on")]
    pub lighting: Switch,
    /// How the volume is drawn [default: raycast; cells where the store has nothing else]
    #[arg(long, value_name = "METHOD")]
    pub method: Option<Method>,
    #[command(flatten)]
    pub cells: CellArgs,
    /// What draws it
    #[arg(long, value_name = "BACKEND", default_value = "auto")]
    pub backend: Backend,
    /// GPU memory that may be used, such as 512MiB or 4GiB
    #[arg(long, value_name = "SIZE", default_value = "1GiB")]
    pub gpu_memory: ByteSize,
    /// What is interpolated between samples: values, or their colours (for comparison, on the GPU) [default: scalar]
    #[arg(long, value_name = "WHAT")]
    pub interpolation: Option<InterpolationName>,
    /// Finest octree level to draw; 0 is full resolution [default: 0]
    #[arg(long, value_name = "N")]
    pub level: Option<u8>,
    /// How bricks of different levels meet: each by its own samples, or filtered so that no seam shows (on the CPU) [default: sharp]
    #[arg(long, value_name = "HOW")]
    pub level_borders: Option<LevelBordersName>,
    #[command(flatten)]
    pub coherence: CoherenceArgs,
    /// Background: a name, #RRGGBB, or transparent
    #[arg(long, value_name = "COLOR", default_value = "black", value_parser = parse_background)]
    pub background: Background,
    /// Draw the volume's box with its coordinates
    #[arg(long)]
    pub axes: bool,
    /// Draw a colour bar with the variable's name and units
    #[arg(long)]
    pub colorbar: bool,
    /// Write the time and the step into the picture
    #[arg(long)]
    pub time_label: bool,
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
    #[arg(long, value_name = "DEG", default_value_t = 30.0, allow_hyphen_values = true, value_parser = parse_fov)]
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
    #[arg(long, value_name = "NAME", value_parser = parse_color_map)]
    pub colormap: Option<ColorMap>,
    /// Path length, in world units, that opacities refer to [default: the smallest spacing; of a mesh, its longest side / 128]
    #[arg(long, value_name = "LENGTH", value_parser = parse_positive)]
    pub opacity_unit: Option<f64>,
}

/// What is drawn simpler than it is because it is alike in space or time.
#[derive(Debug, Clone, Args)]
pub struct CoherenceArgs {
    /// What coherence is measured by: variation of the values, or of their colours [default: color-approximate]
    #[arg(long, value_name = "METRIC")]
    pub metric: Option<MetricName>,
    /// Draw nodes of the octree whose coefficient of variation in space is at most this in their mean colour
    #[arg(long, value_name = "E", default_value_t = 0.0, allow_hyphen_values = true, value_parser = parse_not_negative)]
    pub spatial_tolerance: f64,
    /// Draw bricks whose coefficient of variation over some steps is at most this as they are at the first of them
    #[arg(long, value_name = "E", default_value_t = 0.0, allow_hyphen_values = true, value_parser = parse_not_negative)]
    pub temporal_tolerance: f64,
}

/// Metrics of coherence.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum MetricName {
    /// Variation of values.
    Scalar,
    /// Variation of colours, voxel by voxel: reads every step first; for measuring.
    ColorReference,
    /// Variation of colours, estimated at once from the statistics of the values.
    ColorApproximate,
}

/// Which time step a picture shows.
#[derive(Debug, Clone, Args)]
pub struct StepArgs {
    /// Time step, from 0 [default: the first]
    #[arg(short = 't', long, value_name = "STEP", conflicts_with = "time", allow_hyphen_values = true, value_parser = parse_step)]
    pub time_step: Option<usize>,
    /// Time, in the source's units; the nearest step is drawn
    #[arg(long, value_name = "T", allow_hyphen_values = true, value_parser = parse_finite)]
    pub time: Option<f64>,
    /// Draw --time between the two steps around it, interpolated, instead of the nearest step
    #[arg(long, requires = "time")]
    pub blend_steps: bool,
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
    /// Planes across the view, cut into polygons and blended: on the GPU.
    Slices,
    /// The tetrahedra of a store of cells as they are.
    Cells,
}

/// What draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Backend {
    /// The best there is; what was taken is reported.
    Auto,
    /// The processor, with all its threads.
    Cpu,
    /// A GPU, or a software driver of one.
    Gpu,
}

/// What is interpolated between samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum InterpolationName {
    /// Values, before they become colours.
    Scalar,
    /// Colours.
    Color,
}

/// How bricks of different levels meet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LevelBordersName {
    /// Each as it interpolates its own samples.
    Sharp,
    /// Without a jump.
    Filtered,
}

/// What was chosen to draw, and why.
#[derive(Debug, Clone)]
pub struct ChosenBackend {
    /// `cpu` or `gpu`.
    pub name: &'static str,
    /// What draws, in words.
    pub adapter: String,
    /// Why it was chosen.
    pub reason: String,
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
        format!(
            "{text:?} is not a colour; use #RRGGBB, transparent, {}",
            named.map(|(name, _)| name).join(", ")
        )
    })
}

impl ViewArgs {
    /// Makes a session draw on what was asked for, or on what suits best.
    ///
    /// # Errors
    /// If a GPU was asked for and none can be used.
    pub fn choose_backend(&self, session: &mut Session) -> anyhow::Result<ChosenBackend> {
        let interpolation = match self.interpolation {
            None | Some(InterpolationName::Scalar) => Interpolation::Scalar,
            Some(InterpolationName::Color) => Interpolation::Color,
        };
        let method = match self.method {
            Some(Method::Slices) => chronoxel_render::Method::Slices,
            _ => chronoxel_render::Method::Raycast,
        };
        let options =
            GpuOptions { memory_bytes: self.gpu_memory.0, method, interpolation, ..GpuOptions::default() };
        let needs_gpu = method == chronoxel_render::Method::Slices || interpolation == Interpolation::Color;
        anyhow::ensure!(
            method == chronoxel_render::Method::Raycast || interpolation == Interpolation::Scalar,
            "--interpolation color is for rays: leave out --method slices"
        );
        let filters = self.level_borders == Some(LevelBordersName::Filtered);
        anyhow::ensure!(
            !filters || !(needs_gpu || self.backend == Backend::Gpu),
            "--level-borders filtered is for rays on the CPU: leave out --backend gpu, --method slices and --interpolation color"
        );
        let cpu = |reason: String| {
            anyhow::ensure!(
                !needs_gpu,
                "--method slices and --interpolation color are for the GPU ({reason}): add --backend gpu"
            );
            Ok(ChosenBackend { name: "cpu", adapter: cpu_adapter(), reason })
        };
        let mut gpu = |reason: String| {
            let info = session.use_gpu(&options)?;
            let adapter = format!("{} ({}, {}, {})", info.name, info.kind, info.backend, info.driver);
            anyhow::Ok(ChosenBackend { name: "gpu", adapter, reason })
        };
        match self.backend {
            Backend::Cpu => cpu("asked for".into()),
            Backend::Auto if filters => cpu("--level-borders filtered is for the CPU".into()),
            Backend::Gpu => gpu("asked for".into()),
            Backend::Auto => match GpuRenderer::adapter(&options) {
                Ok(info) if info.is_software && interpolation == Interpolation::Scalar => cpu(format!(
                    "{} is a program on the CPU, slower than the CPU's own ray caster",
                    info.name
                )),
                Ok(info) => {
                    let reason = format!("{} is there", info.name);
                    gpu(reason).or_else(|error| cpu(format!("{error:#}")))
                }
                Err(error) => cpu(error.to_string()),
            },
        }
    }

    /// What the pictures show of an open store.
    ///
    /// # Errors
    /// If a camera or transfer-function file cannot be read or used, or the level does not exist.
    pub fn view(&self, session: &Session) -> anyhow::Result<View> {
        let grid = session.store().header().grid;
        let num_levels = session.store().tree().num_levels();
        let level = self.level.unwrap_or(0);
        anyhow::ensure!(
            usize::from(level) < num_levels,
            "{}: --level is {level}: the store has levels 0 to {}",
            session.store().path().display(),
            num_levels - 1
        );
        Ok(View {
            camera: self.camera.camera(&grid, self.size)?,
            transfer: session.resolve(&self.transfer.function()?)?,
            size: self.size,
            step_voxels: self.step.unwrap_or(DEFAULT_STEP_VOXELS),
            lighting: (self.lighting == Switch::On).then(Lighting::default),
            opacity_unit: self.transfer.opacity_unit.unwrap_or(session.store().header().opacity_unit()),
            level,
            coherence: self.coherence.view(),
            level_borders: match self.level_borders {
                None | Some(LevelBordersName::Sharp) => LevelBorders::Sharp,
                Some(LevelBordersName::Filtered) => LevelBorders::Filtered,
            },
        })
    }

    /// The picture of a step as it is shown: before its background, with what was asked to be written on it.
    ///
    /// # Errors
    /// If the picture has another size than the view.
    pub fn show(
        &self,
        session: &Session,
        view: &View,
        picture: &Picture,
        moment: Moment,
    ) -> anyhow::Result<Image8> {
        let header = session.store().header();
        let variable = &header.variables[session.variable()];
        let legend = Legend {
            camera: &view.camera,
            transfer: &view.transfer,
            bounds: header.grid.bounds(),
            name: &variable.name,
            units: &variable.units,
            range: session.variable_range(),
            times: &header.times,
        };
        self.show_with(&legend, &picture.image, moment)
    }

    /// As [`Self::show`], with what is written beside a picture of anything.
    ///
    /// # Errors
    /// If the picture has another size than was asked for.
    pub fn show_with(&self, legend: &Legend, image: &Image, moment: Moment) -> anyhow::Result<Image8> {
        let [width, height] = self.size;
        let background = self.background.into();
        let style = Style::for_picture(self.size, background);
        let mut shown = Image8::of_background(width, height, background);
        let Legend { camera, bounds, times, .. } = *legend;
        let axes = AxesBox { camera, bounds, names: ["x", "y", "z"], units: "" };
        if self.axes {
            axes.draw_behind(&mut shown, &style);
        }
        shown.composite(image)?;
        let mut occupied = Vec::new();
        let mut color_bar = None;
        if self.colorbar {
            let bar = ColorBar {
                transfer: legend.transfer,
                range: legend.range,
                name: legend.name,
                // A pure number has the unit 1, which nobody writes.
                units: if legend.units == "1" { "" } else { legend.units },
            };
            occupied.extend(bar.areas(&shown, &style));
            color_bar = Some(bar);
        }
        if self.time_label {
            let label = TimeLabel::new(times);
            occupied.push(label.draw(&mut shown, &style, moment.time(&times.times), moment.step).rect);
        }
        if self.axes {
            axes.draw_outline(&mut shown, &style, &occupied);
        }
        if let Some(bar) = color_bar {
            bar.draw(&mut shown, &style);
        }
        Ok(shown)
    }
}

impl CameraArgs {
    /// The camera for a grid, turned further by `turn_deg` where it orbits.
    ///
    /// # Errors
    /// If the camera file cannot be read or used, or an angle is out of range.
    pub fn camera(&self, grid: &UniformGrid, size: [usize; 2]) -> anyhow::Result<Camera> {
        self.turned(grid, size, 0.0)
    }

    /// The camera for a grid, turned further about the vertical axis.
    ///
    /// # Errors
    /// As [`Self::camera`].
    pub fn turned(&self, grid: &UniformGrid, size: [usize; 2], turn_deg: f64) -> anyhow::Result<Camera> {
        self.around(grid.bounds(), size, turn_deg)
    }

    /// The camera for a box, turned further about the vertical axis.
    ///
    /// # Errors
    /// As [`Self::camera`].
    pub fn around(&self, bounds: [[f64; 3]; 2], size: [usize; 2], turn_deg: f64) -> anyhow::Result<Camera> {
        if let Some(path) = &self.camera {
            let text = read_text(path, "camera file")?;
            let camera = Camera::from_json(&text).with_context(|| path.display().to_string())?;
            return Ok(camera.turned(turn_deg)?);
        }
        let fov = (!self.ortho).then_some(self.fov);
        orbit_camera_of(bounds, [self.azimuth + turn_deg, self.elevation], self.zoom, fov, size)
    }
}

impl TransferArgs {
    /// The transfer function.
    ///
    /// # Errors
    /// If the name is neither built in nor a file that can be read and used, or a colour map is asked for where a
    /// file has its own colours.
    pub fn function(&self) -> anyhow::Result<TransferFunction> {
        if TransferFunction::BUILT_IN.contains(&self.tf.as_str()) {
            return Ok(TransferFunction::built_in(&self.tf, self.colormap.unwrap_or(ColorMap::Viridis))?);
        }
        let path = Path::new(&self.tf);
        anyhow::ensure!(
            path.exists(),
            "--tf {:?} is neither a file nor one of the built-in functions {}",
            self.tf,
            TransferFunction::BUILT_IN.join(", ")
        );
        anyhow::ensure!(
            self.colormap.is_none(),
            "--colormap is for the built-in functions; {} has its own colours",
            path.display()
        );
        let text = read_text(path, "transfer function")?;
        TransferFunction::from_json(&text).with_context(|| path.display().to_string())
    }
}

impl CoherenceArgs {
    /// What of the coherence is used; nothing where nothing of it was asked for.
    fn view(&self) -> Option<CoherenceView> {
        let tolerances = Tolerances { spatial: self.spatial_tolerance, temporal: self.temporal_tolerance };
        let is_asked_for = self.metric.is_some() || tolerances != Tolerances::default();
        let metric = match self.metric.unwrap_or(MetricName::ColorApproximate) {
            MetricName::Scalar => Metric::Scalar,
            MetricName::ColorReference => Metric::ColorReference(ColorSpace::Rgb),
            MetricName::ColorApproximate => Metric::ColorApproximate(ColorSpace::Rgb),
        };
        is_asked_for.then_some(CoherenceView { metric, tolerances, skips_transparent: true })
    }
}

impl StepArgs {
    /// The moment meant.
    ///
    /// # Errors
    /// If it is not in the store.
    pub fn resolve(&self, session: &Session) -> anyhow::Result<Moment> {
        let header = session.store().header();
        self.among(session.store().path(), &header.times, header.num_steps_finished as usize)
    }

    /// The moment meant, among the finished steps of a store.
    ///
    /// # Errors
    /// If it is not in the store.
    pub fn among(&self, store: &Path, times: &TimeAxis, num_steps: usize) -> anyhow::Result<Moment> {
        if let Some(time) = self.time {
            return Ok(match self.blend_steps {
                false => Moment::at(times.nearest_step(time).min(num_steps - 1)),
                true => Moment::of_time(&times.times[..num_steps], time),
            });
        }
        let step = self.time_step.unwrap_or(0);
        anyhow::ensure!(
            step < num_steps,
            "{}: step {step} is not in the store: its steps are 0 to {}",
            store.display(),
            num_steps - 1
        );
        Ok(Moment::at(step))
    }
}

impl From<Background> for chronoxel_core::Background {
    fn from(background: Background) -> Self {
        match background {
            Background::Transparent => Self::Transparent,
            Background::Color(color) => Self::Color(color),
        }
    }
}

/// What is written beside a picture, and where its box lies.
pub struct Legend<'a> {
    /// From where.
    pub camera: &'a Camera,
    /// Colours and opacities.
    pub transfer: &'a ResolvedTransfer,
    /// The box that axes are drawn around.
    pub bounds: [[f64; 3]; 2],
    /// Name of the variable.
    pub name: &'a str,
    /// Its units.
    pub units: &'a str,
    /// Its smallest and largest value.
    pub range: [f64; 2],
    /// Times of the steps.
    pub times: &'a TimeAxis,
}

/// Distance between samples along a ray, in voxels, where none is asked for.
const DEFAULT_STEP_VOXELS: f64 = 0.5;

/// What draws on the CPU, in words.
pub fn cpu_adapter() -> String {
    format!("{} threads, {}", rayon::current_num_threads(), chronoxel_render::kernel_name())
}

/// Text files given by the user are small; larger ones are a mistake.
const MOST_TEXT_BYTES: u64 = 16 << 20;

fn read_text(path: &Path, what: &str) -> anyhow::Result<String> {
    let failed = || format!("{}: cannot read the {what}", path.display());
    let num_bytes = std::fs::metadata(path).with_context(failed)?.len();
    anyhow::ensure!(
        num_bytes <= MOST_TEXT_BYTES,
        "{}: {num_bytes} bytes are too many for a {what}",
        path.display()
    );
    std::fs::read_to_string(path).with_context(failed)
}

/// A distance between samples, in voxels.
fn parse_step_length(text: &str) -> Result<f64, String> {
    match parse_finite(text)? {
        step @ 0.01..=2.0 => Ok(step),
        step => Err(format!("{step} voxels are outside 0.01 to 2")),
    }
}

/// A vertical field of view.
fn parse_fov(text: &str) -> Result<f64, String> {
    match parse_finite(text)? {
        fov @ 0.001..=179.0 => Ok(fov),
        fov => Err(format!("{fov} degrees are outside 0.001 to 179")),
    }
}

fn parse_color_map(text: &str) -> Result<ColorMap, String> {
    text.parse().map_err(|error: chronoxel_core::CoreError| error.to_string())
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
