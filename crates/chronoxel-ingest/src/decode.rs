//! Level-0 samples out of a store: brick by brick, slab by slab, or a whole step.
//!
//! Where the tree has no node of level 0, samples are interpolated in the finest ancestor that exists. Masked
//! samples, and those of empty bricks, are NaN.

use chronoxel_codec::decode_f64;
use chronoxel_core::{BrickLayout, LevelGeometry, NodeId, SpanKind, SpanRecord};
use chronoxel_store::{Store, StoreError};
use rayon::prelude::*;

/// One step of one variable of a store.
pub struct StepDecoder<'a> {
    store: &'a Store,
    variable: usize,
    step: u32,
    layout: BrickLayout,
    finest: LevelGeometry,
    /// For each level, the span of each node that holds the step.
    spans: Vec<Vec<SpanRecord>>,
}

/// Level-0 samples of a box of the grid.
#[derive(Debug, Clone, PartialEq)]
pub struct Block {
    /// The first sample, along x, y, z.
    pub first: [usize; 3],
    /// Number of samples along x, y, z.
    pub extent: [usize; 3],
    /// `[z, y, x]`; masked ones are NaN.
    pub samples: Vec<f64>,
}

impl<'a> StepDecoder<'a> {
    /// Reads what the spans of the step are.
    ///
    /// # Errors
    /// Of the store, if a step that it does not have is asked for, or its bytes are damaged.
    pub fn new(store: &'a Store, variable: usize, step: usize) -> Result<Self, StoreError> {
        let header = store.header();
        let step = step as u32;
        let spans = (0..header.levels.len())
            .map(|level| store.spans(variable, level as u8, step))
            .collect::<Result<_, _>>()?;
        Ok(Self { store, variable, step, layout: header.bricks, finest: header.geometry()[0], spans })
    }

    /// Slices that make up a layer of bricks; slabs of whole layers are decoded once.
    pub fn layer_slices(&self) -> usize {
        self.layout.edge
    }

    /// The core samples of brick `[x, y, z]` of level 0 that lie inside the grid.
    ///
    /// # Errors
    /// Of the store, if the bytes of the brick are damaged.
    pub fn brick(&self, brick: [usize; 3]) -> Result<Block, StoreError> {
        let first = brick.map(|b| b * self.layout.edge);
        let extent = std::array::from_fn(|a| (self.finest.dims[a] - first[a]).min(self.layout.edge));
        let (node, rank) = self.finest_node(brick);
        let full = self.full_brick(node.level, rank)?;
        let samples = match node.level {
            0 => self.core_of(&full, extent),
            _ => self.interpolated(&full, node, first, extent),
        };
        Ok(Block { first, extent, samples })
    }

    /// Slices `z` of constant z, `[z, y, x]`.
    ///
    /// # Errors
    /// Of the store, if the bytes of a brick are damaged.
    pub fn slab(&self, z: std::ops::Range<usize>) -> Result<Vec<f64>, StoreError> {
        let [width, height, _] = self.finest.dims;
        let mut slab = vec![f64::NAN; width * height * z.len()];
        let [nx, ny, _] = self.finest.bricks;
        for layer in z.start / self.layout.edge..z.end.div_ceil(self.layout.edge) {
            let bricks: Vec<_> = (0..ny).flat_map(|y| (0..nx).map(move |x| [x, y, layer])).collect();
            // A few bricks at a time: decoded, they are twice as large as the slab they go to.
            for batch in bricks.chunks(4 * rayon::current_num_threads()) {
                let blocks: Vec<_> = batch.par_iter().map(|&brick| self.brick(brick)).collect();
                for block in blocks {
                    block?.copy_into(&mut slab, [width, height], &z);
                }
            }
        }
        Ok(slab)
    }

    /// The node of level 0, or its finest ancestor that exists.
    fn finest_node(&self, brick: [usize; 3]) -> (NodeId, usize) {
        let mut node = NodeId::new(0, brick.map(|b| b as u32));
        loop {
            match self.store.tree().rank(node) {
                Some(rank) => return (node, rank),
                None => node = node.parent(),
            }
        }
    }

    /// Core and apron of a node, masked samples NaN.
    pub(crate) fn full_brick(&self, level: u8, rank: usize) -> Result<Vec<f64>, StoreError> {
        let span = &self.spans[usize::from(level)][rank];
        let mut samples = match span.kind {
            SpanKind::Empty => return Ok(vec![f64::NAN; self.layout.num_full()]),
            SpanKind::Constant(value) => vec![value; self.layout.num_full()],
            SpanKind::Coded { .. } => {
                let payload = self.store.read_payload(self.variable, level, span)?;
                decode_f64(&payload, &self.layout, self.step - span.start).map_err(|error| {
                    let place = format!("payload of level {level}, node {rank}, step {}", self.step);
                    let path = self.store.path().to_owned();
                    StoreError::Corrupt {
                        path,
                        field: place,
                        value: error.to_string(),
                        problem: "damaged".into(),
                    }
                })?
            }
        };
        if let Some(mask) = self.store.read_mask(self.variable, level, span)? {
            for (i, sample) in samples.iter_mut().enumerate() {
                if mask.get(i) {
                    *sample = f64::NAN;
                }
            }
        }
        Ok(samples)
    }

    fn core_of(&self, full: &[f64], [nx, ny, nz]: [usize; 3]) -> Vec<f64> {
        let (edge, low) = (self.layout.full_edge(), self.layout.low);
        let rows = (0..nz).flat_map(|z| (0..ny).map(move |y| low + edge * (low + y + edge * (low + z))));
        rows.flat_map(|start| &full[start..start + nx]).copied().collect()
    }

    /// Trilinear interpolation between the samples of an ancestor; masked where its nearest sample is.
    fn interpolated(
        &self,
        full: &[f64],
        node: NodeId,
        first: [usize; 3],
        [nx, ny, nz]: [usize; 3],
    ) -> Vec<f64> {
        let (edge, low) = (self.layout.full_edge(), self.layout.low);
        let origin = node.brick().map(|b| b as usize * self.layout.edge);
        // Place and fraction along an axis, in samples of the brick.
        let place = |axis: usize, i: usize| {
            let voxel = first[axis] + i;
            let step = 1usize << node.level;
            (voxel / step - origin[axis] + low, (voxel % step) as f64 / step as f64)
        };
        let at = |[x, y, z]: [usize; 3]| full[x + edge * (y + edge * z)];
        let mut samples = Vec::with_capacity(nx * ny * nz);
        for z in 0..nz {
            for y in 0..ny {
                for x in 0..nx {
                    samples.push(trilinear(&at, [place(0, x), place(1, y), place(2, z)]));
                }
            }
        }
        samples
    }
}

/// Interpolates between eight samples; masked ones are left out, and the result is NaN where the nearest is masked.
fn trilinear(at: &impl Fn([usize; 3]) -> f64, place: [(usize, f64); 3]) -> f64 {
    let (mut sum, mut weights) = (0.0, 0.0);
    for corner in 0..8usize {
        let side = |a: usize| corner >> a & 1;
        let weight: f64 = (0..3).map(|a| if side(a) == 1 { place[a].1 } else { 1.0 - place[a].1 }).product();
        let value = at(std::array::from_fn(|a| place[a].0 + side(a)));
        if weight > 0.0 && !value.is_nan() {
            sum += weight * value;
            weights += weight;
        }
    }
    let nearest = at(place.map(|(i, fraction)| i + usize::from(fraction > 0.5)));
    if nearest.is_nan() { f64::NAN } else { sum / weights }
}

impl Block {
    /// Copies what lies in slices `z` into them.
    fn copy_into(&self, slab: &mut [f64], [width, height]: [usize; 2], z: &std::ops::Range<usize>) {
        let [nx, ny, nz] = self.extent;
        for k in (0..nz).filter(|k| z.contains(&(self.first[2] + k))) {
            for j in 0..ny {
                let row =
                    self.first[0] + width * (self.first[1] + j + height * (self.first[2] + k - z.start));
                slab[row..row + nx].copy_from_slice(&self.samples[nx * (j + ny * k)..][..nx]);
            }
        }
    }
}

/// All level-0 samples of a step, `[z, y, x]`; masked ones are NaN.
///
/// # Errors
/// Of the store, if it does not have the step, or its bytes are damaged.
pub fn decode_step(store: &Store, variable: usize, step: usize) -> Result<Vec<f64>, StoreError> {
    let decoder = StepDecoder::new(store, variable, step)?;
    decoder.slab(0..decoder.finest.dims[2])
}
