// Points of a mesh in the picture, and keys to sort its faces by.
#import "shared/sight.wgsl"

@group(0) @binding(0) var<uniform> sight: Sight;
// Three numbers a point.
@group(0) @binding(1) var<storage, read> points: array<f32>;
// Column, row, depth (or, in a perspective, its inverse), and the value as an index of the table.
@group(0) @binding(2) var<storage, read_write> corners: array<vec4<f32>>;
// Three words a face.
@group(0) @binding(3) var<storage, read> faces: array<u32>;
// Numbers of the faces that are drawn.
@group(0) @binding(4) var<storage, read> chosen: array<u32>;
// A key, and the number of a face.
@group(0) @binding(5) var<storage, read_write> pairs: array<vec2<u32>>;

// Whether all faces are drawn.
override ALL: bool;

// The largest key; MOST_KEY of `sight.rs`.
const MOST_KEY: f32 = 16777215.0;

fn point_of(number: u32) -> vec3<f32> {
    let at = 3u * number;
    return vec3<f32>(points[at], points[at + 1u], points[at + 2u]);
}

@compute @workgroup_size(256)
fn project(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    if number >= sight.num_points {
        return;
    }
    let point = point_of(number);
    let depth = dot(point, sight.forward) + sight.depth_offset;
    let away = vec2<f32>(dot(point, sight.right) + sight.right_offset, dot(point, sight.up) + sight.up_offset);
    var scale = sight.scale;
    var w = depth;
    if sight.is_perspective == 1u {
        w = 1.0 / depth;
        scale *= w;
    }
    let place = sight.middle + vec2<f32>(away.x, -away.y) * scale;
    corners[number] = vec4<f32>(place, w, corners[number].w);
}

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
    var sum = 0.0;
    for (var i = 0u; i < 3u; i++) {
        sum += dot(point_of(faces[3u * face + i] & POINT_BITS), sight.forward);
    }
    let key = clamp((sum - sight.least_depth) * sight.keys_per_depth, 0.0, MOST_KEY);
    pairs[number] = vec2<u32>(u32(key), face);
}
