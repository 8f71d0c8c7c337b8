//! Pictures: what a renderer makes, and their PNG form.

use crate::CoreError;

/// What lies behind a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Background {
    /// An opaque sRGB colour, components in [0, 1].
    Color([f32; 3]),
    /// Nothing: alpha is kept.
    Transparent,
}

impl Default for Background {
    fn default() -> Self {
        Self::Color([0.0; 3])
    }
}

/// A picture of premultiplied sRGB colour and opacity, its first row at the top.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    /// Pixels along a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `[row, column]`: red, green, blue (each already multiplied by alpha) and alpha.
    pub pixels: Vec<[f32; 4]>,
}

/// A picture as [`Image`], in 8 bits: what a screen shows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ByteImage {
    /// Pixels along a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `[row, column]`: red, green, blue (each already multiplied by alpha) and alpha.
    pub pixels: Vec<[u8; 4]>,
}

/// Most pixels along one side of a picture.
pub const MAX_IMAGE_EDGE: usize = 32_768;

impl Image {
    /// A transparent picture.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] if a side is 0 or above [`MAX_IMAGE_EDGE`].
    pub fn new(width: usize, height: usize) -> Result<Self, CoreError> {
        check_size([width, height])?;
        Ok(Self { width, height, pixels: vec![[0.0; 4]; width * height] })
    }

    /// The picture in 8 bits, premultiplied as it is.
    pub fn to_bytes(&self) -> ByteImage {
        let byte = |c: f32| (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
        let pixels = self.pixels.iter().map(|pixel| pixel.map(byte)).collect();
        ByteImage { width: self.width, height: self.height, pixels }
    }

    /// The picture before a background, one `[r, g, b, a]` byte quadruple per pixel.
    ///
    /// Colours are sRGB values that were composited as they are, so no transfer curve is applied. Before a colour
    /// alpha is 255; without one, colours are divided by alpha.
    pub fn to_rgba8(&self, background: Background) -> Vec<u8> {
        let byte = |c: f32| (c.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
        let pixel = |p: &[f32; 4]| match background {
            Background::Color(color) => {
                let c: [u8; 3] = std::array::from_fn(|i| byte(p[i] + (1.0 - p[3]) * color[i]));
                [c[0], c[1], c[2], 255]
            }
            Background::Transparent if byte(p[3]) == 0 => [0; 4],
            Background::Transparent => {
                let c: [u8; 3] = std::array::from_fn(|i| byte(p[i] / p[3]));
                [c[0], c[1], c[2], byte(p[3])]
            }
        };
        self.pixels.iter().flat_map(pixel).collect()
    }

    /// The picture as the bytes of a PNG file: 8-bit sRGB, with an alpha channel only where it is kept.
    pub fn to_png(&self, background: Background) -> Vec<u8> {
        let rgba = self.to_rgba8(background);
        match background {
            Background::Transparent => png_bytes(self.width, self.height, png::ColorType::Rgba, &rgba),
            Background::Color(_) => {
                let rgb: Vec<u8> = rgba.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
                png_bytes(self.width, self.height, png::ColorType::Rgb, &rgb)
            }
        }
    }
}

/// Checks the size of a picture, width and height.
///
/// # Errors
/// [`CoreError::InvalidArgument`] if a side is 0 or above [`MAX_IMAGE_EDGE`].
pub fn check_size(size: [usize; 2]) -> Result<(), CoreError> {
    if size.iter().all(|n| (1..=MAX_IMAGE_EDGE).contains(n)) {
        return Ok(());
    }
    let value = format!("{}x{}", size[0], size[1]);
    Err(CoreError::invalid("size of the picture", value, "each side must be between 1 and 32768 pixels"))
}

fn png_bytes(width: usize, height: usize, color: png::ColorType, samples: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width as u32, height as u32);
    encoder.set_color(color);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    let mut writer = encoder.write_header().expect("the size was checked, and memory takes every byte");
    writer.write_image_data(samples).expect("one sample per pixel and channel");
    writer.finish().expect("memory takes every byte");
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image() -> Image {
        let mut image = Image::new(3, 1).unwrap();
        image.pixels = vec![[0.0; 4], [0.25, 0.0, 0.5, 0.5], [1.0, 0.2, 0.0, 1.0]];
        image
    }

    #[test]
    fn bytes_stay_premultiplied() {
        let bytes = image().to_bytes();
        assert_eq!(bytes.pixels, [[0; 4], [64, 0, 128, 128], [255, 51, 0, 255]]);
        assert_eq!([bytes.width, bytes.height], [3, 1]);
    }

    #[test]
    fn bytes_before_a_background() {
        let black = image().to_rgba8(Background::default());
        assert_eq!(black, [0, 0, 0, 255, 64, 0, 128, 255, 255, 51, 0, 255]);
        let white = image().to_rgba8(Background::Color([1.0; 3]));
        assert_eq!(white, [255, 255, 255, 255, 191, 128, 255, 255, 255, 51, 0, 255]);
        let kept = image().to_rgba8(Background::Transparent);
        assert_eq!(kept, [0, 0, 0, 0, 128, 0, 255, 128, 255, 51, 0, 255]);
    }

    #[test]
    fn png_holds_the_bytes() {
        for background in [Background::default(), Background::Transparent] {
            let png = image().to_png(background);
            let mut reader = png::Decoder::new(std::io::Cursor::new(png)).read_info().unwrap();
            let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
            let info = reader.next_frame(&mut bytes).unwrap();
            let channels = info.color_type.samples();
            let expected: Vec<u8> =
                image().to_rgba8(background).chunks(4).flat_map(|p| p[..channels].to_vec()).collect();
            assert_eq!((info.width, info.height, bytes), (3, 1, expected));
        }
    }

    #[test]
    fn sizes_are_bounded() {
        assert!(Image::new(0, 4).is_err());
        assert!(Image::new(1 << 40, 1 << 40).is_err());
    }
}
