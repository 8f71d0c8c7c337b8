//! A tile of the screen: its rays, and what they have gathered.

use chronoxel_core::{Image, PictureRays, compositing::accumulate_constant};

use crate::Scene;
use crate::scene::clip_to_box;

use super::Job;
use super::kernel::{BrickJob, LEAST_TRANSMITTANCE, March, Packet, sample_interval};
use super::lanes::F8;

/// Columns and rows of pixels of a packet.
const PACKET: [usize; 2] = [4, 2];

/// What is done with a brick.
pub(super) enum Work<'a> {
    /// Sampled; with the distance of each block to the nearest that can be seen, where not all can.
    March(March, BrickJob<'a>, Option<Vec<f32>>),
    /// Crossed in closed form: premultiplied colour and alpha of one sample.
    Constant([f32; 4]),
}

/// The rays of a square of pixels, on one thread after another square's.
#[derive(Default)]
pub(super) struct Tile {
    corner: [usize; 2],
    size: [usize; 2],
    packets_along: [usize; 2],
    packets: Vec<Packet>,
    num_samples: u64,
}

/// The pixels of a tile that was drawn.
pub(super) struct PixelBlock {
    corner: [usize; 2],
    width: usize,
    pixels: Vec<[f32; 4]>,
    pub num_samples: u64,
}

impl Tile {
    /// Sets up the rays of the pixels from `corner` on; those outside the picture have no samples.
    ///
    /// * `gathered`: what the pixels of the picture hold so far, transmittance in place of alpha
    pub fn begin(&mut self, setup: &RaySetup, corner: [usize; 2], edge: usize, gathered: &Image) {
        self.corner = corner;
        self.size = std::array::from_fn(|a| edge.min(setup.scene.size[a] - corner[a]));
        self.packets_along = PACKET.map(|n| edge / n);
        self.num_samples = 0;
        self.packets.clear();
        let along = self.packets_along;
        self.packets.extend((0..along[0] * along[1]).map(|i| {
            let first = [i % along[0] * PACKET[0], i / along[0] * PACKET[1]];
            setup.packet([corner[0] + first[0], corner[1] + first[1]], gathered)
        }));
    }

    /// Puts a brick behind what was drawn before.
    pub fn draw(&mut self, job: &Job) {
        let range = |a: usize| {
            let [from, to] = job.pixels[a].map(|p| p.saturating_sub(self.corner[a]));
            from / PACKET[a]..to.div_ceil(PACKET[a]).min(self.packets_along[a])
        };
        let (rows, columns) = (range(1), range(0));
        let packets_along = self.packets_along[0];
        let packets = rows.flat_map(|row| columns.clone().map(move |column| row * packets_along + column));
        match &job.work {
            Work::Constant(sample) => {
                packets.for_each(|i| cross_constant(&job.region, *sample, &mut self.packets[i]));
            }
            Work::March(march, brick, blocks) => {
                let brick = BrickJob { blocks: blocks.as_deref(), ..*brick };
                for i in packets {
                    // SAFETY: `march_for` chose a kernel that this CPU has, and the brick's arrays have the sizes
                    // that `PreparedBrick::new` checked.
                    self.num_samples += unsafe { march(&brick, &mut self.packets[i]) };
                }
            }
        }
    }

    /// The pixels that lie in the picture, transmittance in place of alpha.
    pub fn end(&self) -> PixelBlock {
        let [width, height] = self.size;
        let mut pixels = Vec::with_capacity(width * height);
        for y in 0..height {
            let row = &self.packets[y / PACKET[1] * self.packets_along[0]..];
            for x in 0..width {
                let (packet, lane) = (&row[x / PACKET[0]], x % PACKET[0] + y % PACKET[1] * PACKET[0]);
                let [r, g, b] = [&packet.color[0], &packet.color[1], &packet.color[2]].map(|c| c.0[lane]);
                pixels.push([r, g, b, packet.transmittance.0[lane]]);
            }
        }
        PixelBlock { corner: self.corner, width, pixels, num_samples: self.num_samples }
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
    fn packet(&self, first: [usize; 2], gathered: &Image) -> Packet {
        let zero = F8::default();
        let mut packet = Packet {
            entry: [zero; 3],
            step: [zero; 3],
            inverse_step: [F8([1.0; 8]); 3],
            length: zero,
            num_samples: zero,
            color: [zero; 3],
            transmittance: F8([1.0; 8]),
        };
        for lane in 0..8 {
            let pixel = [first[0] + lane % PACKET[0], first[1] + lane / PACKET[0]];
            if pixel[0] < self.scene.size[0] && pixel[1] < self.scene.size[1] {
                self.set_up(&mut packet, lane, pixel);
                let [r, g, b, transmittance] = gathered.pixels[pixel[1] * gathered.width + pixel[0]];
                packet.color.iter_mut().zip([r, g, b]).for_each(|(color, c)| color.0[lane] = c);
                packet.transmittance.0[lane] = transmittance;
            }
        }
        packet
    }

    fn set_up(&self, packet: &mut Packet, lane: usize, pixel: [usize; 2]) {
        let ray = self.rays.ray(pixel.map(|p| p as f64 + 0.5));
        let Some([entry, exit]) = clip_to_box(&ray, self.bounds) else { return };
        let origin = self.scene.grid.origin;
        for a in 0..3 {
            let place = (ray.origin[a] - origin[a] + entry * ray.direction[a]) * self.per_spacing[a];
            let step = (ray.direction[a] * self.dt * self.per_spacing[a]) as f32;
            packet.entry[a].0[lane] = place as f32;
            packet.step[a].0[lane] = step;
            packet.inverse_step[a].0[lane] = if step.abs() < 1e-30 { 1e30 } else { 1.0 / step };
        }
        let length = (exit - entry) / self.dt;
        packet.length.0[lane] = length as f32;
        // Rounded: a length is not negative.
        packet.num_samples.0[lane] = (length + 0.5) as u32 as f32;
    }
}

/// Crosses a box of one colour in closed form, as that many whole samples.
fn cross_constant(region: &super::LevelBox, sample: [f32; 4], packet: &mut Packet) {
    let [first, end] = sample_interval(region, packet);
    for lane in 0..8 {
        let transmittance = packet.transmittance.0[lane];
        let num_samples = end.0[lane] - first.0[lane];
        if num_samples <= 0.0 || transmittance <= LEAST_TRANSMITTANCE {
            continue;
        }
        let (weight, run_transmittance) = accumulate_constant(sample[3], num_samples);
        for (color, c) in packet.color.iter_mut().zip(sample) {
            color.0[lane] += transmittance * weight * c;
        }
        packet.transmittance.0[lane] = transmittance * run_transmittance;
    }
}
