//! Selection: from a tree of bricks and a view to the list of bricks to draw, front to back; and playback larger than memory: the active cut, what
//! is in memory, what comes next, and how fast frames are.
//!
//! Pure: no files, no threads, no clock.

pub mod cut;
pub mod metric;
pub mod pace;
pub mod prefetch;
#[cfg(test)]
mod random;
pub mod residency;
pub mod select;
pub mod shares;
pub mod view;

pub use cut::{ActiveCut, CutChange, CutLimits, NodeView};
pub use metric::{
    ApproximateErrors, Estimates, NodeErrors, Place, ReferenceError, ReferenceErrors, ScalarErrors,
    StepStatistics,
};
pub use pace::Pace;
pub use prefetch::{Late, Playback, Playhead, Shown, scrubbing};
pub use residency::{Residency, ResidencyCounts, State, Tier, Want};
pub use select::{Appearance, Coherence, DrawItem, How, Selector, Tolerances};
pub use shares::Shares;
pub use view::ViewVolume;
