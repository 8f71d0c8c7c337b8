// Values at the points of a mesh as indices of the table, from values or from a payload.
#import "shared/sight.wgsl"
#import "shared/missing.wgsl"
#import "shared/decode.wgsl"

struct Values {
    // From values to indices: `(value - first - rest) * factor`, the value of index 0 being in two parts.
    first: f32,
    rest: f32,
    // From what payloads decode to, 0 to 1.
    factor: f32,
    offset: f32,
    payload: u32,
    step: u32,
    // The first word of the mask of missing points, or NO_MASK.
    mask: u32,
    padding: u32,
}

const NO_MASK: u32 = 0xffffffffu;

struct Cut {
    ends: vec2<u32>,
    weight: f32,
    padding: u32,
}

@group(0) @binding(0) var<uniform> sight: Sight;
@group(0) @binding(1) var<uniform> values: Values;
// The bits of values of 32 bits; or payloads.
@group(0) @binding(2) var<storage, read> bank: array<u32>;
@group(0) @binding(3) var<storage, read_write> corners: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> cuts: array<Cut>;

fn index_of_value(bits: u32) -> f32 {
    let size = bits & 0x7fffffffu;
    if size > 0x7f800000u {
        return MISSING;
    }
    if size == 0x7f800000u {
        return select(-MOST_INDEX, MOST_INDEX, bits == size);
    }
    let index = ((bitcast<f32>(bits) - values.first) - values.rest) * values.factor;
    return clamp(index, -MOST_INDEX, MOST_INDEX);
}

@compute @workgroup_size(256)
fn place(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    if number < sight.num_points {
        corners[number].w = index_of_value(bank[number]);
    }
}

@compute @workgroup_size(256)
fn decode(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    if number >= sight.num_points {
        return;
    }
    if values.mask != NO_MASK && ((bank[values.mask + (number >> 5u)] >> (number & 31u)) & 1u) == 1u {
        corners[number].w = MISSING;
        return;
    }
    let index = decode_unit(values.payload, values.step, number) * values.factor + values.offset;
    corners[number].w = clamp(index, -MOST_INDEX, MOST_INDEX);
}

@compute @workgroup_size(256)
fn cut(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) num_groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let number = flat_number(group, num_groups, local);
    if number >= sight.num_cuts {
        return;
    }
    let at = cuts[number];
    let a = corners[at.ends.x].w;
    let b = corners[at.ends.y].w;
    var index = a + (b - a) * at.weight;
    if is_missing(a) || is_missing(b) {
        index = MISSING;
    }
    corners[sight.num_points + number].w = index;
}
