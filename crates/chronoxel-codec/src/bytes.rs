//! The canonical bytes of a stage: table, core indices, apron indices.
//!
//! All numbers are little-endian. The table is `offset` and `scale` as `f64`, and for a listed table its
//! entries as `u16`, row after row. Core indices are `edge`³ in `[z, y, x]` order; apron indices are
//! those of the remaining samples in the order in which they appear in the full brick. Indices of 8 bits are
//! one byte each; those of 16 bits are two planes, first all high bytes, then all low bytes, for core and
//! apron separately, since the planes compress better apart.

use chronoxel_core::BrickLayout;

use crate::{CodecError, Indices, Stage, StageClass, Table, TableClass};

/// The bytes of a stage. Their number is `stage.class().num_bytes(layout)`.
///
/// # Panics
/// If the stage has not one index per sample of the layout: see [`Stage::validate`].
pub fn stage_to_bytes(stage: &Stage, layout: &BrickLayout) -> Vec<u8> {
    assert_eq!(stage.indices.len(), layout.num_full(), "one index per sample");
    let mut bytes = Vec::with_capacity(stage.class().num_bytes(layout));
    table_to_bytes(stage, &mut bytes);
    for part in [Part::Core, Part::Apron] {
        match &stage.indices {
            Indices::U8(v) => {
                each_run(layout, part, |start, len| bytes.extend_from_slice(&v[start..start + len]))
            }
            Indices::U16(v) => {
                for shift in [8, 0] {
                    each_run(layout, part, |start, len| {
                        bytes.extend(v[start..start + len].iter().map(|&i| (i >> shift) as u8));
                    });
                }
            }
        }
    }
    bytes
}

/// The bytes of a stage with one index per point of a mesh: the table, then all indices, as those of a core.
///
/// Their number is that of [`StageClass::num_point_bytes`].
pub fn point_stage_to_bytes(stage: &Stage) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(stage.class().num_point_bytes(stage.indices.len()));
    table_to_bytes(stage, &mut bytes);
    match &stage.indices {
        Indices::U8(v) => bytes.extend_from_slice(v),
        Indices::U16(v) => {
            [8, 0].iter().for_each(|shift| bytes.extend(v.iter().map(|&i| (i >> shift) as u8)))
        }
    }
    bytes
}

/// A stage of one index per point from its bytes.
///
/// # Errors
/// As [`stage_from_bytes`].
pub fn point_stage_from_bytes(
    class: &StageClass,
    num_points: usize,
    bytes: &[u8],
) -> Result<Stage, CodecError> {
    if bytes.len() != class.num_point_bytes(num_points) {
        let problem = format!("a stage of this class has {}", class.num_point_bytes(num_points));
        return Err(CodecError::corrupt("number of bytes", bytes.len(), problem));
    }
    let (table, indices) = bytes.split_at(class.num_table_bytes());
    let indices = match class.index_bits {
        8 => Indices::U8(indices.to_vec()),
        _ => {
            let (high, low) = indices.split_at(num_points);
            let join = |(&high, &low): (&u8, &u8)| u16::from(high) << 8 | u16::from(low);
            Indices::U16(high.iter().zip(low).map(join).collect())
        }
    };
    let stage = Stage { indices, table: table_from_bytes(class, table), shift: class.shift };
    stage.validate_samples(num_points)?;
    Ok(stage)
}

fn table_to_bytes(stage: &Stage, bytes: &mut Vec<u8>) {
    match &stage.table {
        Table::Affine { offset, scale } => {
            bytes.extend_from_slice(&offset.to_le_bytes());
            bytes.extend_from_slice(&scale.to_le_bytes());
        }
        Table::Listed { offset, scale, entries, .. } => {
            bytes.extend_from_slice(&offset.to_le_bytes());
            bytes.extend_from_slice(&scale.to_le_bytes());
            entries.iter().for_each(|entry| bytes.extend_from_slice(&entry.to_le_bytes()));
        }
    }
}

/// * `table`: as many bytes as the class has for it
fn table_from_bytes(class: &StageClass, table: &[u8]) -> Table {
    let number = |at: usize| f64::from_le_bytes(std::array::from_fn(|i| table[at + i]));
    let (offset, scale) = (number(0), number(8));
    match class.table {
        TableClass::Affine => Table::Affine { offset, scale },
        TableClass::Listed { rows, .. } => {
            let entries = table[16..].chunks_exact(2).map(|b| u16::from_le_bytes([b[0], b[1]])).collect();
            Table::Listed { offset, scale, num_rows: rows as usize, entries }
        }
    }
}

/// A stage from its bytes.
///
/// # Errors
/// [`CodecError::Corrupt`] if the number of bytes is not that of the class, an index lies outside the table, or
/// a value would not be finite.
pub fn stage_from_bytes(class: &StageClass, layout: &BrickLayout, bytes: &[u8]) -> Result<Stage, CodecError> {
    if bytes.len() != class.num_bytes(layout) {
        let problem = format!("a stage of this class has {}", class.num_bytes(layout));
        return Err(CodecError::corrupt("number of bytes", bytes.len(), problem));
    }
    let (table, indices) = bytes.split_at(class.num_table_bytes());
    let table = table_from_bytes(class, table);
    let indices = match class.index_bits {
        8 => Indices::U8(u8_indices(layout, indices)),
        _ => Indices::U16(u16_indices(layout, indices)),
    };
    let stage = Stage { indices, table, shift: class.shift };
    stage.validate(layout)?;
    Ok(stage)
}

fn u8_indices(layout: &BrickLayout, bytes: &[u8]) -> Vec<u8> {
    let mut indices = vec![0u8; layout.num_full()];
    let mut at = 0;
    for part in [Part::Core, Part::Apron] {
        each_run(layout, part, |start, len| {
            indices[start..start + len].copy_from_slice(&bytes[at..at + len]);
            at += len;
        });
    }
    indices
}

fn u16_indices(layout: &BrickLayout, bytes: &[u8]) -> Vec<u16> {
    let mut indices = vec![0u16; layout.num_full()];
    let (core, apron) = bytes.split_at(2 * layout.num_core());
    for (part, planes) in [(Part::Core, core), (Part::Apron, apron)] {
        let (high, low) = planes.split_at(planes.len() / 2);
        let mut at = 0;
        each_run(layout, part, |start, len| {
            let pairs = high[at..at + len].iter().zip(&low[at..at + len]);
            for (index, (&high, &low)) in indices[start..start + len].iter_mut().zip(pairs) {
                *index = u16::from(high) << 8 | u16::from(low);
            }
            at += len;
        });
    }
    indices
}

/// The two byte ranges of the indices of a stage.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Part {
    Core,
    Apron,
}

/// Calls `run(start, len)` for each run of neighbouring samples of a part, in the order of the full brick.
fn each_run(layout: &BrickLayout, part: Part, mut run: impl FnMut(usize, usize)) {
    let (full, low, edge) = (layout.full_edge(), layout.low, layout.edge);
    let in_core = |i: usize| (low..low + edge).contains(&i);
    for z in 0..full {
        for y in 0..full {
            let row = (z * full + y) * full;
            match (part, in_core(z) && in_core(y)) {
                (Part::Core, true) => run(row + low, edge),
                (Part::Core, false) => {}
                (Part::Apron, true) => {
                    run(row, low);
                    run(row + low + edge, layout.high);
                }
                (Part::Apron, false) => run(row, full),
            }
        }
    }
}
