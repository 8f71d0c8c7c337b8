// Decodes slots into a buffer that is laid out like the brick pool, from which they are copied there.
#import "shared/decode.wgsl"

struct Batch {
    // Samples along an edge, apron included, and pairs of them along a row, the last one padded.
    full_edge: u32,
    pairs: u32,
    // Slots along a line of the pool, and words from row to row of it.
    slots_along: u32,
    row_words: u32,
    // The line of slots that the buffer begins with, and the first job.
    first_line: u32,
    first_job: u32,
}

struct Job {
    slot: u32,
    step: u32,
}

// Whether the pool holds 16-bit fractions in place of 16-bit floats.
override IS_UNORM: bool;
// Whether it is the later of two steps, which is mixed into what the earlier one decoded to.
override IS_LATER: bool;

@group(0) @binding(0) var<uniform> batch: Batch;
@group(0) @binding(1) var<storage, read> bank: array<u32>;
// For each slot, the first word of its payload in its bank.
@group(0) @binding(2) var<storage, read> payloads: array<u32>;
@group(0) @binding(3) var<storage, read> jobs: array<Job>;
@group(0) @binding(4) var<storage, read_write> texels: array<u32>;
// For each slot that is between two steps, the first word of the later payload, and the bits of its weight.
@group(0) @binding(5) var<storage, read> laters: array<vec2<u32>>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let rows = batch.full_edge * batch.full_edge;
    if id.x >= batch.pairs * rows {
        return;
    }
    let job = jobs[batch.first_job + id.y];
    let pair = id.x % batch.pairs;
    let row = id.x / batch.pairs;
    var payload = payloads[job.slot];
    if IS_LATER {
        payload = laters[job.slot].x;
    }
    let first = row * batch.full_edge + 2u * pair;
    var values = decode_units(payload, job.step, first);
    // The last sample of a row has none beside it.
    if 2u * pair + 1u == batch.full_edge {
        values.y = 0.0;
    }
    let line = job.slot / batch.slots_along - batch.first_line;
    let column = (job.slot % batch.slots_along) * batch.pairs + pair;
    let at = (line * rows + row) * batch.row_words + column;
    if IS_LATER {
        values = mix(units_of(texels[at]), values, bitcast<f32>(laters[job.slot].y));
    }
    texels[at] = texel_pair(values);
}

// Floats have their sign as one more bit: they go from -1 to 1.
fn texel_pair(values: vec2<f32>) -> u32 {
    if IS_UNORM {
        return pack2x16unorm(values);
    }
    return pack2x16float(values * 2.0 - 1.0);
}

fn units_of(pair: u32) -> vec2<f32> {
    if IS_UNORM {
        return unpack2x16unorm(pair);
    }
    return unpack2x16float(pair) * 0.5 + 0.5;
}
