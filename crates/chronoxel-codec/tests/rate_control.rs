//! Points of rate control, decoded: they err by what they say, cover the run, and reach every rate.

use chronoxel_codec::{
    CodedPiece, PayloadClass, RateOptions, RatePoint, Run, Stage, choose_points, decode_f64, first_slopes,
    rate_points, stage_to_bytes,
};
use chronoxel_core::BrickLayout;

mod random;
use random::Random;

const STEPS: usize = 11;

/// Stored length as the order-0 entropy of the bytes: what a Huffman coder comes near to.
fn entropy_bytes(bytes: &[u8]) -> usize {
    let mut counts = [0usize; 256];
    bytes.iter().for_each(|&b| counts[usize::from(b)] += 1);
    let bits = |&c: &usize| if c > 0 { c as f64 * (bytes.len() as f64 / c as f64).log2() } else { 0.0 };
    16 + (counts.iter().map(bits).sum::<f64>() / 8.0).ceil() as usize
}

fn options(max_stages: usize, whole_numbers: bool) -> RateOptions<'static> {
    RateOptions {
        max_window: 8,
        max_stages,
        num_entries: 256,
        whole_numbers,
        span_bytes: 20,
        stored_bytes: &entropy_bytes,
    }
}

/// Steps of bricks: waves that move, waves that stand, noise, whole numbers, constants, and steps that differ by one sample.
fn bricks(layout: &BrickLayout) -> Vec<(&'static str, Vec<Vec<f64>>)> {
    let full = layout.full_edge();
    let mut random = Random(3);
    let mut brick = |name: &'static str, value: &mut dyn FnMut(f64, f64, f64, f64, &mut Random) -> f64| {
        let step =
            |t: usize, random: &mut Random, value: &mut dyn FnMut(f64, f64, f64, f64, &mut Random) -> f64| {
                let at = |i: usize| [i % full, i / full % full, i / full / full].map(|c| c as f64);
                (0..layout.num_full())
                    .map(|i| {
                        let [x, y, z] = at(i);
                        value(x, y, z, t as f64, random)
                    })
                    .collect()
            };
        (name, (0..STEPS).map(|t| step(t, &mut random, value)).collect())
    };
    vec![
        brick("moving", &mut |x, y, z, t, r| {
            (0.5 * x + 0.3 * t).sin() * (0.4 * y).cos() + 0.2 * z + 0.02 * r.unit()
        }),
        brick("standing", &mut |x, y, z, _, _| (0.5 * x).sin() * (0.4 * y).cos() + 0.2 * z),
        brick("noise", &mut |_, _, _, _, r| 100.0 * r.unit()),
        brick("whole numbers", &mut |_, _, _, _, r| (r.next() % 1000) as f64),
        brick("constant", &mut |_, _, _, _, _| -4.5),
        brick("one sample", &mut |x, y, z, t, _| f64::from(t > 5.0 && x == 4.0 && y == 4.0 && z == 4.0)),
        brick("denormal", &mut |_, _, _, _, r| f64::from_bits(r.next() % 100)),
    ]
}

fn trained(layout: &BrickLayout) -> Vec<u32> {
    let full = layout.full_edge();
    let inside = |&i: &u32| {
        let i = i as usize;
        [i % full, i / full % full, i / full / full].iter().all(|c| (1..=layout.edge).contains(c))
    };
    (0..layout.num_full() as u32).filter(inside).collect()
}

/// Squared error of a point by decoding it, and its bytes by counting them anew.
fn measure(point: &RatePoint, run: &Run<f64>, options: &RateOptions) -> (f64, u64) {
    let (mut error, mut bytes, mut next) = (0.0, 0, 0);
    for piece in &point.pieces {
        assert_eq!(piece.start, next);
        assert!(piece.len >= 1 && piece.len <= piece.window as usize && piece.window <= options.max_window);
        next += piece.len;
        bytes += options.span_bytes;
        let decoded = |t: usize| match &piece.coded {
            CodedPiece::Constant(v) => vec![*v; run.layout.num_full()],
            CodedPiece::Payload(payload) => decode_f64(payload, run.layout, t as u32).unwrap(),
        };
        if let CodedPiece::Payload(payload) = &piece.coded {
            let class = PayloadClass { stages: payload.stages.iter().map(Stage::class).collect() };
            assert!(class.fits_window(piece.window), "{class}");
            assert!(options.payload_classes(piece.window).contains(&class), "{class}");
            for stage in &payload.stages {
                bytes += entropy_bytes(&stage_to_bytes(stage, run.layout)) as u64;
            }
        }
        for t in 0..piece.len {
            let (decoded, step) = (decoded(t), run.steps[piece.start + t]);
            error +=
                run.trained.iter().map(|&i| (decoded[i as usize] - step[i as usize]).powi(2)).sum::<f64>();
        }
    }
    assert_eq!(next, run.steps.len());
    (error, bytes)
}

#[test]
fn points_err_and_take_what_they_say() {
    let layout = BrickLayout::new(8).unwrap();
    let trained = trained(&layout);
    for (name, steps) in bricks(&layout) {
        let steps: Vec<&[f64]> = steps.iter().map(|step| &step[..]).collect();
        let run = Run { steps: &steps, trained: &trained, layout: &layout };
        let all = || steps.iter().flat_map(|step| step.iter().copied());
        let width = all().fold(f64::NEG_INFINITY, f64::max) - all().fold(f64::INFINITY, f64::min);
        let slopes = first_slopes(width.max(1e-300));
        for max_stages in [1, 3] {
            let options = options(max_stages, name == "whole numbers");
            let points = rate_points(&run, &slopes, &options).unwrap();
            assert_eq!(points.len(), slopes.len() + 1);
            for (s, point) in points.iter().enumerate() {
                let (error, bytes) = measure(point, &run, &options);
                assert_eq!(bytes, point.bytes, "{name} {s}");
                // Listed values are rounded to 16 bits, uniform ones predicted from their step at 16 bits.
                let rounding = (width / 65535.0).powi(2) * (trained.len() * STEPS) as f64;
                let difference = (error - point.squared_error).abs();
                assert!(
                    difference <= 0.02 * error + 2.0 * rounding,
                    "{name} {s}: {error} {}",
                    point.squared_error
                );
            }
            if name == "whole numbers" {
                assert_eq!(measure(&points[0], &run, &options).0, 0.0);
            }
            for (pair, &slope) in points.windows(2).zip(&slopes) {
                let cost = |p: &RatePoint| p.squared_error + slope * 8.0 * p.bytes as f64;
                // The point of a slope is the best of that slope, but for what the search leaves out.
                assert!(cost(&pair[0]) <= 1.1 * cost(&pair[1]), "{name} {slope}");
            }
        }
    }
}

#[test]
fn every_rate_is_met_from_below_with_less_error_for_more_bytes() {
    let layout = BrickLayout::new(8).unwrap();
    let trained = trained(&layout);
    let bricks = bricks(&layout);
    let options = options(2, false);
    // Two bricks of which one moves, and twelve of which the one that moves is none of the first to be tried.
    for (names, probed_moves) in [(vec!["moving", "standing"], true), (vec!["constant"; 12], false)] {
        let mut group: Vec<Vec<&[f64]>> = names
            .iter()
            .map(|name| &bricks.iter().find(|brick| brick.0 == *name).unwrap().1)
            .map(|steps| steps.iter().map(|step| &step[..]).collect())
            .collect();
        if !probed_moves {
            group[1] = bricks[0].1.iter().map(|step| &step[..]).collect();
        }
        let (mut last, mut start) = (f64::INFINITY, None);
        for bits in [0.05, 0.2, 1.0, 2.0, 4.0, 8.0, 12.0] {
            let budget = (bits / 8.0 * (group.len() * STEPS * layout.num_full()) as f64) as u64;
            let (chosen, slope) =
                choose_points(group.len(), 4.0, budget, start, budget, |bricks: &[usize], slopes: &[f64]| {
                    let run = |&b: &usize| Run { steps: &group[b], trained: &trained, layout: &layout };
                    bricks
                        .iter()
                        .map(|b| rate_points(&run(b), slopes, &options))
                        .collect::<Result<Vec<_>, _>>()
                })
                .unwrap();
            // Bricks like these: every other rate starts from the slope of the one before, and keeps near it.
            let is_fresh = start.is_none();
            start = is_fresh.then_some(slope);
            let sum: u64 = chosen.iter().map(|point| point.bytes).sum();
            let error: f64 = chosen.iter().map(|point| point.squared_error).sum();
            let least: u64 = (group.len() * 2 * options.span_bytes as usize) as u64;
            assert!(sum <= budget.max(least), "{bits} bits: {sum} of {budget} bytes");
            assert!(error <= last, "{bits} bits: {error} after {last}");
            // The budget is used, until 16 bits for each sample of the bricks that change are all there is.
            let varied = group.iter().filter(|steps| steps[0] != steps[1]).count();
            let needs = (varied * STEPS * layout.num_full()) as f64;
            let used = sum as f64 >= 0.75 * (budget as f64).min(needs);
            // At low rates one table is a large part of the budget.
            assert!(used || bits < 1.0 || !is_fresh, "{bits} bits: {sum} of {budget} bytes");
            last = error;
        }
    }
}

#[test]
fn constants_cost_no_stage() {
    let layout = BrickLayout::new(8).unwrap();
    let trained = trained(&layout);
    let brick = vec![2.5; layout.num_full()];
    let steps = [&brick[..]; 8];
    let run = Run { steps: &steps, trained: &trained, layout: &layout };
    for point in rate_points(&run, &[1e-12, 1.0], &options(1, false)).unwrap() {
        assert_eq!((point.bytes, point.squared_error), (20, 0.0));
        assert_eq!(point.pieces.len(), 1);
        assert_eq!(point.pieces[0].coded, CodedPiece::Constant(2.5));
    }
}
