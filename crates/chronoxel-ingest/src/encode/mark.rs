//! Marking masked samples in slices that have just been read.

use super::real::Real;

/// What a slice (or several) held.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Marks {
    /// Masked samples: NaN, infinities and fill values.
    pub num_masked: u64,
    /// Infinities among them.
    pub num_infinite: u64,
    /// Smallest and largest unmasked sample; `[+inf, -inf]` where there is none.
    pub range: [f64; 2],
}

impl Marks {
    /// Of no slice at all.
    pub const NONE: Self = Self { num_masked: 0, num_infinite: 0, range: [f64::INFINITY, f64::NEG_INFINITY] };

    /// Of both.
    pub fn merged(self, other: Self) -> Self {
        Self {
            num_masked: self.num_masked + other.num_masked,
            num_infinite: self.num_infinite + other.num_infinite,
            range: [self.range[0].min(other.range[0]), self.range[1].max(other.range[1])],
        }
    }
}

/// Largest minus smallest value of a range; 0 where it holds none.
pub fn width_of([low, high]: [f64; 2]) -> f64 {
    // Halved before the difference and doubled after, which cannot overflow on the way.
    2.0 * (0.5 * high - 0.5 * low).clamp(0.0, 0.5 * f64::MAX)
}

/// Turns every masked sample into NaN.
pub fn mark<T: Real>(slice: &mut [T], fill_value: Option<f64>) -> Marks {
    // Compared in the source's own precision: a file may declare 1e20 in f64 and hold the nearest f32.
    let fill = fill_value.map_or(T::MASKED, T::from_f64);
    if let Some(range) = range_if_plain(slice, fill) {
        return Marks { range, ..Marks::NONE };
    }
    let mut marks = Marks::NONE;
    for v in slice.iter_mut() {
        if v.is_finite() && *v != fill {
            let value = v.to_f64() + 0.0;
            marks.range = [marks.range[0].min(value), marks.range[1].max(value)];
        } else {
            marks.num_masked += 1;
            marks.num_infinite += u64::from(!v.is_finite() && !v.is_masked() && *v != fill);
            *v = T::MASKED;
        }
    }
    marks
}

/// The range of a slice without a masked sample, `None` where there is one; free of branches.
fn range_if_plain<T: Real>(slice: &[T], fill: T) -> Option<[f64; 2]> {
    const LANES: usize = 8;
    let mut low = [T::INFINITE; LANES];
    let mut high = [T::INFINITE.negated(); LANES];
    // Zero as long as all samples are finite and none is the fill value.
    let mut odd = [T::from_f64(0.0); LANES];
    let mut take = |lane: usize, v: T| {
        low[lane] = if v < low[lane] { v } else { low[lane] };
        high[lane] = if v > high[lane] { v } else { high[lane] };
        odd[lane] = odd[lane].plus(if v == fill { T::MASKED } else { v.minus(v) });
    };
    let (chunks, rest) = slice.as_chunks::<LANES>();
    for chunk in chunks {
        for (lane, &v) in chunk.iter().enumerate() {
            take(lane, v);
        }
    }
    for (lane, &v) in rest.iter().enumerate() {
        take(lane, v);
    }
    if odd.iter().any(|v| v.is_masked()) {
        return None;
    }
    let low = low.iter().map(|v| v.to_f64()).fold(f64::INFINITY, f64::min);
    let high = high.iter().map(|v| v.to_f64()).fold(f64::NEG_INFINITY, f64::max);
    Some([low + 0.0, high + 0.0])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marks_nan_infinities_and_fill_values() {
        let mut slice = [1.0, f32::NAN, -2.0, f32::INFINITY, 1e20, 3.0, f32::NEG_INFINITY];
        let marks = mark(&mut slice, Some(1e20));
        assert_eq!(marks, Marks { num_masked: 4, num_infinite: 2, range: [-2.0, 3.0] });
        assert_eq!(slice.map(f32::is_nan), [false, true, false, true, true, false, true]);
    }

    #[test]
    fn plain_slices_are_left_alone() {
        let mut slice: Vec<f64> = (0..21).map(f64::from).collect();
        let before = slice.clone();
        assert_eq!(mark(&mut slice, Some(77.0)), Marks { range: [0.0, 20.0], ..Marks::NONE });
        assert_eq!(slice, before);
        let marks = mark(&mut slice, Some(20.0));
        assert_eq!((marks.num_masked, marks.range), (1, [0.0, 19.0]));
        assert!(slice[20].is_nan());
    }
}
