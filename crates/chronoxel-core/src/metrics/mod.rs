//! Colour metrics: how far the colours of a node differ over space and over time (ellsworth2000, sections 5.2 and 5.3).
//!
//! The *reference* metrics ([`BrickColors`], [`ColorSums`]) look at every voxel; they measure. The *approximate* ones
//! ([`approximate_spatial`], [`approximate_temporal`]) follow from the stored statistics of a node and a table of the
//! transfer function ([`ColorTable`]), and are made anew whenever the function changes.
//!
//! Whether an error is 0 is decided by comparing colours and by the facts of a node, never by a computed zero: an error of 0 says
//! that nothing differs, and everywhere else it is at least [`f64::MIN_POSITIVE`]. What is transparent has one colour, and so
//! has what is masked: both draw nothing.
//!
//! # Where the two differ
//!
//! The approximate spatial metric takes the samples of a node as normally distributed between their smallest and largest. Where they are, it is within
//! 2 % of the reference; with the built-in functions over Turbo, in RGB:
//!
//! | samples | approximate / reference error | opacity of the mean |
//! | --- | --- | --- |
//! | normal, 3 deviations inside the range | 0.99 | same |
//! | equally often everywhere | 0.85–0.94: too few near the ends | same; `sparse` a fifth less |
//! | two values | 0.58 where they are near: it sees those between | same |
//! | 99 % at the smallest value, the others anywhere above (a plume) | 0.15 (`ramp`) to 0.8 (`filled`) | `ramp` 8 times, `filled` 1.2 times |
//!
//! The last row is the worst: a few samples make the deviation wide, and half of the normal distribution lies below the smallest sample and is cut off, so
//! that the mean moves up. Nodes partly in a plume are taken as more alike, and drawn as constants as more opaque, than they are. Smaller nodes help.
//!
//! The other way round, the reference looks at voxels and the approximation at entries between them: two voxels on either side of a
//! visible range of values have the same look, and a reference error of 0, though what is interpolated between them is visible. [`has_one_color`]
//! says what holds for every value between.
//!
//! The temporal metrics differ in scale. That of equation 20 is a property of the table: about the total change of colour over √(number of
//! entries) for a smooth function, 0.03 to 0.11 for the built-in ones with 256 entries, so that e_act was 10 to 40 times smaller than e_rct for samples that waver, with
//! `sparse` nearest. It ranks nodes under one function; tolerances of the two do not compare, and neither do those of e_act with other numbers of entries.

mod approximate;
mod reference;
mod table;
mod voxel_colors;

pub use approximate::{ColorEstimate, approximate_spatial, approximate_temporal, has_one_color};
pub use reference::{BrickColors, ColorSums};
pub use table::ColorTable;
pub use voxel_colors::VoxelColors;

use crate::color::{linear_from_srgb, luv_from_linear};

/// In which coordinates the distances of colours are measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum ColorSpace {
    /// sRGB components in [0, 1], as in ellsworth2000.
    #[default]
    Rgb,
    /// CIE 1976 L\*u\*v\* (D65) divided by 100: in that paper future work. Lightness is in [0, 1], and u\* and v\* within ±1.8.
    Luv,
}

impl ColorSpace {
    /// Coordinates of an sRGB colour.
    pub fn coordinates(self, srgb: [f64; 3]) -> [f64; 3] {
        match self {
            Self::Rgb => srgb,
            Self::Luv => luv_from_linear(srgb.map(linear_from_srgb)).map(|c| c / 100.0),
        }
    }
}

/// Squared distance of two colours, weighed by the opacity of the first (eq. 7).
fn distance(c1: [f64; 3], alpha1: f64, c2: [f64; 3], alpha2: f64) -> f64 {
    let apart: [f64; 3] = std::array::from_fn(|i| c1[i] - c2[i]);
    alpha1 * dot(apart, apart) + (alpha1 - alpha2) * (alpha1 - alpha2)
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Deviation over mean (eq. 10, 13, 19) of colours that are not all one: more than 0, and finite.
///
/// * `squared_deviation`: mean of the distances from the mean colour (eq. 9), ≥ 0 but for rounding
/// * `color`, `alpha`: the mean colour
fn ratio(squared_deviation: f64, color: [f64; 3], alpha: f64) -> f64 {
    let squared_mean = distance(color, alpha, [0.0; 3], 0.0);
    if squared_mean <= 0.0 {
        return f64::MIN_POSITIVE;
    }
    (squared_deviation.max(0.0) / squared_mean).sqrt().clamp(f64::MIN_POSITIVE, f64::MAX)
}
