//! Compressible flow of an ideal gas (Euler equations), by second-order finite volumes.
//!
//! MUSCL–Hancock along one axis after another (Toro 2009, sections 13.4, 14.4 and 16.2): limited slopes of density,
//! velocity and pressure, half a step in each cell, HLLC fluxes (Toro 2009, section 10.4) with Einfeldt's wave
//! speeds. The order of the axes alternates, which keeps second order. Where a slope would leave less than a
//! tenth of a density or pressure at a face, the cell uses none and is first order. Where a cell is all but empty,
//! its fluxes are taken from a least density and pressure; what is conserved is never changed.
//!
//! The sweep axis lies contiguous; the state is turned between sweeps.

use rayon::prelude::*;

/// Density, velocity along x, y, z, and pressure.
pub type Primitive = [f32; 5];

/// Density, momentum along x, y, z, and total energy, all per volume.
type Conserved = [f32; 5];

/// What lies beyond a side of the volume.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Boundary {
    /// A wall without friction: the flow is mirrored.
    Wall,
    /// The flow leaves, unchanged.
    Outflow,
    /// Gas of a given state flows in.
    Inflow(Primitive),
}

/// Largest `dt · (|u| + c) / spacing`; the scheme is stable up to 1.
const LARGEST_COURANT: f64 = 0.8;

/// The gas in a box of cubic cells.
#[derive(Debug)]
pub struct Euler {
    dims: [usize; 3],
    spacing: f64,
    gamma: f32,
    /// Low and high side of x, y, z.
    boundaries: [[Boundary; 2]; 3],
    /// Cells in the order that `contiguous` says.
    cells: Vec<Conserved>,
    turned: Vec<Conserved>,
    /// The axis that lies contiguous; the next one (cyclically) is the slower, then the third.
    contiguous: usize,
    x_first: bool,
}

impl Euler {
    /// Gas whose state at time 0 is `initial([i, j, k])`.
    ///
    /// * `dims`: cells along x, y, z
    /// * `spacing`: their edge
    /// * `gamma`: ratio of specific heats, > 1
    /// * `boundaries`: low and high side of each axis
    pub fn new(
        dims: [usize; 3],
        spacing: f64,
        gamma: f32,
        boundaries: [[Boundary; 2]; 3],
        initial: impl Fn([usize; 3]) -> Primitive + Sync,
    ) -> Self {
        let [nx, ny, _] = dims;
        let state = |cell: usize| conserved(initial([cell % nx, cell / nx % ny, cell / nx / ny]), gamma);
        let cells: Vec<_> = (0..dims.iter().product()).into_par_iter().map(state).collect();
        let turned = vec![[0.0; 5]; cells.len()];
        Self { dims, spacing, gamma, boundaries, cells, turned, contiguous: 0, x_first: true }
    }

    /// Bytes of the state in a box of these dimensions.
    pub fn state_bytes(dims: [usize; 3]) -> u64 {
        2 * size_of::<Conserved>() as u64 * dims.iter().map(|&n| n as u64).product::<u64>()
    }

    /// Advances by `duration`, in steps as long as stability allows.
    pub fn advance(&mut self, duration: f64) {
        let mut left = duration;
        while left > 0.0 {
            let longest = LARGEST_COURANT * self.spacing / f64::from(self.fastest_wave());
            let num_steps = (left / longest).ceil().max(1.0);
            let dt = left / num_steps;
            self.step(dt);
            left = if num_steps == 1.0 { 0.0 } else { left - dt };
        }
    }

    /// Density of the cells of some slices, `[z, y, x]`.
    pub fn density(&self, first: usize, count: usize) -> Vec<f32> {
        let slice_len = self.dims[0] * self.dims[1];
        (first * slice_len..(first + count) * slice_len)
            .map(|cell| self.cells[self.position(cell)][0])
            .collect()
    }

    /// State of a cell, counted x fastest.
    pub fn primitive(&self, cell: usize) -> Primitive {
        primitive(self.cells[self.position(cell)], self.gamma)
    }

    /// Mass, momentum along x, y, z and energy in the box, summed in a fixed order.
    pub fn totals(&self) -> [f64; 5] {
        let volume = self.spacing * self.spacing * self.spacing;
        let mut sums = [0.0; 5];
        for cell in 0..self.cells.len() {
            let state = self.cells[self.position(cell)];
            sums.iter_mut().zip(state).for_each(|(sum, q)| *sum += f64::from(q) * volume);
        }
        sums
    }

    /// Where a cell, counted x fastest, lies in the present order.
    fn position(&self, cell: usize) -> usize {
        let [nx, ny, _] = self.dims;
        let index = [cell % nx, cell / nx % ny, cell / nx / ny];
        let [a, b, c] = [0, 1, 2].map(|n| (self.contiguous + n) % 3);
        (index[c] * self.dims[b] + index[b]) * self.dims[a] + index[a]
    }

    /// Largest `|u| + c` along any axis.
    fn fastest_wave(&self) -> f32 {
        let speed = |state: &Conserved| {
            let [density, u, v, w, pressure] = primitive(*state, self.gamma);
            u.abs().max(v.abs()).max(w.abs()) + (self.gamma * pressure / density).sqrt()
        };
        self.cells.par_iter().map(speed).reduce(|| 0.0, f32::max)
    }

    fn step(&mut self, dt: f64) {
        let ratio = (dt / self.spacing) as f32;
        // Turning by one axis at a time, the last axis of a step is the first of the next.
        let order = if self.x_first { [0, 1, 2] } else { [2, 1, 0] };
        for axis in order {
            while self.contiguous != axis {
                self.turn(self.x_first);
            }
            self.sweep(ratio);
        }
        self.x_first = !self.x_first;
    }

    /// Advances all pencils along the contiguous axis; `ratio` is dt / spacing.
    fn sweep(&mut self, ratio: f32) {
        let (axis, gamma) = (self.contiguous, self.gamma);
        let boundaries = self.boundaries[axis];
        self.cells.par_chunks_mut(self.dims[axis]).for_each_init(Pencil::default, |pencil, cells| {
            pencil.advance(cells, axis, boundaries, gamma, ratio)
        });
    }

    /// Makes the next axis contiguous, or the one before.
    fn turn(&mut self, forward: bool) {
        let [a, b, c] = [0, 1, 2].map(|n| self.dims[(self.contiguous + n) % 3]);
        let cells = &self.cells;
        if forward {
            // [c, b, a] to [a, c, b]
            self.turned.par_chunks_mut(c * b).enumerate().for_each(|(i, out)| {
                out.iter_mut().enumerate().for_each(|(n, q)| *q = cells[n * a + i]);
            });
            self.contiguous = (self.contiguous + 1) % 3;
        } else {
            // [c, b, a] to [b, a, c]
            self.turned.par_chunks_mut(a * c).enumerate().for_each(|(j, out)| {
                for (i, row) in out.chunks_exact_mut(c).enumerate() {
                    row.iter_mut().enumerate().for_each(|(k, q)| *q = cells[(k * b + j) * a + i]);
                }
            });
            self.contiguous = (self.contiguous + 2) % 3;
        }
        std::mem::swap(&mut self.cells, &mut self.turned);
    }
}

/// Buffers of one pencil; two ghost cells lie before and after its cells.
#[derive(Default)]
struct Pencil {
    states: Vec<Primitive>,
    /// States at the low and the high face of a cell after half a step.
    faces: Vec<[Primitive; 2]>,
    fluxes: Vec<Conserved>,
}

impl Pencil {
    fn advance(
        &mut self,
        cells: &mut [Conserved],
        axis: usize,
        boundaries: [Boundary; 2],
        gamma: f32,
        ratio: f32,
    ) {
        self.fill(cells, axis, boundaries, gamma);
        self.faces.clear();
        self.faces.extend(self.states.windows(3).map(|w| half_step([w[0], w[1], w[2]], gamma, ratio)));
        self.fluxes.clear();
        self.fluxes.extend(self.faces.windows(2).map(|f| hllc(f[0][1], f[1][0], gamma)));
        for (cell, flux) in cells.iter_mut().zip(self.fluxes.windows(2)) {
            // Momentum was turned so that the sweep axis comes first.
            let [u, v, w] = [0, 1, 2].map(|n| 1 + (axis + n) % 3);
            for (to, from) in [(0, 0), (u, 1), (v, 2), (w, 3), (4, 4)] {
                cell[to] += ratio * (flux[0][from] - flux[1][from]);
            }
        }
    }

    /// Primitive states with the velocity along the sweep first, ghosts included.
    fn fill(&mut self, cells: &[Conserved], axis: usize, [low, high]: [Boundary; 2], gamma: f32) {
        let turned = |[density, u, v, w, pressure]: Primitive| {
            let velocity = [u, v, w];
            let [u, v, w] = [0, 1, 2].map(|n| velocity[(axis + n) % 3]);
            [density, u, v, w, pressure]
        };
        let ghost = |boundary: Boundary, nearest: Conserved, mirrored: Conserved| match boundary {
            Boundary::Wall => {
                let [density, u, v, w, pressure] = turned(primitive(mirrored, gamma));
                [density, -u, v, w, pressure]
            }
            Boundary::Outflow => turned(primitive(nearest, gamma)),
            Boundary::Inflow(state) => turned(state),
        };
        let last = cells.len() - 1;
        let second = 1.min(last);
        self.states.clear();
        self.states.extend([ghost(low, cells[0], cells[second]), ghost(low, cells[0], cells[0])]);
        self.states.extend(cells.iter().map(|q| turned(primitive(*q, gamma))));
        let end = [ghost(high, cells[last], cells[last]), ghost(high, cells[last], cells[last - second])];
        self.states.extend(end);
    }
}

/// States at the two faces of the middle cell, half a step on (Toro 2009, eqs. 13.31, 14.42).
#[inline]
fn half_step(states: [Primitive; 3], gamma: f32, ratio: f32) -> [Primitive; 2] {
    let [before, middle, after] = states;
    if before == middle && middle == after {
        return [middle, middle];
    }
    let slope: Primitive = std::array::from_fn(|n| limited(middle[n] - before[n], after[n] - middle[n]));
    let [density, u, _, _, pressure] = middle;
    let change: Primitive = std::array::from_fn(|n| {
        let source = match n {
            0 => density * slope[1],
            1 => slope[4] / density,
            4 => gamma * pressure * slope[1],
            _ => 0.0,
        };
        -0.5 * ratio * (u * slope[n] + source)
    });
    let face =
        |sign: f32| -> Primitive { std::array::from_fn(|n| middle[n] + sign * 0.5 * slope[n] + change[n]) };
    let (low, high) = (face(-1.0), face(1.0));
    // A face state far below its cell's would not be positive for long.
    let sound = |face: &Primitive| face[0] > 0.1 * density && face[4] > 0.1 * pressure;
    if sound(&low) && sound(&high) { [low, high] } else { [middle, middle] }
}

/// Monotonised central slope (van Leer 1977).
#[inline]
fn limited(a: f32, b: f32) -> f32 {
    if a * b <= 0.0 {
        return 0.0;
    }
    let least = (2.0 * a.abs()).min(2.0 * b.abs()).min(0.5 * (a + b).abs());
    if a > 0.0 { least } else { -least }
}

/// Flux across a face between two states (Toro 2009, eqs. 10.37 to 10.39).
#[inline]
fn hllc(left: Primitive, right: Primitive, gamma: f32) -> Conserved {
    if left == right {
        return flux(left, gamma);
    }
    let [wave_left, wave_right] = wave_speeds(left, right, gamma);
    if wave_left >= 0.0 {
        return flux(left, gamma);
    }
    if wave_right <= 0.0 {
        return flux(right, gamma);
    }
    let (mass_left, mass_right) = (left[0] * (wave_left - left[1]), right[0] * (wave_right - right[1]));
    let contact =
        (right[4] - left[4] + mass_left * left[1] - mass_right * right[1]) / (mass_left - mass_right);
    let (side, wave, mass) =
        if contact >= 0.0 { (left, wave_left, mass_left) } else { (right, wave_right, mass_right) };
    let state = conserved(side, gamma);
    let density = mass / (wave - contact);
    let energy = state[4] / side[0] + (contact - side[1]) * (contact + side[4] / mass);
    let star = [density, density * contact, density * side[2], density * side[3], density * energy];
    let outer = flux(side, gamma);
    std::array::from_fn(|n| outer[n] + wave * (star[n] - state[n]))
}

/// Einfeldt's bounds of the slowest and fastest signal, from Roe's averages (Toro 2009, eqs. 10.49 and 10.52).
#[inline]
fn wave_speeds(left: Primitive, right: Primitive, gamma: f32) -> [f32; 2] {
    let sound_left = (gamma * left[4] / left[0]).sqrt();
    let sound_right = (gamma * right[4] / right[0]).sqrt();
    let (weight_left, weight_right) = (left[0].sqrt(), right[0].sqrt());
    let total = weight_left + weight_right;
    let mean = (weight_left * left[1] + weight_right * right[1]) / total;
    let jump = right[1] - left[1];
    let spread = (weight_left * sound_left * sound_left + weight_right * sound_right * sound_right) / total
        + 0.5 * weight_left * weight_right / (total * total) * jump * jump;
    let sound = spread.sqrt();
    [(mean - sound).min(left[1] - sound_left), (mean + sound).max(right[1] + sound_right)]
}

/// Flux of a state along the sweep axis.
#[inline]
fn flux(state: Primitive, gamma: f32) -> Conserved {
    let [density, u, v, w, pressure] = state;
    let energy = conserved(state, gamma)[4];
    let mass = density * u;
    [mass, mass * u + pressure, mass * v, mass * w, (energy + pressure) * u]
}

#[inline]
fn conserved([density, u, v, w, pressure]: Primitive, gamma: f32) -> Conserved {
    let kinetic = 0.5 * density * (u * u + v * v + w * w);
    [density, density * u, density * v, density * w, pressure / (gamma - 1.0) + kinetic]
}

/// Density and pressure are kept above zero against rounding.
#[inline]
fn primitive([density, mx, my, mz, energy]: Conserved, gamma: f32) -> Primitive {
    let density = density.max(1e-10);
    let inner = energy - 0.5 * (mx * mx + my * my + mz * mz) / density;
    let pressure = ((gamma - 1.0) * inner).max(1e-7 * energy).max(1e-12);
    [density, mx / density, my / density, mz / density, pressure]
}
