//! The Chronoxel store: a Zarr v3 group of compressed bricks, written so that a crash at any moment
//! leaves a store that opens, read as if every byte were hostile. The format is `docs/format.md`.
//!
//! Writing: [`StoreWriter::create`] (or [`StoreWriter::resume`]), then for each step
//! [`StoreWriter::put`] for each variable and level, [`StoreWriter::put_statistics`] for each node of the time
//! tree that it closes, and [`StoreWriter::commit_step`], at last [`StoreWriter::finish`]. Reading: [`Store::open`],
//! [`Store::spans`] for the covers of all nodes of a level at a step, [`Store::read_payload`],
//! [`Store::statistics`] for what is known of all nodes over a run of steps. [`verify()`] checks every byte and every invariant.

mod arrays;
mod cache;
pub mod cells;
pub mod chunk;
mod commit;
pub mod digest;
pub mod error;
mod files;
pub mod header;
mod header_text;
mod journal;
mod kept;
pub mod layout;
mod put;
mod resume;
mod shard;
pub mod span_write;
pub mod spans;
mod statistics;
mod statistics_read;
mod statistics_write;
pub mod store;
pub mod verify;
mod verify_shard;
mod verify_statistics;
pub mod writer;

pub use cells::{
    CellClass, CellDescription, CellGeometry, CellHeader, CellPayload, CellSpanRecord, CellSpanWrite,
    CellStore, CellStoreWriter, CellTotals, CellVariable, CellVariableDescription, verify_cells,
};
pub use chunk::stored_len;
pub use error::StoreError;
pub use header::{
    Header, LevelEntry, MeshEntry, StoreDescription, TimeTreeEntry, Totals, VariableDescription,
    VariableEntry,
};
pub use span_write::{SpanContent, SpanWrite};
pub use store::Store;
pub use verify::{VerifyReport, verify};
pub use writer::StoreWriter;
