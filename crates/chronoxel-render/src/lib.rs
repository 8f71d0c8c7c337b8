//! Renderers: from bricks, a transfer function and a camera to a picture.
//!
//! [`mod@reference`] defines the right picture in double precision; [`cpu`] makes it fast. Neither knows of files or
//! stores.

pub mod cpu;
pub mod error;
pub mod prepared;
pub mod reference;
pub mod scene;
pub mod slices;

pub use cpu::{CpuOptions, Frame, PartialImage, kernel_name, render, render_with};
pub use error::RenderError;
pub use prepared::PreparedBrick;
pub use reference::{DenseField, render_reference, render_reference_with};
pub use scene::{DrawBrick, DrawHow, RenderStats, Scene};
pub use slices::{SliceList, SliceOrder, Slicer};
