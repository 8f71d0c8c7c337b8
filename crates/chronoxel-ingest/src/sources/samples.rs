//! From bytes of a file to samples: number types, byte order, interleaved components.

use std::io::Read;
use std::path::PathBuf;

use chronoxel_core::{SampleType, Samples};

use crate::{SourceError, StepReader};

/// Bytes that are read and converted at a time: small enough to stay in the cache.
pub(crate) const CHUNK_BYTES: usize = 256 << 10;

/// The largest integer below which every integer is an `f64`.
const MAX_EXACT_INTEGER: u64 = 1 << 53;

/// How samples lie in a stream of bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SampleFormat {
    pub sample_type: SampleType,
    pub big_endian: bool,
    /// Samples per point of the grid; they lie side by side.
    pub num_components: usize,
    /// Which of them is wanted.
    pub component: usize,
}

impl SampleFormat {
    /// One sample per point.
    pub fn scalar(sample_type: SampleType, big_endian: bool) -> Self {
        Self { sample_type, big_endian, num_components: 1, component: 0 }
    }

    /// Bytes of one point: all its components.
    pub fn point_bytes(&self) -> usize {
        self.sample_type.num_bytes() * self.num_components
    }

    /// Bytes of one sample in the kind of samples that the type becomes.
    pub fn held_bytes(&self) -> usize {
        if self.sample_type.fits_f32() { 4 } else { 8 }
    }

    /// An empty run of the kind of samples that the type becomes.
    pub fn empty(&self) -> Samples {
        if self.sample_type.fits_f32() { Samples::F32(Vec::new()) } else { Samples::F64(Vec::new()) }
    }

    /// Converts whole points and appends them to `out`, a run of the kind of [`Self::empty`].
    ///
    /// Fails with an integer that is beyond 53 bits.
    pub fn append(&self, bytes: &[u8], out: &mut Samples) -> Result<(), i128> {
        /// One arm: from the bytes of one sample to the number the run holds.
        macro_rules! convert {
            ($out:expr, $from:ty) => {
                self.append_with::<{ size_of::<$from>() }, _>(bytes, $out, <$from>::from_le_bytes)
            };
        }
        match (out, self.sample_type) {
            (Samples::F32(out), SampleType::U8) => convert!(out, u8),
            (Samples::F32(out), SampleType::I8) => convert!(out, i8),
            (Samples::F32(out), SampleType::U16) => convert!(out, u16),
            (Samples::F32(out), SampleType::I16) => convert!(out, i16),
            (Samples::F32(out), SampleType::F32) => convert!(out, f32),
            (Samples::F64(out), SampleType::U32) => convert!(out, u32),
            (Samples::F64(out), SampleType::I32) => convert!(out, i32),
            (Samples::F64(out), SampleType::F64) => convert!(out, f64),
            (Samples::F64(out), SampleType::U64) => {
                let before = out.len();
                self.append_with::<8, _>(bytes, out, |b| u64::from_le_bytes(b) as f64);
                self.check_integers(bytes, &out[before..])?;
            }
            (Samples::F64(out), SampleType::I64) => {
                let before = out.len();
                self.append_with::<8, _>(bytes, out, |b| i64::from_le_bytes(b) as f64);
                self.check_integers(bytes, &out[before..])?;
            }
            (_, sample_type) => unreachable!("{sample_type} samples in a run of the other kind"),
        }
        Ok(())
    }

    /// Appends the wanted component of each point, `from` being given little-endian bytes.
    fn append_with<const N: usize, T>(
        &self,
        bytes: &[u8],
        out: &mut Vec<impl From<T>>,
        from: impl Fn([u8; N]) -> T,
    ) {
        let number = |b: &[u8]| {
            let mut b: [u8; N] = b.try_into().expect("a chunk is as long as asked");
            if self.big_endian {
                b.reverse();
            }
            from(b).into()
        };
        if self.num_components == 1 {
            out.extend(bytes.chunks_exact(N).map(number));
        } else {
            let at = N * self.component;
            out.extend(bytes.chunks_exact(N * self.num_components).map(|p| number(&p[at..at + N])));
        }
    }

    /// Fails with the first integer that may have been rounded on its way to `f64`.
    fn check_integers(&self, bytes: &[u8], values: &[f64]) -> Result<(), i128> {
        let Some(index) = values.iter().position(|v| v.abs() >= MAX_EXACT_INTEGER as f64) else {
            return Ok(());
        };
        let at = index * self.point_bytes() + 8 * self.component;
        let mut b: [u8; 8] = bytes[at..at + 8].try_into().expect("eight bytes were asked for");
        if self.big_endian {
            b.reverse();
        }
        let exact = match self.sample_type {
            SampleType::U64 => i128::from(u64::from_le_bytes(b)),
            _ => i128::from(i64::from_le_bytes(b)),
        };
        if exact.unsigned_abs() > u128::from(MAX_EXACT_INTEGER) {
            return Err(exact);
        }
        // Exactly 2^53 is fine; look behind it.
        let next = index + 1;
        self.check_integers(&bytes[next * self.point_bytes()..], &values[next..])
    }
}

/// Reads one step of one variable from a stream of bytes that starts at its first sample.
pub(crate) struct SliceReader<R> {
    pub input: R,
    /// For messages.
    pub path: PathBuf,
    /// For messages: whose samples these are.
    pub field: String,
    pub format: SampleFormat,
    pub slice_samples: usize,
}

impl<R: Read + Send> StepReader for SliceReader<R> {
    fn read_slices(&mut self, num_slices: usize) -> Result<Samples, SourceError> {
        let num_samples = num_slices.saturating_mul(self.slice_samples);
        match (self.format.empty(), self.format.sample_type, self.format.num_components) {
            (Samples::F32(mut out), SampleType::F32, 1) => {
                self.read_native(num_samples, &mut out, |v| f32::from_bits(v.to_bits().swap_bytes()))?;
                Ok(Samples::F32(out))
            }
            (Samples::F64(mut out), SampleType::F64, 1) => {
                self.read_native(num_samples, &mut out, |v| f64::from_bits(v.to_bits().swap_bytes()))?;
                Ok(Samples::F64(out))
            }
            (mut out, ..) => {
                self.read_converted(num_samples, &mut out)?;
                Ok(out)
            }
        }
    }
}

impl<R: Read> SliceReader<R> {
    /// Reads samples that need no conversion but for their byte order straight into the run.
    fn read_native<T: bytemuck::Pod>(
        &mut self,
        num_samples: usize,
        out: &mut Vec<T>,
        swapped: impl Fn(T) -> T,
    ) -> Result<(), SourceError> {
        self.reserve(num_samples, out)?;
        let swap = self.format.big_endian != cfg!(target_endian = "big");
        while out.len() < num_samples {
            // Growing chunk by chunk keeps a header that lies from touching memory the file cannot fill.
            let start = out.len();
            out.resize(num_samples.min(start + CHUNK_BYTES / size_of::<T>()), T::zeroed());
            self.fill(bytemuck::cast_slice_mut(&mut out[start..]), start * size_of::<T>())?;
            if swap {
                out[start..].iter_mut().for_each(|v| *v = swapped(*v));
            }
        }
        Ok(())
    }

    /// Reads samples through a small buffer and converts them.
    fn read_converted(&mut self, num_samples: usize, out: &mut Samples) -> Result<(), SourceError> {
        match out {
            Samples::F32(out) => self.reserve(num_samples, out)?,
            Samples::F64(out) => self.reserve(num_samples, out)?,
        }
        let point_bytes = self.format.point_bytes();
        let chunk_points = (CHUNK_BYTES / point_bytes).max(1);
        let mut buffer = vec![0; chunk_points.min(num_samples) * point_bytes];
        while out.len() < num_samples {
            let points = chunk_points.min(num_samples - out.len());
            let chunk = &mut buffer[..points * point_bytes];
            self.fill(chunk, out.len() * point_bytes)?;
            self.format.append(chunk, out).map_err(|integer| self.too_wide(integer))?;
        }
        Ok(())
    }

    /// Address space for a run; an error rather than an abort where there is none.
    fn reserve<T>(&self, num_samples: usize, out: &mut Vec<T>) -> Result<(), SourceError> {
        out.try_reserve_exact(num_samples).map_err(|_| {
            let remedy =
                "there is not enough memory for so many samples at once; use a smaller brick or grid";
            SourceError::unsupported(&self.path, "number of samples in a slab", num_samples, remedy)
        })
    }

    /// Fills `bytes`, the ones `offset` bytes into this run of slices.
    fn fill(&mut self, bytes: &mut [u8], offset: usize) -> Result<(), SourceError> {
        let mut filled = 0;
        while filled < bytes.len() {
            match self.input.read(&mut bytes[filled..]) {
                Ok(0) => {
                    let needed = bytes.len() - filled;
                    let problem = format!(
                        "the data ends {} bytes into these slices, at least {needed} bytes short of what the header \
                         promises; the file is truncated",
                        offset + filled
                    );
                    return Err(SourceError::corrupt(&self.path, &self.field, "truncated", problem));
                }
                Ok(count) => filled += count,
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
                Err(error) => return Err(SourceError::from_read(&self.path, &self.field, error)),
            }
        }
        Ok(())
    }

    /// The error for an integer that no `f64` holds.
    fn too_wide(&self, integer: i128) -> SourceError {
        let remedy = "integers beyond 2^53 would be rounded; convert the file to f64 or narrower integers";
        SourceError::unsupported(&self.path, &self.field, integer, remedy)
    }
}
