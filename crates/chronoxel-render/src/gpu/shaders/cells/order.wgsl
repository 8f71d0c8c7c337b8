// Keys that put the faces of a mesh into the order in which rays meet them.
//
// Of two tetrahedra with a common face, the one on the camera's side comes first (Williams 1992). So a tetrahedron gets the
// depth of its nearest corner as its key, or more than those of the tetrahedra before it, by rounds in which each face passes
// on the key in front of it, until none changes.
#import "shared/sight.wgsl"

@group(0) @binding(0) var<uniform> sight: Sight;
@group(0) @binding(1) var<storage, read> points: array<f32>;
@group(0) @binding(2) var<storage, read> faces: array<u32>;
// For each face the tetrahedron on the side that its normal points to, and that on the other, or NO_CELL.
@group(0) @binding(3) var<storage, read> sides: array<vec2<u32>>;
// The same with that in front first; none of those that are seen from their edges.
@group(0) @binding(4) var<storage, read_write> in_order: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read_write> keys: array<atomic<u32>>;
// Whether a key changed.
@group(0) @binding(6) var<storage, read_write> has_changed: array<atomic<u32>, 4>;
// Numbers of the faces that are drawn.
@group(0) @binding(7) var<storage, read> chosen: array<u32>;
// A key, and the number of a face.
@group(0) @binding(8) var<storage, read_write> pairs: array<vec2<u32>>;

// Whether all faces are drawn.
override ALL: bool;

// The largest depth; MOST_DEPTH of `sight.rs`.
const MOST_DEPTH: f32 = 16777215.0;
// Keys between two depths, for tetrahedra that follow each other.
const DEPTH_BITS: u32 = 6u;
// In place of a tetrahedron where there is none.
const NO_CELL: u32 = 0xffffffffu;

fn point_of(number: u32) -> vec3<f32> {
    let at = 3u * number;
    return vec3<f32>(points[at], points[at + 1u], points[at + 2u]);
}

@compute @workgroup_size(256)
fn clear(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    if number < arrayLength(&keys) {
        atomicStore(&keys[number], 0xffffffffu);
    }
}

// Finds what is in front of each face, and the nearest corners of tetrahedra.
@compute @workgroup_size(256)
fn look(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    if number >= sight.num_all_faces {
        return;
    }
    let a = point_of(faces[3u * number] & POINT_BITS);
    let b = point_of(faces[3u * number + 1u]);
    let c = point_of(faces[3u * number + 2u]);
    var to_camera = -sight.forward;
    if sight.is_perspective == 1u {
        to_camera = sight.eye - a;
    }
    let along = dot(cross(b - a, c - a), to_camera);
    let at = sides[number];
    var ordered = vec2<u32>(NO_CELL);
    if along > 0.0 {
        ordered = at;
    } else if along < 0.0 {
        ordered = at.yx;
    }
    in_order[number] = ordered;
    let depth = min(min(dot(a, sight.forward), dot(b, sight.forward)), dot(c, sight.forward));
    let key = u32(clamp((3.0 * depth - sight.least_depth) * sight.keys_per_depth, 0.0, MOST_DEPTH)) << DEPTH_BITS;
    if at.x != NO_CELL {
        atomicMin(&keys[at.x], key);
    }
    if at.y != NO_CELL {
        atomicMin(&keys[at.y], key);
    }
}

// A round: a tetrahedron comes after those before it.
@compute @workgroup_size(256)
fn pass_on(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    if number >= sight.num_all_faces {
        return;
    }
    let at = in_order[number];
    if at.x == NO_CELL || at.y == NO_CELL {
        return;
    }
    let key = atomicLoad(&keys[at.x]) + 1u;
    if atomicLoad(&keys[at.y]) < key {
        atomicMax(&keys[at.y], key);
        atomicStore(&has_changed[0], 1u);
    }
}

// A face comes after the tetrahedron in front of it, or where there is none before the one behind.
@compute @workgroup_size(256)
fn key(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    if number >= sight.num_faces {
        return;
    }
    var face = number;
    if !ALL {
        face = chosen[number];
    }
    var at = in_order[face];
    if all(at == vec2<u32>(NO_CELL)) {
        at = sides[face];
        if at.x == NO_CELL {
            at = at.yx;
        }
    }
    var key: u32;
    if at.x != NO_CELL {
        key = 2u * atomicLoad(&keys[at.x]) + 1u;
    } else {
        key = 2u * atomicLoad(&keys[at.y]);
    }
    pairs[number] = vec2<u32>(key, face);
}
