//! Tetrahedra drawn as they are, without bricks (bernardon2006, section 3.3).
//!
//! [`mod@reference`] says what the right picture is: each ray is cut by each tetrahedron, and the segments are sorted. The
//! fast renderer draws the *faces*, each once, however many tetrahedra share it (Callahan et al. 2005): they are sorted
//! by the depths of their centroids, binned to tiles of the screen, and every pixel puts them into the right order with
//! a buffer of `k` fragments. Between two successive faces lies a segment, whose colour and opacity come from a
//! pre-integrated table over the value in front, the value behind, and the length.
//!
//! What changes seldom is kept apart from what changes at every step:
//!
//! * [`CellMesh`]: the geometry, once for each mesh;
//! * [`CellView`]: projected points, sorted and binned faces, once for each camera;
//! * [`CellTable`]: the pre-integrated transfer function;
//! * the values, one per point, which [`CellRenderer::render`] is handed for every picture.
//!
//! Whether a pixel is inside the mesh between two faces is counted: a face adds the number of tetrahedra behind it, less
//! the number in front. So meshes need not be convex, may have holes, and their blocks may touch without sharing points.
//!
//! # On a GPU
//!
//! The parts have the shapes that compute passes need. Points, faces and the sorted lists of the tiles stay in storage
//! buffers; a step sends one number per point (or nothing, where a pass decodes them: one mean and two indices per point,
//! tables of a few hundred entries). A workgroup takes a tile and goes through its list in batches: each thread sets up one
//! face of the batch into workgroup memory, then each thread takes its pixel through the batch. The buffer of `k`
//! fragments is an array of `k` pairs of registers, depth and payload, of constant indices, by the same network of
//! compare and swap as here; no atomics, no feedback from the picture. The sort is a radix sort of as many passes as here, with
//! histograms per workgroup; binning is the same counting twice, with a prefix sum in between.

mod face_sort;
mod gradient;
mod importance;
mod lanes;
pub(crate) mod mesh;
pub(crate) mod raster;
pub mod reference;
pub mod segment;
pub(crate) mod table;
pub(crate) mod tile;
pub(crate) mod view;
pub(crate) mod visibility;

pub use importance::{FaceChoice, FaceOrder, Variation, static_importance};
pub use mesh::CellMesh;
pub use raster::{CellOptions, CellRenderer, CellScene, CellStats};
pub use reference::render_cells_reference;
pub use table::CellTable;
pub use view::CellView;
