//! A target for the time of a frame, held by feedback on what frames have cost.

/// How much may be drawn so that frames take a given time.
#[derive(Debug, Clone)]
pub struct Pace {
    target_ms: f64,
    limit: f64,
}

impl Pace {
    /// Nothing measured yet.
    ///
    /// * `target_ms`: the time of a frame to hold, > 0
    pub fn new(target_ms: f64) -> Self {
        Self { target_ms, limit: 0.0 }
    }

    /// The cost up to which the next frame may draw, for [`crate::CutLimits::cost`].
    pub fn cost_limit(&self) -> f64 {
        self.limit
    }

    /// Tells how long a frame took that drew so much.
    ///
    /// * `cost_drawn`: in the units of [`crate::NodeView::cost`], of the nodes that were in fact drawn
    pub fn measured(&mut self, frame_ms: f64, cost_drawn: f64) {
        self.limit = (cost_drawn * self.target_ms / frame_ms).clamp(cost_drawn / 4.0, cost_drawn * 4.0);
    }
}
