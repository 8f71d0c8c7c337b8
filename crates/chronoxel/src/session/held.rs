//! What of a store is in memory as it is stored: payloads and masks of brick spans.

use std::sync::Arc;

use chronoxel_codec::{Indices, Payload, Stage, Table};
use chronoxel_core::{BitMask, BrickLayout, PayloadAddress, SpanKind, SpanRecord};
use chronoxel_store::{Store, StoreError};
use rayon::prelude::*;

/// What makes what is stored of two brick spans the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct HeldKey {
    level: u8,
    window: u32,
    content: HeldContent,
    /// Masks are stored with the window of their span.
    mask: Option<PayloadAddress>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
enum HeldContent {
    Payload {
        class: u8,
        at: PayloadAddress,
    },
    /// A brick of one value, by its bits.
    Constant(u64),
}

impl HeldKey {
    /// Of a span of a node of a level; `None` where it has no data.
    pub fn new(level: u8, record: &SpanRecord) -> Option<Self> {
        let content = match record.kind {
            SpanKind::Empty => return None,
            SpanKind::Constant(value) => HeldContent::Constant(value.to_bits()),
            SpanKind::Coded { class, at } => HeldContent::Payload { class, at },
        };
        Some(Self { level, window: record.window, content, mask: record.mask })
    }

    /// The level of its node.
    pub fn level(&self) -> u8 {
        self.level
    }
}

/// A payload and a mask in memory.
#[derive(Debug, Clone)]
pub(crate) struct Held {
    /// None for a brick of one value.
    pub payload: Option<Arc<Payload>>,
    /// Where any sample is masked.
    pub mask: Option<Arc<BitMask>>,
}

impl Held {
    /// Bytes that it takes in memory, but for what is small.
    pub fn num_bytes(&self) -> usize {
        let mask = self.mask.as_ref().map_or(0, |mask| mask.bytes.len());
        self.payload.as_deref().map_or(0, payload_bytes) + mask + SMALL_BYTES
    }

    /// The most bytes that a span may take: known before it is read.
    pub fn most_bytes(store: &Store, variable: usize, record: &SpanRecord) -> usize {
        let layout = store.layout();
        let payload = match record.kind {
            SpanKind::Coded { class, .. } => {
                let class = &store.header().variables[variable].classes[usize::from(class)];
                class.stages.iter().map(|stage| stage.num_bytes(layout) + size_of::<Stage>()).sum()
            }
            _ => 0,
        };
        payload + record.mask.map_or(0, |_| layout.num_full().div_ceil(8)) + SMALL_BYTES
    }
}

/// What is counted for the entries of maps, the heads of allocations and the like.
const SMALL_BYTES: usize = 256;

/// Bytes that a payload takes in memory, but for what is small.
pub(super) fn payload_bytes(payload: &Payload) -> usize {
    let stage_bytes = |stage: &Stage| {
        let indices = match &stage.indices {
            Indices::U8(indices) => indices.len(),
            Indices::U16(indices) => 2 * indices.len(),
        };
        let entries = match &stage.table {
            Table::Affine { .. } => 0,
            Table::Listed { entries, .. } => 2 * entries.len(),
        };
        size_of::<Stage>() + indices + entries
    };
    size_of::<Payload>() + payload.stages.iter().map(stage_bytes).sum::<usize>()
}

/// A payload that decodes to one value.
pub(super) fn constant_payload(value: f64, layout: &BrickLayout) -> Payload {
    let indices = Indices::U8(vec![0; layout.num_full()]);
    Payload { stages: vec![Stage { indices, table: Table::Affine { offset: value, scale: 0.0 }, shift: 0 }] }
}

/// Reads what is stored of spans of one level, in as few reads as possible.
pub(crate) fn read_held(
    store: &Store,
    variable: usize,
    level: u8,
    records: &[SpanRecord],
) -> Vec<Result<Held, StoreError>> {
    let payloads = store.read_payloads(variable, level, records);
    let with_mask = payloads.into_par_iter().zip(records).map(|(payload, record)| {
        let mask = store.read_mask(variable, level, record)?.map(Arc::new);
        Ok(Held { payload: payload?.map(Arc::new), mask })
    });
    with_mask.collect()
}
