//! Renderers: from bricks, a transfer function and a camera to a picture.
//!
//! [`mod@reference`] defines the right picture in double precision; [`cpu`] makes it fast, and `gpu` (a feature, on by
//! default) makes it on the GPU. [`cells`] draws tetrahedra as they are. None knows of files or stores.

pub mod borders;
pub mod cells;
pub mod cpu;
pub mod error;
#[cfg(feature = "gpu")]
pub mod gpu;
pub mod prepared;
pub mod reference;
pub mod scene;
pub mod slices;

pub use borders::{LevelBorders, filter_level_borders};
pub use cells::{
    CellMesh, CellOptions, CellRenderer, CellScene, CellStats, FaceChoice, FaceOrder, Variation,
    render_cells_reference, static_importance,
};
pub use cpu::{CpuOptions, Frame, PartialImage, kernel_name, render, render_with};
pub use error::RenderError;
#[cfg(feature = "gpu")]
pub use gpu::{
    CellWay, CodedBrick, GpuBrick, GpuCellOptions, GpuCellRenderer, GpuCellStats, GpuCellValues, GpuError,
    GpuHow, GpuInfo, GpuOptions, GpuPicture, GpuRenderer, GpuStats, Interpolation, LaterStep, Method,
    ReadBack, Way,
};
pub use prepared::PreparedBrick;
pub use reference::{DenseField, render_reference, render_reference_with};
pub use scene::{DrawBrick, DrawHow, RenderStats, Scene};
pub use slices::{SliceList, SliceOrder, Slicer};
