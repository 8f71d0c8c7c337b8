//! Eight rays side by side: the operations of the kernel, in plain Rust and in AVX2.
//!
//! Both give the same bits: every operation is an IEEE one on one lane (no fused multiply-add, no approximate
//! reciprocal, nothing across lanes), and interpolation along x is exact integer arithmetic.

/// One number per ray.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(C, align(32))]
pub(super) struct F8(pub [f32; 8]);

/// One whole number per ray.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(C, align(32))]
pub(super) struct I8(pub [i32; 8]);

/// Weights along x are multiples of this fraction of a cell.
pub(super) const WEIGHT_ONE: f32 = 16384.0;

/// Operations on eight lanes. A mask is a number whose bits are all set or all clear in each lane.
///
/// # Safety
/// The methods of an implementation may be called only where the CPU has its instructions, and pointers must be
/// readable at every offset given.
pub(super) unsafe trait Lanes: Copy {
    type F: Copy;
    type I: Copy;
    unsafe fn splat(x: f32) -> Self::F;
    unsafe fn load(x: &F8) -> Self::F;
    unsafe fn store(x: Self::F, to: &mut F8);
    unsafe fn store_int(x: Self::I, to: &mut I8);
    unsafe fn add(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn sub(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn mul(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn div(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn sqrt(a: Self::F) -> Self::F;
    /// `a < b ? a : b`: `b` where either is NaN.
    unsafe fn min(a: Self::F, b: Self::F) -> Self::F;
    /// `a > b ? a : b`: `b` where either is NaN.
    unsafe fn max(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn floor(a: Self::F) -> Self::F;
    unsafe fn ceil(a: Self::F) -> Self::F;
    unsafe fn abs(a: Self::F) -> Self::F;
    /// Mask of `a < b`.
    unsafe fn less(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn and(a: Self::F, b: Self::F) -> Self::F;
    /// `a` where the mask is set, else `b`.
    unsafe fn select(mask: Self::F, a: Self::F, b: Self::F) -> Self::F;
    /// One bit per lane of a mask, lane 0 lowest.
    unsafe fn bits(mask: Self::F) -> u32;
    /// The mask of such bits.
    unsafe fn mask_of(bits: u32) -> Self::F;
    /// Towards zero; |a| < 2^31.
    unsafe fn to_int(a: Self::F) -> Self::I;
    /// The two 16-bit weights `(ONE - w, w)` of a fraction in [0, 1], low half first.
    unsafe fn weights(fraction: Self::F) -> Self::I;
    /// Numbers at `values + indices`.
    unsafe fn values(values: *const f32, indices: &I8) -> Self::F;
    /// Two neighbouring samples per ray, at `samples + offsets`.
    unsafe fn pairs(samples: *const i16, offsets: &I8) -> Self::I;
    /// The weighted sum of each pair.
    unsafe fn sums(pairs: Self::I, weights: Self::I) -> Self::I;
    /// Of four neighbouring samples per ray, at `samples + offsets`: the weighted sum of the last two less that of
    /// the first two.
    unsafe fn slopes(samples: *const i16, offsets: &I8, weights: Self::I) -> Self::I;
    unsafe fn sub_int(a: Self::I, b: Self::I) -> Self::I;
    unsafe fn to_float(a: Self::I) -> Self::F;
    /// Offsets in bytes of rows of four numbers, from the rows' numbers cut to whole ones; 0 <= a < 2^27.
    unsafe fn row_offsets(a: Self::F) -> I8;
    /// Rows of a table of four numbers, one array per column.
    unsafe fn rows(table: *const [f32; 4], offsets: &I8) -> [Self::F; 4];
}

/// Plain Rust.
#[derive(Debug, Clone, Copy)]
pub(super) struct Plain;

#[inline(always)]
fn map(a: F8, f: impl Fn(f32) -> f32) -> F8 {
    F8(a.0.map(f))
}

#[inline(always)]
fn zip(a: F8, b: F8, f: impl Fn(f32, f32) -> f32) -> F8 {
    F8(std::array::from_fn(|i| f(a.0[i], b.0[i])))
}

#[inline(always)]
fn mask_lane(set: bool) -> f32 {
    f32::from_bits(if set { u32::MAX } else { 0 })
}

#[inline(always)]
fn sum_pair([a, b]: [i16; 2], weights: i32) -> i32 {
    i32::from(a) * i32::from(weights as i16) + i32::from(b) * (weights >> 16)
}

// SAFETY: needs no instructions; pointers as the trait says.
unsafe impl Lanes for Plain {
    type F = F8;
    type I = I8;
    unsafe fn splat(x: f32) -> F8 {
        F8([x; 8])
    }
    unsafe fn load(x: &F8) -> F8 {
        *x
    }
    unsafe fn store(x: F8, to: &mut F8) {
        *to = x;
    }
    unsafe fn store_int(x: I8, to: &mut I8) {
        *to = x;
    }
    unsafe fn add(a: F8, b: F8) -> F8 {
        zip(a, b, |a, b| a + b)
    }
    unsafe fn sub(a: F8, b: F8) -> F8 {
        zip(a, b, |a, b| a - b)
    }
    unsafe fn mul(a: F8, b: F8) -> F8 {
        zip(a, b, |a, b| a * b)
    }
    unsafe fn div(a: F8, b: F8) -> F8 {
        zip(a, b, |a, b| a / b)
    }
    unsafe fn sqrt(a: F8) -> F8 {
        map(a, f32::sqrt)
    }
    unsafe fn min(a: F8, b: F8) -> F8 {
        zip(a, b, |a, b| if a < b { a } else { b })
    }
    unsafe fn max(a: F8, b: F8) -> F8 {
        zip(a, b, |a, b| if a > b { a } else { b })
    }
    unsafe fn floor(a: F8) -> F8 {
        map(a, f32::floor)
    }
    unsafe fn ceil(a: F8) -> F8 {
        map(a, f32::ceil)
    }
    unsafe fn abs(a: F8) -> F8 {
        map(a, f32::abs)
    }
    unsafe fn less(a: F8, b: F8) -> F8 {
        zip(a, b, |a, b| mask_lane(a < b))
    }
    unsafe fn and(a: F8, b: F8) -> F8 {
        zip(a, b, |a, b| f32::from_bits(a.to_bits() & b.to_bits()))
    }
    unsafe fn select(mask: F8, a: F8, b: F8) -> F8 {
        F8(std::array::from_fn(|i| if mask.0[i].to_bits() >> 31 == 1 { a.0[i] } else { b.0[i] }))
    }
    unsafe fn bits(mask: F8) -> u32 {
        (0..8).map(|i| (mask.0[i].to_bits() >> 31) << i).sum()
    }
    unsafe fn mask_of(bits: u32) -> F8 {
        F8(std::array::from_fn(|i| mask_lane(bits >> i & 1 == 1)))
    }
    unsafe fn to_int(a: F8) -> I8 {
        I8(a.0.map(|x| x as i32))
    }
    unsafe fn weights(fraction: F8) -> I8 {
        I8(fraction.0.map(|f| {
            let w = (f * WEIGHT_ONE + 0.5) as i32;
            (w << 16) + (WEIGHT_ONE as i32 - w)
        }))
    }
    unsafe fn values(values: *const f32, indices: &I8) -> F8 {
        // SAFETY: readable, as the trait demands.
        F8(indices.0.map(|i| unsafe { *values.add(i as usize) }))
    }
    unsafe fn pairs(samples: *const i16, offsets: &I8) -> I8 {
        I8(offsets.0.map(|o| {
            // SAFETY: readable, as the trait demands.
            unsafe { samples.wrapping_offset(o as isize).cast::<i32>().read_unaligned() }
        }))
    }
    unsafe fn sums(pairs: I8, weights: I8) -> I8 {
        let pair = |i: usize| [pairs.0[i] as i16, (pairs.0[i] >> 16) as i16];
        I8(std::array::from_fn(|i| sum_pair(pair(i), weights.0[i])))
    }
    unsafe fn slopes(samples: *const i16, offsets: &I8, weights: I8) -> I8 {
        I8(std::array::from_fn(|i| {
            let four = samples.wrapping_offset(offsets.0[i] as isize).cast::<[i16; 4]>();
            // SAFETY: readable, as the trait demands.
            let [a, b, c, d] = unsafe { four.read_unaligned() };
            sum_pair([c, d], weights.0[i]) - sum_pair([a, b], weights.0[i])
        }))
    }
    unsafe fn sub_int(a: I8, b: I8) -> I8 {
        I8(std::array::from_fn(|i| a.0[i] - b.0[i]))
    }
    unsafe fn to_float(a: I8) -> F8 {
        F8(a.0.map(|a| a as f32))
    }
    unsafe fn row_offsets(a: F8) -> I8 {
        I8(a.0.map(|x| (x as i32) << 4))
    }
    unsafe fn rows(table: *const [f32; 4], offsets: &I8) -> [F8; 4] {
        // SAFETY: readable, as the trait demands.
        let rows = offsets.0.map(|o| unsafe { *table.byte_add(o as usize) });
        std::array::from_fn(|c| F8(rows.map(|r| r[c])))
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) use avx2::Avx2;

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use super::{F8, I8, Lanes, WEIGHT_ONE};
    use std::arch::x86_64::*;

    /// AVX2 of x86-64.
    #[derive(Debug, Clone, Copy)]
    pub(in super::super) struct Avx2;

    /// Columns of eight rows of four, two rows per register: rows `i` and `i + 4` in `rows[i]`.
    #[inline(always)]
    unsafe fn transpose(rows: [__m256; 4]) -> [__m256; 4] {
        // SAFETY: AVX2 is there, as for every method below.
        unsafe {
            let t0 = _mm256_unpacklo_ps(rows[0], rows[1]);
            let t1 = _mm256_unpackhi_ps(rows[0], rows[1]);
            let t2 = _mm256_unpacklo_ps(rows[2], rows[3]);
            let t3 = _mm256_unpackhi_ps(rows[2], rows[3]);
            [
                _mm256_shuffle_ps::<0x44>(t0, t2),
                _mm256_shuffle_ps::<0xee>(t0, t2),
                _mm256_shuffle_ps::<0x44>(t1, t3),
                _mm256_shuffle_ps::<0xee>(t1, t3),
            ]
        }
    }

    #[inline(always)]
    unsafe fn quad(samples: *const i16, offsets: &[i32; 8], first: usize) -> __m128i {
        // SAFETY: readable, as the trait demands.
        unsafe {
            let sample = |i: usize| samples.wrapping_offset(offsets[first + i] as isize);
            let at = |i: usize| sample(i).cast::<i32>().read_unaligned();
            let v = _mm_cvtsi32_si128(at(0));
            let v = _mm_insert_epi32::<1>(v, at(1));
            let v = _mm_insert_epi32::<2>(v, at(2));
            _mm_insert_epi32::<3>(v, at(3))
        }
    }

    /// Four neighbouring samples of each of four rays: `first`, `first + 1`, `first + 4` and `first + 5`.
    #[inline(always)]
    unsafe fn fours(samples: *const i16, offsets: &[i32; 8], first: usize) -> __m256i {
        // SAFETY: readable, as the trait demands.
        unsafe {
            let at = |i: usize| samples.wrapping_offset(offsets[i] as isize).cast::<f64>();
            let two = |i: usize| _mm_castpd_si128(_mm_loadh_pd(_mm_load_sd(at(i)), at(i + 1)));
            _mm256_set_m128i(two(first + 4), two(first))
        }
    }

    macro_rules! lanewise {
        ($($name:ident($($arg:ident),+) = $intrinsic:expr;)+) => {
            $(#[inline(always)]
            unsafe fn $name($($arg: __m256),+) -> __m256 {
                // SAFETY: AVX2 is there, as the trait demands.
                unsafe { $intrinsic }
            })+
        };
    }

    // SAFETY: used only after AVX2 was detected; pointers as the trait says.
    unsafe impl Lanes for Avx2 {
        type F = __m256;
        type I = __m256i;

        lanewise! {
            add(a, b) = _mm256_add_ps(a, b);
            sub(a, b) = _mm256_sub_ps(a, b);
            mul(a, b) = _mm256_mul_ps(a, b);
            div(a, b) = _mm256_div_ps(a, b);
            sqrt(a) = _mm256_sqrt_ps(a);
            min(a, b) = _mm256_min_ps(a, b);
            max(a, b) = _mm256_max_ps(a, b);
            floor(a) = _mm256_floor_ps(a);
            ceil(a) = _mm256_ceil_ps(a);
            abs(a) = _mm256_andnot_ps(_mm256_set1_ps(-0.0), a);
            less(a, b) = _mm256_cmp_ps::<_CMP_LT_OQ>(a, b);
            and(a, b) = _mm256_and_ps(a, b);
            select(mask, a, b) = _mm256_blendv_ps(b, a, mask);
        }

        #[inline(always)]
        unsafe fn splat(x: f32) -> __m256 {
            // SAFETY: AVX2 is there.
            unsafe { _mm256_set1_ps(x) }
        }
        #[inline(always)]
        unsafe fn load(x: &F8) -> __m256 {
            // SAFETY: eight numbers, aligned to 32 bytes.
            unsafe { _mm256_load_ps(x.0.as_ptr()) }
        }
        #[inline(always)]
        unsafe fn store(x: __m256, to: &mut F8) {
            // SAFETY: eight numbers, aligned to 32 bytes.
            unsafe { _mm256_store_ps(to.0.as_mut_ptr(), x) }
        }
        #[inline(always)]
        unsafe fn store_int(x: __m256i, to: &mut I8) {
            // SAFETY: eight numbers, aligned to 32 bytes.
            unsafe { _mm256_store_si256(to.0.as_mut_ptr().cast(), x) }
        }
        #[inline(always)]
        unsafe fn bits(mask: __m256) -> u32 {
            // SAFETY: AVX2 is there.
            unsafe { _mm256_movemask_ps(mask) as u32 }
        }
        #[inline(always)]
        unsafe fn mask_of(bits: u32) -> __m256 {
            // SAFETY: AVX2 is there.
            unsafe {
                let lane = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
                let set = _mm256_and_si256(_mm256_set1_epi32(bits as i32), lane);
                _mm256_castsi256_ps(_mm256_cmpeq_epi32(set, lane))
            }
        }
        #[inline(always)]
        unsafe fn to_int(a: __m256) -> __m256i {
            // SAFETY: AVX2 is there.
            unsafe { _mm256_cvttps_epi32(a) }
        }
        #[inline(always)]
        unsafe fn weights(fraction: __m256) -> __m256i {
            // SAFETY: AVX2 is there.
            unsafe {
                let scaled = _mm256_mul_ps(fraction, _mm256_set1_ps(WEIGHT_ONE));
                let w = _mm256_cvttps_epi32(_mm256_add_ps(scaled, _mm256_set1_ps(0.5)));
                let rest = _mm256_sub_epi32(_mm256_set1_epi32(WEIGHT_ONE as i32), w);
                _mm256_add_epi32(_mm256_slli_epi32::<16>(w), rest)
            }
        }
        #[inline(always)]
        unsafe fn values(values: *const f32, indices: &I8) -> __m256 {
            // SAFETY: readable, as the trait demands.
            unsafe {
                let at = |i: usize| *values.add(indices.0[i] as usize);
                _mm256_setr_ps(at(0), at(1), at(2), at(3), at(4), at(5), at(6), at(7))
            }
        }
        #[inline(always)]
        unsafe fn pairs(samples: *const i16, offsets: &I8) -> __m256i {
            // SAFETY: readable, as the trait demands.
            unsafe { _mm256_set_m128i(quad(samples, &offsets.0, 4), quad(samples, &offsets.0, 0)) }
        }
        #[inline(always)]
        unsafe fn sums(pairs: __m256i, weights: __m256i) -> __m256i {
            // SAFETY: AVX2 is there.
            unsafe { _mm256_madd_epi16(pairs, weights) }
        }
        #[inline(always)]
        unsafe fn slopes(samples: *const i16, offsets: &I8, weights: __m256i) -> __m256i {
            // SAFETY: readable, as the trait demands.
            unsafe {
                let negative = _mm256_sub_epi16(_mm256_setzero_si256(), weights);
                let weights =
                    [_mm256_unpacklo_epi32(negative, weights), _mm256_unpackhi_epi32(negative, weights)];
                let sums = |i: usize| {
                    let four = fours(samples, &offsets.0, 2 * i);
                    _mm256_castsi256_ps(_mm256_madd_epi16(four, weights[i]))
                };
                let (a, b) = (sums(0), sums(1));
                // The sums of the first two and of the last two, in the order of the rays.
                let first = _mm256_castps_si256(_mm256_shuffle_ps::<0x88>(a, b));
                let last = _mm256_castps_si256(_mm256_shuffle_ps::<0xdd>(a, b));
                _mm256_add_epi32(first, last)
            }
        }
        #[inline(always)]
        unsafe fn sub_int(a: __m256i, b: __m256i) -> __m256i {
            // SAFETY: AVX2 is there.
            unsafe { _mm256_sub_epi32(a, b) }
        }
        #[inline(always)]
        unsafe fn to_float(a: __m256i) -> __m256 {
            // SAFETY: AVX2 is there.
            unsafe { _mm256_cvtepi32_ps(a) }
        }
        #[inline(always)]
        unsafe fn row_offsets(a: __m256) -> I8 {
            let mut offsets = I8::default();
            // SAFETY: AVX2 is there.
            unsafe { Self::store_int(_mm256_slli_epi32::<4>(_mm256_cvttps_epi32(a)), &mut offsets) };
            offsets
        }
        #[inline(always)]
        unsafe fn rows(table: *const [f32; 4], offsets: &I8) -> [__m256; 4] {
            // SAFETY: readable, as the trait demands.
            unsafe {
                let row = |i: usize| _mm_loadu_ps(table.byte_add(offsets.0[i] as usize).cast());
                transpose([
                    _mm256_set_m128(row(4), row(0)),
                    _mm256_set_m128(row(5), row(1)),
                    _mm256_set_m128(row(6), row(2)),
                    _mm256_set_m128(row(7), row(3)),
                ])
            }
        }
    }
}
