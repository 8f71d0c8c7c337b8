//! Values at the points of a mesh through time.

use chronoxel_codec::{
    CellCodecOptions, CellSpan, OneWorker, decode_samples, encode_cells, paper_ratio, point_stage_from_bytes,
    point_stage_to_bytes, span_errors,
};

/// Values at points of a lattice in front of a blunt body: a shock, and a fade to zero over the steps.
fn fading(num_points: usize, num_steps: usize) -> Vec<Vec<f32>> {
    let first = |p: usize| {
        let [x, y, z] = [p % 40, p / 40 % 32, p / 1280].map(|i| i as f32);
        let distance = ((x - 30.0).powi(2) + 0.5 * (y - 16.0).powi(2)).sqrt() + 0.3 * z;
        let shock = 1.0 / (1.0 + ((distance - 14.0) * 1.5).exp());
        0.2 + 0.6 * shock + 0.2 * (0.21 * x + 0.37 * y * z / 32.0).sin().abs()
    };
    let first: Vec<f32> = (0..num_points).map(first).collect();
    let fade = |t: usize| 1.0 - t as f32 / (num_steps - 1) as f32;
    (0..num_steps).map(|t| first.iter().map(|v| v * fade(t)).collect()).collect()
}

/// Waves of many lengths that run at different speeds.
fn waves(num_points: usize, num_steps: usize) -> Vec<Vec<f32>> {
    let value = |p: usize, t: usize| {
        let (x, t) = (p as f32 * 0.013, t as f32);
        (x + 0.11 * t).sin() + 0.5 * (7.3 * x - 0.23 * t).sin() + 0.2 * (41.7 * x + 0.61 * t).cos()
    };
    (0..num_steps).map(|t| (0..num_points).map(|p| value(p, t)).collect()).collect()
}

fn slices(steps: &[Vec<f32>]) -> Vec<&[f32]> {
    steps.iter().map(Vec::as_slice).collect()
}

fn steps_of<'a>(span: &CellSpan, steps: &[&'a [f32]]) -> Vec<&'a [f32]> {
    steps[span.start..span.start + span.num_steps].to_vec()
}

#[test]
fn ratios_are_those_of_the_paper() {
    // Table 1, with the numbers of points of the meshes themselves.
    assert!((paper_ratio(40_960, 64, 256) - 18.55).abs() < 0.01);
    assert!((paper_ratio(160_000, 150, 1024) - 34.7).abs() > 1.0, "of 150 steps a last block is not full");
    // Two hundred points: 51,200 bytes over 2,400 and a table of 73,728.
    assert!((paper_ratio(200, 64, 256) - 51_200.0 / 76_128.0).abs() < 1e-12);
}

#[test]
fn a_field_that_fades_is_as_close_as_the_papers() {
    let steps = fading(40_960, 64);
    let steps = slices(&steps);
    let spans = encode_cells(&steps, &CellCodecOptions::default(), &OneWorker).unwrap();
    assert_eq!(spans.len(), 1);
    let errors = span_errors(&spans[0], &steps).unwrap();
    let range = steps[0].iter().fold(0.0f32, |a, b| a.max(*b));
    let raw = 4.0 * 40_960.0 * 64.0;
    println!(
        "{errors:?}, range {range}, {} bytes, ratio {}",
        spans[0].num_bytes(),
        raw / spans[0].num_bytes() as f64
    );
    assert!(errors.snr_db >= 41.7);
    assert!(errors.max_error <= 0.0046 * f64::from(range));
    // Two bytes of mean and two indices per point, and tables of 16-bit numbers.
    assert_eq!(spans[0].num_bytes(), 40_960 * 4 + 16 * 3 + 2 * 256 * 72);
}

#[test]
fn there_is_one_decoder_and_bytes_come_back() {
    let steps = waves(5000, 100);
    let steps = slices(&steps);
    for entries in [256, 300] {
        let spans = encode_cells(&steps, &CellCodecOptions { entries, max_error: None }, &OneWorker).unwrap();
        assert_eq!(spans.iter().map(|s| (s.start, s.num_steps)).collect::<Vec<_>>(), [(0, 64), (64, 36)]);
        for span in &spans {
            let classes: Vec<_> = span.payload.stages.iter().map(|stage| stage.class()).collect();
            assert!(
                classes
                    .iter()
                    .all(|class| class.validate().is_ok() && class.fits_window(span.num_steps as u32))
            );
            let mut read = span.clone();
            for (stage, class) in read.payload.stages.iter_mut().zip(&classes) {
                let bytes = point_stage_to_bytes(stage);
                assert_eq!(bytes.len(), class.num_point_bytes(5000));
                assert!(point_stage_from_bytes(class, 5000, &bytes[1..]).is_err());
                *stage = point_stage_from_bytes(class, 5000, &bytes).unwrap();
            }
            assert_eq!(&read, span);
            let mut values = vec![0.0; 5000];
            for step in [0, 1, 7, 8, span.num_steps - 1] {
                span.decode(span.start + step, &mut values).unwrap();
                let sums = decode_samples(&span.payload, 5000, step as u32).unwrap();
                assert!(values.iter().zip(&sums).all(|(v, s)| *v == *s as f32));
            }
            assert!(span.decode(span.start + span.num_steps, &mut values).is_err());
            assert!(span.start == 0 || span.decode(0, &mut values).is_err());
            assert!(span.decode(span.start, &mut values[1..]).is_err());
        }
        let errors = span_errors(&spans[0], &steps_of(&spans[0], &steps)).unwrap();
        println!("{entries}: {errors:?}");
        assert!(errors.snr_db > 15.0);
    }
}

#[test]
fn bounds_hold_for_what_is_decoded() {
    let steps = waves(1200, 70);
    let steps = slices(&steps);
    for bound in [0.3, 0.02, 1e-6] {
        let options = CellCodecOptions { entries: 64, max_error: Some(bound) };
        let spans = encode_cells(&steps, &options, &OneWorker).unwrap();
        let mut next = 0;
        let mut values = vec![0.0; 1200];
        for span in &spans {
            assert_eq!(span.start, next);
            next += span.num_steps;
            for (step, source) in steps.iter().enumerate().take(next).skip(span.start) {
                span.decode(step, &mut values).unwrap();
                let errors = values.iter().zip(*source).map(|(a, b)| f64::from((a - b).abs()));
                let error = errors.fold(0.0, f64::max);
                assert!(error <= bound, "{bound}: {error} at {step}");
            }
        }
        assert_eq!(next, 70);
        println!(
            "{bound}: {} spans, {} bytes",
            spans.len(),
            spans.iter().map(CellSpan::num_bytes).sum::<usize>()
        );
    }
    assert!(
        encode_cells(&steps, &CellCodecOptions { entries: 64, max_error: Some(1e-30) }, &OneWorker).is_err()
    );
}

#[test]
fn constants_single_steps_and_few_points_are_exact() {
    for num_points in [50, 5000] {
        let constant = vec![vec![7.25f32; num_points]; 64];
        let constant = slices(&constant);
        for span in encode_cells(&constant, &CellCodecOptions::default(), &OneWorker).unwrap() {
            let errors = span_errors(&span, &steps_of(&span, &constant)).unwrap();
            assert_eq!((errors.max_error, errors.snr_db), (0.0, f64::INFINITY));
        }
    }
    let one = vec![(0..50).map(|i| i as f32).collect::<Vec<f32>>()];
    let span = &encode_cells(&slices(&one), &CellCodecOptions::default(), &OneWorker).unwrap()[0];
    assert!(span_errors(span, &slices(&one)).unwrap().max_error < 49.0 / 65535.0);
}

#[test]
fn what_cannot_be_coded_is_refused() {
    let options = CellCodecOptions::default();
    assert!(encode_cells(&[], &options, &OneWorker).is_err());
    assert!(encode_cells(&[&[]], &options, &OneWorker).is_err());
    assert!(encode_cells(&[&[1.0], &[1.0, 2.0]], &options, &OneWorker).is_err());
    let error = encode_cells(&[&[1.0], &[f32::INFINITY]], &options, &OneWorker).unwrap_err().to_string();
    assert!(error.starts_with("step with an infinite value is 1:"), "{error}");
    assert!(encode_cells(&[&[1.0]], &CellCodecOptions { entries: 1, ..options }, &OneWorker).is_err());
    assert!(
        encode_cells(&[&[1.0]], &CellCodecOptions { max_error: Some(-1.0), ..options }, &OneWorker).is_err()
    );
}

#[test]
fn missing_values_are_masked_and_split_spans_where_they_change() {
    let mut steps = waves(3000, 64);
    // A hole that stays, and one point that is there from step 20 on; step 40 has no value at all.
    for (t, step) in steps.iter_mut().enumerate() {
        step[..7].fill(f32::NAN);
        step[100] = if t < 20 { f32::NAN } else { 1e6 };
        if t == 40 {
            step.fill(f32::NAN);
        }
    }
    let steps = slices(&steps);
    for max_error in [None, Some(0.05)] {
        let options = CellCodecOptions { entries: 64, max_error };
        let spans = encode_cells(&steps, &options, &OneWorker).unwrap();
        let mut next = 0;
        let mut values = vec![0.0; 3000];
        for span in &spans {
            assert_eq!((span.start, span.start % span.window, span.num_steps), (next, 0, span.window));
            next += span.num_steps;
            let missing = span.missing.as_ref().unwrap();
            for (step, source) in steps.iter().enumerate().take(next).skip(span.start) {
                span.decode(step, &mut values).unwrap();
                for (point, (&found, &value)) in values.iter().zip(*source).enumerate() {
                    assert_eq!(missing.get(point), value.is_nan());
                    let error = f64::from((found - value).abs());
                    assert!(value.is_nan() || error <= max_error.unwrap_or(30.0), "{error} at {step}");
                }
            }
        }
        assert_eq!(next, 64);
        let starts: Vec<usize> = spans.iter().map(|span| span.start).collect();
        assert!([0, 16, 20, 24, 32, 40, 41].iter().all(|start| starts.contains(start)), "{starts:?}");
    }
}

#[test]
fn few_points_and_tight_bounds_never_cost_more_than_the_values() {
    for num_points in [1, 2, 40, 200, 3000] {
        let steps = waves(num_points, 70);
        let steps = slices(&steps);
        for max_error in [None, Some(0.3), Some(1e-3), Some(1e-6)] {
            let options = CellCodecOptions { entries: 1024, max_error };
            let spans = encode_cells(&steps, &options, &OneWorker).unwrap();
            let num_bytes: usize = spans.iter().map(CellSpan::num_bytes).sum();
            assert!(num_bytes <= 70 * (4 * num_points + 32), "{num_points}, {max_error:?}: {num_bytes}");
        }
    }
}

#[test]
fn whole_numbers_are_exact_at_no_error() {
    let steps: Vec<Vec<f32>> =
        (0..9).map(|t| (0..500).map(|p| ((p * (t + 3)) % 251) as f32).collect()).collect();
    let steps = slices(&steps);
    let options = CellCodecOptions { entries: 256, max_error: Some(0.0) };
    for span in encode_cells(&steps, &options, &OneWorker).unwrap() {
        assert_eq!(span_errors(&span, &steps_of(&span, &steps)).unwrap().max_error, 0.0);
        assert!(span.num_bytes() <= 520 * span.num_steps);
    }
}
