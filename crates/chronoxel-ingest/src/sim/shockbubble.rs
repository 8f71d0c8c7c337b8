//! `sim:shockbubble`: a shock in air runs over a bubble of light gas in a box of 5 : 2 : 2.
//!
//! The experiment of Haas and Sturtevant (1987) and lum2001's third data set in kind: the shock enters the light
//! bubble, runs ahead inside it, and its misaligned pressure and density gradients roll the bubble up into a
//! vortex ring. All gas has one ratio of specific heats; the bubble is as light as helium.
//!
//! Lengths are in bubble diameters, densities and pressures in those of the still air (so the density is a
//! ratio, unit `1`), and times in diameters per √(pressure / density): the speed of sound is √1.4.
//! Whatever `dims` is, the box is 2 high, its cells are cubes and its length follows (5 by default).

use chronoxel_core::{TimeAxis, UniformGrid};
use libm::{sqrt, tanh};

use super::euler::{Boundary, Euler, Primitive};
use super::spec::Spec;
use super::{Run, SimulatedSeries, WorkingBytes};
use crate::SourceError;

const GAMMA: f64 = 1.4;
const HEIGHT: f64 = 2.0;
const DURATION: f64 = 2.8;
const BUBBLE_DENSITY: f64 = 0.138;
const BUBBLE_CENTRE_X: f64 = 1.1;
const BUBBLE_RADIUS: f64 = 0.5;
const SHOCK_X: f64 = 0.45;
const STILL_AIR: Primitive = [1.0, 0.0, 0.0, 0.0, 1.0];

/// Opens `sim:shockbubble`; options `dims`, `steps` and `mach` (of the shock).
pub(super) fn open(spec: &Spec) -> Result<SimulatedSeries, SourceError> {
    spec.check_keys(&["dims", "steps", "mach"])?;
    let dims = spec.dims([160, 64, 64], 8)?;
    let steps = spec.steps(32)?;
    let mach = spec.number("mach", 1.7, [1.01, 10.0])?;
    let spacing = HEIGHT / dims[2] as f64;
    Ok(SimulatedSeries::new(
        UniformGrid::new(dims, [0.5 * spacing; 3], [spacing; 3]).expect("checked dims"),
        TimeAxis::regular(steps, DURATION / steps as f64, "").expect("increasing times"),
        ["density", "1"],
        WorkingBytes { shared: Euler::state_bytes(dims), per_thread: 0 },
        Box::new(move || Box::new(ShockBubble::new(dims, spacing, mach))),
    ))
}

struct ShockBubble {
    time: f64,
    gas: Euler,
}

impl ShockBubble {
    fn new(dims: [usize; 3], spacing: f64, mach: f64) -> Self {
        let shocked = behind_shock(mach);
        let wall = [Boundary::Wall; 2];
        let boundaries = [[Boundary::Inflow(shocked), Boundary::Outflow], wall, wall];
        let centre = [BUBBLE_CENTRE_X, 0.5 * dims[1] as f64 * spacing, 0.5 * HEIGHT];
        let initial = |index: [usize; 3]| {
            let position = index.map(|n| (n as f64 + 0.5) * spacing);
            if position[0] < SHOCK_X {
                return shocked;
            }
            let squared: f64 = position.iter().zip(centre).map(|(p, c)| (p - c) * (p - c)).sum();
            // The rim is two cells wide: no staircase of cubes to grow ripples from.
            let share = 0.5 * (1.0 - tanh((sqrt(squared) - BUBBLE_RADIUS) / spacing));
            let mut state = STILL_AIR;
            state[0] = (1.0 + (BUBBLE_DENSITY - 1.0) * share) as f32;
            state
        };
        Self { time: 0.0, gas: Euler::new(dims, spacing, GAMMA as f32, boundaries, initial) }
    }
}

impl Run for ShockBubble {
    fn advance_to(&mut self, time: f64) {
        self.gas.advance(time - self.time);
        self.time = time;
    }

    fn slices(&mut self, first: usize, count: usize) -> Vec<f32> {
        self.gas.density(first, count)
    }
}

/// State behind a shock that runs into still air (Rankine–Hugoniot).
fn behind_shock(mach: f64) -> Primitive {
    let squared = mach * mach;
    let density = (GAMMA + 1.0) * squared / ((GAMMA - 1.0) * squared + 2.0);
    let pressure = 1.0 + 2.0 * GAMMA / (GAMMA + 1.0) * (squared - 1.0);
    let velocity = mach * sqrt(GAMMA) * (1.0 - 1.0 / density);
    [density as f32, velocity as f32, 0.0, 0.0, pressure as f32]
}
