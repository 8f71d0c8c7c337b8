//! Brick spans: what the cover of a node says of one run of time steps.

/// Where the bytes of a payload or a mask lie: row and node of the array of its level and window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PayloadAddress {
    /// Row of the span that first had these bytes (see the store's `row(start, window)`).
    pub row: u32,
    /// Rank of the node among the nodes of its level, in Morton order.
    pub node: u32,
}

/// What a brick span holds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum SpanKind {
    /// No data: every sample lies outside the grid or is masked.
    Empty,
    /// Every sample, apron included, is this value.
    Constant(f64),
    /// Indices and tables.
    Coded {
        /// Index into the variable's list of payload classes.
        class: u8,
        /// Where the bytes are: the span's own place, or an earlier span with equal bytes.
        at: PayloadAddress,
    },
}

/// Statistics of the source samples of a span: core samples only, masked ones left out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpanStatistics {
    /// Number of samples counted.
    pub count: u64,
    /// Smallest; NaN where `count` is 0, as are the other three.
    pub min: f64,
    /// Largest.
    pub max: f64,
    /// Mean.
    pub mean: f64,
    /// Standard deviation (of the population: divided by `count`).
    pub std: f64,
}

impl SpanStatistics {
    /// Of the samples of both: Chan's update of mean and deviation, scaled so that no square overflows.
    pub fn merged(self, other: Self) -> Self {
        if self.count == 0 || other.count == 0 {
            return if self.count == 0 { other } else { self };
        }
        let count = self.count + other.count;
        let [a, b] = [self.count, other.count].map(|n| n as f64 / count as f64);
        let (min, max) = (self.min.min(other.min), self.max.max(other.max));
        let mean = (a * self.mean + b * other.mean).clamp(min, max);
        let half_apart = (0.5 * self.mean - 0.5 * other.mean).abs();
        let unit = self.std.max(other.std).max(half_apart);
        let square = |x: f64| (x / unit) * (x / unit);
        let std = match unit {
            0.0 => 0.0,
            _ => {
                unit * (a * square(self.std) + b * square(other.std) + 4.0 * a * b * square(half_apart))
                    .sqrt()
            }
        };
        // No deviation exceeds half the range; rounding may.
        Self { count, min, max, mean, std: std.min(0.5 * max - 0.5 * min) }
    }
}

/// One entry of a node's cover.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpanRecord {
    /// First time step.
    pub start: u32,
    /// Number of time steps, at least 1.
    pub len: u32,
    /// Length of the window whose arrays hold the span (`len` is shorter at either end of a series).
    pub window: u32,
    /// What it holds.
    pub kind: SpanKind,
    /// Where its mask is, if any of its samples is masked.
    pub mask: Option<PayloadAddress>,
    /// Smallest and largest *decoded* sample, apron and pad included: what skipping may rely on.
    pub drawn_range: [f64; 2],
    /// Statistics of the source.
    pub statistics: SpanStatistics,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(values: &[f64]) -> SpanStatistics {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let std = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
        let fold = |pick: fn(f64, f64) -> f64| values.iter().copied().reduce(pick).unwrap();
        SpanStatistics { count: values.len() as u64, min: fold(f64::min), max: fold(f64::max), mean, std }
    }

    #[test]
    fn merged_statistics_are_those_of_all_samples() {
        let values: Vec<f64> = (0..50).map(|i| f64::from(i * i % 37) - 7.5).collect();
        let all = of(&values);
        let merged = of(&values[..3]).merged(of(&values[3..20])).merged(of(&values[20..]));
        assert_eq!((merged.count, merged.min, merged.max), (50, all.min, all.max));
        assert!((merged.mean - all.mean).abs() < 1e-13 && (merged.std - all.std).abs() < 1e-13);
        let none = SpanStatistics { count: 0, min: f64::NAN, max: f64::NAN, mean: f64::NAN, std: f64::NAN };
        assert_eq!(none.merged(all), all);
        assert_eq!(all.merged(none), all);
    }

    #[test]
    fn the_ends_of_the_number_range_merge() {
        let single = |v: f64| SpanStatistics { count: 1, min: v, max: v, mean: v, std: 0.0 };
        let huge = single(f64::MAX).merged(single(-f64::MAX));
        assert_eq!((huge.mean, huge.std), (0.0, f64::MAX));
        let tiny = single(0.0).merged(single(4.0 * f64::MIN_POSITIVE));
        assert_eq!((tiny.mean, tiny.std), (2.0 * f64::MIN_POSITIVE, 2.0 * f64::MIN_POSITIVE));
        assert_eq!(single(0.1).merged(single(0.1)).std, 0.0);
    }
}
