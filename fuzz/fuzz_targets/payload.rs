//! Payloads: the bytes of up to three stages under any class, decoding at any step, and what must agree.
#![no_main]

use chronoxel_codec::{
    Payload, PayloadClass, Stage, StageClass, Table, TableClass, decode_f64, decode_resident, decoded_range,
    stage_from_bytes, stage_to_bytes,
};
use chronoxel_core::BrickLayout;
use libfuzzer_sys::fuzz_target;

/// Index bits, entries and rows of a table (none of both: affine), shift.
type Shape = (u8, u16, u16, u8);
/// A stage: its shape, offset and scale, and where in the bytes its own start.
type Part = (Shape, [f64; 2], u16);

fn class(&((bits, entries, rows, shift), ..): &Part) -> StageClass {
    let table = match (entries, rows) {
        (0, 0) => TableClass::Affine,
        _ => TableClass::Listed { entries: u32::from(entries % 1100), rows: u32::from(rows % 40) },
    };
    let index_bits = [8, 16, bits][usize::from(bits) % 3];
    StageClass { index_bits, table, shift }
}

/// Largest magnitude of a value that the stage's numbers allow.
fn magnitude(stage: &Stage) -> f64 {
    let (Table::Affine { offset, scale } | Table::Listed { offset, scale, .. }) = stage.table;
    offset.abs().max((offset + 65535.0 * scale).abs())
}

fn check(payload: &Payload, layout: &BrickLayout, step: u32) {
    let decoded = decode_f64(payload, layout, step);
    let resident = decode_resident(payload, layout, step, None);
    // Only the sum of several stages can be too large for drawing alone.
    assert!(decoded.is_ok() || resident.is_err());
    assert!(resident.is_ok() || decoded.is_err() || payload.stages.len() > 1);
    if let (Ok(decoded), Ok(resident)) = (&decoded, &resident) {
        assert_eq!(decoded.len(), layout.num_full());
        assert_eq!(resident.samples.len(), layout.num_full());
        let rounding = if payload.stages.len() == 1 { 0.0 } else { 0.501 * resident.scale };
        let magnitude: f64 = payload.stages.iter().map(magnitude).sum();
        let bound = rounding + 4.0 * (payload.stages.len() + 1) as f64 * f64::EPSILON * magnitude;
        for (&sample, decoded) in resident.samples.iter().zip(decoded) {
            let drawn = resident.offset + resident.scale * f64::from(sample);
            assert!((drawn - decoded).abs() <= bound, "{decoded} is drawn as {drawn}, bound {bound}");
        }
    }
}

/// The range over the first steps is that of decoding each of them.
fn check_range(payload: &Payload, layout: &BrickLayout, num_steps: u32) {
    let Ok(range) = decoded_range(payload, layout, num_steps) else { return };
    let mut plain = [f64::INFINITY, f64::NEG_INFINITY];
    for step in 0..num_steps {
        for value in decode_f64(payload, layout, step).expect("a range was found") {
            plain = [plain[0].min(value), plain[1].max(value)];
        }
    }
    assert_eq!(range, plain);
}

fuzz_target!(|input: (Part, Option<Part>, Option<Part>, u32, &[u8])| {
    let (first, second, third, step, bytes) = input;
    let Ok(layout) = BrickLayout::new(8) else { return };
    let parts = [Some(first), second, third];
    let class = PayloadClass { stages: parts.iter().flatten().map(class).collect() };
    if class.validate().is_err() {
        return;
    }
    let mut stages = Vec::new();
    for (class, (_, numbers, start)) in class.stages.iter().zip(parts.iter().flatten()) {
        // As they are, and at the length of the class: the input's bytes over and over after sound numbers.
        assert!(stage_from_bytes(class, &layout, bytes).is_err() || bytes.len() == class.num_bytes(&layout));
        let numbers = numbers.iter().flat_map(|v| v.to_le_bytes());
        let rest = bytes.iter().copied().chain([0]).cycle().skip(usize::from(*start) % 2048);
        let filled: Vec<u8> = numbers.chain(rest).take(class.num_bytes(&layout)).collect();
        let stage = match stage_from_bytes(class, &layout, &filled) {
            Ok(stage) => stage,
            // Indices beyond the table: all of the lowest ones instead, so that decoding is reached.
            Err(_) => {
                let (table, indices) = filled.split_at(class.num_table_bytes());
                let TableClass::Listed { entries, .. } = class.table else { return };
                let low = |&i: &u8| (u32::from(i) % entries) as u8;
                // High bytes come first, for core and apron apart.
                let (core, apron) = (layout.num_core(), layout.num_full() - layout.num_core());
                let high = |at: usize| at < core || (2 * core..2 * core + apron).contains(&at);
                let wide = class.index_bits == 16;
                let index = |(at, i): (usize, &u8)| if wide && high(at) { 0 } else { low(i) };
                let filled: Vec<u8> =
                    table.iter().copied().chain(indices.iter().enumerate().map(index)).collect();
                let Ok(stage) = stage_from_bytes(class, &layout, &filled) else { continue };
                stage
            }
        };
        let bytes = stage_to_bytes(&stage, &layout);
        assert_eq!(stage_from_bytes(class, &layout, &bytes).as_ref(), Ok(&stage), "bytes are canonical");
        stages.push(stage);
    }
    let payload = Payload { stages };
    check(&payload, &layout, step);
    check(&payload, &layout, step % 32);
    check_range(&payload, &layout, step % 9);
    let _ = decoded_range(&payload, &layout, step);
    let stages = payload.stages.iter().map(|stage| stage.clone().into_canonical(&layout)).collect();
    let canonical = Payload { stages: Result::expect(stages, "sound stages have a canonical form") };
    assert_eq!(decode_f64(&canonical, &layout, step % 32), decode_f64(&payload, &layout, step % 32));
    check(&canonical, &layout, step % 32);
});
