//! The time axis: which time each step has.

use serde::{Deserialize, Serialize};

use crate::CoreError;

/// Times of the steps of a series, strictly increasing; spacing may be uneven.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TimeAxis {
    /// Time of each step, in `units`.
    pub times: Vec<f64>,
    /// What the times are counted in, as the source says it; empty where it does not.
    pub units: String,
}

impl TimeAxis {
    /// An axis that was checked.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] if there is no step, a time is not finite, or a time does not
    /// exceed the one before it.
    pub fn new(times: Vec<f64>, units: impl Into<String>) -> Result<Self, CoreError> {
        if times.is_empty() {
            return Err(CoreError::invalid("number of time steps", 0, "a series needs at least one"));
        }
        if let Some(t) = times.iter().find(|t| !t.is_finite()) {
            return Err(CoreError::invalid("time", t, "times must be finite"));
        }
        if let Some(step) = (1..times.len()).find(|&s| times[s] <= times[s - 1]) {
            return Err(CoreError::invalid(
                "time",
                format!("{} at step {step} after {}", times[step], times[step - 1]),
                "times must increase from step to step",
            ));
        }
        Ok(Self { times, units: units.into() })
    }

    /// Steps numbered `0, dt, 2 dt, …`.
    pub fn regular(num_steps: usize, dt: f64, units: impl Into<String>) -> Result<Self, CoreError> {
        Self::new((0..num_steps).map(|s| s as f64 * dt).collect(), units)
    }

    /// Number of steps.
    pub fn num_steps(&self) -> usize {
        self.times.len()
    }

    /// The step whose time is nearest to `time`; the earlier one where two are equally near.
    pub fn nearest_step(&self, time: f64) -> usize {
        let after = self.times.partition_point(|&t| t < time);
        match after {
            0 => 0,
            n if n == self.times.len() => n - 1,
            n if self.times[n] - time < time - self.times[n - 1] => n,
            n => n - 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nearest_step_on_an_uneven_axis() {
        let axis = TimeAxis::new(vec![2.0, 3.0, 30.0], "hours").unwrap();
        let found: Vec<usize> = [0.0, 2.5, 2.6, 16.0, 17.0, 99.0].map(|t| axis.nearest_step(t)).into();
        assert_eq!(found, [0, 0, 1, 1, 2, 2]);
    }

    #[test]
    fn times_that_do_not_increase_are_refused() {
        assert!(TimeAxis::new(vec![], "").is_err());
        assert!(TimeAxis::new(vec![0.0, 0.0], "").is_err());
        assert!(TimeAxis::new(vec![0.0, f64::NAN], "").is_err());
    }
}
