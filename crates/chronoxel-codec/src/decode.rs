//! Decoding: from a payload to the samples of a brick at one step.

use chronoxel_core::{BitMask, BrickLayout, ResidentBrick};

use crate::{CodecError, Indices, Payload, Stage, Table, fixed::FixedSums};

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
    decode_samples(payload, layout.num_full(), step_in_span)
}

/// [`decode_f64`] of a payload of any number of samples, as the points of a mesh are.
///
/// # Errors
/// As [`decode_f64`].
pub fn decode_samples(
    payload: &Payload,
    num_samples: usize,
    step_in_span: u32,
) -> Result<Vec<f64>, CodecError> {
    validate_samples(payload, num_samples)?;
    let mut samples = vec![0.0; num_samples];
    for (at, stage) in payload.stages.iter().enumerate() {
        let row = Entries::of(stage, step_in_span)?;
        let first = at == 0;
        match (&row, &stage.indices) {
            (_, Indices::U8(_)) => {
                let values = row.padded().map(|entry| row.value(entry));
                add(&mut samples, &stage.indices, first, |i| values[usize::from(i) % 256]);
            }
            (Entries::Affine { offset, scale }, _) => {
                add(&mut samples, &stage.indices, first, |i| offset + scale * f64::from(i));
            }
            (Entries::Row { offset, scale, row }, _) => {
                let values: Vec<f64> = row.iter().map(|&entry| offset + scale * f64::from(entry)).collect();
                add(&mut samples, &stage.indices, first, |i| values[usize::from(i)]);
            }
        }
    }
    Ok(samples)
}

/// A brick at a step of its span, ready to be drawn: 16-bit samples.
///
/// A single stage needs no rounding: its indices or entries are taken as they are. Several stages are summed in fixed
/// point and rounded once, within the sum of the ranges that the stages have at the step. A sample then differs from
/// that of [`decode_f64`] by at most 0.501 of the brick's `scale` (which is at least the smallest normal number), plus
/// rounding in `f64`: `4 * (stages + 1)` units in the last place of the sum of the largest magnitudes of the stages.
///
/// # Errors
/// As [`decode_f64`], and where the range of a sum of several stages might not be finite.
pub fn decode_resident(
    payload: &Payload,
    layout: &BrickLayout,
    step_in_span: u32,
    mask: Option<BitMask>,
) -> Result<ResidentBrick, CodecError> {
    validate(payload, layout)?;
    let rows = rows_at(payload, step_in_span)?;
    let ([stage], [row]) = (payload.stages.as_slice(), rows.as_slice()) else {
        let FixedSums { samples, offset, scale, .. } = FixedSums::of(payload, &rows)?;
        return Ok(ResidentBrick { samples, offset, scale, mask });
    };
    let samples = match (row, &stage.indices) {
        (Entries::Affine { .. }, Indices::U8(v)) => v.iter().map(|&i| u16::from(i)).collect(),
        (Entries::Affine { .. }, Indices::U16(v)) => v.clone(),
        (Entries::Row { .. }, Indices::U8(v)) => {
            let row = row.padded();
            v.iter().map(|&i| row[usize::from(i)]).collect()
        }
        (Entries::Row { row, .. }, Indices::U16(v)) => v.iter().map(|&i| row[usize::from(i)]).collect(),
    };
    Ok(ResidentBrick { samples, offset: row.offset(), scale: row.scale(), mask })
}

/// Smallest and largest decoded sample over the first `num_steps` steps of a span, core and apron: exactly those of
/// [`decode_f64`].
///
/// # Errors
/// As [`decode_resident`].
pub fn decoded_range(
    payload: &Payload,
    layout: &BrickLayout,
    num_steps: u32,
) -> Result<[f64; 2], CodecError> {
    validate(payload, layout)?;
    let mut range = [f64::INFINITY, f64::NEG_INFINITY];
    let mut include = |value: f64| range = [range[0].min(value), range[1].max(value)];
    if let [stage] = payload.stages.as_slice() {
        // A value grows with its entry, rounding included.
        let used = used_entries(stage);
        for step in steps_of_new_rows(payload, num_steps) {
            let row = Entries::of(stage, step)?;
            let [low, high] = match &used {
                None => [stage.indices.smallest(), stage.indices.largest()],
                Some(used) => row.extremes_of(used),
            };
            for entry in [low, high] {
                include(row.value(entry));
            }
        }
        return Ok(range);
    }
    for step in steps_of_new_rows(payload, num_steps) {
        let rows = rows_at(payload, step)?;
        let fixed = FixedSums::of(payload, &rows)?;
        // An exact sum lies within `slack` of a fixed one, so the exact extremes are among the samples whose fixed sums
        // lie within twice that of the fixed extremes.
        let rounding = 4.0 * (rows.len() + 1) as f64 * f64::EPSILON * fixed.magnitude / fixed.scale;
        let slack = (2.0 * (0.501 + rounding)).ceil() as u16;
        let low = fixed.samples.iter().fold(u16::MAX, |low, &sum| low.min(sum)).saturating_add(slack);
        let high = fixed.samples.iter().fold(0, |high, &sum| high.max(sum)).saturating_sub(slack);
        for (block, samples) in fixed.samples.chunks(64).enumerate() {
            if samples.iter().fold(false, |any, &sum| any | (sum <= low) | (sum >= high)) {
                let extreme = |&(_, &sum): &(usize, &u16)| sum <= low || sum >= high;
                let extremes = samples.iter().enumerate().filter(extreme);
                extremes.for_each(|(at, _)| include(exact_sum(payload, &rows, 64 * block + at)));
            }
        }
    }
    Ok(range)
}

/// Checks every stage, and that there are some.
fn validate(payload: &Payload, layout: &BrickLayout) -> Result<(), CodecError> {
    validate_samples(payload, layout.num_full())
}

fn validate_samples(payload: &Payload, num_samples: usize) -> Result<(), CodecError> {
    if payload.stages.is_empty() {
        return Err(CodecError::corrupt("number of stages", 0, "a payload has at least one"));
    }
    payload.stages.iter().try_for_each(|stage| stage.validate_samples(num_samples))
}

/// The steps below `num_steps` at which a stage may have another row than at the step before.
fn steps_of_new_rows(payload: &Payload, num_steps: u32) -> impl Iterator<Item = u32> {
    let listed = payload.stages.iter().filter(|stage| matches!(stage.table, Table::Listed { .. }));
    let shift = listed.map(|stage| u32::from(stage.shift)).min().unwrap_or(u32::BITS);
    let last = num_steps.saturating_sub(1).checked_shr(shift).unwrap_or(0);
    (0..=last).filter(move |_| num_steps > 0).map(move |at| at.checked_shl(shift).unwrap_or(0))
}

/// Which entries of a listed table the indices use; `None` where the table is affine.
fn used_entries(stage: &Stage) -> Option<Vec<bool>> {
    let Table::Listed { num_rows, entries, .. } = &stage.table else { return None };
    let num_entries = entries.len() / num_rows;
    let mut used = vec![false; num_entries.max(256)];
    match &stage.indices {
        Indices::U8(v) => {
            let mut flags = [false; 256];
            v.iter().for_each(|&i| flags[usize::from(i)] = true);
            used[..256].copy_from_slice(&flags);
        }
        Indices::U16(v) => v.iter().for_each(|&i| used[usize::from(i)] = true),
    }
    used.truncate(num_entries);
    Some(used)
}

/// The sum of the stages at one sample, as [`decode_f64`] has it.
fn exact_sum(payload: &Payload, rows: &[Entries<'_>], at: usize) -> f64 {
    let value = |(row, stage): (&Entries<'_>, &Stage)| {
        let index = match &stage.indices {
            Indices::U8(v) => u16::from(v[at]),
            Indices::U16(v) => v[at],
        };
        let entry = match row {
            Entries::Affine { .. } => index,
            Entries::Row { row, .. } => row[usize::from(index)],
        };
        row.value(entry)
    };
    rows.iter().zip(&payload.stages).map(value).reduce(|sum, value| sum + value).unwrap_or(0.0)
}

/// What the indices of a stage mean at a step.
pub(crate) enum Entries<'a> {
    Affine { offset: f64, scale: f64 },
    Row { offset: f64, scale: f64, row: &'a [u16] },
}

/// What the indices of each stage of a validated payload mean at a step.
pub(crate) fn rows_at(payload: &Payload, step_in_span: u32) -> Result<Vec<Entries<'_>>, CodecError> {
    payload.stages.iter().map(|stage| Entries::of(stage, step_in_span)).collect()
}

impl<'a> Entries<'a> {
    /// What the indices of a validated stage mean at a step.
    fn of(stage: &'a Stage, step_in_span: u32) -> Result<Self, CodecError> {
        match &stage.table {
            Table::Affine { offset, scale } => Ok(Self::Affine { offset: *offset, scale: *scale }),
            Table::Listed { offset, scale, num_rows, entries } => {
                let row = step_in_span.checked_shr(u32::from(stage.shift)).unwrap_or(0) as usize;
                if row >= *num_rows {
                    let problem = format!("the table has {num_rows} rows");
                    return Err(CodecError::corrupt("table row", row, problem));
                }
                let num_entries = entries.len() / num_rows;
                let row = &entries[row * num_entries..(row + 1) * num_entries];
                Ok(Self::Row { offset: *offset, scale: *scale, row })
            }
        }
    }

    pub fn offset(&self) -> f64 {
        match self {
            Self::Affine { offset, .. } | Self::Row { offset, .. } => *offset,
        }
    }

    pub fn scale(&self) -> f64 {
        match self {
            Self::Affine { scale, .. } | Self::Row { scale, .. } => *scale,
        }
    }

    /// For each 8-bit index its entry; beyond the row, which no sound index reaches, 0.
    pub fn padded(&self) -> [u16; 256] {
        match self {
            Self::Affine { .. } => std::array::from_fn(|i| i as u16),
            Self::Row { row, .. } => {
                let mut padded = [0; 256];
                let len = row.len().min(256);
                padded[..len].copy_from_slice(&row[..len]);
                padded
            }
        }
    }

    /// The value of an entry.
    pub fn value(&self, entry: u16) -> f64 {
        self.offset() + self.scale() * f64::from(entry)
    }

    /// Bounds of the entries that the indices have: the extremes where the table is canonical.
    pub fn extremes(&self, indices: &Indices) -> [u16; 2] {
        match self {
            Self::Affine { .. } => [indices.smallest(), indices.largest()],
            Self::Row { row, .. } => {
                let row = &row[..=usize::from(indices.largest())];
                let low = row.iter().fold(u16::MAX, |low, &entry| low.min(entry));
                [low, row.iter().fold(0, |high, &entry| high.max(entry))]
            }
        }
    }

    /// Smallest and largest of the used entries of a row.
    fn extremes_of(&self, used: &[bool]) -> [u16; 2] {
        let Self::Row { row, .. } = self else { return [0; 2] };
        let used = row.iter().zip(used).filter(|(_, used)| **used);
        used.fold([u16::MAX, 0], |[low, high], (&entry, _)| [low.min(entry), high.max(entry)])
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
