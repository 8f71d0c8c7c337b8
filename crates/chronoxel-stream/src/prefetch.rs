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

/// What to do when a step is due and its payloads are not there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Late {
    /// Keep the speed, and show fewer of the steps.
    Drop,
    /// Keep the steps, and show them later.
    Wait,
}

/// What a frame shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Shown {
    /// The same step as the frame before, as it should.
    Same,
    /// The same step, because the next one is not there yet.
    Late,
    /// Another step.
    Next,
    /// The same step: playback has ended.
    End,
}

/// A step shown so many times in a row without delay before more of them are tried again.
const PUNCTUAL: u32 = 16;

/// Playback of a series that may arrive more slowly than it is played.
///
/// Loads that are begun for a step and given up when its time has passed help nobody, so the step announced next stays the next until it is
/// there. Where steps are dropped, the one after it lies as much further on as the wait was long, and so on at that distance: the speed stays, and only steps that will be
/// shown are asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Playback {
    head: Playhead,
    late: Late,
    /// Frames that a position of the head stands for.
    frames_per_move: u32,
    /// Frames since the last move.
    num_frames: u32,
    num_punctual: u32,
    num_dropped: u64,
    num_late: u64,
}

impl Playback {
    /// Playback from a position on.
    pub fn new(head: Playhead, late: Late) -> Self {
        Self { head, late, frames_per_move: 1, num_frames: 0, num_punctual: 0, num_dropped: 0, num_late: 0 }
    }

    /// The step that is shown.
    pub fn step(&self) -> u32 {
        self.head.step()
    }

    /// The position that is shown, with the speed asked for.
    pub fn head(&self) -> Playhead {
        self.head
    }

    /// Jumps, or changes the speed.
    pub fn set_head(&mut self, head: Playhead) {
        *self = Self { num_dropped: self.num_dropped, num_late: self.num_late, ..Self::new(head, self.late) };
    }

    /// The step shown and those that will be shown next: see [`Playhead::coming`].
    pub fn coming(&self, most: u32) -> Vec<(u32, Tier)> {
        self.ahead().coming(most)
    }

    /// The head, moving by all that it moves by at a time.
    fn ahead(&self) -> Playhead {
        let steps_per_frame = self.head.steps_per_frame * f64::from(self.frames_per_move);
        Playhead { steps_per_frame, ..self.head }
    }

    /// A frame goes by.
    ///
    /// * `is_ready`: whether a step can be shown, asked of the next one alone
    pub fn advance(&mut self, is_ready: &mut dyn FnMut(u32) -> bool) -> Shown {
        self.num_frames += 1;
        if self.num_frames < self.frames_per_move {
            return Shown::Same;
        }
        let Some(next) = self.ahead().next() else { return Shown::End };
        if next.step() != self.step() && !is_ready(next.step()) {
            self.num_late += 1;
            return Shown::Late;
        }
        let is_new = next.step() != self.step();
        if is_new && self.late == Late::Drop {
            let passed = self.head.steps_per_frame.abs().min(1.0) * f64::from(self.frames_per_move);
            self.num_dropped += (passed as u64).saturating_sub(1);
            self.keep_speed();
        }
        self.head.position = next.position;
        self.num_frames = 0;
        if is_new { Shown::Next } else { Shown::Same }
    }

    /// Lets the distance of steps follow how long they take to arrive.
    fn keep_speed(&mut self) {
        if self.num_frames > self.frames_per_move {
            self.frames_per_move = self.num_frames;
            self.num_punctual = 0;
            return;
        }
        self.num_punctual += 1;
        if self.num_punctual == PUNCTUAL {
            self.frames_per_move = (self.frames_per_move - 1).max(1);
            self.num_punctual = 0;
        }
    }

    /// Steps that were passed over because there was no time to load them.
    pub fn num_dropped(&self) -> u64 {
        self.num_dropped
    }

    /// Frames that showed a step for longer because the next one was not there.
    pub fn num_late(&self) -> u64 {
        self.num_late
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

    #[test]
    fn waiting_shows_every_step_and_says_how_late_it_is() {
        let mut playback = Playback::new(head(10, 0.0, 1.0, false), Late::Wait);
        let mut shown = vec![0];
        for frame in 0.. {
            // A step takes three frames to arrive.
            match playback.advance(&mut |_| frame % 3 == 2) {
                Shown::Next => shown.push(playback.step()),
                Shown::End => break,
                Shown::Late => assert!(frame % 3 != 2),
                Shown::Same => panic!("each frame is due to show another step"),
            }
        }
        assert_eq!(shown, (0..10).collect::<Vec<_>>());
        assert_eq!((playback.num_late(), playback.num_dropped()), (18, 0));
    }

    #[test]
    fn dropping_keeps_the_speed() {
        for (steps_per_frame, frames_to_load) in [(1.0, 4), (-1.0, 3), (8.0, 2), (0.5, 5)] {
            let mut playback = Playback::new(head(1_000_000, 500_000.0, steps_per_frame, false), Late::Drop);
            let (mut loading, mut left, mut num_shown) = (None, frames_to_load, 0);
            for _ in 0..600 {
                // Nothing but the announced step is loaded.
                let next = playback.coming(1)[1].0;
                left = if loading == Some(next) { left - 1 } else { frames_to_load - 1 };
                loading = Some(next);
                num_shown +=
                    u64::from(playback.advance(&mut |step| step == next && left <= 0) == Shown::Next);
            }
            let distance = (playback.head().position - 500_000.0) / steps_per_frame;
            assert!((550.0..=600.0).contains(&distance), "{distance} frames' worth at {steps_per_frame}");
            assert!(
                (600 / frames_to_load as u64 - 30..=600 / 2).contains(&num_shown),
                "{num_shown} at {steps_per_frame}"
            );
            assert!(playback.num_dropped() > 0 || steps_per_frame.abs() < 1.0);
        }
    }

    #[test]
    fn what_was_dropped_comes_back_when_loads_are_fast_again() {
        let mut playback = Playback::new(head(100_000, 0.0, 1.0, true), Late::Drop);
        for frame in 0..100 {
            playback.advance(&mut |_| frame % 5 == 0);
        }
        assert!(playback.coming(1)[1].0 >= playback.step() + 5);
        let mut last = playback.step();
        for _ in 0..400 {
            last = playback.step();
            playback.advance(&mut |_| true);
        }
        assert_eq!(playback.step(), last + 1);
        let dropped = playback.num_dropped();
        playback.set_head(head(100_000, 7.0, -1.0, true));
        playback.advance(&mut |_| true);
        assert_eq!((playback.step(), playback.num_dropped()), (6, dropped));
    }
}
