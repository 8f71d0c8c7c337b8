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

// What a stage adds to a sample.
//
// stage: the first word of its description
fn stage_value(payload: u32, stage: u32, step: u32, sample: u32) -> f32 {
    let num_entries = bank[stage + 3u];
    var entry = index_of(payload + bank[stage], bank[stage + 1u], sample);
    if num_entries > 0u {
        let row = step >> min(bank[stage + 4u], 31u);
        entry = index_of(payload + bank[stage + 2u], 16u, row * num_entries + entry);
    }
    return bitcast<f32>(bank[stage + 6u]) + bitcast<f32>(bank[stage + 5u]) * f32(entry);
}

// The sum of the stages, from 0 at the payload's least value to 1 at its largest.
//
// payload: its first word in the bank
fn decode_unit(payload: u32, step: u32, sample: u32) -> f32 {
    var sum = stage_value(payload, payload + 1u, step, sample);
    for (var i = 1u; i < bank[payload]; i++) {
        sum += stage_value(payload, payload + 1u + i * STAGE_WORDS, step, sample);
    }
    return clamp(sum, 0.0, 1.0);
}
