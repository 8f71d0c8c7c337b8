//! Numbers written as text, as a stream of the little-endian bytes of their sample type.

use std::io::{BufRead, Error, ErrorKind, Read, Result};

use chronoxel_core::SampleType;

/// The longest number that is read; `f64` needs at most 24 characters as usually written.
const MAX_NUMBER_CHARS: usize = 512;

/// Turns text with numbers between white space or commas into the bytes of samples.
pub(crate) struct NumberText<R> {
    input: R,
    sample_type: SampleType,
    /// Bytes of the last number that did not fit into the caller's buffer.
    left: [u8; 8],
    num_left: usize,
    token: Vec<u8>,
}

impl<R: BufRead> NumberText<R> {
    /// Numbers of a type from the front of a text.
    pub fn new(input: R, sample_type: SampleType) -> Self {
        Self { input, sample_type, left: [0; 8], num_left: 0, token: Vec::new() }
    }

    /// Reads the next number into `left`; `false` at the end of the text.
    fn next_number(&mut self) -> Result<bool> {
        self.token.clear();
        loop {
            let available = match self.input.fill_buf() {
                Ok(available) => available,
                Err(e) if e.kind() == ErrorKind::Interrupted => continue,
                Err(e) => return Err(e),
            };
            if available.is_empty() {
                break;
            }
            if self.token.is_empty() {
                let blanks = available.iter().take_while(|b| is_blank(**b)).count();
                if blanks > 0 {
                    self.input.consume(blanks);
                    continue;
                }
            }
            let end = available.iter().position(|b| is_blank(*b));
            let taken = end.unwrap_or(available.len());
            if self.token.len() + taken > MAX_NUMBER_CHARS {
                return Err(Error::new(
                    ErrorKind::InvalidData,
                    "text without white space where numbers should be",
                ));
            }
            self.token.extend_from_slice(&available[..taken]);
            self.input.consume(taken);
            if end.is_some() {
                break;
            }
        }
        if self.token.is_empty() {
            return Ok(false);
        }
        self.left = bytes_of(&self.token, self.sample_type).ok_or_else(|| {
            let text = format!(
                "{:?} is not a number of type {}",
                self.token.escape_ascii().to_string(),
                self.sample_type
            );
            Error::new(ErrorKind::InvalidData, text)
        })?;
        self.num_left = self.sample_type.num_bytes();
        Ok(true)
    }
}

impl<R: BufRead> Read for NumberText<R> {
    fn read(&mut self, out: &mut [u8]) -> Result<usize> {
        let size = self.sample_type.num_bytes();
        let mut filled = 0;
        while filled < out.len() {
            if self.num_left == 0 && !self.next_number()? {
                break;
            }
            let count = self.num_left.min(out.len() - filled);
            let start = size - self.num_left;
            out[filled..filled + count].copy_from_slice(&self.left[start..start + count]);
            self.num_left -= count;
            filled += count;
        }
        Ok(filled)
    }
}

/// What may stand between two numbers.
fn is_blank(byte: u8) -> bool {
    byte.is_ascii_whitespace() || byte == b','
}

/// The little-endian bytes of a number, at the front of eight.
fn bytes_of(token: &[u8], sample_type: SampleType) -> Option<[u8; 8]> {
    /// One arm: parses the text as a type and lays its bytes down.
    macro_rules! parsed {
        ($text:expr, $type:ty) => {{
            let mut bytes = [0; 8];
            bytes[..size_of::<$type>()].copy_from_slice(&$text.parse::<$type>().ok()?.to_le_bytes());
            Some(bytes)
        }};
    }
    let text = std::str::from_utf8(token).ok()?;
    match sample_type {
        SampleType::U8 => parsed!(text, u8),
        SampleType::I8 => parsed!(text, i8),
        SampleType::U16 => parsed!(text, u16),
        SampleType::I16 => parsed!(text, i16),
        SampleType::U32 => parsed!(text, u32),
        SampleType::I32 => parsed!(text, i32),
        SampleType::U64 => parsed!(text, u64),
        SampleType::I64 => parsed!(text, i64),
        SampleType::F32 => parsed!(text, f32),
        SampleType::F64 => parsed!(text, f64),
    }
}

#[cfg(test)]
mod tests {
    use std::io::BufReader;

    use super::*;

    #[test]
    fn numbers_cross_every_boundary_of_buffers() {
        let text = " 1 -2,3.5e1\n nan\t-inf 0.1 ";
        for capacity in 1..9 {
            let input = BufReader::with_capacity(capacity, text.as_bytes());
            let mut bytes = Vec::new();
            NumberText::new(input, SampleType::F32).read_to_end(&mut bytes).unwrap();
            let values: Vec<f32> =
                bytes.chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
            assert_eq!(values[..3], [1.0, -2.0, 35.0]);
            assert!(values[3].is_nan());
            assert_eq!(values[4..], [f32::NEG_INFINITY, 0.1]);
        }
    }

    #[test]
    fn what_is_no_number_of_the_type_is_refused() {
        for text in ["1 x", "256", "-1", "1.5", "99999999999999999999"] {
            let mut out = Vec::new();
            assert!(
                NumberText::new(text.as_bytes(), SampleType::U8).read_to_end(&mut out).is_err(),
                "{text}"
            );
        }
        let long = "1".repeat(10_000);
        assert!(NumberText::new(long.as_bytes(), SampleType::F64).read_to_end(&mut Vec::new()).is_err());
    }
}
