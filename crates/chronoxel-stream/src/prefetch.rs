//! Which steps come next: where playback will be, so that payloads are there before it is.

use std::collections::HashSet;

use crate::Tier;

/// A position in a series, and how it moves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Playhead {
    /// Steps of the series, at least 1.
    pub num_steps: u32,
    /// Where it is; the step shown is the whole part.
    pub position: f64,
    /// Steps to go on by in each frame: 1 shows each step once, 0.25 four times, 8 every eighth, negative ones play backwards, 0 rests.
    pub steps_per_frame: f64,
    /// Whether playback starts over when it reaches the end (or the start, backwards).
    pub is_looping: bool,
}

impl Playhead {
    /// The step that is shown.
    pub fn step(&self) -> u32 {
        (self.position.max(0.0) as u32).min(self.num_steps.saturating_sub(1))
    }

    /// Where it is one frame later; `None` where playback ends. A round starts over at the first step, or the last one backwards, so that every round
    /// shows the same steps.
    pub fn next(&self) -> Option<Self> {
        let position = self.position + self.steps_per_frame;
        let end = f64::from(self.num_steps);
        if (0.0..end).contains(&position) {
            return Some(Self { position, ..*self });
        }
        let start = if self.steps_per_frame > 0.0 { 0.0 } else { end - 1.0 };
        (self.is_looping && position.is_finite()).then_some(Self { position: start, ..*self })
    }

    /// The step shown and at most `most` different ones after it, in the order in which they will be shown.
    pub fn coming(&self, most: u32) -> Vec<(u32, Tier)> {
        let mut steps = vec![(self.step(), Tier::Needed)];
        let mut seen = HashSet::from([self.step()]);
        let mut at = *self;
        if self.steps_per_frame.abs() < 1.0 {
            // Every step is shown, each in several frames.
            at.position = f64::from(self.step());
            at.steps_per_frame = self.steps_per_frame.signum();
        }
        while self.steps_per_frame != 0.0 && steps.len() as u64 <= u64::from(most) {
            match at.next() {
                Some(next) if seen.insert(next.step()) => at = next,
                _ => break,
            }
            steps.push((at.step(), Tier::Coming(steps.len() as u32)));
        }
        steps
    }
}

/// The steps around one that somebody drags a slider to: it first, then its neighbours, two on the side that the drag moves to for each on the other.
///
/// * `direction`: sign of the last movement; at 0 both sides are alike
/// * `most`: neighbours at most
pub fn scrubbing(num_steps: u32, step: u32, direction: i32, most: u32) -> Vec<(u32, Tier)> {
    let last = i64::from(num_steps.saturating_sub(1));
    let here = i64::from(step).min(last);
    let sign = if direction < 0 { -1 } else { 1 };
    let per_turn = if direction == 0 { 1 } else { 2 };
    let mut steps = vec![(here as u32, Tier::Needed)];
    let (mut ahead, mut behind) = (1i64, 1i64);
    while steps.len() as u64 <= u64::from(most) && (ahead <= last || behind <= last) {
        let turn = (0..per_turn).map(|n| sign * (ahead + n)).chain([-sign * behind]);
        for offset in turn {
            let at = here + offset;
            if (0..=last).contains(&at) && steps.len() as u64 <= u64::from(most) {
                steps.push((at as u32, Tier::Coming(steps.len() as u32)));
            }
        }
        ahead += per_turn;
        behind += 1;
    }
    steps
}

#[cfg(test)]
mod tests {
    use super::*;

    fn head(num_steps: u32, position: f64, steps_per_frame: f64, is_looping: bool) -> Playhead {
        Playhead { num_steps, position, steps_per_frame, is_looping }
    }

    /// Steps that come, checked to have tiers 1, 2, … after the one shown.
    fn coming(playhead: Playhead, most: u32) -> Vec<u32> {
        numbered(playhead.coming(most))
    }

    fn numbered(steps: Vec<(u32, Tier)>) -> Vec<u32> {
        let tiers = steps.iter().enumerate().map(|(n, _)| match n {
            0 => Tier::Needed,
            n => Tier::Coming(n as u32),
        });
        assert!(tiers.eq(steps.iter().map(|(_, tier)| *tier)), "{steps:?}");
        steps.into_iter().map(|(step, _)| step).collect()
    }

    #[test]
    fn steps_come_in_the_direction_of_play() {
        assert_eq!(coming(head(10, 4.0, 1.0, false), 3), [4, 5, 6, 7]);
        assert_eq!(coming(head(10, 4.0, -1.0, false), 3), [4, 3, 2, 1]);
        assert_eq!(coming(head(10, 4.0, 0.0, true), 3), [4]);
    }

    #[test]
    fn fast_play_passes_steps_over_and_slow_play_repeats_them() {
        assert_eq!(coming(head(100, 0.0, 8.0, false), 4), [0, 8, 16, 24, 32]);
        assert_eq!(coming(head(100, 5.0, 2.5, false), 4), [5, 7, 10, 12, 15]);
        assert_eq!(coming(head(100, 5.0, 0.25, false), 2), [5, 6, 7]);
        assert_eq!(coming(head(100, 5.75, 0.25, false), 2), [5, 6, 7]);
        assert_eq!(coming(head(100, 5.0, 1.5, false), 3), [5, 6, 8, 9]);
    }

    #[test]
    fn a_series_ends_or_starts_over() {
        assert_eq!(coming(head(10, 8.0, 1.0, false), 5), [8, 9]);
        assert_eq!(coming(head(10, 8.0, 1.0, true), 5), [8, 9, 0, 1, 2, 3]);
        assert_eq!(coming(head(10, 1.0, -1.0, true), 3), [1, 0, 9, 8]);
        assert_eq!(coming(head(20, 16.0, 8.0, true), 5), [16, 0, 8], "each round shows the same steps");
        assert_eq!(coming(head(3, 0.0, 1.0, true), 50), [0, 1, 2]);
        assert_eq!(coming(head(1, 0.0, 1.0, true), 5), [0]);
        assert_eq!(coming(head(5, 4.0, -0.5, false), 9), [4, 3, 2, 1, 0]);
        assert_eq!(head(10, 9.0, 1.0, false).next(), None);
        assert_eq!(head(10, 9.0, f64::NAN, true).next(), None);
    }

    /// What was announced is what is then shown.
    #[test]
    fn play_shows_what_was_announced() {
        for speed in [1.0, -1.0, 0.3, -0.7, 2.5, 8.0, -3.0, 1e-9, 1e12] {
            let mut at = head(40, 17.0, speed, true);
            for _ in 0..200 {
                let announced = coming(at, 1);
                let Some(next) = at.next() else { break };
                at = next;
                assert!(announced.contains(&at.step()), "{speed}: {announced:?} before {}", at.step());
            }
        }
    }

    #[test]
    fn scrubbing_looks_both_ways() {
        assert_eq!(numbered(scrubbing(100, 50, 0, 4)), [50, 51, 49, 52, 48]);
        assert_eq!(numbered(scrubbing(100, 50, 1, 6)), [50, 51, 52, 49, 53, 54, 48]);
        assert_eq!(numbered(scrubbing(100, 50, -1, 3)), [50, 49, 48, 51]);
        assert_eq!(numbered(scrubbing(100, 99, 1, 3)), [99, 98, 97, 96]);
        let mut all = numbered(scrubbing(9, 2, -1, 50));
        all.sort();
        assert_eq!(all, (0..9).collect::<Vec<_>>());
    }
}
