//! A field in closed form, for volumes of any size: waves that run through each other, so that no brick is empty, constant or still.

use chronoxel_core::{SampleType, Samples, TimeAxis, UniformGrid};
use chronoxel_ingest::{SourceError, StepReader, TimeSeries, Variable};
use rayon::prelude::*;

/// Waves, each a product of three: periods along x, y and z over the volume, what they move by from step to step, and a weight.
const WAVES: [([f32; 3], [f32; 3], f32); 4] = [
    ([2.0, 3.0, 2.5], [0.11, 0.07, 0.05], 1.0),
    ([5.0, 4.0, 3.0], [0.19, 0.13, -0.17], 0.8),
    ([7.0, 6.0, 8.0], [-0.23, 0.29, 0.11], 0.5),
    ([11.0, 13.0, 9.0], [0.31, -0.37, 0.41], 0.25),
];

/// The series.
#[derive(Debug)]
pub struct Ripples {
    grid: UniformGrid,
    times: TimeAxis,
    variables: [Variable; 1],
}

impl Ripples {
    /// A cube of some samples along an edge, over some steps.
    ///
    /// # Errors
    /// If there are no steps, or fewer than two samples.
    pub fn new(edge: usize, num_steps: usize) -> anyhow::Result<Self> {
        let variable = Variable {
            name: "ripples".to_owned(),
            units: String::new(),
            sample_type: SampleType::F32,
            fill_value: None,
        };
        Ok(Self {
            grid: UniformGrid::new([edge; 3], [0.0; 3], [1.0; 3])?,
            times: TimeAxis::new((0..num_steps).map(|t| t as f64).collect(), String::new())?,
            variables: [variable],
        })
    }
}

impl TimeSeries for Ripples {
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
        _variable: usize,
        step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError> {
        let along = |axis: usize| {
            let n = self.grid.dims[axis];
            WAVES.map(|(periods, speeds, _)| {
                let at = |i: usize| i as f32 / n as f32 * periods[axis] + step as f32 * speeds[axis];
                (0..n).map(|i| (std::f32::consts::TAU * at(i)).sin()).collect()
            })
        };
        Ok(Box::new(RipplesStep { waves: [along(0), along(1), along(2)], next_slice: 0 }))
    }
}

/// One step: the waves along each axis.
struct RipplesStep {
    waves: [[Vec<f32>; WAVES.len()]; 3],
    next_slice: usize,
}

impl StepReader for RipplesStep {
    fn read_slices(&mut self, num_slices: usize) -> Result<Samples, SourceError> {
        let [x, y, z] = &self.waves;
        let (nx, ny) = (x[0].len(), y[0].len());
        let sum: f32 = WAVES.iter().map(|wave| wave.2).sum();
        let mut samples = vec![0.5f32; nx * ny * num_slices];
        let first = self.next_slice;
        samples.par_chunks_mut(nx).enumerate().for_each(|(row, samples)| {
            let (j, k) = (row % ny, first + row / ny);
            for (wave, (_, _, weight)) in WAVES.iter().enumerate() {
                let factor = 0.5 * weight / sum * y[wave][j] * z[wave][k];
                samples.iter_mut().zip(&x[wave]).for_each(|(sample, x)| *sample += factor * x);
            }
        });
        self.next_slice += num_slices;
        Ok(Samples::F32(samples))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slices_are_those_of_the_formula() {
        let mut ripples = Ripples::new(16, 3).unwrap();
        let mut reader = ripples.open_step(0, 2).unwrap();
        reader.read_slices(5).unwrap();
        let Samples::F32(slices) = reader.read_slices(2).unwrap() else { panic!("32-bit floats") };
        let wave = |axis: usize, at: usize, wave: usize| {
            let (periods, speeds, _) = WAVES[wave];
            let turns = f64::from(periods[axis]) * at as f64 / 16.0 + 2.0 * f64::from(speeds[axis]);
            (std::f64::consts::TAU * turns).sin()
        };
        for (i, sample) in slices.iter().enumerate() {
            let [x, y, z] = [i % 16, i / 16 % 16, 5 + i / 256];
            let sum: f64 =
                (0..4).map(|w| f64::from(WAVES[w].2) * wave(0, x, w) * wave(1, y, w) * wave(2, z, w)).sum();
            assert!((f64::from(*sample) - 0.5 - 0.5 * sum / 2.55).abs() < 1e-5, "{i}");
        }
    }
}
