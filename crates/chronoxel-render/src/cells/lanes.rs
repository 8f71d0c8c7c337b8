//! Eight pixels side by side: the operations of the rasteriser, in plain Rust and in AVX2.
//!
//! Both give the same bits: every operation is an IEEE or integer one on one lane, without fused multiply-adds,
//! approximate reciprocals, or sums across lanes.

/// The bits of one number per pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(C, align(32))]
pub(super) struct Eight(pub [u32; 8]);

impl Eight {
    pub const fn splat(x: f32) -> Self {
        Self([x.to_bits(); 8])
    }
    pub fn of(x: [f32; 8]) -> Self {
        Self(x.map(f32::to_bits))
    }
    pub fn get(&self, lane: usize) -> f32 {
        f32::from_bits(self.0[lane])
    }
}

/// Operations on eight lanes of 32 bits. A mask counts by its highest bits.
///
/// # Safety
/// The methods of an implementation may be called only where the CPU has its instructions.
pub(super) unsafe trait Wide: Copy {
    type V: Copy;
    unsafe fn splat(x: f32) -> Self::V;
    unsafe fn splat_int(x: i32) -> Self::V;
    unsafe fn load(x: &Eight) -> Self::V;
    unsafe fn store(x: Self::V, to: &mut Eight);
    unsafe fn add(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn sub(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn mul(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn div(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn sqrt(a: Self::V) -> Self::V;
    /// `a < b ? a : b`: `b` where either is NaN.
    unsafe fn min(a: Self::V, b: Self::V) -> Self::V;
    /// `a > b ? a : b`: `b` where either is NaN.
    unsafe fn max(a: Self::V, b: Self::V) -> Self::V;
    /// Mask of `a < b`.
    unsafe fn less(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn and(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn or(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn xor(a: Self::V, b: Self::V) -> Self::V;
    /// `a` where the mask is set, else `b`.
    unsafe fn select(mask: Self::V, a: Self::V, b: Self::V) -> Self::V;
    /// One bit per lane of a mask, lane 0 lowest.
    unsafe fn bits(mask: Self::V) -> u32;
    unsafe fn add_int(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn sub_int(a: Self::V, b: Self::V) -> Self::V;
    /// Mask of `a > b`, signed.
    unsafe fn greater_int(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn shift_left<const N: i32>(a: Self::V) -> Self::V;
    unsafe fn shift_right<const N: i32>(a: Self::V) -> Self::V;
    /// With the sign.
    unsafe fn shift_right_signed<const N: i32>(a: Self::V) -> Self::V;
    /// Towards zero; |a| < 2^31.
    unsafe fn to_int(a: Self::V) -> Self::V;
    unsafe fn to_float(a: Self::V) -> Self::V;
    /// Rows of a table of four numbers, one array per column.
    ///
    /// The numbers of the rows must lie in the table.
    unsafe fn rows(table: *const [f32; 4], numbers: Self::V) -> [Self::V; 4];
}

/// Plain Rust.
#[derive(Debug, Clone, Copy)]
pub(super) struct Plain;

#[inline(always)]
fn float(a: Eight, b: Eight, f: impl Fn(f32, f32) -> f32) -> Eight {
    Eight(std::array::from_fn(|i| f(f32::from_bits(a.0[i]), f32::from_bits(b.0[i])).to_bits()))
}

#[inline(always)]
fn int(a: Eight, b: Eight, f: impl Fn(u32, u32) -> u32) -> Eight {
    Eight(std::array::from_fn(|i| f(a.0[i], b.0[i])))
}

fn mask(set: bool) -> u32 {
    if set { u32::MAX } else { 0 }
}

// SAFETY: needs no instructions; rows as the trait says.
unsafe impl Wide for Plain {
    type V = Eight;
    unsafe fn splat(x: f32) -> Eight {
        Eight::splat(x)
    }
    unsafe fn splat_int(x: i32) -> Eight {
        Eight([x as u32; 8])
    }
    unsafe fn load(x: &Eight) -> Eight {
        *x
    }
    unsafe fn store(x: Eight, to: &mut Eight) {
        *to = x;
    }
    unsafe fn add(a: Eight, b: Eight) -> Eight {
        float(a, b, |a, b| a + b)
    }
    unsafe fn sub(a: Eight, b: Eight) -> Eight {
        float(a, b, |a, b| a - b)
    }
    unsafe fn mul(a: Eight, b: Eight) -> Eight {
        float(a, b, |a, b| a * b)
    }
    unsafe fn div(a: Eight, b: Eight) -> Eight {
        float(a, b, |a, b| a / b)
    }
    unsafe fn sqrt(a: Eight) -> Eight {
        float(a, a, |a, _| a.sqrt())
    }
    unsafe fn min(a: Eight, b: Eight) -> Eight {
        float(a, b, |a, b| if a < b { a } else { b })
    }
    unsafe fn max(a: Eight, b: Eight) -> Eight {
        float(a, b, |a, b| if a > b { a } else { b })
    }
    unsafe fn less(a: Eight, b: Eight) -> Eight {
        int(a, b, |a, b| mask(f32::from_bits(a) < f32::from_bits(b)))
    }
    unsafe fn and(a: Eight, b: Eight) -> Eight {
        int(a, b, |a, b| a & b)
    }
    unsafe fn or(a: Eight, b: Eight) -> Eight {
        int(a, b, |a, b| a | b)
    }
    unsafe fn xor(a: Eight, b: Eight) -> Eight {
        int(a, b, |a, b| a ^ b)
    }
    unsafe fn select(mask: Eight, a: Eight, b: Eight) -> Eight {
        Eight(std::array::from_fn(|i| if mask.0[i] >> 31 == 1 { a.0[i] } else { b.0[i] }))
    }
    unsafe fn bits(mask: Eight) -> u32 {
        (0..8).map(|i| (mask.0[i] >> 31) << i).sum()
    }
    unsafe fn add_int(a: Eight, b: Eight) -> Eight {
        int(a, b, u32::wrapping_add)
    }
    unsafe fn sub_int(a: Eight, b: Eight) -> Eight {
        int(a, b, u32::wrapping_sub)
    }
    unsafe fn greater_int(a: Eight, b: Eight) -> Eight {
        int(a, b, |a, b| mask(a as i32 > b as i32))
    }
    unsafe fn shift_left<const N: i32>(a: Eight) -> Eight {
        Eight(a.0.map(|a| a << N))
    }
    unsafe fn shift_right<const N: i32>(a: Eight) -> Eight {
        Eight(a.0.map(|a| a >> N))
    }
    unsafe fn shift_right_signed<const N: i32>(a: Eight) -> Eight {
        Eight(a.0.map(|a| (a as i32 >> N) as u32))
    }
    unsafe fn to_int(a: Eight) -> Eight {
        Eight(a.0.map(|a| f32::from_bits(a) as i32 as u32))
    }
    unsafe fn to_float(a: Eight) -> Eight {
        Eight(a.0.map(|a| (a as i32 as f32).to_bits()))
    }
    unsafe fn rows(table: *const [f32; 4], numbers: Eight) -> [Eight; 4] {
        // SAFETY: in the table, as the trait demands.
        let rows = numbers.0.map(|n| unsafe { *table.add(n as usize) });
        std::array::from_fn(|c| Eight(rows.map(|r| r[c].to_bits())))
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) use avx2::Avx2;

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use super::{Eight, Wide};
    use std::arch::x86_64::*;

    /// AVX2 of x86-64.
    #[derive(Debug, Clone, Copy)]
    pub(in super::super) struct Avx2;

    macro_rules! lanewise {
        ($($name:ident($($arg:ident),+) = $intrinsic:expr;)+) => {
            $(#[inline(always)]
            unsafe fn $name($($arg: __m256),+) -> __m256 {
                // SAFETY: AVX2 is there, as the trait demands.
                unsafe { $intrinsic }
            })+
        };
    }

    macro_rules! whole {
        ($($name:ident($($arg:ident),+) = $intrinsic:ident;)+) => {
            $(#[inline(always)]
            unsafe fn $name($($arg: __m256),+) -> __m256 {
                // SAFETY: AVX2 is there, as the trait demands.
                unsafe { _mm256_castsi256_ps($intrinsic($(_mm256_castps_si256($arg)),+)) }
            })+
        };
    }

    // SAFETY: used only after AVX2 was detected; rows as the trait says.
    unsafe impl Wide for Avx2 {
        type V = __m256;

        lanewise! {
            add(a, b) = _mm256_add_ps(a, b);
            sub(a, b) = _mm256_sub_ps(a, b);
            mul(a, b) = _mm256_mul_ps(a, b);
            div(a, b) = _mm256_div_ps(a, b);
            sqrt(a) = _mm256_sqrt_ps(a);
            min(a, b) = _mm256_min_ps(a, b);
            max(a, b) = _mm256_max_ps(a, b);
            less(a, b) = _mm256_cmp_ps::<_CMP_LT_OQ>(a, b);
            and(a, b) = _mm256_and_ps(a, b);
            or(a, b) = _mm256_or_ps(a, b);
            xor(a, b) = _mm256_xor_ps(a, b);
            select(mask, a, b) = _mm256_blendv_ps(b, a, mask);
            to_int(a) = _mm256_castsi256_ps(_mm256_cvttps_epi32(a));
            to_float(a) = _mm256_cvtepi32_ps(_mm256_castps_si256(a));
        }
        whole! {
            add_int(a, b) = _mm256_add_epi32;
            sub_int(a, b) = _mm256_sub_epi32;
            greater_int(a, b) = _mm256_cmpgt_epi32;
        }

        #[inline(always)]
        unsafe fn splat(x: f32) -> __m256 {
            // SAFETY: AVX2 is there.
            unsafe { _mm256_set1_ps(x) }
        }
        #[inline(always)]
        unsafe fn splat_int(x: i32) -> __m256 {
            // SAFETY: AVX2 is there.
            unsafe { _mm256_castsi256_ps(_mm256_set1_epi32(x)) }
        }
        #[inline(always)]
        unsafe fn load(x: &Eight) -> __m256 {
            // SAFETY: eight numbers, aligned to 32 bytes.
            unsafe { _mm256_load_ps(x.0.as_ptr().cast()) }
        }
        #[inline(always)]
        unsafe fn store(x: __m256, to: &mut Eight) {
            // SAFETY: eight numbers, aligned to 32 bytes.
            unsafe { _mm256_store_ps(to.0.as_mut_ptr().cast(), x) }
        }
        #[inline(always)]
        unsafe fn bits(mask: __m256) -> u32 {
            // SAFETY: AVX2 is there.
            unsafe { _mm256_movemask_ps(mask) as u32 }
        }
        #[inline(always)]
        unsafe fn shift_left<const N: i32>(a: __m256) -> __m256 {
            // SAFETY: AVX2 is there.
            unsafe { _mm256_castsi256_ps(_mm256_slli_epi32::<N>(_mm256_castps_si256(a))) }
        }
        #[inline(always)]
        unsafe fn shift_right<const N: i32>(a: __m256) -> __m256 {
            // SAFETY: AVX2 is there.
            unsafe { _mm256_castsi256_ps(_mm256_srli_epi32::<N>(_mm256_castps_si256(a))) }
        }
        #[inline(always)]
        unsafe fn shift_right_signed<const N: i32>(a: __m256) -> __m256 {
            // SAFETY: AVX2 is there.
            unsafe { _mm256_castsi256_ps(_mm256_srai_epi32::<N>(_mm256_castps_si256(a))) }
        }
        #[inline(always)]
        unsafe fn rows(table: *const [f32; 4], numbers: __m256) -> [__m256; 4] {
            // SAFETY: in the table, as the trait demands.
            unsafe {
                let mut at = Eight::default();
                Self::store(numbers, &mut at);
                let row = |i: usize| _mm_loadu_ps(table.add(at.0[i] as usize).cast());
                let r0 = _mm256_set_m128(row(4), row(0));
                let r1 = _mm256_set_m128(row(5), row(1));
                let r2 = _mm256_set_m128(row(6), row(2));
                let r3 = _mm256_set_m128(row(7), row(3));
                let t0 = _mm256_unpacklo_ps(r0, r1);
                let t1 = _mm256_unpackhi_ps(r0, r1);
                let t2 = _mm256_unpacklo_ps(r2, r3);
                let t3 = _mm256_unpackhi_ps(r2, r3);
                [
                    _mm256_shuffle_ps::<0x44>(t0, t2),
                    _mm256_shuffle_ps::<0xee>(t0, t2),
                    _mm256_shuffle_ps::<0x44>(t1, t3),
                    _mm256_shuffle_ps::<0xee>(t1, t3),
                ]
            }
        }
    }
}
