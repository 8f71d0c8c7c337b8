//! A tile of the picture: faces are put over it in about the right order, and each pixel puts them into the right one.
//!
//! A pixel holds up to `K` fragments sorted by depth. A new one goes through them by compare and swap, and the nearest
//! of all leaves; with the one that left before, it bounds a segment. Places without a fragment lie infinitely near, so
//! that a lane with no new fragment takes part with one of those, and nothing moves.

use super::lanes::{Eight, Wide};
use super::table::{LAST_NODE, NO_VALUE, NUM_LENGTHS};

/// Columns of a tile.
pub(super) const TILE_WIDTH: usize = 32;
/// Rows of a tile.
pub(super) const TILE_HEIGHT: usize = 16;
/// Columns and rows of a block: the eight lanes.
const BLOCK: [usize; 2] = [4, 2];
const BLOCKS_ACROSS: usize = TILE_WIDTH / BLOCK[0];
const BLOCKS_DOWN: usize = TILE_HEIGHT / BLOCK[1];

/// A ray ends where less than this much of what lies behind would be seen: half a level of 8 bits.
pub(crate) const LEAST_TRANSMITTANCE: f32 = 1.0 / 512.0;

/// Lowest bits of a payload: the number of tetrahedra that a ray enters with the face, less those it leaves, signed.
const NET_BITS: i32 = 4;

/// A corner of a face.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(16))]
pub(super) struct Corner {
    pub x: f32,
    pub y: f32,
    /// Depth; in a perspective, its inverse.
    pub w: f32,
    /// The value as an index of the table, not rounded; NaN where there is none.
    pub value: f32,
}

/// What all faces of a picture share.
#[derive(Debug, Clone, Copy)]
pub(super) struct Look<'a> {
    pub is_perspective: bool,
    /// See [`super::CellTable`].
    pub table: &'a [[f32; 4]],
    /// Two over the longest segment.
    pub per_half_longest: f32,
    /// For each sum of two cosines of 8 bits: the factor of the colour, and the highlight.
    pub light: Option<&'a [[f32; 4]]>,
}

/// The lengths, in half the longest one, between which layers are told apart.
pub(crate) const LEAST_PART: f32 = 2.0 / (1 << (2 * NUM_LENGTHS)) as f32;
pub(crate) const MOST_PART: f32 = 2.0 - 2.0 * f32::EPSILON;

/// Eight pixels.
#[derive(Clone)]
#[repr(C, align(32))]
struct Block<const K: usize> {
    depths: [Eight; K],
    payloads: [Eight; K],
    last_depth: Eight,
    last_payload: Eight,
    /// Tetrahedra that the rays are in.
    inside: Eight,
    color: [Eight; 3],
    transmittance: Eight,
    /// Length along the ray for each unit of depth.
    per_depth: Eight,
}

const NOWHERE: Eight = Eight::splat(f32::NEG_INFINITY);
const ZERO: Eight = Eight::splat(0.0);

impl<const K: usize> Block<K> {
    const EMPTY: Self = Self {
        depths: [NOWHERE; K],
        payloads: [ZERO; K],
        last_depth: NOWHERE,
        last_payload: ZERO,
        inside: ZERO,
        color: [ZERO; 3],
        transmittance: Eight::splat(1.0),
        per_depth: Eight::splat(1.0),
    };

    /// The mask of rays that have ended: each for itself, so that pictures do not depend on which pixels lie side by side.
    ///
    /// # Safety
    /// The CPU has the instructions of `W`.
    #[inline(always)]
    unsafe fn ended<W: Wide>(&self) -> W::V {
        // SAFETY: as this function.
        unsafe { W::less(W::load(&self.transmittance), W::splat(LEAST_TRANSMITTANCE)) }
    }
}

/// What was counted while a tile was drawn.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct TileCounts {
    pub fragments: u64,
    pub misordered: u64,
}

/// A tile on which faces are drawn.
pub(super) struct Tile<const K: usize> {
    blocks: Vec<Block<K>>,
    is_done: [bool; BLOCKS_ACROSS * BLOCKS_DOWN],
    corner: [f32; 2],
    pub counts: TileCounts,
}

impl<const K: usize> Tile<K> {
    pub fn new() -> Self {
        let num_blocks = BLOCKS_ACROSS * BLOCKS_DOWN;
        Self {
            blocks: vec![Block::EMPTY; num_blocks],
            is_done: [false; BLOCKS_ACROSS * BLOCKS_DOWN],
            corner: [0.0; 2],
            counts: TileCounts::default(),
        }
    }

    /// An empty tile with its first pixel at a place of the picture.
    ///
    /// * `per_depth`: length along the ray of a pixel for each unit of depth
    pub fn begin(&mut self, corner: [usize; 2], per_depth: impl Fn([usize; 2]) -> f32) {
        self.corner = corner.map(|c| c as f32);
        self.counts = TileCounts::default();
        self.is_done.fill(false);
        for (number, block) in self.blocks.iter_mut().enumerate() {
            *block = Block::EMPTY;
            let lanes = std::array::from_fn(|lane| {
                let [x, y] = place(number, lane);
                per_depth([corner[0] + x, corner[1] + y])
            });
            block.per_depth = Eight::of(lanes);
        }
    }

    /// Whether nothing that is behind would be seen.
    pub fn is_done(&self) -> bool {
        self.is_done.iter().all(|done| *done)
    }

    /// Premultiplied colour and opacity, row by row; what was not flushed is missing.
    pub fn pixels(&self) -> Vec<[f32; 4]> {
        let mut pixels = vec![[0.0; 4]; TILE_WIDTH * TILE_HEIGHT];
        for (number, block) in self.blocks.iter().enumerate() {
            for lane in 0..8 {
                let [x, y] = place(number, lane);
                let [r, g, b] = [0, 1, 2].map(|c| block.color[c].get(lane));
                pixels[y * TILE_WIDTH + x] = [r, g, b, 1.0 - block.transmittance.get(lane)];
            }
        }
        pixels
    }

    /// Puts a face over the tile.
    ///
    /// * `corners`: by the rising numbers of their points
    /// * `cosines`: those between gradient and ray at the corners
    ///
    /// # Safety
    /// The CPU has the instructions of `W`.
    #[inline(always)]
    pub unsafe fn draw<W: Wide>(&mut self, look: &Look, corners: [Corner; 3], net: i32, cosines: [f32; 3]) {
        let Some([columns, rows]) = self.blocks_of(&corners) else { return };
        let Some(setup) = Setup::new(look, corners, net, cosines) else { return };
        // SAFETY: as this function.
        unsafe {
            let steps_x = W::load(&Eight::of([0.5, 1.5, 2.5, 3.5, 0.5, 1.5, 2.5, 3.5]));
            let steps_y = W::load(&Eight::of([0.5, 0.5, 0.5, 0.5, 1.5, 1.5, 1.5, 1.5]));
            let edges = Edges::<W>::new(&setup);
            for row in rows[0]..=rows[1] {
                let y = self.corner[1] + (row * BLOCK[1]) as f32;
                let along = edges.row(W::add(W::splat(y), steps_y));
                for column in columns[0]..=columns[1] {
                    let number = row * BLOCKS_ACROSS + column;
                    if self.is_done[number] {
                        continue;
                    }
                    let x = self.corner[0] + (column * BLOCK[0]) as f32;
                    let (outside, [ab, ac]) = edges.at(&along, W::add(W::splat(x), steps_x));
                    let outside = W::or(outside, self.blocks[number].ended::<W>());
                    let covered = !W::bits(outside) & 255;
                    if covered == 0 {
                        continue;
                    }
                    let (depth, payload) = setup.fragments::<W>(look, ab, ac);
                    let depth = W::select(outside, W::splat(f32::NEG_INFINITY), depth);
                    let payload = W::select(outside, W::splat(0.0), payload);
                    let block = &mut self.blocks[number];
                    let (depth, payload) = insert::<W, K>(block, depth, payload);
                    let (misordered, is_done) = advance::<W, K>(look, block, depth, payload);
                    self.is_done[number] = is_done;
                    self.counts.fragments += u64::from(covered.count_ones());
                    self.counts.misordered += u64::from(misordered.count_ones());
                }
            }
        }
    }

    /// Takes what the pixels still hold, once all faces are drawn.
    ///
    /// # Safety
    /// The CPU has the instructions of `W`.
    #[inline(always)]
    pub unsafe fn flush<W: Wide>(&mut self, look: &Look) {
        for (block, is_done) in self.blocks.iter_mut().zip(&self.is_done) {
            for i in 0..K {
                if !is_done {
                    // SAFETY: as this function.
                    unsafe {
                        let ended = block.ended::<W>();
                        let nowhere = W::splat(f32::NEG_INFINITY);
                        let depth = W::select(ended, nowhere, W::load(&block.depths[i]));
                        let payload = W::select(ended, W::splat(0.0), W::load(&block.payloads[i]));
                        let (misordered, _) = advance::<W, K>(look, block, depth, payload);
                        self.counts.misordered += u64::from(misordered.count_ones());
                    }
                }
            }
        }
    }

    /// First and last column and row of the blocks in the box of a face.
    #[inline(always)]
    fn blocks_of(&self, [a, b, c]: &[Corner; 3]) -> Option<[[usize; 2]; 2]> {
        let range = |a: f32, b: f32, c: f32, corner: f32, len: usize, block: usize| {
            let low = a.min(b).min(c) - corner;
            let high = a.max(b).max(c) - corner;
            // The first centre is half a pixel in.
            let first = (low - 0.5).max(0.0).ceil();
            let last = (high - 0.5).min((len - 1) as f32).floor();
            (first <= last).then_some([first as usize / block, last as usize / block])
        };
        let columns = range(a.x, b.x, c.x, self.corner[0], TILE_WIDTH, BLOCK[0])?;
        let rows = range(a.y, b.y, c.y, self.corner[1], TILE_HEIGHT, BLOCK[1])?;
        Some([columns, rows])
    }
}

/// Column and row in the tile of a lane of a block.
fn place(number: usize, lane: usize) -> [usize; 2] {
    let [column, row] = [number % BLOCKS_ACROSS, number / BLOCKS_ACROSS];
    [column * BLOCK[0] + lane % BLOCK[0], row * BLOCK[1] + lane / BLOCK[0]]
}

/// A face as its pixels need it.
struct Setup {
    corners: [Corner; 3],
    /// Whether the normal points away from the camera.
    is_away: bool,
    /// Depth, value and cosine at the first corner, and their changes with the edge functions `ab` and `ac`.
    depth: [f32; 3],
    value: [f32; 3],
    cosine: [f32; 3],
    /// Ranges of depth (or its inverse) and value.
    depths: [f32; 2],
    values: [f32; 2],
    /// Payload bits that are the same all over the face.
    fixed: i32,
    has_value: bool,
}

impl Setup {
    /// `None` where the face is seen from its edge.
    #[inline(always)]
    fn new(look: &Look, corners: [Corner; 3], net: i32, cosines: [f32; 3]) -> Option<Self> {
        let [a, b, c] = corners;
        let [abx, aby, acx, acy] = [b.x - a.x, b.y - a.y, c.x - a.x, c.y - a.y].map(f64::from);
        // Twice the area; rows run downwards.
        let area = abx * acy - aby * acx;
        if area == 0.0 || area.is_nan() {
            return None;
        }
        let per_area = (1.0 / area) as f32;
        let linear = |[a, b, c]: [f32; 3]| [a, (c - a) * per_area, (a - b) * per_area];
        let range = |a: f32, b: f32, c: f32| [a.min(b).min(c), a.max(b).max(c)];
        let weighted = |corner: &Corner, x: f32| if look.is_perspective { x * corner.w } else { x };
        let over = |x: [f32; 3]| linear([0, 1, 2].map(|i| weighted(&corners[i], x[i])));
        let values = corners.map(|corner| corner.value);
        let has_value = !(values[0] + values[1] + values[2]).is_nan();
        let is_away = area > 0.0;
        let net = if is_away { net } else { -net };
        let missing = if has_value { 0 } else { NO_VALUE << 24 };
        let [low, high] = range(a.value, b.value, c.value);
        let clamp = |x: f32| x.clamp(0.0, LAST_NODE as f32);
        Some(Self {
            corners,
            is_away,
            depth: linear(corners.map(|corner| corner.w)),
            value: over(values),
            cosine: over(cosines),
            depths: range(a.w, b.w, c.w),
            values: [clamp(low), clamp(high)],
            fixed: (missing | (net as u32 & ((1 << NET_BITS) - 1))) as i32,
            has_value,
        })
    }

    /// Depths and payloads of eight pixels, from their edge functions.
    #[inline(always)]
    unsafe fn fragments<W: Wide>(&self, look: &Look, ab: W::V, ac: W::V) -> (W::V, W::V) {
        // SAFETY: the CPU has the instructions of `W`, by the callers.
        unsafe {
            let at = |[a, by_ab, by_ac]: [f32; 3]| {
                W::add(W::splat(a), W::add(W::mul(ab, W::splat(by_ab)), W::mul(ac, W::splat(by_ac))))
            };
            let between = |x, [low, high]: [f32; 2]| W::min(W::max(x, W::splat(low)), W::splat(high));
            let w = between(at(self.depth), self.depths);
            let depth = if look.is_perspective { W::div(W::splat(1.0), w) } else { w };
            let straight = |x| if look.is_perspective { W::mul(x, depth) } else { x };
            let mut payload = W::splat_int(self.fixed);
            if self.has_value {
                let value = between(straight(at(self.value)), self.values);
                let index = W::to_int(W::add(value, W::splat(0.5)));
                payload = W::or(payload, W::shift_left::<24>(index));
            }
            if look.light.is_some() {
                let cosine = straight(at(self.cosine));
                let size = W::min(W::max(cosine, W::sub(W::splat(0.0), cosine)), W::splat(1.0));
                let byte = W::to_int(W::add(W::mul(size, W::splat(255.0)), W::splat(0.5)));
                payload = W::or(payload, W::shift_left::<16>(byte));
            }
            (depth, payload)
        }
    }
}

/// The edge functions of a face: `ab`, `bc` and `ac`, each from its end of the lower number.
///
/// Both faces at an edge compute the same bits for it, so that a pixel lies on one side of it for both.
struct Edges<W: Wide> {
    a: [W::V; 2],
    b: [W::V; 2],
    ab: [W::V; 2],
    bc: [W::V; 2],
    ac: [W::V; 2],
    sign: W::V,
    other_sign: W::V,
}

impl<W: Wide> Edges<W> {
    #[inline(always)]
    unsafe fn new(setup: &Setup) -> Self {
        let [a, b, c] = &setup.corners;
        // SAFETY: the CPU has the instructions of `W`, by the callers.
        unsafe {
            let along = |a: &Corner, b: &Corner| [W::splat(b.x - a.x), W::splat(b.y - a.y)];
            let (set, clear) = (W::splat_int(i32::MIN), W::splat_int(0));
            Self {
                a: [W::splat(a.x), W::splat(a.y)],
                b: [W::splat(b.x), W::splat(b.y)],
                ab: along(a, b),
                bc: along(b, c),
                ac: along(a, c),
                sign: if setup.is_away { clear } else { set },
                other_sign: if setup.is_away { set } else { clear },
            }
        }
    }

    /// The parts of the edge functions that a row has in common.
    #[inline(always)]
    unsafe fn row(&self, y: W::V) -> [W::V; 3] {
        // SAFETY: as above.
        unsafe {
            let (from_a, from_b) = (W::sub(y, self.a[1]), W::sub(y, self.b[1]));
            [W::mul(self.ab[0], from_a), W::mul(self.bc[0], from_b), W::mul(self.ac[0], from_a)]
        }
    }

    /// The mask of what is outside, and the edge functions `ab` and `ac`.
    #[inline(always)]
    unsafe fn at(&self, row: &[W::V; 3], x: W::V) -> (W::V, [W::V; 2]) {
        // SAFETY: as above.
        unsafe {
            let (from_a, from_b) = (W::sub(x, self.a[0]), W::sub(x, self.b[0]));
            let ab = W::sub(row[0], W::mul(self.ab[1], from_a));
            let bc = W::sub(row[1], W::mul(self.bc[1], from_b));
            let ac = W::sub(row[2], W::mul(self.ac[1], from_a));
            let outside =
                W::or(W::or(W::xor(ab, self.sign), W::xor(bc, self.sign)), W::xor(ac, self.other_sign));
            // The sign alone counts: the rest may be any bits, NaN among them.
            (W::shift_right_signed::<31>(outside), [ab, ac])
        }
    }
}

/// Puts fragments among those of a block, and takes out the nearest.
#[inline(always)]
unsafe fn insert<W: Wide, const K: usize>(
    block: &mut Block<K>,
    mut depth: W::V,
    mut payload: W::V,
) -> (W::V, W::V) {
    // SAFETY: the CPU has the instructions of `W`, by the callers.
    unsafe {
        let mut out = None;
        for i in 0..K {
            let (held, held_payload) = (W::load(&block.depths[i]), W::load(&block.payloads[i]));
            let is_nearer = W::less(depth, held);
            let near = (W::min(depth, held), W::select(is_nearer, payload, held_payload));
            depth = W::max(depth, held);
            payload = W::select(is_nearer, held_payload, payload);
            match i {
                0 => out = Some(near),
                _ => {
                    W::store(near.0, &mut block.depths[i - 1]);
                    W::store(near.1, &mut block.payloads[i - 1]);
                }
            }
        }
        W::store(depth, &mut block.depths[K - 1]);
        W::store(payload, &mut block.payloads[K - 1]);
        out.expect("there is room for at least one")
    }
}

/// Takes the next fragments of the rays of a block; returns which came too late, and whether all rays have ended.
#[inline(always)]
unsafe fn advance<W: Wide, const K: usize>(
    look: &Look,
    block: &mut Block<K>,
    depth: W::V,
    payload: W::V,
) -> (u32, bool) {
    // SAFETY: the CPU has the instructions of `W`, by the callers; entries lie in the table, see below.
    unsafe {
        let last_depth = W::load(&block.last_depth);
        let last_payload = W::load(&block.last_payload);
        let inside = W::load(&block.inside);
        let zero = W::splat(0.0);
        let is_behind = W::less(last_depth, depth);
        let is_fragment = W::less(W::splat(f32::NEG_INFINITY), depth);
        let misordered = W::bits(W::and(is_fragment, W::less(depth, last_depth)));
        let is_segment = W::and(is_behind, W::greater_int(inside, zero));
        let mut is_done = false;
        if W::bits(is_segment) != 0 {
            let way = W::mul(W::sub(depth, last_depth), W::load(&block.per_depth));
            // Where there is no segment the depth may be infinite.
            let length = W::select(is_segment, way, zero);
            // A layer for each power of 4 below the longest, found by the exponent.
            let part = W::mul(length, W::splat(look.per_half_longest));
            let part = W::min(W::max(part, W::splat(LEAST_PART)), W::splat(MOST_PART));
            let exponent = W::shift_right::<24>(part);
            let layer = W::sub_int(exponent, W::splat_int((LEAST_PART.to_bits() >> 24) as i32));
            // Payloads begin with an index below 256, and there are as many layers as the clamped exponents.
            let pair =
                W::or(W::shift_left::<8>(W::shift_right::<24>(last_payload)), W::shift_right::<24>(payload));
            let entry = W::or(W::shift_left::<16>(layer), pair);
            let [r, g, b, extinction] = W::rows(look.table.as_ptr(), entry);
            let alpha = opacity::<W>(W::mul(length, extinction));
            let transmittance = W::load(&block.transmittance);
            let weight = W::mul(transmittance, alpha);
            let mut color = [r, g, b];
            if let Some(light) = look.light {
                let cosine = |p| W::and(W::shift_right::<16>(p), W::splat_int(255));
                let sum = W::add_int(cosine(last_payload), cosine(payload));
                let [scattered, highlight, ..] = W::rows(light.as_ptr(), sum);
                color = color.map(|c| W::add(W::mul(c, scattered), highlight));
            }
            for (sum, c) in block.color.iter_mut().zip(color) {
                let total = W::add(W::load(sum), W::mul(c, weight));
                W::store(total, sum);
            }
            let left = W::sub(transmittance, weight);
            W::store(left, &mut block.transmittance);
            is_done = W::bits(W::less(left, W::splat(LEAST_TRANSMITTANCE))) == 255;
        }
        const UNUSED: i32 = 32 - NET_BITS;
        // Where there is no fragment the payload is 0, in which no tetrahedra are entered.
        let net = shift_net::<W, UNUSED>(payload);
        W::store(W::add_int(inside, net), &mut block.inside);
        W::store(W::max(depth, last_depth), &mut block.last_depth);
        W::store(W::select(is_behind, payload, last_payload), &mut block.last_payload);
        (misordered, is_done)
    }
}

/// The signed number in the lowest bits.
#[inline(always)]
unsafe fn shift_net<W: Wide, const UNUSED: i32>(payload: W::V) -> W::V {
    // SAFETY: the CPU has the instructions of `W`, by the callers.
    unsafe { W::shift_right_signed::<UNUSED>(W::shift_left::<UNUSED>(payload)) }
}

/// `1 - 2^-x`, relatively exact to 2e-6, for `x >= 0`.
#[inline(always)]
unsafe fn opacity<W: Wide>(x: W::V) -> W::V {
    // Of `(1 - 2^-f) / f`, by the series of the exponential: powers of the logarithm of 2 over factorials.
    const SERIES: [f32; 7] = [
        std::f32::consts::LN_2,
        -0.240_226_5,
        0.055_504_11,
        -0.009_618_129,
        0.001_333_355_8,
        -0.000_154_035_3,
        0.000_015_252_7,
    ];
    // SAFETY: the CPU has the instructions of `W`, by the callers.
    unsafe {
        let x = W::min(x, W::splat(126.0));
        let whole = W::to_int(x);
        let f = W::sub(x, W::to_float(whole));
        // Pairs of terms, so that few additions wait for each other.
        let pair = |i: usize| W::add(W::splat(SERIES[i]), W::mul(f, W::splat(SERIES[i + 1])));
        let square = W::mul(f, f);
        let low = W::add(pair(0), W::mul(square, pair(2)));
        let high = W::add(pair(4), W::mul(square, W::splat(SERIES[6])));
        let of_fraction = W::mul(f, W::add(low, W::mul(W::mul(square, square), high)));
        let power = W::shift_left::<23>(W::sub_int(W::splat_int(127), whole));
        W::add(W::sub(W::splat(1.0), power), W::mul(power, of_fraction))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cells::lanes::Plain;

    #[test]
    fn opacities_are_those_of_the_exponential() {
        for x in [0.0f32, 1e-7, 1e-3, 0.3, 0.999, 1.0, 1.7, 12.3, 126.0, 1e9] {
            // SAFETY: plain Rust runs everywhere.
            let found = unsafe { opacity::<Plain>(Eight::splat(x)) }.get(3);
            let expected = -(-f64::from(x) * std::f64::consts::LN_2).exp_m1();
            assert!((f64::from(found) - expected).abs() <= 3e-6 * expected, "{x}: {found} {expected}");
        }
    }

    #[test]
    fn fragments_leave_by_depth() {
        let mut block = Block::<3>::EMPTY;
        let mut left = Vec::new();
        for depth in [5.0, 1.0, 3.0, 2.0, 9.0, 7.0] {
            let payload = Eight([depth as u32; 8]);
            // SAFETY: plain Rust runs everywhere.
            let (d, p) = unsafe { insert::<Plain, 3>(&mut block, Eight::splat(depth), payload) };
            left.push((d.get(0), p.0[0]));
        }
        let nowhere = (f32::NEG_INFINITY, 0);
        assert_eq!(left, [nowhere, nowhere, nowhere, (1.0, 1), (2.0, 2), (3.0, 3)]);
        assert_eq!(block.depths.map(|d| d.get(7)), [5.0, 7.0, 9.0]);
    }
}
