// Points of a mesh in the picture.
#import "shared/sight.wgsl"

@group(0) @binding(0) var<uniform> sight: Sight;
// Three numbers a point.
@group(0) @binding(1) var<storage, read> points: array<f32>;
// Column, row, depth (or, in a perspective, its inverse), and the value as an index of the table.
@group(0) @binding(2) var<storage, read_write> corners: array<vec4<f32>>;

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
