//! The plume and its transport solver against conservation of mass and closed forms.

#[path = "common/steps.rs"]
mod steps;

use chronoxel_ingest::sim::{
    self,
    transport::{Material, Transport},
};
use steps::steps_of;

fn gaussian_ball(transport: &mut Transport, dims: [usize; 3], centre: [f64; 3], sigma: f64) {
    for (k, j, i) in
        (0..dims[2]).flat_map(|k| (0..dims[1]).flat_map(move |j| (0..dims[0]).map(move |i| (k, j, i))))
    {
        let squared: f64 = [i, j, k].iter().zip(centre).map(|(&n, c)| (n as f64 - c) * (n as f64 - c)).sum();
        let weight = libm::exp(-0.5 * squared / (sigma * sigma));
        if weight > 1e-9 {
            transport.discharge([i, j, k], weight);
        }
    }
}

#[test]
fn discharged_mass_is_in_the_water_on_the_bed_or_outside() {
    let dims = [40, 24, 20];
    let material = Material { settling_speed: 0.05, diffusivity: [0.4, 0.2], floor: 1e-9 };
    let mut transport = Transport::new(dims, 10.0, material);
    for n in 0..900 {
        transport.discharge([8, 12, 17], 300.0);
        let turn = libm::sin(f64::from(n) * 0.02);
        transport.step(10.0, |k| [0.06 + 0.003 * k as f64, 0.06 * turn]);
    }
    let mass = transport.mass();
    assert_eq!(mass.discharged, 270_000.0);
    let found = mass.suspended + mass.settled + mass.outflow + mass.traces;
    assert!((found / mass.discharged - 1.0).abs() < 1e-12, "{mass:?}");
    // Each of the three is a real part of the balance, and the traces are none.
    for part in [mass.suspended, mass.settled, mass.outflow] {
        assert!(part > 0.02 * mass.discharged, "{mass:?}");
    }
    assert!(mass.traces >= 0.0 && mass.traces < 1e-6 * mass.discharged, "{mass:?}");
    let lowest = (0..dims.iter().product()).map(|c| transport.concentration(c)).fold(f64::MAX, f64::min);
    assert!(lowest >= 0.0, "{lowest}");
}

/// A cloud in a uniform current: its centre moves by `u t`, and its variance grows by `2 K t`.
#[test]
fn a_cloud_moves_and_spreads_as_the_closed_form_says() {
    let (dims, sigma, start) = ([72, 56, 56], 4.0, [24.0, 32.0, 34.0]);
    let material = Material { settling_speed: 0.06, diffusivity: [0.05, 0.025], floor: 1e-12 };
    let mut cloud = Transport::new(dims, 1.0, material);
    gaussian_ball(&mut cloud, dims, start, sigma);
    let (dt, num_steps, u, v) = (1.0, 200, 0.11, -0.05);
    for _ in 0..num_steps {
        cloud.step(dt, |_| [u, v]);
    }
    let [mut mass, mut first, mut second] = [0.0, 0.0, 0.0].map(|x| [x; 3]);
    for cell in 0..dims.iter().product() {
        let index = [cell % dims[0], cell / dims[0] % dims[1], cell / dims[0] / dims[1]];
        for axis in 0..3 {
            let x = index[axis] as f64 - start[axis];
            let c = cloud.concentration(cell);
            mass[axis] += c;
            first[axis] += c * x;
            second[axis] += c * x * x;
        }
    }
    let secs = dt * f64::from(num_steps);
    for (axis, (speed, diffusivity)) in [(u, 0.05), (v, 0.05), (-0.06, 0.025)].into_iter().enumerate() {
        let mean = first[axis] / mass[axis];
        let variance = second[axis] / mass[axis] - mean * mean;
        assert!((mean - speed * secs).abs() < 0.02, "axis {axis}: centre {mean}");
        let exact = sigma * sigma + 2.0 * diffusivity * secs;
        assert!((variance / exact - 1.0).abs() < 0.02, "axis {axis}: variance {variance}, exactly {exact}");
    }
}

#[test]
fn nearly_all_samples_are_exactly_zero_and_the_deposit_stays() {
    let steps = steps_of("sim:plume?dims=48&steps=12&limit=1", &(0..12).collect::<Vec<_>>());
    let num_samples: usize = steps.iter().map(Vec::len).sum();
    let num_zero = steps.iter().flatten().filter(|&&c| c == 0.0).count();
    assert!(num_zero as f64 > 0.98 * num_samples as f64, "{num_zero} of {num_samples}");
    assert!(steps.iter().all(|s| s.iter().any(|&c| c > 0.0)), "a step without material");
    assert!(steps.iter().flatten().all(|&c| c == 0.0 || c >= 1.0), "below the detection limit");
    let bed = |step: usize| steps[step][..48 * 48].iter().map(|&c| f64::from(c)).sum::<f64>();
    assert!(bed(5) > 0.0 && bed(11) > bed(5));
}

#[test]
fn the_same_bits_for_any_number_of_threads_and_after_going_back() {
    let spec = "sim:plume?dims=33x40x28&steps=5";
    let with_threads = |n: usize, steps: &[usize]| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        pool.install(|| steps_of(spec, steps))
    };
    let one = with_threads(1, &[0, 1, 2, 3, 4]);
    assert_eq!(one, with_threads(2, &[0, 1, 2, 3, 4]));
    let jumping = with_threads(3, &[4, 1, 1, 3]);
    assert_eq!(jumping, [4, 1, 1, 3].map(|s: usize| one[s].clone()));
}

#[test]
fn slices_read_piece_by_piece_are_the_whole_step() {
    let mut series = sim::open("sim:plume?dims=16x9x12&steps=3").unwrap();
    assert_eq!(series.times().num_steps(), 3);
    assert_eq!(series.variables()[0].units, "mg/L");
    let whole = series.open_step(0, 2).unwrap().read_slices(12).unwrap().to_f64();
    let mut reader = series.open_step(0, 2).unwrap();
    let pieces: Vec<f64> =
        [5, 0, 1, 6].iter().flat_map(|&n| reader.read_slices(n).unwrap().to_f64()).collect();
    assert_eq!((pieces.len(), pieces), (16 * 9 * 12, whole));
}

#[test]
fn what_does_not_exist_is_refused_with_what_does() {
    for (spec, hint) in [
        ("sim:plum", "plume"),
        ("sim:plume?colour=red", "dims, steps, limit"),
        ("sim:plume?steps=-3", "from 1"),
        ("sim:plume?limit=0", "from 0.000001"),
        ("sim:plume?dims=4", "from 8"),
        ("sim:plume?dims", "key=value"),
        ("sim:plume?steps=2&steps=3", "once"),
        ("plume", "sim:NAME"),
    ] {
        let message = sim::open(spec).err().unwrap_or_else(|| panic!("{spec} was opened")).to_string();
        assert!(message.contains(hint) && !message.contains('\n'), "{spec}: {message}");
    }
}
