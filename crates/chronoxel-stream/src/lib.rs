//! Selection: from a tree of bricks and a view to the list of bricks to draw, front to back.
//!
//! Pure: no files, no threads, no clock.

pub mod metric;
pub mod select;
pub mod shares;
pub mod view;

pub use metric::{
    ApproximateErrors, Estimates, NodeErrors, Place, ReferenceError, ReferenceErrors, ScalarErrors,
    StepStatistics,
};
pub use select::{Appearance, Coherence, DrawItem, How, Selector, Tolerances};
pub use shares::Shares;
pub use view::ViewVolume;
