//! Payload codecs: stages of indices and tables, their bytes, their decoding, and the quantiser.
//!
//! A decoded sample is the sum over the stages of `table[row(step)][index]`, whatever made the tables
//! and the indices. Encoders may be as clever as they like; there is one decode rule.

pub mod allocation;
pub mod bounded;
pub mod bytes;
pub mod cells;
pub mod class;
pub mod dct;
pub mod decode;
pub mod error;
mod fixed;
pub mod lloyd_max;
pub mod palette;
pub mod payload;
pub mod quantize;
pub mod rate;
pub mod vq;
pub mod window;
pub mod workers;

pub use allocation::{allocate_bits, expected_distortion};
pub use bytes::{point_stage_from_bytes, point_stage_to_bytes, stage_from_bytes, stage_to_bytes};
pub use cells::{
    BLOCK_STEPS, CellCodecOptions, CellSpan, SpanErrors, decode_points, encode_cells, paper_ratio,
    span_errors,
};
pub use class::{PayloadClass, StageClass, TableClass};
pub use dct::Dct;
pub use decode::{decode_f64, decode_resident, decode_samples, decoded_range};
pub use error::CodecError;
pub use lloyd_max::LloydMax;
pub use palette::{ProductQuantizer, product_palette};
pub use payload::{Indices, Payload, Stage, Table};
pub use quantize::{SampleValue, quantize_affine};
pub use rate::{
    CodedPiece, Piece, RateOptions, RatePoint, Run, allocate, choose_points, first_slopes, rate_points,
};
pub use vq::{VectorTable, vector_palette};
pub use window::{Palette, UnitWindow, code_stages};
pub use workers::{OneWorker, Workers};
