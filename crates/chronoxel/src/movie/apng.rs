//! Animated PNG: lossless, true colour, with alpha.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use anyhow::{Context, Result};
use chronoxel_core::Image8;
use png::{BlendOp, DisposeOp, Writer};

use super::pending::PendingFile;
use super::{Frame, FrameCheck, FrameSink, MovieOptions, delay_fraction, picture};

/// An APNG being written. Of each picture only the rectangle that differs from the one before is stored.
pub(super) struct Apng {
    writer: Writer<BufWriter<File>>,
    check: FrameCheck,
    previous: Option<Image8>,
    file: PendingFile,
}

impl Apng {
    pub(super) fn create(path: &Path, options: MovieOptions) -> Result<Self> {
        let file = PendingFile::new(path)?;
        let [width, height] = options.size.map(|n| n as u32);
        let mut encoder = png::Encoder::new(BufWriter::new(file.create()?), width, height);
        picture::set_format(&mut encoder, png::ColorType::Rgba);
        let cannot_start = || format!("cannot write '{}'", path.display());
        encoder.set_animated(options.num_frames as u32, 0).with_context(cannot_start)?;
        let (numerator, denominator) = delay_fraction(options.fps);
        encoder.set_frame_delay(numerator, denominator).with_context(cannot_start)?;
        encoder.set_dispose_op(DisposeOp::None).with_context(cannot_start)?;
        encoder.set_blend_op(BlendOp::Source).with_context(cannot_start)?;
        let writer = encoder.write_header().with_context(cannot_start)?;
        Ok(Self { writer, check: FrameCheck::new(path.to_string_lossy(), options), previous: None, file })
    }

    fn write_rectangle(&mut self, image: &Image8, [x, y, width, height]: [usize; 4]) -> Result<()> {
        if self.previous.is_some() {
            self.writer.reset_frame_position()?;
            self.writer.set_frame_dimension(width as u32, height as u32)?;
            self.writer.set_frame_position(x as u32, y as u32)?;
        }
        let rows = (y..y + height).flat_map(|row| &image.pixels[row * image.width + x..][..width]);
        let bytes: Vec<u8> = rows.flatten().copied().collect();
        Ok(self.writer.write_image_data(&bytes)?)
    }
}

impl FrameSink for Apng {
    fn write_frame(&mut self, frame: &Frame<'_>) -> Result<()> {
        self.check.next(frame.image)?;
        let rectangle = match &self.previous {
            Some(previous) => changed_rectangle(previous, frame.image),
            None => [0, 0, frame.image.width, frame.image.height],
        };
        self.write_rectangle(frame.image, rectangle)
            .with_context(|| format!("cannot write '{}'", self.check.output))?;
        self.previous = Some(frame.image.clone());
        Ok(())
    }

    fn finish(self: Box<Self>) -> Result<()> {
        self.check.complete()?;
        let Self { writer, check, file, .. } = *self;
        writer.finish().with_context(|| format!("cannot finish '{}'", check.output))?;
        file.publish()
    }
}

/// The smallest rectangle `[x, y, width, height]` outside which two pictures of one size agree; one
/// pixel where they agree everywhere.
pub(super) fn changed_rectangle(before: &Image8, after: &Image8) -> [usize; 4] {
    let (mut low, mut high) = ([usize::MAX; 2], [0; 2]);
    let pairs = before.pixels.chunks(before.width).zip(after.pixels.chunks(after.width));
    for (y, (old, new)) in pairs.enumerate() {
        let Some(first) = (0..old.len()).find(|&x| old[x] != new[x]) else { continue };
        let last = (0..old.len()).rfind(|&x| old[x] != new[x]).unwrap_or(first);
        low = [low[0].min(first), low[1].min(y)];
        high = [high[0].max(last), y];
    }
    if low[0] == usize::MAX {
        return [0, 0, 1, 1];
    }
    [low[0], low[1], high[0] - low[0] + 1, high[1] - low[1] + 1]
}
