//! Chronoxel: the library that joins the parts, and what the command line is made of.

pub mod annotate;
pub mod bytes;
pub mod movie;
pub mod progress;
