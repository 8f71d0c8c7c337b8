//! Brick spans: what the cover of a node says of one run of time steps.

/// Where the bytes of a payload or a mask lie: row and node of the array of its level and window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct PayloadAddress {
    /// Row of the span that first had these bytes (see the store's `row(start, window)`).
    pub row: u32,
    /// Rank of the node among the nodes of its level, in Morton order.
    pub node: u32,
}

/// What a brick span holds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SpanKind {
    /// No data: every sample lies outside the grid or is masked.
    Empty,
    /// Every sample, apron included, is this value.
    Constant(f64),
    /// Indices and tables.
    Coded {
        /// Index into the variable's list of payload classes.
        class: u8,
        /// Where the bytes are: the span's own place, or an earlier span with equal bytes.
        at: PayloadAddress,
    },
}

/// Statistics of the source samples of a span: core samples only, masked ones left out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpanStatistics {
    /// Number of samples counted.
    pub count: u64,
    /// Smallest; NaN where `count` is 0, as are the other three.
    pub min: f64,
    /// Largest.
    pub max: f64,
    /// Mean.
    pub mean: f64,
    /// Standard deviation (of the population: divided by `count`).
    pub std: f64,
}

/// One entry of a node's cover.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpanRecord {
    /// First time step.
    pub start: u32,
    /// Number of time steps, at least 1.
    pub len: u32,
    /// Length of the window whose arrays hold the span (`len` is shorter at either end of a series).
    pub window: u32,
    /// What it holds.
    pub kind: SpanKind,
    /// Where its mask is, if any of its samples is masked.
    pub mask: Option<PayloadAddress>,
    /// Smallest and largest *decoded* sample, apron and pad included: what skipping may rely on.
    pub drawn_range: [f64; 2],
    /// Statistics of the source.
    pub statistics: SpanStatistics,
}
