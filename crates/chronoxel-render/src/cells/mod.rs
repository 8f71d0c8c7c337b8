//! Tetrahedra drawn as they are, without bricks (bernardon2006, section 3.3).
//!
//! [`mod@reference`] says what the right picture is: each ray is cut by each tetrahedron, and the segments are sorted. The
//! fast renderer draws the *faces*, each once, however many tetrahedra share it (Callahan et al. 2005): they are put
//! into about the order in which rays meet them, binned to tiles of the screen, and every pixel puts them into the right
//! order with a buffer of `k` fragments. Between two successive faces lies a segment, whose colour and opacity come from a
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
//! `GpuCellRenderer` (feature `gpu`) draws the same picture in compute passes, of the same parts: points, faces and the lists
//! of the tiles stay in storage buffers, and a step sends one number per point, or a row number where a pass decodes it. The
//! order of the faces is found in rounds that pass keys from tetrahedron to tetrahedron, and by a radix sort; tiles are 8 by 8
//! pixels, listed by counting, a prefix sum and a second radix sort, which keeps the order. A workgroup goes through the list of
//! its tile in batches: each invocation sets up one face and notes which pixels it covers, then each takes its own pixel
//! through the faces that cover it, with the `k` fragments in registers.

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
