//! What the caller asks of the encoder, and what is reported back.

use serde_json::{Value, json};

use super::palettes::PaletteKind;
use super::variable::{Coding, How};
use super::windowed::Method;
use crate::voxelise::{VoxelOptions, VoxelReport};
use crate::{EncodeError, Variable};

/// How bricks are coded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Codec {
    /// Per brick the fewest bytes that hold an error bound, or the least error at a rate; without either as `Raw`.
    Auto,
    /// Each step quantised within the range of each brick.
    Raw,
    /// Temporal palettes (lum2001): DCT, bit allocation, Lloyd-Max quantisers, per brick.
    Palette,
    /// The same with one quantiser for each slice of the volume, as lum2001 has it: to compare with.
    PaletteSlice,
    /// Temporal palettes trained on the vectors of each brick.
    Vq,
}

impl Codec {
    /// As it is written on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Raw => "raw",
            Self::Palette => "palette",
            Self::PaletteSlice => "palette-slice",
            Self::Vq => "vq",
        }
    }
}

/// What is asked of the encoder.
#[derive(Debug, Clone, PartialEq)]
pub struct EncodeOptions {
    /// Names of the variables to encode; all of them where empty.
    pub variables: Vec<String>,
    /// How bricks are coded.
    pub codec: Codec,
    /// `Raw`: bits per sample, 8 or 16; by default 8 for 8-bit integers, else 16. `Auto`: stored bits per sample and
    /// step, on average.
    pub bits: Option<f64>,
    /// Steps of a window, 1 to 16, a power of two; by default 8 for palettes, 16 for `Auto`.
    pub window: Option<u32>,
    /// Stages of a palette, 1 to 3; by default 1.
    pub stages: Option<u8>,
    /// Whether the windows of different bricks begin at different steps (lum2001, section 3.4), so that no step replaces many: off to compare.
    pub interleaved: bool,
    /// Largest error of a source sample, in units of the variable's range: `range`, else what was seen of it so far
    /// when a brick is coded, which can only be stricter than the final one.
    pub max_error: Option<f64>,
    /// The range errors refer to.
    pub range: Option<[f64; 2]>,
    /// Core samples along the edge of a brick.
    pub brick_edge: usize,
    /// Memory for the working set: slices, bricks and their bytes.
    pub memory_bytes: u64,
    /// Replace what is there.
    pub overwrite: bool,
    /// Continue an unfinished store.
    pub resume: bool,
    /// The value that means "no data", instead of the source's.
    pub fill_value: Option<f64>,
    /// Name of the source: recorded, and compared by a resume.
    pub source_name: String,
    /// How a mesh becomes bricks.
    pub voxels: VoxelOptions,
}

impl Default for EncodeOptions {
    fn default() -> Self {
        Self {
            variables: Vec::new(),
            codec: Codec::Auto,
            bits: None,
            window: None,
            stages: None,
            interleaved: true,
            max_error: None,
            range: None,
            brick_edge: 32,
            memory_bytes: 1 << 30,
            overwrite: false,
            resume: false,
            fill_value: None,
            source_name: String::new(),
            voxels: VoxelOptions::default(),
        }
    }
}

/// How far an encoding is.
#[derive(Debug, Clone, PartialEq)]
pub struct Progress {
    /// The step being encoded.
    pub step: usize,
    /// Steps of the series.
    pub num_steps: usize,
    /// Bytes of source samples encoded, those of a resumed store included.
    pub done_bytes: u64,
    /// Bytes of all source samples.
    pub raw_bytes: u64,
}

/// What an encoding did.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EncodeReport {
    /// Bytes of the source's samples, all steps and encoded variables.
    pub raw_bytes: u64,
    /// Bytes of the store.
    pub stored_bytes: u64,
    /// Steps read: those that a resume found finished are not among them.
    pub steps_read: usize,
    /// Steps that were finished already.
    pub steps_resumed: usize,
    /// Wall-clock time.
    pub wall_secs: f64,
    /// Masked samples in the steps read: NaN, infinities and fill values.
    pub num_masked: u64,
    /// Infinities among them.
    pub num_infinite: u64,
    /// What voxelising did, where the source is a mesh.
    pub voxels: Option<VoxelReport>,
}

impl EncodeOptions {
    /// Checks the options in themselves.
    ///
    /// # Errors
    /// [`EncodeError::InvalidArgument`] for one that is out of range or contradicts another.
    pub fn check(&self) -> Result<(), EncodeError> {
        let invalid = |argument, value: String, remedy: &str| {
            Err(EncodeError::InvalidArgument { argument, value, remedy: remedy.into() })
        };
        let codec = self.codec.name();
        if let Some(bits) = self.bits {
            match self.codec {
                Codec::Raw if ![8.0, 16.0].contains(&bits) => {
                    return invalid("--bits", bits.to_string(), "with --codec raw: use 8 or 16");
                }
                Codec::Auto if !(0.01..=32.0).contains(&bits) => {
                    return invalid("--bits", bits.to_string(), "per sample and step: 0.01 to 32");
                }
                Codec::Raw | Codec::Auto => {}
                _ => {
                    let remedy =
                        format!("--codec {codec} has --window and --stages; --codec auto meets a rate");
                    return invalid("--bits", bits.to_string(), &remedy);
                }
            }
        }
        if let Some(error) = self.max_error {
            if !(0.0..1.0).contains(&error) {
                return invalid(
                    "--max-error",
                    error.to_string(),
                    "a share of the range: at least 0, below 1",
                );
            }
            if self.codec != Codec::Auto {
                let remedy = format!("goes with --codec auto, not with {codec}");
                return invalid("--max-error", error.to_string(), &remedy);
            }
            if self.bits.is_some() {
                return invalid(
                    "--max-error",
                    error.to_string(),
                    "chooses the bits itself: leave --bits out",
                );
            }
        }
        if let Some(window) = self.window {
            if ![1, 2, 4, 8, 16].contains(&window) {
                return invalid("--window", window.to_string(), "steps: use 1, 2, 4, 8 or 16");
            }
            let by_steps = self.codec == Codec::Auto && self.max_error.is_none() && self.bits.is_none();
            if by_steps || self.codec == Codec::Raw {
                let remedy =
                    "--codec raw codes each step by itself, and so does auto without --max-error or --bits";
                return invalid("--window", window.to_string(), remedy);
            }
        }
        if let Some(stages) = self.stages {
            if !(1..=3).contains(&stages) {
                return invalid("--stages", stages.to_string(), "use 1, 2 or 3");
            }
            if !matches!(self.codec, Codec::Palette | Codec::Vq) {
                let remedy = format!("goes with palette and vq; --codec {codec} chooses by itself");
                return invalid("--stages", stages.to_string(), &remedy);
            }
        }
        if let Some([low, high]) = self.range.filter(|[low, high]| !(low < high && (high - low).is_finite()))
        {
            return invalid("--range", format!("{low}:{high}"), "MIN must be below MAX, both finite");
        }
        if self.overwrite && self.resume {
            return invalid("--overwrite", "with --resume".into(), "use one of them");
        }
        Ok(())
    }

    /// The variables to encode, with their indices in the series.
    pub(super) fn choose_variables(
        &self,
        available: &[Variable],
        num_steps: usize,
    ) -> Result<Vec<(usize, Coding)>, EncodeError> {
        let names: Vec<&str> = available.iter().map(|v| v.name.as_str()).collect();
        let mut chosen: Vec<usize> = Vec::new();
        for wanted in &self.variables {
            let Some(index) = names.iter().position(|name| name == wanted) else {
                let remedy = format!("the source has {}", names.join(", "));
                return Err(EncodeError::InvalidArgument {
                    argument: "--variable",
                    value: wanted.clone(),
                    remedy,
                });
            };
            if !chosen.contains(&index) {
                chosen.push(index);
            }
        }
        if self.variables.is_empty() {
            chosen = (0..available.len()).collect();
        }
        chosen.into_iter().map(|index| Ok((index, self.coding(&available[index], num_steps)?))).collect()
    }

    fn coding(&self, variable: &Variable, num_steps: usize) -> Result<Coding, EncodeError> {
        let fill_value = self.fill_value.or(variable.fill_value).filter(|fill| !fill.is_nan());
        Ok(Coding {
            name: variable.name.clone(),
            // Where the source holds integers, a fill value of NaN never occurs; in floats NaN is masked anyway.
            fill_value,
            range: self.range,
            how: self.how(variable, num_steps),
        })
    }

    fn how(&self, variable: &Variable, num_steps: usize) -> How {
        let num_stages = usize::from(self.stages.unwrap_or(1));
        let windows = |default: u32, method| {
            // No longer than the series has use for.
            let longest = u32::try_from(num_steps.next_power_of_two()).unwrap_or(u32::MAX);
            How::Windows { window: self.window.unwrap_or(default).min(longest), method }
        };
        let palettes = |kind| windows(8, Method::Palettes { kind, num_stages });
        match (self.codec, self.max_error, self.bits) {
            (Codec::Palette, ..) => palettes(PaletteKind::Product),
            (Codec::Vq, ..) => palettes(PaletteKind::Vector),
            (Codec::PaletteSlice, ..) => windows(8, Method::Slices),
            (Codec::Auto, _, Some(bits)) => windows(8, Method::Rate { bits }),
            (Codec::Auto, Some(max_error), _) => windows(16, Method::Bound { max_error }),
            (Codec::Auto, ..) | (Codec::Raw, ..) => {
                let bits = if variable.sample_type.num_bytes() == 1 { 8 } else { 16 };
                How::Steps { bits: self.bits.map_or(bits, |bits| bits as u8) }
            }
        }
    }

    /// What the store's header records, and a resume compares.
    pub(super) fn recorded(&self, is_mesh: bool) -> Value {
        let mut recorded = json!({
            "program": concat!("chronoxel ", env!("CARGO_PKG_VERSION")),
            "source": self.source_name,
            "codec": self.codec.name(),
            "bits": self.bits,
            "window": self.window,
            "stages": self.stages,
            "max_error": self.max_error,
            "range": self.range,
        });
        if !self.interleaved {
            recorded["interleaved"] = false.into();
        }
        if is_mesh {
            recorded["field_threshold"] = self.voxels.field_threshold.into();
            recorded["max_depth"] = self.voxels.max_depth.into();
        }
        recorded
    }
}
