//! The words of Chronoxel as types: grids, time, the octree of bricks, spans, and what a
//! resident brick is. Everything here is pure: no files, no threads, no GPU.

pub mod brick;
pub mod dtype;
pub mod error;
pub mod grid;
pub mod octree;
pub mod samples;
pub mod span;
pub mod time;

pub use brick::{BitMask, BrickLayout, ResidentBrick};
pub use dtype::SampleType;
pub use error::CoreError;
pub use grid::UniformGrid;
pub use octree::{LevelGeometry, NodeId, Octree};
pub use samples::Samples;
pub use span::{PayloadAddress, SpanKind, SpanRecord, SpanStatistics};
pub use time::TimeAxis;
