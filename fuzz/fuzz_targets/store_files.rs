//! The files of a store below its header: the input picks one of the fixture's and says what to change in it,
//! as it lies or unpacked, with checksums put right.
#![no_main]

use chronoxel_fuzz::fixture;
use libfuzzer_sys::fuzz_target;

/// A change: what to do, where, with which value.
type Edit = (u8, u32, [u8; 8]);

fn apply(content: &mut Vec<u8>, &(what, at, value): &Edit) {
    let len = content.len().max(1);
    let at = at as usize % len;
    match what % 4 {
        0 => content[at..].iter_mut().take(1).for_each(|byte| *byte = value[0]),
        1 => content[at / 8 * 8..].iter_mut().zip(value).for_each(|(byte, v)| *byte = v),
        2 => {
            // A number of spans: small, whole, or none.
            let numbers = [f64::from(value[0]), -1.0, f64::NAN, 4294967295.0, 0.5, f64::INFINITY];
            let number = numbers[usize::from(value[1]) % numbers.len()].to_le_bytes();
            content[at / 8 * 8..].iter_mut().zip(number).for_each(|(byte, v)| *byte = v);
        }
        _ if value[0] & 1 == 0 => content.truncate(at),
        _ => content.extend_from_slice(&value),
    }
}

fuzz_target!(|input: (u8, u8, u8, Vec<Edit>)| {
    let (file, how, slot, edits) = input;
    let (name, original) = fixture::data_file(usize::from(file));
    let mut content = fixture::unpack(name, original, how, usize::from(slot));
    edits.iter().take(32).for_each(|edit| apply(&mut content, edit));
    let packed = fixture::pack(name, original, how, usize::from(slot), content);
    fixture::with_file(name, &packed, fixture::read_all);
});
