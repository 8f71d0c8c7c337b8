//! GIF: plays everywhere; 256 colours per picture.

use std::borrow::Cow;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use ::gif::{DisposalMethod, Encoder, Repeat};
use anyhow::{Context, Result};
use chronoxel_core::Image8;

use super::apng::changed_rectangle;
use super::palette::Palette;
use super::pending::PendingFile;
use super::{Frame, FrameCheck, FrameSink, MovieOptions};

/// A GIF being written, endlessly repeating. Every picture has its own palette. Where the first picture
/// is opaque, all are shown over black and only the rectangle that changes is stored; otherwise pixels
/// less than half opaque are transparent.
pub(super) struct GifMovie {
    encoder: Encoder<BufWriter<File>>,
    check: FrameCheck,
    previous: Option<Image8>,
    transparent: bool,
    file: PendingFile,
}

impl GifMovie {
    pub(super) fn create(path: &Path, options: MovieOptions) -> Result<Self> {
        let file = PendingFile::new(path)?;
        let [width, height] = options.size.map(|n| n as u16);
        let output = BufWriter::new(file.create()?);
        let started = Encoder::new(output, width, height, &[]).and_then(|mut encoder| {
            encoder.set_repeat(Repeat::Infinite)?;
            Ok(encoder)
        });
        let encoder = started.with_context(|| format!("cannot write '{}'", path.display()))?;
        let check = FrameCheck::new(path.to_string_lossy(), options);
        Ok(Self { encoder, check, previous: None, transparent: false, file })
    }

    fn rectangle(&self, image: &Image8) -> [usize; 4] {
        match &self.previous {
            Some(previous) if !self.transparent => changed_rectangle(previous, image),
            _ => [0, 0, image.width, image.height],
        }
    }
}

impl FrameSink for GifMovie {
    fn write_frame(&mut self, frame: &Frame<'_>) -> Result<()> {
        let index = self.check.next(frame.image)?;
        if index == 0 {
            self.transparent = frame.image.pixels.iter().any(|pixel| pixel[3] < 128);
        }
        let rectangle = self.rectangle(frame.image);
        let mut encoded = indexed(frame.image, rectangle, self.transparent);
        encoded.delay = delay_hundredths(index, self.check.options.fps);
        self.encoder
            .write_frame(&encoded)
            .with_context(|| format!("cannot write '{}'", self.check.output))?;
        self.previous = Some(frame.image.clone());
        Ok(())
    }

    fn finish(self: Box<Self>) -> Result<()> {
        self.check.complete()?;
        let Self { encoder, check, file, .. } = *self;
        let cannot_finish = || format!("cannot finish '{}'", check.output);
        encoder.into_inner().with_context(cannot_finish)?.flush().with_context(cannot_finish)?;
        file.publish()
    }
}

/// How long picture `index` lasts, so that the movie as a whole keeps its pace.
fn delay_hundredths(index: usize, fps: f64) -> u16 {
    let end_of = |num: usize| (num as f64 * 100.0 / fps).round();
    (end_of(index + 1) - end_of(index)).clamp(2.0, f64::from(u16::MAX)) as u16
}

/// A rectangle `[x, y, width, height]` of a picture with a palette of its own.
fn indexed(image: &Image8, [x, y, width, height]: [usize; 4], transparent: bool) -> ::gif::Frame<'static> {
    let pixels = || (y..y + height).flat_map(|row| &image.pixels[row * image.width + x..][..width]).copied();
    let shown = |[r, g, b, a]: [u8; 4]| match transparent {
        true => [r, g, b],
        false => [r, g, b].map(|c| ((u32::from(c) * u32::from(a) + 127) / 255) as u8),
    };
    let visible = |pixel: &[u8; 4]| !transparent || pixel[3] >= 128;
    let palette = Palette::of(pixels().filter(visible).map(shown), 256 - usize::from(transparent));
    let through = palette.colors.len() as u8;
    let entry = |pixel: [u8; 4]| if visible(&pixel) { palette.entry(shown(pixel)) } else { through };
    let buffer: Vec<u8> = pixels().map(entry).collect();
    let mut colors = palette.colors.concat();
    if transparent {
        colors.extend([0; 3]);
    }
    ::gif::Frame {
        left: x as u16,
        top: y as u16,
        width: width as u16,
        height: height as u16,
        dispose: if transparent { DisposalMethod::Background } else { DisposalMethod::Keep },
        transparent: transparent.then_some(through),
        palette: Some(colors),
        buffer: Cow::Owned(buffer),
        ..::gif::Frame::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delays_keep_the_pace() {
        let total = |fps: f64, num: usize| (0..num).map(|i| u32::from(delay_hundredths(i, fps))).sum::<u32>();
        assert_eq!(total(30.0, 30), 100);
        assert_eq!(total(24.0, 48), 200);
        assert_eq!(total(60.0, 60), 120);
        assert_eq!(delay_hundredths(0, 0.01), 10_000);
    }
}
