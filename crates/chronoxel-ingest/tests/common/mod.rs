//! A series in memory.

use chronoxel_core::{SampleType, Samples, TimeAxis, UniformGrid};
use chronoxel_ingest::{SourceError, StepReader, TimeSeries, Variable};

/// One variable, every step in memory.
#[derive(Clone)]
pub struct MemorySeries {
    pub grid: UniformGrid,
    pub times: TimeAxis,
    pub variables: Vec<Variable>,
    /// `[variable][step]`, each `[z, y, x]`.
    pub steps: Vec<Vec<Vec<f64>>>,
    /// Slices read of each step, over all variables.
    pub slices_read: Vec<usize>,
    /// A step whose last slice cannot be read.
    pub broken_step: Option<usize>,
}

impl MemorySeries {
    pub fn new(dims: [usize; 3], sample_type: SampleType, steps: Vec<Vec<f64>>) -> Self {
        let times = TimeAxis::regular(steps.len(), 0.5, "s").unwrap();
        let variable = Variable { name: "v".into(), units: "K".into(), sample_type, fill_value: None };
        let slices_read = vec![0; steps.len()];
        Self {
            grid: UniformGrid::new(dims, [0.0; 3], [1.0, 1.0, 2.0]).unwrap(),
            times,
            variables: vec![variable],
            steps: vec![steps],
            slices_read,
            broken_step: None,
        }
    }

    /// Samples from a function of step and place.
    pub fn of(
        dims: [usize; 3],
        sample_type: SampleType,
        num_steps: usize,
        f: impl Fn(usize, [usize; 3]) -> f64,
    ) -> Self {
        let step = |s: usize| {
            let place = |i: usize| [i % dims[0], i / dims[0] % dims[1], i / (dims[0] * dims[1])];
            (0..dims.iter().product()).map(|i| f(s, place(i))).collect()
        };
        Self::new(dims, sample_type, (0..num_steps).map(step).collect())
    }
}

impl TimeSeries for MemorySeries {
    fn grid(&self) -> &UniformGrid {
        &self.grid
    }

    fn times(&self) -> &TimeAxis {
        &self.times
    }

    fn variables(&self) -> &[Variable] {
        &self.variables
    }

    fn open_step<'a>(
        &'a mut self,
        variable: usize,
        step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError> {
        Ok(Box::new(MemoryReader {
            area: self.grid.dims[0] * self.grid.dims[1],
            samples: &self.steps[variable][step],
            fits_f32: self.variables[variable].sample_type.fits_f32(),
            slices_read: &mut self.slices_read[step],
            is_broken: self.broken_step == Some(step),
        }))
    }
}

struct MemoryReader<'a> {
    area: usize,
    samples: &'a [f64],
    fits_f32: bool,
    slices_read: &'a mut usize,
    is_broken: bool,
}

impl StepReader for MemoryReader<'_> {
    fn read_slices(&mut self, num_slices: usize) -> Result<Samples, SourceError> {
        let (slices, rest) = self.samples.split_at(num_slices * self.area);
        if rest.is_empty() && self.is_broken {
            let source = std::io::Error::other("broken on purpose");
            return Err(SourceError::Io { path: "memory".into(), action: "read", source });
        }
        self.samples = rest;
        *self.slices_read += num_slices;
        Ok(match self.fits_f32 {
            true => Samples::F32(slices.iter().map(|&v| v as f32).collect()),
            false => Samples::F64(slices.to_vec()),
        })
    }
}

/// Numbers that look random, in [0, 1): SplitMix64.
pub fn noise(seed: u64) -> f64 {
    let mut z = seed.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ z >> 31) >> 11) as f64 / (1u64 << 53) as f64
}
