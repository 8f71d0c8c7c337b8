// A plain ray caster over one 3-D texture that holds the whole volume: no bricks, nothing skipped but what lies behind what
// is opaque. Samples, colours and light are those of Chronoxel's own ray casters.

struct View {
    // Where rays start, voxels: at the corner of the picture, and from pixel to pixel.
    start: vec3<f32>,
    num_columns: u32,
    start_per_column: vec3<f32>,
    num_rows: u32,
    start_per_row: vec3<f32>,
    is_lit: u32,
    // Their direction in the world, not of unit length.
    direction: vec3<f32>,
    least_transmittance: f32,
    direction_per_column: vec3<f32>,
    // From what the texture holds to the index of a colour.
    index_factor: f32,
    direction_per_row: vec3<f32>,
    index_offset: f32,
    // From a unit vector in the world to the voxels from sample to sample.
    step_per_direction: vec3<f32>,
    ambient: f32,
    // The far corner of the grid, voxels.
    last: vec3<f32>,
    diffuse: f32,
    world_from_difference: vec3<f32>,
    specular: f32,
    unit_from_step: f32,
    specular_power: f32,
}

@group(0) @binding(0) var<uniform> view: View;
// Of one sample, premultiplied.
@group(0) @binding(1) var<storage, read> colors: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> pixels: array<u32>;
@group(0) @binding(3) var volume: texture_3d<f32>;
@group(0) @binding(4) var linear: sampler;

fn value_at(place: vec3<f32>) -> f32 {
    return textureSampleLevel(volume, linear, (place + 0.5) / (view.last + 1.0), 0.0).x;
}

fn difference_at(place: vec3<f32>) -> vec3<f32> {
    let x = vec3<f32>(1.0, 0.0, 0.0);
    let y = vec3<f32>(0.0, 1.0, 0.0);
    let z = vec3<f32>(0.0, 0.0, 1.0);
    return vec3<f32>(
        value_at(place + x) - value_at(place - x),
        value_at(place + y) - value_at(place - y),
        value_at(place + z) - value_at(place - z),
    );
}

// The factor of the colour, and the highlight of a light at the eye.
fn light(place: vec3<f32>, step: vec3<f32>) -> vec2<f32> {
    let difference = difference_at(place);
    let gradient = difference * view.world_from_difference;
    let square = dot(gradient, gradient);
    if !(square > 0.0) {
        return vec2<f32>(1.0, 0.0);
    }
    let cosine = abs(dot(difference, step) * view.unit_from_step) * inverseSqrt(square);
    return vec2<f32>(view.ambient + view.diffuse * cosine, view.specular * pow(cosine, view.specular_power));
}

fn trace(start: vec3<f32>, step: vec3<f32>) -> vec4<f32> {
    let inverse = 1.0 / select(step, vec3<f32>(1e-15), abs(step) < vec3<f32>(1e-15));
    let near = min(-start * inverse, (view.last - start) * inverse);
    let far = max(-start * inverse, (view.last - start) * inverse);
    let begin = max(max(max(near.x, near.y), near.z), 0.0);
    let length = min(min(far.x, far.y), far.z) - begin;
    let entry = start + begin * step;
    var pixel = vec4<f32>(0.0, 0.0, 0.0, 1.0);
    for (var k = 0.5; k < length; k += 1.0) {
        let place = entry + k * step;
        let index = value_at(place) * view.index_factor + view.index_offset;
        let color = colors[u32(clamp(index, 0.0, f32(arrayLength(&colors) - 1u)))];
        if color.w <= 0.0 {
            continue;
        }
        var terms = vec2<f32>(1.0, 0.0);
        if view.is_lit == 1u {
            terms = light(place, step);
        }
        pixel += pixel.w * vec4<f32>(color.xyz * terms.x + color.w * terms.y, -color.w);
        if pixel.w <= view.least_transmittance {
            break;
        }
    }
    return vec4<f32>(pixel.xyz, 1.0 - pixel.w);
}

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= view.num_columns || id.y >= view.num_rows {
        return;
    }
    let at = vec2<f32>(id.xy) + 0.5;
    let start = view.start + at.x * view.start_per_column + at.y * view.start_per_row;
    let direction = view.direction + at.x * view.direction_per_column + at.y * view.direction_per_row;
    let pixel = trace(start, normalize(direction) * view.step_per_direction);
    pixels[id.y * view.num_columns + id.x] = pack4x8unorm(pixel);
}
