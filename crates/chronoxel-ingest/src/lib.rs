//! From files as scientists have them to a store: sources, analysis, encoding.

pub mod encode;
pub mod error;
pub mod export;
pub mod series;
pub mod sim;
pub mod sources;

pub use error::SourceError;
pub use series::{StepReader, TimeSeries, Variable};
