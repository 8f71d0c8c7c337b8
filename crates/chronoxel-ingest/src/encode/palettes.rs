//! Windows as palettes: lum2001's codec and the vector palette, over whole windows of fixed length.

use chronoxel_codec::{
    CodecError, PayloadClass, StageClass, TableClass, UnitWindow, code_stages, decoded_range,
    product_palette, vector_palette,
};
use chronoxel_core::BrickLayout;

use super::coding::Choice;
use super::node::{NodeSteps, Piece};
use super::real::Real;

/// Entries of a palette: as many as 8-bit indices can name.
const NUM_ENTRIES: usize = 256;

/// How palettes are made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PaletteKind {
    /// DCT, bit allocation, Lloyd-Max quantisers (lum2001).
    Product,
    /// Vectors of a window's samples, trained directly.
    Vector,
}

/// The classes of payloads of one to `num_stages` stages over windows of up to `window` steps.
pub fn classes(window: u32, num_stages: usize) -> Vec<PayloadClass> {
    let windows = (0..=window.ilog2()).map(|log| 1 << log);
    windows
        .flat_map(|rows| (1..=num_stages).map(move |n| PayloadClass { stages: vec![stage_class(rows); n] }))
        .collect()
}

fn stage_class(rows: u32) -> StageClass {
    StageClass { index_bits: 8, table: TableClass::Listed { entries: NUM_ENTRIES as u32, rows }, shift: 0 }
}

/// Codes some steps of one mask, all with data, as one span.
pub fn piece<T: Real>(
    node: &NodeSteps<T>,
    steps: std::ops::Range<usize>,
    window: u32,
    kind: PaletteKind,
    num_stages: usize,
    layout: &BrickLayout,
) -> Result<Piece, CodecError> {
    let unit = UnitWindow::new(&node.samples_of(steps.clone()), node.trained(steps.start))?;
    let payload = code_stages(&unit, layout, num_stages, NUM_ENTRIES, window as usize, |unit| match kind {
        PaletteKind::Product => product_palette(unit, NUM_ENTRIES.ilog2()),
        PaletteKind::Vector => vector_palette(unit, NUM_ENTRIES),
    })?;
    let drawn_range = decoded_range(&payload, layout, steps.len() as u32)?;
    Ok(Piece { start: steps.start, len: steps.len(), window, choice: Choice::Coded(payload), drawn_range })
}
