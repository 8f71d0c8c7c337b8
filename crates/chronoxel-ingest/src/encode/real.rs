//! The two number types the encoder computes in: `f32` for sources that fit it, else `f64`.

use bytemuck::Pod;
use chronoxel_codec::SampleValue;
use chronoxel_core::Samples;

/// A sample as the encoder holds it; NaN stands for "masked".
pub trait Real: SampleValue + Pod {
    /// The mark of a masked sample.
    const MASKED: Self;
    /// The largest finite value.
    const LARGEST: Self;
    /// The smallest above 0.
    const SMALLEST: Self;
    /// Above every sample: where a search for the smallest begins.
    const INFINITE: Self;

    /// The vector inside `samples`, or `None` where the reader handed over the other kind.
    fn from_samples(samples: Samples) -> Option<Vec<Self>>;
    /// Rounded to the type.
    fn from_f64(value: f64) -> Self;
    /// Without rounding.
    fn to_f64(self) -> f64;
    /// Neither NaN nor an infinity.
    fn is_finite(self) -> bool;
    /// The opposite.
    fn negated(self) -> Self;
    /// The sum.
    fn plus(self, other: Self) -> Self;
    /// The difference.
    fn minus(self, other: Self) -> Self;
    /// The product.
    fn times(self, other: Self) -> Self;
    /// The quotient.
    fn over(self, other: Self) -> Self;
    /// The square root.
    fn root(self) -> Self;
    /// Without its sign.
    fn magnitude(self) -> Self;
    /// The smaller one; the first where that is NaN.
    fn at_most(self, most: Self) -> Self;
    /// The larger one; `least` where the first is NaN.
    fn at_least(self, least: Self) -> Self;
    /// Equal bit by bit: tells the two zeros apart.
    fn same_bits(self, other: Self) -> bool;
    /// `(low + 2 middle + high) / 4`, exact where all three are equal, and never overflowing.
    fn average_121(low: Self, middle: Self, high: Self) -> Self;

    /// Whether the sample is masked.
    #[inline(always)]
    fn is_masked(self) -> bool {
        self.partial_cmp(&self).is_none()
    }
}

macro_rules! real {
    ($type:ident, $kind:ident) => {
        impl Real for $type {
            const MASKED: Self = $type::NAN;
            const LARGEST: Self = $type::MAX;
            const SMALLEST: Self = $type::from_bits(1);
            const INFINITE: Self = $type::INFINITY;

            fn from_samples(samples: Samples) -> Option<Vec<Self>> {
                match samples {
                    Samples::$kind(v) => Some(v),
                    _ => None,
                }
            }

            #[inline(always)]
            fn from_f64(value: f64) -> Self {
                value as $type
            }

            #[inline(always)]
            fn to_f64(self) -> f64 {
                f64::from(self)
            }

            #[inline(always)]
            fn is_finite(self) -> bool {
                $type::is_finite(self)
            }

            #[inline(always)]
            fn negated(self) -> Self {
                -self
            }

            #[inline(always)]
            fn plus(self, other: Self) -> Self {
                self + other
            }

            #[inline(always)]
            fn minus(self, other: Self) -> Self {
                self - other
            }

            #[inline(always)]
            fn times(self, other: Self) -> Self {
                self * other
            }

            #[inline(always)]
            fn over(self, other: Self) -> Self {
                self / other
            }

            #[inline(always)]
            fn root(self) -> Self {
                self.sqrt()
            }

            #[inline(always)]
            fn magnitude(self) -> Self {
                self.abs()
            }

            #[inline(always)]
            fn at_most(self, most: Self) -> Self {
                if most < self { most } else { self }
            }

            #[inline(always)]
            fn at_least(self, least: Self) -> Self {
                if self > least { self } else { least }
            }

            #[inline(always)]
            fn same_bits(self, other: Self) -> bool {
                self.to_bits() == other.to_bits()
            }

            #[inline(always)]
            fn average_121(low: Self, middle: Self, high: Self) -> Self {
                let sides = 0.5 * low + 0.5 * high;
                0.5 * sides + 0.5 * middle
            }

            #[inline(always)]
            fn is_masked(self) -> bool {
                self.is_nan()
            }
        }
    };
}

real!(f32, F32);
real!(f64, F64);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn average_of_equal_samples_is_exact() {
        for v in [0.1f32, -3.2e38, 1.5e-38, 16_777_215.0, std::f32::consts::PI] {
            assert_eq!(f32::average_121(v, v, v), v);
        }
        assert_eq!(f64::average_121(f64::MAX, f64::MAX, f64::MAX), f64::MAX);
        assert_eq!(f32::average_121(1.0, 2.0, 5.0), 2.5);
    }
}
