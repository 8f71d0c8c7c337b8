// Cosines between gradient and ray at the points of a mesh: gradients in its tetrahedra, their sums around each point.
#import "shared/sight.wgsl"
#import "shared/missing.wgsl"

struct Cut {
    ends: vec2<u32>,
    weight: f32,
    padding: u32,
}

@group(0) @binding(0) var<uniform> sight: Sight;
@group(0) @binding(1) var<storage, read> points: array<f32>;
@group(0) @binding(2) var<storage, read> corners: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> cells: array<vec4<u32>>;
// For each point, where its tetrahedra start behind these words, and the end; then numbers of tetrahedra.
@group(0) @binding(4) var<storage, read> around: array<u32>;
// Three numbers a tetrahedron.
@group(0) @binding(5) var<storage, read_write> gradients: array<f32>;
@group(0) @binding(6) var<storage, read_write> cosines: array<f32>;
@group(0) @binding(7) var<storage, read> cuts: array<Cut>;

fn point_of(number: u32) -> vec3<f32> {
    let at = 3u * number;
    return vec3<f32>(points[at], points[at + 1u], points[at + 2u]);
}

// The gradient in a tetrahedron times six times its volume; zero where a value is missing.
@compute @workgroup_size(256)
fn of_cells(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    if number >= arrayLength(&cells) {
        return;
    }
    let cell = cells[number];
    let a = point_of(cell.x);
    let ab = point_of(cell.y) - a;
    let ac = point_of(cell.z) - a;
    let ad = point_of(cell.w) - a;
    let values = vec4<f32>(corners[cell.x].w, corners[cell.y].w, corners[cell.z].w, corners[cell.w].w);
    var sum = vec3<f32>(0.0);
    // Infinite values have indices of that size.
    if all(abs(values) < vec4<f32>(MOST_INDEX)) {
        let rise = values.yzw - values.x;
        sum = rise.x * cross(ac, ad) + rise.y * cross(ad, ab) + rise.z * cross(ab, ac);
    }
    for (var i = 0u; i < 3u; i++) {
        gradients[3u * number + i] = sum[i];
    }
}

@compute @workgroup_size(256)
fn of_points(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    if number >= sight.num_points {
        return;
    }
    var sum = vec3<f32>(0.0);
    let base = sight.num_points + 1u;
    for (var i = around[number]; i < around[number + 1u]; i++) {
        let at = 3u * around[base + i];
        sum += vec3<f32>(gradients[at], gradients[at + 1u], gradients[at + 2u]);
    }
    cosines[number] = cosine_of(sum, point_of(number));
}

// Where there is no gradient it faces the lamp.
fn cosine_of(gradient: vec3<f32>, point: vec3<f32>) -> f32 {
    let most = max(max(abs(gradient.x), abs(gradient.y)), abs(gradient.z));
    if !(most > 0.0) {
        return 1.0;
    }
    var ray = sight.forward;
    if sight.is_perspective == 1u {
        ray = point - sight.eye;
    }
    // Scaled first, so that squares neither vanish nor overflow.
    let scaled = gradient / most;
    let squares = dot(scaled, scaled) * dot(ray, ray);
    if !(squares > 0.0) {
        return 1.0;
    }
    return dot(scaled, ray) / sqrt(squares);
}

@compute @workgroup_size(256)
fn of_cuts(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    if number >= sight.num_cuts {
        return;
    }
    let at = cuts[number];
    let a = cosines[at.ends.x];
    let b = cosines[at.ends.y];
    cosines[sight.num_points + number] = a + (b - a) * at.weight;
}
