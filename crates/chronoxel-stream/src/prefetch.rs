//! Which steps come next: where playback will be, so that payloads are there before it is.

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
        let mut seen = std::collections::HashSet::from([self.step()]);
        let mut at = *self;
        // Slow playback shows a step in many frames: whole frames are passed over until it changes.
        let frames_per_step = (1.0 / self.steps_per_frame.abs()).ceil().min(1e6) as u32;
        for _ in 0..most.min(self.num_steps) {
            let before = at.step();
            for _ in 0..frames_per_step {
                match at.next() {
                    Some(next) => at = next,
                    None => return steps,
                }
                if at.step() != before {
                    break;
                }
            }
            if !seen.insert(at.step()) {
                break;
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
