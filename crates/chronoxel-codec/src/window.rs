//! The samples of one brick over the steps of one span, as the encoders of tables see them, and what they make of
//! them: a palette.

use chronoxel_core::BrickLayout;

use crate::{CodecError, Indices, Payload, SampleValue, Stage, Table, quantize::range_of};

/// The largest entry of a listed table.
const LARGEST_ENTRY: f64 = 65535.0;

/// The samples of a brick over the steps of a span, scaled to [0, 1] by their own range.
#[derive(Debug, Clone, PartialEq)]
pub struct UnitWindow {
    /// `[t, sample]`, the samples of a step being those of the full brick, `[z, y, x]`.
    pub values: Vec<f32>,
    /// Steps of the span: at least 1.
    pub num_steps: usize,
    /// Samples that tables are trained on, increasing, at least one: core samples inside the grid that are not masked.
    pub trained: Vec<u32>,
    /// `sample = offset + width * value`.
    pub offset: f64,
    /// Width of the range; 0 where all samples are equal, else at least 65,535 times the smallest normal number.
    pub width: f64,
}

/// A palette: for each sample of a brick one index, and for each index one value per step.
#[derive(Debug, Clone, PartialEq)]
pub struct Palette {
    /// One per sample of the full brick.
    pub indices: Indices,
    /// `[t, entry]`, in the units of the window: 0 to 1.
    pub values: Vec<f32>,
    /// Entries: at least 1.
    pub num_entries: usize,
}

impl UnitWindow {
    /// * `steps`: for each step the samples of the full brick, masked ones padded
    /// * `trained`: see [`Self::trained`]
    ///
    /// # Errors
    /// [`CodecError::InvalidArgument`] for no steps, steps of different sizes, a sample that is not finite, or a range
    /// beyond that of `f64`.
    pub fn new<T: SampleValue>(steps: &[&[T]], trained: Vec<u32>) -> Result<Self, CodecError> {
        let num_samples = steps.first().map_or(0, |step| step.len());
        if num_samples == 0 || steps.iter().any(|step| step.len() != num_samples) {
            return Err(CodecError::invalid(
                "steps of a window",
                steps.len(),
                "all of one size, at least one",
            ));
        }
        if trained.is_empty() || trained.iter().any(|&i| i as usize >= num_samples) {
            return Err(CodecError::invalid("samples to train on", trained.len(), "some of the brick's"));
        }
        let mut range = [f64::INFINITY, f64::NEG_INFINITY];
        for step in steps {
            let [low, high] = range_of(step)?;
            range = [range[0].min(low), range[1].max(high)];
        }
        let [low, width] = [range[0], range[1] - range[0]];
        if !width.is_finite() {
            let value = format!("{low} to {}", range[1]);
            return Err(CodecError::invalid("range of a brick", value, "scale the samples down"));
        }
        let scale = if width > 0.0 { (width / LARGEST_ENTRY).max(f64::MIN_POSITIVE) } else { 0.0 };
        let width = LARGEST_ENTRY * scale;
        let per_width = if width > 0.0 { 1.0 / width } else { 0.0 };
        let unit = |x: T| (((x.into() - low) * per_width) as f32).clamp(0.0, 1.0);
        let values = steps.iter().flat_map(|step| step.iter().map(|&x| unit(x))).collect();
        Ok(Self { values, num_steps: steps.len(), trained, offset: low, width })
    }

    /// Samples of one step.
    pub fn num_samples(&self) -> usize {
        self.values.len() / self.num_steps
    }

    /// The values of a step.
    pub fn step(&self, t: usize) -> &[f32] {
        let n = self.num_samples();
        &self.values[t * n..][..n]
    }

    /// What a palette leaves of the samples, scaled anew: a window for the next stage.
    ///
    /// The palette counts with its values rounded as [`Palette::to_stage`] rounds them.
    pub fn residual(&self, palette: &Palette) -> Self {
        let rounded: Vec<f32> =
            palette.values.iter().map(|&v| f32::from(entry_of(v)) / LARGEST_ENTRY as f32).collect();
        let mut values = Vec::with_capacity(self.values.len());
        for t in 0..self.num_steps {
            let row = &rounded[t * palette.num_entries..][..palette.num_entries];
            match &palette.indices {
                Indices::U8(v) => {
                    values.extend(self.step(t).iter().zip(v).map(|(x, &i)| x - row[usize::from(i)]))
                }
                Indices::U16(v) => {
                    values.extend(self.step(t).iter().zip(v).map(|(x, &i)| x - row[usize::from(i)]))
                }
            }
        }
        let low = values.iter().copied().fold(f32::INFINITY, f32::min);
        let high = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let width = high - low;
        // Residuals far below a unit of the window are what `f32` cannot tell from zero.
        let per_width = if width > 0.0 { 1.0 / width } else { 0.0 };
        values.iter_mut().for_each(|v| *v = ((*v - low) * per_width).clamp(0.0, 1.0));
        Self {
            values,
            num_steps: self.num_steps,
            trained: self.trained.clone(),
            offset: self.width * f64::from(low),
            width: self.width * f64::from(width),
        }
    }
}

/// The entry of a table for a value of a window.
fn entry_of(value: f32) -> u16 {
    (value * LARGEST_ENTRY as f32).round_ties_even() as u16
}

/// Stages of palettes: each made for what those before it leave, until nothing is left.
///
/// * `num_stages`: most stages, at least 1
/// * `num_entries`: entries of each table
/// * `num_rows`: rows of each table, at least the steps of the window
/// * `palette_of`: makes the palette of a stage
///
/// # Errors
/// [`CodecError::InvalidArgument`] where the tables are smaller than the palettes.
pub fn code_stages(
    window: &UnitWindow,
    layout: &BrickLayout,
    num_stages: usize,
    num_entries: usize,
    num_rows: usize,
    palette_of: impl Fn(&UnitWindow) -> Palette,
) -> Result<Payload, CodecError> {
    let mut palette = palette_of(window);
    let mut stages = vec![palette.to_stage(window, layout, num_entries, num_rows)?];
    if num_stages > 1 {
        let mut left = window.residual(&palette);
        while stages.len() < num_stages && left.width > 0.0 {
            palette = palette_of(&left);
            stages.push(palette.to_stage(&left, layout, num_entries, num_rows)?);
            left = left.residual(&palette);
        }
    }
    Ok(Payload { stages })
}

impl Palette {
    /// The stage that decodes to the palette: a listed table of `num_rows` rows of `num_entries` entries, in canonical form.
    ///
    /// * `num_entries`: at least that of the palette; entries beyond are zero
    /// * `num_rows`: at least the steps of the window; rows beyond repeat nothing and are zero
    ///
    /// # Errors
    /// [`CodecError::InvalidArgument`] if there are fewer, or one index does not fit the palette.
    pub fn to_stage(
        &self,
        window: &UnitWindow,
        layout: &BrickLayout,
        num_entries: usize,
        num_rows: usize,
    ) -> Result<Stage, CodecError> {
        if num_entries < self.num_entries || num_rows < window.num_steps {
            let value = format!("{num_rows} x {num_entries}");
            return Err(CodecError::invalid("size of a table", value, "at least that of the palette"));
        }
        let mut entries = vec![0u16; num_rows * num_entries];
        for (row, values) in
            entries.chunks_exact_mut(num_entries).zip(self.values.chunks_exact(self.num_entries))
        {
            row.iter_mut().zip(values).for_each(|(entry, &value)| *entry = entry_of(value));
        }
        let table =
            Table::Listed { offset: window.offset, scale: window.width / LARGEST_ENTRY, num_rows, entries };
        Stage { indices: self.indices.clone(), table, shift: 0 }.into_canonical(layout)
    }

    /// Sum of the squared errors over the trained samples of all steps, in the units of the window.
    pub fn squared_error(&self, window: &UnitWindow) -> f64 {
        let error = |t: usize, i: u32| {
            let index = match &self.indices {
                Indices::U8(v) => usize::from(v[i as usize]),
                Indices::U16(v) => usize::from(v[i as usize]),
            };
            f64::from(window.step(t)[i as usize] - self.values[t * self.num_entries + index])
        };
        (0..window.num_steps).map(|t| window.trained.iter().map(|&i| error(t, i).powi(2)).sum::<f64>()).sum()
    }
}
