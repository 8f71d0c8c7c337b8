//! Steps of a built-in simulation, whole.

use chronoxel_core::Samples;
use chronoxel_ingest::sim;

/// All samples of some steps, opened in the order given.
pub fn steps_of(spec: &str, steps: &[usize]) -> Vec<Vec<f32>> {
    let mut series = sim::open(spec).unwrap();
    let num_slices = series.grid().dims[2];
    let mut read = |step: &usize| match series.open_step(0, *step).unwrap().read_slices(num_slices).unwrap() {
        Samples::F32(samples) => samples,
        Samples::F64(_) => panic!("f32 was declared"),
    };
    steps.iter().map(&mut read).collect()
}
