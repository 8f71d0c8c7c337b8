//! What the host and the shaders share: the structs of `shaders/`, field by field.

use bytemuck::{Pod, Zeroable};

/// `Lighting` of `shared/lighting.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct LightingData {
    pub world_from_difference: [f32; 3],
    pub unit_from_step: f32,
    pub ambient: f32,
    pub diffuse: f32,
    pub specular: f32,
    pub specular_power: u32,
}

/// `View` of `shared/sampling.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct ViewData {
    pub start: [f32; 3],
    pub cell_edge: f32,
    pub start_per_column: [f32; 3],
    pub root_level: u32,
    pub start_per_row: [f32; 3],
    pub first_row: u32,
    pub direction: [f32; 3],
    pub num_columns: u32,
    pub direction_per_column: [f32; 3],
    pub num_rows: u32,
    pub direction_per_row: [f32; 3],
    pub is_first: u32,
    pub step_per_direction: [f32; 3],
    pub most_place: f32,
    pub last: [f32; 3],
    pub full_edge: u32,
    pub cells: [i32; 3],
    pub low_apron: u32,
    pub per_texel: [f32; 3],
    pub padding: u32,
    pub lighting: LightingData,
}

/// `Brick` of `shared/sampling.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct BrickData {
    pub origin: [f32; 3],
    pub scale: f32,
    pub texel: [f32; 3],
    pub colors: u32,
    pub index_from_texel: [f32; 2],
    pub mask: u32,
    pub payload: u32,
    pub step: u32,
    pub later: u32,
    pub later_step: u32,
    pub later_weight: f32,
}

/// `NO_LATER` of `shared/sampling.wgsl`.
pub(super) const NO_LATER: u32 = u32::MAX;

/// `NO_MASK` of `shared/sampling.wgsl`.
pub(super) const NO_MASK: u32 = u32::MAX;

/// `Constant` of `shared/sampling.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct ConstantData {
    pub color: [f32; 4],
    pub log_transmittance: f32,
    pub scale: f32,
    pub padding: [u32; 2],
}

/// `Batch` of `decode.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct BatchData {
    pub full_edge: u32,
    pub pairs: u32,
    pub slots_along: u32,
    pub row_words: u32,
    pub first_line: u32,
    pub first_job: u32,
}

/// `Job` of `decode.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct JobData {
    pub slot: u32,
    pub step: u32,
}

/// The description of a stage in a bank, as `shared/decode.wgsl` reads it.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct StageData {
    /// First word of the indices, counted from that of the payload.
    pub indices: u32,
    pub index_bits: u32,
    /// First word of the table, counted from that of the payload.
    pub table: u32,
    /// Entries of a row; 0 where the table is affine.
    pub num_entries: u32,
    pub shift: u32,
    pub factor: f32,
    pub offset: f32,
    pub padding: u32,
}

/// `Planes` of `slices.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct PlanesData {
    pub column: [f32; 3],
    pub column_offset: f32,
    pub row: [f32; 3],
    pub row_offset: f32,
    pub column_per_depth: f32,
    pub row_per_depth: f32,
    pub start: f32,
    pub is_perspective: u32,
}

/// What `place_vertex` of `slices.wgsl` is given.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct VertexData {
    /// Voxels of level 0.
    pub position: [f32; 3],
    /// Of its plane, in step lengths behind where rays start.
    pub depth: f32,
    /// The number of the box that its polygon is cut from.
    pub number: u32,
}

/// `Box` of `slices.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct BoxData {
    pub low: [f32; 3],
    pub content: u32,
    pub high: [f32; 3],
    pub padding: u32,
}

/// `CONSTANT` of `slices.wgsl`.
pub(super) const CONSTANT: u32 = 1 << 31;

/// `Sight` of `shared/sight.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct SightData {
    pub right: [f32; 3],
    pub right_offset: f32,
    pub up: [f32; 3],
    pub up_offset: f32,
    pub forward: [f32; 3],
    pub depth_offset: f32,
    pub eye: [f32; 3],
    pub scale: f32,
    pub middle: [f32; 2],
    pub least_depth: f32,
    pub keys_per_depth: f32,
    pub num_points: u32,
    pub num_cuts: u32,
    pub num_faces: u32,
    pub is_perspective: u32,
    pub num_columns: u32,
    pub num_rows: u32,
    pub tiles_across: u32,
    pub first_tile_row: u32,
    pub num_tile_rows: u32,
    pub per_half_longest: f32,
    pub first_row: u32,
    pub num_all_faces: u32,
}

/// `Scan` of `cells/scan.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct ScanData {
    pub num: u32,
    pub part: u32,
    pub padding: [u32; 2],
}

/// `Digit` of `cells/sort.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub(super) struct DigitData {
    pub num: u32,
    pub shift: u32,
    pub part: u32,
    pub num_parts: u32,
}

/// `Values` of `cells/values.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct ValuesData {
    pub first: f32,
    pub rest: f32,
    pub factor: f32,
    pub offset: f32,
    pub payload: u32,
    pub step: u32,
    pub mask: u32,
    pub padding: u32,
}

/// `Cut` of `cells/values.wgsl` and `cells/gradients.wgsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(super) struct CutData {
    pub ends: [u32; 2],
    pub weight: f32,
    pub padding: u32,
}
