//! The colour maps that transfer functions are built over.
//!
//! viridis and inferno are the maps of the Python package matplotlib (released under CC0), turbo is that of
//! Mikhailov (2019, Apache-2.0); they are kept as the fewest control points that reproduce the published
//! tables of 256 entries to 1/255 when interpolated linearly. coolwarm is computed from its definition.

use std::{fmt, str::FromStr};

use crate::{CoreError, color};

/// A named map from [0, 1] to sRGB colours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum ColorMap {
    /// Perceptually uniform, dark violet to yellow.
    #[default]
    Viridis,
    /// Perceptually uniform, black to pale yellow through red.
    Inferno,
    /// A smooth rainbow.
    Turbo,
    /// Diverging, blue to red through grey.
    Coolwarm,
    /// Black to white.
    Gray,
}

impl ColorMap {
    /// All maps.
    pub const ALL: [Self; 5] = [Self::Viridis, Self::Inferno, Self::Turbo, Self::Coolwarm, Self::Gray];

    /// The lower-case name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Viridis => "viridis",
            Self::Inferno => "inferno",
            Self::Turbo => "turbo",
            Self::Coolwarm => "coolwarm",
            Self::Gray => "gray",
        }
    }

    /// Control points `(x, sRGB)`, x increasing from 0 to 1, to be interpolated linearly.
    pub fn points(self) -> Vec<(f64, [f32; 3])> {
        match self {
            Self::Viridis => points_of_table(&VIRIDIS),
            Self::Inferno => points_of_table(&INFERNO),
            Self::Turbo => points_of_table(&TURBO),
            Self::Coolwarm => coolwarm_points(),
            Self::Gray => vec![(0.0, [0.0; 3]), (1.0, [1.0; 3])],
        }
    }
}

impl fmt::Display for ColorMap {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for ColorMap {
    type Err = CoreError;

    fn from_str(text: &str) -> Result<Self, CoreError> {
        Self::ALL.into_iter().find(|m| m.name() == text).ok_or_else(|| {
            CoreError::invalid("colour map", text, "use one of viridis inferno turbo coolwarm gray")
        })
    }
}

fn points_of_table(table: &[(u8, u32)]) -> Vec<(f64, [f32; 3])> {
    let component = |rgb: u32, shift: u32| (rgb >> shift & 255) as f32 / 255.0;
    table
        .iter()
        .map(|&(i, rgb)| (f64::from(i) / 255.0, [16, 8, 0].map(|shift| component(rgb, shift))))
        .collect()
}

/// Moreland's diverging map from (80, 1.08, −1.1) to (80, 1.08, 0.5) in Msh, at 65 points.
fn coolwarm_points() -> Vec<(f64, [f32; 3])> {
    let (cool, warm) = ([80.0, 1.08, -1.1], [80.0, 1.08, 0.5]);
    (0..=64)
        .map(|i| {
            let x = f64::from(i) / 64.0;
            let rgb = color::srgb_from_lab(color::lab_from_msh(color::diverging(cool, warm, x)));
            (x, rgb.map(|c| c as f32))
        })
        .collect()
}

#[rustfmt::skip]
const VIRIDIS: [(u8, u32); 16] = [
    (0, 0x440154), (19, 0x481c6e), (35, 0x46307e), (55, 0x3f4889), (88, 0x2f6b8e), (127, 0x21908d),
    (141, 0x1e9d89), (154, 0x23a983), (166, 0x2fb47c), (181, 0x48c16e), (197, 0x69cd5b), (218, 0x9dd93b),
    (236, 0xcde11d), (243, 0xdfe318), (249, 0xefe51c), (255, 0xfde725),
];

#[rustfmt::skip]
const INFERNO: [(u8, u32); 21] = [
    (0, 0x000004), (4, 0x02010a), (12, 0x07051b), (25, 0x160b39), (35, 0x260c51), (44, 0x360961),
    (56, 0x4a0c6b), (71, 0x62146e), (91, 0x82206c), (114, 0xa62d60), (136, 0xc73e4c), (158, 0xe25734),
    (178, 0xf3761b), (194, 0xfa9207), (201, 0xfc9f07), (209, 0xfcae12), (223, 0xf9c932), (233, 0xf4dd4f),
    (242, 0xf1ed71), (250, 0xf5f992), (255, 0xfcffa4),
];

#[rustfmt::skip]
const TURBO: [(u8, u32); 30] = [
    (0, 0x30123b), (7, 0x38276d), (14, 0x3f3b97), (22, 0x4451bf), (30, 0x4666dd), (36, 0x4776ee),
    (43, 0x4687fb), (49, 0x4196ff), (56, 0x37a8fa), (63, 0x2ab9ee), (74, 0x1ad2d2), (81, 0x18dec0),
    (85, 0x1ae4b6), (92, 0x27eea4), (100, 0x3ff68a), (113, 0x71fe5f), (123, 0x96fe44), (131, 0xacfb38),
    (139, 0xc1f334), (153, 0xe1dd37), (164, 0xf4c73a), (172, 0xfbb637), (181, 0xfe9e2f), (192, 0xfb7e21),
    (205, 0xef5811), (214, 0xe2430a), (227, 0xca2a04), (241, 0xa71401), (254, 0x7e0502), (255, 0x7a0403),
];

#[cfg(test)]
mod tests {
    use super::*;

    fn color_at(map: ColorMap, x: f64) -> [f64; 3] {
        let points = map.points();
        let right = points.partition_point(|p| p.0 < x).max(1);
        let ((x0, a), (x1, b)) = (points[right - 1], points[right]);
        let w = (x - x0) / (x1 - x0);
        std::array::from_fn(|i| f64::from(a[i]) + (f64::from(b[i]) - f64::from(a[i])) * w)
    }

    /// Entries of the tables of matplotlib 3.11.2 (`matplotlib.colormaps[name](entry)`).
    #[test]
    fn maps_agree_with_the_published_tables() {
        let expected: [(ColorMap, u8, [f64; 3]); 16] = [
            (ColorMap::Viridis, 37, [0.274128, 0.199721, 0.498911]),
            (ColorMap::Viridis, 100, [0.166617, 0.463708, 0.558119]),
            (ColorMap::Viridis, 150, [0.128087, 0.647749, 0.523491]),
            (ColorMap::Viridis, 230, [0.741388, 0.873449, 0.149561]),
            (ColorMap::Inferno, 37, [0.162689, 0.043554, 0.333277]),
            (ColorMap::Inferno, 100, [0.565854, 0.143567, 0.408258]),
            (ColorMap::Inferno, 150, [0.851384, 0.30226, 0.239636]),
            (ColorMap::Inferno, 230, [0.964394, 0.843848, 0.273391]),
            (ColorMap::Turbo, 37, [0.2768, 0.47151, 0.94214]),
            (ColorMap::Turbo, 128, [0.64362, 0.98999, 0.23356]),
            (ColorMap::Turbo, 191, [0.9859, 0.50479, 0.13367]),
            (ColorMap::Turbo, 230, [0.76476, 0.14374, 0.01041]),
            (ColorMap::Coolwarm, 0, [0.229806, 0.298718, 0.753683]),
            (ColorMap::Coolwarm, 64, [0.554312, 0.690097, 0.995516]),
            (ColorMap::Coolwarm, 191, [0.958279, 0.604335, 0.483297]),
            (ColorMap::Coolwarm, 255, [0.705673, 0.015556, 0.150233]),
        ];
        for (map, entry, rgb) in expected {
            let found = color_at(map, f64::from(entry) / 255.0);
            // coolwarm's published table is itself rounded in places, by up to 1.5/255.
            let tolerance = if map == ColorMap::Coolwarm { 1.6 / 255.0 } else { 1.0 / 255.0 };
            let worst = (0..3).map(|i| (found[i] - rgb[i]).abs()).fold(0.0, f64::max);
            assert!(worst < tolerance, "{map} at {entry}: {found:?}, published {rgb:?}");
        }
    }

    #[test]
    fn points_span_zero_to_one() {
        for map in ColorMap::ALL {
            let points = map.points();
            assert_eq!((points[0].0, points[points.len() - 1].0), (0.0, 1.0));
            assert!(points.is_sorted_by(|a, b| a.0 < b.0));
            assert_eq!(map.name().parse::<ColorMap>().unwrap(), map);
        }
        assert!("jet".parse::<ColorMap>().is_err());
    }
}
