//! The kernel: eight rays through one brick.

use chronoxel_core::BitMask;

use crate::prepared::BLOCK_EDGE;

use super::lanes::{F8, I8, Lanes, Plain};
use super::light::{LightJob, terms};
use super::partial::PacketPixels;

/// A ray ends where less than this much of what lies behind would be seen: half a level of 8 bits.
pub(crate) const LEAST_TRANSMITTANCE: f32 = 1.0 / 512.0;

/// Samples taken before the blocks ahead are looked at again.
const RUN: f32 = 12.0;

/// Eight rays, and what they have gathered so far.
#[derive(Debug, Clone, Copy)]
pub(super) struct Packet {
    /// Where each enters the grid, level-0 voxels, per axis.
    pub entry: [F8; 3],
    /// From sample to sample, in voxels of the level sampled, per axis.
    pub step: [F8; 3],
    /// `1 / step`; huge where the step is 0.
    pub inverse_step: [F8; 3],
    /// Length inside the grid, counted in samples of level 0, and the same rounded.
    pub length: F8,
    pub num_samples: F8,
    pub pixels: PacketPixels,
}

impl Packet {
    /// Rays without samples.
    pub const EMPTY: Self = Self {
        entry: [F8([0.0; 8]); 3],
        step: [F8([0.0; 8]); 3],
        inverse_step: [F8([1.0; 8]); 3],
        length: F8([0.0; 8]),
        num_samples: F8([0.0; 8]),
        pixels: PacketPixels::EMPTY,
    };
}

/// The box of a draw list's entry, in voxels of its level.
#[derive(Debug, Clone, Copy)]
pub(super) struct LevelBox {
    /// `2^-level`.
    pub scale: f32,
    /// Lower planes; minus infinity at the grid's faces.
    pub low: [f32; 3],
    /// Upper planes; infinity at the grid's faces.
    pub high: [f32; 3],
}

/// What the kernel needs to know of a brick.
#[derive(Debug, Clone, Copy)]
pub(super) struct BrickJob<'a> {
    /// Samples, `full_edge` along each axis.
    pub samples: &'a [i16],
    pub full_edge: usize,
    /// Samples of the apron before the core.
    pub low_apron: usize,
    /// Place of the first sample of the core, in voxels of the level.
    pub origin: [f32; 3],
    /// Factor and offset from an interpolated sample to the index of its table entry.
    pub index_from_sample: [f32; 2],
    pub table: &'a [[f32; 4]],
    /// For each block, `[z, y, x]`, how many blocks away the nearest is that can be seen, see
    /// [`super::blocks`]. Absent where all can.
    pub blocks: Option<&'a [f32]>,
    pub blocks_along_edge: usize,
    pub mask: Option<&'a BitMask>,
    pub light: Option<LightJob>,
}

/// Draws a brick into a packet and returns the number of samples taken.
pub(super) type March = unsafe fn(&BrickJob, &LevelBox, &mut Packet) -> u64;

/// The instructions that the kernels use on this CPU.
pub fn kernel_name() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    if has_avx2() {
        return if has_avx512vl() { "AVX2 with the registers of AVX-512VL" } else { "AVX2" };
    }
    "plain Rust"
}

#[cfg(target_arch = "x86_64")]
fn has_avx2() -> bool {
    is_x86_feature_detected!("avx2") && is_x86_feature_detected!("popcnt")
}

#[cfg(target_arch = "x86_64")]
fn has_avx512vl() -> bool {
    is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl")
}

/// The kernel for a brick: the fastest that this CPU has, or the plain one.
pub(super) fn march_for(job: &BrickJob, plain: bool) -> March {
    let (lit, masked) = (job.light.is_some(), job.mask.is_some());
    #[cfg(target_arch = "x86_64")]
    if !plain && has_avx2() {
        return match (lit, masked, has_avx512vl()) {
            (false, false, false) => march_avx2::<false, false>,
            (false, true, false) => march_avx2::<false, true>,
            (true, false, false) => march_avx2::<true, false>,
            (true, true, false) => march_avx2::<true, true>,
            (false, false, true) => march_avx512vl::<false, false>,
            (false, true, true) => march_avx512vl::<false, true>,
            (true, false, true) => march_avx512vl::<true, false>,
            (true, true, true) => march_avx512vl::<true, true>,
        };
    }
    match (lit, masked) {
        (false, false) => march::<Plain, false, false>,
        (false, true) => march::<Plain, false, true>,
        (true, false) => march::<Plain, true, false>,
        (true, true) => march::<Plain, true, true>,
    }
}

/// The indices of the samples that each ray of a packet takes in a box: the first, and the one after the last.
pub(super) fn sample_interval(region: &LevelBox, packet: &Packet) -> [F8; 2] {
    let (mut first, mut end) = (F8::default(), F8::default());
    // SAFETY: the plain lanes need nothing of the CPU.
    unsafe {
        let [a, b] = interval::<Plain>(region, packet);
        Plain::store(a, &mut first);
        Plain::store(b, &mut end);
    }
    [first, end]
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,popcnt")]
unsafe fn march_avx2<const LIT: bool, const MASKED: bool>(
    job: &BrickJob,
    region: &LevelBox,
    packet: &mut Packet,
) -> u64 {
    // SAFETY: AVX2 was detected.
    unsafe { march::<super::lanes::Avx2, LIT, MASKED>(job, region, packet) }
}

/// The same for CPUs with twice the registers.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,popcnt,avx512f,avx512vl")]
unsafe fn march_avx512vl<const LIT: bool, const MASKED: bool>(
    job: &BrickJob,
    region: &LevelBox,
    packet: &mut Packet,
) -> u64 {
    // SAFETY: AVX2 was detected.
    unsafe { march::<super::lanes::Avx2, LIT, MASKED>(job, region, packet) }
}

/// First index at or behind a plane, counted along each ray: a function of the ray and the plane alone, so that
/// two boxes that share a plane share the index, and no sample is lost or taken twice.
#[inline(always)]
unsafe fn crossing<L: Lanes>(plane: f32, entry: L::F, inverse_step: L::F) -> L::F {
    // SAFETY: as the caller guarantees for L.
    unsafe { L::ceil(L::sub(L::mul(L::sub(L::splat(plane), entry), inverse_step), L::splat(0.5))) }
}

#[inline(always)]
unsafe fn interval<L: Lanes>(region: &LevelBox, packet: &Packet) -> [L::F; 2] {
    // SAFETY: as the caller guarantees for L.
    unsafe {
        let mut first = L::splat(0.0);
        let mut end = if region.scale == 1.0 {
            L::load(&packet.num_samples)
        } else {
            L::floor(L::add(L::mul(L::load(&packet.length), L::splat(region.scale)), L::splat(0.5)))
        };
        for a in 0..3 {
            let entry = L::mul(L::load(&packet.entry[a]), L::splat(region.scale));
            let inverse_step = L::load(&packet.inverse_step[a]);
            let low = crossing::<L>(region.low[a], entry, inverse_step);
            let high = crossing::<L>(region.high[a], entry, inverse_step);
            first = L::max(L::min(low, high), first);
            end = L::min(L::max(low, high), end);
        }
        [first, end]
    }
}

/// Rays in a brick's own coordinates: sample `k` lies at `entry + k · step - origin`, `k` counting half-integers.
struct Rays<L: Lanes> {
    entry: [L::F; 3],
    step: [L::F; 3],
    inverse_step: [L::F; 3],
    origin: [L::F; 3],
    /// Least and largest coordinates in the cells of the core, around which the apron holds all that gradients need.
    least: L::F,
    most: L::F,
}

impl<L: Lanes> Rays<L> {
    #[inline(always)]
    unsafe fn new(job: &BrickJob, scale: f32, packet: &Packet) -> Self {
        // SAFETY: as the caller guarantees for L.
        unsafe {
            let scale = L::splat(scale);
            let [e, s, i] = [&packet.entry, &packet.step, &packet.inverse_step];
            Self {
                entry: [
                    L::mul(L::load(&e[0]), scale),
                    L::mul(L::load(&e[1]), scale),
                    L::mul(L::load(&e[2]), scale),
                ],
                step: [L::load(&s[0]), L::load(&s[1]), L::load(&s[2])],
                inverse_step: [L::load(&i[0]), L::load(&i[1]), L::load(&i[2])],
                origin: [L::splat(job.origin[0]), L::splat(job.origin[1]), L::splat(job.origin[2])],
                least: L::splat(0.0),
                most: L::splat(((job.blocks_along_edge * BLOCK_EDGE) as f32).next_down()),
            }
        }
    }

    /// Place of sample `k` along an axis, counted from the core's first sample and kept inside the core's cells,
    /// out of which rounding may carry it.
    ///
    /// The difference is exact, so that a place is the same point of the grid in whichever brick it is sampled.
    #[inline(always)]
    unsafe fn place(&self, axis: usize, k: L::F) -> L::F {
        // SAFETY: as the caller guarantees for L.
        unsafe {
            let in_level = L::add(self.entry[axis], L::mul(k, self.step[axis]));
            let in_brick = L::sub(in_level, self.origin[axis]);
            L::min(L::max(in_brick, self.least), self.most)
        }
    }
}

/// Where eight samples lie among those of a brick.
pub(super) struct Cells<L: Lanes> {
    pub offsets: I8,
    pub weights_x: L::I,
    pub wy: L::F,
    pub wz: L::F,
}

/// Index of the sample at whole coordinates.
#[inline(always)]
unsafe fn sample_index<L: Lanes>([x, y, z]: [L::F; 3], job: &BrickJob) -> L::F {
    let row = job.full_edge;
    let first = job.low_apron * (1 + row + row * row);
    // SAFETY: as the caller guarantees for L.
    unsafe {
        let row = L::splat(row as f32);
        L::add(L::add(x, L::splat(first as f32)), L::mul(row, L::add(y, L::mul(row, z))))
    }
}

#[inline(always)]
unsafe fn cells_at<L: Lanes>(places: [L::F; 3], job: &BrickJob) -> Cells<L> {
    // SAFETY: as the caller guarantees for L.
    unsafe {
        let [x, y, z] = places;
        let (fx, fy, fz) = (L::floor(x), L::floor(y), L::floor(z));
        let index = sample_index::<L>([fx, fy, fz], job);
        let mut offsets = I8::default();
        L::store_int(L::to_int(index), &mut offsets);
        Cells { offsets, weights_x: L::weights(L::sub(x, fx)), wy: L::sub(y, fy), wz: L::sub(z, fz) }
    }
}

/// `a` where the weight is 0, `b` where it is 1.
#[inline(always)]
unsafe fn mix<L: Lanes>(a: L::F, b: L::F, weight: L::F) -> L::F {
    // SAFETY: as the caller guarantees for L.
    unsafe { L::add(a, L::mul(L::sub(b, a), weight)) }
}

/// The samples of cells, interpolated along x, in units of `1 / WEIGHT_ONE` of a sample: for each z, for each y.
#[inline(always)]
unsafe fn edges<L: Lanes>(job: &BrickJob, cells: &Cells<L>) -> [[L::I; 2]; 2] {
    let (row, plane) = (job.full_edge, job.full_edge * job.full_edge);
    // SAFETY: `Rays::place` keeps every cell's eight samples inside the brick's `full_edge`³, which is what
    // `PreparedBrick::new` checked `samples` to hold; the rest as the caller guarantees for L.
    unsafe {
        let start = job.samples.as_ptr();
        let at = |by: usize| L::sums(L::pairs(start.add(by), &cells.offsets), cells.weights_x);
        [[at(0), at(row)], [at(plane), at(plane + row)]]
    }
}

/// Interpolation along y and z of what was interpolated along x.
#[inline(always)]
pub(super) unsafe fn interpolate<L: Lanes>([near, far]: [[L::I; 2]; 2], cells: &Cells<L>) -> L::F {
    // SAFETY: as the caller guarantees for L.
    unsafe {
        let near = mix::<L>(L::to_float(near[0]), L::to_float(near[1]), cells.wy);
        let far = mix::<L>(L::to_float(far[0]), L::to_float(far[1]), cells.wy);
        mix::<L>(near, far, cells.wz)
    }
}

/// Offsets in the table, in bytes, of the colours of interpolated samples.
#[inline(always)]
unsafe fn table_offsets<L: Lanes>(job: &BrickJob, sample: L::F) -> I8 {
    // SAFETY: as the caller guarantees for L.
    unsafe {
        let [factor, offset] = job.index_from_sample;
        let index = L::add(L::mul(sample, L::splat(factor)), L::splat(offset));
        let last = L::splat((job.table.len() - 1) as f32);
        // Inside the table, NaN included: `max` gives its second argument then.
        L::row_offsets(L::min(L::max(index, L::splat(0.0)), last))
    }
}

/// Lanes whose nearest sample is not masked.
#[inline(always)]
unsafe fn unmasked<L: Lanes>(mask: &BitMask, places: [L::F; 3], job: &BrickJob) -> L::F {
    // SAFETY: as the caller guarantees for L.
    unsafe {
        let half = L::splat(0.5);
        let [x, y, z] = [L::add(places[0], half), L::add(places[1], half), L::add(places[2], half)];
        let index = sample_index::<L>([L::floor(x), L::floor(y), L::floor(z)], job);
        let mut indices = I8::default();
        L::store_int(L::to_int(index), &mut indices);
        let mut bits = 0;
        for lane in 0..8 {
            bits |= u32::from(!mask.get(indices.0[lane] as usize)) << lane;
        }
        L::mask_of(bits)
    }
}

/// Moves every ray of `alive` on to its next sample in a block that can be seen, or past `end`.
///
/// Around a block at distance `d` from the nearest that can be seen, all blocks up to `d - 1` away are hidden.
#[inline(always)]
unsafe fn skip_hidden<L: Lanes>(
    job: &BrickJob,
    blocks: &[f32],
    rays: &Rays<L>,
    mut k: L::F,
    end: L::F,
    alive: L::F,
) -> L::F {
    let along_edge = job.blocks_along_edge;
    assert!(blocks.len() == along_edge.pow(3), "one distance per block");
    // SAFETY: each coordinate of a block is kept below `along_edge`; the rest as the caller guarantees for L.
    unsafe {
        let last = L::splat((along_edge - 1) as f32);
        let edge = L::splat(BLOCK_EDGE as f32);
        let inverse_edge = L::splat(1.0 / BLOCK_EDGE as f32);
        let row = L::splat(along_edge as f32);
        let (zero, one) = (L::splat(0.0), L::splat(1.0));
        loop {
            let inside = L::and(L::less(k, end), alive);
            let mut block = [zero; 3];
            for (a, block) in block.iter_mut().enumerate() {
                *block = L::min(L::max(L::floor(L::mul(rays.place(a, k), inverse_edge)), zero), last);
            }
            let mut indices = I8::default();
            let index = L::add(block[0], L::mul(row, L::add(block[1], L::mul(row, block[2]))));
            L::store_int(L::to_int(index), &mut indices);
            let distance = L::values(blocks.as_ptr(), &indices);
            let hidden = L::and(inside, L::less(zero, distance));
            if L::bits(hidden) == 0 {
                return k;
            }
            let mut exit = L::splat(f32::INFINITY);
            for (a, block) in block.into_iter().enumerate() {
                let ahead = L::add(block, distance);
                let behind = L::add(L::sub(block, distance), one);
                let plane = L::mul(L::select(L::less(rays.step[a], zero), behind, ahead), edge);
                let way = L::sub(L::add(plane, rays.origin[a]), rays.entry[a]);
                exit = L::min(L::mul(way, rays.inverse_step[a]), exit);
            }
            // A little before the plane, so that rounding never carries a ray past a sample that is seen.
            let before = L::sub(exit, L::splat(0.5 + 1.0 / 64.0));
            let next = L::max(L::add(L::ceil(before), L::splat(0.5)), L::add(k, one));
            k = L::select(hidden, next, k);
        }
    }
}

/// Eight samples that were found, and not yet composited.
struct Look<L: Lanes> {
    cells: Cells<L>,
    edges: [[L::I; 2]; 2],
    /// Lanes that are still before the end of their run.
    in_range: L::F,
    /// Of those, lanes that are not masked.
    shown: L::F,
    table_offsets: I8,
}

/// Samples at `k`; those out of range are read inside the brick, and not used.
#[inline(always)]
unsafe fn look<L: Lanes, const MASKED: bool>(
    job: &BrickJob,
    rays: &Rays<L>,
    k: L::F,
    limit: L::F,
) -> Look<L> {
    // SAFETY: as the caller guarantees for L.
    unsafe {
        let places = [rays.place(0, k), rays.place(1, k), rays.place(2, k)];
        let cells = cells_at::<L>(places, job);
        let in_range = L::less(k, limit);
        let shown = match job.mask {
            Some(mask) if MASKED => L::and(in_range, unmasked::<L>(mask, places, job)),
            _ => in_range,
        };
        let edges = edges::<L>(job, &cells);
        let sample = interpolate::<L>(edges, &cells);
        Look { table_offsets: table_offsets::<L>(job, sample), cells, edges, in_range, shown }
    }
}

/// What the rays of a packet have gathered.
struct Gathered<L: Lanes> {
    color: [L::F; 3],
    transmittance: L::F,
}

/// Puts samples behind what was gathered.
#[inline(always)]
unsafe fn composite<L: Lanes, const LIT: bool>(
    job: &BrickJob,
    rays: &Rays<L>,
    look: &Look<L>,
    alive: L::F,
    gathered: &mut Gathered<L>,
) {
    // SAFETY: `table_offsets` lie inside the table; the rest as the caller guarantees for L.
    unsafe {
        let [r, g, b, alpha] = L::rows(job.table.as_ptr(), &look.table_offsets);
        let weight = L::and(L::and(look.shown, alive), gathered.transmittance);
        let opacity = L::mul(weight, alpha);
        gathered.transmittance = L::sub(gathered.transmittance, opacity);
        let [red, green, blue] = &mut gathered.color;
        match &job.light {
            Some(light) if LIT => {
                if L::bits(L::less(L::splat(0.0), opacity)) == 0 {
                    return;
                }
                let [scattered, highlight] = terms::<L>(job, light, &rays.step, &look.cells, look.edges);
                let (lit, white) = (L::mul(weight, scattered), L::mul(opacity, highlight));
                *red = L::add(*red, L::add(L::mul(lit, r), white));
                *green = L::add(*green, L::add(L::mul(lit, g), white));
                *blue = L::add(*blue, L::add(L::mul(lit, b), white));
            }
            _ => {
                *red = L::add(*red, L::mul(weight, r));
                *green = L::add(*green, L::mul(weight, g));
                *blue = L::add(*blue, L::mul(weight, b));
            }
        }
    }
}

/// Takes samples from `k` on until every ray is at its limit or ends; returns where that is, and their number.
///
/// A sample is looked up while the one before it is composited: the two do not wait for each other.
#[inline(always)]
unsafe fn run<L: Lanes, const LIT: bool, const MASKED: bool>(
    job: &BrickJob,
    rays: &Rays<L>,
    mut k: L::F,
    limit: L::F,
    gathered: &mut Gathered<L>,
) -> (L::F, u64) {
    let mut num_samples = 0;
    // SAFETY: as the caller guarantees for L.
    unsafe {
        let (one, least) = (L::splat(1.0), L::splat(LEAST_TRANSMITTANCE));
        let mut here = look::<L, MASKED>(job, rays, k, limit);
        loop {
            let alive = L::less(least, gathered.transmittance);
            let lanes = L::bits(L::and(here.in_range, alive));
            if lanes == 0 {
                return (k, num_samples);
            }
            num_samples += u64::from(lanes.count_ones());
            k = L::add(k, one);
            let next = look::<L, MASKED>(job, rays, k, limit);
            composite::<L, LIT>(job, rays, &here, alive, gathered);
            here = next;
        }
    }
}

#[inline(always)]
unsafe fn march<L: Lanes, const LIT: bool, const MASKED: bool>(
    job: &BrickJob,
    region: &LevelBox,
    packet: &mut Packet,
) -> u64 {
    let mut num_samples = 0;
    // SAFETY: as the caller guarantees for L.
    unsafe {
        let [first, end] = interval::<L>(region, packet);
        let least = L::splat(LEAST_TRANSMITTANCE);
        let transmittance = L::load(&packet.pixels.transmittance);
        if L::bits(L::and(L::less(first, end), L::less(least, transmittance))) == 0 {
            return 0;
        }
        let rays = Rays::<L>::new(job, region.scale, packet);
        let [r, g, b] = &packet.pixels.color;
        let mut gathered = Gathered::<L> { color: [L::load(r), L::load(g), L::load(b)], transmittance };
        let (mut k, mut limit) = (L::add(first, L::splat(0.5)), end);
        loop {
            let alive = L::less(least, gathered.transmittance);
            if let Some(blocks) = job.blocks {
                k = skip_hidden::<L>(job, blocks, &rays, k, end, alive);
                limit = L::min(L::add(k, L::splat(RUN)), end);
            }
            if L::bits(L::and(L::less(k, end), alive)) == 0 {
                break;
            }
            let taken;
            (k, taken) = run::<L, LIT, MASKED>(job, &rays, k, limit, &mut gathered);
            num_samples += taken;
        }
        for (color, gathered) in packet.pixels.color.iter_mut().zip(gathered.color) {
            L::store(gathered, color);
        }
        L::store(gathered.transmittance, &mut packet.pixels.transmittance);
    }
    num_samples
}
