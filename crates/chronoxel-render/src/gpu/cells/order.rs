//! The order in which rays meet the faces of a mesh, in compute passes, see `cells/order.wgsl`.

use bytemuck::cast_slice;

use super::passes::{Pass, groups_for, storage_buffer, upload_all};
use super::resident::Resident;
use super::sorter::Sorter;
use crate::gpu::device::{Device, storage, uniform};
use crate::gpu::memory::Buffer;
use crate::gpu::{GpuError, import};

/// Bits of the keys that faces are sorted by.
const KEY_BITS: u32 = 32;
/// Rounds until it is looked whether keys still change.
const ROUNDS: u32 = 16;
/// The most rounds, where tetrahedra lie before each other in a circle, so that keys never come to rest: by then they have
/// grown by 2^-21 of the range of depths at most.
const MOST_ROUNDS: u32 = 512;

/// Sorts the faces of a mesh.
#[derive(Debug)]
pub(super) struct Ordering {
    clear: Pass,
    look: Pass,
    pass_on: Pass,
    key_all: Pass,
    key_chosen: Pass,
    sorter: Sorter,
    sides: Buffer,
    in_order: Buffer,
    keys: Buffer,
    has_changed: Buffer,
    has_changed_read: Buffer,
    nothing: Buffer,
}

/// What is sorted.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wanted<'a> {
    /// `Sight` of `shared/sight.wgsl`.
    pub sight: &'a Buffer,
    /// Numbers of the faces, where not all are sorted.
    pub chosen: Option<&'a Buffer>,
    pub num_faces: u32,
    /// Room for pairs of key and face.
    pub pairs: [&'a Buffer; 2],
    /// Where the numbers go in order.
    pub numbers: &'a Buffer,
}

impl Ordering {
    pub fn new(device: &Device, resident: &Resident) -> Result<Self, GpuError> {
        use wgpu::BufferUsages as Usage;
        let [read, write] = [storage(true), storage(false)];
        let bindings = [uniform(false), read, read, read, write, write, write, read, write];
        let pass = |entry, all: bool| {
            let constants = [("ALL", f64::from(u8::from(all)))];
            Pass::new(device, "order.wgsl", entry, import::CELL_ORDER, &bindings, &constants)
        };
        let (num_faces, num_cells) =
            (resident.mesh.num_faces() as u64, resident.mesh.num_tetrahedra() as u64);
        let sides = storage_buffer(device, "the tetrahedra beside faces", 8 * num_faces, Usage::COPY_DST)?;
        upload_all(device, &sides, cast_slice(&resident.mesh.sides));
        let none = Usage::empty();
        Ok(Self {
            clear: pass("clear", true)?,
            look: pass("look", true)?,
            pass_on: pass("pass_on", true)?,
            key_all: pass("key", true)?,
            key_chosen: pass("key", false)?,
            sorter: Sorter::new(device)?,
            sides,
            in_order: storage_buffer(device, "the tetrahedra before faces", 8 * num_faces, none)?,
            keys: storage_buffer(device, "the order of the tetrahedra", 4 * num_cells, none)?,
            has_changed: storage_buffer(device, "changes", 16, Usage::COPY_SRC | Usage::COPY_DST)?,
            has_changed_read: device.buffer("changes to read", 16, Usage::COPY_DST | Usage::MAP_READ)?,
            nothing: storage_buffer(device, "nothing", 16, none)?,
        })
    }

    /// Puts the faces into the order in which rays meet them.
    pub fn sort(&self, device: &Device, resident: &Resident, wanted: Wanted) -> Result<(), GpuError> {
        let resources = [
            wanted.sight,
            &resident.points,
            &resident.faces,
            &self.sides,
            &self.in_order,
            &self.keys,
            &self.has_changed,
            wanted.chosen.unwrap_or(&self.nothing),
            wanted.pairs[0],
        ]
        .map(|b| b.raw.as_entire_binding());
        let [num_faces, num_cells] =
            [resident.mesh.num_faces(), resident.mesh.num_tetrahedra()].map(|n| groups_for(n as u64));
        let mut first = Some((&self.clear, &self.look));
        let mut num_rounds = 0;
        let mut changes = true;
        while changes && num_rounds < MOST_ROUNDS {
            let mut encoder = device.raw.create_command_encoder(&Default::default());
            let mut pass = encoder.begin_compute_pass(&Default::default());
            if let Some((clear, look)) = first.take() {
                clear.run(device, &mut pass, &resources, num_cells);
                look.run(device, &mut pass, &resources, num_faces);
            }
            (1..ROUNDS).for_each(|_| self.pass_on.run(device, &mut pass, &resources, num_faces));
            drop(pass);
            encoder.clear_buffer(&self.has_changed.raw, 0, None);
            let mut pass = encoder.begin_compute_pass(&Default::default());
            self.pass_on.run(device, &mut pass, &resources, num_faces);
            drop(pass);
            encoder.copy_buffer_to_buffer(&self.has_changed.raw, 0, &self.has_changed_read.raw, 0, 16);
            device.queue.submit([encoder.finish()]);
            device.read(&self.has_changed_read.raw, 16, |bytes| changes = bytes[0] != 0)?;
            num_rounds += ROUNDS;
        }
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        let key = if wanted.chosen.is_some() { &self.key_chosen } else { &self.key_all };
        key.run(device, &mut pass, &resources, groups_for(wanted.num_faces.into()));
        drop(pass);
        device.queue.submit([encoder.finish()]);
        let (both, num) = (wanted.pairs, wanted.num_faces);
        self.sorter.sort(device, both, num, KEY_BITS, |pass, at| {
            self.sorter.take(device, pass, [both[at], both[1 - at]], wanted.numbers, num);
        });
        Ok(())
    }
}
