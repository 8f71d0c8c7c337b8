//! Volumes as slices: polygons on planes perpendicular to the direction of view.

mod active;
mod list;
mod slicer;

pub use list::SliceList;
pub use slicer::{MAX_SLICES_PER_BOX, SliceOrder, Slicer};
