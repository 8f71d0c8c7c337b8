//! Sizes in bytes as people write and read them: `512MiB`, `1.5GB`, `4096`.

use std::fmt;
use std::str::FromStr;

use anyhow::{Context, Result, bail};

/// A number of bytes. Reads `512MiB` (1024²), `1.5GB` (1000³), `2G` (1024³, as other tools do) and
/// plain `4096`; prints binary units with three digits: `1.50 GiB`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ByteSize(pub u64);

/// Units in ascending order; the power is that of 1024 or 1000.
const PREFIXES: [(char, u32); 5] = [('k', 1), ('m', 2), ('g', 3), ('t', 4), ('p', 5)];

/// Bytes in one of a unit, by its name in lower case.
fn unit_bytes(unit: &str) -> Option<u64> {
    if unit.is_empty() || unit == "b" {
        return Some(1);
    }
    let mut letters = unit.chars();
    let first = letters.next()?;
    let power = PREFIXES.iter().find(|(letter, _)| *letter == first)?.1;
    match letters.as_str() {
        "" | "i" | "ib" => Some(1024u64.pow(power)),
        "b" => Some(1000u64.pow(power)),
        _ => None,
    }
}

impl FromStr for ByteSize {
    type Err = anyhow::Error;

    /// # Errors
    /// If the text is not a number with a unit, is negative, or does not fit 64 bits.
    fn from_str(text: &str) -> Result<Self> {
        let trimmed = text.trim();
        let end = trimmed.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(trimmed.len());
        let (number, unit) = trimmed.split_at(end);
        let unit = unit.trim().to_ascii_lowercase();
        let expected = "write a number and a unit, like 512MiB, 4GiB, 1.5GB or 4096";
        let Some(per_unit) = unit_bytes(&unit) else {
            bail!("size '{text}' is not understood: {expected}");
        };
        if let Ok(whole) = number.parse::<u64>() {
            let bytes = whole.checked_mul(per_unit);
            return bytes
                .map(Self)
                .with_context(|| format!("size '{text}' is too large: it must fit 64 bits"));
        }
        let Ok(number) = number.parse::<f64>() else {
            bail!("size '{text}' is not understood: {expected}");
        };
        let bytes = (number * per_unit as f64).round();
        if bytes >= u64::MAX as f64 {
            bail!("size '{text}' is too large: it must fit 64 bits");
        }
        Ok(Self(bytes as u64))
    }
}

impl fmt::Display for ByteSize {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0 < 1024 {
            return write!(f, "{} B", self.0);
        }
        let units = ["KiB", "MiB", "GiB", "TiB", "PiB", "EiB"];
        let mut value = self.0 as f64 / 1024.0;
        let mut unit = 0;
        // 999.5 would print as 1000 with three digits; 1023.5 as 1024.
        while value >= 1023.5 && unit + 1 < units.len() {
            value /= 1024.0;
            unit += 1;
        }
        let decimals = if value >= 99.95 { 0 } else { 1 + usize::from(value < 9.995) };
        write!(f, "{value:.decimals$} {}", units[unit])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> u64 {
        text.parse::<ByteSize>().unwrap().0
    }

    #[test]
    fn sizes_as_people_write_them() {
        assert_eq!(parsed("512MiB"), 536_870_912);
        assert_eq!(parsed("4GiB"), 4_294_967_296);
        assert_eq!(parsed("1.5GB"), 1_500_000_000);
        assert_eq!(parsed(" 2 g "), 2_147_483_648);
        assert_eq!(parsed("64k"), 65_536);
        assert_eq!(parsed("0.5KiB"), 512);
        assert_eq!(parsed("4096"), 4096);
        assert_eq!(parsed("4096B"), 4096);
        assert_eq!(parsed("18446744073709551615"), u64::MAX);
    }

    #[test]
    fn what_is_no_size_is_refused_in_one_line() {
        for text in
            ["", "MiB", "12XB", "-1", "1e9", "1.2.3M", "16384PiB", "1 024", "nan", "99999999999.5PB", "."]
        {
            let error = text.parse::<ByteSize>().unwrap_err().to_string();
            assert!(error.contains(&format!("'{text}'")) && !error.contains('\n'), "{error}");
        }
    }

    #[test]
    fn sizes_as_people_read_them() {
        let shown = |bytes: u64| ByteSize(bytes).to_string();
        assert_eq!(shown(0), "0 B");
        assert_eq!(shown(1023), "1023 B");
        assert_eq!(shown(1024), "1.00 KiB");
        assert_eq!(shown(1_500_000_000), "1.40 GiB");
        assert_eq!(shown(13_000_000), "12.4 MiB");
        assert_eq!(shown(536_870_912), "512 MiB");
        assert_eq!(shown(1024 * 1024 - 1), "1.00 MiB");
        assert_eq!(shown(u64::MAX), "16.0 EiB");
    }

    #[test]
    fn what_is_printed_is_read_again() {
        for bytes in [0u64, 900, 1024, 70_000, 123_456_789, 5_000_000_000] {
            let again = parsed(&ByteSize(bytes).to_string());
            assert!(again.abs_diff(bytes) as f64 <= 0.006 * bytes as f64, "{bytes} became {again}");
        }
    }
}
