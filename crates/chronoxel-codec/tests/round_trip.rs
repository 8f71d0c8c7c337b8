//! Properties over seeded random payloads and bricks: bytes round-trip, errors stay within their bound.

use chronoxel_codec::{
    CodecError, Indices, Payload, Stage, StageClass, Table, TableClass, decode_f64, decode_resident,
    decoded_range, quantize_affine, stage_from_bytes, stage_to_bytes,
};
use chronoxel_core::BrickLayout;

mod random;
use random::Random;

fn layout() -> BrickLayout {
    BrickLayout::new(8).unwrap()
}

fn random_stage(random: &mut Random, class: StageClass) -> Stage {
    let n = layout().num_full();
    let num_entries = match class.table {
        TableClass::Affine => 1u64 << class.index_bits,
        TableClass::Listed { entries, .. } => u64::from(entries),
    };
    let mut index = || random.next() % num_entries;
    let indices = match class.index_bits {
        8 => Indices::U8((0..n).map(|_| index() as u8).collect()),
        _ => Indices::U16((0..n).map(|_| index() as u16).collect()),
    };
    let (offset, scale) = (random.unit() * 200.0 - 100.0, random.unit());
    let table = match class.table {
        TableClass::Affine => Table::Affine { offset, scale },
        TableClass::Listed { entries, rows } => {
            let entries = (0..entries * rows).map(|_| random.next() as u16 % 5).collect();
            Table::Listed { offset, scale, num_rows: rows as usize, entries }
        }
    };
    Stage { indices, table, shift: class.shift }
}

fn classes() -> Vec<StageClass> {
    let listed = |index_bits, entries, rows, shift| StageClass {
        index_bits,
        table: TableClass::Listed { entries, rows },
        shift,
    };
    vec![
        StageClass::affine(8),
        StageClass::affine(16),
        listed(8, 256, 1, 0),
        listed(8, 3, 7, 2),
        listed(16, 1024, 4, 1),
        listed(16, 1, 1, 0),
    ]
}

#[test]
fn bytes_round_trip_and_have_the_length_of_their_class() {
    let mut random = Random(1);
    for class in classes() {
        class.validate().unwrap();
        let stage = random_stage(&mut random, class);
        assert_eq!(stage.class(), class);
        let bytes = stage_to_bytes(&stage, &layout());
        assert_eq!(bytes.len(), class.num_bytes(&layout()));
        assert_eq!(stage_from_bytes(&class, &layout(), &bytes).unwrap(), stage);
        for wrong in [&bytes[1..], &[], &[&bytes[..], &[0]].concat()] {
            assert!(stage_from_bytes(&class, &layout(), wrong).is_err());
        }
    }
}

#[test]
fn core_indices_come_before_the_apron_and_high_bytes_before_low_ones() {
    // Index of sample (x, y, z) of the full brick of 11: x + 11 y + 121 z; the core starts at (1, 1, 1).
    let indices = (0..1331u32).map(|i| i as u16).collect();
    let table = Table::Affine { offset: 1.5, scale: 2.0 };
    let bytes = stage_to_bytes(&Stage { indices: Indices::U16(indices), table, shift: 0 }, &layout());
    assert_eq!(bytes[..8], 1.5f64.to_le_bytes());
    assert_eq!(bytes[8..16], 2.0f64.to_le_bytes());
    let index = |plane: usize, count: usize, at: usize| {
        u32::from(bytes[16 + plane + at]) << 8 | u32::from(bytes[16 + plane + count + at])
    };
    let core = |at| index(0, 512, at);
    assert_eq!([core(0), core(1), core(8), core(64), core(511)], [133, 134, 144, 254, 133 + 7 * 133]);
    let apron = |at| index(1024, 1331 - 512, at);
    // Row (y, z) = (1, 1) starts at 132: one sample before the core's eight, two after.
    assert_eq!(
        [apron(0), apron(131), apron(132), apron(133), apron(134), apron(135)],
        [0, 131, 132, 141, 142, 143]
    );
    assert_eq!(apron(1331 - 512 - 1), 1330);
}

#[test]
fn the_sum_of_stages_is_the_sum_of_their_table_entries() {
    let mut random = Random(2);
    let steps = 26;
    for classes in [&classes()[..1], &classes()[2..4], &classes()[..4]] {
        let stages: Vec<Stage> = classes.iter().map(|&class| random_stage(&mut random, class)).collect();
        let payload = Payload { stages: stages.clone() };
        let mut range = [f64::INFINITY, f64::NEG_INFINITY];
        // Only the first stage of one row serves any step; the others end with their tables.
        let num_steps = if classes.iter().any(|c| matches!(c.table, TableClass::Listed { rows: 1, .. })) {
            1
        } else {
            steps
        };
        for step in 0..num_steps {
            let decoded = decode_f64(&payload, &layout(), step).unwrap();
            for at in [0, 700, 1330] {
                let value = |stage: &Stage| {
                    let index = match &stage.indices {
                        Indices::U8(v) => usize::from(v[at]),
                        Indices::U16(v) => usize::from(v[at]),
                    };
                    match &stage.table {
                        Table::Affine { offset, scale } => offset + scale * index as f64,
                        Table::Listed { offset, scale, num_rows, entries } => {
                            let row = (step >> stage.shift) as usize * (entries.len() / num_rows);
                            offset + scale * f64::from(entries[row + index])
                        }
                    }
                };
                let sum = stages.iter().map(value).reduce(|a, b| a + b).unwrap();
                assert_eq!(decoded[at].to_bits(), sum.to_bits());
            }
            decoded.iter().for_each(|&v| range = [range[0].min(v), range[1].max(v)]);
            let brick = decode_resident(&payload, &layout(), step, None).unwrap();
            let [low, high] = [f64::INFINITY, f64::NEG_INFINITY];
            let width =
                decoded.iter().fold(high, |a, &b| a.max(b)) - decoded.iter().fold(low, |a, &b| a.min(b));
            // Independent indices reach about the sum of the ranges of their rows.
            assert!(stages.len() == 1 || brick.scale * 65535.0 <= 1.1 * width);
            let bound = if stages.len() == 1 { 0.0 } else { 0.501 * brick.scale + 1e-12 };
            for (&sample, value) in brick.samples.iter().zip(&decoded) {
                assert!((brick.offset + brick.scale * f64::from(sample) - value).abs() <= bound);
            }
        }
        assert_eq!(decoded_range(&payload, &layout(), num_steps).unwrap(), range);
    }
    let listed = Payload { stages: vec![random_stage(&mut random, classes()[3])] };
    assert!(decode_f64(&listed, &layout(), 27).is_ok() && decode_f64(&listed, &layout(), 28).is_err());
}

/// Offset and scale of stages that sums stumble over.
const NUMBERS: [[f64; 2]; 8] = [
    [-3.0, 1e-4],
    [1e10, 1e-9],
    [-1e10, 3e-9],
    [1e300, 1e293],
    [-1e-310, 1e-312],
    [5e-324, 5e-324],
    [0.25, 0.0],
    [-1e16, 1.0],
];

#[test]
fn drawn_sums_keep_their_bound_and_ranges_are_exact() {
    let mut random = Random(8);
    let mut classes = classes();
    classes.retain(|class| !matches!(class.table, TableClass::Listed { rows: 1, .. }));
    for _ in 0..300 {
        let mut stage = || {
            let class = classes[random.next() as usize % classes.len()];
            let mut stage = random_stage(&mut random, class);
            let numbers = NUMBERS[random.next() as usize % NUMBERS.len()];
            if let Table::Listed { entries, .. } = &mut stage.table {
                entries.iter_mut().for_each(|entry| *entry *= 13_107);
            }
            let (Table::Affine { offset, scale } | Table::Listed { offset, scale, .. }) = &mut stage.table;
            [*offset, *scale] = numbers;
            stage
        };
        let payload = Payload { stages: vec![stage(), stage(), stage()] };
        let magnitude = |stage: &Stage| {
            let (Table::Affine { offset, scale } | Table::Listed { offset, scale, .. }) = stage.table;
            offset.abs() + 65535.0 * scale
        };
        let ulps = 4.0 * 4.0 * f64::EPSILON * payload.stages.iter().map(magnitude).sum::<f64>();
        let mut range = [f64::INFINITY, f64::NEG_INFINITY];
        for step in 0..8 {
            let decoded = decode_f64(&payload, &layout(), step).unwrap();
            let brick = decode_resident(&payload, &layout(), step, None).unwrap();
            for (&sample, value) in brick.samples.iter().zip(&decoded) {
                let drawn = brick.offset + brick.scale * f64::from(sample);
                assert!((drawn - value).abs() <= 0.501 * brick.scale + ulps, "{value} is drawn as {drawn}");
            }
            decoded.iter().for_each(|&v| range = [range[0].min(v), range[1].max(v)]);
            assert_eq!(decoded_range(&payload, &layout(), step + 1).unwrap(), range);
        }
    }
}

#[test]
fn sums_that_are_not_finite_are_errors_and_long_spans_of_one_row_are_quick() {
    let mut random = Random(9);
    let mut stage = random_stage(&mut random, StageClass::affine(8));
    let payload = Payload { stages: vec![stage.clone(), stage.clone()] };
    assert!(decoded_range(&payload, &layout(), u32::MAX).is_ok());
    stage.table = Table::Affine { offset: 1.7e308, scale: 0.0 };
    let payload = Payload { stages: vec![stage.clone(), stage] };
    assert!(decode_resident(&payload, &layout(), 0, None).is_err());
    assert!(decoded_range(&payload, &layout(), 1).is_err());
    assert!(decode_resident(&Payload { stages: vec![] }, &layout(), 0, None).is_err());
}

/// Bricks of every kind that quantisers stumble over.
fn bricks(random: &mut Random) -> Vec<Vec<f64>> {
    let mut scaled = |offset: f64, width: f64| (0..1331).map(|_| offset + width * random.unit()).collect();
    let mut bricks: Vec<Vec<f64>> = vec![
        scaled(0.0, 1.0),
        scaled(-5.0, 10.0),
        scaled(1e10, 1e-3),
        scaled(1e300, 1e300),
        scaled(-1e-300, 2e-300),
        scaled(0.0, 5e-322),
        scaled(-1e-310, 1e-309),
        scaled(1.0, 1e-15),
        vec![0.0; 1331],
        vec![-0.0; 1331],
        vec![-7.25; 1331],
        vec![f64::from_bits(1); 1331],
    ];
    for pair in [[0.0, f64::from_bits(1)], [1.0, 1.0 + f64::EPSILON], [-8e307, 8e307], [3.0, -3.0]] {
        bricks.push((0..1331).map(|i| pair[i % 7 / 4]).collect());
    }
    bricks
}

#[test]
fn quantised_samples_differ_by_at_most_half_a_scale_and_rounding() {
    let mut random = Random(3);
    for brick in bricks(&mut random) {
        for bits in [8, 16] {
            let stage = quantize_affine(&brick, false, bits).unwrap();
            stage.validate(&layout()).unwrap();
            let Table::Affine { offset, scale } = stage.table else { panic!("affine") };
            let low = brick.iter().copied().fold(f64::INFINITY, f64::min);
            let high = brick.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            assert_eq!(offset, low);
            let n = 2f64.powi(bits.into()) - 1.0;
            assert!(scale <= ((high - low) / n).max(f64::MIN_POSITIVE));
            let ulp = f64::EPSILON * low.abs().max(high.abs());
            let bound = scale / 2.0 + 4.0 * ulp;
            let decoded = decode_f64(&Payload { stages: vec![stage] }, &layout(), 0).unwrap();
            for (decoded, sample) in decoded.iter().zip(&brick) {
                assert!((decoded - sample).abs() <= bound, "{sample} became {decoded}, bound {bound}");
            }
        }
    }
}

#[test]
fn f32_and_f64_samples_give_the_same_stage() {
    let mut random = Random(4);
    let narrow: Vec<f32> = (0..1331).map(|_| random.unit() as f32 * 40.0 - 7.0).collect();
    let wide: Vec<f64> = narrow.iter().map(|&v| f64::from(v)).collect();
    for bits in [8, 16] {
        assert_eq!(quantize_affine(&narrow, false, bits), quantize_affine(&wide, false, bits));
    }
}

#[test]
fn whole_numbers_lose_nothing_where_their_range_fits() {
    let mut random = Random(5);
    for (bits, offset, width) in [(8u8, -100.0, 256), (16, 1e15, 65_536), (8, 3.0, 11)] {
        let brick: Vec<f64> = (0..1331).map(|_| offset + (random.next() % width) as f64).collect();
        let payload = Payload { stages: vec![quantize_affine(&brick, true, bits).unwrap()] };
        assert_eq!(decode_f64(&payload, &layout(), 0).unwrap(), brick);
        let brick_again = decode_resident(&payload, &layout(), 0, None).unwrap();
        assert_eq!((brick_again.scale, brick_again.samples.len()), (1.0, 1331));
    }
}

#[test]
fn samples_that_cannot_be_quantised_are_named() {
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for at in [0, 16, 1330] {
            let mut brick = vec![1.0; 1331];
            brick[at] = bad;
            let error = quantize_affine(&brick, false, 8).unwrap_err().to_string();
            assert!(error.contains(&bad.to_string()), "{error}");
        }
    }
    assert!(quantize_affine(&[-1e308, 1e308], false, 8).is_err());
    assert!(quantize_affine::<f64>(&[], false, 8).is_err());
    assert!(matches!(quantize_affine(&[1.0], false, 12), Err(CodecError::InvalidArgument { .. })));
}

#[test]
fn damaged_stages_are_errors_and_never_panics() {
    let mut random = Random(6);
    for class in classes() {
        let bytes = stage_to_bytes(&random_stage(&mut random, class), &layout());
        for _ in 0..200 {
            let mut damaged = bytes.clone();
            let at = random.next() as usize % damaged.len().min(40);
            damaged[at] ^= random.next() as u8;
            if let Ok(stage) = stage_from_bytes(&class, &layout(), &damaged) {
                let payload = Payload { stages: vec![stage] };
                assert!(decode_f64(&payload, &layout(), 0).unwrap().iter().all(|v| v.is_finite()));
                decode_resident(&payload, &layout(), 0, None).unwrap();
            }
        }
    }
    let short = Stage {
        indices: Indices::U8(vec![0; 5]),
        table: Table::Affine { offset: 0.0, scale: 1.0 },
        shift: 0,
    };
    assert!(decode_resident(&Payload { stages: vec![short] }, &layout(), 0, None).is_err());
    assert!(decode_f64(&Payload { stages: vec![] }, &layout(), 0).is_err());
}

#[test]
fn canonical_stages_decode_alike_and_are_equal_for_equal_samples() {
    let mut random = Random(7);
    for class in &classes()[2..5] {
        let stage = random_stage(&mut random, *class);
        let canonical = stage.clone().into_canonical(&layout()).unwrap();
        let decode = |stage: &Stage, step| {
            decode_f64(&Payload { stages: vec![stage.clone()] }, &layout(), step).unwrap()
        };
        assert_eq!(decode(&stage, 0), decode(&canonical, 0));
        // The same brick with the entries in another order: entry e becomes n - 1 - e.
        let Table::Listed { offset, scale, num_rows, entries } = stage.table.clone() else { continue };
        let n = entries.len() / num_rows;
        let reversed = entries.chunks(n).flat_map(|row| row.iter().rev().copied()).collect();
        let indices = match &stage.indices {
            Indices::U8(v) => Indices::U8(v.iter().map(|&i| (n - 1 - usize::from(i)) as u8).collect()),
            Indices::U16(v) => Indices::U16(v.iter().map(|&i| (n - 1 - usize::from(i)) as u16).collect()),
        };
        let other =
            Stage { indices, table: Table::Listed { offset, scale, num_rows, entries: reversed }, ..stage };
        assert_eq!(other.into_canonical(&layout()).unwrap(), canonical);
    }
}

#[test]
fn classes_fit_the_windows_their_rows_are_for() {
    let listed =
        |rows, shift| StageClass { index_bits: 8, table: TableClass::Listed { entries: 4, rows }, shift };
    let windows = |class: StageClass| (0..40u32).filter(|&w| class.fits_window(w)).collect::<Vec<_>>();
    assert_eq!(windows(listed(4, 0)), [4]);
    assert_eq!(windows(listed(2, 3)), [9, 10, 11, 12, 13, 14, 15, 16]);
    assert_eq!(windows(StageClass::affine(8)).len(), 40);
    for wrong in [listed(0, 0), listed(1, 32), StageClass { index_bits: 12, ..listed(1, 0) }] {
        assert!(wrong.validate().is_err());
    }
}
