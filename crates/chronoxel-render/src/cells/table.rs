//! The transfer function, integrated beforehand for segments of a ray: a table over the value in front, the value
//! behind, and the length.
//!
//! An entry has the mean extinction between its two values, so that opacities are exact in the length, and the colour of
//! what the segment adds, divided by its opacity, for one of [`NUM_LENGTHS`] lengths: it changes little with the length.
//!
//! Values are cut into bins. For each number of bins between front and back, the segments are all windows of that many
//! bins; compositing is associative, so that each window is the end of one run and the start of the next
//! (van Herk 1992), and the whole table takes three compositing steps per entry.

use chronoxel_core::ResolvedTransfer;
use rayon::prelude::*;

use super::segment::extinction;

/// The largest index of a value.
pub(crate) const LAST_NODE: usize = 254;
/// The index of a missing value: its row and column are transparent.
pub(crate) const NO_VALUE: u32 = 255;
/// Rows, and columns, of a layer.
const STRIDE: usize = 256;
/// Layers: lengths for which colours are known.
pub(crate) const NUM_LENGTHS: usize = 4;
/// Places in a bin at which the transfer function is looked at, between two of its corners.
const LOOKS: usize = 4;

/// A transfer function made ready for the segments of a mesh.
#[derive(Debug)]
pub struct CellTable {
    /// `[length, front, back]`: colour over opacity, and the extinction times `log2 e`.
    pub(crate) entries: Vec<[f32; 4]>,
    /// Value of index 0, and indices per unit of value.
    pub(crate) first_value: f64,
    pub(crate) nodes_per_value: f64,
    pub(crate) longest: f64,
}

/// Extinction and colour of a bin or of a single value.
#[derive(Debug, Clone, Copy, Default)]
struct Matter {
    extinction: f32,
    color: [f32; 3],
}

impl CellTable {
    /// The table of a transfer function.
    ///
    /// * `value_range`: values beyond it are drawn as the nearest one in it; finite, the smaller first
    /// * `unit`: the path length that opacities refer to
    /// * `longest`: the longest segment, > 0
    pub fn new(transfer: &ResolvedTransfer, value_range: [f64; 2], unit: f64, longest: f64) -> Self {
        let [low, high] = value_range;
        let width = if high > low { high - low } else { 1.0 };
        let value = |node: f64| low + width * node / LAST_NODE as f64;
        let bins: Vec<Matter> = (0..LAST_NODE)
            .map(|i| mean_matter(transfer, value(i as f64), value((i + 1) as f64), unit))
            .collect();
        let nodes: Vec<Matter> =
            (0..=LAST_NODE).map(|i| matter(transfer.evaluate(value(i as f64)), unit)).collect();
        let mut entries = vec![[0.0; 4]; NUM_LENGTHS * STRIDE * STRIDE];
        let layers = entries.par_chunks_exact_mut(STRIDE * STRIDE).enumerate();
        layers.for_each(|(layer, entries)| {
            let length = longest * length_of_layer(layer);
            fill_layer(entries, &bins, &nodes, length as f32);
        });
        Self { entries, first_value: low, nodes_per_value: LAST_NODE as f64 / width, longest }
    }

    /// Bytes held in memory.
    pub fn num_bytes(&self) -> usize {
        size_of_val(self.entries.as_slice())
    }
}

/// The length that a layer stands for, in the longest one: the middle of those of one power of 4.
fn length_of_layer(layer: usize) -> f64 {
    0.5 * 0.25f64.powi((NUM_LENGTHS - 1 - layer) as i32)
}

fn matter([r, g, b, opacity]: [f64; 4], unit: f64) -> Matter {
    Matter { extinction: extinction(opacity, unit) as f32, color: [r, g, b].map(|c| c as f32) }
}

/// Mean extinction over a range of values, and the mean colour weighted by it.
fn mean_matter(transfer: &ResolvedTransfer, low: f64, high: f64, unit: f64) -> Matter {
    let mut cuts = vec![low];
    cuts.extend(transfer.points().iter().map(|p| p.x).filter(|x| *x > low && *x < high));
    cuts.push(high);
    let (mut depth, mut color) = (0.0, [0.0; 3]);
    for pair in cuts.windows(2) {
        let width = (pair[1] - pair[0]) / LOOKS as f64;
        for i in 0..LOOKS {
            let [r, g, b, opacity] = transfer.evaluate(pair[0] + (i as f64 + 0.5) * width);
            let part = extinction(opacity, unit) * width;
            depth += part;
            color.iter_mut().zip([r, g, b]).for_each(|(sum, c)| *sum += part * c);
        }
    }
    if depth <= 0.0 {
        return Matter::default();
    }
    Matter { extinction: (depth / (high - low)) as f32, color: color.map(|c| (c / depth) as f32) }
}

/// `1 - exp(-depth)`, relatively exact.
fn opacity_of(depth: f32) -> f32 {
    if depth < 0.01 { depth * (1.0 - depth * (0.5 - depth * (1.0 / 6.0))) } else { 1.0 - (-depth).exp() }
}

/// Premultiplied `front` before `back`.
fn over(front: [f32; 4], back: [f32; 4]) -> [f32; 4] {
    let transmittance = 1.0 - front[3];
    std::array::from_fn(|i| front[i] + transmittance * back[i])
}

/// All entries of one length.
///
/// * `entries`: `[front, back]`
fn fill_layer(entries: &mut [[f32; 4]], bins: &[Matter], nodes: &[Matter], length: f32) {
    for (i, node) in nodes.iter().enumerate() {
        entries[i * STRIDE + i] = entry(*node);
    }
    // Extinction, and colour weighted by it, of all bins before each.
    let mut sums = vec![[0.0f64; 4]; bins.len() + 1];
    for (i, bin) in bins.iter().enumerate() {
        let of = |c: usize| if c < 3 { bin.color[c] * bin.extinction } else { bin.extinction };
        sums[i + 1] = std::array::from_fn(|c| sums[i][c] + f64::from(of(c)));
    }
    let mut runs = Runs::new(bins.len());
    for num in 1..=bins.len() {
        runs.fill(bins, num, length);
        for first in 0..=bins.len() - num {
            let sum: [f64; 4] = std::array::from_fn(|c| sums[first + num][c] - sums[first][c]);
            let mean = (sum[3] / num as f64) as f32;
            let mean_color: [f32; 3] = std::array::from_fn(|c| (sum[c] / sum[3]) as f32);
            let [up, down] = runs.window(first, num);
            let of = |window: [f32; 4]| {
                // Of hardly any opacity, colours are the mean; of none at all there is none.
                let color = match window[3] {
                    a if a > 1e-12 => [window[0] / a, window[1] / a, window[2] / a],
                    _ if mean > 0.0 => mean_color,
                    _ => [0.0; 3],
                };
                entry(Matter { extinction: mean, color })
            };
            entries[first * STRIDE + first + num] = of(up);
            entries[(first + num) * STRIDE + first] = of(down);
        }
    }
}

fn entry(matter: Matter) -> [f32; 4] {
    let [r, g, b] = matter.color;
    [r, g, b, matter.extinction * std::f32::consts::LOG2_E]
}

/// Bins composited from the start of their run, and to its end, in both directions.
struct Runs {
    /// From the start of the run up to and with a bin, rising values.
    up_start: Vec<[f32; 4]>,
    /// From a bin to the end of its run, rising values.
    up_end: Vec<[f32; 4]>,
    /// From a bin down to the start of its run.
    down_start: Vec<[f32; 4]>,
    /// From the end of the run down to a bin.
    down_end: Vec<[f32; 4]>,
}

impl Runs {
    fn new(num_bins: usize) -> Self {
        let none = || vec![[0.0; 4]; num_bins];
        Self { up_start: none(), up_end: none(), down_start: none(), down_end: none() }
    }

    /// * `num`: bins of a run, and of a segment, which has `length`
    fn fill(&mut self, bins: &[Matter], num: usize, length: f32) {
        let per_bin = length / num as f32;
        for (i, bin) in bins.iter().enumerate() {
            let alpha = opacity_of(bin.extinction * per_bin);
            let [r, g, b] = bin.color.map(|c| c * alpha);
            let one = [r, g, b, alpha];
            let is_start = i.is_multiple_of(num);
            self.up_end[i] = one;
            self.up_start[i] = if is_start { one } else { over(self.up_start[i - 1], one) };
            self.down_start[i] = if is_start { one } else { over(one, self.down_start[i - 1]) };
        }
        for i in (0..bins.len()).rev() {
            let one = self.up_end[i];
            let is_end = (i + 1).is_multiple_of(num) || i + 1 == bins.len();
            self.up_end[i] = if is_end { one } else { over(one, self.up_end[i + 1]) };
            self.down_end[i] = if is_end { one } else { over(self.down_end[i + 1], one) };
        }
    }

    /// The bins of a segment, with rising and with falling values.
    fn window(&self, first: usize, num: usize) -> [[f32; 4]; 2] {
        let last = first + num - 1;
        if first.is_multiple_of(num) {
            return [self.up_end[first], self.down_start[last]];
        }
        [over(self.up_end[first], self.up_start[last]), over(self.down_start[last], self.down_end[first])]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cells::segment::integrate_segment;
    use chronoxel_core::{ColorMap, TransferFunction};

    #[test]
    fn entries_are_the_integrals_of_their_segments() {
        for name in TransferFunction::BUILT_IN {
            let function = TransferFunction::built_in(name, ColorMap::Turbo).unwrap();
            let transfer = function.resolve([-1.0, 3.0]).unwrap();
            let (unit, longest) = (0.1, 2.0);
            let table = CellTable::new(&transfer, [-1.0, 3.0], unit, longest);
            for (front, back) in [(0, 254), (254, 0), (10, 11), (200, 100), (120, 121), (90, 170), (215, 215)]
            {
                for layer in 0..NUM_LENGTHS {
                    let length = longest * length_of_layer(layer);
                    let values = [front, back].map(|i: usize| -1.0 + 4.0 * i as f64 / 254.0);
                    let expected = integrate_segment(&transfer, values, length, unit, (1.0, 0.0));
                    let [r, g, b, extinction] = table.entries[(layer * STRIDE + front) * STRIDE + back];
                    let alpha = 1.0 - (-f64::from(extinction) * length).exp2();
                    let found = [r, g, b].map(|c| f64::from(c) * alpha);
                    for (found, expected) in found.into_iter().chain([alpha]).zip(expected) {
                        assert!(
                            (found - expected).abs() < 2e-3,
                            "{name} {front} {back} {layer}: {found} {expected}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn missing_values_are_transparent() {
        let function = TransferFunction::built_in("filled", ColorMap::Gray).unwrap();
        let table = CellTable::new(&function.resolve([0.0, 0.0]).unwrap(), [0.0, 0.0], 1.0, 1.0);
        for i in 0..STRIDE {
            assert_eq!(table.entries[NO_VALUE as usize * STRIDE + i], [0.0; 4]);
            assert_eq!(table.entries[i * STRIDE + NO_VALUE as usize], [0.0; 4]);
        }
        assert!(table.entries.iter().all(|e| e.iter().all(|c| c.is_finite())));
    }
}
