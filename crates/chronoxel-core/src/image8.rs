//! Pictures of 8 bits per channel: what files hold, what is compared, what annotations are drawn on.

use crate::{Background, CoreError, Image};

/// A picture of 8-bit sRGB with straight alpha, its first row at the top.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image8 {
    /// Pixels along a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `[row, column]`: red, green, blue, alpha; alpha 255 is opaque, and colours are not multiplied by it.
    pub pixels: Vec<[u8; 4]>,
}

impl Image8 {
    /// A picture of one colour.
    pub fn filled(width: usize, height: usize, pixel: [u8; 4]) -> Self {
        Self { width, height, pixels: vec![pixel; width * height] }
    }

    /// A picture from its bytes, four per pixel.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] if there are not `width * height * 4` bytes.
    pub fn from_rgba(width: usize, height: usize, bytes: &[u8]) -> Result<Self, CoreError> {
        let num_pixels = width.checked_mul(height);
        if !bytes.len().is_multiple_of(4) || num_pixels != Some(bytes.len() / 4) {
            let value = format!("{} for {width}x{height}", bytes.len());
            return Err(CoreError::invalid("number of picture bytes", value, "four per pixel are needed"));
        }
        let pixels = bytes.chunks_exact(4).map(|p| [p[0], p[1], p[2], p[3]]).collect();
        Ok(Self { width, height, pixels })
    }

    /// A rendered picture before a background.
    pub fn from_image(image: &Image, background: Background) -> Self {
        let bytes = image.to_rgba8(background);
        let pixels = bytes.chunks_exact(4).map(|p| [p[0], p[1], p[2], p[3]]).collect();
        Self { width: image.width, height: image.height, pixels }
    }

    /// A picture of nothing but a background.
    pub fn of_background(width: usize, height: usize, background: Background) -> Self {
        let pixel = match background {
            Background::Color(color) => {
                let [r, g, b] = color.map(|c| (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8);
                [r, g, b, 255]
            }
            Background::Transparent => [0; 4],
        };
        Self::filled(width, height, pixel)
    }

    /// Composites a rendered picture over this one, e.g. over the edges behind the volume.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] if their sizes differ.
    pub fn composite(&mut self, above: &Image) -> Result<(), CoreError> {
        if (self.width, self.height) != (above.width, above.height) {
            let value = format!("{}x{} over {}x{}", above.width, above.height, self.width, self.height);
            return Err(CoreError::invalid("size of the pictures", value, "both must have one size"));
        }
        for (pixel, p) in self.pixels.iter_mut().zip(&above.pixels) {
            let below = f32::from(pixel[3]) / 255.0 * (1.0 - p[3]);
            let alpha = p[3] + below;
            if alpha <= 0.0 {
                continue;
            }
            for (channel, premultiplied) in pixel.iter_mut().zip(&p[..3]) {
                let mixed = (premultiplied * 255.0 + f32::from(*channel) * below) / alpha;
                *channel = (mixed.clamp(0.0, 255.0) + 0.5) as u8;
            }
            pixel[3] = (alpha.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
        }
        Ok(())
    }

    /// Composites a colour of some coverage in [0, 1] over a pixel; outside the picture nothing happens.
    ///
    /// sRGB values are composited as they are, like those of a transfer function (over, Porter and Duff 1984).
    pub fn blend(&mut self, x: i64, y: i64, color: [u8; 3], coverage: f32) {
        let inside = |v: i64, n: usize| usize::try_from(v).ok().filter(|v| *v < n);
        let (Some(column), Some(row)) = (inside(x, self.width), inside(y, self.height)) else { return };
        let pixel = &mut self.pixels[row * self.width + column];
        let coverage = coverage.clamp(0.0, 1.0);
        let below = f32::from(pixel[3]) / 255.0 * (1.0 - coverage);
        let alpha = coverage + below;
        if alpha <= 0.0 {
            return;
        }
        for (channel, above) in pixel.iter_mut().zip(color) {
            let mixed = (f32::from(above) * coverage + f32::from(*channel) * below) / alpha;
            *channel = (mixed + 0.5) as u8;
        }
        pixel[3] = (alpha * 255.0 + 0.5) as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blending_follows_the_over_operator() {
        let mut image = Image8::filled(3, 1, [100, 0, 200, 255]);
        image.pixels[1] = [0; 4];
        image.blend(0, 0, [200, 100, 0], 0.5);
        image.blend(1, 0, [200, 100, 0], 0.5);
        image.blend(2, 0, [200, 100, 0], 0.0);
        image.blend(3, 0, [200, 100, 0], 1.0);
        image.blend(0, -1, [200, 100, 0], 1.0);
        assert_eq!(image.pixels, [[150, 50, 100, 255], [200, 100, 0, 128], [100, 0, 200, 255]]);
    }

    #[test]
    fn compositing_over_a_background_is_rendering_before_it() {
        let mut image = Image::new(3, 1).unwrap();
        image.pixels = vec![[0.0; 4], [0.25, 0.0, 0.5, 0.5], [1.0, 0.2, 0.0, 1.0]];
        for background in [Background::Color([1.0, 0.0, 0.2]), Background::Transparent] {
            let mut composed = Image8::of_background(3, 1, background);
            composed.composite(&image).unwrap();
            assert_eq!(composed, Image8::from_image(&image, background));
        }
        assert!(Image8::filled(2, 1, [0; 4]).composite(&image).is_err());
    }

    #[test]
    fn bytes_must_fit_the_size() {
        assert!(Image8::from_rgba(2, 1, &[0; 8]).is_ok());
        for (width, height, num_bytes) in [(2, 1, 7), (2, 2, 8), (usize::MAX, 8, 8), (0, 0, 4)] {
            assert!(Image8::from_rgba(width, height, &vec![0; num_bytes]).is_err());
        }
    }
}
