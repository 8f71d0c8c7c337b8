//! The words of Chronoxel as types: grids, time, the octree of bricks, spans, and what a
//! resident brick is. Everything here is pure: no files, no threads, no GPU.

pub mod brick;
pub mod cache;
pub mod camera;
pub mod color;
pub mod colormap;
pub mod compare;
pub mod compositing;
pub mod dtype;
pub mod error;
pub mod grid;
pub mod image;
pub mod image8;
pub mod lighting;
pub mod metrics;
pub mod octree;
pub mod samples;
pub mod span;
pub mod time;
pub mod time_tree;
pub mod transfer;
mod transfer_json;
pub mod visibility;

pub use brick::{BitMask, BrickLayout, ResidentBrick};
pub use cache::{ByteLru, CacheCounts};
pub use camera::{Camera, PictureRays, Projection, Ray};
pub use colormap::ColorMap;
pub use compare::{ImageDifference, compare, difference_picture};
pub use dtype::SampleType;
pub use error::CoreError;
pub use grid::UniformGrid;
pub use image::{Background, ByteImage, Image};
pub use image8::Image8;
pub use lighting::Lighting;
pub use metrics::{
    BrickColors, ColorEstimate, ColorSpace, ColorSums, ColorTable, VoxelColors, approximate_spatial,
    approximate_temporal, has_one_color,
};
pub use octree::{LevelGeometry, NodeId, Octree};
pub use samples::Samples;
pub use span::{PayloadAddress, SpanKind, SpanRecord, SpanStatistics};
pub use time::TimeAxis;
pub use time_tree::{NodeFacts, NodeStatistics, TimeNode};
pub use transfer::{ResolvedTransfer, TransferDomain, TransferFunction, TransferPoint};
pub use visibility::{Eye, view_order};
