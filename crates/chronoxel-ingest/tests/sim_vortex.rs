//! The pseudo-spectral solver against the Taylor–Green vortex, and the turbulence it makes.

#[path = "common/steps.rs"]
mod steps;

use chronoxel_ingest::sim::navier_stokes::NavierStokes;
use steps::steps_of;

fn taylor_green(n: usize, viscosity: f64) -> NavierStokes {
    let mut flow = NavierStokes::new([n; 3], viscosity);
    flow.add_taylor_green();
    flow
}

/// Mean enstrophy of the inviscid vortex as a power series in t (`fixtures/taylor_green.py`, exact).
#[test]
fn inviscid_enstrophy_follows_its_power_series() {
    let mut flow = taylor_green(32, 0.0);
    let mut time = 0.0;
    for next in [0.2, 0.4, 0.6] {
        flow.advance(next - time);
        time = next;
        let [energy, enstrophy] = flow.energy_and_enstrophy();
        let t2 = time * time;
        let series = 3.0 / 8.0 + t2 * (5.0 / 128.0 + t2 * (25.0 / 8448.0 - t2 * (52439.0 / 376_668_160.0)));
        assert!((energy - 0.125).abs() < 2e-7, "energy {energy} at {time}");
        assert!((enstrophy / series - 1.0).abs() < 2e-6, "enstrophy {enstrophy} at {time}, series {series}");
    }
}

/// Time, mean energy and mean enstrophy at Re = 100; the dissipation peaks shortly before t = 5.
const REFERENCE: [[f64; 3]; 6] = [
    [1.0, 0.11748093, 0.38842810],
    [2.0, 0.10904761, 0.46328815],
    [3.0, 0.09879146, 0.56097536],
    [4.0, 0.08681938, 0.62873537],
    [5.0, 0.07396432, 0.64840356],
    [6.0, 0.06123973, 0.61491261],
];

/// Energy and enstrophy at Re = 100 as another program finds them (`fixtures/taylor_green.py`), through the
/// peak of the dissipation.
#[test]
fn the_viscous_vortex_dissipates_as_another_solver_says() {
    let mut flow = taylor_green(48, 0.01);
    let mut time = 0.0;
    for [next, energy, enstrophy] in REFERENCE {
        flow.advance(next - time);
        time = next;
        let found = flow.energy_and_enstrophy();
        assert!((found[0] / energy - 1.0).abs() < 1e-4, "energy {} at {time}, not {energy}", found[0]);
        assert!(
            (found[1] / enstrophy - 1.0).abs() < 1e-3,
            "enstrophy {} at {time}, not {enstrophy}",
            found[1]
        );
    }
}

/// `dE/dt = −2 ν Ω` holds for every incompressible flow; here for the random one, on an uneven lattice.
#[test]
fn energy_is_lost_at_the_rate_of_the_enstrophy() {
    let viscosity = 0.02;
    let mut flow = NavierStokes::new([30, 36, 27], viscosity);
    flow.add_taylor_green();
    flow.add_wave([1, 2, -1], [[0.05, 0.1], [-0.1, 0.02], [0.03, 0.1]]);
    flow.add_wave([0, 1, 2], [[0.1, -0.05], [0.04, 0.1], [0.1, 0.0]]);
    flow.advance(0.5);
    let h = 0.02;
    let before = flow.energy_and_enstrophy()[0];
    flow.advance(h);
    let middle = flow.energy_and_enstrophy()[1];
    flow.advance(h);
    let after = flow.energy_and_enstrophy()[0];
    let (lost, expected) = ((before - after) / (2.0 * h), 2.0 * viscosity * middle);
    assert!((lost / expected - 1.0).abs() < 1e-3, "{lost} {expected}");
}

/// At time 0 the vorticity is known: `(−cos x sin y sin z, −sin x cos y sin z, 2 sin x sin y cos z)`.
#[test]
fn vorticity_of_the_taylor_green_vortex_on_an_uneven_lattice() {
    let dims = [12, 15, 10];
    let mut flow = NavierStokes::new(dims, 0.01);
    flow.add_taylor_green();
    for (cell, &found) in flow.vorticity_magnitude().iter().enumerate() {
        let index = [cell % dims[0], cell / dims[0] % dims[1], cell / dims[0] / dims[1]];
        let [x, y, z]: [f64; 3] =
            std::array::from_fn(|a| std::f64::consts::TAU * index[a] as f64 / dims[a] as f64);
        let w = [x.cos() * y.sin() * z.sin(), x.sin() * y.cos() * z.sin(), 2.0 * x.sin() * y.sin() * z.cos()];
        let exact = w.iter().map(|w| w * w).sum::<f64>().sqrt();
        assert!((f64::from(found) - exact).abs() < 2e-6, "{index:?}: {found} {exact}");
    }
}

#[test]
fn the_same_bits_for_any_number_of_threads_and_after_going_back() {
    let spec = "sim:vortex?dims=17x20x15&steps=4&seed=7";
    let with_threads = |n: usize, steps: &[usize]| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        pool.install(|| steps_of(spec, steps))
    };
    let one = with_threads(1, &[0, 1, 2, 3]);
    assert_eq!(one, with_threads(2, &[0, 1, 2, 3]));
    assert_eq!(with_threads(3, &[3, 0, 2]), [3, 0, 2].map(|s: usize| one[s].clone()));
    assert_ne!(one, steps_of("sim:vortex?dims=17x20x15&steps=4&seed=8", &[0, 1, 2, 3]));
}

#[test]
fn vorticity_is_stretched_and_stays_finite_at_any_shape() {
    for dims in ["8", "32", "9x16x31"] {
        let steps = steps_of(&format!("sim:vortex?dims={dims}&steps=4&re=200"), &[0, 3]);
        assert!(steps.iter().flatten().all(|w| w.is_finite() && *w >= 0.0), "{dims}");
        if dims == "32" {
            let peak = |step: usize| steps[step].iter().copied().fold(0.0, f32::max);
            assert!(peak(1) > 1.5 * peak(0), "{} {}", peak(0), peak(1));
        }
    }
}
