//! Classes of payloads: what fixes the number of bytes of each stage, so that payloads of one class
//! are the elements of one array.

use chronoxel_core::BrickLayout;
use serde::{Deserialize, Serialize};

use crate::CodecError;

/// Most stages of a payload.
pub const MAX_STAGES: usize = 8;
/// Most entries in a row of a listed table.
pub const MAX_ENTRIES: u32 = 1 << 16;
/// Most entries of a listed table, all rows together.
pub const MAX_TABLE: u64 = 1 << 20;
/// Most rows of a listed table, and so the longest window.
pub const MAX_ROWS: u32 = 1024;

/// The kind and size of a table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub enum TableClass {
    /// Offset and scale: 16 bytes.
    Affine,
    /// Offset, scale, and `rows * entries` numbers of 16 bits.
    Listed {
        /// Entries of a row, at most 65,536, and at most 256 with 8-bit indices.
        entries: u32,
        /// Rows.
        rows: u32,
    },
}

/// What fixes the number of bytes of a stage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StageClass {
    /// Bits of an index: 8 or 16.
    pub index_bits: u8,
    /// The table.
    pub table: TableClass,
    /// Row of a step: `(step - start) >> shift`.
    pub shift: u8,
}

/// What fixes the number of bytes of a payload.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PayloadClass {
    /// The classes of its stages, in order.
    pub stages: Vec<StageClass>,
}

impl std::fmt::Display for PayloadClass {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        for (number, stage) in self.stages.iter().enumerate() {
            let plus = if number > 0 { " + " } else { "" };
            match stage.table {
                TableClass::Affine => write!(f, "{plus}{}-bit affine", stage.index_bits)?,
                TableClass::Listed { entries, rows } => {
                    write!(f, "{plus}{}-bit table of {entries} x {rows}", stage.index_bits)?;
                }
            }
        }
        Ok(())
    }
}

impl StageClass {
    /// One affine stage with indices of `index_bits` bits.
    pub const fn affine(index_bits: u8) -> Self {
        Self { index_bits, table: TableClass::Affine, shift: 0 }
    }

    /// Bytes of the table at the front of a stage.
    pub const fn num_table_bytes(&self) -> usize {
        match self.table {
            TableClass::Affine => 16,
            TableClass::Listed { entries, rows } => 16 + 2 * entries as usize * rows as usize,
        }
    }

    /// Bytes of one index.
    pub const fn num_index_bytes(&self) -> usize {
        self.index_bits as usize / 8
    }

    /// Bytes of a stage: table, then core indices, then apron indices.
    pub const fn num_bytes(&self, layout: &BrickLayout) -> usize {
        self.num_table_bytes() + self.num_index_bytes() * layout.num_full()
    }

    /// Bytes of a stage of one index per point of a mesh: table, then indices.
    pub const fn num_point_bytes(&self, num_points: usize) -> usize {
        self.num_table_bytes() + self.num_index_bytes() * num_points
    }

    /// Whether spans of window length `window` may use the class: a listed table has one row for
    /// every `2^shift` steps of the window, no more and no fewer; an affine one serves any length.
    pub const fn fits_window(&self, window: u32) -> bool {
        match self.table {
            TableClass::Affine => true,
            TableClass::Listed { rows, .. } => {
                window > 0 && (window - 1) >> self.shift == rows.wrapping_sub(1)
            }
        }
    }

    /// Checks the class itself.
    ///
    /// # Errors
    /// [`CodecError::InvalidArgument`] for index widths other than 8 and 16, tables that are empty or too
    /// large, a shift of 32 or more, and an affine table with a shift.
    pub fn validate(&self) -> Result<(), CodecError> {
        if self.index_bits != 8 && self.index_bits != 16 {
            return Err(CodecError::invalid("index_bits", self.index_bits, "use 8 or 16"));
        }
        if self.shift >= 32 || (self.table == TableClass::Affine && self.shift != 0) {
            return Err(CodecError::invalid("shift", self.shift, "use 0 to 31, and 0 with an affine table"));
        }
        if let TableClass::Listed { entries, rows } = self.table {
            let most = if self.index_bits == 8 { 256 } else { MAX_ENTRIES };
            if entries == 0 || entries > most {
                return Err(CodecError::invalid(
                    "table entries",
                    entries,
                    "use 1 to 65536, to 256 with 8 bits",
                ));
            }
            if rows == 0 || rows > MAX_ROWS {
                return Err(CodecError::invalid("table rows", rows, "use 1 to 1024"));
            }
            if u64::from(entries) * u64::from(rows) > MAX_TABLE {
                let value = format!("{rows} x {entries}");
                return Err(CodecError::invalid("table size", value, "at most 2^20 entries over all rows"));
            }
        }
        Ok(())
    }
}

impl PayloadClass {
    /// One affine stage with indices of `index_bits` bits: raw quantised samples.
    pub fn affine(index_bits: u8) -> Self {
        Self { stages: vec![StageClass::affine(index_bits)] }
    }

    /// Whether spans of window length `window` may use the class: see [`StageClass::fits_window`].
    pub fn fits_window(&self, window: u32) -> bool {
        self.stages.iter().all(|stage| stage.fits_window(window))
    }

    /// Checks the number of stages and each of them.
    ///
    /// # Errors
    /// [`CodecError::InvalidArgument`] naming what is wrong.
    pub fn validate(&self) -> Result<(), CodecError> {
        if self.stages.is_empty() || self.stages.len() > MAX_STAGES {
            return Err(CodecError::invalid("number of stages", self.stages.len(), "use 1 to 8"));
        }
        self.stages.iter().try_for_each(StageClass::validate)
    }
}
