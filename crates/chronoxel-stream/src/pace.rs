//! A target for the time of a frame, held by feedback on what frames have cost.
//!
//! A frame is taken to last `fixed + slope · cost`. Both are estimated from the last frames by medians, so that single frames that hang, whatever for,
//! change nothing; three in a row that last much longer or shorter than expected are taken for a change of the machine or the scene, and both
//! follow at once.

use std::collections::VecDeque;

/// Frames that the estimates are made from.
const NUM_FRAMES: usize = 12;
/// Frames in a row that all must tell the same before a change is believed.
const NUM_ALIKE: usize = 3;
/// A frame that lasts this much longer or shorter than expected is not explained by noise.
const SURPRISE: f64 = 1.3;
/// A limit that is expected to miss the target by no more than this part of it stays, so that a cut can settle.
const DEAD_BAND: f64 = 0.03;
/// Costs must differ by this part of them to tell the slope.
const DISTINCT: f64 = 0.08;
/// Most that the limit grows by or shrinks by at a time.
const MOST_GROWTH: f64 = 4.0;
/// The same where less was drawn than allowed: the next split may be that of the root, into eight.
const MOST_HEADROOM: f64 = 16.0;

#[derive(Debug, Clone, Copy)]
struct Sample {
    ms: f64,
    cost: f64,
}

/// How much may be drawn so that frames take a given time. See the [module](self).
#[derive(Debug, Clone)]
pub struct Pace {
    target_ms: f64,
    limit: f64,
    samples: VecDeque<Sample>,
    /// `fixed` and `slope`, once a frame was measured.
    model: Option<[f64; 2]>,
    /// Whether the slope was seen, or only follows from taking all time for drawing.
    has_slope: bool,
}

impl Pace {
    /// Nothing measured yet: the first frame may draw nothing but what must be drawn.
    ///
    /// * `target_ms`: the time of a frame to hold, > 0
    pub fn new(target_ms: f64) -> Self {
        Self::starting_at(target_ms, 0.0)
    }

    /// Nothing measured yet, with the cost that the first frame may draw.
    pub fn starting_at(target_ms: f64, cost: f64) -> Self {
        let samples = VecDeque::with_capacity(NUM_FRAMES);
        Self { target_ms, limit: cost, samples, model: None, has_slope: false }
    }

    /// The cost up to which the next frame may draw, for [`crate::CutLimits::cost`].
    pub fn cost_limit(&self) -> f64 {
        self.limit
    }

    /// The time aimed for.
    pub fn target_ms(&self) -> f64 {
        self.target_ms
    }

    /// What a frame of some cost is expected to last, once one was measured.
    pub fn expected_ms(&self, cost: f64) -> Option<f64> {
        self.model.map(|[fixed, slope]| fixed + slope * cost)
    }

    /// Tells how long a frame took that drew so much. Frames that were not drawn are not told.
    ///
    /// * `cost_drawn`: in the units of [`crate::NodeView::cost`], of the nodes that were in fact drawn
    pub fn measured(&mut self, frame_ms: f64, cost_drawn: f64) {
        if !(frame_ms > 0.0 && frame_ms.is_finite() && cost_drawn >= 0.0 && cost_drawn.is_finite()) {
            return;
        }
        if self.samples.len() == NUM_FRAMES {
            self.samples.pop_front();
        }
        self.samples.push_back(Sample { ms: frame_ms, cost: cost_drawn });
        self.follow_change();
        self.estimate();
        self.set_limit();
    }

    /// The last frames, if there are as many as must tell alike.
    fn last(&self) -> impl Iterator<Item = Sample> + '_ {
        self.samples.iter().rev().take(NUM_ALIKE).copied()
    }

    /// Where the last frames all lasted much longer, or all much shorter, than expected, all earlier ones tell nothing any more.
    fn follow_change(&mut self) {
        let Some([fixed, slope]) = self.model.filter(|_| self.samples.len() >= NUM_ALIKE) else { return };
        let ratios: Vec<f64> = self.last().map(|s| s.ms / (fixed + slope * s.cost).max(1e-9)).collect();
        if ratios.iter().all(|r| *r > SURPRISE) || ratios.iter().all(|r| *r < 1.0 / SURPRISE) {
            let ratio = median(ratios);
            self.model = Some([fixed * ratio, slope * ratio]);
            self.samples.drain(..self.samples.len() - NUM_ALIKE);
        }
    }

    /// Slope by the median over pairs (Theil, 1950, and Sen, 1968), fixed part by the median over the last frames.
    fn estimate(&mut self) {
        let samples: Vec<Sample> = self.samples.iter().copied().collect();
        let typical = Sample {
            ms: median(samples.iter().map(|s| s.ms).collect()),
            cost: median(samples.iter().map(|s| s.cost).collect()),
        };
        let mut slopes = Vec::new();
        for (n, a) in samples.iter().enumerate() {
            let distinct =
                samples[..n].iter().filter(|b| (a.cost - b.cost).abs() > DISTINCT * a.cost.max(b.cost));
            slopes.extend(distinct.map(|b| (a.ms - b.ms) / (a.cost - b.cost)));
        }
        let known = self.model.map(|[_, slope]| slope).filter(|_| self.has_slope);
        // All time for drawing is the steepest that it can be.
        let steepest = if typical.cost > 0.0 { typical.ms / typical.cost } else { 0.0 };
        let slope = match (slopes.len() >= NUM_ALIKE, known) {
            (true, _) => {
                self.has_slope = true;
                median(slopes)
            }
            (false, Some(slope)) => slope,
            (false, None) => steepest,
        };
        let slope = slope.clamp(0.02 * steepest, steepest);
        let recent = samples.iter().rev().take(5);
        let fixed = median(recent.map(|s| s.ms - slope * s.cost).collect()).max(0.0);
        self.model = Some([fixed, slope]);
    }

    fn set_limit(&mut self) {
        let Some([fixed, slope]) = self.model else { return };
        let drawn = median(self.last().map(|s| s.cost).collect());
        if drawn == 0.0 {
            // Nothing to learn from, nor to lose, until a cost is allowed at which something is drawn.
            if self.last().all(|s| s.ms < self.target_ms) {
                self.limit = self.limit.max(1.0) * MOST_HEADROOM;
            }
            return;
        }
        let at_limit = fixed + slope * self.limit;
        let is_reached = drawn >= 0.8 * self.limit;
        if is_reached && (at_limit - self.target_ms).abs() <= DEAD_BAND * self.target_ms {
            return;
        }
        let mut wanted = if slope > 0.0 { (self.target_ms - fixed) / slope } else { f64::MAX };
        // While there is time to spare, the limit grows until something more is drawn: costs are estimates, and no more is learnt from drawing the same.
        if !is_reached && self.last().all(|s| s.ms < 0.8 * self.target_ms) {
            wanted = wanted.max(1.5 * self.limit);
        }
        let most = if is_reached { MOST_GROWTH } else { MOST_HEADROOM };
        // The fixed part may be taken for too much while the scene changes: no more is given up than the last frames ask for, whatever the estimate.
        let recent = median(self.last().map(|s| s.ms).collect());
        let least = (self.target_ms / recent).powi(2).clamp(1.0 / MOST_GROWTH, 1.0);
        self.limit = wanted.clamp(drawn * least, drawn * most);
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    let middle = values.len() / 2;
    match values.len() % 2 {
        1 => values[middle],
        _ => 0.5 * (values[middle - 1] + values[middle]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;

    /// What frames take: a fixed part, a part that grows with the cost, noise, and now and then a hitch.
    struct Machine {
        fixed: f64,
        slope: f64,
        noise: f64,
        hitches: f64,
        most_cost: f64,
        random: Random,
    }

    impl Machine {
        /// Runs frames, and returns the median time of the last `counted`.
        fn run(&mut self, pace: &mut Pace, frames: usize, counted: usize) -> f64 {
            let mut times = Vec::new();
            for _ in 0..frames {
                // A cut does not use its limit to the last.
                let granted = pace.cost_limit() * (0.88 + 0.12 * self.random.unit());
                let cost = granted.clamp(1.0, self.most_cost);
                let spread = 1.0 + self.noise * (2.0 * self.random.unit() - 1.0);
                let hitch = if self.random.chance(self.hitches) { 15.0 } else { 1.0 };
                let ms = (self.fixed + self.slope * cost) * spread * hitch;
                pace.measured(ms, cost);
                times.push(ms);
            }
            median(times.split_off(frames - counted))
        }
    }

    const TARGET: f64 = 33.0;

    fn machine(seed: u64, fixed: f64, slope: f64) -> Machine {
        Machine { fixed, slope, noise: 0.1, hitches: 0.03, most_cost: 1e12, random: Random(seed) }
    }

    fn check(median_ms: f64, what: &str) {
        assert!((median_ms / TARGET - 1.0).abs() < 0.15, "{median_ms} ms {what}");
    }

    #[test]
    fn the_target_is_met_after_thirty_frames() {
        for seed in 0..50 {
            for (fixed, slope) in [(0.0, 0.05), (5.0, 0.3), (15.0, 0.001), (22.0, 0.02), (1.0, 3.0)] {
                let mut pace = Pace::new(TARGET);
                let mut machine = machine(seed, fixed, slope);
                machine.run(&mut pace, 30, 1);
                for window in 0..5 {
                    let what = format!("seed {seed}, {fixed} + {slope} cost, window {window}");
                    check(machine.run(&mut pace, 30, 30), &what);
                }
            }
        }
    }

    #[test]
    fn it_is_met_again_after_a_sudden_change() {
        for seed in 0..50 {
            for (factor, fixed) in [(4.0, 2.0), (0.25, 2.0), (4.0, 0.0), (0.25, 12.0)] {
                let mut pace = Pace::new(TARGET);
                let mut machine = machine(seed, fixed, 0.1);
                machine.run(&mut pace, 80, 1);
                machine.slope *= factor;
                machine.run(&mut pace, 30, 1);
                check(machine.run(&mut pace, 30, 30), &format!("seed {seed}, times {factor}, fixed {fixed}"));
            }
        }
    }

    #[test]
    fn a_hitch_changes_next_to_nothing() {
        let mut pace = Pace::new(TARGET);
        let mut machine = Machine { noise: 0.03, hitches: 0.0, ..machine(7, 4.0, 0.1) };
        machine.run(&mut pace, 60, 1);
        let before = pace.cost_limit();
        for hitch_ms in [400.0, 5000.0] {
            pace.measured(hitch_ms, before);
            assert!((pace.cost_limit() / before - 1.0).abs() < 0.1, "{} from {before}", pace.cost_limit());
            machine.run(&mut pace, 6, 1);
        }
    }

    #[test]
    fn a_noiseless_limit_rests() {
        let mut pace = Pace::new(TARGET);
        let mut limits = Vec::new();
        for _ in 0..60 {
            let cost = pace.cost_limit().max(1.0);
            pace.measured(4.0 + 0.1 * cost, cost);
            limits.push(pace.cost_limit());
        }
        assert!(limits[30..].iter().all(|limit| *limit == limits[59]), "{limits:?}");
        assert!((limits[59] - 290.0).abs() < 10.0);
    }

    #[test]
    fn a_volume_that_is_cheap_enough_is_drawn_whole() {
        let mut pace = Pace::new(TARGET);
        let mut machine = Machine { most_cost: 50.0, ..machine(3, 4.0, 0.1) };
        machine.run(&mut pace, 30, 1);
        assert!(pace.cost_limit() >= 50.0);
    }

    #[test]
    fn a_target_that_nothing_meets_leaves_the_coarsest_cut() {
        let mut pace = Pace::new(TARGET);
        let mut machine = machine(3, 60.0, 0.1);
        machine.run(&mut pace, 40, 1);
        assert!(pace.cost_limit() < 2.0, "{}", pace.cost_limit());
        // Times that mean nothing are passed over.
        let before = pace.cost_limit();
        [f64::NAN, 0.0, -1.0, f64::INFINITY].into_iter().for_each(|ms| pace.measured(ms, 1.0));
        assert_eq!(pace.cost_limit(), before);
    }
}
