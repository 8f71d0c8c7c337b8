// What is drawn, and its samples. Reads `bank`, which the importing shader declares; it also imports the shared
// functions of classification, decoding and lighting.

struct View {
    // Where rays start, level-0 voxels: at the corner of the picture, and from pixel to pixel.
    start: vec3<f32>,
    // Voxels of level 0 along an edge of a cell of the page table.
    cell_edge: f32,
    start_per_column: vec3<f32>,
    root_level: u32,
    start_per_row: vec3<f32>,
    // The first row of the picture that is drawn.
    first_row: u32,
    // Their direction in the world, not of unit length: at the corner, and from pixel to pixel.
    direction: vec3<f32>,
    num_columns: u32,
    direction_per_column: vec3<f32>,
    num_rows: u32,
    direction_per_row: vec3<f32>,
    // Whether nothing was gathered before.
    is_first: u32,
    // From a unit vector in the world to the voxels from sample to sample.
    step_per_direction: vec3<f32>,
    // Largest place in the cells of a brick, and samples along an edge, apron included.
    most_place: f32,
    // The far corner of the grid, voxels.
    last: vec3<f32>,
    full_edge: u32,
    // The number of cells.
    cells: vec3<i32>,
    low_apron: u32,
    // 1 / size of the pool.
    per_texel: vec3<f32>,
    padding: u32,
    lighting: Lighting,
}

struct Brick {
    // Of the core's first sample, voxels of the brick's level.
    origin: vec3<f32>,
    // 2^-level
    scale: f32,
    // Of the core's first sample, in the pool.
    texel: vec3<f32>,
    // The first of its level's colours.
    colors: u32,
    // Factor and offset from what the pool holds to the index of a colour.
    index_from_texel: vec2<f32>,
    // The first word of its mask among the masks, or in the bank where samples are decoded at each fetch; or NO_MASK.
    mask: u32,
    // For decoding at each fetch: the first word of its payload in the bank, and the step in its span.
    payload: u32,
    step: u32,
    // The same of the later of two steps, or NO_LATER; and the weight of what it decodes to.
    later: u32,
    later_step: u32,
    later_weight: f32,
}

struct Constant {
    // Of one sample, premultiplied.
    color: vec4<f32>,
    log_transmittance: f32,
    // 2^-level of the samples
    scale: f32,
    padding_a: u32,
    padding_b: u32,
}

// Decode at each fetch, in place of sampling the pool.
override FETCH: bool;
// Decode both of two steps, where there are two.
override BLEND: bool;
// Interpolate colours, after the look-up.
override INTERPOLATE_COLOR: bool;
// The colours of a level.
override NUM_COLORS: u32;

const NO_MASK: u32 = 0xffffffffu;
const NO_LATER: u32 = 0xffffffffu;

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> bricks: array<Brick>;
@group(0) @binding(3) var<storage, read> constants: array<Constant>;
@group(0) @binding(4) var<storage, read> colors: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> masks: array<u32>;
@group(0) @binding(8) var pool: texture_3d<f32>;
@group(0) @binding(9) var pool_sampler: sampler;

// The index of a sample of a brick, from its place counted from the core's first.
fn sample_index(place: vec3<i32>) -> u32 {
    let at = vec3<u32>(place + i32(view.low_apron));
    return at.x + view.full_edge * (at.y + view.full_edge * at.z);
}

fn is_masked(brick: Brick, place: vec3<f32>) -> bool {
    if brick.mask == NO_MASK {
        return false;
    }
    let index = sample_index(vec3<i32>(floor(place + 0.5)));
    let at = brick.mask + (index >> 5u);
    var word: u32;
    if FETCH {
        word = bank[at];
    } else {
        word = masks[at];
    }
    return ((word >> (index & 31u)) & 1u) == 1u;
}

// A sample of a brick's payload, or between those of two. Without a loop: drivers in software count rounds of inner loops
// up to a limit.
fn decode_between(brick: Brick, sample: u32) -> f32 {
    let value = decode_unit(brick.payload, brick.step, sample);
    if BLEND && brick.later != NO_LATER {
        return mix(value, decode_unit(brick.later, brick.later_step, sample), brick.later_weight);
    }
    return value;
}

// The value at a place that is a sample.
fn fetch(brick: Brick, place: vec3<i32>) -> f32 {
    if FETCH {
        return decode_between(brick, sample_index(place));
    }
    return textureLoad(pool, vec3<i32>(brick.texel) + place, 0).x;
}

// The value at a place, interpolated.
fn value_at(brick: Brick, place: vec3<f32>) -> f32 {
    if FETCH {
        return fetched_value(brick, place);
    }
    return textureSampleLevel(pool, pool_sampler, (brick.texel + place + 0.5) * view.per_texel, 0.0).x;
}

// The same from the eight samples around it.
fn fetched_value(brick: Brick, place: vec3<f32>) -> f32 {
    let cell = floor(place);
    var value = 0.0;
    for (var i = 0u; i < 8u; i++) {
        let corner = corner_of(i);
        value += corner_weight(place - cell, corner) * fetch(brick, vec3<i32>(cell) + vec3<i32>(corner));
    }
    return value;
}

// A corner of a cell, bit 0 being x, bit 1 y, bit 2 z.
fn corner_of(number: u32) -> vec3<u32> {
    return vec3<u32>(number, number >> 1u, number >> 2u) & vec3<u32>(1u);
}

fn corner_weight(weight: vec3<f32>, corner: vec3<u32>) -> f32 {
    let w = select(1.0 - weight, weight, corner == vec3<u32>(1u));
    return w.x * w.y * w.z;
}

fn classify(brick: Brick, value: f32) -> vec4<f32> {
    return colors[brick.colors + color_index(value, brick.index_from_texel, NUM_COLORS)];
}

fn color_at(brick: Brick, place: vec3<f32>) -> vec4<f32> {
    if !INTERPOLATE_COLOR {
        return classify(brick, value_at(brick, place));
    }
    let cell = floor(place);
    var color = vec4<f32>(0.0);
    for (var i = 0u; i < 8u; i++) {
        let corner = corner_of(i);
        let of_corner = classify(brick, fetch(brick, vec3<i32>(cell) + vec3<i32>(corner)));
        color += corner_weight(place - cell, corner) * of_corner;
    }
    return color;
}

// Differences of the neighbours of each sample along x, y and z, interpolated as the samples are.
fn difference_at(brick: Brick, place: vec3<f32>) -> vec3<f32> {
    if FETCH {
        return fetched_difference(brick, place);
    }
    let x = vec3<f32>(1.0, 0.0, 0.0);
    let y = vec3<f32>(0.0, 1.0, 0.0);
    let z = vec3<f32>(0.0, 0.0, 1.0);
    return vec3<f32>(
        value_at(brick, place + x) - value_at(brick, place - x),
        value_at(brick, place + y) - value_at(brick, place - y),
        value_at(brick, place + z) - value_at(brick, place - z),
    );
}

// The same from the 32 samples that it takes, each fetched once: rows along x, each weighed for the values it is a part
// of, and against those before and behind. In a loop, because code that decodes 32 times takes minutes to compile.
fn fetched_difference(brick: Brick, place: vec3<f32>) -> vec3<f32> {
    let cell = floor(place);
    let w = place - cell;
    var value_y = vec4<f32>(0.0, 1.0 - w.y, w.y, 0.0);
    var value_z = vec4<f32>(0.0, 1.0 - w.z, w.z, 0.0);
    var slope_y = vec4<f32>(w.y - 1.0, -w.y, 1.0 - w.y, w.y);
    var slope_z = vec4<f32>(w.z - 1.0, -w.z, 1.0 - w.z, w.z);
    var difference = vec3<f32>(0.0);
    for (var i = 0; i < 16; i++) {
        let y = i & 3;
        let z = i >> 2u;
        let is_inner = vec2<bool>(y == 1 || y == 2, z == 1 || z == 2);
        if !any(is_inner) {
            continue;
        }
        let at = vec3<i32>(cell) + vec3<i32>(0, y - 1, z - 1);
        let low = fetch(brick, at);
        let high = fetch(brick, at + vec3<i32>(1, 0, 0));
        let row = mix(low, high, w.x);
        difference.y += row * slope_y[y] * value_z[z];
        difference.z += row * value_y[y] * slope_z[z];
        if all(is_inner) {
            let before = fetch(brick, at - vec3<i32>(1, 0, 0));
            let after = fetch(brick, at + vec3<i32>(2, 0, 0));
            difference.x += mix(high - before, after - low, w.x) * value_y[y] * value_z[z];
        }
    }
    return difference;
}
