//! Explore time-varying volumes too large for memory.
//!
//! This crate joins the parts of Chronoxel: the readers and the encoder
//! ([`chronoxel_ingest`]), the store ([`chronoxel_store`]), selection ([`chronoxel_stream`]) and rendering
//! ([`chronoxel_render`]); and it holds the command line. It has no algorithms of its own.

pub mod annotate;
pub mod bench;
mod blend;
pub mod bytes;
pub mod cli;
pub mod interrupt;
pub mod movie;
pub mod player;
pub mod process;
pub mod progress;
pub mod session;
