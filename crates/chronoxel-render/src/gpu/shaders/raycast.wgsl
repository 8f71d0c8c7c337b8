// The ray caster: one ray per pixel, box by box through the page table.
#import "shared/classification.wgsl"
#import "shared/lighting.wgsl"
#import "shared/compositing.wgsl"
#import "shared/locate.wgsl"
#import "shared/decode.wgsl"
#import "shared/sampling.wgsl"

override LIT: bool;
// A ray ends where less than this much of what lies behind would be seen.
override LEAST_TRANSMITTANCE: f32;

// Beyond every plane; the product of two is finite.
const FAR: f32 = 1e15;

@group(0) @binding(1) var<storage, read> nodes: array<u32>;
@group(0) @binding(6) var<storage, read> bank: array<u32>;
// Red, green and blue multiplied by alpha, and transmittance.
@group(0) @binding(7) var<storage, read_write> gathered: array<vec4<f32>>;

struct RayInGrid {
    // Where it enters the grid, voxels of level 0.
    entry: vec3<f32>,
    // From sample to sample, in voxels of the level sampled.
    step: vec3<f32>,
    inverse_step: vec3<f32>,
    // Length inside the grid, counted in samples of level 0; negative where it misses it.
    length: f32,
}

fn inverse_of(step: f32) -> f32 {
    return select(1.0 / step, FAR, abs(step) < 1.0 / FAR);
}

fn ray_of(pixel: vec2<f32>) -> RayInGrid {
    let start = view.start + pixel.x * view.start_per_column + pixel.y * view.start_per_row;
    let direction = view.direction + pixel.x * view.direction_per_column + pixel.y * view.direction_per_row;
    var ray: RayInGrid;
    ray.step = normalize(direction) * view.step_per_direction;
    ray.inverse_step = vec3<f32>(inverse_of(ray.step.x), inverse_of(ray.step.y), inverse_of(ray.step.z));
    let near = -start * ray.inverse_step;
    let far = (view.last - start) * ray.inverse_step;
    let from_each = min(near, far);
    let to_each = max(near, far);
    let begin = max(max(max(from_each.x, from_each.y), from_each.z), 0.0);
    let end = min(min(to_each.x, to_each.y), to_each.z);
    ray.length = end - begin;
    ray.entry = clamp(start + begin * ray.step, vec3<f32>(0.0), view.last);
    return ray;
}

// Where planes are crossed, one per axis, counted in samples of level 0.
fn crossings(ray: RayInGrid, planes: vec3<f32>) -> vec3<f32> {
    return (planes - ray.entry) * ray.inverse_step;
}

// The planes of a box, beyond everything at the grid's faces.
fn low_planes(low: vec3<i32>) -> vec3<f32> {
    return select(vec3<f32>(low) * view.cell_edge, vec3<f32>(-FAR), low <= vec3<i32>(0));
}

fn high_planes(high: vec3<i32>) -> vec3<f32> {
    let planes = vec3<f32>(high) * view.cell_edge;
    return select(planes, vec3<f32>(FAR), planes >= view.last);
}

// The cell that a ray is in after some samples, a plane that is just crossed being behind: along each axis, the one
// between whose planes it is by the same numbers by which samples are shared out.
fn cell_at(ray: RayInGrid, samples: f32) -> vec3<i32> {
    var cell = vec3<i32>(floor((ray.entry + samples * ray.step) / view.cell_edge));
    let is_ascending = ray.inverse_step > vec3<f32>(0.0);
    let is_behind_low = crossings(ray, vec3<f32>(cell) * view.cell_edge) <= vec3<f32>(samples);
    let is_behind_high = crossings(ray, vec3<f32>(cell + 1i) * view.cell_edge) <= vec3<f32>(samples);
    let is_below = select(is_behind_low, !is_behind_low, is_ascending);
    let is_above = select(!is_behind_high, is_behind_high, is_ascending);
    cell = select(select(cell, cell + 1i, is_above), cell - 1i, is_below);
    return clamp(cell, vec3<i32>(0), view.cells - 1i);
}

// The samples that a ray takes in a box: the first, and the one after the last. A function of the planes alone, so that
// no sample is lost or taken twice between boxes that share one.
//
// scale: 2^-level of the samples
fn sample_interval(ray: RayInGrid, low: vec3<f32>, high: vec3<f32>, scale: f32) -> vec2<f32> {
    let a = ceil((low * scale - ray.entry * scale) * ray.inverse_step - 0.5);
    let b = ceil((high * scale - ray.entry * scale) * ray.inverse_step - 0.5);
    let from_each = min(a, b);
    let to_each = max(a, b);
    let first = max(max(max(from_each.x, from_each.y), from_each.z), 0.0);
    let end = min(min(to_each.x, to_each.y), to_each.z);
    return vec2<f32>(first, min(end, floor(ray.length * scale + 0.5)));
}

// Puts the samples of a brick behind what was gathered.
fn march(ray: RayInGrid, brick: Brick, interval: vec2<f32>, before: vec4<f32>) -> vec4<f32> {
    var pixel = before;
    let entry = ray.entry * brick.scale;
    for (var k = interval.x + 0.5; k < interval.y; k += 1.0) {
        // Rounding may carry a place out of the cells of the core, around which the apron has all that is needed.
        let place = clamp(entry + k * ray.step - brick.origin, vec3<f32>(0.0), vec3<f32>(view.most_place));
        if is_masked(brick, place) {
            continue;
        }
        let color = color_at(brick, place);
        if color.w <= 0.0 {
            continue;
        }
        var terms = vec2<f32>(1.0, 0.0);
        if LIT {
            terms = headlight_terms(view.lighting, difference_at(brick, place), ray.step);
        }
        pixel += pixel.w * vec4<f32>(color.xyz * terms.x + color.w * terms.y, -color.w);
        if pixel.w <= LEAST_TRANSMITTANCE {
            break;
        }
    }
    return pixel;
}

// Puts a box of one colour behind what was gathered.
fn cross_constant(constant: Constant, interval: vec2<f32>, before: vec4<f32>) -> vec4<f32> {
    let num_samples = interval.y - interval.x;
    if num_samples <= 0.0 {
        return before;
    }
    let run = accumulate_constant(constant.color.w, constant.log_transmittance, num_samples);
    return vec4<f32>(before.xyz + before.w * run.x * constant.color.xyz, before.w * run.y);
}

fn trace(ray: RayInGrid, before: vec4<f32>) -> vec4<f32> {
    var pixel = before;
    var samples = 0.0;
    while samples < ray.length && pixel.w > LEAST_TRANSMITTANCE {
        let here = locate(cell_at(ray, samples), view.root_level);
        let low = low_planes(here.low);
        let high = high_planes(here.low + here.edge);
        if here.kind == KIND_BRICK {
            let brick = bricks[here.number];
            pixel = march(ray, brick, sample_interval(ray, low, high, brick.scale), pixel);
        } else if here.kind == KIND_CONSTANT {
            let constant = constants[here.number];
            pixel = cross_constant(constant, sample_interval(ray, low, high, constant.scale), pixel);
        }
        let leave = max(crossings(ray, low), crossings(ray, high));
        let exit = min(min(leave.x, leave.y), leave.z);
        // It grows from box to box; were it to stand still, the ray would end rather than hang.
        if !(exit > samples) {
            break;
        }
        samples = exit;
    }
    return pixel;
}

@compute @workgroup_size(8, 8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= view.num_columns || id.y >= view.num_rows {
        return;
    }
    let at = id.y * view.num_columns + id.x;
    var pixel = vec4<f32>(0.0, 0.0, 0.0, 1.0);
    if view.is_first == 0u {
        pixel = gathered[at];
    }
    let ray = ray_of(vec2<f32>(f32(id.x), f32(view.first_row + id.y)) + 0.5);
    gathered[at] = trace(ray, pixel);
}
