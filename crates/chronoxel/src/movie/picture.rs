//! Single pictures: 8-bit PNG, written and read.

use std::fs::File;
use std::io::{BufReader, BufWriter, Write};
use std::path::Path;

use anyhow::{Context, Result, bail};
use chronoxel_core::Image8;
use png::{BitDepth, ColorType, Transformations};

use super::pending::PendingFile;

/// The largest picture that is read: 2^28 pixels, 1 GiB.
const MAX_PIXELS: u64 = 1 << 28;

/// No byte of a deflate stream makes more than 1032 bytes.
const MAX_EXPANSION: u64 = 1032;

/// Writes a picture as an 8-bit sRGB PNG, with an alpha channel only where a pixel is not opaque.
/// Folders are made as needed; nothing is left under the name on failure.
///
/// # Errors
/// If the file cannot be written.
pub fn write_png(path: &Path, image: &Image8) -> Result<()> {
    let file = PendingFile::new(path)?;
    encode(image, &file)?;
    file.publish()
}

/// Writes a picture into a file that is not published yet.
pub(super) fn encode(image: &Image8, file: &PendingFile) -> Result<()> {
    let opaque = image.pixels.iter().all(|pixel| pixel[3] == 255);
    let kept = if opaque { 3 } else { 4 };
    let bytes: Vec<u8> = image.pixels.iter().flat_map(|pixel| &pixel[..kept]).copied().collect();
    let mut output = BufWriter::new(file.create()?);
    let mut write = || -> Result<()> {
        let mut encoder = png::Encoder::new(&mut output, image.width as u32, image.height as u32);
        set_format(&mut encoder, if opaque { ColorType::Rgb } else { ColorType::Rgba });
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&bytes)?;
        writer.finish()?;
        Ok(output.flush()?)
    };
    write().with_context(|| format!("cannot write '{}'", file.target().display()))
}

/// 8 bits, sRGB, and the compression all our PNGs have.
pub(super) fn set_format<W: Write>(encoder: &mut png::Encoder<'_, W>, color: ColorType) {
    encoder.set_color(color);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    encoder.set_compression(png::Compression::Balanced);
}

/// Reads a PNG of any kind as 8-bit RGBA; 16-bit samples are rounded to 8, of an animation the first
/// picture is taken.
///
/// # Errors
/// If the file cannot be read, is not a PNG, is damaged, or has more than 2^28 pixels.
pub fn read_png(path: &Path) -> Result<Image8> {
    let name = path.display();
    let file = File::open(path).with_context(|| format!("cannot open picture '{name}'"))?;
    let file_bytes = file.metadata().with_context(|| format!("cannot read picture '{name}'"))?.len();
    let mut decoder = png::Decoder::new(BufReader::new(file));
    decoder.set_transformations(Transformations::EXPAND | Transformations::ALPHA);
    let mut reader = decoder.read_info().with_context(|| format!("'{name}' is not a readable PNG"))?;
    let (width, height) = reader.info().size();
    if u64::from(width) * u64::from(height) > MAX_PIXELS {
        bail!("picture '{name}' is {width}x{height}: at most 2^28 pixels are read");
    }
    let num_bytes = reader.output_buffer_size().with_context(|| format!("picture '{name}' is too large"))?;
    let packed_bytes = u64::from(height).saturating_mul(reader.info().raw_row_length() as u64);
    if packed_bytes > file_bytes.saturating_mul(MAX_EXPANSION) {
        bail!("picture '{name}' claims {width}x{height} pixels, more than its {file_bytes} bytes can hold");
    }
    let mut bytes = vec![0; num_bytes];
    let info = reader.next_frame(&mut bytes).with_context(|| format!("picture '{name}' is damaged"))?;
    bytes.truncate(info.buffer_size());
    let sixteen = info.bit_depth == BitDepth::Sixteen;
    let samples: Vec<u8> = if sixteen { bytes.chunks_exact(2).map(eight_bits).collect() } else { bytes };
    let pixels = match info.color_type {
        ColorType::GrayscaleAlpha => samples.chunks_exact(2).map(|p| [p[0], p[0], p[0], p[1]]).collect(),
        ColorType::Rgba => samples.chunks_exact(4).map(|p| [p[0], p[1], p[2], p[3]]).collect(),
        other => {
            bail!("picture '{name}' was read as {other:?}: it must be grey or RGB, with or without alpha")
        }
    };
    Ok(Image8 { width: info.width as usize, height: info.height as usize, pixels })
}

/// A big-endian 16-bit sample rounded to 8 bits.
fn eight_bits(sample: &[u8]) -> u8 {
    let wide = u32::from(sample[0]) << 8 | u32::from(sample[1]);
    ((wide * 255 + 32_767) / 65_535) as u8
}
