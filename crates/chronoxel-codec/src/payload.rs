//! Payloads in memory: what a coded span holds.

use chronoxel_core::BrickLayout;

use crate::{CodecError, StageClass, TableClass};

/// One index per sample of a brick, core and apron together, `[z, y, x]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Indices {
    /// Up to 256 entries.
    U8(Vec<u8>),
    /// Up to 65,536 entries.
    U16(Vec<u16>),
}

impl Indices {
    /// Number of indices.
    pub fn len(&self) -> usize {
        match self {
            Self::U8(v) => v.len(),
            Self::U16(v) => v.len(),
        }
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Bits of one index: 8 or 16.
    pub fn bits(&self) -> u8 {
        match self {
            Self::U8(_) => 8,
            Self::U16(_) => 16,
        }
    }

    /// The largest index; 0 where there are none.
    pub fn largest(&self) -> u16 {
        match self {
            Self::U8(v) => u16::from(v.iter().fold(0, |largest, &i| largest.max(i))),
            Self::U16(v) => v.iter().fold(0, |largest, &i| largest.max(i)),
        }
    }

    /// The smallest index; 0 where there are none.
    pub fn smallest(&self) -> u16 {
        match self {
            Self::U8(v) if !v.is_empty() => u16::from(v.iter().fold(u8::MAX, |least, &i| least.min(i))),
            Self::U16(v) if !v.is_empty() => v.iter().fold(u16::MAX, |least, &i| least.min(i)),
            _ => 0,
        }
    }
}

/// What an index means.
#[derive(Debug, Clone, PartialEq)]
pub enum Table {
    /// `value = offset + scale * index`, at every step of the span.
    Affine {
        /// Value of index 0.
        offset: f64,
        /// Value step per index, at least 0.
        scale: f64,
    },
    /// `value = offset + scale * entries[row][index]`.
    Listed {
        /// Value of entry 0.
        offset: f64,
        /// Value step per unit of an entry, at least 0.
        scale: f64,
        /// Rows of the table; the row of a step is `(step - start) >> shift`.
        num_rows: usize,
        /// `[row, entry]`.
        entries: Vec<u16>,
    },
}

/// One stage of a payload.
#[derive(Debug, Clone, PartialEq)]
pub struct Stage {
    /// One index per sample.
    pub indices: Indices,
    /// What the indices mean.
    pub table: Table,
    /// Row of a step: `(step - start) >> shift`.
    pub shift: u8,
}

/// A coded span: stages, summed in order.
#[derive(Debug, Clone, PartialEq)]
pub struct Payload {
    /// At least one stage.
    pub stages: Vec<Stage>,
}

impl Payload {
    /// The first step of the span that decodes to the same samples as another because the same entries are listed for both.
    ///
    /// * `step_in_span`: counted from the span's first
    pub fn first_step_like(&self, step_in_span: u32) -> u32 {
        let alike = |step: &u32| self.stages.iter().all(|stage| stage.row(*step) == stage.row(step_in_span));
        (0..step_in_span).find(alike).unwrap_or(step_in_span)
    }
}

impl Stage {
    /// The entries that are listed for a step; none of a table that is the same for all, or beyond its rows.
    fn row(&self, step_in_span: u32) -> Option<&[u16]> {
        let Table::Listed { num_rows, entries, .. } = &self.table else { return None };
        let num_entries = entries.len().checked_div(*num_rows)?;
        entries.chunks_exact(num_entries.max(1)).nth(step_in_span.checked_shr(self.shift.into())? as usize)
    }

    /// The class of the stage: what fixes the number of its bytes.
    pub fn class(&self) -> StageClass {
        let table = match &self.table {
            Table::Affine { .. } => TableClass::Affine,
            Table::Listed { num_rows, entries, .. } => TableClass::Listed {
                entries: entries.len().checked_div(*num_rows).unwrap_or(0) as u32,
                rows: *num_rows as u32,
            },
        };
        StageClass { index_bits: self.indices.bits(), table, shift: self.shift }
    }

    /// Checks that the stage can be decoded: one index per sample, every index in the table, and
    /// every value finite.
    ///
    /// # Errors
    /// [`CodecError::Corrupt`] naming what is wrong.
    pub fn validate(&self, layout: &BrickLayout) -> Result<(), CodecError> {
        self.validate_samples(layout.num_full())
    }

    /// [`Self::validate`] of a stage of any number of samples.
    ///
    /// # Errors
    /// As [`Self::validate`].
    pub fn validate_samples(&self, num_samples: usize) -> Result<(), CodecError> {
        if self.indices.len() != num_samples {
            let problem = format!("there are {num_samples} samples");
            return Err(CodecError::corrupt("number of indices", self.indices.len(), problem));
        }
        let (offset, scale, largest) = match &self.table {
            Table::Affine { offset, scale } => (*offset, *scale, (1u32 << self.indices.bits()) - 1),
            Table::Listed { offset, scale, num_rows, entries } => {
                if *num_rows == 0 || entries.is_empty() || entries.len() % num_rows != 0 {
                    let problem = format!("not a table of {num_rows} rows");
                    return Err(CodecError::corrupt("number of table entries", entries.len(), problem));
                }
                let num_entries = entries.len() / num_rows;
                // Indices of 8 bits cannot leave a table of 256 entries.
                let all_fit = num_entries >= 1 << self.indices.bits();
                if !all_fit && usize::from(self.indices.largest()) >= num_entries {
                    let problem = format!("the table has {num_entries} entries");
                    return Err(CodecError::corrupt("index", self.indices.largest(), problem));
                }
                (*offset, *scale, u32::from(u16::MAX))
            }
        };
        if !offset.is_finite() {
            return Err(CodecError::corrupt("table offset", offset, "it must be finite"));
        }
        if !(scale >= 0.0 && (offset + scale * f64::from(largest)).is_finite()) {
            return Err(CodecError::corrupt("table scale", scale, "it must be finite and not negative"));
        }
        Ok(())
    }

    /// The stage with a listed table in canonical form: used entries only, equal ones merged, sorted
    /// by their values row after row, unused entries zero and last. An affine stage stays as it is.
    ///
    /// Decoding gives the same samples; two stages that decode alike from tables of the same offset,
    /// scale and shape have equal bytes afterwards, so that they can be stored once.
    ///
    /// # Errors
    /// [`CodecError::Corrupt`] if the stage cannot be decoded.
    pub fn into_canonical(self, layout: &BrickLayout) -> Result<Self, CodecError> {
        self.validate(layout)?;
        let Table::Listed { offset, scale, num_rows, entries } = self.table else { return Ok(self) };
        let num_entries = entries.len() / num_rows;
        let mut used = vec![false; num_entries];
        match &self.indices {
            Indices::U8(v) => v.iter().for_each(|&i| used[usize::from(i)] = true),
            Indices::U16(v) => v.iter().for_each(|&i| used[usize::from(i)] = true),
        }
        let column = |entry: usize| (0..num_rows).map(move |row| row * num_entries + entry);
        let values = |entry: usize| -> Vec<u16> { column(entry).map(|at| entries[at]).collect() };
        let mut columns: Vec<Vec<u16>> = (0..num_entries).filter(|&e| used[e]).map(values).collect();
        columns.sort_unstable();
        columns.dedup();
        let place = |entry: usize| columns.binary_search(&values(entry)).unwrap_or(0) as u16;
        let new_index: Vec<u16> = (0..num_entries).map(|e| if used[e] { place(e) } else { 0 }).collect();
        let mut sorted = vec![0u16; entries.len()];
        for (entry, values) in columns.iter().enumerate() {
            column(entry).zip(values).for_each(|(at, &value)| sorted[at] = value);
        }
        let indices = match self.indices {
            Indices::U8(v) => Indices::U8(v.iter().map(|&i| new_index[usize::from(i)] as u8).collect()),
            Indices::U16(v) => Indices::U16(v.iter().map(|&i| new_index[usize::from(i)]).collect()),
        };
        Ok(Self { indices, table: Table::Listed { offset, scale, num_rows, entries: sorted }, ..self })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_with_the_same_entries_are_found() {
        let listed = |entries: &[u16], shift| Stage {
            indices: Indices::U8(vec![0, 1]),
            table: Table::Listed {
                offset: 0.0,
                scale: 1.0,
                num_rows: entries.len() / 2,
                entries: entries.to_vec(),
            },
            shift,
        };
        let affine = Stage {
            indices: Indices::U8(vec![0, 1]),
            table: Table::Affine { offset: 0.0, scale: 1.0 },
            shift: 0,
        };
        let payload = Payload { stages: vec![affine, listed(&[1, 2, 3, 4, 1, 2, 1, 2], 0)] };
        assert_eq!([0, 1, 2, 3].map(|step| payload.first_step_like(step)), [0, 1, 0, 0]);
        let two = Payload { stages: vec![listed(&[1, 2, 3, 4, 1, 2, 1, 2], 0), listed(&[5, 6, 7, 8], 1)] };
        assert_eq!([0, 1, 2, 3].map(|step| two.first_step_like(step)), [0, 1, 2, 2]);
    }
}
