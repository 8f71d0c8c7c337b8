//! One step of a Zarr array, read in layers as high as its chunks.

use std::ops::Range;

use chronoxel_core::Samples;

use super::chunks::ChunkReader;
use super::metadata::ArrayMetadata;
use crate::sources::samples::SampleFormat;
use crate::{SourceError, StepReader};

/// Layers of all the steps that one row of chunks holds, so that the next step need not decode them again.
#[derive(Default)]
pub(crate) struct KeptLayers {
    /// Which chunks along the time axis these are.
    chunk_t: Option<usize>,
    /// Per chunk along z: the samples, `[t, z, y, x]`, once they were needed.
    layers: Vec<Option<Samples>>,
}

/// Bytes of one layer of chunks, cut to the volume.
pub(crate) fn layer_bytes(array: &ArrayMetadata, dims: [usize; 3]) -> u64 {
    let height = array.chunk[array.chunk.len() - 3].min(dims[2] as u64);
    bytes_of(array, [dims[0] as u64, dims[1] as u64, height])
}

/// Bytes of the steps that one row of chunks holds, where they are kept: several, and at most `most_bytes`.
pub(crate) fn kept_bytes(array: &ArrayMetadata, dims: [usize; 3], most_bytes: u64) -> Option<u64> {
    let per_chunk = if array.shape.len() == 4 { array.chunk[0].min(array.shape[0]) } else { 1 };
    let bytes = bytes_of(array, dims.map(|n| n as u64)).saturating_mul(per_chunk);
    (per_chunk > 1 && bytes <= most_bytes).then_some(bytes)
}

/// Bytes of a box of decoded samples.
fn bytes_of(array: &ArrayMetadata, size: [u64; 3]) -> u64 {
    let held = SampleFormat::scalar(array.sample_type, false).held_bytes();
    size.into_iter().fold(held as u64, u64::saturating_mul)
}

/// Reads a step layer by layer.
pub(crate) struct LayerReader<'a> {
    array: &'a ArrayMetadata,
    chunks: ChunkReader<'a>,
    /// `None` where a chunk holds one step, or too much to keep.
    kept: Option<&'a mut KeptLayers>,
    dims: [usize; 3],
    /// `None` where the array has no time axis.
    step: Option<usize>,
    next_slice: usize,
    /// The first slice of `layer`.
    layer_start: usize,
    layer: Samples,
}

impl<'a> LayerReader<'a> {
    /// A reader of one step, at its first slice.
    pub fn new(
        array: &'a ArrayMetadata,
        kept: &'a mut KeptLayers,
        most_kept_bytes: u64,
        dims: [usize; 3],
        step: usize,
    ) -> Self {
        Self {
            array,
            chunks: ChunkReader::new(array),
            kept: kept_bytes(array, dims, most_kept_bytes).map(|_| kept),
            dims,
            step: (array.shape.len() == 4).then_some(step),
            next_slice: 0,
            layer_start: 0,
            layer: empty(array),
        }
    }
}

/// An empty run of the kind of samples that an array becomes.
fn empty(array: &ArrayMetadata) -> Samples {
    SampleFormat::scalar(array.sample_type, false).empty()
}

/// Appends a part of a run to another of the same kind.
fn append(out: &mut Samples, from: &Samples, range: Range<usize>) {
    match (out, from) {
        (Samples::F32(out), Samples::F32(from)) => out.extend_from_slice(&from[range]),
        (Samples::F64(out), Samples::F64(from)) => out.extend_from_slice(&from[range]),
        _ => unreachable!("both are of the kind that the sample type becomes"),
    }
}

impl StepReader for LayerReader<'_> {
    fn read_slices(&mut self, num_slices: usize) -> Result<Samples, SourceError> {
        let slice_samples = self.dims[0] * self.dims[1];
        let end = self.next_slice + num_slices;
        let mut out = empty(self.array);
        while self.next_slice < end {
            let have = self.layer_start + self.layer.len() / slice_samples;
            if self.next_slice >= have {
                self.read_layer()?;
                continue;
            }
            let taken = (end - self.next_slice).min(have - self.next_slice);
            let from = (self.next_slice - self.layer_start) * slice_samples;
            append(&mut out, &self.layer, from..from + taken * slice_samples);
            self.next_slice += taken;
        }
        Ok(out)
    }
}

impl LayerReader<'_> {
    /// Samples of a chunk along z, y, x.
    fn chunk_size(&self) -> [usize; 3] {
        let first_axis = self.array.chunk.len() - 3;
        [0, 1, 2].map(|axis| self.array.chunk[first_axis + axis] as usize)
    }

    /// Reads the layer of chunks that the next slice is in.
    fn read_layer(&mut self) -> Result<(), SourceError> {
        let [nx, ny, nz] = self.dims;
        let cz = self.chunk_size()[0];
        let chunk_z = self.next_slice / cz;
        self.layer_start = chunk_z * cz;
        let ct = if self.step.is_some() { self.array.chunk[0] as usize } else { 1 };
        let (chunk_t, row) = (self.step.unwrap_or(0) / ct, self.step.unwrap_or(0) % ct);
        // The layer before goes first: there is memory for one.
        self.layer = empty(self.array);
        let Some(kept) = self.kept.take() else {
            self.layer = self.decode_layer(chunk_t, chunk_z, row..row + 1)?;
            return Ok(());
        };
        if kept.chunk_t != Some(chunk_t) {
            *kept = KeptLayers { chunk_t: Some(chunk_t), layers: vec![None; nz.div_ceil(cz)] };
        }
        if kept.layers[chunk_z].is_none() {
            let num_steps = ct.min(self.array.shape[0] as usize - chunk_t * ct);
            kept.layers[chunk_z] = Some(self.decode_layer(chunk_t, chunk_z, 0..num_steps)?);
        }
        let step_samples = cz.min(nz - self.layer_start) * ny * nx;
        if let Some(all) = &kept.layers[chunk_z] {
            append(&mut self.layer, all, row * step_samples..(row + 1) * step_samples);
        }
        self.kept = Some(kept);
        Ok(())
    }

    /// Decodes the chunks of a layer, `[t, z, y, x]`.
    ///
    /// * `rows`: the steps wanted, counted from the first of the chunks
    fn decode_layer(
        &mut self,
        chunk_t: usize,
        chunk_z: usize,
        rows: Range<usize>,
    ) -> Result<Samples, SourceError> {
        let [nx, ny, nz] = self.dims;
        let [cz, cy, cx] = self.chunk_size();
        let height = cz.min(nz - chunk_z * cz);
        let (absent, num_samples) = (self.array.absent_value, rows.len() * height * ny * nx);
        let mut layer = match empty(self.array) {
            Samples::F32(_) => Samples::F32(vec![absent as f32; num_samples]),
            Samples::F64(_) => Samples::F64(vec![absent; num_samples]),
        };
        for chunk_y in 0..ny.div_ceil(cy) {
            for chunk_x in 0..nx.div_ceil(cx) {
                let mut place: Vec<u64> = self.step.iter().map(|_| chunk_t as u64).collect();
                place.extend([chunk_z, chunk_y, chunk_x].map(|at| at as u64));
                let Some(samples) = self.chunks.read(&place)? else { continue };
                let (y, x) = (chunk_y * cy, chunk_x * cx);
                let size = [height, cy.min(ny - y), cx.min(nx - x)];
                match (&mut layer, &samples) {
                    (Samples::F32(to), Samples::F32(from)) => {
                        self.place(from, to, rows.clone(), [y, x], size)
                    }
                    (Samples::F64(to), Samples::F64(from)) => {
                        self.place(from, to, rows.clone(), [y, x], size)
                    }
                    _ => unreachable!("both are of the kind that the sample type becomes"),
                }
            }
        }
        Ok(layer)
    }

    /// Copies the part of a chunk that is inside the volume to where it belongs in the layer.
    ///
    /// * `corner`: y and x of the chunk's first sample
    /// * `size`: samples inside along z, y, x
    fn place<T: Copy>(
        &self,
        from: &[T],
        to: &mut [T],
        rows: Range<usize>,
        corner: [usize; 2],
        size: [usize; 3],
    ) {
        let [nx, ny, _] = self.dims;
        let strides = self.array.chunk_strides();
        let first_axis = strides.len() - 3;
        let [sz, sy, sx] = [0, 1, 2].map(|axis| strides[first_axis + axis]);
        for (t, row) in rows.enumerate() {
            let row_start = if self.step.is_some() { row * strides[0] } else { 0 };
            for z in 0..size[0] {
                for y in 0..size[1] {
                    let line = row_start + z * sz + y * sy;
                    let start = ((t * size[0] + z) * ny + corner[0] + y) * nx + corner[1];
                    let out = &mut to[start..start + size[2]];
                    if sx == 1 {
                        out.copy_from_slice(&from[line..line + size[2]]);
                    } else {
                        out.iter_mut().enumerate().for_each(|(x, sample)| *sample = from[line + x * sx]);
                    }
                }
            }
        }
    }
}
