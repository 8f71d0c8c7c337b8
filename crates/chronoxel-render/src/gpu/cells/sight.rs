//! A mesh as a camera sees it: points projected, faces put into order and listed for each tile, in compute passes.
//!
//! The order in which rays meet the faces may be the CPU's, and be uploaded when it changes. Where a part of the mesh lies
//! beside or behind the camera, the plane where it begins to see cuts tetrahedra: then [`Seen`] does the projecting and
//! cutting on the CPU as well, and tiles are listed here all the same.

use bytemuck::{Zeroable, bytes_of, cast_slice};
use chronoxel_core::{Camera, Projection};

use super::CellWay;
use super::order::{Ordering, Wanted};
use super::passes::{Pass, groups_for, hold, most_binding, storage_buffer, upload_all};
use super::resident::{Resident, face_words};
use super::sorter::{Scanner, Sorter};
use crate::cells::view::{Seen, ViewFace, is_all_seen};
use crate::cells::{CellMesh, FaceChoice, visibility};
use crate::gpu::device::{Device, storage, uniform};
use crate::gpu::host::{CutData, SightData};
use crate::gpu::memory::Buffer;
use crate::gpu::timing::{Span, Timer};
use crate::gpu::{GpuError, import};

/// Columns and rows of a tile; `TILE` of `shared/sight.wgsl`.
pub(super) const TILE: usize = 8;
/// The largest depth by which faces are sorted, as floats tell depths apart; `MOST_DEPTH` of `cells/order.wgsl`.
const MOST_DEPTH: f64 = ((1u32 << 24) - 1) as f64;
/// The most tiles that are listed at once by programs on the CPU: their loops end after 2^16 rounds.
const MOST_SOFTWARE_TILES: u32 = 1 << 15;

/// What changed when a camera looked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Looked {
    pub has_changed: bool,
    /// Whether points must be given their values again.
    pub lost_values: bool,
}

/// Faces in order, and where.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Order {
    None,
    /// Sorted in passes or on the CPU, for what [`visibility::depends_on`] says.
    Sorted(CellWay, [[f64; 3]; 2]),
    /// Sorted and cut on the CPU.
    Cut,
}

#[derive(Debug)]
struct Passes {
    project: Pass,
    count: Pass,
    list: Pass,
    start: Pass,
}

impl Passes {
    fn new(device: &Device) -> Result<Self, GpuError> {
        let [read, write] = [storage(true), storage(false)];
        let of_points = [uniform(false), read, write];
        let of_lists = [uniform(false), read, read, read, write, write, write, write];
        let bin = |entry| Pass::new(device, "bin.wgsl", entry, import::CELL_BIN, &of_lists, &[]);
        Ok(Self {
            project: Pass::new(device, "place.wgsl", "project", import::CELL_PLACE, &of_points, &[])?,
            count: bin("count")?,
            list: bin("list")?,
            start: bin("start")?,
        })
    }
}

/// How a mesh is seen, and its buffers.
#[derive(Debug)]
pub(super) struct Sight {
    passes: Passes,
    sorter: Sorter,
    scanner: Scanner,
    /// Made when first asked for.
    ordering: Option<Ordering>,
    sorting: CellWay,
    seen_from: Option<(Camera, [usize; 2])>,
    /// Numbers of the faces that are drawn, where not all are.
    chosen: Option<(Vec<u32>, Option<Buffer>)>,
    order: Order,
    /// The order on the CPU, and what it depends on.
    cpu_order: Option<([[f64; 3]; 2], Vec<u32>)>,
    pub data: SightData,
    pub uniform: Buffer,
    corners: Option<Buffer>,
    cuts: Option<Buffer>,
    /// Faces as they are seen, where some are cut.
    own_faces: Option<Buffer>,
    numbers: Option<Buffer>,
    places: Option<Buffer>,
    pairs: [Option<Buffer>; 2],
    starts: Option<Buffer>,
    totals: Buffer,
    totals_read: Buffer,
    /// In place of what is only read, and of what may be written: one buffer must not be both.
    nothing: Buffer,
    unwritten: Buffer,
    /// The rows of tiles that are listed, first and number, and which pairs they are in.
    listed: Option<([u32; 2], usize)>,
    /// Faces in the picture, and pairs of tile and face.
    pub num_seen: u32,
    pub num_pairs: u32,
}

impl Sight {
    pub fn new(device: &Device, sorting: CellWay) -> Result<Self, GpuError> {
        use wgpu::BufferUsages as Usage;
        let bytes = size_of::<SightData>() as u64;
        Ok(Self {
            passes: Passes::new(device)?,
            sorter: Sorter::new(device)?,
            scanner: Scanner::new(device)?,
            ordering: None,
            sorting,
            seen_from: None,
            chosen: None,
            order: Order::None,
            cpu_order: None,
            data: Zeroable::zeroed(),
            uniform: device.buffer("the view of the mesh", bytes, Usage::UNIFORM | Usage::COPY_DST)?,
            corners: None,
            cuts: None,
            own_faces: None,
            numbers: None,
            places: None,
            pairs: [None, None],
            starts: None,
            totals: storage_buffer(device, "totals", 16, Usage::COPY_DST | Usage::COPY_SRC)?,
            totals_read: device.buffer("totals to read", 16, Usage::COPY_DST | Usage::MAP_READ)?,
            nothing: storage_buffer(device, "nothing", 16, Usage::empty())?,
            unwritten: storage_buffer(device, "nothing", 16, Usage::empty())?,
            listed: None,
            num_seen: 0,
            num_pairs: 0,
        })
    }

    /// Draws only some of the faces from now on, or all.
    pub fn choose(&mut self, choice: Option<FaceChoice>, num_faces: usize) {
        let chosen = choice.map(|c| c.faces.into_iter().filter(|f| (*f as usize) < num_faces).collect());
        self.chosen = chosen.map(|faces| (faces, None));
        self.forget();
    }

    /// Whether only some of the faces are drawn.
    pub fn leaves_out(&self) -> bool {
        self.chosen.is_some()
    }

    /// Where faces are sorted from now on.
    pub fn set_sorting(&mut self, sorting: CellWay) {
        if self.sorting != sorting {
            self.sorting = sorting;
            self.forget();
        }
    }

    /// Begins anew with the next camera.
    pub fn forget(&mut self) {
        (self.seen_from, self.order, self.cpu_order, self.listed) = (None, Order::None, None, None);
    }

    pub fn corners(&self) -> &Buffer {
        self.corners.as_ref().unwrap_or(&self.nothing)
    }

    pub fn cuts(&self) -> &Buffer {
        self.cuts.as_ref().unwrap_or(&self.nothing)
    }

    /// Points of the mesh and of its cuts.
    pub fn num_corners(&self) -> u64 {
        u64::from(self.data.num_points) + u64::from(self.data.num_cuts)
    }

    /// Faces, pairs of tile and face, and where those of each tile start; of what [`Self::list`] listed last.
    pub fn lists<'a>(&'a self, resident: &'a Resident) -> [&'a Buffer; 3] {
        let at = self.listed.map_or(0, |(_, at)| at);
        let pairs = self.pairs[at].as_ref().unwrap_or(&self.nothing);
        [self.faces(resident), pairs, self.starts.as_ref().unwrap_or(&self.nothing)]
    }

    fn faces<'a>(&'a self, resident: &'a Resident) -> &'a Buffer {
        match self.order {
            Order::Cut => self.own_faces.as_ref().unwrap_or(&self.nothing),
            _ => &resident.faces,
        }
    }

    /// Writes the view for what is submitted next.
    pub fn upload(&self, device: &Device) {
        device.upload(&self.uniform.raw, 0, bytes_of(&self.data));
    }

    /// Sees the mesh from a camera.
    pub fn look(
        &mut self,
        device: &Device,
        resident: &Resident,
        camera: &Camera,
        size: [usize; 2],
        timer: &mut Timer,
    ) -> Result<Looked, GpuError> {
        if self.seen_from == Some((*camera, size)) {
            return Ok(Looked { has_changed: false, lost_values: false });
        }
        (self.seen_from, self.listed) = (None, None);
        let span = timer.begin_alone(device, Span::View);
        self.data = SightData { num_faces: self.data.num_faces, ..sight_of(resident, camera, size) };
        let lost_values = if is_all_seen(&resident.mesh, camera) {
            self.look_at_all(device, resident, camera)?
        } else {
            self.look_and_cut(device, resident, camera, size)?;
            true
        };
        timer.end_alone(device, span);
        self.seen_from = Some((*camera, size));
        Ok(Looked { has_changed: true, lost_values })
    }

    /// Projects points, and sorts faces if they are not in order; says whether points lost their values.
    fn look_at_all(
        &mut self,
        device: &Device,
        resident: &Resident,
        camera: &Camera,
    ) -> Result<bool, GpuError> {
        let lost_values = self.hold_corners(device, 0)?;
        let wanted = Order::Sorted(self.sorting, visibility::depends_on(camera));
        let is_sorted = self.order == wanted;
        if !is_sorted {
            self.order = Order::None;
            self.own_faces = None;
            match self.sorting {
                CellWay::Cpu => self.sort_on_cpu(device, resident, camera)?,
                CellWay::Gpu => match self.sort_on_gpu(device, resident) {
                    // There is room for what is drawn, if not for what it takes to sort it.
                    Err(GpuError::MemoryTooSmall { .. }) => {
                        (self.ordering, self.pairs) = (None, [None, None]);
                        device.settle();
                        self.sort_on_cpu(device, resident, camera)?;
                    }
                    sorted => sorted?,
                },
            }
        }
        self.upload(device);
        let resources = [&self.uniform, &resident.points, self.corners()].map(|b| b.raw.as_entire_binding());
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        self.passes.project.run(device, &mut pass, &resources, groups_for(self.data.num_points.into()));
        drop(pass);
        device.queue.submit([encoder.finish()]);
        self.order = wanted;
        Ok(lost_values)
    }

    fn sort_on_gpu(&mut self, device: &Device, resident: &Resident) -> Result<(), GpuError> {
        if self.ordering.is_none() {
            self.ordering = Some(Ordering::new(device, resident)?);
        }
        self.hold_order(device, resident.mesh.num_faces())?;
        self.upload(device);
        let pairs = [0, 1].map(|i| self.pairs[i].as_ref().unwrap_or(&self.nothing));
        let wanted = Wanted {
            sight: &self.uniform,
            chosen: self.chosen.as_ref().and_then(|(_, buffer)| buffer.as_ref()),
            num_faces: self.data.num_faces,
            pairs,
            numbers: self.numbers.as_ref().unwrap_or(&self.nothing),
        };
        if let Some(ordering) = &self.ordering {
            ordering.sort(device, resident, wanted)?;
        }
        Ok(())
    }

    /// Sorts on the CPU, and uploads the order.
    fn sort_on_cpu(&mut self, device: &Device, resident: &Resident, camera: &Camera) -> Result<(), GpuError> {
        let mut numbers = self.numbers.take();
        let order = self.order_on_cpu(&resident.mesh, camera);
        let num = order.len();
        let copied = wgpu::BufferUsages::COPY_DST;
        hold(device, &mut numbers, "the order of the faces", 4 * num as u64, copied)?;
        upload_all(device, numbers.as_ref().unwrap_or(&self.nothing), cast_slice(self.cpu_order()));
        self.numbers = numbers;
        self.data.num_faces = num as u32;
        Ok(())
    }

    /// The order of the faces, sorted anew where the camera has moved so that it is another.
    fn order_on_cpu(&mut self, mesh: &CellMesh, camera: &Camera) -> &[u32] {
        let depends_on = visibility::depends_on(camera);
        self.cpu_order.take_if(|(of, _)| *of != depends_on);
        let chosen = self.chosen.as_ref().map(|(faces, _)| faces);
        let (_, order) = self.cpu_order.get_or_insert_with(|| {
            let all: Vec<u32>;
            let faces = match chosen {
                Some(faces) => faces,
                None => {
                    all = (0..mesh.num_faces() as u32).collect();
                    &all
                }
            };
            (depends_on, visibility::order(mesh, camera, faces))
        });
        order
    }

    fn cpu_order(&self) -> &[u32] {
        self.cpu_order.as_ref().map_or(&[], |(_, order)| order)
    }

    /// Makes room for an order of the faces that are drawn, and uploads which those are.
    fn hold_order(&mut self, device: &Device, num_all: usize) -> Result<(), GpuError> {
        let num = self.chosen.as_ref().map_or(num_all, |(faces, _)| faces.len()) as u64;
        self.data.num_faces = num as u32;
        if let Some((faces, buffer @ None)) = &mut self.chosen {
            let made =
                storage_buffer(device, "the faces that are drawn", 4 * num, wgpu::BufferUsages::COPY_DST)?;
            upload_all(device, &made, cast_slice(faces));
            *buffer = Some(made);
        }
        for pairs in &mut self.pairs {
            hold(device, pairs, "faces to sort", 8 * num, wgpu::BufferUsages::empty())?;
        }
        hold(device, &mut self.numbers, "the order of the faces", 4 * num, wgpu::BufferUsages::COPY_DST)?;
        Ok(())
    }

    /// Sorts, projects and cuts on the CPU.
    fn look_and_cut(
        &mut self,
        device: &Device,
        resident: &Resident,
        camera: &Camera,
        size: [usize; 2],
    ) -> Result<(), GpuError> {
        let (mesh, copied) = (&resident.mesh, wgpu::BufferUsages::COPY_DST);
        self.order = Order::None;
        let Seen { points, cuts, parts } = Seen::new(mesh, camera, size, self.order_on_cpu(mesh, camera));
        let is_seen = |face: &&ViewFace| face[..3].iter().all(|p| !points[*p as usize][0].is_nan());
        let words: Vec<[u32; 3]> =
            parts.iter().flatten().filter(is_seen).map(|face| face_words(*face)).collect();
        drop(parts);
        self.data.num_faces = words.len() as u32;
        self.data.num_cuts = cuts.len() as u32;
        let num = words.len() as u64;
        hold(device, &mut self.own_faces, "the faces that are seen", 12 * num, copied)?;
        hold(device, &mut self.numbers, "the order of the faces", 4 * num, copied)?;
        hold(device, &mut self.cuts, "cut edges", 16 * cuts.len() as u64, copied)?;
        self.hold_corners(device, cuts.len())?;
        let upload = |buffer: &Option<Buffer>, bytes: &[u8]| {
            upload_all(device, buffer.as_ref().unwrap_or(&self.nothing), bytes);
        };
        upload(&self.own_faces, cast_slice(&words));
        let in_order: Vec<u32> = (0..num as u32).collect();
        upload(&self.numbers, cast_slice(&in_order));
        let cuts: Vec<CutData> =
            cuts.iter().map(|cut| CutData { ends: cut.ends, weight: cut.weight, padding: 0 }).collect();
        upload(&self.cuts, cast_slice(&cuts));
        let place = |p: &[f32; 3]| if p[0].is_nan() { [0.0; 4] } else { [p[0], p[1], p[2], 0.0] };
        let corners: Vec<[f32; 4]> = points.iter().map(place).collect();
        upload(&self.corners, cast_slice(&corners));
        self.order = Order::Cut;
        Ok(())
    }

    /// Makes room for points of the mesh and of cuts; says whether what was there is lost.
    fn hold_corners(&mut self, device: &Device, num_cuts: usize) -> Result<bool, GpuError> {
        let bytes = 16 * (u64::from(self.data.num_points) + num_cuts as u64);
        hold(
            device,
            &mut self.corners,
            "projected points",
            bytes,
            wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC,
        )
    }

    /// Lists the faces of some rows of tiles; says whether there is room for it.
    ///
    /// * `rows`: the first, and how many
    pub fn list(
        &mut self,
        device: &Device,
        resident: &Resident,
        rows: [u32; 2],
        timer: &mut Timer,
    ) -> Result<bool, GpuError> {
        if self.listed.is_some_and(|(of, _)| of == rows) {
            return Ok(true);
        }
        let num_tiles = self.data.tiles_across * rows[1];
        if device.info.is_software && num_tiles > MOST_SOFTWARE_TILES && rows[1] > 1 {
            return Ok(false);
        }
        self.listed = None;
        [self.data.first_tile_row, self.data.num_tile_rows] = rows;
        let span = timer.begin_alone(device, Span::View);
        let none = wgpu::BufferUsages::empty();
        hold(
            device,
            &mut self.places,
            "numbers of tiles of faces",
            4 * u64::from(self.data.num_faces),
            none,
        )?;
        hold(device, &mut self.starts, "where lists of tiles start", 4 * u64::from(num_tiles) + 4, none)?;
        self.count_pairs(device, resident)?;
        let fits = self.hold_pairs(device, rows[1] == 1)?;
        if fits {
            let at = self.sort_pairs(device, resident, num_tiles);
            self.listed = Some((rows, at));
        }
        timer.end_alone(device, span);
        Ok(fits)
    }

    fn count_pairs(&mut self, device: &Device, resident: &Resident) -> Result<(), GpuError> {
        self.upload(device);
        device.upload(&self.totals.raw, 0, &[0; 16]);
        self.scanner.prepare(device, self.data.num_faces);
        let resources = self.list_resources(resident, &self.unwritten);
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        self.passes.count.run(device, &mut pass, &resources, groups_for(self.data.num_faces.into()));
        self.scanner.run(device, &mut pass, self.places.as_ref().unwrap_or(&self.nothing));
        drop(pass);
        self.scanner.copy_total(&mut encoder, &self.totals, 4);
        encoder.copy_buffer_to_buffer(&self.totals.raw, 0, &self.totals_read.raw, 0, 16);
        device.queue.submit([encoder.finish()]);
        let mut totals = [0u32; 4];
        device.read(&self.totals_read.raw, 16, |bytes| totals.copy_from_slice(cast_slice(bytes)))?;
        [self.num_seen, self.num_pairs, ..] = totals;
        Ok(())
    }

    /// Makes room for the pairs of a list, if there is; if there must be, it is an error that there is none.
    fn hold_pairs(&mut self, device: &Device, must: bool) -> Result<bool, GpuError> {
        let bytes = 8 * u64::from(self.num_pairs);
        let held: u64 = self.pairs.iter().flatten().map(Buffer::bytes).sum();
        let is_held = self.pairs.iter().all(|p| p.as_ref().is_some_and(|p| p.bytes() >= bytes));
        let fits = bytes <= most_binding(device) && 2 * bytes + 32 <= device.budget.left() + held;
        if !is_held && !fits && !must {
            return Ok(false);
        }
        if !is_held {
            self.pairs = [None, None];
            device.settle();
            for pairs in &mut self.pairs {
                hold(device, pairs, "lists of the faces of tiles", bytes, wgpu::BufferUsages::empty())?;
            }
        }
        Ok(true)
    }

    /// Makes the pairs and sorts them by tile; returns where they are then.
    fn sort_pairs(&self, device: &Device, resident: &Resident, num_tiles: u32) -> usize {
        let both = [0, 1].map(|i| self.pairs[i].as_ref().unwrap_or(&self.nothing));
        let mut encoder = device.raw.create_command_encoder(&Default::default());
        let mut pass = encoder.begin_compute_pass(&Default::default());
        let resources = self.list_resources(resident, both[0]);
        self.passes.list.run(device, &mut pass, &resources, groups_for(self.data.num_faces.into()));
        drop(pass);
        device.queue.submit([encoder.finish()]);
        let num_bits = 32 - (num_tiles - 1).leading_zeros();
        self.sorter.sort(device, both, self.num_pairs, num_bits, |pass, at| {
            let resources = self.list_resources(resident, both[at]);
            self.passes.start.run(device, pass, &resources, groups_for(u64::from(self.num_pairs) + 1));
        })
    }

    fn list_resources<'a>(
        &'a self,
        resident: &'a Resident,
        pairs: &'a Buffer,
    ) -> [wgpu::BindingResource<'a>; 8] {
        let or_nothing = |buffer: &'a Option<Buffer>| buffer.as_ref().unwrap_or(&self.nothing);
        [
            &self.uniform,
            self.corners(),
            self.faces(resident),
            or_nothing(&self.numbers),
            or_nothing(&self.places),
            pairs,
            or_nothing(&self.starts),
            &self.totals,
        ]
        .map(|b| b.raw.as_entire_binding())
    }
}

/// What the shaders need to know of a camera.
fn sight_of(resident: &Resident, camera: &Camera, size: [usize; 2]) -> SightData {
    let [right, up, forward] = camera.axes();
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let from_eye: [f64; 3] = std::array::from_fn(|a| resident.centre[a] - camera.position()[a]);
    let scaled = |axis: [f64; 3]| axis.map(|c| (c * resident.unit) as f32);
    let offset = |axis| dot(from_eye, axis) as f32;
    let bounds = resident.mesh.bounds();
    let depths = (0..8).map(|corner| {
        let place = std::array::from_fn(|a| bounds[corner >> a & 1][a] - resident.centre[a]);
        3.0 * dot(place, forward)
    });
    let [least, most] = depths.fold([f64::INFINITY, f64::NEG_INFINITY], |[l, m], d| [l.min(d), m.max(d)]);
    SightData {
        right: scaled(right),
        right_offset: offset(right),
        up: scaled(up),
        up_offset: offset(up),
        forward: scaled(forward),
        depth_offset: offset(forward),
        eye: from_eye.map(|c| (-c / resident.unit) as f32),
        scale: (0.5 * size[1] as f64 / camera.half_height()) as f32,
        middle: size.map(|n| 0.5 * n as f32),
        least_depth: least as f32,
        keys_per_depth: if most > least { (MOST_DEPTH / (most - least)) as f32 } else { 0.0 },
        num_points: resident.mesh.num_points() as u32,
        num_all_faces: resident.mesh.num_faces() as u32,
        is_perspective: u32::from(matches!(camera.projection(), Projection::Perspective { .. })),
        num_columns: size[0] as u32,
        num_rows: size[1] as u32,
        tiles_across: size[0].div_ceil(TILE) as u32,
        ..Zeroable::zeroed()
    }
}
