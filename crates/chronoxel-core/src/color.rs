//! Conversions between the colour spaces that colour maps are defined in.
//!
//! sRGB is IEC 61966-2-1, Lab is CIE 1976 with the D65 white point, and Msh is the polar form of Lab
//! in which diverging maps are defined (Moreland, *Diverging Color Maps for Scientific
//! Visualization*, 2009): `M` the length, `s` the angle from the lightness axis, `h` the hue.

const WHITE_D65: [f64; 3] = [0.95047, 1.0, 1.08883];

/// Linear light of an sRGB component in [0, 1].
pub(crate) fn linear_from_srgb(c: f64) -> f64 {
    if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
}

/// sRGB component of linear light, clamped to [0, 1].
fn srgb_from_linear(c: f64) -> f64 {
    let c = if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
    c.clamp(0.0, 1.0)
}

/// CIE XYZ of linear light in the sRGB primaries.
fn xyz_from_linear([r, g, b]: [f64; 3]) -> [f64; 3] {
    [
        0.412_456_4 * r + 0.357_576_1 * g + 0.180_437_5 * b,
        0.212_672_9 * r + 0.715_152_2 * g + 0.072_175_0 * b,
        0.019_333_9 * r + 0.119_192_0 * g + 0.950_304_1 * b,
    ]
}

/// CIE 1976 L\*u\*v\* (D65) of linear light in the sRGB primaries; black is (0, 0, 0).
pub(crate) fn luv_from_linear(rgb: [f64; 3]) -> [f64; 3] {
    let chromaticity = |[x, y, z]: [f64; 3]| {
        let sum = x + 15.0 * y + 3.0 * z;
        [4.0 * x / sum, 9.0 * y / sum]
    };
    let xyz = xyz_from_linear(rgb);
    if xyz[1] <= 0.0 {
        return [0.0; 3];
    }
    let lightness =
        if xyz[1] > 216.0 / 24389.0 { 116.0 * xyz[1].cbrt() - 16.0 } else { 24389.0 / 27.0 * xyz[1] };
    let (here, white) = (chromaticity(xyz), chromaticity(WHITE_D65));
    [lightness, 13.0 * lightness * (here[0] - white[0]), 13.0 * lightness * (here[1] - white[1])]
}

/// CIE Lab (D65) of an sRGB colour.
pub fn lab_from_srgb(rgb: [f64; 3]) -> [f64; 3] {
    let xyz = xyz_from_linear(rgb.map(linear_from_srgb));
    let f: [f64; 3] = std::array::from_fn(|i| {
        let t = xyz[i] / WHITE_D65[i];
        if t > 216.0 / 24389.0 { t.cbrt() } else { (24389.0 / 27.0 * t + 16.0) / 116.0 }
    });
    [116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])]
}

/// sRGB of a CIE Lab (D65) colour, clamped to the gamut.
pub fn srgb_from_lab(lab: [f64; 3]) -> [f64; 3] {
    let fy = (lab[0] + 16.0) / 116.0;
    let f = [fy + lab[1] / 500.0, fy, fy - lab[2] / 200.0];
    let [x, y, z]: [f64; 3] = std::array::from_fn(|i| {
        let t = if f[i] > 6.0 / 29.0 { f[i].powi(3) } else { (116.0 * f[i] - 16.0) * 27.0 / 24389.0 };
        t * WHITE_D65[i]
    });
    [
        3.240_454_2 * x - 1.537_138_5 * y - 0.498_531_4 * z,
        -0.969_266_0 * x + 1.876_010_8 * y + 0.041_556_0 * z,
        0.055_643_4 * x - 0.204_025_9 * y + 1.057_225_2 * z,
    ]
    .map(srgb_from_linear)
}

/// Msh of a Lab colour.
pub fn msh_from_lab([l, a, b]: [f64; 3]) -> [f64; 3] {
    let m = (l * l + a * a + b * b).sqrt();
    if m < 1e-9 { [0.0; 3] } else { [m, (l / m).clamp(-1.0, 1.0).acos(), b.atan2(a)] }
}

/// Lab of an Msh colour.
pub fn lab_from_msh([m, s, h]: [f64; 3]) -> [f64; 3] {
    [m * s.cos(), m * s.sin() * h.cos(), m * s.sin() * h.sin()]
}

/// A colour between two in Msh, by way of white where both are saturated and their hues differ
/// (Moreland 2009, figure 6), `x` from 0 to 1.
pub fn diverging(low: [f64; 3], high: [f64; 3], x: f64) -> [f64; 3] {
    let (mut from, mut to, mut x) = (low, high, x);
    let hue_distance = {
        let d = (from[2] - to[2]).abs();
        d.min(std::f64::consts::TAU - d)
    };
    if from[1] > 0.05 && to[1] > 0.05 && hue_distance > std::f64::consts::FRAC_PI_3 {
        let white = [from[0].max(to[0]).max(88.0), 0.0, 0.0];
        if x < 0.5 {
            (to, x) = (white, 2.0 * x);
        } else {
            (from, x) = (white, 2.0 * x - 1.0);
        }
    }
    if from[1] < 0.05 && to[1] > 0.05 {
        from[2] = spun_hue(to, from[0]);
    } else if to[1] < 0.05 && from[1] > 0.05 {
        to[2] = spun_hue(from, to[0]);
    }
    std::array::from_fn(|i| from[i] + (to[i] - from[i]) * x)
}

/// Hue that a saturated colour should turn to on its way to an unsaturated one of length `m`.
fn spun_hue([ms, ss, hs]: [f64; 3], m: f64) -> f64 {
    if ms >= m {
        return hs;
    }
    let spin = ss * (m * m - ms * ms).sqrt() / (ms * ss.sin());
    if hs > -std::f64::consts::FRAC_PI_3 { hs + spin } else { hs - spin }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lab_of_known_colours() {
        // Values of CIE 1976 for sRGB red and mid grey, as published by colour calculators.
        let red = lab_from_srgb([1.0, 0.0, 0.0]);
        for (found, expected) in red.iter().zip([53.24, 80.09, 67.20]) {
            assert!((found - expected).abs() < 0.02, "{red:?}");
        }
        assert!((lab_from_srgb([0.5; 3])[0] - 53.39).abs() < 0.01);
    }

    #[test]
    fn luv_of_known_colours() {
        // CIE 1976 coordinates of the sRGB primaries, white and mid grey, as colour calculators publish them.
        let published = [
            ([1.0, 0.0, 0.0], [53.24, 175.01, 37.76]),
            ([0.0, 1.0, 0.0], [87.73, -83.08, 107.40]),
            ([0.0, 0.0, 1.0], [32.30, -9.40, -130.34]),
            ([1.0, 1.0, 1.0], [100.0, 0.0, 0.0]),
            ([0.5, 0.5, 0.5], [53.39, 0.0, 0.0]),
            ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        ];
        for (rgb, expected) in published {
            let found = luv_from_linear(rgb.map(linear_from_srgb));
            assert!((0..3).all(|i| (found[i] - expected[i]).abs() < 0.02), "{rgb:?}: {found:?}");
        }
    }

    #[test]
    fn conversions_are_inverse() {
        for rgb in [[0.1, 0.5, 0.9], [0.0; 3], [1.0; 3], [0.02, 0.01, 0.03]] {
            let back = srgb_from_lab(lab_from_msh(msh_from_lab(lab_from_srgb(rgb))));
            assert!((0..3).all(|i| (back[i] - rgb[i]).abs() < 2e-5), "{rgb:?} {back:?}");
        }
    }
}
