//! The samples of a NRRD: one stream of bytes over one file or many, in any encoding.

use std::fs::File;
use std::io::{BufRead, BufReader, Error, ErrorKind, Read, Result};
use std::path::PathBuf;

use chronoxel_core::SampleType;
use flate2::bufread::MultiGzDecoder;

use super::nrrd_header::Fields;
use super::number_text::NumberText;
use super::volume_file::{MAX_DEFLATE_RATIO, open_at, open_regular};
use crate::SourceError;

/// Bytes of encoded data read at a time.
const READ_BYTES: usize = 1 << 17;

/// How the samples are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Encoding {
    Raw,
    Gzip,
    Text,
}

impl Encoding {
    /// The encoding of a header.
    pub fn of(fields: &Fields) -> std::result::Result<Self, SourceError> {
        let text = fields.required("encoding")?;
        match text.to_lowercase().as_str() {
            "raw" => Ok(Self::Raw),
            "gzip" | "gz" => Ok(Self::Gzip),
            "txt" | "text" | "ascii" => Ok(Self::Text),
            _ => Err(SourceError::unsupported(
                &fields.path,
                "encoding",
                text,
                "raw, gzip and text are; save it with `unu save -e gzip`",
            )),
        }
    }
}

/// Where the samples are; the files were found to be long enough.
pub(crate) struct DataPlace {
    encoding: Encoding,
    sample_type: SampleType,
    files: Vec<DataFile>,
    /// Bytes of decoded samples in each file.
    bytes_per_file: u64,
    /// Whether the samples must end where the file does.
    is_attached: bool,
}

/// One file and where its data are.
struct DataFile {
    path: PathBuf,
    /// Position of the encoded data.
    start: u64,
    /// Decoded bytes to pass over.
    byte_skip: u64,
}

impl DataPlace {
    /// Finds the data of a header and checks that the files can hold them.
    pub fn find(
        fields: &Fields,
        sample_type: SampleType,
        data_bytes: u64,
    ) -> std::result::Result<Self, SourceError> {
        let encoding = Encoding::of(fields)?;
        let mut paths = fields.data_files()?;
        let is_attached = paths.is_empty();
        if is_attached {
            paths.push(fields.path.clone());
        }
        let bytes_per_file = data_bytes / paths.len() as u64;
        if bytes_per_file * paths.len() as u64 != data_bytes
            || !bytes_per_file.is_multiple_of(sample_type.num_bytes() as u64)
        {
            let problem = format!("{data_bytes} bytes of samples cannot be shared evenly between them");
            return Err(SourceError::corrupt(&fields.path, "number of data files", paths.len(), problem));
        }
        let mut place = Self { encoding, sample_type, files: Vec::new(), bytes_per_file, is_attached };
        for path in paths {
            let file = place.locate(fields, path)?;
            place.files.push(file);
        }
        Ok(place)
    }

    /// Finds the data in one file.
    fn locate(&self, fields: &Fields, path: PathBuf) -> std::result::Result<DataFile, SourceError> {
        let (file, file_bytes) = open_regular(&path)?;
        let line_skip = fields.integer("line skip")?.unwrap_or(0);
        let mut start = if self.is_attached { fields.header_bytes } else { 0 };
        if line_skip > 0 {
            let mut input = BufReader::new(open_at(&path, start)?);
            for _ in 0..line_skip {
                let skipped = input.skip_until(b'\n').map_err(|e| SourceError::io(&path, "read", e))?;
                if skipped == 0 {
                    break;
                }
                start += skipped as u64;
            }
        }
        drop(file);
        let available = file_bytes.saturating_sub(start);
        let mut byte_skip = fields.integer("byte skip")?.unwrap_or(0);
        if byte_skip == -1 && self.encoding == Encoding::Raw {
            byte_skip = available.saturating_sub(self.bytes_per_file) as i64;
        }
        let byte_skip = u64::try_from(byte_skip).map_err(|_| {
            let problem = "it must be 0 or more, or -1 with raw encoding";
            SourceError::corrupt(&fields.path, "byte skip", byte_skip, problem)
        })?;
        let needed = byte_skip.saturating_add(self.bytes_per_file);
        let (at_most, is_wrong) = match self.encoding {
            Encoding::Raw => {
                (available, if self.is_attached { needed != available } else { needed > available })
            }
            Encoding::Gzip => {
                let most = available.saturating_mul(MAX_DEFLATE_RATIO);
                (most, needed > most)
            }
            Encoding::Text => {
                // A number takes a digit and a blank.
                let most = (available / 2 + 1).saturating_mul(self.sample_type.num_bytes() as u64);
                (most, needed > most)
            }
        };
        if is_wrong {
            let problem = format!(
                "the sizes need {needed} bytes where it can hold {at_most}; it is truncated or the sizes are wrong"
            );
            return Err(SourceError::corrupt(&path, "length", format!("{file_bytes} bytes"), problem));
        }
        Ok(DataFile { path, start, byte_skip })
    }

    /// Decoded bytes in all files.
    fn total_bytes(&self) -> u64 {
        self.bytes_per_file * self.files.len() as u64
    }

    /// Opens the file that holds decoded byte `position`, which is the first one read.
    fn open(&self, position: u64) -> std::result::Result<Stream, SourceError> {
        let file = &self.files[(position / self.bytes_per_file) as usize];
        let skip = file.byte_skip + position % self.bytes_per_file;
        if self.encoding == Encoding::Raw {
            let input = Box::new(open_at(&file.path, file.start + skip)?);
            return Ok(Stream { input, position });
        }
        let encoded = BufReader::with_capacity(READ_BYTES, open_at(&file.path, file.start)?);
        let mut input: Box<dyn Read + Send> = match self.encoding {
            Encoding::Gzip => Box::new(MultiGzDecoder::new(encoded)),
            _ => Box::new(NumberText::<BufReader<File>>::new(encoded, self.sample_type)),
        };
        pass_over(&mut input, skip).map_err(|e| SourceError::from_read(&file.path, "samples", e))?;
        Ok(Stream { input, position })
    }

    /// A reader of the decoded bytes from `position` on; goes on with `stream` where that is not behind.
    pub fn reader<'a>(
        &'a self,
        stream: &'a mut Option<Stream>,
        position: u64,
        keep_stream: bool,
    ) -> std::result::Result<PlaceReader<'a>, SourceError> {
        let in_same_file = |s: &Stream| {
            s.position <= position
                && (position - s.position) < self.bytes_per_file - s.position % self.bytes_per_file
        };
        let can_go_on =
            |s: &Stream| s.position == position || self.encoding != Encoding::Raw && in_same_file(s);
        match stream.as_mut().filter(|s| can_go_on(s) && !s.position.is_multiple_of(self.bytes_per_file)) {
            Some(open) => {
                pass_over(&mut open.input, position - open.position)
                    .map_err(|e| SourceError::from_read(&self.files[0].path, "samples", e))?;
                open.position = position;
            }
            None => *stream = Some(self.open(position)?),
        }
        Ok(PlaceReader { place: self, stream, keep_stream })
    }
}

/// Reads bytes and forgets them.
fn pass_over(input: &mut impl Read, num_bytes: u64) -> Result<()> {
    match std::io::copy(&mut input.take(num_bytes), &mut std::io::sink())? {
        n if n == num_bytes => Ok(()),
        n => Err(Error::new(
            ErrorKind::UnexpectedEof,
            format!("the data end {} bytes too early", num_bytes - n),
        )),
    }
}

/// A file that is being decoded.
pub(crate) struct Stream {
    input: Box<dyn Read + Send>,
    /// Which decoded byte comes next.
    position: u64,
}

/// The decoded bytes, across the borders of files.
pub(crate) struct PlaceReader<'a> {
    place: &'a DataPlace,
    stream: &'a mut Option<Stream>,
    /// Whether the stream stays open for a later step.
    keep_stream: bool,
}

impl PlaceReader<'_> {
    /// An attached stream that has given all its samples has no more.
    fn check_end(&mut self) -> Result<()> {
        let Some(stream) = self.stream.as_mut() else { return Ok(()) };
        if stream.input.read(&mut [0; 1])? > 0 {
            return Err(Error::new(ErrorKind::InvalidData, "there are more samples than the sizes say"));
        }
        Ok(())
    }
}

impl Read for PlaceReader<'_> {
    fn read(&mut self, out: &mut [u8]) -> Result<usize> {
        let Some(position) = self.stream.as_ref().map(|s| s.position) else { return Ok(0) };
        let bytes_per_file = self.place.bytes_per_file;
        let left_in_file = bytes_per_file - position % bytes_per_file;
        let wanted = usize::try_from(left_in_file).unwrap_or(usize::MAX).min(out.len());
        let Some(stream) = self.stream.as_mut() else { return Ok(0) };
        let count = stream.input.read(&mut out[..wanted])?;
        stream.position += count as u64;
        if count as u64 == left_in_file {
            let next = stream.position;
            if next < self.place.total_bytes() {
                *self.stream = Some(self.place.open(next).map_err(Error::other)?);
            } else {
                if self.place.is_attached && self.place.encoding != Encoding::Raw {
                    self.check_end()?;
                }
                *self.stream = None;
            }
        }
        Ok(count)
    }
}

impl Drop for PlaceReader<'_> {
    fn drop(&mut self) {
        if !self.keep_stream {
            *self.stream = None;
        }
    }
}
