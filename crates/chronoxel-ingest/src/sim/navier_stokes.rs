//! Incompressible Navier–Stokes flow in a periodic box of edge 2π, by a pseudo-spectral method.
//!
//! `∂u/∂t = P[u × ω] + ν ∇²u`: the product is taken on the samples, the projection P onto fields without
//! divergence and everything linear on the modes; the 2/3 rule removes aliasing. Classical fourth-order
//! Runge–Kutta steps with the viscous decay as an integrating factor (Rogallo 1977), so that viscosity does not
//! limit the step.

use rayon::prelude::*;

use super::fourier::{Complex32, Fourier, Scratch, modes_of};

const ZERO: Complex32 = Complex32 { re: 0.0, im: 0.0 };
/// Largest `dt · Σ |u_a| / spacing_a`; fourth-order steps of dealiased modes are stable up to 1.35.
const LARGEST_COURANT: f64 = 1.2;

/// The flow: its velocity as modes.
pub struct NavierStokes {
    dims: [usize; 3],
    viscosity: f64,
    fourier: Fourier,
    /// `[kx, component, ky, kz]`
    velocity: Vec<Complex32>,
}

impl NavierStokes {
    /// Fluid at rest.
    ///
    /// * `dims`: samples along x, y, z, each at least 4
    /// * `viscosity`: kinematic, m²/s, not negative
    pub fn new(dims: [usize; 3], viscosity: f64) -> Self {
        let fourier = Fourier::new(dims);
        let num_modes: usize = fourier.modes().iter().product();
        Self { dims, viscosity, fourier, velocity: vec![ZERO; 3 * num_modes] }
    }

    /// Bytes held at most while the flow advances: velocity, rate and two stages; columns of six fields and slabs of three.
    pub fn step_bytes(dims: [usize; 3]) -> u64 {
        let [mx, my, mz] = modes_of(dims).map(|n| n as u64);
        size_of::<Complex32>() as u64 * mx * my * (4 * 3 * mz + (6 + 3) * dims[2] as u64)
    }

    /// Bytes held at most while the magnitude is made: velocity, columns of three fields, and the magnitude.
    pub fn magnitude_bytes(dims: [usize; 3]) -> u64 {
        let ([mx, my, mz], [nx, ny, nz]) = (modes_of(dims).map(|n| n as u64), dims.map(|n| n as u64));
        size_of::<Complex32>() as u64 * mx * my * (3 * mz + 3 * nz) + size_of::<f32>() as u64 * nx * ny * nz
    }

    /// Bytes that each thread holds at most: slices of six fields, and a plane in transform.
    pub fn thread_bytes(dims: [usize; 3]) -> u64 {
        let ([mx, my, _], [nx, ny, nz]) = (modes_of(dims).map(|n| n as u64), dims.map(|n| n as u64));
        size_of::<f32>() as u64 * 6 * nx * ny + size_of::<Complex32>() as u64 * (mx * ny).max(my * nz)
    }

    /// Adds the real velocity `2 Re(a exp(i k·x))`; nothing is added where the lattice does not hold k.
    ///
    /// * `wave`: k, not zero
    /// * `amplitude`: real and imaginary part of a for each component; what is parallel to k is left out
    pub fn add_wave(&mut self, wave: [i32; 3], amplitude: [[f64; 2]; 3]) {
        let squared: f64 = wave.iter().map(|&k| f64::from(k) * f64::from(k)).sum();
        let along =
            [0, 1].map(|part| (0..3).map(|a| f64::from(wave[a]) * amplitude[a][part]).sum::<f64>() / squared);
        let solenoidal: [Complex32; 3] = std::array::from_fn(|a| {
            let part = |p: usize| (amplitude[a][p] - f64::from(wave[a]) * along[p]) as f32;
            Complex32::new(part(0), part(1))
        });
        for (sign, conjugate) in [(1, false), (-1, true)] {
            let Some(mode) = self.mode(wave.map(|k| sign * k)) else { continue };
            let [_, my, mz] = self.fourier.modes();
            for (component, a) in solenoidal.iter().enumerate() {
                let at = ((mode[0] * 3 + component) * my + mode[1]) * mz + mode[2];
                self.velocity[at] += if conjugate { a.conj() } else { *a };
            }
        }
    }

    /// Adds Taylor and Green's vortices, `(sin x cos y cos z, −cos x sin y cos z, 0)` m/s (Brachet et al. 1983).
    pub fn add_taylor_green(&mut self) {
        for [ky, kz] in [[1, 1], [1, -1], [-1, 1], [-1, -1]] {
            // sin x cos y cos z is the sum of sin(x ± y ± z) / 4, and cos x sin y cos z that of ± sin(x ± y ± z) / 4.
            let v = -0.125 * f64::from(ky);
            self.add_wave([1, ky, kz], [[0.0, -0.125], [0.0, -v], [0.0, 0.0]]);
        }
    }

    /// Advances by `duration` seconds, in steps as long as stability allows.
    pub fn advance(&mut self, duration: f64) {
        let mut left = duration;
        let mut rate = vec![ZERO; self.velocity.len()];
        while left > 0.0 {
            let fastest = self.convection(&self.velocity, &mut rate);
            let num_steps = (left * fastest / LARGEST_COURANT).ceil().max(1.0);
            let dt = left / num_steps;
            self.step(dt, &mut rate);
            left = if num_steps == 1.0 { 0.0 } else { left - dt };
        }
    }

    /// Mean kinetic energy `⟨|u|²⟩ / 2` and mean enstrophy `⟨|ω|²⟩ / 2`, summed over the modes in order.
    pub fn energy_and_enstrophy(&self) -> [f64; 2] {
        let [_, my, mz] = self.fourier.modes();
        let mut sums = [0.0; 2];
        for (ikx, planes) in self.velocity.chunks_exact(3 * my * mz).enumerate() {
            // A mode with kx > 0 stands for its conjugate, too.
            let weight = if ikx == 0 { 0.5 } else { 1.0 };
            for (mode, u) in planes.iter().enumerate() {
                let k = self.wave([ikx, mode / mz % my, mode % mz]).map(f64::from);
                let energy = weight * f64::from(u.re * u.re + u.im * u.im);
                sums[0] += energy;
                sums[1] += energy * (k[0] * k[0] + k[1] * k[1] + k[2] * k[2]);
            }
        }
        sums
    }

    /// Magnitude of the vorticity on all samples, `[z, y, x]`.
    pub fn vorticity_magnitude(&self) -> Vec<f32> {
        let columns =
            self.fourier.columns(3, |at, pencils| self.vorticity_modes(&self.velocity, at, pencils));
        let slice_len = self.dims[0] * self.dims[1];
        let mut magnitude = vec![0.0f32; slice_len * self.dims[2]];
        magnitude.par_chunks_mut(slice_len).enumerate().for_each_init(
            || (Scratch::default(), vec![0.0; slice_len]),
            |(scratch, component), (k, out)| {
                for field in 0..3 {
                    self.fourier.slab(&columns, [3, field, k], component, scratch);
                    out.iter_mut().zip(&*component).for_each(|(sum, c)| *sum += c * c);
                }
                out.iter_mut().for_each(|m| *m = m.sqrt());
            },
        );
        magnitude
    }

    fn wave(&self, mode: [usize; 3]) -> [f32; 3] {
        std::array::from_fn(|axis| self.fourier.wave_number(axis, mode[axis]))
    }

    /// Where a wave number lies among the kept modes, if it does.
    fn mode(&self, wave: [i32; 3]) -> Option<[usize; 3]> {
        let modes = self.fourier.modes();
        let index =
            |axis: usize| (0..modes[axis]).find(|&i| self.fourier.wave_number(axis, i) == wave[axis] as f32);
        Some([index(0)?, index(1)?, index(2)?])
    }

    /// One step; `rate` holds the convection of the present velocity.
    fn step(&mut self, dt: f64, rate: &mut [Complex32]) {
        let half_decay = self.decay(0.5 * dt);
        let (dt, half, sixth) = (dt as f32, 0.5 * dt as f32, dt as f32 / 6.0);
        let mut next = vec![ZERO; rate.len()];
        let mut stage = vec![ZERO; rate.len()];
        self.for_each_mode([&mut next, &mut stage], rate, &half_decay, |[next, stage], u, k1, e| {
            *stage = (u + k1 * half) * e;
            *next = (u + k1 * sixth) * (e * e);
        });
        self.convection(&stage, rate);
        self.for_each_mode([&mut next, &mut stage], rate, &half_decay, |[next, stage], u, k2, e| {
            *stage = u * e + k2 * half;
            *next += k2 * (2.0 * sixth * e);
        });
        self.convection(&stage, rate);
        self.for_each_mode([&mut next, &mut stage], rate, &half_decay, |[next, stage], u, k3, e| {
            *stage = (u * e + k3 * dt) * e;
            *next += k3 * (2.0 * sixth * e);
        });
        self.convection(&stage, rate);
        next.par_iter_mut().zip(&*rate).for_each(|(next, k4)| *next += k4 * sixth);
        self.velocity = next;
    }

    /// Factors by which viscosity shrinks a mode within `dt`, for each axis; their product is that of the mode.
    fn decay(&self, dt: f64) -> [Vec<f32>; 3] {
        std::array::from_fn(|axis| {
            let factor = |i: usize| {
                let k = f64::from(self.fourier.wave_number(axis, i));
                libm::exp(-self.viscosity * k * k * dt) as f32
            };
            (0..self.fourier.modes()[axis]).map(factor).collect()
        })
    }

    /// Combines velocity, rate and decay of every mode into two outputs.
    fn for_each_mode(
        &self,
        [out_a, out_b]: [&mut Vec<Complex32>; 2],
        rate: &[Complex32],
        decay: &[Vec<f32>; 3],
        combine: impl Fn([&mut Complex32; 2], Complex32, Complex32, f32) + Sync,
    ) {
        let [_, my, mz] = self.fourier.modes();
        let plane = 3 * my * mz;
        let outputs = out_a.par_chunks_mut(plane).zip(out_b.par_chunks_mut(plane));
        let inputs = self.velocity.par_chunks(plane).zip(rate.par_chunks(plane));
        outputs.zip(inputs).zip(&decay[0]).for_each(|(((a, b), (u, r)), decay_x)| {
            let inputs = u.chunks_exact(mz).zip(r.chunks_exact(mz));
            let pencils = a.chunks_exact_mut(mz).zip(b.chunks_exact_mut(mz)).zip(inputs);
            for (pencil, ((a, b), (u, r))) in pencils.enumerate() {
                let decay_xy = decay_x * decay[1][pencil % my];
                for n in 0..mz {
                    combine([&mut a[n], &mut b[n]], u[n], r[n], decay_xy * decay[2][n]);
                }
            }
        });
    }

    /// `P[u × ω]` of a velocity, and the largest `Σ |u_a| / spacing_a` anywhere, 1/s.
    fn convection(&self, velocity: &[Complex32], rate: &mut [Complex32]) -> f64 {
        let [mx, my, mz] = self.fourier.modes();
        let columns = self.fourier.columns(6, |at, pencils| {
            let (u, w) = pencils.split_at_mut(3 * mz);
            self.velocity_modes(velocity, at, u);
            self.vorticity_modes(velocity, at, w);
        });
        let slice_len = self.dims[0] * self.dims[1];
        let mut slabs = vec![ZERO; 3 * mx * my * self.dims[2]];
        let fastest = slabs
            .par_chunks_mut(3 * mx * my)
            .enumerate()
            .map_init(
                || (Scratch::default(), vec![0.0; 6 * slice_len]),
                |(scratch, fields), (k, out)| {
                    for (field, samples) in fields.chunks_exact_mut(slice_len).enumerate() {
                        self.fourier.slab(&columns, [6, field, k], samples, scratch);
                    }
                    let fastest = self.cross(fields);
                    for (product, out) in fields.chunks_exact(slice_len).zip(out.chunks_exact_mut(mx * my)) {
                        self.fourier.slab_modes(product, out, scratch);
                    }
                    fastest
                },
            )
            .reduce(|| 0.0, f32::max);
        self.fourier.spectra(&slabs, 3, rate);
        self.project(rate);
        f64::from(fastest)
    }

    /// Replaces the first three of the fields u, ω by `u × ω`; returns the largest `Σ |u_a| / spacing_a`.
    fn cross(&self, fields: &mut [f32]) -> f32 {
        let per_spacing = self.dims.map(|n| n as f32 / std::f32::consts::TAU);
        let (u, w) = fields.split_at_mut(fields.len() / 2);
        let slice_len = u.len() / 3;
        let (ux, rest) = u.split_at_mut(slice_len);
        let (uy, uz) = rest.split_at_mut(slice_len);
        let (wx, rest) = w.split_at(slice_len);
        let (wy, wz) = rest.split_at(slice_len);
        let mut fastest = 0.0f32;
        for n in 0..slice_len {
            let [x, y, z] = [ux[n], uy[n], uz[n]];
            fastest =
                fastest.max(x.abs() * per_spacing[0] + y.abs() * per_spacing[1] + z.abs() * per_spacing[2]);
            ux[n] = y * wz[n] - z * wy[n];
            uy[n] = z * wx[n] - x * wz[n];
            uz[n] = x * wy[n] - y * wx[n];
        }
        fastest
    }

    fn velocity_modes(&self, velocity: &[Complex32], [ikx, iky]: [usize; 2], pencils: &mut [Complex32]) {
        let [_, my, mz] = self.fourier.modes();
        for (component, pencil) in pencils.chunks_exact_mut(mz).enumerate() {
            pencil.copy_from_slice(&velocity[((ikx * 3 + component) * my + iky) * mz..][..mz]);
        }
    }

    /// `ω = i k × u` of one pencil.
    fn vorticity_modes(&self, velocity: &[Complex32], [ikx, iky]: [usize; 2], pencils: &mut [Complex32]) {
        let [_, my, mz] = self.fourier.modes();
        let u = |component: usize, n: usize| velocity[((ikx * 3 + component) * my + iky) * mz + n];
        for n in 0..mz {
            let [kx, ky, kz] = self.wave([ikx, iky, n]);
            let [x, y, z] = [u(0, n), u(1, n), u(2, n)];
            for (component, curl) in
                [z * ky - y * kz, x * kz - z * kx, y * kx - x * ky].into_iter().enumerate()
            {
                pencils[component * mz + n] = Complex32::new(-curl.im, curl.re);
            }
        }
    }

    /// Takes out of each mode what is parallel to its wave vector, and the mean.
    fn project(&self, modes: &mut [Complex32]) {
        let [_, my, mz] = self.fourier.modes();
        modes.par_chunks_mut(3 * my * mz).enumerate().for_each(|(ikx, planes)| {
            let (x, rest) = planes.split_at_mut(my * mz);
            let (y, z) = rest.split_at_mut(my * mz);
            for n in 0..my * mz {
                let [kx, ky, kz] = self.wave([ikx, n / mz, n % mz]);
                let squared = kx * kx + ky * ky + kz * kz;
                let along = (x[n] * kx + y[n] * ky + z[n] * kz) / squared.max(1.0);
                x[n] -= along * kx;
                y[n] -= along * ky;
                z[n] -= along * kz;
            }
        });
    }
}
