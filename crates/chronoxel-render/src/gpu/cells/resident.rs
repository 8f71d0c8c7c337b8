//! The geometry of a mesh on the GPU: uploaded once.

use std::sync::Arc;

use bytemuck::cast_slice;

use super::passes::{storage_buffer, upload_all};
use crate::RenderError;
use crate::cells::CellMesh;
use crate::cells::view::ViewFace;
use crate::gpu::GpuError;
use crate::gpu::device::Device;
use crate::gpu::memory::Buffer;

/// Most points: their numbers share a word with 4 bits.
const MOST_POINTS: usize = 1 << 28;

/// A mesh, and its buffers.
#[derive(Debug)]
pub(super) struct Resident {
    pub mesh: Arc<CellMesh>,
    /// The centre of the mesh's bounds, and half their longest side: points are in units of that, from there.
    pub centre: [f64; 3],
    pub unit: f64,
    /// Three numbers a point.
    pub points: Buffer,
    /// Three words a face, see [`face_words`].
    pub faces: Buffer,
    lit: Option<Lit>,
}

/// What gradients take.
#[derive(Debug)]
pub(super) struct Lit {
    pub cells: Buffer,
    /// Where the tetrahedra of each point start, and their numbers.
    pub around: Buffer,
    /// Three numbers a tetrahedron.
    pub gradients: Buffer,
}

impl Resident {
    pub fn new(device: &Device, mesh: Arc<CellMesh>) -> Result<Self, GpuError> {
        if mesh.num_points() > MOST_POINTS {
            let remedy = "the GPU numbers at most 2^28: draw on the CPU";
            return Err(RenderError::invalid("number of points", mesh.num_points(), remedy).into());
        }
        let [low, high] = mesh.bounds();
        let centre: [f64; 3] = std::array::from_fn(|a| 0.5 * (low[a] + high[a]));
        let longest = (0..3).map(|a| high[a] - low[a]).fold(0.0, f64::max);
        let unit = if longest > 0.0 { 0.5 * longest } else { 1.0 };
        let copied = wgpu::BufferUsages::COPY_DST;
        let points = storage_buffer(device, "the points of the mesh", 12 * mesh.num_points() as u64, copied)?;
        let place =
            |p: &[f64; 3]| -> [f32; 3] { std::array::from_fn(|a| ((p[a] - centre[a]) / unit) as f32) };
        let places: Vec<[f32; 3]> = mesh.points.iter().map(place).collect();
        upload_all(device, &points, cast_slice(&places));
        drop(places);
        let faces = storage_buffer(device, "the faces of the mesh", 12 * mesh.num_faces() as u64, copied)?;
        let words = |f: &crate::cells::mesh::Face| {
            let [a, b, c] = f.points;
            face_words([a, b, c, i32::from(f.net) as u32])
        };
        let words: Vec<[u32; 3]> = mesh.faces.iter().map(words).collect();
        upload_all(device, &faces, cast_slice(&words));
        Ok(Self { mesh, centre, unit, points, faces, lit: None })
    }

    /// What gradients take, uploaded when first asked for.
    pub fn hold_lit(&mut self, device: &Device) -> Result<(), GpuError> {
        if self.lit.is_none() {
            let (mesh, copied) = (&self.mesh, wgpu::BufferUsages::COPY_DST);
            let num_cells = mesh.num_tetrahedra() as u64;
            let cells = storage_buffer(device, "the tetrahedra of the mesh", 16 * num_cells, copied)?;
            upload_all(device, &cells, cast_slice(&mesh.tetrahedra));
            let of_points = mesh.cells_of_points();
            let words = [of_points.starts.as_slice(), &of_points.cells].concat();
            let around =
                storage_buffer(device, "the tetrahedra around points", 4 * words.len() as u64, copied)?;
            upload_all(device, &around, cast_slice(&words));
            let gradients = storage_buffer(device, "gradients", 12 * num_cells, copied)?;
            self.lit = Some(Lit { cells, around, gradients });
        }
        Ok(())
    }

    pub fn lit(&self) -> Option<&Lit> {
        self.lit.as_ref()
    }
}

/// A face as the shaders read it.
pub(super) fn face_words([a, b, c, net]: ViewFace) -> [u32; 3] {
    [a | net << 28, b, c]
}
