//! What the caller asks of the encoder, and what is reported back.

use serde_json::{Value, json};

use super::step::Coding;
use crate::{EncodeError, Variable};

/// How bricks are coded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Codec {
    /// Per brick the fewest bytes that hold the error bound; without a bound as `Raw`.
    Auto,
    /// Quantised within the range of each brick.
    Raw,
}

impl Codec {
    /// As it is written on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Raw => "raw",
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
    /// Bits per sample, 8 or 16; by default 8 for 8-bit integers, else 16.
    pub bits: Option<u8>,
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
}

impl Default for EncodeOptions {
    fn default() -> Self {
        Self {
            variables: Vec::new(),
            codec: Codec::Auto,
            bits: None,
            max_error: None,
            range: None,
            brick_edge: 32,
            memory_bytes: 1 << 30,
            overwrite: false,
            resume: false,
            fill_value: None,
            source_name: String::new(),
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
}

impl EncodeOptions {
    /// Checks the options in themselves.
    pub(super) fn check(&self) -> Result<(), EncodeError> {
        let invalid = |argument, value: String, remedy: &str| {
            Err(EncodeError::InvalidArgument { argument, value, remedy: remedy.into() })
        };
        if let Some(bits) = self.bits.filter(|b| ![8, 16].contains(b)) {
            return invalid("--bits", bits.to_string(), "use 8 or 16");
        }
        if let Some(error) = self.max_error {
            if !(0.0..1.0).contains(&error) {
                return invalid(
                    "--max-error",
                    error.to_string(),
                    "a share of the range: at least 0, below 1",
                );
            }
            if self.codec == Codec::Raw {
                return invalid("--max-error", error.to_string(), "goes with --codec auto; raw has --bits");
            }
            if self.bits.is_some() {
                return invalid(
                    "--max-error",
                    error.to_string(),
                    "chooses the bits itself: leave --bits out",
                );
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
        chosen.into_iter().map(|index| Ok((index, self.coding(&available[index])?))).collect()
    }

    fn coding(&self, variable: &Variable) -> Result<Coding, EncodeError> {
        let sample_type = variable.sample_type;
        let fill_value = self.fill_value.or(variable.fill_value).filter(|fill| !fill.is_nan());
        Ok(Coding {
            name: variable.name.clone(),
            // Where the source holds integers, a fill value of NaN never occurs; in floats NaN is masked anyway.
            fill_value,
            bits: self.bits.unwrap_or(if sample_type.num_bytes() == 1 { 8 } else { 16 }),
            max_error: self.max_error,
            range: self.range,
        })
    }

    /// What the store's header records, and a resume compares.
    pub(super) fn recorded(&self) -> Value {
        json!({
            "program": concat!("chronoxel ", env!("CARGO_PKG_VERSION")),
            "source": self.source_name,
            "codec": self.codec.name(),
            "bits": self.bits,
            "max_error": self.max_error,
            "range": self.range,
        })
    }
}
