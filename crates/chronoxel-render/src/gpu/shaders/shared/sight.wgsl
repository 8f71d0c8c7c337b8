// How a camera sees a mesh of tetrahedra.

struct Sight {
    // From a point of the mesh, counted from the centre of its bounds, to places right of the camera, above it, and before it.
    right: vec3<f32>,
    right_offset: f32,
    up: vec3<f32>,
    up_offset: f32,
    forward: vec3<f32>,
    depth_offset: f32,
    // Where the camera stands, in the mesh's numbers.
    eye: vec3<f32>,
    // Pixels per unit, at depth 1 in a perspective.
    scale: f32,
    // The middle of the picture, pixels.
    middle: vec2<f32>,
    // From three times a depth to the key of a tetrahedron.
    least_depth: f32,
    keys_per_depth: f32,
    num_points: u32,
    // Points where edges are cut in front of the camera.
    num_cuts: u32,
    // Faces that are drawn.
    num_faces: u32,
    is_perspective: u32,
    num_columns: u32,
    num_rows: u32,
    tiles_across: u32,
    // The rows of tiles that lists are made of.
    first_tile_row: u32,
    num_tile_rows: u32,
    // Two over the longest segment.
    per_half_longest: f32,
    // The row of pixels that the picture begins with.
    first_row: u32,
    // Faces of the mesh.
    num_all_faces: u32,
}

// Columns and rows of a tile.
const TILE: u32 = 8u;

// Three words of a face: its points, and above the first the net number of its tetrahedra in 4 signed bits.
const POINT_BITS: u32 = 0x0fffffffu;

// The number of an invocation among rows of workgroups of 256.
fn flat_number(group: vec3<u32>, num_groups: vec3<u32>, local: u32) -> u32 {
    return (group.y * num_groups.x + group.x) * 256u + local;
}
