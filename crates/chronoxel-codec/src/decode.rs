//! Decoding: from a payload to the samples of a brick at one step.

use chronoxel_core::{BitMask, BrickLayout, ResidentBrick};

use crate::{CodecError, Indices, Payload, Stage, Table, quantize_affine};

/// The samples of a brick at a step of its span, core and apron, `[z, y, x]`.
///
/// `value = sum over stages, in order, of offset + scale * entry`, in `f64`.
///
/// # Errors
/// [`CodecError::Corrupt`] if the payload has no stage, a stage is not sound (see [`Stage::validate`]), or has no
/// row for the step.
pub fn decode_f64(
    payload: &Payload,
    layout: &BrickLayout,
    step_in_span: u32,
) -> Result<Vec<f64>, CodecError> {
    let mut samples = vec![0.0; layout.num_full()];
    if payload.stages.is_empty() {
        return Err(CodecError::corrupt("number of stages", 0, "a payload has at least one"));
    }
    for (at, stage) in payload.stages.iter().enumerate() {
        stage.validate(layout)?;
        let first = at == 0;
        match entries_of(stage, step_in_span)? {
            Entries::Affine { offset, scale } => {
                add(&mut samples, &stage.indices, first, |i| offset + scale * f64::from(i));
            }
            Entries::Row { offset, scale, row } => {
                let values: Vec<f64> = row.iter().map(|&entry| offset + scale * f64::from(entry)).collect();
                add(&mut samples, &stage.indices, first, |i| values[usize::from(i)]);
            }
        }
    }
    Ok(samples)
}

/// A brick at a step of its span, ready to be drawn: each sample rounded once, to 16 bits within the range of
/// the decoded brick. A single stage needs no rounding: its indices or entries are taken as they are.
///
/// # Errors
/// As [`decode_f64`].
pub fn decode_resident(
    payload: &Payload,
    layout: &BrickLayout,
    step_in_span: u32,
    mask: Option<BitMask>,
) -> Result<ResidentBrick, CodecError> {
    let [stage] = payload.stages.as_slice() else {
        let stage = quantize_affine(&decode_f64(payload, layout, step_in_span)?, false, 16)?;
        let (Indices::U16(samples), Table::Affine { offset, scale }) = (stage.indices, stage.table) else {
            return Err(CodecError::invalid("bits", 16, "the quantiser gives 16-bit indices"));
        };
        return Ok(ResidentBrick { samples, offset, scale, mask });
    };
    stage.validate(layout)?;
    let (offset, scale, samples) = match (entries_of(stage, step_in_span)?, &stage.indices) {
        (Entries::Affine { offset, scale }, Indices::U8(v)) => {
            (offset, scale, v.iter().map(|&i| u16::from(i)).collect())
        }
        (Entries::Affine { offset, scale }, Indices::U16(v)) => (offset, scale, v.clone()),
        (Entries::Row { offset, scale, row }, Indices::U8(v)) => {
            (offset, scale, v.iter().map(|&i| row[usize::from(i)]).collect())
        }
        (Entries::Row { offset, scale, row }, Indices::U16(v)) => {
            (offset, scale, v.iter().map(|&i| row[usize::from(i)]).collect())
        }
    };
    Ok(ResidentBrick { samples, offset, scale, mask })
}

/// Smallest and largest decoded sample over the first `num_steps` steps of a span, core and apron.
///
/// # Errors
/// As [`decode_f64`].
pub fn decoded_range(
    payload: &Payload,
    layout: &BrickLayout,
    num_steps: u32,
) -> Result<[f64; 2], CodecError> {
    if let [Stage { indices, table: Table::Affine { offset, scale }, .. }] = payload.stages.as_slice() {
        payload.stages[0].validate(layout)?;
        return Ok([indices.smallest(), indices.largest()].map(|i| offset + scale * f64::from(i)));
    }
    let mut range = [f64::INFINITY, f64::NEG_INFINITY];
    for step in 0..num_steps {
        for value in decode_f64(payload, layout, step)? {
            range = [range[0].min(value), range[1].max(value)];
        }
    }
    Ok(range)
}

enum Entries<'a> {
    Affine { offset: f64, scale: f64 },
    Row { offset: f64, scale: f64, row: &'a [u16] },
}

/// What the indices of a validated stage mean at a step.
fn entries_of(stage: &Stage, step_in_span: u32) -> Result<Entries<'_>, CodecError> {
    match &stage.table {
        Table::Affine { offset, scale } => Ok(Entries::Affine { offset: *offset, scale: *scale }),
        Table::Listed { offset, scale, num_rows, entries } => {
            let row = step_in_span.checked_shr(u32::from(stage.shift)).unwrap_or(0) as usize;
            if row >= *num_rows {
                let problem = format!("the table has {num_rows} rows");
                return Err(CodecError::corrupt("table row", row, problem));
            }
            let num_entries = entries.len() / num_rows;
            let row = &entries[row * num_entries..(row + 1) * num_entries];
            Ok(Entries::Row { offset: *offset, scale: *scale, row })
        }
    }
}

/// Adds the value of each index to its sample, or sets it where the stage is the first.
fn add(samples: &mut [f64], indices: &Indices, first: bool, value: impl Fn(u16) -> f64) {
    match (indices, first) {
        (Indices::U8(v), true) => samples.iter_mut().zip(v).for_each(|(s, &i)| *s = value(i.into())),
        (Indices::U8(v), false) => samples.iter_mut().zip(v).for_each(|(s, &i)| *s += value(i.into())),
        (Indices::U16(v), true) => samples.iter_mut().zip(v).for_each(|(s, &i)| *s = value(i)),
        (Indices::U16(v), false) => samples.iter_mut().zip(v).for_each(|(s, &i)| *s += value(i)),
    }
}
