//! Advection, diffusion and settling of a dissolved or suspended material, by conservative finite volumes.
//!
//! `∂c/∂t + u(z, t) ∂c/∂x + v(z, t) ∂c/∂y − w_s ∂c/∂z = ∇·(K ∇c) + source`, c in g/m³ (which is mg/L).
//! Each axis is swept in turn; fluxes are upwind with van Leer's limited slopes (second order where smooth, no
//! new extremes, never negative). Horizontal sides are open to outflow, the surface is closed, and what
//! reaches the bed stays there.
//!
//! Only a box of each slice is computed: the cells above `floor`, and two cells around them. What leaves
//! that box is counted in `traces`, so that mass is accounted for to rounding.

use rayon::prelude::*;

/// Cells of a slice that may hold material, half-open along x and y.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Patch {
    x: [usize; 2],
    y: [usize; 2],
}

impl Patch {
    const EMPTY: Self = Self { x: [usize::MAX, 0], y: [usize::MAX, 0] };

    fn is_empty(&self) -> bool {
        self.x[0] >= self.x[1] || self.y[0] >= self.y[1]
    }

    fn union(&self, other: &Self) -> Self {
        let join = |a: [usize; 2], b: [usize; 2]| [a[0].min(b[0]), a[1].max(b[1])];
        Self { x: join(self.x, other.x), y: join(self.y, other.y) }
    }

    fn padded(&self, margin: usize, [nx, ny, _]: [usize; 3]) -> Self {
        if self.is_empty() {
            return Self::EMPTY;
        }
        let grow = |r: [usize; 2], n: usize| [r[0].saturating_sub(margin), (r[1] + margin).min(n)];
        Self { x: grow(self.x, nx), y: grow(self.y, ny) }
    }

    /// Numbers of the cells in a slice, row by row.
    fn rows(self, nx: usize) -> impl Iterator<Item = std::ops::Range<usize>> {
        let y = if self.is_empty() { 0..0 } else { self.y[0]..self.y[1] };
        y.map(move |j| j * nx + self.x[0]..j * nx + self.x[1])
    }
}

/// Properties of a material and of the water that carries it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// Speed at which it sinks, m/s, not negative.
    pub settling_speed: f64,
    /// Horizontal and vertical diffusivity, m²/s, not negative.
    pub diffusivity: [f64; 2],
    /// Concentration that is not followed any further, g/m³.
    pub floor: f64,
}

/// Where discharged material has gone, g.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MassBalance {
    /// Put in by [`Transport::discharge`].
    pub discharged: f64,
    /// In the water.
    pub suspended: f64,
    /// On the bed.
    pub settled: f64,
    /// Carried out through the horizontal sides.
    pub outflow: f64,
    /// Diluted below the floor and not followed.
    pub traces: f64,
}

/// The state of one material; slice 0 lies on the bed.
#[derive(Debug)]
pub struct Transport {
    dims: [usize; 3],
    spacing: f64,
    material: Material,
    cells: Vec<f64>,
    patches: Vec<Patch>,
    next_cells: Vec<f64>,
    next_patches: Vec<Patch>,
    deposit: Vec<f64>,
    discharged: f64,
    outflow: f64,
    traces: f64,
}

impl Transport {
    /// Clean water on a lattice of cubic cells.
    ///
    /// * `dims`: cells along x, y, z
    /// * `spacing`: their edge, m
    pub fn new(dims: [usize; 3], spacing: f64, material: Material) -> Self {
        let num_cells = dims.iter().product();
        Self {
            dims,
            spacing,
            material,
            cells: vec![0.0; num_cells],
            patches: vec![Patch::EMPTY; dims[2]],
            next_cells: vec![0.0; num_cells],
            next_patches: vec![Patch::EMPTY; dims[2]],
            deposit: vec![0.0; dims[0] * dims[1]],
            discharged: 0.0,
            outflow: 0.0,
            traces: 0.0,
        }
    }

    /// Bytes of the state on a lattice of these dimensions.
    pub fn state_bytes(dims: [usize; 3]) -> u64 {
        let [nx, ny, nz] = dims.map(|n| n as u64);
        (2 * nx * ny * nz + nx * ny) * size_of::<f64>() as u64 + 2 * nz * size_of::<Patch>() as u64
    }

    /// The longest step that keeps concentrations from turning negative, s.
    ///
    /// A cell gives away at most the fraction `ν (2 − ν) + 2 d` in a sweep (Courant number ν, diffusion
    /// number d); with ν ≤ 0.6 and d ≤ 0.08 that is 1.
    pub fn longest_step(&self, fastest_current: f64) -> f64 {
        let speed = fastest_current.max(self.material.settling_speed);
        let diffusivity = self.material.diffusivity[0].max(self.material.diffusivity[1]);
        (0.6 * self.spacing / speed).min(0.08 * self.spacing * self.spacing / diffusivity)
    }

    /// Adds `mass` (g) to the cell (i, j, k).
    pub fn discharge(&mut self, [i, j, k]: [usize; 3], mass: f64) {
        let [nx, ny, _] = self.dims;
        self.cells[(k * ny + j) * nx + i] += mass / self.cell_volume();
        self.discharged += mass;
        let cell = Patch { x: [i, i + 1], y: [j, j + 1] }.padded(2, self.dims);
        self.patches[k] = self.patches[k].union(&cell);
    }

    /// Advances by `dt` seconds in the current `current(k)` = (u, v) of slice k, m/s.
    ///
    /// # Panics
    /// If `dt` exceeds [`Self::longest_step`] for the current.
    pub fn step(&mut self, dt: f64, current: impl Fn(usize) -> [f64; 2] + Sync) {
        let fastest = (0..self.dims[2]).flat_map(&current).fold(0.0, |a: f64, u| a.max(u.abs()));
        assert!(dt <= self.longest_step(fastest) * (1.0 + 1e-9), "step of {dt} s is not stable");
        self.sweep_slices(dt, current);
        self.settle_on_bed(dt);
        self.sweep_columns(dt);
    }

    /// Concentration of a cell's water and, on the bed, of what has settled there, g/m³.
    pub fn concentration(&self, cell: usize) -> f64 {
        self.cells[cell] + self.deposit.get(cell).map_or(0.0, |m| m / self.spacing)
    }

    /// Where the material is now.
    pub fn mass(&self) -> MassBalance {
        MassBalance {
            discharged: self.discharged,
            suspended: self.cells.iter().sum::<f64>() * self.cell_volume(),
            settled: self.deposit.iter().sum::<f64>() * self.spacing * self.spacing,
            outflow: self.outflow,
            traces: self.traces,
        }
    }

    fn cell_volume(&self) -> f64 {
        self.spacing * self.spacing * self.spacing
    }

    fn slice_len(&self) -> usize {
        self.dims[0] * self.dims[1]
    }

    /// Advection and diffusion along x, then y, slice by slice.
    fn sweep_slices(&mut self, dt: f64, current: impl Fn(usize) -> [f64; 2] + Sync) {
        let diffusion = self.material.diffusivity[0] * dt / (self.spacing * self.spacing);
        let courant_of = dt / self.spacing;
        let (dims, slice_len) = (self.dims, self.slice_len());
        let lost: Vec<f64> = self
            .cells
            .par_chunks_mut(slice_len)
            .zip(&self.patches)
            .enumerate()
            .map_init(Vec::new, |flux, (k, (slice, patch))| {
                if patch.is_empty() {
                    return 0.0;
                }
                let [u, v] = current(k);
                let along_x = sweep_x(slice, *patch, dims[0], [u * courant_of, diffusion], flux);
                along_x + sweep_y(slice, *patch, dims, [v * courant_of, diffusion], flux)
            })
            .collect();
        self.outflow += lost.iter().sum::<f64>() * self.cell_volume();
    }

    /// What sinks through the lowest face; [`Self::sweep_columns`] takes it out of the water.
    fn settle_on_bed(&mut self, dt: f64) {
        let depth = self.material.settling_speed * dt;
        for row in self.patches[0].rows(self.dims[0]) {
            for (mass, c) in self.deposit[row.clone()].iter_mut().zip(&self.cells[row]) {
                *mass += depth * c;
            }
        }
    }

    /// Settling and vertical diffusion, then each slice's patch is drawn tight again.
    fn sweep_columns(&mut self, dt: f64) {
        let courant = -self.material.settling_speed * dt / self.spacing;
        let diffusion = self.material.diffusivity[1] * dt / (self.spacing * self.spacing);
        let (slice_len, dims, floor) = (self.slice_len(), self.dims, self.material.floor);
        let (cells, patches) = (&self.cells, &self.patches);
        let traces: Vec<f64> = self
            .next_cells
            .par_chunks_mut(slice_len)
            .zip(&mut self.next_patches)
            .enumerate()
            .map(|(k, (out, out_patch))| {
                out_patch.rows(dims[0]).for_each(|row| out[row].fill(0.0));
                let near = k.saturating_sub(1)..(k + 2).min(dims[2]);
                let patch = patches[near].iter().fold(Patch::EMPTY, |a, b| a.union(b));
                for row in patch.rows(dims[0]) {
                    sweep_column_row(cells, [slice_len, dims[2], k], row, [courant, diffusion], out);
                }
                let (tight, traces) = draw_tight(out, patch, dims, floor);
                *out_patch = tight;
                traces
            })
            .collect();
        self.traces += traces.iter().sum::<f64>() * self.cell_volume();
        std::mem::swap(&mut self.cells, &mut self.next_cells);
        std::mem::swap(&mut self.patches, &mut self.next_patches);
    }
}

/// What crosses a face from its low to its high side in one step, in units of a cell's concentration.
///
/// * `courant`: velocity · dt / spacing, its sign that of the velocity
/// * `diffusion`: K dt / spacing²
#[inline]
fn face_flux([far_low, low, high, far_high]: [f64; 4], [courant, diffusion]: [f64; 2]) -> f64 {
    let advected = if courant >= 0.0 {
        courant * (low + 0.5 * (1.0 - courant) * van_leer(low - far_low, high - low))
    } else {
        courant * (high - 0.5 * (1.0 + courant) * van_leer(high - low, far_high - high))
    };
    advected - diffusion * (high - low)
}

/// Harmonic mean of two slopes; 0 where they disagree in sign.
#[inline]
fn van_leer(a: f64, b: f64) -> f64 {
    let product = a * b;
    if product > 0.0 { 2.0 * product / (a + b) } else { 0.0 }
}

/// Sweeps the rows of a patch in place; returns the concentration that left through the sides of the volume.
fn sweep_x(slice: &mut [f64], patch: Patch, nx: usize, numbers: [f64; 2], flux: &mut Vec<f64>) -> f64 {
    let [x0, x1] = patch.x;
    let mut lost = 0.0;
    for row in slice.chunks_exact_mut(nx).take(patch.y[1]).skip(patch.y[0]) {
        let at = |i: isize| row[i.clamp(0, nx as isize - 1) as usize];
        flux.clear();
        flux.extend((x0 as isize..=x1 as isize).map(|f| match f {
            0 => row[0] * numbers[0].min(0.0),
            f if f == nx as isize => row[nx - 1] * numbers[0].max(0.0),
            f if f == x0 as isize || f == x1 as isize => 0.0,
            f => face_flux([at(f - 2), at(f - 1), at(f), at(f + 1)], numbers),
        }));
        for (i, c) in row[x0..x1].iter_mut().enumerate() {
            *c += flux[i] - flux[i + 1];
        }
        lost += flux[x1 - x0].max(0.0) * f64::from(x1 == nx) - flux[0].min(0.0) * f64::from(x0 == 0);
    }
    lost
}

/// As [`sweep_x`], along y: the fluxes of all rows are taken before any row changes.
fn sweep_y(
    slice: &mut [f64],
    patch: Patch,
    [nx, ny, _]: [usize; 3],
    numbers: [f64; 2],
    flux: &mut Vec<f64>,
) -> f64 {
    let [[x0, x1], [y0, y1]] = [patch.x, patch.y];
    let width = x1 - x0;
    let row = |j: isize| &slice[j.clamp(0, ny as isize - 1) as usize * nx..][x0..x1];
    flux.clear();
    for f in y0 as isize..=y1 as isize {
        match f {
            0 => flux.extend(row(0).iter().map(|c| c * numbers[0].min(0.0))),
            f if f == ny as isize => flux.extend(row(f).iter().map(|c| c * numbers[0].max(0.0))),
            f if f == y0 as isize || f == y1 as isize => flux.resize(flux.len() + width, 0.0),
            f => {
                let rows = [row(f - 2), row(f - 1), row(f), row(f + 1)];
                flux.extend((0..width).map(|i| face_flux(rows.map(|r| r[i]), numbers)));
            }
        }
    }
    for j in y0..y1 {
        let (low, high) = flux[(j - y0) * width..].split_at(width);
        for ((c, low), high) in slice[j * nx + x0..j * nx + x1].iter_mut().zip(low).zip(high) {
            *c += low - high;
        }
    }
    let (first, last) = (&flux[..width], &flux[flux.len() - width..]);
    let lost_low = if y0 == 0 { -first.iter().sum::<f64>() } else { 0.0 };
    let lost_high = if y1 == ny { last.iter().sum::<f64>() } else { 0.0 };
    lost_low + lost_high
}

/// One row of slice `k` after settling and vertical diffusion.
fn sweep_column_row(
    cells: &[f64],
    [slice_len, nz, k]: [usize; 3],
    row: std::ops::Range<usize>,
    numbers: [f64; 2],
    out: &mut [f64],
) {
    let start = row.start;
    let at = |k: isize| &cells[k.clamp(0, nz as isize - 1) as usize * slice_len..][row.clone()];
    let k_signed = k as isize;
    let near: [&[f64]; 5] = std::array::from_fn(|n| at(k_signed + n as isize - 2));
    for i in 0..row.len() {
        let c = near.map(|r| r[i]);
        let below = if k == 0 { numbers[0] * c[2] } else { face_flux([c[0], c[1], c[2], c[3]], numbers) };
        let above = if k + 1 == nz { 0.0 } else { face_flux([c[1], c[2], c[3], c[4]], numbers) };
        out[start + i] = c[2] + below - above;
    }
}

/// Draws a patch tight around what exceeds the floor, clears the rest and returns its concentration.
fn draw_tight(slice: &mut [f64], patch: Patch, dims: [usize; 3], floor: f64) -> (Patch, f64) {
    let nx = dims[0];
    let mut tight = Patch::EMPTY;
    for row in patch.rows(nx) {
        let j = row.start / nx;
        let values = &slice[row.clone()];
        let above = |c: &f64| *c > floor;
        if let (Some(first), Some(last)) = (values.iter().position(above), values.iter().rposition(above)) {
            let x0 = row.start - j * nx;
            tight = tight.union(&Patch { x: [x0 + first, x0 + last + 1], y: [j, j + 1] });
        }
    }
    let kept = tight.padded(2, dims);
    let mut traces = 0.0;
    for row in patch.rows(nx) {
        let (j, first) = (row.start / nx, row.start % nx);
        let inside_y = (kept.y[0]..kept.y[1]).contains(&j);
        for (i, c) in (first..).zip(&mut slice[row]) {
            if !(inside_y && (kept.x[0]..kept.x[1]).contains(&i)) {
                traces += *c;
                *c = 0.0;
            }
        }
    }
    (kept, traces)
}
