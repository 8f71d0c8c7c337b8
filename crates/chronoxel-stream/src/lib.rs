//! Selection and caching: from a tree of bricks and a view to the list of bricks to draw, front to back,
//! and which of them stay in memory.
//!
//! Pure: no files, no threads, no clock.

pub mod cache;
pub mod select;
pub mod view;

pub use cache::{ByteLru, CacheCounts};
pub use select::{DrawItem, How, Selector};
pub use view::ViewVolume;
