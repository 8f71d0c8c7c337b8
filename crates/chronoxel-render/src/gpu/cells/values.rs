//! Values at the points of a mesh on the GPU: uploaded, or decoded there; and what gradients make of them.

use std::collections::HashMap;
use std::sync::Arc;

use bytemuck::{Zeroable, bytes_of, cast_slice};
use chronoxel_codec::{Payload, decode_points};
use chronoxel_core::BitMask;

use super::passes::{Pass, groups_for, hold, upload_all};
use super::resident::Resident;
use super::sight::Sight;
use super::{CellWay, GpuCellValues};
use crate::RenderError;
use crate::cells::CellTable;
use crate::gpu::bank::{Banks, Place, pack_samples};
use crate::gpu::device::{Device, storage, uniform};
use crate::gpu::host::ValuesData;
use crate::gpu::memory::Buffer;
use crate::gpu::portion::check_step;
use crate::gpu::timing::{Span, Timer};
use crate::gpu::{GpuError, import};

/// `NO_MASK` of `cells/values.wgsl`.
const NO_MASK: u32 = u32::MAX;
/// The most banks of payloads: each is bound on its own.
const MOST_BANKS: usize = 64;

/// What the points were given last.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Given {
    key: u64,
    step_in_span: u32,
    first_value: f64,
    nodes_per_value: f64,
}

/// Gives points their values.
#[derive(Debug)]
pub(super) struct Values {
    place: Pass,
    decode: Pass,
    cut: Pass,
    of_cells: Pass,
    of_points: Pass,
    of_cuts: Pass,
    params: Buffer,
    uploaded: Option<Buffer>,
    cosines: Option<Buffer>,
    banks: Banks,
    /// Where the mask of each payload begins, counted from the payload, if it has one.
    masks: HashMap<u64, Option<u32>>,
    now: u64,
    given: Option<Given>,
    decoded: Vec<f32>,
    memory_bytes: u64,
    pub decoding: CellWay,
    pub num_payloads_uploaded: usize,
}

impl Values {
    /// * `memory_bytes`: what payloads may take
    pub fn new(device: &Device, decoding: CellWay, memory_bytes: u64) -> Result<Self, GpuError> {
        use wgpu::BufferUsages as Usage;
        let [read, write] = [storage(true), storage(false)];
        let of_values = [uniform(false), uniform(false), read, write, read];
        let values = |entry| Pass::new(device, "values.wgsl", entry, import::CELL_VALUES, &of_values, &[]);
        let of_gradients = [uniform(false), read, read, read, read, write, write, read];
        let gradients =
            |entry| Pass::new(device, "gradients.wgsl", entry, import::CELL_GRADIENTS, &of_gradients, &[]);
        let bytes = size_of::<ValuesData>() as u64;
        Ok(Self {
            place: values("place")?,
            decode: values("decode")?,
            cut: values("cut")?,
            of_cells: gradients("of_cells")?,
            of_points: gradients("of_points")?,
            of_cuts: gradients("of_cuts")?,
            params: device.buffer("how values are placed", bytes, Usage::UNIFORM | Usage::COPY_DST)?,
            uploaded: None,
            cosines: None,
            banks: Banks::new(memory_bytes, MOST_BANKS),
            masks: HashMap::new(),
            now: 1,
            given: None,
            decoded: Vec::new(),
            memory_bytes,
            decoding,
            num_payloads_uploaded: 0,
        })
    }

    /// Forgets what the points were given.
    pub fn forget(&mut self) {
        self.given = None;
    }

    /// Cosines between gradient and ray at the points; there are none before [`Self::light`].
    pub fn cosines(&self) -> Option<&Buffer> {
        self.cosines.as_ref()
    }

    /// Gives the points their values, unless they have them; says whether it did.
    pub fn give(
        &mut self,
        device: &Device,
        sight: &Sight,
        table: &CellTable,
        values: &GpuCellValues,
        timer: &mut Timer,
    ) -> Result<bool, GpuError> {
        let num_points = sight.data.num_points as usize;
        match values {
            GpuCellValues::Decoded(values) => {
                self.given = None;
                self.place(device, sight, table, values, timer)?;
            }
            GpuCellValues::Coded { payload, key, step_in_span, missing } => {
                let (key, step_in_span) = (*key, *step_in_span);
                let CellTable { first_value, nodes_per_value, .. } = *table;
                let wanted = Given { key, step_in_span, first_value, nodes_per_value };
                if self.given == Some(wanted) {
                    return Ok(false);
                }
                self.given = None;
                check_step(payload, step_in_span)?;
                let missing = missing.as_deref();
                if self.decoding == CellWay::Gpu {
                    self.decode(device, sight, table, (payload, missing), [key, step_in_span.into()], timer)?;
                } else {
                    let mut decoded = std::mem::take(&mut self.decoded);
                    decode_on_cpu(payload, missing, step_in_span, num_points, &mut decoded)?;
                    self.place(device, sight, table, &decoded, timer)?;
                    self.decoded = decoded;
                }
                self.given = Some(wanted);
            }
        }
        Ok(true)
    }

    /// Uploads values, and makes indices of them.
    fn place(
        &mut self,
        device: &Device,
        sight: &Sight,
        table: &CellTable,
        values: &[f32],
        timer: &mut Timer,
    ) -> Result<(), GpuError> {
        let bytes = 4 * values.len() as u64;
        hold(device, &mut self.uploaded, "values at points", bytes, wgpu::BufferUsages::COPY_DST)?;
        let first = table.first_value as f32;
        let data = ValuesData {
            first,
            rest: (table.first_value - f64::from(first)) as f32,
            factor: table.nodes_per_value as f32,
            mask: NO_MASK,
            ..Zeroable::zeroed()
        };
        if let Some(uploaded) = &self.uploaded {
            upload_all(device, uploaded, cast_slice(values));
            self.run(device, sight, &self.place, &uploaded.raw, data, timer);
        }
        Ok(())
    }

    fn decode(
        &mut self,
        device: &Device,
        sight: &Sight,
        table: &CellTable,
        (payload, missing): (&Arc<Payload>, Option<&BitMask>),
        [key, step]: [u64; 2],
        timer: &mut Timer,
    ) -> Result<(), GpuError> {
        let place = self.hold_payload(device, key, payload, missing, sight.data.num_points as usize)?;
        let data = ValuesData {
            factor: (place.range.width * table.nodes_per_value) as f32,
            offset: ((place.range.low - table.first_value) * table.nodes_per_value) as f32,
            payload: place.word,
            step: step as u32,
            mask: self.masks.get(&key).copied().flatten().map_or(NO_MASK, |mask| place.word + mask),
            ..Zeroable::zeroed()
        };
        if let Some(bank) = self.banks.raw(place.bank) {
            self.run(device, sight, &self.decode, bank, data, timer);
        }
        Ok(())
    }

    /// Makes a payload resident, at the cost of those that were used least recently.
    pub fn hold_payload(
        &mut self,
        device: &Device,
        key: u64,
        payload: &Payload,
        missing: Option<&BitMask>,
        num_points: usize,
    ) -> Result<Place, GpuError> {
        self.now += 1;
        if let Some(place) = self.banks.get(key, self.now) {
            return Ok(place);
        }
        let mut packed = pack_samples(payload, num_points)?;
        let mask = match missing {
            Some(mask) => Some(packed.append_point_mask(mask, num_points)?),
            None => None,
        };
        loop {
            if let Some(place) = self.banks.put(device, key, &packed, self.now)? {
                let banks = &self.banks;
                self.masks.retain(|key, _| banks.holds(*key));
                self.masks.insert(key, mask);
                self.num_payloads_uploaded += 1;
                return Ok(place);
            }
            if !self.banks.forget_oldest(self.now) {
                let (what, needed) = ("the payload of a span", 4 * packed.words.len() as u64);
                let given = device.budget.limit();
                let least = given.saturating_mul(needed).div_ceil(self.memory_bytes.max(1)).max(given + 1);
                return Err(GpuError::MemoryTooSmall { given, what, needed, least });
            }
        }
    }

    fn run(
        &self,
        device: &Device,
        sight: &Sight,
        how: &Pass,
        bank: &wgpu::Buffer,
        data: ValuesData,
        timer: &mut Timer,
    ) {
        sight.upload(device);
        device.upload(&self.params.raw, 0, bytes_of(&data));
        let [sight_data, params, corners, cuts] =
            [&sight.uniform, &self.params, sight.corners(), sight.cuts()].map(|b| b.raw.as_entire_binding());
        let resources = [sight_data, params, bank.as_entire_binding(), corners, cuts];
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let span = timer.begin(&mut encoder, Span::Decode);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        how.run(device, &mut pass, &resources, groups_for(sight.data.num_points.into()));
        if sight.data.num_cuts > 0 {
            self.cut.run(device, &mut pass, &resources, groups_for(sight.data.num_cuts.into()));
        }
        drop(pass);
        timer.end(&mut encoder, span);
        device.queue.submit([encoder.finish()]);
    }

    /// Finds the cosines between gradient and ray.
    pub fn light(
        &mut self,
        device: &Device,
        sight: &Sight,
        resident: &mut Resident,
        timer: &mut Timer,
    ) -> Result<(), GpuError> {
        resident.hold_lit(device)?;
        let none = wgpu::BufferUsages::empty();
        hold(device, &mut self.cosines, "cosines at points", 4 * sight.num_corners(), none)?;
        let (Some(lit), Some(cosines)) = (resident.lit(), &self.cosines) else { return Ok(()) };
        sight.upload(device);
        let resources = [
            &sight.uniform,
            &resident.points,
            sight.corners(),
            &lit.cells,
            &lit.around,
            &lit.gradients,
            cosines,
            sight.cuts(),
        ]
        .map(|b| b.raw.as_entire_binding());
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let span = timer.begin(&mut encoder, Span::Decode);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        let num_cells = resident.mesh.num_tetrahedra() as u64;
        self.of_cells.run(device, &mut pass, &resources, groups_for(num_cells));
        self.of_points.run(device, &mut pass, &resources, groups_for(sight.data.num_points.into()));
        if sight.data.num_cuts > 0 {
            self.of_cuts.run(device, &mut pass, &resources, groups_for(sight.data.num_cuts.into()));
        }
        drop(pass);
        timer.end(&mut encoder, span);
        device.queue.submit([encoder.finish()]);
        Ok(())
    }
}

/// Decodes a step of a payload; NaN where points are missing.
fn decode_on_cpu(
    payload: &Payload,
    missing: Option<&BitMask>,
    step_in_span: u32,
    num_points: usize,
    values: &mut Vec<f32>,
) -> Result<(), GpuError> {
    values.resize(num_points, 0.0);
    decode_points(payload, step_in_span, values)?;
    if let Some(mask) = missing {
        if mask.bytes.len() != num_points.div_ceil(8) {
            let remedy = "it must have one bit per point of the mesh";
            return Err(RenderError::invalid("bytes of the mask of points", mask.bytes.len(), remedy).into());
        }
        let is_missing = |i: usize| mask.bytes[i / 8] >> (i % 8) & 1 == 1;
        values.iter_mut().enumerate().filter(|(i, _)| is_missing(*i)).for_each(|(_, v)| *v = f32::NAN);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use chronoxel_codec::{CellCodecOptions, OneWorker, encode_cells};
    use chronoxel_core::{Camera, ColorMap, TransferFunction};

    use super::*;
    use crate::cells::{CellMesh, CellScene};
    use crate::gpu::cells::{GpuCellOptions, GpuCellRenderer};
    use crate::gpu::{GpuOptions, twins};

    const NUM_POINTS: usize = 700;

    /// Indices of the table that the points were given.
    fn indices(gpu: &GpuCellRenderer) -> Vec<f32> {
        use wgpu::BufferUsages as Usage;
        let bytes = 16 * NUM_POINTS as u64;
        let to = gpu.device.buffer("read", bytes, Usage::COPY_DST | Usage::MAP_READ).unwrap();
        let mut encoder = gpu.device.raw.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(&gpu.sight.corners().raw, 0, &to.raw, 0, bytes);
        gpu.device.queue.submit([encoder.finish()]);
        let mut found = Vec::new();
        let take = |b: &[u8]| found.extend(cast_slice::<u8, [f32; 4]>(b).iter().map(|corner| corner[3]));
        gpu.device.read(&to.raw, bytes, take).unwrap();
        found
    }

    fn mesh() -> Arc<CellMesh> {
        let place = |i: usize| [i as f64, f64::from(i.is_multiple_of(2)), f64::from(i.is_multiple_of(3))];
        let cells: Vec<[u32; 4]> = (3..NUM_POINTS as u32).map(|i| [i - 3, i - 2, i - 1, i]).collect();
        Arc::new(CellMesh::new((0..NUM_POINTS).map(place).collect(), &cells).unwrap())
    }

    fn payload(offset: f32, entries: usize) -> Arc<Payload> {
        let value = |t: usize, i: usize| offset + (0.3 * i as f32 + 0.1 * t as f32).sin();
        let steps: Vec<Vec<f32>> = (0..64).map(|t| (0..NUM_POINTS).map(|i| value(t, i)).collect()).collect();
        let borrowed: Vec<&[f32]> = steps.iter().map(Vec::as_slice).collect();
        let options = CellCodecOptions { entries, max_error: None };
        Arc::new(encode_cells(&borrowed, &options, &OneWorker).unwrap().remove(0).payload)
    }

    #[test]
    fn indices_are_those_of_the_values_decoded_on_the_cpu() {
        if twins::device().is_none() {
            return;
        }
        let mesh = mesh();
        let memory = GpuOptions { memory_bytes: 64 << 20, ..Default::default() };
        let function = TransferFunction::built_in("ramp", ColorMap::Gray).unwrap();
        for (offset, entries) in [(0.0f32, 16), (101_325.0, 16), (0.5, 300)] {
            let payload = payload(offset, entries);
            let range = [-1.0, 1.0].map(|v| v + f64::from(offset));
            let scene = CellScene {
                camera: Camera::orbit(mesh.bounds(), 0.0, 0.0, 1.0, None, 1.0).unwrap(),
                transfer: function.resolve(range).unwrap(),
                size: [16, 16],
                lighting: None,
                opacity_unit: 1.0,
                value_range: range,
            };
            let mut gpu =
                GpuCellRenderer::new(Arc::clone(&mesh), &memory, GpuCellOptions::default()).unwrap();
            for step_in_span in [0, 7, 63] {
                let mut values = vec![0.0; NUM_POINTS];
                decode_points(&payload, step_in_span, &mut values).unwrap();
                let coded = GpuCellValues::Coded {
                    payload: Arc::clone(&payload),
                    key: 7,
                    step_in_span,
                    missing: None,
                };
                // What 32 bits tell apart, in the range of the values, which is 2: the indices' roundings, and for coded
                // values those of their sums; the CPU's values themselves are rounded where they are large.
                let of_value = offset.abs() * f32::EPSILON * 0.5;
                let bounds = [1.5 * f32::EPSILON, 4.0 * f32::EPSILON + of_value];
                for (given, bound) in [GpuCellValues::Decoded(&values), coded].iter().zip(bounds) {
                    gpu.render(&scene, given).unwrap();
                    for (found, value) in indices(&gpu).into_iter().zip(&values) {
                        let expected = (f64::from(*value) - range[0]) / 2.0;
                        let difference = (f64::from(found) / 254.0 - expected).abs();
                        assert!(difference <= bound.into(), "{offset} {step_in_span}: {difference} {bound}");
                    }
                }
            }
        }
    }
}
