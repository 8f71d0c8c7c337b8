//! `sim:swirl`: a test pattern for playback, and for nothing else: band-limited noise carried by a swirling flow.
//!
//! Nothing is solved: the pattern has texture in every brick, moves coherently from step to step, and costs little at any size, so that series larger than memory
//! can be made in minutes. Its numbers mean nothing, and rates or errors of codecs measured with it say nothing about data.
//!
//! The noise is a periodic tile with waves of one octave only. The flow turns about two axes through the middle, each at a speed that depends on what the turn
//! leaves unchanged (the distance from the axis and the place along it), so that it keeps volumes and its characteristics are known. Shear
//! would draw the noise out without end: two copies of the noise, half a period apart, are carried for one period each, and faded in and out so that the
//! variance stays the same. All slices and steps are independent of each other.

use std::f64::consts::{PI, TAU};

use chronoxel_core::{TimeAxis, UniformGrid};
use libm::{cos, exp, sin, sqrt};
use rayon::prelude::*;

use super::spec::Spec;
use super::vortex::SplitMix64;
use super::{Run, SimulatedSeries, WorkingBytes};
use crate::SourceError;

/// Samples of the tile along an axis; a power of two.
const TILE: usize = 64;
/// Samples of the tile with the first ones repeated behind the last.
const PADDED: usize = TILE + 1;
/// Wave numbers of the tile: the longest are below, the shortest are this.
const WAVES: [i32; 2] = [4, 8];
/// Half the angle that noise is carried through at most, radians.
const MOST_ANGLE: f64 = 0.7;
/// The tile lies askew in the grid, so that its repetitions never meet bricks in the same way: rows of a rotation.
const ASKEW: [[f64; 3]; 3] = [[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]];
/// Slices whose characteristics are held at a time.
const SLAB: usize = 16;

/// Opens `sim:swirl`; options `dims`, `steps`, `seed`, `wavelength` (of the shortest waves, voxels) and `speed` (voxels per step).
///
/// Unlike in the simulations, a step is the same length of time however many there are, so that steps stay coherent at any number and size.
pub(super) fn open(spec: &Spec) -> Result<SimulatedSeries, SourceError> {
    spec.check_keys(&["dims", "steps", "seed", "wavelength", "speed"])?;
    let dims = spec.dims([128; 3], 8)?;
    let steps = spec.steps(128)?;
    let seed = spec.seed(1)?;
    let wavelength = spec.number("wavelength", 8.0, [4.0, 64.0])?;
    let speed = spec.number("speed", 1.0, [0.001, 64.0])?;
    Ok(SimulatedSeries::new(
        UniformGrid::new(dims, [0.0; 3], [1.0; 3]).expect("checked dims"),
        TimeAxis::regular(steps, 1.0, "").expect("increasing times"),
        ["playback_test_pattern", ""],
        working_bytes(dims),
        Box::new(move || Box::new(Swirl::new(dims, seed, wavelength, speed))),
    ))
}

fn working_bytes(dims: [usize; 3]) -> WorkingBytes {
    let lattice = Lattice::new(dims);
    let planes = SLAB / lattice.spacing + 2;
    let slab = planes * lattice.nodes[0] * lattice.nodes[1] * size_of::<Characteristics>();
    let tile = PADDED * PADDED * PADDED * size_of::<f32>();
    // While the tile is made, its complex samples are held, and those of one axis less.
    let waves = 2 * WAVES[1] as usize + 1;
    let making = TILE * TILE * (TILE + waves) * size_of::<[f64; 2]>();
    WorkingBytes { shared: (slab + tile).max(making) as u64, per_thread: 0 }
}

/// Where the two copies of the noise that are seen at a point come from, in samples of the tile.
type Characteristics = [[f64; 3]; 2];

/// Every so many voxels the characteristics are computed, and interpolated between: they are smooth on the scale of the whole box.
struct Lattice {
    spacing: usize,
    nodes: [usize; 3],
}

impl Lattice {
    fn new(dims: [usize; 3]) -> Self {
        let longest = *dims.iter().max().expect("three axes");
        let spacing = (longest / 32).clamp(1, 16);
        Self { spacing, nodes: dims.map(|n| (n - 1) / spacing + 2) }
    }
}

struct Swirl {
    dims: [usize; 3],
    seed: u64,
    /// Samples of the tile per voxel.
    scale: f64,
    /// Radians per step at the axes.
    turn: f64,
    lattice: Lattice,
    tile: Vec<f32>,
    step: f64,
}

impl Swirl {
    fn new(dims: [usize; 3], seed: u64, wavelength: f64, speed: f64) -> Self {
        let longest = *dims.iter().max().expect("three axes") as f64;
        let shortest_wave = TILE as f64 / f64::from(WAVES[1]);
        Self {
            dims,
            seed,
            scale: shortest_wave / wavelength,
            turn: speed / (0.5 * longest),
            lattice: Lattice::new(dims),
            tile: tile(seed),
            step: 0.0,
        }
    }

    /// The two copies of the noise at present: the steps since their middle, their weight, and where in the tile they lie.
    fn copies(&self) -> [Carried; 2] {
        let period = 2.0 * MOST_ANGLE / self.turn;
        [0.0, 0.5].map(|part| {
            let periods = self.step / period + part;
            let number = periods as u64;
            let phase = periods - number as f64;
            let mut random = SplitMix64(self.seed ^ (2 * number + u64::from(part > 0.0) + 1).rotate_left(32));
            Carried {
                age: (phase - 0.5) * period,
                weight: sin(PI * phase) as f32,
                offset: [0; 3].map(|_| (random.symmetric() + 1.0) * TILE as f64),
            }
        })
    }

    /// Characteristics of a lattice plane.
    fn plane(&self, k: usize, copies: &[Carried; 2]) -> Vec<Characteristics> {
        let longest = *self.dims.iter().max().expect("three axes") as f64;
        let mut nodes = Vec::with_capacity(self.lattice.nodes[0] * self.lattice.nodes[1]);
        for j in 0..self.lattice.nodes[1] {
            for i in 0..self.lattice.nodes[0] {
                let index = [i, j, k].map(|n| (n * self.lattice.spacing) as f64);
                let here = std::array::from_fn(|a| (index[a] - 0.5 * (self.dims[a] - 1) as f64) / longest);
                nodes.push(copies.each_ref().map(|copy| {
                    let from = carried_from(here, self.turn * copy.age);
                    std::array::from_fn(|a| {
                        let along: f64 = (0..3).map(|b| ASKEW[a][b] * from[b]).sum();
                        along * longest * self.scale + copy.offset[a]
                    })
                }));
            }
        }
        nodes
    }

    /// One row of samples.
    fn row(
        &self,
        planes: &[Vec<Characteristics>],
        [y, z]: [usize; 2],
        copies: &[Carried; 2],
        row: &mut [f32],
    ) {
        let spacing = self.lattice.spacing;
        let [fy, fz] = [y, z].map(|n| (n % spacing) as f64 / spacing as f64);
        let (j, nx) = (y / spacing, self.lattice.nodes[0]);
        let between = |i: usize, copy: usize, a: usize| {
            let in_plane = |plane: &[Characteristics]| {
                let (low, high) = (plane[j * nx + i][copy][a], plane[(j + 1) * nx + i][copy][a]);
                low + fy * (high - low)
            };
            let (low, high) = (in_plane(&planes[0]), in_plane(&planes[1]));
            low + fz * (high - low)
        };
        for (i, part) in row.chunks_mut(spacing).enumerate() {
            let ends =
                [i, i + 1].map(|i| std::array::from_fn(|copy| std::array::from_fn(|a| between(i, copy, a))));
            self.stretch(ends, copies, part);
        }
    }

    /// Samples between two nodes of the lattice.
    fn stretch(&self, ends: [Characteristics; 2], copies: &[Carried; 2], samples: &mut [f32]) {
        samples.fill(0.0);
        for (n, copy) in copies.iter().enumerate() {
            let [from, to] = [ends[0][n], ends[1][n]];
            // In f32 near the tile, and positive all along.
            let periods = from.map(|c| libm::floor(c / TILE as f64) * TILE as f64 - 2.0 * TILE as f64);
            let start: [f32; 3] = std::array::from_fn(|a| (from[a] - periods[a]) as f32);
            let slope: [f32; 3] =
                std::array::from_fn(|a| ((to[a] - from[a]) / self.lattice.spacing as f64) as f32);
            for (i, sample) in samples.iter_mut().enumerate() {
                let at = std::array::from_fn(|a| start[a] + slope[a] * i as f32);
                *sample += copy.weight * self.noise(at);
            }
        }
    }

    /// The noise at a point of the tile, interpolated linearly: at eight samples to the shortest wave, that adds little to its spectrum.
    #[inline]
    fn noise(&self, at: [f32; 3]) -> f32 {
        let whole = at.map(|c| c as i32);
        let [fx, fy, fz]: [f32; 3] = std::array::from_fn(|a| at[a] - whole[a] as f32);
        let [i, j, k] = whole.map(|c| c as usize % TILE);
        let first = (k * PADDED + j) * PADDED + i;
        let t = &self.tile[first..first + PADDED * PADDED + PADDED + 2];
        let along_x = |n: usize| t[n] + fx * (t[n + 1] - t[n]);
        let along_y = |n: usize| {
            let (low, high) = (along_x(n), along_x(n + PADDED));
            low + fy * (high - low)
        };
        let (low, high) = (along_y(0), along_y(PADDED * PADDED));
        low + fz * (high - low)
    }
}

/// One of the two copies of the noise at some step.
struct Carried {
    /// Steps since the middle of its period.
    age: f64,
    weight: f32,
    /// Where the middle of the box lies in the tile.
    offset: [f64; 3],
}

impl Run for Swirl {
    fn advance_to(&mut self, time: f64) {
        self.step = time;
    }

    fn slices(&mut self, first: usize, count: usize) -> Vec<f32> {
        let [nx, ny, _] = self.dims;
        let spacing = self.lattice.spacing;
        let copies = self.copies();
        let mut samples = vec![0.0; nx * ny * count];
        for (n, slab) in samples.chunks_mut(nx * ny * SLAB).enumerate() {
            let first = first + n * SLAB;
            let last = first + slab.len() / (nx * ny) - 1;
            let low = first / spacing;
            let planes: Vec<_> =
                (low..last / spacing + 2).into_par_iter().map(|k| self.plane(k, &copies)).collect();
            slab.par_chunks_mut(nx).enumerate().for_each(|(r, row)| {
                let (y, z) = (r % ny, first + r / ny);
                self.row(&planes[z / spacing - low..], [y, z], &copies, row);
            });
        }
        samples
    }
}

/// Where the flow carried something from that is `here` now, both from the middle and in lengths of the longest side.
///
/// * `angle`: that a turn at full speed has made since
fn carried_from(here: [f64; 3], angle: f64) -> [f64; 3] {
    let [x, y, z] = here;
    let first = -angle * (0.5 + 0.5 * exp(-(x * x + y * y) / 0.09)) * (0.8 + 0.2 * sin(TAU * z));
    let (s, c) = (sin(first), cos(first));
    let [x, y] = [c * x - s * y, s * x + c * y];
    let second = -angle * (0.4 + 0.4 * exp(-(y * y + z * z) / 0.04)) * (0.8 + 0.2 * cos(TAU * x));
    let (s, c) = (sin(second), cos(second));
    [x, c * y - s * z, s * y + c * z]
}

/// A periodic tile of noise of variance 1, padded: waves of random amplitude and phase in one octave.
fn tile(seed: u64) -> Vec<f32> {
    let most = WAVES[1];
    let num = 2 * most as usize + 1;
    let table = wave_table();
    let mut random = SplitMix64(seed);
    let mut field: Vec<[f64; 2]> = Vec::with_capacity(num * num * num);
    for kz in -most..=most {
        for ky in -most..=most {
            for kx in -most..=most {
                let squared = kx * kx + ky * ky + kz * kz;
                let is_inside = squared > WAVES[0] * WAVES[0] && squared <= most * most;
                let wave = [random.symmetric(), random.symmetric()];
                field.push(if is_inside { wave } else { [0.0; 2] });
            }
        }
    }
    // One axis after the other: the wave numbers of the axis that varies fastest become places, which from then on vary slowest.
    for _ in 0..3 {
        field = transformed(&field, num, &table);
    }
    let variance = field.iter().map(|value| value[0] * value[0]).sum::<f64>() / field.len() as f64;
    let scale = 1.0 / sqrt(variance);
    let mut padded = Vec::with_capacity(PADDED * PADDED * PADDED);
    for z in 0..PADDED {
        for y in 0..PADDED {
            for x in 0..PADDED {
                let [x, y, z] = [x, y, z].map(|n| n % TILE);
                padded.push((field[(z * TILE + y) * TILE + x][0] * scale) as f32);
            }
        }
    }
    padded
}

/// `exp(2 π i n / TILE)`.
fn wave_table() -> Vec<[f64; 2]> {
    let angles = (0..TILE).map(|n| TAU * n as f64 / TILE as f64);
    angles.map(|angle| [cos(angle), sin(angle)]).collect()
}

/// Sums of waves along the axis that varies fastest, at every place of the tile; that axis then varies slowest.
fn transformed(field: &[[f64; 2]], num: usize, table: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let most = num / 2;
    let rows: Vec<&[[f64; 2]]> = field.chunks(num).collect();
    let mut out = Vec::with_capacity(rows.len() * TILE);
    for place in 0..TILE {
        for row in &rows {
            let mut sum = [0.0; 2];
            for (n, [re, im]) in row.iter().enumerate() {
                let [c, s] = table[(n + TILE - most) * place % TILE];
                sum[0] += re * c - im * s;
                sum[1] += re * s + im * c;
            }
            out.push(sum);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The determinant of the Jacobian is 1 everywhere: the flow keeps volumes.
    #[test]
    fn the_flow_keeps_volumes() {
        let h = 1e-5;
        for (n, angle) in [(1, 0.7), (2, -0.7), (3, 0.2)] {
            let here = [0.1, -0.27, 0.33].map(|c| c * f64::from(n) / 2.0);
            let column = |a: usize| {
                let moved = |sign: f64| {
                    carried_from(
                        std::array::from_fn(|b| here[b] + if a == b { sign * h } else { 0.0 }),
                        angle,
                    )
                };
                let (low, high) = (moved(-1.0), moved(1.0));
                std::array::from_fn(|b| (high[b] - low[b]) / (2.0 * h))
            };
            let [u, v, w]: [[f64; 3]; 3] = std::array::from_fn(column);
            let determinant = u[0] * (v[1] * w[2] - v[2] * w[1]) - u[1] * (v[0] * w[2] - v[2] * w[0])
                + u[2] * (v[0] * w[1] - v[1] * w[0]);
            assert!((determinant - 1.0).abs() < 1e-8, "{determinant}");
        }
    }

    #[test]
    fn the_tile_is_askew_by_a_rotation() {
        for (a, row) in ASKEW.iter().enumerate() {
            for (b, other) in ASKEW.iter().enumerate() {
                let product: f64 = row.iter().zip(other).map(|(x, y)| x * y).sum();
                assert!((product - f64::from(u8::from(a == b))).abs() < 1e-12);
            }
        }
    }

    /// A sum of waves has no mean, and repeats behind the last sample.
    #[test]
    fn the_tile_is_periodic_noise_of_variance_one() {
        let tile = tile(5);
        let at = |x: usize, y: usize, z: usize| f64::from(tile[(z * PADDED + y) * PADDED + x]);
        assert_eq!(at(TILE, 3, 9), at(0, 3, 9));
        assert_eq!(at(7, TILE, TILE), at(7, 0, 0));
        let inside = || (0..TILE.pow(3)).map(|n| at(n % TILE, n / TILE % TILE, n / TILE / TILE));
        let num = TILE.pow(3) as f64;
        assert!((inside().sum::<f64>() / num).abs() < 1e-6);
        assert!((inside().map(|v| v * v).sum::<f64>() / num - 1.0).abs() < 1e-6);
    }
}
