//! From files as scientists have them to a store: sources, analysis, encoding.

pub mod decode;
pub mod encode;
pub mod error;
pub mod export;
pub mod measure;
pub mod mesh;
pub mod series;
pub mod sim;
pub mod sources;
pub mod voxelise;

pub use decode::{StepDecoder, decode_step};
pub use encode::{
    CellOptions, CellReport, Codec, EncodeOptions, EncodeReport, Progress, encode, encode_cells, encode_mesh,
};
pub use error::{EncodeError, SourceError};
pub use measure::{
    CellErrors, CellMeasurement, Measurement, VariableErrors, measure, measure_cells, measure_mesh,
};
pub use mesh::{GridType, MeshCensus, MeshSeries, Opened};
pub use series::{StepReader, TimeSeries, Variable};
pub use voxelise::{VoxelOptions, VoxelReport};
