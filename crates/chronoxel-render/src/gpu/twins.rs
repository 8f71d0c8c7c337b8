//! The functions of `shaders/shared/` in Rust, and the tests that hold both to the same values.

use bytemuck::{bytes_of, cast_slice};
use chronoxel_codec::{Indices, Payload, Stage, Table, decode_f64};
use chronoxel_core::{BrickLayout, Lighting, compositing};

use super::bank::pack;
use super::device::{Device, storage, uniform};
use super::host::{LightingData, StageData};
use super::page_table::{CellBox, Entry, PageTable};
use super::{GpuError, GpuOptions};

/// `shared/decode.wgsl`
fn decode_unit(bank: &[u32], payload: usize, step: u32, sample: usize) -> f32 {
    let index_of = |first: usize, bits: u32, at: usize| match bits {
        8 => bank[first + at / 4] >> (8 * (at % 4)) & 0xff,
        _ => bank[first + at / 2] >> (16 * (at % 2)) & 0xffff,
    };
    let mut sum = 0.0;
    for i in 0..bank[payload] as usize {
        let words = &bank[payload + 1 + i * size_of::<StageData>() / 4..][..size_of::<StageData>() / 4];
        let stage: StageData = bytemuck::pod_read_unaligned(cast_slice(words));
        let mut entry = index_of(payload + stage.indices as usize, stage.index_bits, sample);
        if stage.num_entries > 0 {
            let row = step >> stage.shift.min(31);
            let at = (row * stage.num_entries + entry) as usize;
            entry = index_of(payload + stage.table as usize, 16, at);
        }
        sum += stage.offset + stage.factor * entry as f32;
    }
    sum.clamp(0.0, 1.0)
}

/// `shared/classification.wgsl`
fn color_index(number: f32, [factor, offset]: [f32; 2], num_colors: u32) -> u32 {
    (number * factor + offset).clamp(0.0, (num_colors - 1) as f32) as u32
}

/// `shared/compositing.wgsl`
fn exp_m1(x: f32) -> f32 {
    if x < -0.25 {
        return x.exp() - 1.0;
    }
    x * (1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0 * (1.0 + x / 5.0 * (1.0 + x / 6.0)))))
}

/// `shared/compositing.wgsl`
fn accumulate_constant(opacity: f32, log_transmittance: f32, num_samples: f32) -> [f32; 2] {
    if opacity >= 1.0 {
        return [1.0, 0.0];
    }
    let x = (log_transmittance * num_samples).max(-80.0);
    [-exp_m1(x) / opacity, x.exp()]
}

/// `shared/opacity.wgsl`
fn log_transmittance_of(a: f32) -> f32 {
    if a > 0.125 {
        return (1.0 - a).ln();
    }
    let series = 1.0 + a * (1.0 / 2.0 + a * (1.0 / 3.0 + a * (1.0 / 4.0 + a * (1.0 / 5.0 + a / 6.0))));
    -a * series
}

/// `shared/lighting.wgsl`
fn power(base: f32, exponent: u32) -> f32 {
    let (mut result, mut square, mut rest) = (1.0, base, exponent);
    while rest > 0 {
        if rest & 1 == 1 {
            result *= square;
        }
        square *= square;
        rest >>= 1;
    }
    result
}

/// `shared/lighting.wgsl`
fn headlight_terms(lighting: &LightingData, difference: [f32; 3], step: [f32; 3]) -> [f32; 2] {
    let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let gradient: [f32; 3] = std::array::from_fn(|a| difference[a] * lighting.world_from_difference[a]);
    let square = dot(gradient, gradient);
    if square.is_nan() || square <= 0.0 {
        return [1.0, 0.0];
    }
    let cosine = (dot(difference, step) * lighting.unit_from_step).abs() / square.sqrt();
    let scattered = lighting.ambient + lighting.diffuse * cosine;
    [scattered, lighting.specular * power(cosine, lighting.specular_power)]
}

/// Which function `shaders/tests/twins.wgsl` calls.
#[derive(Debug, Clone, Copy)]
enum Function {
    ExpM1,
    AccumulateConstant,
    Power,
    HeadlightTerms,
    ColorIndex,
    DecodeUnit,
    LogTransmittanceOf,
    Locate,
}

/// A device, where there is an adapter.
pub(super) fn device() -> Option<Device> {
    match Device::new(&GpuOptions { memory_bytes: 64 << 20, ..Default::default() }) {
        Ok(device) => Some(device),
        Err(e @ GpuError::NoAdapter { .. }) if std::env::var_os("CHRONOXEL_REQUIRE_GPU").is_none() => {
            println!("skipped: {e}");
            None
        }
        Err(e) => panic!("{e}"),
    }
}

/// What the shared functions read beside their arguments.
#[derive(Debug, Default)]
struct Memory {
    nodes: Vec<u32>,
    bank: Vec<u32>,
    lighting: Option<LightingData>,
}

/// Calls a function in the shader; `None` without an adapter.
fn call(function: Function, memory: &Memory, inputs: &[[f32; 8]]) -> Option<Vec<[f32; 4]>> {
    use wgpu::BufferUsages as Usage;
    let device = device()?;
    let filled = |words: &[u32], usage: Usage| {
        let buffer =
            device.buffer("a twin's memory", 4 * words.len() as u64, usage | Usage::COPY_DST).unwrap();
        device.upload(&buffer.raw, 0, cast_slice(words));
        buffer
    };
    let lighting = memory.lighting.unwrap_or(bytemuck::Zeroable::zeroed());
    let buffers = [
        filled(&memory.nodes, Usage::STORAGE),
        filled(&memory.bank, Usage::STORAGE),
        filled(cast_slice(inputs), Usage::STORAGE),
        filled(cast_slice(bytes_of(&lighting)), Usage::UNIFORM),
        filled(&vec![0; 4 * inputs.len()], Usage::STORAGE | Usage::COPY_SRC),
    ];
    let kinds = [storage(true), storage(true), storage(true), uniform(false), storage(false)];
    let layout = device.bind_group_layout("twins", &kinds);
    let constants = [("FUNCTION", f64::from(function as u32))];
    let source = include_str!("shaders/tests/twins.wgsl");
    let pipeline = device.pipeline("twins.wgsl", source, &layout, &constants).unwrap();
    let group = device.bind_group(&layout, &buffers.each_ref().map(|b| b.raw.as_entire_binding()));
    let mut encoder = device.raw.create_command_encoder(&Default::default());
    let mut pass = encoder.begin_compute_pass(&Default::default());
    pass.set_pipeline(&pipeline);
    pass.set_bind_group(0, &group, &[]);
    pass.dispatch_workgroups(inputs.len().div_ceil(64) as u32, 1, 1);
    drop(pass);
    let bytes = 16 * inputs.len() as u64;
    let read = device.buffer("a twin's values", bytes, Usage::COPY_DST | Usage::MAP_READ).unwrap();
    encoder.copy_buffer_to_buffer(&buffers[4].raw, 0, &read.raw, 0, bytes);
    device.queue.submit([encoder.finish()]);
    let mut values = Vec::new();
    device.read(&read.raw, bytes, |bytes| values.extend_from_slice(cast_slice(bytes))).unwrap();
    Some(values)
}

fn inputs_of<const N: usize>(rows: &[[f32; N]]) -> Vec<[f32; 8]> {
    rows.iter().map(|row| std::array::from_fn(|i| row.get(i).copied().unwrap_or(0.0))).collect()
}

#[track_caller]
fn assert_close(what: &str, actual: f32, expected: f32, tolerance: f32) {
    assert!((actual - expected).abs() <= tolerance, "{what}: {actual} in place of {expected}");
}

#[test]
fn exp_m1_keeps_what_is_small() {
    let rows: Vec<[f32; 1]> = (0..400).map(|i| [-(10f32.powf(i as f32 / 50.0 - 6.5))]).collect();
    for [x] in &rows {
        let exact = f64::from(*x).exp_m1();
        assert!((f64::from(exp_m1(*x)) - exact).abs() <= 3e-7 * exact.abs(), "{x}");
    }
    let Some(values) = call(Function::ExpM1, &Memory::default(), &inputs_of(&rows)) else { return };
    for ([x], [value, ..]) in rows.iter().zip(values) {
        assert_close(&format!("e^{x} - 1"), value, exp_m1(*x), 2e-6 * exp_m1(*x).abs());
    }
}

#[test]
fn runs_of_equal_samples() {
    let mut rows = Vec::new();
    for opacity in [1e-6f32, 1e-3, 0.02, 0.5, 0.999, 1.0] {
        for num_samples in [1.0f32, 2.0, 37.0, 5000.0] {
            let log_transmittance = f64::ln_1p(-f64::from(opacity)).max(-1e30) as f32;
            rows.push([opacity, log_transmittance, num_samples]);
        }
    }
    for [opacity, log_transmittance, n] in &rows {
        let [weight, transmittance] = accumulate_constant(*opacity, *log_transmittance, *n);
        let (exact_weight, exact_transmittance) = compositing::accumulate_constant(*opacity, *n);
        assert_close("weight", weight, exact_weight, 1e-6 * exact_weight);
        assert_close("transmittance", transmittance, exact_transmittance, 1e-6);
    }
    let Some(values) = call(Function::AccumulateConstant, &Memory::default(), &inputs_of(&rows)) else {
        return;
    };
    for ([opacity, log_transmittance, n], [weight, transmittance, ..]) in rows.iter().zip(values) {
        let expected = accumulate_constant(*opacity, *log_transmittance, *n);
        assert_close(&format!("weight {opacity} {n}"), weight, expected[0], 3e-6 * expected[0]);
        assert_close(&format!("transmittance {opacity} {n}"), transmittance, expected[1], 2e-6);
    }
}

#[test]
fn opacities_of_longer_ways_keep_what_is_small() {
    let rows: Vec<[f32; 1]> = (0..400).map(|i| [10f32.powf(i as f32 / 60.0 - 6.66)]).collect();
    for [opacity] in &rows {
        let exact = (-f64::from(*opacity)).ln_1p();
        let found = f64::from(log_transmittance_of(*opacity));
        assert!((found - exact).abs() <= 2e-6 * exact.abs(), "{opacity}: {found} in place of {exact}");
    }
    let Some(values) = call(Function::LogTransmittanceOf, &Memory::default(), &inputs_of(&rows)) else {
        return;
    };
    for ([opacity], [value, ..]) in rows.iter().zip(values) {
        let expected = log_transmittance_of(*opacity);
        assert_close(&format!("ln(1 - {opacity})"), value, expected, 1e-5 * expected.abs());
    }
}

#[test]
fn powers() {
    let rows: Vec<[f32; 2]> =
        (0..=128).flat_map(|p| [0.0, 0.3, 0.97, 1.0].map(|base| [base, p as f32])).collect();
    for [base, p] in &rows {
        let exact = f64::from(*base).powi(*p as i32);
        assert!((f64::from(power(*base, *p as u32)) - exact).abs() <= 1e-5 * exact.max(1e-30), "{base} {p}");
    }
    let Some(values) = call(Function::Power, &Memory::default(), &inputs_of(&rows)) else { return };
    for ([base, p], [value, ..]) in rows.iter().zip(values) {
        let expected = power(*base, *p as u32);
        assert_close(&format!("{base}^{p}"), value, expected, 1e-5 * expected + 1e-30);
    }
}

#[test]
fn lighting() {
    let (lighting, spacing, dt) = (Lighting::default(), [0.5f64, 0.25, 2.0], 0.1);
    let data = LightingData {
        world_from_difference: spacing.map(|s| (0.25 / s) as f32),
        unit_from_step: (0.25 / dt) as f32,
        ambient: lighting.ambient,
        diffuse: lighting.diffuse,
        specular: lighting.specular,
        specular_power: lighting.specular_power,
    };
    let mut rows = vec![[0.0; 8]];
    for i in 0..300 {
        let angle = |k: f64| (f64::from(i) * k).sin();
        let direction = [angle(0.37), angle(1.13), angle(0.71) + 1e-3];
        let length = direction.iter().map(|c| c * c).sum::<f64>().sqrt();
        let step: [f32; 3] = std::array::from_fn(|a| (direction[a] / length * dt / spacing[a]) as f32);
        let difference = [angle(0.91), angle(0.53), angle(1.7)].map(|c| c as f32);
        rows.push([difference[0], difference[1], difference[2], 0.0, step[0], step[1], step[2], 0.0]);
    }
    let parts = |row: &[f32; 8]| ([row[0], row[1], row[2]], [row[4], row[5], row[6]]);
    for row in &rows {
        let (difference, step) = parts(row);
        let gradient = std::array::from_fn(|a| f64::from(difference[a]) / spacing[a]);
        let direction = std::array::from_fn(|a| f64::from(step[a]) * spacing[a] / dt);
        let (scattered, highlight) = lighting.headlight_terms(gradient, direction);
        let terms = headlight_terms(&data, difference, step);
        assert_close("scattered", terms[0], scattered as f32, 1e-6);
        assert_close("highlight", terms[1], highlight as f32, 1e-6);
    }
    let memory = Memory { lighting: Some(data), ..Memory::default() };
    let Some(values) = call(Function::HeadlightTerms, &memory, &rows) else { return };
    for (row, [scattered, highlight, ..]) in rows.iter().zip(values) {
        let (difference, step) = parts(row);
        let expected = headlight_terms(&data, difference, step);
        assert_close("scattered in the shader", scattered, expected[0], 2e-6);
        assert_close("highlight in the shader", highlight, expected[1], 2e-6);
    }
}

#[test]
fn classification() {
    let rows: Vec<[f32; 3]> = (0..500)
        .map(|i| {
            [(i as f32 - 100.0) / 300.0, [1000.0, 1e25, -300.0][i % 3], [0.5, -1e25, 4000.25][i / 3 % 3]]
        })
        .collect();
    let Some(values) = call(Function::ColorIndex, &Memory::default(), &inputs_of(&rows)) else { return };
    let mut num_other = 0;
    for ([number, factor, offset], [value, ..]) in rows.iter().zip(values) {
        let expected = color_index(*number, [*factor, *offset], 4096);
        assert!(value.fract() == 0.0 && (value - expected as f32).abs() <= 1.0, "{number} {factor} {offset}");
        num_other += usize::from(value != expected as f32);
    }
    assert!(num_other <= 5, "{num_other} on the other side of an entry's edge");
}

/// A payload of three stages, 8 and 16 bits, with several rows.
fn payload(layout: &BrickLayout) -> Payload {
    let noise = |i: usize, k: usize| (i * k + i / 7 * 131) % 65_521;
    let bytes = |k| (0..layout.num_full()).map(|i| noise(i, k) as u8).collect();
    let stage = |indices, table, shift| Stage { indices, table, shift };
    let entries = (0..4 * 256).map(|i| noise(i, 7919) as u16).collect();
    let few = (0..2 * 5).map(|i| noise(i, 104_729) as u16).collect();
    let low = (0..layout.num_full()).map(|i| (noise(i, 31) % 5) as u16).collect();
    let listed = |offset, scale, num_rows, entries| Table::Listed { offset, scale, num_rows, entries };
    let stages = vec![
        stage(Indices::U8(bytes(7919)), listed(-3.0, 0.01, 4, entries), 0),
        stage(Indices::U16(low), listed(0.5, 1e-3, 2, few), 1),
        stage(Indices::U8(bytes(13)), Table::Affine { offset: 100.0, scale: 0.25 }, 0),
    ];
    Payload { stages }
}

#[test]
fn decoding() {
    let layout = BrickLayout::new(8).unwrap();
    let payload = payload(&layout);
    let packed = pack(&payload, &layout).unwrap();
    // It lies somewhere in the middle of a bank.
    let mut bank = vec![0xdead_beef; 5];
    bank.extend_from_slice(&packed.words);
    let rows: Vec<[f32; 3]> =
        (0..4 * layout.num_full()).map(|i| [5.0, (i % 4) as f32, (i / 4) as f32]).collect();
    for step in 0..4 {
        let exact = decode_f64(&payload, &layout, step).unwrap();
        for (i, exact) in exact.into_iter().enumerate() {
            let unit = (exact - packed.range.low) / packed.range.width;
            assert!((f64::from(decode_unit(&bank, 5, step, i)) - unit).abs() < 4e-7, "{step} {i}");
        }
    }
    let memory = Memory { bank, ..Memory::default() };
    let Some(values) = call(Function::DecodeUnit, &memory, &inputs_of(&rows)) else { return };
    for ([_, step, sample], [value, same, next, _]) in rows.iter().zip(values) {
        let expected = |at| decode_unit(&memory.bank, 5, *step as u32, at);
        let (sample, what) = (*sample as usize, format!("sample {sample} at {step}"));
        assert_close(&what, value, expected(sample), 2e-7);
        assert_close(&what, same, value, 1e-7);
        if sample + 1 < layout.num_full() {
            assert_close(&format!("{what} and the next"), next, expected(sample + 1), 2e-7);
        }
    }
}

#[test]
fn location() {
    let mut boxes = vec![
        (CellBox { low: [4, 0, 0], level: 2 }, Entry::Constant(3)),
        (CellBox { low: [0, 2, 4], level: 1 }, Entry::Brick(4)),
    ];
    boxes.extend(
        (0..64)
            .filter(|i| i % 5 != 0)
            .map(|i| (CellBox { low: [4 + i % 4, 4 + i / 4 % 4, i / 16], level: 0 }, Entry::Brick(5 + i))),
    );
    let table = PageTable::new(&boxes, [8; 3]).unwrap();
    let rows: Vec<[f32; 4]> =
        (0..512).map(|i| [i % 8, i / 8 % 8, i / 64, table.root_level].map(|c| c as f32)).collect();
    let memory = Memory { nodes: table.words.clone(), ..Memory::default() };
    let Some(values) = call(Function::Locate, &memory, &inputs_of(&rows)) else { return };
    for (row, value) in rows.iter().zip(values) {
        let (entry, place) = table.locate([row[0], row[1], row[2]].map(|c| c as u32));
        let [kind, number] = match entry {
            None => [0, 0],
            Some(Entry::Constant(number)) => [1, number],
            Some(Entry::Brick(number)) => [2, number],
        };
        let expected = [kind, number, place.low[0] + 100 * place.low[1], 1 << place.level];
        assert_eq!(value, expected.map(|c| c as f32), "{row:?}");
    }
}
