//! Payloads: the bytes of one or two stages under any class, then decoding at any step.
#![no_main]

use chronoxel_codec::{
    Payload, PayloadClass, StageClass, TableClass, decode_f64, decode_resident, decoded_range, stage_from_bytes,
    stage_to_bytes,
};
use chronoxel_core::BrickLayout;
use libfuzzer_sys::fuzz_target;

/// Index bits, entries and rows of a table (none of both: affine), shift.
type Shape = (u8, u16, u16, u8);

fn class(&(bits, entries, rows, shift): &Shape) -> StageClass {
    let table = match (entries, rows) {
        (0, 0) => TableClass::Affine,
        _ => TableClass::Listed { entries: u32::from(entries % 1100), rows: u32::from(rows % 40) },
    };
    let index_bits = [8, 16, bits][usize::from(bits) % 3];
    StageClass { index_bits, table, shift }
}

fuzz_target!(|input: (Shape, Option<Shape>, u32, [f64; 2], &[u8])| {
    let (first, second, step, affine, bytes) = input;
    let Ok(layout) = BrickLayout::new(8) else { return };
    let class = PayloadClass { stages: [Some(first), second].iter().flatten().map(class).collect() };
    if class.validate().is_err() {
        return;
    }
    let mut stages = Vec::new();
    for class in &class.stages {
        // As they are, and at the length of the class: the input's bytes over and over after sound numbers.
        assert!(stage_from_bytes(class, &layout, bytes).is_err() || bytes.len() == class.num_bytes(&layout));
        let numbers = affine.iter().flat_map(|v| v.to_le_bytes());
        let rest = bytes.iter().copied().chain([0]).cycle();
        let filled: Vec<u8> = numbers.chain(rest).take(class.num_bytes(&layout)).collect();
        let Ok(stage) = stage_from_bytes(class, &layout, &filled) else { return };
        assert_eq!(stage_to_bytes(&stage, &layout), filled, "the bytes of a stage are canonical");
        stages.push(stage);
    }
    let payload = Payload { stages };
    let decoded = decode_f64(&payload, &layout, step);
    let resident = decode_resident(&payload, &layout, step, None);
    if let (Ok(decoded), Ok(resident)) = (&decoded, &resident) {
        assert_eq!(decoded.len(), layout.num_full());
        assert_eq!(resident.samples.len(), layout.num_full());
    }
    let _ = decoded_range(&payload, &layout, step % 64);
});
