//! Volumes as slices: polygons on planes perpendicular to the direction of view.

mod active;
mod list;
pub mod reference;
mod slicer;

pub use list::SliceList;
pub use reference::{render_slices_reference, render_slices_reference_with};
pub use slicer::{MAX_SLICES_PER_BOX, SliceOrder, Slicer};
