//! `sim:vortex`: turbulence that decays in a periodic box, shown by the magnitude of its vorticity.
//!
//! Large Taylor–Green vortices and a random solenoidal flow of the same energy break up into thin tubes and
//! decay: lum2001's first data set in kind. The box has the edge 2π m whatever `dims` is; by default the
//! Reynolds number is the largest that the samples resolve. The field is periodic: the sample after the last
//! one would be the first.

use std::f64::consts::TAU;

use chronoxel_core::{TimeAxis, UniformGrid};

use super::fourier::cutoff;
use super::navier_stokes::NavierStokes;
use super::spec::Spec;
use super::{Run, SimulatedSeries, WorkingBytes};
use crate::SourceError;

const DURATION_SECS: f64 = 6.0;
/// Mean kinetic energy of the random flow, (m/s)²; that of the Taylor–Green vortices is 1/8.
const RANDOM_ENERGY: f64 = 0.125;
/// Largest squared wave number of the random flow.
const RANDOM_WAVES: i32 = 9;

/// Opens `sim:vortex`; options `dims`, `steps`, `seed` and `re` (Reynolds number, 1/ν).
pub(super) fn open(spec: &Spec) -> Result<SimulatedSeries, SourceError> {
    spec.check_keys(&["dims", "steps", "seed", "re"])?;
    let dims = spec.dims([64; 3], 8)?;
    let steps = spec.steps(32)?;
    let seed = spec.seed(1)?;
    let reynolds = spec.number("re", resolved_reynolds(dims), [1.0, 1e6])?;
    let grid = UniformGrid::new(dims, [0.0; 3], dims.map(|n| TAU / n as f64)).expect("checked dims");
    Ok(SimulatedSeries::new(
        grid,
        TimeAxis::regular(steps, DURATION_SECS / steps as f64, "s").expect("increasing times"),
        ["vorticity_magnitude", "1/s"],
        working_bytes(dims),
        Box::new(move || Box::new(Vortex::new(dims, 1.0 / reynolds, seed))),
    ))
}

/// Reynolds number at which the smallest eddies are as large as the shortest kept wave: Kolmogorov's length
/// `(ν³/ε)^¼` times the cut-off is about 1 for the dissipation of this flow.
fn resolved_reynolds(dims: [usize; 3]) -> f64 {
    let smallest_cutoff = dims.map(cutoff).into_iter().min().expect("three axes");
    libm::round(2.5 * libm::pow(smallest_cutoff as f64, 4.0 / 3.0))
}

/// Memory at its peak: in a step, or when the magnitude is made.
fn working_bytes(dims: [usize; 3]) -> WorkingBytes {
    let (in_step, in_magnitude) = (NavierStokes::step_bytes(dims), NavierStokes::magnitude_bytes(dims));
    WorkingBytes { shared: in_step.max(in_magnitude), per_thread: NavierStokes::thread_bytes(dims) }
}

struct Vortex {
    secs: f64,
    flow: NavierStokes,
    slice_len: usize,
    /// The field at `secs`, once it was asked for.
    magnitude: Option<Vec<f32>>,
}

impl Vortex {
    fn new(dims: [usize; 3], viscosity: f64, seed: u64) -> Self {
        let mut flow = NavierStokes::new(dims, viscosity);
        flow.add_taylor_green();
        add_random_flow(&mut flow, seed);
        Self { secs: 0.0, flow, slice_len: dims[0] * dims[1], magnitude: None }
    }
}

impl Run for Vortex {
    fn advance_to(&mut self, time: f64) {
        self.flow.advance(time - self.secs);
        self.secs = time;
        self.magnitude = None;
    }

    fn slices(&mut self, first: usize, count: usize) -> Vec<f32> {
        let magnitude = self.magnitude.get_or_insert_with(|| self.flow.vorticity_magnitude());
        magnitude[first * self.slice_len..(first + count) * self.slice_len].to_vec()
    }
}

/// Adds waves of random direction and phase, all of one amplitude, of the energy [`RANDOM_ENERGY`].
///
/// The waves do not depend on the lattice, so that the same seed is the same flow at any resolution.
fn add_random_flow(flow: &mut NavierStokes, seed: u64) {
    let mut random = SplitMix64(seed);
    let mut waves = Vec::new();
    let mut energy = 0.0;
    for wave in half_of_the_waves() {
        let amplitude: [[f64; 2]; 3] = std::array::from_fn(|_| [random.symmetric(), random.symmetric()]);
        let squared: f64 = wave.iter().map(|&k| f64::from(k * k)).sum();
        for part in 0..2 {
            let along: f64 = (0..3).map(|a| f64::from(wave[a]) * amplitude[a][part]).sum();
            let whole: f64 = amplitude.iter().map(|a| a[part] * a[part]).sum();
            energy += whole - along * along / squared;
        }
        waves.push((wave, amplitude));
    }
    let scale = (RANDOM_ENERGY / energy).sqrt();
    for (wave, amplitude) in waves {
        flow.add_wave(wave, amplitude.map(|part| part.map(|a| a * scale)));
    }
}

/// One of each pair k, −k with `0 < |k|² ≤` [`RANDOM_WAVES`].
fn half_of_the_waves() -> impl Iterator<Item = [i32; 3]> {
    let range = || -3..=3;
    range()
        .flat_map(move |z| range().flat_map(move |y| range().map(move |x| [x, y, z])))
        .filter(|&[x, y, z]| (1..=RANDOM_WAVES).contains(&(x * x + y * y + z * z)) && [z, y, x] > [0, 0, 0])
}

/// Steele, Lea and Flood's generator (2014).
pub(super) struct SplitMix64(pub u64);

impl SplitMix64 {
    /// Uniform in [-1, 1).
    pub fn symmetric(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^= z >> 31;
        (z >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }
}
