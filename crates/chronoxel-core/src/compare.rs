//! How much two pictures differ: PSNR, SSIM, CIE L\*u\*v\* distance, and a picture of the difference.
//!
//! Pixels that are not opaque are compared as they look over black.

use crate::{CoreError, Image8, color};

/// What a comparison of two pictures found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImageDifference {
    /// Peak signal-to-noise ratio over R, G and B, in dB; infinite for equal pictures.
    pub psnr_db: f64,
    /// Mean structural similarity of the lumas, at most 1; `None` where a side is shorter than the window of
    /// 11 pixels.
    pub ssim: Option<f64>,
    /// Mean distance in L\*u\*v\*.
    pub luv_mean: f64,
    /// Largest distance in L\*u\*v\*.
    pub luv_max: f64,
    /// Pixels of which a channel differs, alpha included.
    pub differing_pixels: usize,
}

/// Compares two pictures of one size.
///
/// # Errors
/// [`CoreError::InvalidArgument`] if their sizes differ or they have no pixels.
pub fn compare(a: &Image8, b: &Image8) -> Result<ImageDifference, CoreError> {
    check_sizes(a, b)?;
    let (luv_mean, luv_max) = luv_distance(a, b)?;
    Ok(ImageDifference {
        psnr_db: psnr_db(a, b),
        ssim: ssim(&luma(a), &luma(b), a.width),
        luv_mean,
        luv_max,
        differing_pixels: a.pixels.iter().zip(&b.pixels).filter(|(p, q)| p != q).count(),
    })
}

/// The absolute difference of two pictures per channel, times `gain` and cut at 255; opaque.
///
/// # Errors
/// [`CoreError::InvalidArgument`] if their sizes differ or they have no pixels.
pub fn difference_picture(a: &Image8, b: &Image8, gain: u8) -> Result<Image8, CoreError> {
    check_sizes(a, b)?;
    let pixel = |(p, q): (&[u8; 4], &[u8; 4])| {
        let (p, q) = (over_black(*p), over_black(*q));
        let [r, g, b] = std::array::from_fn(|i| p[i].abs_diff(q[i]).saturating_mul(gain));
        [r, g, b, 255]
    };
    Ok(Image8 {
        width: a.width,
        height: a.height,
        pixels: a.pixels.iter().zip(&b.pixels).map(pixel).collect(),
    })
}

fn check_sizes(a: &Image8, b: &Image8) -> Result<(), CoreError> {
    if (a.width, a.height) != (b.width, b.height) {
        let value = format!("{}x{} against {}x{}", a.width, a.height, b.width, b.height);
        return Err(CoreError::invalid("size of the pictures", value, "only pictures of one size compare"));
    }
    if a.pixels.is_empty() {
        return Err(CoreError::invalid("size of the pictures", "0 pixels", "there is nothing to compare"));
    }
    Ok(())
}

/// A pixel as it looks over black.
fn over_black([r, g, b, a]: [u8; 4]) -> [u8; 3] {
    [r, g, b].map(|c| ((u32::from(c) * u32::from(a) + 127) / 255) as u8)
}

/// `10 log10(255² / mse)`, the mean squared error taken over R, G and B of all pixels.
fn psnr_db(a: &Image8, b: &Image8) -> f64 {
    let squared: u64 = a
        .pixels
        .iter()
        .zip(&b.pixels)
        .map(|(p, q)| {
            let (p, q) = (over_black(*p), over_black(*q));
            (0..3).map(|i| u64::from(p[i].abs_diff(q[i])).pow(2)).sum::<u64>()
        })
        .sum();
    let mse = squared as f64 / (3 * a.pixels.len()) as f64;
    10.0 * (255.0 * 255.0 / mse).log10()
}

/// Rec. 709 luma of each pixel, 0 to 255, not rounded.
fn luma(image: &Image8) -> Vec<f64> {
    let of_pixel = |pixel: &[u8; 4]| {
        let [r, g, b] = over_black(*pixel).map(f64::from);
        0.2126 * r + 0.7152 * g + 0.0722 * b
    };
    image.pixels.iter().map(of_pixel).collect()
}

/// Half the window of SSIM: 11 × 11 pixels.
const RADIUS: usize = 5;

/// Mean structural similarity of two pictures of one channel, over all positions at which the window of
/// 11 × 11 pixels lies inside.
///
/// Wang, Bovik, Sheikh and Simoncelli 2004, equation 13, with Gaussian weights of σ = 1.5, K₁ = 0.01,
/// K₂ = 0.03, and values up to 255.
///
/// Returns `None` where a side is shorter than the window.
fn ssim(a: &[f64], b: &[f64], width: usize) -> Option<f64> {
    let height = a.len() / width;
    if width.min(height) < 2 * RADIUS + 1 {
        return None;
    }
    let product = |p: &[f64], q: &[f64]| -> Vec<f64> { p.iter().zip(q).map(|(x, y)| x * y).collect() };
    let mean_a = gaussian_means(a, width);
    let mean_b = gaussian_means(b, width);
    let square_a = gaussian_means(&product(a, a), width);
    let square_b = gaussian_means(&product(b, b), width);
    let cross = gaussian_means(&product(a, b), width);
    let (c1, c2) = ((0.01f64 * 255.0).powi(2), (0.03f64 * 255.0).powi(2));
    let similarity = |i: usize| {
        let (ma, mb) = (mean_a[i], mean_b[i]);
        let (variance_a, variance_b) = (square_a[i] - ma * ma, square_b[i] - mb * mb);
        let covariance = cross[i] - ma * mb;
        (2.0 * ma * mb + c1) * (2.0 * covariance + c2)
            / ((ma * ma + mb * mb + c1) * (variance_a + variance_b + c2))
    };
    Some((0..mean_a.len()).map(similarity).sum::<f64>() / mean_a.len() as f64)
}

/// Gaussian-weighted means around every pixel whose window lies inside the picture.
fn gaussian_means(values: &[f64], width: usize) -> Vec<f64> {
    let raw: [f64; 2 * RADIUS + 1] = std::array::from_fn(|i| {
        let distance = i as f64 - RADIUS as f64;
        (-0.5 * (distance / 1.5).powi(2)).exp()
    });
    let weights = raw.map(|w| w / raw.iter().sum::<f64>());
    let inner = width - 2 * RADIUS;
    let weighted = |window: &[f64]| window.iter().zip(&weights).map(|(v, w)| v * w).sum::<f64>();
    let rows: Vec<f64> =
        values.chunks_exact(width).flat_map(|row| row.windows(2 * RADIUS + 1).map(weighted)).collect();
    let num_rows = rows.len() / inner - 2 * RADIUS;
    let column = |start: usize| (0..weights.len()).map(|k| rows[start + k * inner] * weights[k]).sum();
    (0..num_rows * inner).map(column).collect()
}

/// Mean and largest L\*u\*v\* distance (D65) of the pixels of two pictures of one size.
///
/// # Errors
/// [`CoreError::InvalidArgument`] if their sizes differ or they have no pixels.
pub fn luv_distance(a: &Image8, b: &Image8) -> Result<(f64, f64), CoreError> {
    check_sizes(a, b)?;
    let linear: Vec<f64> = (0..=255).map(|c| color::linear_from_srgb(f64::from(c) / 255.0)).collect();
    let luv = |pixel: [u8; 4]| color::luv_from_linear(over_black(pixel).map(|c| linear[usize::from(c)]));
    let distance = |(p, q): (&[u8; 4], &[u8; 4])| {
        if p == q {
            return 0.0;
        }
        let (p, q) = (luv(*p), luv(*q));
        (0..3).map(|i| (p[i] - q[i]).powi(2)).sum::<f64>().sqrt()
    };
    let (sum, max) = a
        .pixels
        .iter()
        .zip(&b.pixels)
        .map(distance)
        .fold((0.0, 0.0f64), |(sum, max), distance| (sum + distance, max.max(distance)));
    Ok((sum / a.pixels.len() as f64, max))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gray(width: usize, height: usize, value: u8) -> Image8 {
        Image8::filled(width, height, [value, value, value, 255])
    }

    #[test]
    fn equal_pictures_do_not_differ() {
        let found = compare(&gray(12, 11, 80), &gray(12, 11, 80)).unwrap();
        let expected = ImageDifference {
            psnr_db: f64::INFINITY,
            ssim: Some(1.0),
            luv_mean: 0.0,
            luv_max: 0.0,
            differing_pixels: 0,
        };
        assert_eq!(
            ImageDifference { ssim: found.ssim.map(|s| (s * 1e12).round() / 1e12), ..found },
            expected
        );
    }

    #[test]
    fn flat_pictures_have_closed_forms() {
        // A constant offset d has mse d²; SSIM of constants is its luminance term alone.
        let found = compare(&gray(20, 20, 100), &gray(20, 20, 110)).unwrap();
        assert!((found.psnr_db - 20.0 * (25.5f64).log10()).abs() < 1e-12);
        let c1 = 6.5025;
        let luminance = (2.0 * 100.0 * 110.0 + c1) / (100.0 * 100.0 + 110.0 * 110.0 + c1);
        assert!((found.ssim.unwrap() - luminance).abs() < 1e-9);
        assert_eq!(found.differing_pixels, 400);
    }

    #[test]
    fn luv_distance_of_known_colours() {
        // Black to white is 100 units of lightness; red to green by their published coordinates
        // (53.24, 175.01, 37.76) and (87.73, −83.08, 107.40): √(34.49² + 258.09² + 69.64²).
        let pair = |p: [u8; 3], q: [u8; 3]| {
            let filled = |c: [u8; 3]| Image8::filled(1, 1, [c[0], c[1], c[2], 255]);
            compare(&filled(p), &filled(q)).unwrap().luv_max
        };
        assert!((pair([0; 3], [255; 3]) - 100.0).abs() < 1e-3);
        assert!((pair([255, 0, 0], [0, 255, 0]) - 269.54).abs() < 0.02);
    }

    #[test]
    fn mean_and_max_are_over_pixels() {
        let (a, mut b) = (gray(4, 1, 0), gray(4, 1, 0));
        b.pixels[2] = [255; 4];
        let found = compare(&a, &b).unwrap();
        assert!((found.luv_max - 100.0).abs() < 1e-3 && (found.luv_mean - 25.0).abs() < 1e-3);
        assert_eq!((found.differing_pixels, found.ssim), (1, None));
    }

    #[test]
    fn pictures_with_alpha_are_compared_over_black() {
        let half = Image8::filled(1, 1, [200, 100, 0, 128]);
        let opaque = Image8::filled(1, 1, [100, 50, 0, 255]);
        let found = compare(&half, &opaque).unwrap();
        assert_eq!((found.psnr_db, found.differing_pixels), (f64::INFINITY, 1));
    }

    #[test]
    fn difference_is_amplified_and_cut() {
        let mut b = gray(2, 1, 10);
        b.pixels[1] = [0, 110, 12, 255];
        let picture = difference_picture(&gray(2, 1, 10), &b, 4).unwrap();
        assert_eq!(picture.pixels, [[0, 0, 0, 255], [40, 255, 8, 255]]);
    }

    #[test]
    fn sizes_must_agree() {
        let error = compare(&gray(2, 3, 0), &gray(3, 2, 0)).unwrap_err().to_string();
        assert!(error.contains("2x3 against 3x2"), "{error}");
        assert!(compare(&gray(0, 0, 0), &gray(0, 0, 0)).is_err());
        assert!(difference_picture(&gray(1, 1, 0), &gray(2, 1, 0), 1).is_err());
    }
}
