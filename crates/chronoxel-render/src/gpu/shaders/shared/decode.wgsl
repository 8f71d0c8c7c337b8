// Decoding: one sample of a payload at a step of its span. Reads `bank`, an array of words that the importing shader
// declares. Twin: `twins::decode_unit`.

// Words of the description of a stage, in the order of `StageWord` in `host.rs`.
const STAGE_WORDS: u32 = 8u;

// The index of a sample among indices of 8 or 16 bits, packed into words, lowest first.
fn index_of(first_word: u32, bits: u32, sample: u32) -> u32 {
    if bits == 8u {
        return (bank[first_word + (sample >> 2u)] >> (8u * (sample & 3u))) & 0xffu;
    }
    return (bank[first_word + (sample >> 1u)] >> (16u * (sample & 1u))) & 0xffffu;
}

// What the indices of a stage mean at a step.
struct Stage {
    // First word of the indices, and bits of each.
    indices: u32,
    index_bits: u32,
    // First word of the table, and the first entry of the step's row; no entries where it is affine.
    table: u32,
    row: u32,
    num_entries: u32,
    factor: f32,
    offset: f32,
}

fn stage_at(payload: u32, number: u32, step: u32) -> Stage {
    let at = payload + 1u + number * STAGE_WORDS;
    let num_entries = bank[at + 3u];
    let row = (step >> min(bank[at + 4u], 31u)) * num_entries;
    let factor = bitcast<f32>(bank[at + 5u]);
    let offset = bitcast<f32>(bank[at + 6u]);
    return Stage(payload + bank[at], bank[at + 1u], payload + bank[at + 2u], row, num_entries, factor, offset);
}

// What a stage adds to a sample.
fn stage_value(stage: Stage, sample: u32) -> f32 {
    var entry = index_of(stage.indices, stage.index_bits, sample);
    if stage.num_entries > 0u {
        entry = index_of(stage.table, 16u, stage.row + entry);
    }
    return stage.offset + stage.factor * f32(entry);
}

// The sum of the stages, from 0 at the payload's least value to 1 at its largest.
//
// payload: its first word in the bank
fn decode_unit(payload: u32, step: u32, sample: u32) -> f32 {
    var sum = stage_value(stage_at(payload, 0u, step), sample);
    for (var i = 1u; i < bank[payload]; i++) {
        sum += stage_value(stage_at(payload, i, step), sample);
    }
    return clamp(sum, 0.0, 1.0);
}

// The same of a sample and the next.
fn decode_units(payload: u32, step: u32, sample: u32) -> vec2<f32> {
    let first = stage_at(payload, 0u, step);
    var sum = vec2<f32>(stage_value(first, sample), stage_value(first, sample + 1u));
    for (var i = 1u; i < bank[payload]; i++) {
        let stage = stage_at(payload, i, step);
        sum += vec2<f32>(stage_value(stage, sample), stage_value(stage, sample + 1u));
    }
    return clamp(sum, vec2<f32>(0.0), vec2<f32>(1.0));
}
