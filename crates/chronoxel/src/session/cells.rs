//! A store of cells opened for drawing: from a view and a step to a picture of its tetrahedra.
//!
//! The mesh is made ready once. What is stored of a span serves all of its steps, so that a step costs its decoding and its
//! pixels. There is nothing coarser to stand in for damaged bytes: they are an error that names the file.

mod importance;
mod values;

use std::{path::Path, sync::Arc, time::Instant};

use anyhow::{Context, bail, ensure};
use chronoxel_core::{ByteLru, Camera, Image, Lighting, ResolvedTransfer, TransferFunction};
use chronoxel_render::{
    CellMesh, CellOptions, CellRenderer, CellScene, CellStats, FaceChoice, FaceOrder, GpuCellOptions,
    GpuCellRenderer, GpuCellStats, GpuCellValues, GpuInfo, GpuOptions, GpuPicture, ReadBack,
};
use chronoxel_store::{CellPayload, CellStore, Store};

use super::Moment;
pub use importance::Importance;
pub(crate) use values::{decode_into, values_between};

/// What a picture of cells shows, but for the step.
#[derive(Debug, Clone, PartialEq)]
pub struct CellShot {
    /// From where.
    pub camera: Camera,
    /// Colours and opacities, x in data units.
    pub transfer: ResolvedTransfer,
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// Lighting, or none.
    pub lighting: Option<Lighting>,
    /// Path length that opacities refer to, world units.
    pub opacity_unit: f64,
}

/// A picture of cells, and what it took.
#[derive(Debug, Clone)]
pub struct CellPicture<I = Image> {
    /// The mesh over nothing.
    pub image: I,
    /// What the renderer counted.
    pub stats: CellStats,
    /// Faces that were to be drawn, in the picture or not.
    pub num_chosen: usize,
    /// Time to read and decode, in milliseconds.
    pub fetch_ms: f64,
    /// Time to draw, in milliseconds.
    pub render_ms: f64,
    /// What the GPU did, where one drew.
    pub on_gpu: Option<GpuCellStats>,
}

/// The values of a step.
#[derive(Debug, Clone, Copy)]
pub(crate) enum StepValues<'a> {
    /// One per point.
    Decoded(&'a [f32]),
    /// As they are stored, and the step.
    Coded(&'a CellPayload, u32),
}

/// What draws.
enum Drawer {
    Cpu(Box<CellRenderer>),
    Gpu(Box<GpuCellRenderer>),
}

impl Drawer {
    fn choose(&mut self, choice: Option<FaceChoice>) {
        match self {
            Self::Cpu(renderer) => renderer.choose(choice),
            Self::Gpu(renderer) => renderer.choose(choice),
        }
    }
}

/// An open store of cells, one variable of which is drawn.
pub struct CellSession {
    store: Arc<CellStore>,
    variable: usize,
    /// The box that cameras and axes refer to.
    bounds: [[f64; 3]; 2],
    mesh: Arc<CellMesh>,
    drawer: Drawer,
    k: usize,
    order: Option<FaceOrder>,
    fraction: f64,
    payloads: ByteLru<u32, Arc<CellPayload>>,
    values: Vec<f32>,
    memory_bytes: u64,
}

/// Bytes of a point while its mesh is drawn: its place, in the world and in the picture, its variation, and values.
const BYTES_PER_POINT: u64 = 24 + 12 + 16 + 16 + 8;
/// Bytes of a tetrahedron, the most of: itself twice and its four sides, while its faces are found; two faces with what lies at them, their order and
/// the lists of the tiles, while it is drawn.
const BYTES_PER_CELL: u64 = 200;
/// Bytes that a pixel takes while a picture is made.
const BYTES_PER_PIXEL: u64 = 40;
/// Share of what the mesh leaves of the memory that the payloads of spans may take.
const PAYLOAD_SHARE: f64 = 0.4;

impl CellSession {
    /// Opens a store of cells, or of bricks and cells, to draw a variable of it, the first where none is named.
    ///
    /// * `k`: fragments that a pixel can put into order: 2, 6 or 16
    ///
    /// # Errors
    /// If the store cannot be opened or has no cells, no such variable or no finished step, or its mesh takes more memory than there may be.
    pub fn open(path: &Path, variable: Option<&str>, memory_bytes: u64, k: usize) -> anyhow::Result<Self> {
        let store = Arc::new(CellStore::open(path)?);
        let header = store.header();
        let variable = match variable {
            None => 0,
            Some(name) => header.variable(name).with_context(|| {
                let names: Vec<&str> = header.variables.iter().map(|v| v.name.as_str()).collect();
                format!("{}: no variable {name:?}; it has {}", path.display(), names.join(", "))
            })?,
        };
        if header.num_steps_finished == 0 {
            bail!("{}: no time step is finished yet; finish it with encode --resume", path.display());
        }
        let mesh_bytes = header.num_points * BYTES_PER_POINT + header.num_tetrahedra * BYTES_PER_CELL;
        ensure!(
            mesh_bytes <= memory_bytes,
            "{}: {} tetrahedra take about {}, more than --memory allows; raise it",
            path.display(),
            header.num_tetrahedra,
            crate::bytes::ByteSize(mesh_bytes)
        );
        let bounds = bounds_of(path, &store)?;
        let geometry = store.read_geometry()?;
        let mesh = CellMesh::new(geometry.points, &geometry.tetrahedra)
            .with_context(|| format!("{}: the mesh cannot be drawn", path.display()))?;
        let mesh = Arc::new(mesh);
        let options = CellOptions { k, ..CellOptions::default() };
        let drawer = Drawer::Cpu(Box::new(CellRenderer::new(Arc::clone(&mesh), options)?));
        let left = (memory_bytes - mesh_bytes) as f64 * PAYLOAD_SHARE;
        Ok(Self {
            store,
            variable,
            bounds,
            mesh,
            drawer,
            k,
            order: None,
            fraction: 1.0,
            payloads: ByteLru::new(left as usize),
            values: Vec::new(),
            memory_bytes: memory_bytes - mesh_bytes,
        })
    }

    /// Draws on a GPU from now on: says on which.
    ///
    /// # Errors
    /// If there is none, or it or the memory is too small for the mesh.
    pub fn use_gpu(&mut self, options: &GpuOptions) -> anyhow::Result<GpuInfo> {
        let of_cells = GpuCellOptions { k: self.k, ..GpuCellOptions::default() };
        let renderer = GpuCellRenderer::new(Arc::clone(&self.mesh), options, of_cells)?;
        let info = renderer.info().clone();
        self.drawer = Drawer::Gpu(Box::new(renderer));
        let choice = self.choice();
        self.drawer.choose(choice);
        Ok(info)
    }

    /// Whether a GPU draws.
    pub fn is_on_gpu(&self) -> bool {
        matches!(self.drawer, Drawer::Gpu(_))
    }

    /// The store.
    pub fn store(&self) -> &Arc<CellStore> {
        &self.store
    }

    /// The mesh.
    pub fn mesh(&self) -> &Arc<CellMesh> {
        &self.mesh
    }

    /// Index of the variable that is drawn.
    pub fn variable(&self) -> usize {
        self.variable
    }

    /// Fragments that a pixel puts into order.
    pub fn k(&self) -> usize {
        self.k
    }

    /// The box that cameras and axes refer to: that of the bricks beside the cells, where there are any.
    pub fn bounds(&self) -> [[f64; 3]; 2] {
        self.bounds
    }

    /// The length over which opacities of transfer functions are meant, where they do not say.
    pub fn opacity_unit(&self) -> f64 {
        self.store.header().opacity_unit()
    }

    /// The range of the variable over the steps that are finished.
    pub fn variable_range(&self) -> [f64; 2] {
        let variable = &self.store.header().variables[self.variable];
        [variable.min.unwrap_or(0.0), variable.max.unwrap_or(0.0)]
    }

    /// A transfer function over the variable's range.
    ///
    /// # Errors
    /// If a point of the function overflows.
    pub fn resolve(&self, transfer: &TransferFunction) -> anyhow::Result<ResolvedTransfer> {
        Ok(transfer.resolve(self.variable_range())?)
    }

    /// Bytes read so far, those of the mesh among them.
    pub fn bytes_from_disk(&self) -> u64 {
        self.store.bytes_read()
    }

    /// Memory that the mesh leaves.
    pub(crate) fn memory_left(&self) -> u64 {
        self.memory_bytes
    }

    /// The order in which faces are worth drawing, once [`Self::measure_importance`] found it.
    pub fn face_order(&self) -> Option<&FaceOrder> {
        self.order.as_ref()
    }

    /// The fraction of the faces within that is drawn.
    pub fn detail(&self) -> f64 {
        self.fraction
    }

    /// Draws a fraction of the faces within from now on, beside the boundary.
    ///
    /// # Errors
    /// If not all are to be drawn and it is not known which matter.
    pub fn set_detail(&mut self, fraction: f64) -> anyhow::Result<()> {
        if fraction == self.fraction {
            return Ok(());
        }
        ensure!(
            fraction >= 1.0 || self.order.is_some(),
            "which faces matter must be measured before some are left out"
        );
        self.fraction = fraction;
        let choice = self.choice();
        self.drawer.choose(choice);
        Ok(())
    }

    /// The faces that are to be drawn, where some are left out.
    fn choice(&self) -> Option<FaceChoice> {
        self.order.as_ref().filter(|_| self.fraction < 1.0)?.choose(self.fraction)
    }

    /// Faces that are to be drawn.
    pub fn num_chosen(&self) -> usize {
        match &self.order {
            Some(order) if self.fraction < 1.0 => {
                order.num_boundary() + (self.fraction * order.num_inner() as f64).round() as usize
            }
            _ => self.mesh.num_faces(),
        }
    }

    /// Draws a step.
    ///
    /// # Errors
    /// If the step is out of range or damaged, or the picture cannot be drawn.
    pub fn draw(&mut self, shot: &CellShot, step: usize) -> anyhow::Result<CellPicture> {
        self.draw_moment(shot, Moment::at(step))
    }

    /// Draws a moment at a step or between two, where a value is missing that is missing in either.
    ///
    /// # Errors
    /// As [`Self::draw`].
    pub fn draw_moment(&mut self, shot: &CellShot, moment: Moment) -> anyhow::Result<CellPicture> {
        let num_steps = self.store.header().num_steps_finished as usize;
        let Moment { step, weight } = moment;
        let last = step + usize::from(weight > 0.0);
        if last >= num_steps || !(0.0..1.0).contains(&weight) {
            bail!("step {last} is not in the store: its steps are 0 to {}", num_steps - 1);
        }
        let start = Instant::now();
        let payload = self.payload(step as u32)?;
        let is_decoded = weight > 0.0 || !self.is_on_gpu();
        let mut values = std::mem::take(&mut self.values);
        if is_decoded {
            decode_into(&self.store, &payload, step as u32, &mut values)?;
        }
        if weight > 0.0 {
            let mut later = Vec::new();
            self.read_values(last as u32, &mut later)?;
            values_between(&mut values, &later, weight);
        }
        let fetch_ms = start.elapsed().as_secs_f64() * 1e3;
        let of_step = match is_decoded {
            true => StepValues::Decoded(&values),
            false => StepValues::Coded(&payload, step as u32),
        };
        let picture = self.draw_values(shot, of_step, ReadBack::Floats);
        self.values = values;
        let picture = CellPicture { fetch_ms, ..picture? };
        Ok(picture.map(|image| match image {
            GpuPicture::Floats(image) => image,
            _ => unreachable!("floats were asked for"),
        }))
    }

    /// Draws values of the points.
    pub(crate) fn draw_values(
        &mut self,
        shot: &CellShot,
        values: StepValues,
        read_back: ReadBack,
    ) -> anyhow::Result<CellPicture<GpuPicture>> {
        let [width, height] = shot.size;
        let picture_bytes = width as u64 * height as u64 * BYTES_PER_PIXEL;
        ensure!(
            picture_bytes <= self.memory_bytes,
            "--size {width}x{height} takes {picture_bytes} bytes, more than --memory leaves beside the mesh; raise it"
        );
        let scene = CellScene {
            camera: shot.camera,
            transfer: shot.transfer.clone(),
            size: shot.size,
            lighting: shot.lighting,
            opacity_unit: shot.opacity_unit,
            value_range: self.variable_range(),
        };
        let num_chosen = self.num_chosen();
        let (image, stats, on_gpu) = match (&mut self.drawer, values) {
            (Drawer::Cpu(renderer), StepValues::Decoded(values)) => {
                let (image, stats) = renderer.render(&scene, values)?;
                let image = match read_back {
                    ReadBack::Floats => GpuPicture::Floats(image),
                    ReadBack::Bytes => GpuPicture::Bytes(image.to_bytes()),
                    ReadBack::Nothing => GpuPicture::Nothing,
                };
                (image, stats, None)
            }
            (Drawer::Cpu(_), StepValues::Coded(..)) => bail!("the CPU draws decoded values"),
            (Drawer::Gpu(renderer), values) => {
                let (image, stats) = renderer.render_as(&scene, &values.for_gpu(), read_back)?;
                (image, stats.cells, Some(stats))
            }
        };
        Ok(CellPicture { image, stats, num_chosen, fetch_ms: 0.0, render_ms: stats.render_ms, on_gpu })
    }

    /// Sends what is stored of a span to the GPU before it is drawn.
    pub(crate) fn prepare(&mut self, payload: &CellPayload) -> anyhow::Result<()> {
        if let Drawer::Gpu(renderer) = &mut self.drawer {
            renderer.prepare(&StepValues::Coded(payload, payload.start).for_gpu())?;
        }
        Ok(())
    }

    /// What is stored of the span of a step.
    fn payload(&mut self, step: u32) -> anyhow::Result<Arc<CellPayload>> {
        let record = self.store.span_at(self.variable, step)?;
        if let Some(payload) = self.payloads.get(&record.start) {
            return Ok(payload);
        }
        let payload = self.store.read_span(self.variable, &record)?;
        self.payloads.insert(record.start, Arc::clone(&payload), payload.num_bytes());
        Ok(payload)
    }

    /// The values of a step.
    fn read_values(&mut self, step: u32, values: &mut Vec<f32>) -> anyhow::Result<()> {
        let payload = self.payload(step)?;
        decode_into(&self.store, &payload, step, values)
    }
}

impl StepValues<'_> {
    fn for_gpu(&self) -> GpuCellValues<'_> {
        match *self {
            Self::Decoded(values) => GpuCellValues::Decoded(values),
            Self::Coded(payload, step) => GpuCellValues::Coded {
                payload: Arc::clone(&payload.payload),
                key: payload.start.into(),
                step_in_span: step - payload.start,
                missing: payload.missing.clone(),
            },
        }
    }
}

impl<I> CellPicture<I> {
    fn map<J>(self, change: impl FnOnce(I) -> J) -> CellPicture<J> {
        let Self { image, stats, num_chosen, fetch_ms, render_ms, on_gpu } = self;
        CellPicture { image: change(image), stats, num_chosen, fetch_ms, render_ms, on_gpu }
    }

    /// What must be said of a picture that is not right everywhere.
    pub fn warning(&self, k: usize) -> Option<String> {
        warning_of(self.stats.num_misordered, self.stats.num_fragments, k)
    }
}

/// What must be said of fragments that were drawn in the wrong order.
pub(crate) fn warning_of(num_misordered: u64, num_fragments: u64, k: usize) -> Option<String> {
    let remedy = match k {
        0..=2 => "use --k 6, or 16",
        3..=6 => "use --k 16",
        _ => "the mesh is too irregular for the largest k there is",
    };
    (num_misordered > 0).then(|| {
        format!(
            "{num_misordered} of {num_fragments} fragments came too late to be drawn with --k {k}: {remedy}"
        )
    })
}

/// The box of the bricks beside the cells, so that pictures of both agree, or of the points.
fn bounds_of(path: &Path, store: &CellStore) -> anyhow::Result<[[f64; 3]; 2]> {
    if store.path() == path {
        return Ok(store.header().bounds);
    }
    Ok(Store::open(path)?.header().grid.bounds())
}
