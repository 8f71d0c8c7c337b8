//! Stores of cells: the tetrahedra of a mesh as they are, and the values at its points through time.
//!
//! Such a store is a Zarr v3 group of its own, in a folder `NAME.cxl` or in the folder `_cells` of a store of bricks of the
//! same source. Geometry lies in two plain arrays. Values are coded in blocks of 64 steps, by [`chronoxel_codec::encode_cells`]: a span is the whole
//! mesh over a block, or over a part of it that halving gives. A block is written at once, the header after it, so that there is no journal: a store
//! opens at every moment up to its last finished block.
//!
//! Writing: [`CellStoreWriter::create`] or [`CellStoreWriter::resume`], for each block [`CellStoreWriter::put`] for each variable and
//! [`CellStoreWriter::commit_block`], at last [`CellStoreWriter::finish`]. Reading: [`CellStore::open`],
//! [`CellStore::read_geometry`], [`CellStore::span_at`], [`CellStore::read_span`]. [`verify_cells`] checks every byte.

mod arrays;
mod geometry;
mod header;
mod spans;
mod store;
mod verify;
mod writer;

pub(crate) use header::{ATTRIBUTE, is_cell_store};

pub use geometry::CellGeometry;
pub use header::{CellClass, CellDescription, CellHeader, CellTotals, CellVariable, CellVariableDescription};
pub use spans::{CellSpanRecord, CellSpanWrite};
pub use store::{CellPayload, CellStore};
pub use verify::verify_cells;
pub use writer::CellStoreWriter;

/// Steps of a block, which is written and read by itself.
pub const BLOCK_STEPS: u32 = chronoxel_codec::BLOCK_STEPS as u32;
/// The folder of a store of cells within a store of bricks of the same source.
pub const NESTED_FOLDER: &str = "_cells";
