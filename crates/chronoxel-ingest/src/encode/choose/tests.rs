//! Properties of the choice over seeded fields: the pieces partition the steps, the bound holds on what is decoded.

use chronoxel_codec::stage_from_bytes;

use super::*;
use crate::encode::pad::pad;

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }
}

fn layout() -> BrickLayout {
    BrickLayout::new(8).unwrap()
}

/// A brick over `num_steps` steps from a function of `[x, y, z]` and the step.
fn field<T: Real>(num_steps: usize, mut value: impl FnMut([f64; 3], f64) -> f64) -> Vec<Vec<T>> {
    let full = layout().full_edge();
    let place = |i: usize| [i % full, i / full % full, i / full / full].map(|p| p as f64);
    let mut step = |t: usize| {
        (0..layout().num_full()).map(|i| T::from_f64(value(place(i), t as f64))).collect::<Vec<T>>()
    };
    (0..num_steps).map(&mut step).collect()
}

/// A smooth wave that moves by `speed` samples a step.
fn wave(speed: f64) -> impl Fn([f64; 3], f64) -> f64 {
    move |[x, y, z], t| libm::sin(0.3 * (x - speed * t) + 0.1 * y) + 0.4 * libm::cos(0.2 * z + 0.1 * x)
}

fn stored_len(bytes: &[u8]) -> usize {
    zstd::bulk::compress(bytes, 1).unwrap().len()
}

struct Case<'a, T> {
    node: NodeWindow<'a, T>,
    bound: f64,
}

impl<T: Real + SampleValue> Case<'_, T> {
    fn pieces(&self) -> Vec<Piece> {
        within_bound(&self.node, self.bound, true, &layout(), &stored_len).unwrap()
    }

    /// Checks every promise on the pieces and returns them.
    fn check(&self) -> Vec<Piece> {
        let pieces = self.pieces();
        assert_eq!(pieces, self.pieces(), "the same samples, the same pieces");
        let mut next = 0;
        for piece in &pieces {
            assert_eq!(piece.start, next, "pieces follow one another");
            next += piece.len;
            assert!(piece.len >= 1 && piece.window.is_power_of_two() && piece.window <= self.node.window);
            let first = (self.node.lead + piece.start) / piece.window as usize;
            let last = (self.node.lead + piece.start + piece.len - 1) / piece.window as usize;
            assert_eq!(first, last, "a piece stays within one place of the dyadic tree");
            let masks = &self.node.masks[piece.start..][..piece.len];
            assert!(masks.iter().all(|mask| *mask == masks[0]), "one mask");
            self.check_samples(piece);
        }
        assert_eq!(next, self.node.steps.len(), "all steps");
        pieces
    }

    fn check_samples(&self, piece: &Piece) {
        let mut range = [f64::INFINITY, f64::NEG_INFINITY];
        for row in 0..piece.len {
            let decoded = match &piece.choice {
                Choice::Empty => panic!("there are samples"),
                Choice::Constant(value) => vec![*value; layout().num_full()],
                Choice::Coded(payload) => {
                    decode_f64(&stored(payload, piece.window), &layout(), row as u32).unwrap()
                }
            };
            let at = piece.start + row;
            for (i, (&sample, &decoded)) in self.node.steps[at].iter().zip(&decoded).enumerate() {
                range = [range[0].min(decoded), range[1].max(decoded)];
                let error = (sample.to_f64() - decoded).abs();
                let masked = self.node.masks[at].is_some_and(|mask| mask.get(i));
                assert!(masked || error <= self.bound, "step {at}, sample {i}: {error} > {}", self.bound);
            }
        }
        assert_eq!(piece.drawn_range, range);
    }
}

/// The payload as it comes back from its bytes, by a class that is announced for windows of 16 and fits this one.
fn stored(payload: &Payload, window: u32) -> Payload {
    let class = PayloadClass { stages: payload.stages.iter().map(Stage::class).collect() };
    assert!(classes(16).contains(&class) && class.fits_window(window), "{class}");
    let through_bytes = |stage: &Stage| {
        let bytes = stage_to_bytes(stage, &layout());
        stage_from_bytes(&stage.class(), &layout(), &bytes).unwrap()
    };
    Payload { stages: payload.stages.iter().map(through_bytes).collect() }
}

fn check<T: Real + SampleValue>(steps: &[Vec<T>], window: u32, lead: usize, bound: f64) -> Vec<Piece> {
    let whole = |v: &T| v.to_f64().abs() < 9e15 && v.to_f64() == v.to_f64().trunc();
    let node = NodeWindow {
        steps: steps.iter().map(Vec::as_slice).collect(),
        masks: vec![None; steps.len()],
        lead,
        window,
        whole_numbers: steps.iter().flatten().all(whole),
    };
    Case { node, bound }.check()
}

#[test]
fn noise_and_waves_stay_within_the_bound() {
    let mut random = Random(1);
    for bound in [3e-5, 1e-3, 0.02, 0.3, 3.0] {
        for (seed, amplitude) in [(2, 1.0), (3, 0.01)] {
            let mut noise = Random(seed);
            check(&field::<f32>(8, |_, _| amplitude * noise.unit() + 7.0), 8, 0, bound);
        }
        for speed in [0.0, 0.01, 0.2, 2.0] {
            check(&field::<f32>(8, wave(speed)), 8, 0, bound);
            check(&field::<f64>(16, |p, t| wave(speed)(p, t) + 0.01 * random.unit()), 16, 0, bound);
        }
    }
}

#[test]
fn steps_missing_at_either_end_are_nobody_elses() {
    for lead in 0..8 {
        for num_steps in 1..=8 - lead {
            check(&field::<f32>(num_steps, wave(0.05)), 8, lead, 0.05);
        }
    }
    // Places 5 to 7 of 8: one span at the longest.
    let still = check(&field::<f32>(3, wave(0.0)), 8, 5, 0.01);
    assert_eq!(still.iter().map(|p| (p.start, p.len, p.window)).collect::<Vec<_>>(), [(0, 3, 4)]);
}

#[test]
fn whole_numbers_of_16_bits_lose_nothing() {
    let mut random = Random(4);
    check(&field::<f32>(4, |_, _| (random.next() % 65536) as f64), 4, 0, 0.0);
    check(&field::<f64>(4, |[x, y, z], t| 3.0 * x + y + (z + t).floor() - 40000.0), 4, 0, 0.0);
    check(&field::<f32>(8, |p, t| (200.0 + 50.0 * wave(0.1)(p, t)).round()), 8, 0, 0.0);
    // A little error makes for a coarser grid of whole numbers.
    check(&field::<f32>(8, |p, t| (9000.0 + 8000.0 * wave(0.1)(p, t)).round()), 8, 0, 2.5);
    // Steps that are 16 bits wide each, 2^20 apart.
    check(&field::<f64>(4, |[x, ..], t| 6000.0 * x + 1_048_576.0 * t), 4, 0, 0.0);
}

#[test]
fn what_does_not_change_is_stored_once() {
    let still = check(&field::<f32>(16, wave(0.0)), 16, 0, 0.001);
    assert_eq!((still.len(), still[0].window), (1, 16));
    let constant = check(&field::<f32>(16, |_, _| 0.1), 16, 0, 0.0);
    assert_eq!(constant.len(), 1);
    assert_eq!(constant[0].choice, Choice::Constant(f64::from(0.1f32)));
    // No lattice is so fine; equal steps are one piece all the same.
    let exact = check(&field::<f32>(8, |[x, ..], _| if x < 4.0 { 0.25 } else { 0.5 }), 8, 0, 0.0);
    assert_eq!(exact.len(), 1);
    let blinking = field::<f32>(8, |[x, ..], t| if x < 4.0 { 3.0 } else { 5.0 + t % 2.0 });
    assert_eq!(check(&blinking, 8, 0, 0.0).len(), 1, "a table of two entries serves all steps");
    assert!(check(&blinking, 8, 0, 0.5).iter().all(|p| p.window == 8));
}

#[test]
fn the_ends_of_the_number_range() {
    let denormal = field::<f64>(4, |[x, y, _], t| (x + 11.0 * y + t) * 5e-324);
    check(&denormal, 4, 0, 1e-320);
    let tiny = field::<f64>(4, |p, t| 1e-305 * wave(0.1)(p, t));
    check(&tiny, 4, 0, 1e-307);
    check(&tiny, 4, 0, 4e-308);
    check(&field::<f64>(4, |p, t| 1e300 * wave(0.1)(p, t)), 4, 0, 1e297);
    check(&field::<f32>(4, |p, t| 3e38 * 0.5 * wave(0.1)(p, t)), 4, 0, 1e36);
    check(&field::<f64>(4, |p, t| 1e9 + wave(0.1)(p, t)), 4, 0, 0.01);
    let too_wide = field::<f64>(2, |[x, ..], _| if x < 4.0 { f64::MAX } else { -f64::MAX });
    let node = NodeWindow {
        steps: too_wide.iter().map(Vec::as_slice).collect(),
        masks: vec![None; 2],
        lead: 0,
        window: 2,
        whole_numbers: false,
    };
    let refused = within_bound(&node, 1.0, true, &layout(), &stored_len);
    assert!(matches!(refused, Err(Refusal::Codec(_))), "{refused:?}");
}

#[test]
fn a_bound_beyond_16_bits_is_refused_or_met_as_well_as_can_be() {
    let steps = field::<f64>(2, wave(0.5));
    let node = NodeWindow {
        steps: steps.iter().map(Vec::as_slice).collect(),
        masks: vec![None; 2],
        lead: 0,
        window: 2,
        whole_numbers: false,
    };
    let refused = within_bound(&node, 1e-9, true, &layout(), &stored_len);
    assert!(matches!(refused, Err(Refusal::Bound { error, bound: 1e-9 }) if error < 1e-4), "{refused:?}");
    let best = within_bound(&node, 1e-9, false, &layout(), &stored_len).unwrap();
    assert_eq!(best.len(), 2);
    assert_eq!(best[0].choice, {
        let stages = vec![quantize_affine(&steps[0], false, 16).unwrap()];
        Choice::Coded(Payload { stages })
    });
}

#[test]
fn masks_part_spans_and_masked_samples_may_be_anything() {
    let full = layout().full_edge();
    for (rate, num_parts) in [(0.0, 1), (0.5, 4)] {
        // A front of masked samples that moves by `rate` samples a step.
        let mut steps =
            field::<f32>(
                8,
                |[x, y, z], t| {
                    if x < 2.0 + (rate * t).floor() { f64::NAN } else { wave(0.02)([x, y, z], t) }
                },
            );
        let masks: Vec<BitMask> =
            steps.iter().map(|s| BitMask::from_flags(s.iter().map(|v| v.is_masked()))).collect();
        steps.iter_mut().for_each(|step| pad(step, full, false));
        let node = NodeWindow {
            steps: steps.iter().map(Vec::as_slice).collect(),
            masks: masks.iter().map(Some).collect(),
            lead: 0,
            window: 8,
            whole_numbers: false,
        };
        let pieces = Case { node, bound: 0.3 }.check();
        assert_eq!(pieces.len(), num_parts);
    }
}

#[test]
fn longer_windows_never_cost_more() {
    let bytes = |pieces: &[Piece]| -> usize {
        let stages = |piece: &Piece| match &piece.choice {
            Choice::Coded(p) => p.stages.iter().map(|s| stored_len(&stage_to_bytes(s, &layout()))).sum(),
            _ => 0,
        };
        pieces.iter().map(|piece| RECORD_BYTES + stages(piece)).sum()
    };
    for (speed, at_least) in [(0.02, 2.0), (0.2, 1.05), (3.0, 1.0)] {
        let steps = field::<f32>(8, wave(speed));
        let single: usize =
            steps.iter().map(|step| bytes(&check(std::slice::from_ref(step), 1, 0, 0.02))).sum();
        let joined = bytes(&check(&steps, 8, 0, 0.02));
        assert!(single as f64 >= at_least * joined as f64, "speed {speed}: {single} against {joined}");
    }
}

#[test]
fn classes_are_few() {
    assert_eq!(classes(1), [PayloadClass::affine(8), PayloadClass::affine(16)]);
    let classes = classes(16);
    assert!(classes.len() <= 26);
    for class in &classes {
        class.validate().unwrap();
        assert_eq!(classes.iter().filter(|c| *c == class).count(), 1);
    }
}
