//! What is known of one brick of one step: ranges, exact flags, statistics.

use chronoxel_core::{BrickLayout, LevelGeometry, SpanStatistics};

use super::real::Real;

/// The outcome of looking at a brick's source samples.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Analysis {
    /// Smallest and largest unmasked sample of core and apron; `None` where all are masked.
    pub range: Option<[f64; 2]>,
    /// Whether all unmasked samples of core and apron have the same bits.
    pub is_constant: bool,
    /// Masked samples of core and apron.
    pub num_masked: usize,
    /// Over unmasked core samples inside the grid.
    pub statistics: SpanStatistics,
}

/// Analyses the samples of brick `[x, y, z]`, `[z, y, x]` over core and apron.
pub fn analyse<T: Real>(
    samples: &[T],
    may_be_masked: bool,
    brick: [usize; 3],
    geometry: &LevelGeometry,
    layout: &BrickLayout,
) -> Analysis {
    let num_masked = if may_be_masked { samples.iter().filter(|v| v.is_masked()).count() } else { 0 };
    let (low, high) = range_of(samples);
    let range = (num_masked < samples.len()).then(|| [low.to_f64() + 0.0, high.to_f64() + 0.0]);
    let is_constant = range.is_some_and(|[low, high]| low == high) && {
        let first = samples.iter().copied().find(|v| !v.is_masked());
        first.is_some_and(|first| samples.iter().all(|v| v.is_masked() || v.same_bits(first)))
    };
    let core = Core::new(samples, brick, geometry, layout);
    let statistics = match (is_constant, num_masked) {
        (true, 0) => constant_statistics(samples[0].to_f64(), core.num_samples()),
        _ => statistics(&core, num_masked > 0),
    };
    Analysis { range, is_constant, num_masked, statistics }
}

/// Lanes of the reductions: fixed, so that results do not depend on the machine.
const LANES: usize = 8;

/// Smallest and largest unmasked sample.
pub(super) fn range_of<T: Real>(samples: &[T]) -> (T, T) {
    let mut low = [T::INFINITE; LANES];
    let mut high = [T::INFINITE.negated(); LANES];
    let (chunks, rest) = samples.as_chunks::<LANES>();
    let mut take = |lane: usize, v: T| {
        // A comparison with NaN is false: masked samples change nothing.
        low[lane] = if v < low[lane] { v } else { low[lane] };
        high[lane] = if v > high[lane] { v } else { high[lane] };
    };
    for chunk in chunks {
        for (lane, &v) in chunk.iter().enumerate() {
            take(lane, v);
        }
    }
    for (lane, &v) in rest.iter().enumerate() {
        take(lane, v);
    }
    ends_of(low, high)
}

fn ends_of<T: Real>(low: [T; LANES], high: [T; LANES]) -> (T, T) {
    let smaller = |a: T, b: T| if b < a { b } else { a };
    let larger = |a: T, b: T| if b > a { b } else { a };
    (low.into_iter().fold(T::INFINITE, smaller), high.into_iter().fold(T::INFINITE.negated(), larger))
}

/// The rows of a brick's core that lie inside the grid.
pub(super) struct Core<'a, T> {
    samples: &'a [T],
    full: usize,
    low: usize,
    extent: [usize; 3],
}

impl<'a, T: Real> Core<'a, T> {
    /// Of brick `[x, y, z]`, of whose core and apron these are the samples.
    pub(super) fn new(
        samples: &'a [T],
        brick: [usize; 3],
        geometry: &LevelGeometry,
        layout: &BrickLayout,
    ) -> Self {
        let extent = std::array::from_fn(|a| (geometry.dims[a] - brick[a] * layout.edge).min(layout.edge));
        Self { samples, full: layout.full_edge(), low: layout.low, extent }
    }

    fn num_samples(&self) -> u64 {
        self.extent.iter().product::<usize>() as u64
    }

    /// Number of the samples that [`Self::gather`] gathers.
    pub(super) fn num_strided(&self, stride: usize) -> usize {
        self.extent.iter().map(|n| n.div_ceil(stride)).product()
    }

    /// Copies every `stride`-th sample along each axis.
    pub(super) fn gather(&self, stride: usize, out: &mut [T]) {
        let [nx, ny, nz] = self.extent;
        let mut out = out.chunks_mut(nx.div_ceil(stride));
        for z in (0..nz).step_by(stride) {
            for (y, out) in (0..ny).step_by(stride).zip(&mut out) {
                let row = self.row(y, z);
                match stride {
                    1 => out.copy_from_slice(row),
                    _ => out.iter_mut().zip(row.iter().step_by(stride)).for_each(|(out, v)| *out = *v),
                }
            }
        }
    }

    #[inline(always)]
    fn row(&self, y: usize, z: usize) -> &'a [T] {
        &self.samples[self.low + self.full * (self.low + y + self.full * (self.low + z))..][..self.extent[0]]
    }

    fn rows(&self) -> impl Iterator<Item = &'a [T]> {
        let (samples, full, low, [nx, ny, nz]) = (self.samples, self.full, self.low, self.extent);
        (0..nz).flat_map(move |z| {
            (0..ny).map(move |y| &samples[low + full * (low + y + full * (low + z))..][..nx])
        })
    }
}

fn constant_statistics(value: f64, count: u64) -> SpanStatistics {
    SpanStatistics { count, min: value + 0.0, max: value + 0.0, mean: value + 0.0, std: 0.0 }
}

/// Moments about one of the samples, which lose at most a factor of `count` of `f64`'s precision to cancellation,
/// whatever the samples are.
fn statistics<T: Real>(core: &Core<'_, T>, masked: bool) -> SpanStatistics {
    let Some(pivot) = core.rows().flatten().find(|v| !v.is_masked()) else {
        return SpanStatistics { count: 0, min: f64::NAN, max: f64::NAN, mean: f64::NAN, std: f64::NAN };
    };
    let moments_in = |unit: f64| match masked {
        false => moments_unmasked(core, pivot.to_f64(), unit),
        true => moments_masked(core, pivot.to_f64(), unit),
    };
    let mut unit = 1.0;
    let mut moments = moments_in(unit);
    // Squares beyond either end of f64's range are taken again in another unit.
    if !moments.squares.is_finite() || moments.squares < 1e-280 && moments.min < moments.max {
        // Powers of two: exact.
        unit = if moments.squares < 1.0 { 2f64.powi(532) } else { 2f64.powi(-532) };
        moments = moments_in(unit);
    }
    let Moments { count, min, max, sum, squares } = moments;
    let n = count as f64;
    let mean = ((pivot.to_f64() * unit + sum / n) / unit).clamp(min, max);
    let std = ((squares - sum * (sum / n)).max(0.0) / n).sqrt() / unit;
    // No deviation exceeds half the range; rounding may, and beyond f64's range.
    let std = std.min(0.5 * max - 0.5 * min);
    SpanStatistics { count, min, max, mean, std }
}

struct Moments {
    count: u64,
    min: f64,
    max: f64,
    sum: f64,
    squares: f64,
}

fn moments_unmasked<T: Real>(core: &Core<'_, T>, pivot: f64, unit: f64) -> Moments {
    let mut low = [T::INFINITE; LANES];
    let mut high = [T::INFINITE.negated(); LANES];
    let mut sums = [0.0f64; LANES];
    let mut squares = [0.0f64; LANES];
    let scaled_pivot = pivot * unit;
    let mut take = |lane: usize, v: T| {
        low[lane] = if v < low[lane] { v } else { low[lane] };
        high[lane] = if v > high[lane] { v } else { high[lane] };
        let d = v.to_f64() * unit - scaled_pivot;
        sums[lane] += d;
        squares[lane] += d * d;
    };
    for row in core.rows() {
        let (chunks, rest) = row.as_chunks::<LANES>();
        for chunk in chunks {
            for (lane, &v) in chunk.iter().enumerate() {
                take(lane, v);
            }
        }
        for (lane, &v) in rest.iter().enumerate() {
            take(lane, v);
        }
    }
    let (low, high) = ends_of(low, high);
    Moments {
        count: core.num_samples(),
        min: low.to_f64() + 0.0,
        max: high.to_f64() + 0.0,
        sum: sums.iter().sum(),
        squares: squares.iter().sum(),
    }
}

fn moments_masked<T: Real>(core: &Core<'_, T>, pivot: f64, unit: f64) -> Moments {
    let scaled_pivot = pivot * unit;
    let mut m = Moments { count: 0, min: f64::INFINITY, max: f64::NEG_INFINITY, sum: 0.0, squares: 0.0 };
    for v in core.rows().flatten().filter(|v| !v.is_masked()).map(|v| v.to_f64()) {
        let d = v * unit - scaled_pivot;
        m.count += 1;
        m.min = m.min.min(v + 0.0);
        m.max = m.max.max(v + 0.0);
        m.sum += d;
        m.squares += d * d;
    }
    m
}

#[cfg(test)]
mod tests {
    use super::*;
    use chronoxel_core::{UniformGrid, octree::levels_of};

    fn analyse_core(core: impl Fn(usize) -> f64) -> Analysis {
        let layout = BrickLayout::new(8).unwrap();
        let grid = UniformGrid::new([8, 8, 5], [0.0; 3], [1.0; 3]).unwrap();
        let full = layout.full_edge();
        let samples: Vec<f64> = (0..layout.num_full())
            .map(|i| {
                let [x, y, z] = [i % full, i / full % full, i / full / full].map(|p| p.wrapping_sub(1));
                if x < 8 && y < 8 && z < 5 { core(x + 8 * (y + 8 * z)) } else { 1e6 }
            })
            .collect();
        analyse(&samples, true, [0; 3], &levels_of(&grid, &layout)[0], &layout)
    }

    #[test]
    fn statistics_of_consecutive_numbers() {
        // 0 … 319: mean 319 / 2, variance (n^2 - 1) / 12.
        let a = analyse_core(|i| i as f64);
        assert_eq!((a.statistics.count, a.statistics.min, a.statistics.max), (320, 0.0, 319.0));
        assert_eq!(a.statistics.mean, 159.5);
        assert!((a.statistics.std - ((320.0f64 * 320.0 - 1.0) / 12.0).sqrt()).abs() < 1e-11);
        assert_eq!(a.range, Some([0.0, 1e6]));
        assert!(!a.is_constant);
    }

    #[test]
    fn a_large_mean_does_not_swallow_the_deviation() {
        let a = analyse_core(|i| 1e9 + (i % 2) as f64);
        assert_eq!((a.statistics.mean, a.statistics.std), (1e9 + 0.5, 0.5));
        let huge = analyse_core(|i| if i % 2 == 0 { f64::MAX } else { -f64::MAX });
        assert!(huge.statistics.mean.abs() < 1e-15 * f64::MAX);
        assert!((huge.statistics.std / f64::MAX - 1.0).abs() < 1e-12);
    }

    #[test]
    fn masked_samples_do_not_count() {
        let a = analyse_core(|i| if i < 4 { i as f64 } else { f64::NAN });
        assert_eq!((a.statistics.count, a.num_masked), (4, 316));
        assert_eq!((a.statistics.mean, a.statistics.std), (1.5, 1.25f64.sqrt()));
        let none = analyse_core(|_| f64::NAN);
        assert_eq!(none.statistics.count, 0);
        assert!(none.statistics.mean.is_nan());
    }
}
