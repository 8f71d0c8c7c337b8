//! The reference metrics: from the colour of every voxel at every step (ellsworth2000, eq. 7–13).

use crate::TimeNode;

use super::voxel_colors::{VoxelColor, VoxelColors};
use super::{distance, dot, ratio};

/// Mean colour of some voxels and what their distances from it need, such that two of them merge.
///
/// Kept about the mean rather than about 0, so that nothing cancels. A NaN stands for voxels without data.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Moments {
    alpha: f64,
    color: [f64; 3],
    /// Mean of α (c − mean c).
    co_deviation: [f64; 3],
    /// Mean of the distances from the mean (eq. 9, squared).
    squared_deviation: f64,
}

impl Moments {
    /// Of a voxel without data.
    const NO_DATA: Self = Self {
        alpha: f64::NAN,
        color: [f64::NAN; 3],
        co_deviation: [f64::NAN; 3],
        squared_deviation: f64::NAN,
    };

    /// Of both.
    ///
    /// * `share`: of the second, in [0, 1]
    fn merged(&self, other: &Self, share: f64) -> Self {
        let rest = 1.0 - share;
        let both = share * rest;
        let apart: [f64; 3] = std::array::from_fn(|i| other.color[i] - self.color[i]);
        let alpha_apart = other.alpha - self.alpha;
        let co_apart: [f64; 3] = std::array::from_fn(|i| other.co_deviation[i] - self.co_deviation[i]);
        Self {
            alpha: self.alpha + share * alpha_apart,
            color: std::array::from_fn(|i| self.color[i] + share * apart[i]),
            co_deviation: std::array::from_fn(|i| {
                self.co_deviation[i] + share * co_apart[i] + both * alpha_apart * apart[i]
            }),
            squared_deviation: rest * self.squared_deviation
                + share * other.squared_deviation
                + both
                    * (2.0 * dot(apart, co_apart)
                        + (share * self.alpha + rest * other.alpha) * dot(apart, apart)
                        + alpha_apart * alpha_apart),
        }
    }

    /// σ̂/μ̂ (eq. 10 and 13), 0 where nothing is seen.
    fn ratio(&self) -> f64 {
        match self.squared_deviation > 0.0 {
            true => ratio(self.squared_deviation, self.color, self.alpha),
            false => 0.0,
        }
    }

    /// Whether two voxels, neither of which changes, look different.
    fn differs(&self, other: &Self) -> bool {
        let [a, b] = [self, other].map(|voxel| if voxel.alpha.is_nan() { 0.0 } else { voxel.alpha });
        a != b || (a != 0.0 && self.color != other.color)
    }
}

/// Which colours there are among voxels: coordinates and opacity; all that draws nothing is one colour.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
enum Colors {
    #[default]
    None,
    One([f64; 4]),
    Several,
}

impl Colors {
    const TRANSPARENT: Self = Self::One([0.0; 4]);

    fn of(color: VoxelColor) -> Self {
        let [x, y, z] = color.coordinates;
        if color.alpha == 0.0 { Self::TRANSPARENT } else { Self::One([x, y, z, color.alpha]) }
    }

    fn merged(self, other: Self) -> Self {
        match (self, other) {
            (Self::None, any) | (any, Self::None) => any,
            (a, b) if a == b => a,
            _ => Self::Several,
        }
    }
}

/// What the reference metrics need of the voxels of a node over the steps of a time node.
///
/// Those of disjoint boxes merge to those of both; the default is that of an empty box. Voxels without data (masked) draw nothing: they
/// count neither in the mean colour nor in distances from it, but that they differ from what is seen makes an error more than 0.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ColorSums {
    /// Voxels times steps with data.
    count: u64,
    moments: Moments,
    srgb: [f64; 3],
    colors: Colors,
    /// Sum of σ̂_i/μ̂_i over the voxels that have data at every step, and their number.
    sum_of_ratios: f64,
    num_voxels: u64,
    changes: bool,
}

impl ColorSums {
    /// Of the voxels of both boxes, over the same steps.
    pub fn merged(&self, other: &Self) -> Self {
        Self {
            sum_of_ratios: self.sum_of_ratios + other.sum_of_ratios,
            num_voxels: self.num_voxels + other.num_voxels,
            changes: self.changes || other.changes,
            ..self.with_samples_of(other)
        }
    }

    /// The colours of both; what changes in time is left as it is.
    fn with_samples_of(&self, other: &Self) -> Self {
        let colors = self.colors.merged(other.colors);
        if self.count == 0 || other.count == 0 {
            let with_data = if self.count == 0 { other } else { self };
            let Self { count, moments, srgb, .. } = *with_data;
            return Self { count, moments, srgb, colors, ..*self };
        }
        let count = self.count + other.count;
        let share = other.count as f64 / count as f64;
        Self {
            count,
            moments: self.moments.merged(&other.moments, share),
            srgb: std::array::from_fn(|i| self.srgb[i] + share * (other.srgb[i] - self.srgb[i])),
            colors,
            ..*self
        }
    }

    /// e_rcs (eq. 10): 0 exactly where all voxels look the same at all steps.
    pub fn spatial_error(&self) -> f64 {
        match self.colors {
            Colors::Several => self.moments.ratio().max(f64::MIN_POSITIVE),
            Colors::None | Colors::One(_) => 0.0,
        }
    }

    /// e_rct (eq. 13): 0 exactly where no voxel changes its look.
    ///
    /// The mean over the voxels that have data at every step.
    pub fn temporal_error(&self) -> f64 {
        if !self.changes {
            return 0.0;
        }
        (self.sum_of_ratios / self.num_voxels.max(1) as f64).max(f64::MIN_POSITIVE)
    }

    /// Mean colour: sRGB, opacity per unit length; zeros where no voxel has data.
    pub fn mean(&self) -> [f32; 4] {
        let [r, g, b] = self.srgb;
        [r, g, b, self.moments.alpha].map(|c| c as f32)
    }
}

/// Gathers the voxels of one step.
#[derive(Default)]
struct StepColors {
    voxels: Vec<Moments>,
    count: u64,
    alpha: f64,
    color: [f64; 3],
    srgb: [f64; 3],
    colors: Colors,
}

impl StepColors {
    fn push(&mut self, color: VoxelColor) {
        let VoxelColor { srgb, coordinates, alpha } = color;
        self.count += 1;
        self.alpha += alpha;
        self.color = std::array::from_fn(|i| self.color[i] + coordinates[i]);
        self.srgb = std::array::from_fn(|i| self.srgb[i] + srgb[i]);
        self.colors = self.colors.merged(Colors::of(color));
        self.voxels.push(Moments { alpha, color: coordinates, ..Moments::default() });
    }

    fn push_masked(&mut self) {
        self.colors = self.colors.merged(Colors::TRANSPARENT);
        self.voxels.push(Moments::NO_DATA);
    }

    fn sums(&self) -> ColorSums {
        let colors = self.colors;
        if self.count == 0 {
            return ColorSums { colors, ..ColorSums::default() };
        }
        let n = self.count as f64;
        let (alpha, color) = (self.alpha / n, self.color.map(|sum| sum / n));
        let (mut co_deviation, mut squared_deviation) = ([0.0; 3], 0.0);
        for voxel in self.voxels.iter().filter(|voxel| !voxel.alpha.is_nan()) {
            co_deviation =
                std::array::from_fn(|i| co_deviation[i] + voxel.alpha * (voxel.color[i] - color[i]));
            squared_deviation += distance(voxel.color, voxel.alpha, color, alpha);
        }
        let moments = Moments {
            alpha,
            color,
            co_deviation: co_deviation.map(|sum| sum / n),
            squared_deviation: squared_deviation / n,
        };
        let (count, srgb) = (self.count, self.srgb.map(|sum| sum / n));
        ColorSums { count, moments, srgb, colors, num_voxels: count, ..ColorSums::default() }
    }
}

/// The voxels of one brick over the steps of a time node.
#[derive(Debug)]
struct Carried {
    voxels: Vec<Moments>,
    sums: ColorSums,
}

impl Carried {
    /// With the steps that follow.
    ///
    /// * `share`: of those steps, among all
    fn extended(mut self, later: &Self, share: f64) -> Self {
        let mut sums = self.sums.with_samples_of(&later.sums);
        sums.changes |= later.sums.changes;
        (sums.sum_of_ratios, sums.num_voxels) = (0.0, 0);
        for (voxel, next) in self.voxels.iter_mut().zip(&later.voxels) {
            sums.changes |= voxel.differs(next);
            *voxel = voxel.merged(next, share);
            if !voxel.alpha.is_nan() {
                sums.sum_of_ratios += voxel.ratio();
                sums.num_voxels += 1;
            }
        }
        Self { voxels: self.voxels, sums }
    }
}

/// Colours of the voxels of one brick, step by step: what the reference metrics of its time nodes need.
///
/// Holds eight numbers per voxel for each level of the time tree.
#[derive(Debug)]
pub struct BrickColors {
    num_voxels: usize,
    num_steps: u32,
    num_pushed: u32,
    /// By level, the first half of a time node whose second is not over.
    first_halves: Vec<Option<Carried>>,
}

impl BrickColors {
    /// Of a brick before its first step.
    ///
    /// * `num_voxels`: of the brick; core voxels in the grid, as everywhere in statistics
    /// * `num_steps`: of the series
    pub fn new(num_voxels: usize, num_steps: u32) -> Self {
        let num_levels = TimeNode::root(num_steps).level;
        Self { num_voxels, num_steps, num_pushed: 0, first_halves: (0..num_levels).map(|_| None).collect() }
    }

    /// Takes the samples of the next step, and gives the time nodes that are over with it, shorter ones first.
    ///
    /// * `samples`: NaN where masked
    ///
    /// # Panics
    /// If the number of samples is not the brick's, or the series is over.
    pub fn push(
        &mut self,
        colors: &VoxelColors,
        samples: impl IntoIterator<Item = f64>,
    ) -> Vec<(TimeNode, ColorSums)> {
        assert!(self.num_pushed < self.num_steps, "the series has {} steps", self.num_steps);
        let step = self.num_pushed;
        self.num_pushed += 1;
        let mut current = self.colored(colors, samples);
        let mut closed = Vec::new();
        for node in TimeNode::closed_by(step, self.num_steps) {
            if let Some(below) = node.level.checked_sub(1)
                && let Some(first) = self.first_halves[usize::from(below)].take()
            {
                let num_later = node.halves()[1].steps(self.num_steps).len();
                let share = num_later as f64 / node.steps(self.num_steps).len() as f64;
                current = first.extended(&current, share);
            }
            closed.push((node, current.sums));
        }
        let level = closed.len() - 1;
        if level < self.first_halves.len() {
            self.first_halves[level] = Some(current);
        }
        closed
    }

    fn colored(&self, colors: &VoxelColors, samples: impl IntoIterator<Item = f64>) -> Carried {
        let mut step = StepColors { voxels: Vec::with_capacity(self.num_voxels), ..StepColors::default() };
        for sample in samples {
            match sample.is_nan() {
                true => step.push_masked(),
                false => step.push(colors.of(sample)),
            }
        }
        assert_eq!(step.voxels.len(), self.num_voxels, "samples of the brick");
        Carried { sums: step.sums(), voxels: step.voxels }
    }
}
