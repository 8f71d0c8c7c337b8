//! Windows in time: which steps of a node are coded as one.
//!
//! Windows of a node start at `phase + k · L`. Phases differ from node to node, so that no step replaces more than about
//! one in `L` of the bricks, and no whole plane of them (lum2001, section 3.4). What precedes the first start is a window
//! of its own that lacks its first steps, as the last one may lack its last. A series no longer than a window is one window.

use chronoxel_core::NodeId;

/// The windows of a series.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timing {
    /// L: steps of a window, a power of two.
    pub window: u32,
    /// Steps of the series.
    pub num_steps: u32,
    /// Whether phases differ from node to node.
    pub interleaved: bool,
}

impl Timing {
    /// `(x + 3 y + 5 z) mod L` of the node's brick.
    pub fn phase(&self, node: NodeId) -> u32 {
        let [x, y, z] = node.brick().map(u64::from);
        self.phase_of(x + 3 * y + 5 * z)
    }

    /// That of a node whose place counts as `place`.
    pub fn phase_of(&self, place: u64) -> u32 {
        // There is no border between windows to spread where there is one window.
        if !self.interleaved || self.num_steps <= self.window {
            0
        } else {
            (place % u64::from(self.window)) as u32
        }
    }

    /// Place of a step in the window that holds it: `0 .. L`.
    pub fn place(&self, phase: u32, step: u32) -> u32 {
        (step + self.window - phase) % self.window
    }

    /// Whether the window that holds a step ends with it.
    pub fn closes(&self, phase: u32, step: u32) -> bool {
        step + 1 == self.num_steps || self.place(phase, step) + 1 == self.window
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_out_of_phase_partition_the_series() {
        for (window, num_steps) in [(1, 5), (2, 5), (8, 3), (8, 8), (8, 21), (16, 40)] {
            let timing = Timing { window, num_steps, interleaved: true };
            for phase in 0..window {
                let ends: Vec<u32> = (0..num_steps).filter(|&s| timing.closes(phase, s)).collect();
                assert_eq!(ends.last(), Some(&(num_steps - 1)));
                let starts = ends.iter().map(|end| end + 1).filter(|&s| s < num_steps);
                assert!(
                    starts.clone().all(|start| start % window == phase && timing.place(phase, start) == 0)
                );
                // Only the first and the last window are short.
                assert!(starts.collect::<Vec<_>>().windows(2).all(|pair| pair[1] - pair[0] == window));
            }
        }
    }

    #[test]
    fn a_short_series_is_one_window() {
        let timing = Timing { window: 8, num_steps: 8, interleaved: true };
        let node = NodeId::new(0, [1, 1, 1]);
        assert_eq!((timing.phase(node), timing.phase_of(7)), (0, 0));
        assert_eq!(Timing { window: 8, num_steps: 9, interleaved: true }.phase(node), 1);
        assert_eq!(Timing { window: 8, num_steps: 9, interleaved: false }.phase(node), 0);
    }

    #[test]
    fn a_step_closes_an_equal_share_of_the_nodes() {
        let timing = Timing { window: 8, num_steps: 100, interleaved: true };
        let nodes = (0..512u32).map(|i| NodeId::new(0, [i % 8, i / 8 % 8, i / 64]));
        let mut closing = [0; 8];
        nodes.for_each(|node| {
            closing[(0..8).find(|&s| timing.closes(timing.phase(node), 40 + s)).unwrap() as usize] += 1
        });
        assert_eq!(closing, [64; 8]);
    }
}
