//! Which of many was used least recently, at no cost to each use.

/// Candidates to go, the one used least recently last; made anew when they run out.
#[derive(Debug, Default)]
pub(super) struct Oldest {
    /// Moment of use, and what was used then.
    candidates: Vec<(u64, u64)>,
}

impl Oldest {
    /// What was used least recently, before a moment; it must leave, or be used, before the next call.
    ///
    /// * `uses`: of everything there is, the moment of its last use and what it is
    /// * `last_use`: the same of one; `None` where it has left
    pub fn take<I: Iterator<Item = (u64, u64)>>(
        &mut self,
        before: u64,
        uses: impl Fn() -> I,
        last_use: impl Fn(u64) -> Option<u64>,
    ) -> Option<u64> {
        for is_fresh in [false, true] {
            if is_fresh {
                self.candidates.clear();
                self.candidates.extend(uses().filter(|(moment, _)| *moment < before));
                self.candidates.sort_unstable_by(|a, b| b.cmp(a));
            }
            while let Some((moment, what)) = self.candidates.pop() {
                // Used since it became a candidate, or gone: not the oldest any more.
                if last_use(what) == Some(moment) && moment < before {
                    return Some(what);
                }
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_goes_whatever_was_used_meanwhile() {
        let (mut oldest, mut now, mut seed) = (Oldest::default(), 100, 1u64);
        let mut uses: Vec<u64> = (0..50).collect();
        for round in 0..400 {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            now += 1;
            if seed >> 62 > 0 {
                uses[(seed >> 33) as usize % 50] = now;
                continue;
            }
            // Half of the time, what was used in the last ten moments must stay.
            let before = if round % 2 == 0 { now } else { now - 10 };
            let of_each = || uses.iter().enumerate().map(|(i, moment)| (*moment, i as u64));
            let expected = of_each().min().filter(|(moment, _)| *moment < before).map(|(_, i)| i);
            let found = oldest.take(before, of_each, |i| Some(uses[i as usize]));
            assert_eq!(found, expected, "round {round}");
            if let Some(i) = found {
                uses[i as usize] = now;
            }
        }
    }
}
