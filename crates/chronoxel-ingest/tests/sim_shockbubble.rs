//! The gas solver against the exact Riemann solution and conservation laws, and the scene it makes.

#[path = "common/steps.rs"]
mod steps;

use chronoxel_ingest::sim::{
    self,
    euler::{Boundary, Euler, Primitive},
};
use steps::steps_of;

const GAMMA: f64 = 1.4;

/// Density, velocity and pressure on one side of a diaphragm.
type Gas = [f64; 3];

/// Exact self-similar solution of the Riemann problem at `x / t` (Toro 2009, chapter 4), by bisection for the
/// pressure between the outer waves.
fn exact_riemann(left: Gas, right: Gas, speed: f64) -> Gas {
    let [below, above] = [GAMMA - 1.0, GAMMA + 1.0];
    let sound = |gas: Gas| (GAMMA * gas[2] / gas[0]).sqrt();
    let change = |p: f64, gas: Gas| {
        if p > gas[2] {
            (p - gas[2]) * (2.0 / (above * gas[0]) / (p + below / above * gas[2])).sqrt()
        } else {
            2.0 * sound(gas) / below * ((p / gas[2]).powf(below / (2.0 * GAMMA)) - 1.0)
        }
    };
    let (mut low, mut high) = (0.0, 100.0 * (left[2] + right[2]));
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        let excess = change(middle, left) + change(middle, right) + right[1] - left[1];
        if excess > 0.0 { high = middle } else { low = middle }
    }
    let pressure = 0.5 * (low + high);
    let velocity = 0.5 * (left[1] + right[1] + change(pressure, right) - change(pressure, left));
    // The right side is the left one seen in a mirror.
    let sign = if speed < velocity { 1.0 } else { -1.0 };
    let gas = if speed < velocity { left } else { right };
    let (outer, star, x) = (sign * gas[1], sign * velocity, sign * speed);
    let (c, ratio) = (sound(gas), pressure / gas[2]);
    let [density, u, p] = if ratio > 1.0 {
        let front = outer - c * (above / (2.0 * GAMMA) * ratio + below / (2.0 * GAMMA)).sqrt();
        let squeezed = gas[0] * (ratio + below / above) / (ratio * below / above + 1.0);
        if x < front { [gas[0], outer, gas[2]] } else { [squeezed, star, pressure] }
    } else {
        let tail = star - c * ratio.powf(below / (2.0 * GAMMA));
        if x < outer - c {
            [gas[0], outer, gas[2]]
        } else if x > tail {
            [gas[0] * ratio.powf(1.0 / GAMMA), star, pressure]
        } else {
            let local = 2.0 / above * (c + below / 2.0 * (outer - x));
            let thinned = local / c;
            let speed = 2.0 / above * (c + below / 2.0 * outer + x);
            [gas[0] * thinned.powf(2.0 / below), speed, gas[2] * thinned.powf(2.0 * GAMMA / below)]
        }
    };
    [density, sign * u, p]
}

/// Runs a shock tube of length 1 along an axis; returns the mean errors of density, velocity and pressure.
fn tube_error(left: Gas, right: Gas, duration: f64, num_cells: usize, axis: usize) -> Gas {
    let mut dims = [2; 3];
    dims[axis] = num_cells;
    let spacing = 1.0 / num_cells as f64;
    let initial = |index: [usize; 3]| {
        let [density, speed, pressure] = if 2 * index[axis] < num_cells { left } else { right };
        let mut state: Primitive = [density as f32, 0.0, 0.0, 0.0, pressure as f32];
        state[1 + axis] = speed as f32;
        state
    };
    let mut tube = Euler::new(dims, spacing, GAMMA as f32, [[Boundary::Outflow; 2]; 3], initial);
    tube.advance(duration);
    let stride = dims[..axis].iter().product::<usize>();
    let mut errors = [0.0; 3];
    for i in 0..num_cells {
        let state = tube.primitive(i * stride).map(f64::from);
        let exact = exact_riemann(left, right, ((i as f64 + 0.5) * spacing - 0.5) / duration);
        let found = [state[0], state[1 + axis], state[4]];
        for n in 0..3 {
            assert!(found[n].is_finite() && found[0] > 0.0 && found[2] > 0.0, "{found:?} at {i}");
            errors[n] += (found[n] - exact[n]).abs() * spacing;
        }
    }
    errors
}

/// Toro 2009, table 4.2, test 1: pressure and velocity between the waves.
#[test]
fn the_exact_solution_of_this_test_is_the_tabulated_one() {
    let [density, velocity, pressure] = exact_riemann([1.0, 0.0, 1.0], [0.125, 0.0, 0.1], 0.5);
    assert!((pressure - 0.30313).abs() < 1e-5 && (velocity - 0.92745).abs() < 1e-5);
    assert!((density - 0.42632).abs() < 1e-5, "{density}");
    assert!((exact_riemann([1.0, 0.0, 1.0], [0.125, 0.0, 0.1], 1.2)[0] - 0.26557).abs() < 1e-5);
}

#[test]
fn sods_shock_tube_converges_along_every_axis() {
    let (left, right) = ([1.0, 0.0, 1.0], [0.125, 0.0, 0.1]);
    let coarse = tube_error(left, right, 0.2, 100, 0);
    let fine = tube_error(left, right, 0.2, 400, 0);
    assert!(coarse[0] < 0.006 && coarse[1] < 0.009 && coarse[2] < 0.005, "{coarse:?}");
    for n in 0..3 {
        // Shocks and contacts make it first order at best.
        assert!(fine[n] < 0.37 * coarse[n], "{n}: {} after {}", fine[n], coarse[n]);
    }
    for axis in [1, 2] {
        let turned = tube_error(left, right, 0.2, 100, axis);
        assert!((turned[0] - coarse[0]).abs() < 1e-6, "axis {axis}: {turned:?}");
    }
}

#[test]
fn strong_shocks_and_near_vacuum_stay_positive() {
    // Toro 2009, tests 2 and 3: two rarefactions, and a blast of pressure ratio 10^5.
    let rarefied = tube_error([1.0, -2.0, 0.4], [1.0, 2.0, 0.4], 0.15, 200, 0);
    assert!(rarefied[0] < 0.02 && rarefied[2] < 0.01, "{rarefied:?}");
    let blast = tube_error([1.0, 0.0, 1000.0], [1.0, 0.0, 0.01], 0.012, 400, 1);
    assert!(blast[0] < 0.12, "{blast:?}");
}

#[test]
fn a_closed_box_keeps_its_mass_and_energy() {
    let wall = [[Boundary::Wall; 2]; 3];
    let initial = |[i, j, k]: [usize; 3]| {
        let squared = (i as f32 - 5.0).powi(2) + (j as f32 - 8.0).powi(2) + (k as f32 - 6.0).powi(2);
        if squared < 12.0 { [0.3, 0.0, 0.0, 0.0, 8.0] } else { [1.0, 0.0, 0.0, 0.0, 1.0] }
    };
    let mut gas = Euler::new([20, 16, 18], 0.1, GAMMA as f32, wall, initial);
    let before = gas.totals();
    gas.advance(1.5);
    let after = gas.totals();
    assert!((after[0] / before[0] - 1.0).abs() < 2e-6, "mass {before:?} {after:?}");
    assert!((after[4] / before[4] - 1.0).abs() < 2e-6, "energy {before:?} {after:?}");
    let density = gas.density(0, 18);
    assert!(density.iter().any(|&d| (d - 1.0).abs() > 0.1), "nothing happened");
}

/// What enters through one side and leaves through none is `ρ u A t`.
#[test]
fn inflow_adds_its_mass() {
    let wind: Primitive = [1.2, 0.7, 0.0, 0.0, 1.1];
    let mut boundaries = [[Boundary::Wall; 2]; 3];
    boundaries[0] = [Boundary::Inflow(wind), Boundary::Outflow];
    let mut gas = Euler::new([60, 4, 6], 0.1, GAMMA as f32, boundaries, |[i, _, _]| {
        if i < 20 { wind } else { [1.0, 0.0, 0.0, 0.0, 1.0] }
    });
    let before = gas.totals();
    gas.advance(0.5);
    let entered = 1.2 * 0.7 * (0.4 * 0.6) * 0.5;
    let gained = gas.totals()[0] - before[0];
    assert!((gained / entered - 1.0).abs() < 1e-4, "{gained} {entered}");
}

#[test]
fn the_same_bits_for_any_number_of_threads_and_after_going_back() {
    let spec = "sim:shockbubble?dims=41x16x18&steps=4";
    let with_threads = |n: usize, steps: &[usize]| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        pool.install(|| steps_of(spec, steps))
    };
    let one = with_threads(1, &[0, 1, 2, 3]);
    assert_eq!(one, with_threads(2, &[0, 1, 2, 3]));
    assert_eq!(with_threads(3, &[3, 1]), [3, 1].map(|s: usize| one[s].clone()));
}

#[test]
fn the_strongest_shock_and_the_smallest_box_stay_sound() {
    for spec in ["sim:shockbubble?dims=40x16x16&steps=3&mach=10", "sim:shockbubble?dims=8&steps=2"] {
        let last = sim::open(spec).unwrap().times().num_steps() - 1;
        let steps = steps_of(spec, &[last]);
        assert!(steps[0].iter().all(|d| d.is_finite() && *d > 0.0), "{spec}");
    }
}

/// The shock runs at its Mach number, and the bubble is carried along and stays light.
#[test]
fn the_shock_runs_at_its_mach_number_over_the_bubble() {
    let (nx, n) = (80, 32);
    let steps = steps_of("sim:shockbubble?dims=80x32x32&steps=28&mach=1.7", &[0, 10, 24]);
    let edge = |samples: &[f32]| samples[..nx].iter().rposition(|&d| d > 1.5).unwrap();
    let moved = (edge(&steps[1]) - edge(&steps[0])) as f64 * 2.0 / n as f64;
    let expected = 1.7 * GAMMA.sqrt() * 1.0;
    assert!((moved - expected).abs() < 0.13, "moved {moved}, expected {expected}");
    let lightest = |samples: &[f32]| {
        let (at, density) =
            samples.iter().copied().enumerate().fold((0, f32::MAX), |a, b| if b.1 < a.1 { b } else { a });
        (at % nx, density)
    };
    assert!(lightest(&steps[0]).1 < 0.15);
    let (x, density) = lightest(&steps[2]);
    assert!(x > 50 && density < 0.8, "x {x}, density {density}");
}
