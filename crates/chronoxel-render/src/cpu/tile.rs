//! A tile of the screen: its rays, and what they have gathered.

use std::ops::Range;

use chronoxel_core::{Image, PictureRays, Ray, compositing::accumulate_constant};

use crate::Scene;

use super::Job;
use super::kernel::{BrickJob, LEAST_TRANSMITTANCE, March, Packet, sample_interval};
use super::lanes::F8;
use super::partial::{PACKET, PacketPixels, PartialImage, Recorded};

/// What is done with a brick.
pub(super) enum Work<'a> {
    /// Sampled; with the distance of each block to the nearest that can be seen, where not all can.
    March(March, BrickJob<'a>, Option<Vec<f32>>),
    /// Crossed in closed form: premultiplied colour and alpha of one sample.
    Constant([f32; 4]),
    /// Composited as it was recorded.
    Partial(&'a PartialImage),
}

/// The rays of a square of pixels, on one thread after another square's.
#[derive(Default)]
pub(super) struct Tile {
    corner: [usize; 2],
    size: [usize; 2],
    packets_along: [usize; 2],
    packets: Vec<Packet>,
    /// While a run is recorded: what was drawn before it.
    front: Vec<PacketPixels>,
    recorded: Recorded,
    num_samples: u64,
}

/// The pixels of a tile that was drawn.
pub(super) struct PixelBlock {
    pub corner: [usize; 2],
    width: usize,
    pixels: Vec<[f32; 4]>,
    pub recorded: Recorded,
    pub num_samples: u64,
}

impl Tile {
    /// Sets up the rays of the pixels from `corner` on; those outside the picture have no samples.
    ///
    /// * `setup`: absent where nothing will be sampled
    /// * `gathered`: what the pixels of the picture hold so far, transmittance in place of alpha, where they hold
    ///   anything
    pub fn begin(
        &mut self,
        setup: Option<&RaySetup>,
        corner: [usize; 2],
        size: [usize; 2],
        edge: usize,
        gathered: Option<&Image>,
    ) {
        self.corner = corner;
        self.size = std::array::from_fn(|a| edge.min(size[a] - corner[a]));
        self.packets_along = PACKET.map(|n| edge / n);
        self.num_samples = 0;
        self.packets.clear();
        let along = self.packets_along;
        self.packets.extend((0..along[0] * along[1]).map(|i| {
            let first = [i % along[0] * PACKET[0], i / along[0] * PACKET[1]];
            setup.map_or(Packet::EMPTY, |setup| setup.packet([corner[0] + first[0], corner[1] + first[1]]))
        }));
        if let Some(gathered) = gathered {
            self.resume(gathered);
        }
    }

    /// Takes up what an earlier portion gathered.
    fn resume(&mut self, gathered: &Image) {
        let [width, height] = self.size;
        for y in 0..height {
            let pixels = &gathered.pixels[(self.corner[1] + y) * gathered.width + self.corner[0]..][..width];
            let row = &mut self.packets[y / PACKET[1] * self.packets_along[0]..];
            for (x, [r, g, b, transmittance]) in pixels.iter().copied().enumerate() {
                let (packet, lane) = (&mut row[x / PACKET[0]], x % PACKET[0] + y % PACKET[1] * PACKET[0]);
                packet.pixels.color.iter_mut().zip([r, g, b]).for_each(|(color, c)| color.0[lane] = c);
                packet.pixels.transmittance.0[lane] = transmittance;
            }
        }
    }

    /// Draws a run of bricks on its own, keeps that, and puts it behind what was drawn before; where what was drawn
    /// before hides all of the run, notes that.
    pub fn record<'a>(&mut self, run: u32, jobs: impl Iterator<Item = &'a Job<'a>> + Clone) {
        let Some(is_seen) = self.sees_any(jobs.clone()) else { return };
        self.recorded.push_run(run, is_seen);
        if !is_seen {
            return;
        }
        self.front.clear();
        let fresh = |packet: &mut Packet| std::mem::replace(&mut packet.pixels, PacketPixels::EMPTY);
        self.front.extend(self.packets.iter_mut().map(fresh));
        jobs.for_each(|job| self.draw(job));
        for (i, (packet, front)) in self.packets.iter_mut().zip(&self.front).enumerate() {
            let drawn = std::mem::replace(&mut packet.pixels, *front);
            if drawn != PacketPixels::EMPTY {
                let in_tile = [i % self.packets_along[0], i / self.packets_along[0]];
                self.recorded.push(
                    run,
                    std::array::from_fn(|a| self.corner[a] / PACKET[a] + in_tile[a]),
                    drawn,
                );
                packet.pixels.put_behind(&drawn);
            }
        }
    }

    /// Whether a ray that crosses one of the bricks has not ended in front of it; `None` where no ray crosses any.
    fn sees_any<'a>(&self, jobs: impl Iterator<Item = &'a Job<'a>>) -> Option<bool> {
        let mut is_crossed = false;
        for job in jobs {
            let [rows, columns] = self.packets_of(job);
            let crossed: Box<dyn Iterator<Item = (usize, [bool; 8])>> = match &job.work {
                Work::Partial(image) => {
                    let of_image = self.packets_of_image(image, rows);
                    Box::new(of_image.map(|(i, pixels)| (i, pixels.transmittance.0.map(|t| t < 1.0))))
                }
                Work::March(..) | Work::Constant(_) => Box::new(self.indices(rows, columns).map(|i| {
                    let [first, end] = sample_interval(&job.region, &self.packets[i]);
                    (i, std::array::from_fn(|lane| first.0[lane] < end.0[lane]))
                })),
            };
            for (i, lanes) in crossed {
                let transmittance = &self.packets[i].pixels.transmittance.0;
                if lanes.iter().zip(transmittance).any(|(crossed, t)| *crossed && *t > LEAST_TRANSMITTANCE) {
                    return Some(true);
                }
                is_crossed |= lanes.contains(&true);
            }
        }
        is_crossed.then_some(false)
    }

    /// The rows and columns of packets that a brick may touch.
    fn packets_of(&self, job: &Job) -> [Range<usize>; 2] {
        [1, 0].map(|a| {
            let [from, to] = job.pixels[a].map(|p| p.saturating_sub(self.corner[a]));
            from / PACKET[a]..to.div_ceil(PACKET[a]).min(self.packets_along[a])
        })
    }

    /// Indices of the packets of some rows and columns.
    fn indices(&self, rows: Range<usize>, columns: Range<usize>) -> impl Iterator<Item = usize> + use<> {
        let packets_along = self.packets_along[0];
        rows.flat_map(move |row| columns.clone().map(move |column| row * packets_along + column))
    }

    /// What a partial image has in some rows of packets, with the index of each packet in the tile.
    fn packets_of_image<'i>(
        &self,
        image: &'i PartialImage,
        rows: Range<usize>,
    ) -> impl Iterator<Item = (usize, &'i PacketPixels)> + use<'i> {
        let [first_column, first_row] = [0, 1].map(|a| self.corner[a] / PACKET[a]);
        let packets_along = self.packets_along[0];
        let columns = first_column..first_column + packets_along;
        rows.flat_map(move |row| {
            let in_row = image.packets_in(first_row + row, columns.clone());
            in_row.map(move |(column, pixels)| (row * packets_along + column - first_column, pixels))
        })
    }

    /// Puts a brick behind what was drawn before.
    pub fn draw(&mut self, job: &Job) {
        let [rows, columns] = self.packets_of(job);
        match &job.work {
            Work::Partial(image) => {
                for (i, pixels) in self.packets_of_image(image, rows) {
                    self.packets[i].pixels.put_behind(pixels);
                }
            }
            Work::Constant(sample) => {
                for i in self.indices(rows, columns) {
                    cross_constant(&job.region, *sample, &mut self.packets[i]);
                }
            }
            Work::March(march, brick, blocks) => {
                let brick = BrickJob { blocks: blocks.as_deref(), ..*brick };
                for i in self.indices(rows, columns) {
                    // SAFETY: `march_for` chose a kernel that this CPU has, and the brick's arrays have the sizes
                    // that `PreparedBrick::new` checked.
                    self.num_samples += unsafe { march(&brick, &job.region, &mut self.packets[i]) };
                }
            }
        }
    }

    /// The pixels that lie in the picture, transmittance in place of alpha.
    pub fn end(&mut self) -> PixelBlock {
        let [width, height] = self.size;
        let mut pixels = Vec::with_capacity(width * height);
        for y in 0..height {
            let row = &self.packets[y / PACKET[1] * self.packets_along[0]..];
            for x in 0..width {
                let (packet, lane) = (&row[x / PACKET[0]], x % PACKET[0] + y % PACKET[1] * PACKET[0]);
                let [r, g, b] = [0, 1, 2].map(|c| packet.pixels.color[c].0[lane]);
                pixels.push([r, g, b, packet.pixels.transmittance.0[lane]]);
            }
        }
        let recorded = std::mem::take(&mut self.recorded);
        PixelBlock { corner: self.corner, width, pixels, recorded, num_samples: self.num_samples }
    }
}

impl PixelBlock {
    /// Copies the pixels to their place.
    pub fn copy_to(&self, image: &mut Image) {
        for (row, pixels) in self.pixels.chunks_exact(self.width).enumerate() {
            let start = (self.corner[1] + row) * image.width + self.corner[0];
            image.pixels[start..start + self.width].copy_from_slice(pixels);
        }
    }
}

/// What the rays of a picture have in common.
pub(super) struct RaySetup<'a> {
    scene: &'a Scene,
    rays: PictureRays,
    bounds: [[f64; 3]; 2],
    per_spacing: [f64; 3],
    dt: f64,
}

impl<'a> RaySetup<'a> {
    pub fn new(scene: &'a Scene) -> Self {
        Self {
            scene,
            rays: scene.camera.rays(scene.size),
            bounds: scene.grid.bounds(),
            per_spacing: scene.grid.spacing.map(|s| 1.0 / s),
            dt: scene.step_length(),
        }
    }

    /// The rays of the eight pixels from `first` on.
    ///
    /// As `clip_to_box` and the places that follow from it, in loops over lanes that the compiler can vectorise.
    fn packet(&self, first: [usize; 2]) -> Packet {
        let rays: [Ray; 8] = std::array::from_fn(|lane| {
            let pixel = [first[0] + lane % PACKET[0], first[1] + lane / PACKET[0]];
            self.rays.ray(pixel.map(|p| p as f64 + 0.5))
        });
        let (mut entry, mut exit) = ([0.0f64; 8], [f64::INFINITY; 8]);
        for a in 0..3 {
            let (low, high) = (self.bounds[0][a], self.bounds[1][a]);
            for lane in 0..8 {
                let Ray { origin, direction } = &rays[lane];
                let inverse = 1.0 / direction[a];
                let (t0, t1) = ((low - origin[a]) * inverse, (high - origin[a]) * inverse);
                let crossed = if t0 < t1 { [t0, t1] } else { [t1, t0] };
                let is_between = low <= origin[a] && origin[a] <= high;
                let parallel = [if is_between { 0.0 } else { f64::INFINITY }, f64::INFINITY];
                let [near, far] = if direction[a] == 0.0 { parallel } else { crossed };
                entry[lane] = if near > entry[lane] { near } else { entry[lane] };
                exit[lane] = if far < exit[lane] { far } else { exit[lane] };
            }
        }
        let (mut packet, zero) = (Packet::EMPTY, [0.0f32; 8]);
        let (mut length, mut rounded) = (zero, zero);
        let size = self.scene.size;
        for lane in 0..8 {
            let in_picture = first[0] + lane % PACKET[0] < size[0] && first[1] + lane / PACKET[0] < size[1];
            let is_inside = in_picture && exit[lane] > entry[lane];
            let samples = if is_inside { (exit[lane] - entry[lane]) / self.dt } else { 0.0 };
            entry[lane] = if is_inside { entry[lane] } else { 0.0 };
            length[lane] = samples as f32;
            // Not negative, so that cutting rounds.
            rounded[lane] = (samples + 0.5) as u32 as f32;
        }
        (packet.length, packet.num_samples) = (F8(length), F8(rounded));
        let origin = self.scene.grid.origin;
        for a in 0..3 {
            let step_per_direction = self.dt * self.per_spacing[a];
            let (mut places, mut steps, mut inverses) = (zero, zero, zero);
            for lane in 0..8 {
                let Ray { origin: from, direction } = &rays[lane];
                places[lane] =
                    ((from[a] - origin[a] + entry[lane] * direction[a]) * self.per_spacing[a]) as f32;
                let step = (direction[a] * step_per_direction) as f32;
                steps[lane] = step;
                inverses[lane] = if step.abs() < 1e-30 { 1e30 } else { 1.0 / step };
            }
            packet.entry[a] = F8(places);
            packet.step[a] = F8(steps);
            packet.inverse_step[a] = F8(inverses);
        }
        packet
    }
}

/// Crosses a box of one colour in closed form, as that many whole samples.
fn cross_constant(region: &super::LevelBox, sample: [f32; 4], packet: &mut Packet) {
    let [first, end] = sample_interval(region, packet);
    for lane in 0..8 {
        let transmittance = packet.pixels.transmittance.0[lane];
        let num_samples = end.0[lane] - first.0[lane];
        if num_samples <= 0.0 || transmittance <= LEAST_TRANSMITTANCE {
            continue;
        }
        let (weight, run_transmittance) = accumulate_constant(sample[3], num_samples);
        for (color, c) in packet.pixels.color.iter_mut().zip(sample) {
            color.0[lane] += transmittance * weight * c;
        }
        packet.pixels.transmittance.0[lane] = transmittance * run_transmittance;
    }
}
