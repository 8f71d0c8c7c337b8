//! The fraction of the faces that a frame may draw, so that frames take a given time.

use chronoxel_stream::Pace;

/// Fractions lie this much apart, as a ratio, and more than a step must be asked for before the faces change: a choice of
/// other faces is sorted anew.
const RATIO: f64 = 1.19;
/// Most steps that the fraction changes by at a time, so that nobody sees it jump.
const MOST_STEPS: i32 = 2;
/// Smallest fraction beside none, as a power of [`RATIO`].
const LEAST: i32 = -32;

/// A target for the time of a frame, held by the number of faces. Looks at no clock.
#[derive(Debug, Clone)]
pub struct DetailPace {
    pace: Pace,
    num_boundary: usize,
    num_inner: usize,
    /// The fraction, as a power of [`RATIO`]: 0 is all.
    level: i32,
    /// Frames since the fraction changed.
    num_alike: u32,
}

impl DetailPace {
    /// Nothing measured yet: the first frame draws a tenth of the faces within.
    ///
    /// * `target_ms`: the time of a frame to hold, > 0
    pub fn new(target_ms: f64, num_boundary: usize, num_inner: usize) -> Self {
        let level = level_of(0.1);
        let mut pace = Self { pace: Pace::new(target_ms), num_boundary, num_inner, level, num_alike: 0 };
        pace.pace = Pace::starting_at(target_ms, pace.cost(pace.fraction()));
        pace
    }

    /// The fraction of the faces within that the next frame draws.
    pub fn fraction(&self) -> f64 {
        fraction_of(self.level)
    }

    /// A finer fraction, for a picture that stands still: all faces in a few frames.
    pub fn refined(&self, fraction: f64) -> f64 {
        if fraction >= 0.4 { 1.0 } else { (2.5 * fraction).max(0.05) }
    }

    /// Tells how long a frame took.
    ///
    /// * `num_faces`: that were to be drawn
    /// * `view_changed`: whether faces were sorted for it
    pub fn measured(&mut self, frame_ms: f64, num_faces: usize, view_changed: bool) {
        // Faces that were chosen anew are sorted: that is no frame to learn from, unless every frame sorts.
        let is_typical = !view_changed || self.num_alike > 0;
        self.num_alike += 1;
        if !is_typical {
            return;
        }
        self.pace.measured(frame_ms, num_faces as f64);
        let wanted = (self.pace.cost_limit() - self.num_boundary as f64) / self.num_inner.max(1) as f64;
        let wanted = exact_level(wanted).clamp(f64::from(LEAST), 0.0);
        if (wanted - f64::from(self.level)).abs() > 1.0 || (wanted == 0.0 && self.level != 0) {
            let change = (wanted.floor() as i32 - self.level).clamp(-MOST_STEPS, MOST_STEPS);
            if change != 0 {
                self.level += change;
                self.num_alike = 0;
            }
        }
    }

    fn cost(&self, fraction: f64) -> f64 {
        self.num_boundary as f64 + fraction * self.num_inner as f64
    }
}

fn exact_level(fraction: f64) -> f64 {
    if fraction <= 0.0 { f64::from(LEAST) } else { fraction.ln() / RATIO.ln() }
}

fn level_of(fraction: f64) -> i32 {
    (exact_level(fraction).floor() as i32).clamp(LEAST, 0)
}

fn fraction_of(level: i32) -> f64 {
    if level <= LEAST { 0.0 } else { RATIO.powi(level).min(1.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOUNDARY: usize = 5_000;
    const INNER: usize = 400_000;

    /// What frames take: a fixed part and one that grows with the faces; and a sort where they change.
    struct Machine {
        fixed_ms: f64,
        ms_per_face: f64,
        before: f64,
    }

    impl Machine {
        /// Plays frames; gives the fractions that they drew.
        fn play(&mut self, pace: &mut DetailPace, num: usize) -> Vec<f64> {
            let frame = |_| {
                let fraction = pace.fraction();
                let faces = BOUNDARY + (fraction * INNER as f64) as usize;
                let changed = fraction != self.before;
                self.before = fraction;
                let sort_ms = if changed { 1e-4 * faces as f64 } else { 0.0 };
                pace.measured(self.fixed_ms + self.ms_per_face * faces as f64 + sort_ms, faces, changed);
                fraction
            };
            (0..num).map(frame).collect()
        }

        fn ms(&self, fraction: f64) -> f64 {
            self.fixed_ms + self.ms_per_face * (BOUNDARY as f64 + fraction * INNER as f64)
        }
    }

    fn machine(fixed_ms: f64, ms_per_face: f64) -> Machine {
        Machine { fixed_ms, ms_per_face, before: -1.0 }
    }

    #[test]
    fn the_target_is_held_and_then_nothing_changes() {
        for (fixed_ms, ms_per_face) in [(5.0, 4e-4), (20.0, 1e-3), (1.0, 2e-4)] {
            let mut pace = DetailPace::new(50.0, BOUNDARY, INNER);
            let mut machine = machine(fixed_ms, ms_per_face);
            let fractions = machine.play(&mut pace, 80);
            let last = fractions[79];
            assert!((machine.ms(last) / 50.0 - 1.0).abs() < 0.2, "{last}: {} ms", machine.ms(last));
            assert!(fractions[60..].iter().all(|f| *f == last), "{fractions:?}");
            // Nobody sees it jump.
            assert!(fractions.windows(2).all(|w| w[1] / w[0] < 1.45 && w[0] / w[1] < 1.45), "{fractions:?}");
        }
    }

    #[test]
    fn a_mesh_that_is_small_enough_is_drawn_whole() {
        let mut pace = DetailPace::new(50.0, BOUNDARY, INNER);
        assert_eq!(machine(1.0, 1e-5).play(&mut pace, 40).last(), Some(&1.0));
    }

    #[test]
    fn a_target_that_nothing_meets_leaves_the_boundary() {
        let mut pace = DetailPace::new(5.0, BOUNDARY, INNER);
        let fractions = machine(40.0, 1e-3).play(&mut pace, 60);
        assert!(*fractions.last().unwrap() < 0.005, "{fractions:?}");
    }

    #[test]
    fn a_slower_machine_draws_less_and_a_faster_one_more() {
        let mut pace = DetailPace::new(50.0, BOUNDARY, INNER);
        let mut machine = machine(5.0, 4e-4);
        let before = *machine.play(&mut pace, 60).last().unwrap();
        machine.ms_per_face *= 4.0;
        let after = *machine.play(&mut pace, 60).last().unwrap();
        assert!((machine.ms(after) / 50.0 - 1.0).abs() < 0.25, "{after}: {} ms", machine.ms(after));
        assert!(after < 0.5 * before);
        machine.ms_per_face /= 4.0;
        let again = *machine.play(&mut pace, 60).last().unwrap();
        assert!((machine.ms(again) / 50.0 - 1.0).abs() < 0.25, "{again}");
    }

    #[test]
    fn what_stands_still_is_refined_to_all_faces() {
        let pace = DetailPace::new(50.0, BOUNDARY, INNER);
        let mut fraction = 0.01;
        let steps: Vec<f64> = (0..5)
            .map(|_| {
                fraction = pace.refined(fraction);
                fraction
            })
            .collect();
        assert_eq!(steps[4], 1.0);
        assert!(steps.windows(2).all(|w| w[1] >= w[0]));
    }
}
