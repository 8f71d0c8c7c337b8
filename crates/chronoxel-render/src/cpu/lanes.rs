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
    unsafe fn blend(pairs: Self::I, weights: Self::I) -> Self::F;
    /// Offsets in bytes of rows of four numbers, from the rows' numbers cut to whole ones; 0 <= a < 2^27.
    unsafe fn row_offsets(a: Self::F) -> I8;
    /// Rows of a table of four numbers, one array per column.
    unsafe fn rows(table: *const [f32; 4], offsets: &I8) -> [Self::F; 4];
    /// Says that gradients at `gradients + offsets` may be wanted soon.
    unsafe fn prefetch(gradients: *const [i16; 4], offsets: &I8, plane: usize);
    /// Gradients at `gradients + offsets`, interpolated along x, then z, then y.
    unsafe fn gradients(
        gradients: *const [i16; 4],
        offsets: &I8,
        strides: [usize; 2],
        weights: Self::I,
        wy: Self::F,
        wz: Self::F,
    ) -> [Self::F; 4];
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
fn blend_pair([a, b]: [i16; 2], weights: i32) -> f32 {
    (i32::from(a) * i32::from(weights as i16) + i32::from(b) * (weights >> 16)) as f32
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
            unsafe { samples.add(o as usize).cast::<i32>().read_unaligned() }
        }))
    }
    unsafe fn blend(pairs: I8, weights: I8) -> F8 {
        F8(std::array::from_fn(|i| blend_pair([pairs.0[i] as i16, (pairs.0[i] >> 16) as i16], weights.0[i])))
    }
    unsafe fn row_offsets(a: F8) -> I8 {
        I8(a.0.map(|x| (x as i32) << 4))
    }
    unsafe fn rows(table: *const [f32; 4], offsets: &I8) -> [F8; 4] {
        // SAFETY: readable, as the trait demands.
        let rows = offsets.0.map(|o| unsafe { *table.byte_add(o as usize) });
        std::array::from_fn(|c| F8(rows.map(|r| r[c])))
    }
    unsafe fn prefetch(_: *const [i16; 4], _: &I8, _: usize) {}
    unsafe fn gradients(
        gradients: *const [i16; 4],
        offsets: &I8,
        [row, plane]: [usize; 2],
        weights: I8,
        wy: F8,
        wz: F8,
    ) -> [F8; 4] {
        let mut columns = [F8::default(); 4];
        for ray in 0..8 {
            // SAFETY: readable, as the trait demands.
            let at = |offset: usize| unsafe { *gradients.add(offsets.0[ray] as usize + offset) };
            for (c, column) in columns.iter_mut().enumerate() {
                let along_x = |o: usize| blend_pair([at(o)[c], at(o + 1)[c]], weights.0[ray]);
                let along_z = |o: usize| {
                    let (a, b) = (along_x(o), along_x(o + plane));
                    a + (b - a) * wz.0[ray]
                };
                let (a, b) = (along_z(0), along_z(row));
                column.0[ray] = a + (b - a) * wy.0[ray];
            }
        }
        columns
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
            let at = |i: usize| samples.add(offsets[first + i] as usize).cast::<i32>().read_unaligned();
            let v = _mm_cvtsi32_si128(at(0));
            let v = _mm_insert_epi32::<1>(v, at(1));
            let v = _mm_insert_epi32::<2>(v, at(2));
            _mm_insert_epi32::<3>(v, at(3))
        }
    }

    /// The gradients of two rays: four numbers of ray `I` in the lower half, four of ray `I + 4` in the upper.
    ///
    /// * `at`: the first sample of each ray's cell
    /// * `w`, `wy`, `wz`: those of all eight rays
    #[inline(always)]
    unsafe fn two_gradients<const I: i32>(
        at: [*const [i16; 4]; 2],
        [row, plane]: [usize; 2],
        w: __m256i,
        wy: __m256,
        wz: __m256,
    ) -> __m256 {
        // SAFETY: readable, as the trait demands.
        unsafe {
            let order = _mm256_broadcastsi128_si256(_mm_setr_epi8(
                0, 1, 8, 9, 2, 3, 10, 11, 4, 5, 12, 13, 6, 7, 14, 15,
            ));
            // The same number for all four of a ray: `0b_ii_ii_ii_ii` of each half.
            let w = match I {
                0 => _mm256_shuffle_epi32::<0x00>(w),
                1 => _mm256_shuffle_epi32::<0x55>(w),
                2 => _mm256_shuffle_epi32::<0xaa>(w),
                _ => _mm256_shuffle_epi32::<0xff>(w),
            };
            let [wy, wz] = match I {
                0 => [_mm256_permute_ps::<0x00>(wy), _mm256_permute_ps::<0x00>(wz)],
                1 => [_mm256_permute_ps::<0x55>(wy), _mm256_permute_ps::<0x55>(wz)],
                2 => [_mm256_permute_ps::<0xaa>(wy), _mm256_permute_ps::<0xaa>(wz)],
                _ => [_mm256_permute_ps::<0xff>(wy), _mm256_permute_ps::<0xff>(wz)],
            };
            let [lower, upper] = at;
            let along_x = |o: usize| {
                let lower = _mm_loadu_si128(lower.add(o).cast());
                let upper = _mm_loadu_si128(upper.add(o).cast());
                let both = _mm256_shuffle_epi8(_mm256_set_m128i(upper, lower), order);
                _mm256_cvtepi32_ps(_mm256_madd_epi16(both, w))
            };
            let (near, far) = (along_x(0), along_x(plane));
            let a = _mm256_add_ps(near, _mm256_mul_ps(_mm256_sub_ps(far, near), wz));
            let (near, far) = (along_x(row), along_x(plane + row));
            let b = _mm256_add_ps(near, _mm256_mul_ps(_mm256_sub_ps(far, near), wz));
            _mm256_add_ps(a, _mm256_mul_ps(_mm256_sub_ps(b, a), wy))
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
        unsafe fn blend(pairs: __m256i, weights: __m256i) -> __m256 {
            // SAFETY: AVX2 is there.
            unsafe { _mm256_cvtepi32_ps(_mm256_madd_epi16(pairs, weights)) }
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
        #[inline(always)]
        unsafe fn prefetch(gradients: *const [i16; 4], offsets: &I8, plane: usize) {
            // SAFETY: prefetching reads nothing.
            unsafe {
                for i in 0..8 {
                    let at = gradients.offset(offsets.0[i] as isize);
                    _mm_prefetch::<_MM_HINT_T0>(at.cast());
                    _mm_prefetch::<_MM_HINT_T0>(at.wrapping_add(plane).cast());
                }
            }
        }
        #[inline(always)]
        unsafe fn gradients(
            gradients: *const [i16; 4],
            offsets: &I8,
            strides: [usize; 2],
            weights: __m256i,
            wy: __m256,
            wz: __m256,
        ) -> [__m256; 4] {
            // SAFETY: readable, as the trait demands.
            unsafe {
                let at = |i: usize| gradients.offset(offsets.0[i] as isize);
                transpose([
                    two_gradients::<0>([at(0), at(4)], strides, weights, wy, wz),
                    two_gradients::<1>([at(1), at(5)], strides, weights, wy, wz),
                    two_gradients::<2>([at(2), at(6)], strides, weights, wy, wz),
                    two_gradients::<3>([at(3), at(7)], strides, weights, wy, wz),
                ])
            }
        }
    }
}
