//! lum2001's own unit of quantisation: one quantiser for each slice of the volume (section 3.4), to compare with.
//!
//! The windows of a layer of bricks start together, and for each of its slices, those of the apron too, one quantiser is
//! fitted to the samples of all bricks of the layer. A brick's table holds the tables of its slices one after
//! the other, and its 16-bit index is `256 · slice + index`. The paper stores the table of a slice once; here each brick has its
//! copy, which stored sizes count.

use chronoxel_codec::{
    CodecError, Indices, Payload, PayloadClass, ProductQuantizer, Stage, StageClass, Table, TableClass,
    decoded_range,
};
use chronoxel_core::BrickLayout;
use rayon::prelude::*;

use super::coding::Choice;
use super::node::{NodeSteps, Piece, SectionContent};
use super::palettes::{self, PaletteKind};
use super::real::Real;

/// Entries of a slice's table.
const NUM_ENTRIES: usize = 256;
const LARGEST_ENTRY: f64 = 65535.0;

/// The classes of payloads: tables of slices over whole windows, and palettes of bricks where masks come and go inside one.
pub fn classes(window: u32, layout: &BrickLayout) -> Vec<PayloadClass> {
    let mut classes = palettes::classes(window, 1);
    let entries = (layout.full_edge() * NUM_ENTRIES) as u32;
    let table = TableClass::Listed { entries, rows: window };
    classes.push(PayloadClass { stages: vec![StageClass { index_bits: 16, table, shift: 0 }] });
    classes
}

/// The scale of all samples of a layer, and a quantiser for each of its slices that has data.
struct Layer {
    offset: f64,
    width: f64,
    quantizers: Vec<Option<ProductQuantizer>>,
}

/// The pieces of the nodes of one layer of bricks, whose windows are the same steps.
///
/// # Errors
/// The place of a node that the codecs refuse, and why.
pub fn pieces<T: Real>(
    nodes: &[&NodeSteps<T>],
    window: u32,
    layout: &BrickLayout,
) -> Result<Vec<Vec<Piece>>, (usize, CodecError)> {
    let is_whole = |node: &&&NodeSteps<T>| {
        let sections = node.sections(window, true);
        matches!(&sections[..], [one] if one.content != SectionContent::Empty)
    };
    let whole: Vec<&NodeSteps<T>> = nodes.iter().filter(is_whole).copied().collect();
    let layer = Layer::fit(&whole, layout);
    let pieces = nodes.par_iter().enumerate().map(|(at, node)| {
        let pieces = node.sections(window, true).into_iter().map(|section| match section.piece() {
            Some(piece) => Ok(piece),
            None if section.width == window => layer.piece(node, window, layout),
            None => palettes::piece(node, section.steps, section.width, PaletteKind::Product, 1, layout),
        });
        pieces.collect::<Result<Vec<Piece>, CodecError>>().map_err(|source| (at, source))
    });
    pieces.collect::<Vec<_>>().into_iter().collect()
}

impl Layer {
    /// Fits the quantisers to nodes that have data at every step, under one mask each.
    fn fit<T: Real>(nodes: &[&NodeSteps<T>], layout: &BrickLayout) -> Self {
        let ranges = nodes.iter().flat_map(|node| node.analyses.iter().filter_map(|analysis| analysis.range));
        let [low, high] =
            ranges.fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], [c, d]| [a.min(c), b.max(d)]);
        let scale = ((high - low) / LARGEST_ENTRY).clamp(f64::MIN_POSITIVE, f64::MAX / LARGEST_ENTRY);
        let mut layer = Self { offset: low, width: LARGEST_ENTRY * scale, quantizers: Vec::new() };
        let fit = |z: usize| layer.fit_slice(nodes, z, layout);
        layer.quantizers = (0..layout.full_edge()).into_par_iter().map(fit).collect();
        layer
    }

    fn fit_slice<T: Real>(
        &self,
        nodes: &[&NodeSteps<T>],
        z: usize,
        layout: &BrickLayout,
    ) -> Option<ProductQuantizer> {
        let (full, low) = (layout.full_edge(), layout.low);
        let num_steps = nodes.first()?.samples.len();
        // The core's place in x and y, at any z: slices of the apron have no core of their own.
        let columns = |node: &NodeSteps<T>| -> Vec<usize> {
            let inside = node.core.iter().map(|&i| i as usize).take_while(|i| i / (full * full) == low);
            let at = inside.map(|i| i - low * full * full + z * full * full);
            at.filter(|&i| node.masks[0].as_ref().is_none_or(|mask| !mask.get(i))).collect()
        };
        let columns: Vec<Vec<usize>> = nodes.iter().map(|node| columns(node)).collect();
        let num_vectors: usize = columns.iter().map(Vec::len).sum();
        if num_vectors == 0 {
            return None;
        }
        let mut values = Vec::with_capacity(num_vectors * num_steps);
        for step in 0..num_steps {
            for (node, columns) in nodes.iter().zip(&columns) {
                let samples = node.samples[step].as_ref().expect("nodes with data at every step");
                values.extend(columns.iter().map(|&i| self.unit(samples[i])));
            }
        }
        let trained: Vec<u32> = (0..num_vectors as u32).collect();
        Some(ProductQuantizer::fit(&values, num_steps, &trained, NUM_ENTRIES.ilog2()))
    }

    fn unit<T: Real>(&self, sample: T) -> f32 {
        (((sample.to_f64() - self.offset) / self.width) as f32).clamp(0.0, 1.0)
    }

    fn piece<T: Real>(
        &self,
        node: &NodeSteps<T>,
        window: u32,
        layout: &BrickLayout,
    ) -> Result<Piece, CodecError> {
        let full = layout.full_edge();
        let (num_steps, num_entries) = (node.samples.len(), full * NUM_ENTRIES);
        let mut entries = vec![0u16; window as usize * num_entries];
        let mut indices = Vec::with_capacity(layout.num_full());
        for (z, quantizer) in self.quantizers.iter().enumerate() {
            let slice = z * full * full..(z + 1) * full * full;
            let Some(quantizer) = quantizer else {
                indices.resize(slice.end, (z * NUM_ENTRIES) as u16);
                continue;
            };
            let samples = node.samples.iter().flatten().flat_map(|step| &step[slice.clone()]);
            let values: Vec<f32> = samples.map(|&sample| self.unit(sample)).collect();
            indices.extend(quantizer.code(&values).iter().map(|&i| (z * NUM_ENTRIES) as u16 + u16::from(i)));
            for (t, row) in quantizer.table().chunks_exact(quantizer.num_entries()).enumerate() {
                let at = t * num_entries + z * NUM_ENTRIES;
                let rounded =
                    row.iter().map(|&value| (value * LARGEST_ENTRY as f32).round_ties_even() as u16);
                entries[at..].iter_mut().zip(rounded).for_each(|(entry, value)| *entry = value);
            }
        }
        let table = Table::Listed {
            offset: self.offset,
            scale: self.width / LARGEST_ENTRY,
            num_rows: window as usize,
            entries,
        };
        let payload = Payload { stages: vec![Stage { indices: Indices::U16(indices), table, shift: 0 }] };
        let drawn_range = decoded_range(&payload, layout, num_steps as u32)?;
        Ok(Piece { start: 0, len: num_steps, window, choice: Choice::Coded(payload), drawn_range })
    }
}
