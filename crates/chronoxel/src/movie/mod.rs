//! Pictures and movies as files: PNG, numbered PNGs, APNG, GIF, and MP4 through `ffmpeg`.
//!
//! Every format is a [`FrameSink`]. Whatever it writes appears under its name only when
//! [`FrameSink::finish`] has succeeded; a sink that is dropped before leaves nothing behind.

mod apng;
mod gif;
mod mp4;
mod numbered;
mod palette;
mod pending;
pub mod picture;
mod template;
#[cfg(test)]
pub(crate) mod tests;

use std::path::Path;

use anyhow::{Context, Result, bail};
use chronoxel_core::{Image8, image::check_size};

pub use picture::{read_png, write_png};
pub use template::FrameTemplate;

/// One picture of a movie, and what it shows.
#[derive(Debug, Clone, Copy)]
pub struct Frame<'a> {
    /// The picture; all pictures of a movie have one size.
    pub image: &'a Image8,
    /// Time step.
    pub step: usize,
    /// Time of the step, in the units of the series.
    pub time: f64,
}

/// What is known of a movie before its first picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MovieOptions {
    /// Width and height of every picture.
    pub size: [usize; 2],
    /// Pictures per second, from 0.01 to 1000. GIF counts in hundredths of a second and players
    /// take less than two for ten: its pictures last whole hundredths, at least two, and are laid so that
    /// up to 50 per second the movie keeps its pace.
    pub fps: f64,
    /// How many pictures there will be.
    pub num_frames: usize,
}

/// A movie being written.
pub trait FrameSink {
    /// Appends a picture.
    ///
    /// # Errors
    /// If its size is not the movie's, there are more than were announced, or the output cannot be written.
    fn write_frame(&mut self, frame: &Frame<'_>) -> Result<()>;

    /// Completes the output and gives it its name.
    ///
    /// # Errors
    /// If there were fewer pictures than announced, or the output cannot be written.
    fn finish(self: Box<Self>) -> Result<()>;
}

/// Starts a movie in the format that the name of `output` says: `.mp4`, `.gif`, `.apng`, or numbered
/// pictures like `'f/{frame:04}.png'`.
///
/// # Errors
/// If the name says no format, an option is out of range, `ffmpeg` is needed and not on the PATH, or the
/// output cannot be created.
pub fn create(output: &str, options: MovieOptions) -> Result<Box<dyn FrameSink>> {
    check_options(output, &options)?;
    let path = Path::new(output);
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    if FrameTemplate::is_template(output) {
        return Ok(Box::new(numbered::NumberedPngs::create(output, options)?));
    }
    match extension.as_str() {
        "mp4" | "m4v" | "mov" => Ok(Box::new(mp4::Mp4::create(path, options)?)),
        "gif" => Ok(Box::new(gif::GifMovie::create(path, options)?)),
        "apng" => Ok(Box::new(apng::Apng::create(path, options)?)),
        "png" => bail!(
            "output '{output}' is one picture, and a movie has {}: write numbered pictures to '{{frame:04}}.png', or use .apng",
            options.num_frames
        ),
        _ => bail!(
            "output '{output}' has no known movie extension: use .mp4, .gif, .apng or '{{frame:04}}.png'"
        ),
    }
}

fn check_options(output: &str, options: &MovieOptions) -> Result<()> {
    check_size(options.size).with_context(|| format!("cannot write '{output}'"))?;
    if !(0.01..=1000.0).contains(&options.fps) {
        bail!("fps of '{output}' is {}: it must be between 0.01 and 1000", options.fps);
    }
    if options.num_frames == 0 {
        bail!("'{output}' would have no picture: choose at least one step");
    }
    Ok(())
}

/// Counts pictures and refuses those that do not belong.
#[derive(Debug)]
struct FrameCheck {
    output: String,
    options: MovieOptions,
    num_written: usize,
}

impl FrameCheck {
    fn new(output: impl Into<String>, options: MovieOptions) -> Self {
        Self { output: output.into(), options, num_written: 0 }
    }

    /// Called before a picture is written; gives its number.
    fn next(&mut self, image: &Image8) -> Result<usize> {
        let [width, height] = self.options.size;
        if [image.width, image.height] != [width, height] {
            bail!(
                "picture {} of '{}' is {}x{}: all pictures of the movie must be {width}x{height}",
                self.num_written,
                self.output,
                image.width,
                image.height
            );
        }
        if self.num_written == self.options.num_frames {
            bail!("'{}' was announced with {} pictures and gets more", self.output, self.options.num_frames);
        }
        self.num_written += 1;
        Ok(self.num_written - 1)
    }

    /// Called before the movie is completed.
    fn complete(&self) -> Result<()> {
        if self.num_written != self.options.num_frames {
            bail!(
                "'{}' has only {} of its {} pictures: nothing was written",
                self.output,
                self.num_written,
                self.options.num_frames
            );
        }
        Ok(())
    }
}

/// The fraction of a second, `(numerator, denominator)`, nearest to `1 / fps` that 16 bits each can hold.
fn delay_fraction(fps: f64) -> (u16, u16) {
    let error = |n: u16, d: u16| (f64::from(n) * fps / f64::from(d) - 1.0).abs();
    let mut best = (1, 1);
    for numerator in 1..=1001u16 {
        let denominator = (f64::from(numerator) * fps).round().clamp(1.0, f64::from(u16::MAX)) as u16;
        if error(numerator, denominator) + 1e-9 < error(best.0, best.1) {
            best = (numerator, denominator);
        }
    }
    best
}
