//! Selection: from a tree of bricks and a view to the list of bricks to draw, front to back.
//!
//! Pure: no files, no threads, no clock.

pub mod select;
pub mod view;

pub use select::{DrawItem, How, Selector};
pub use view::ViewVolume;
