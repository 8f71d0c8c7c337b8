//! A few colours that stand for all colours of a picture.

use std::collections::HashMap;

/// Passes that move each colour to the mean of those it stands for.
const NUM_REFINEMENTS: usize = 2;

/// Colours, and which of them stands for each colour of the picture they were made for.
pub(super) struct Palette {
    pub(super) colors: Vec<[u8; 3]>,
    entry_of: HashMap<[u8; 3], u8>,
}

impl Palette {
    /// At most `max` (1 to 256) colours for a picture, exact where it has no more. The commonest colour, mostly the
    /// background, is always kept as it is, so that it does not flicker from picture to picture.
    ///
    /// The boxes of a variance-based median cut (Heckbert 1982, split at the mean of the axis of largest
    /// squared error) are refined by Lloyd iterations. Deterministic.
    pub(super) fn of(pixels: impl Iterator<Item = [u8; 3]>, max: usize) -> Self {
        let mut found = counted(pixels);
        if found.len() <= max {
            let colors: Vec<[u8; 3]> = found.iter().map(|(color, _)| *color).collect();
            let entry_of = colors.iter().enumerate().map(|(i, color)| (*color, i as u8)).collect();
            return Self { colors, entry_of };
        }
        let commonest = (0..found.len()).max_by_key(|&i| (found[i].1, usize::MAX - i)).unwrap_or(0);
        let kept = found.remove(commonest).0;
        let mut colors = cut(&mut found, max - 1);
        for _ in 0..NUM_REFINEMENTS {
            colors = refined(&found, &colors);
        }
        colors.push(kept);
        let mut entry_of: HashMap<[u8; 3], u8> =
            found.iter().map(|(color, _)| (*color, nearest(&colors, *color) as u8)).collect();
        entry_of.insert(kept, (colors.len() - 1) as u8);
        Self { colors, entry_of }
    }

    /// The entry that stands for a colour of the picture.
    pub(super) fn entry(&self, color: [u8; 3]) -> u8 {
        self.entry_of[&color]
    }
}

/// The distinct colours in order, and how often each occurs.
fn counted(pixels: impl Iterator<Item = [u8; 3]>) -> Vec<([u8; 3], u64)> {
    let mut all: Vec<[u8; 3]> = pixels.collect();
    all.sort_unstable();
    all.chunk_by(|a, b| a == b).map(|equal| (equal[0], equal.len() as u64)).collect()
}

/// Weights of the squared differences of R, G and B: the eye sees green best.
const CHANNEL_WEIGHTS: [i64; 3] = [2, 4, 3];

/// The colour nearest to another, the first of equally near ones.
fn nearest(colors: &[[u8; 3]], color: [u8; 3]) -> usize {
    let distance = |other: &[u8; 3]| -> i64 {
        (0..3).map(|i| CHANNEL_WEIGHTS[i] * (i64::from(other[i]) - i64::from(color[i])).pow(2)).sum()
    };
    (0..colors.len()).min_by_key(|&i| distance(&colors[i])).unwrap_or(0)
}

/// A run of the colours that are represented by one.
struct ColorBox {
    start: usize,
    end: usize,
    /// The channel of largest squared error, and that error.
    axis: usize,
    error: f64,
    /// Mean along that channel.
    mean: f64,
}

impl ColorBox {
    fn new(found: &[([u8; 3], u64)], start: usize, end: usize) -> Self {
        let mut widest = Self { start, end, axis: 0, error: -1.0, mean: 0.0 };
        let weight: f64 = found[start..end].iter().map(|(_, count)| *count as f64).sum();
        for axis in 0..3 {
            let moment = |power: i32| -> f64 {
                let values = found[start..end].iter();
                values.map(|(color, count)| f64::from(color[axis]).powi(power) * *count as f64).sum()
            };
            let mean = moment(1) / weight;
            let error = (moment(2) - weight * mean * mean) * CHANNEL_WEIGHTS[axis] as f64;
            if error > widest.error {
                widest = Self { axis, error, mean, ..widest };
            }
        }
        widest
    }
}

/// Means of `num` boxes (or of as many as there are colours); reorders the colours.
fn cut(found: &mut [([u8; 3], u64)], num: usize) -> Vec<[u8; 3]> {
    let mut boxes = vec![ColorBox::new(found, 0, found.len())];
    while boxes.len() < num {
        let widest = (0..boxes.len())
            .filter(|&i| boxes[i].end - boxes[i].start > 1)
            .max_by(|&i, &j| boxes[i].error.total_cmp(&boxes[j].error).then(j.cmp(&i)));
        let Some(widest) = widest else { break };
        let ColorBox { start, end, axis, mean, .. } = boxes.swap_remove(widest);
        let part = &mut found[start..end];
        part.sort_unstable_by_key(|(color, _)| (color[axis], *color));
        let below = part.partition_point(|(color, _)| f64::from(color[axis]) <= mean);
        let middle = start + below.clamp(1, part.len() - 1);
        boxes.push(ColorBox::new(found, start, middle));
        boxes.push(ColorBox::new(found, middle, end));
    }
    boxes.iter().map(|b| mean_color(found[b.start..b.end].iter()).unwrap_or_default()).collect()
}

/// Mean of counted colours; `None` of none.
fn mean_color<'a>(colors: impl Iterator<Item = &'a ([u8; 3], u64)>) -> Option<[u8; 3]> {
    let (mut sums, mut weight) = ([0u64; 3], 0);
    for (color, count) in colors {
        (0..3).for_each(|i| sums[i] += u64::from(color[i]) * count);
        weight += count;
    }
    (weight > 0).then(|| sums.map(|sum| ((sum + weight / 2) / weight) as u8))
}

/// Each colour moved to the mean of those nearest to it; one that stands for none stays.
fn refined(found: &[([u8; 3], u64)], colors: &[[u8; 3]]) -> Vec<[u8; 3]> {
    let mut members: Vec<Vec<([u8; 3], u64)>> = vec![Vec::new(); colors.len()];
    for counted in found {
        members[nearest(colors, counted.0)].push(*counted);
    }
    members.iter().zip(colors).map(|(of, color)| mean_color(of.iter()).unwrap_or(*color)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_colours_are_kept_exactly() {
        let pixels = [[1, 2, 3], [200, 0, 9], [1, 2, 3]];
        let palette = Palette::of(pixels.into_iter(), 2);
        assert!(pixels.iter().all(|p| palette.colors[usize::from(palette.entry(*p))] == *p));
    }

    #[test]
    fn a_gradient_is_cut_evenly_and_the_background_kept() {
        let gradient = (0..=255u8).flat_map(|r| [[r, 0, 0], [r, 0, 0]]);
        let palette = Palette::of(gradient.chain([[7, 7, 7]; 5000]), 33);
        assert_eq!(palette.colors[usize::from(palette.entry([7, 7, 7]))], [7, 7, 7]);
        // 32 entries over 256 values leave at most half of 8 as the error where they lie evenly.
        let worst =
            (0..=255u8).map(|r| palette.colors[usize::from(palette.entry([r, 0, 0]))][0].abs_diff(r)).max();
        assert!(worst.unwrap() <= 8, "{worst:?}");
    }

    #[test]
    fn one_colour_may_stand_for_all() {
        let palette = Palette::of([[0, 0, 0], [9, 9, 9], [9, 9, 9]].into_iter(), 2);
        assert_eq!(palette.colors.len(), 2);
        let palette = Palette::of((0..=255u8).map(|r| [r, r, r]), 2);
        assert_eq!(palette.colors.len(), 2);
    }
}
