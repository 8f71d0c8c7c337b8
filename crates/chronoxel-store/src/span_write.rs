//! What the encoder hands to the writer: spans with their bytes.

use chronoxel_core::{BitMask, SpanStatistics};

/// What a span to be written holds.
#[derive(Debug, Clone, PartialEq)]
pub enum SpanContent {
    /// No data.
    Empty,
    /// Every sample, apron included, is this value.
    Constant(f64),
    /// A payload.
    Coded {
        /// Index into the variable's classes.
        class: u8,
        /// Canonical bytes of each stage: see `chronoxel_codec::stage_to_bytes`.
        stages: Vec<Vec<u8>>,
    },
}

/// A span to be written.
#[derive(Debug, Clone, PartialEq)]
pub struct SpanWrite {
    /// Rank of the node among those of its level, in Morton order.
    pub node_rank: u32,
    /// First step: where the node's previous span ended.
    pub start: u32,
    /// Number of steps, 1 to `window`.
    pub len: u32,
    /// Length of the window, one of the variable's.
    pub window: u32,
    /// What it holds.
    pub content: SpanContent,
    /// Masked samples over core and apron, if there are any; never with `Empty`.
    pub mask: Option<BitMask>,
    /// Smallest and largest decoded sample (`chronoxel_codec::decoded_range`); NaN for `Empty`, the value
    /// itself twice for `Constant`.
    pub drawn_range: [f64; 2],
    /// Statistics of the source's core samples inside the grid, masked ones left out.
    pub statistics: SpanStatistics,
}
