//! The tiles of a picture, each drawn by a workgroup.

use std::collections::HashMap;

use bytemuck::cast_slice;
use chronoxel_core::Lighting;

use super::passes::{Pass, storage_buffer, upload_all};
use super::resident::Resident;
use super::sight::Sight;
use crate::cells::CellTable;
use crate::cells::raster::{TableKey, light_table};
use crate::cells::table::{LAST_NODE, NO_VALUE};
use crate::cells::tile::{LEAST_PART, LEAST_TRANSMITTANCE, MOST_PART};
use crate::gpu::device::{Device, storage, uniform};
use crate::gpu::memory::Buffer;
use crate::gpu::timing::{Span, Timer};
use crate::gpu::{GpuError, import};

/// Bytes of the counts.
const COUNTS_BYTES: u64 = 32;
/// The most faces of a tile that programs on the CPU draw: their loops end after 2^16 rounds in all, and a batch of 64
/// takes up to 140.
const MOST_SOFTWARE_FACES: u32 = 28_000;
/// Bytes of what light does, two entries in a row.
const LIGHT_BYTES: u64 = 16 * 256;

/// A transfer function on the GPU.
#[derive(Debug)]
struct ResidentTable {
    key: TableKey,
    /// Without its entries.
    table: CellTable,
    entries: Buffer,
}

/// What was counted in a picture.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Counts {
    pub fragments: u64,
    pub misordered: u64,
}

/// Draws tiles.
#[derive(Debug)]
pub(super) struct Tiles {
    k: usize,
    /// By whether segments are lit, and whether the camera is a perspective one.
    passes: HashMap<[bool; 2], Pass>,
    table: Option<ResidentTable>,
    light: Buffer,
    lighting: Option<Lighting>,
    counts: Buffer,
    counts_read: Buffer,
    nothing: Buffer,
}

impl Tiles {
    pub fn new(device: &Device, k: usize) -> Result<Self, GpuError> {
        use wgpu::BufferUsages as Usage;
        Ok(Self {
            k,
            passes: HashMap::new(),
            table: None,
            light: device.buffer("what light does", LIGHT_BYTES, Usage::UNIFORM | Usage::COPY_DST)?,
            lighting: None,
            counts: storage_buffer(device, "counts", COUNTS_BYTES, Usage::COPY_SRC | Usage::COPY_DST)?,
            counts_read: device.buffer("counts to read", COUNTS_BYTES, Usage::COPY_DST | Usage::MAP_READ)?,
            nothing: storage_buffer(device, "nothing", 16, Usage::empty())?,
        })
    }

    /// Integrates a transfer function, unless it is that of the last picture; says whether it did.
    pub fn set_table(&mut self, device: &Device, key: TableKey) -> Result<bool, GpuError> {
        if self.table.as_ref().is_some_and(|held| held.key == key) {
            return Ok(false);
        }
        let [unit, longest] = key.2;
        let mut table = CellTable::new(&key.0, key.1, unit, longest);
        let of_table = std::mem::take(&mut table.entries);
        let entries = match self.table.take() {
            Some(held) => held.entries,
            None => {
                let bytes = size_of_val(of_table.as_slice()) as u64;
                storage_buffer(device, "the transfer function", bytes, wgpu::BufferUsages::COPY_DST)?
            }
        };
        upload_all(device, &entries, cast_slice(&of_table));
        self.table = Some(ResidentTable { key, table, entries });
        Ok(true)
    }

    /// How values are looked up; the table's entries are on the GPU alone.
    ///
    /// # Panics
    /// If none was set.
    pub fn table(&self) -> &CellTable {
        &self.table.as_ref().expect("a transfer function is set before values are placed").table
    }

    /// How segments are lit.
    pub fn set_lighting(&mut self, device: &Device, lighting: Option<Lighting>) {
        if let Some(lighting) = lighting.filter(|_| self.lighting != lighting) {
            let mut terms: Vec<[f32; 2]> = light_table(lighting).iter().map(|t| [t[0], t[1]]).collect();
            terms.resize(LIGHT_BYTES as usize / 8, [0.0; 2]);
            device.upload(&self.light.raw, 0, cast_slice(&terms));
        }
        self.lighting = lighting;
    }

    /// Begins a picture.
    pub fn begin(&self, device: &Device) {
        device.upload(&self.counts.raw, 0, &[0; COUNTS_BYTES as usize]);
    }

    /// Draws the tiles that are listed.
    pub fn draw(
        &mut self,
        device: &Device,
        sight: &Sight,
        resident: &Resident,
        cosines: Option<&Buffer>,
        gathered: &Buffer,
        timer: &mut Timer,
    ) -> Result<(), GpuError> {
        let key = [self.lighting.is_some(), sight.data.is_perspective == 1];
        if !self.passes.contains_key(&key) {
            self.passes.insert(key, new_pass(device, self.k, key)?);
        }
        let Some(table) = &self.table else { return Ok(()) };
        sight.upload(device);
        let [faces, pairs, starts] = sight.lists(resident);
        let resources = [
            &sight.uniform,
            &self.light,
            sight.corners(),
            cosines.unwrap_or(&self.nothing),
            faces,
            pairs,
            starts,
            &table.entries,
            gathered,
            &self.counts,
        ]
        .map(|b| b.raw.as_entire_binding());
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let span = timer.begin(&mut encoder, Span::Render);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        let groups = [sight.data.tiles_across, sight.data.num_tile_rows];
        self.passes[&key].run(device, &mut pass, &resources, groups);
        drop(pass);
        timer.end(&mut encoder, span);
        device.queue.submit([encoder.finish()]);
        Ok(())
    }

    /// What was counted since the picture was begun.
    ///
    /// # Errors
    /// [`GpuError::Setup`] if a tile had more faces than the driver can go through.
    pub fn finish(&self, device: &Device) -> Result<Counts, GpuError> {
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        encoder.copy_buffer_to_buffer(&self.counts.raw, 0, &self.counts_read.raw, 0, COUNTS_BYTES);
        device.queue.submit([encoder.finish()]);
        let mut words = [0u32; COUNTS_BYTES as usize / 4];
        device.read(&self.counts_read.raw, COUNTS_BYTES, |bytes| words.copy_from_slice(cast_slice(bytes)))?;
        if words[4] > 0 {
            let adapter = device.info.name.clone();
            let reason =
                format!("a tile has over {MOST_SOFTWARE_FACES} faces: draw fewer or a larger picture");
            return Err(GpuError::Setup { adapter, reason });
        }
        let count = |at: usize| u64::from(words[at]) | u64::from(words[at + 1]) << 32;
        Ok(Counts { fragments: count(0), misordered: count(2) })
    }
}

fn new_pass(device: &Device, k: usize, [lit, perspective]: [bool; 2]) -> Result<Pass, GpuError> {
    let [read, write] = [storage(true), storage(false)];
    let bindings = [uniform(false), uniform(false), read, read, read, read, read, read, write, write];
    let most_faces = if device.info.is_software { MOST_SOFTWARE_FACES } else { u32::MAX };
    let constants = [
        ("K", k as f64),
        ("LIT", f64::from(u8::from(lit))),
        ("PERSPECTIVE", f64::from(u8::from(perspective))),
        ("LEAST_TRANSMITTANCE", LEAST_TRANSMITTANCE.into()),
        ("LAST_NODE", LAST_NODE as f64),
        ("NO_VALUE", NO_VALUE.into()),
        ("LEAST_PART", LEAST_PART.into()),
        ("MOST_PART", MOST_PART.into()),
        ("MOST_FACES", most_faces.into()),
    ];
    Pass::new(device, "tiles.wgsl", "main", import::CELL_TILES, &bindings, &constants)
}
