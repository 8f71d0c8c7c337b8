//! MP4 (H.264) through the `ffmpeg` program.

use std::io::{ErrorKind, Read, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::thread::JoinHandle;

use anyhow::{Result, bail};
use chronoxel_core::Image8;

use super::pending::PendingFile;
use super::{Frame, FrameCheck, FrameSink, MovieOptions};

/// How much of what `ffmpeg` says is kept for an error message.
const MAX_SAID_BYTES: usize = 16 * 1024;

/// An MP4 being written: raw pictures go to a running `ffmpeg`. Sides are made even, as 4:2:0
/// colour needs, by repeating the last column or row; transparent pixels are shown over black.
pub(super) struct Mp4 {
    ffmpeg: Child,
    pictures: Option<ChildStdin>,
    said: Option<JoinHandle<String>>,
    check: FrameCheck,
    file: Option<PendingFile>,
}

impl Mp4 {
    pub(super) fn create(path: &Path, options: MovieOptions) -> Result<Self> {
        Self::create_with("ffmpeg", path, options)
    }

    /// As [`Self::create`], with the program to run.
    pub(super) fn create_with(program: &str, path: &Path, options: MovieOptions) -> Result<Self> {
        let file = PendingFile::new(path)?;
        file.create()?;
        let [width, height] = options.size.map(|n| n.next_multiple_of(2));
        let spawned = Command::new(program)
            .args(["-hide_banner", "-nostdin", "-loglevel", "error", "-y"])
            .args(["-f", "rawvideo", "-pixel_format", "rgb24"])
            .args(["-video_size", &format!("{width}x{height}"), "-framerate", &options.fps.to_string()])
            .args(["-i", "pipe:0", "-an"])
            // Without these, players take the colours of large and small movies for different ones.
            .args(["-vf", "scale=out_color_matrix=bt709:out_range=tv,format=yuv420p"])
            .args(["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"])
            .args(["-c:v", "libx264", "-crf", "18", "-preset", "medium", "-movflags", "+faststart"])
            .args(["-f", "mp4"])
            .arg(as_file_argument(file.path()))
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn();
        let mut ffmpeg = match spawned {
            Ok(child) => child,
            Err(error) if error.kind() == ErrorKind::NotFound => bail!(
                "'{}' needs the program ffmpeg, which is not on the PATH: install it (e.g. apt-get install ffmpeg), or write .gif, .apng or '{{frame:04}}.png' instead",
                path.display()
            ),
            Err(error) => bail!("cannot start ffmpeg for '{}': {error}", path.display()),
        };
        let pictures = ffmpeg.stdin.take();
        let said = ffmpeg.stderr.take().map(|pipe| std::thread::spawn(move || keep_beginning(pipe)));
        let check = FrameCheck::new(path.to_string_lossy(), options);
        Ok(Self { ffmpeg, pictures, said, check, file: Some(file) })
    }

    /// Waits for the end of `ffmpeg`; whether it was content, and what it said on one line.
    fn wait(&mut self) -> Result<(bool, String)> {
        drop(self.pictures.take());
        let status = self.ffmpeg.wait()?;
        let said = self.said.take().and_then(|reader| reader.join().ok()).unwrap_or_default();
        let lines: Vec<&str> = said.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
        let summary = if lines.is_empty() { status.to_string() } else { lines.join("; ") };
        Ok((status.success(), summary))
    }

    fn failure(&self, said: &str) -> anyhow::Error {
        anyhow::anyhow!(
            "ffmpeg could not write '{}': {said} (an ffmpeg with libx264 is needed; .gif, .apng and '{{frame:04}}.png' need none)",
            self.check.output
        )
    }
}

impl FrameSink for Mp4 {
    fn write_frame(&mut self, frame: &Frame<'_>) -> Result<()> {
        self.check.next(frame.image)?;
        let bytes = even_rgb(frame.image);
        match self.pictures.as_mut().map(|pipe| pipe.write_all(&bytes)) {
            Some(Ok(())) => Ok(()),
            _ => {
                let (_, said) = self.wait()?;
                Err(self.failure(&said))
            }
        }
    }

    fn finish(mut self: Box<Self>) -> Result<()> {
        self.check.complete()?;
        let (content, said) = self.wait()?;
        match self.file.take() {
            Some(file) if content => file.publish(),
            _ => Err(self.failure(&said)),
        }
    }
}

impl Drop for Mp4 {
    fn drop(&mut self) {
        drop(self.pictures.take());
        // It may have ended already; then there is nothing to stop.
        let _ = self.ffmpeg.kill();
        let _ = self.ffmpeg.wait();
    }
}

/// A path that `ffmpeg` takes for nothing but a file, whatever it begins with or contains.
fn as_file_argument(path: &Path) -> std::ffi::OsString {
    let mut argument = std::ffi::OsString::from("file:");
    argument.push(path);
    argument
}

/// RGB bytes of a picture over black, both sides made even.
fn even_rgb(image: &Image8) -> Vec<u8> {
    let [width, height] = [image.width, image.height].map(|n| n.next_multiple_of(2));
    let mut bytes = Vec::with_capacity(3 * width * height);
    for y in 0..height {
        let row = &image.pixels[y.min(image.height - 1) * image.width..][..image.width];
        for x in 0..width {
            let [r, g, b, a] = row[x.min(image.width - 1)];
            bytes.extend([r, g, b].map(|c| ((u32::from(c) * u32::from(a) + 127) / 255) as u8));
        }
    }
    bytes
}

/// The beginning of what a program says, until it stops talking.
fn keep_beginning(mut pipe: impl Read) -> String {
    let (mut kept, mut buffer) = (Vec::new(), [0u8; 4096]);
    while let Ok(count @ 1..) = pipe.read(&mut buffer) {
        let room = MAX_SAID_BYTES.saturating_sub(kept.len());
        kept.extend_from_slice(&buffer[..count.min(room)]);
    }
    String::from_utf8_lossy(&kept).into_owned()
}
