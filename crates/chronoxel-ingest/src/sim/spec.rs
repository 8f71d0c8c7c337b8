//! What a user asks of a built-in simulation: `NAME?key=value&…`, taken apart and checked.

use crate::SourceError;

/// Most samples of one step: the states of the solvers are held in memory.
const MAX_SAMPLES: u128 = 1 << 31;
const MAX_STEPS: usize = 1_000_000;

/// A name and its options, in the order given.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Spec {
    pub name: String,
    options: Vec<(String, String)>,
}

impl Spec {
    /// Takes `sim:NAME?key=value&…` apart; names and keys are not judged yet.
    pub fn parse(text: &str) -> Result<Self, SourceError> {
        let body = text.strip_prefix("sim:").ok_or_else(|| {
            invalid("simulation", text, "write it as sim:NAME or sim:NAME?key=value&key=value")
        })?;
        let (name, tail) = body.split_once('?').unwrap_or((body, ""));
        let mut options: Vec<(String, String)> = Vec::new();
        for pair in tail.split('&').filter(|p| !p.is_empty()) {
            let Some((key, value)) = pair.split_once('=') else {
                return Err(invalid("simulation option", pair, "write it as key=value"));
            };
            if options.iter().any(|(k, _)| k == key) {
                return Err(invalid("simulation option", pair, "this key was given before; give it once"));
            }
            options.push((key.to_owned(), value.to_owned()));
        }
        Ok(Self { name: name.to_owned(), options })
    }

    /// Refuses keys that the simulation does not have.
    pub fn check_keys(&self, known: &[&str]) -> Result<(), SourceError> {
        match self.options.iter().find(|(k, _)| !known.contains(&k.as_str())) {
            None => Ok(()),
            Some((key, _)) => Err(invalid(
                "simulation option",
                key,
                format!("sim:{} has the options {}", self.name, known.join(", ")),
            )),
        }
    }

    /// The option `dims`: `N` for a cube or `XxYxZ`, each at least `smallest`.
    pub fn dims(&self, default: [usize; 3], smallest: usize) -> Result<[usize; 3], SourceError> {
        let Some(text) = self.value("dims") else { return Ok(default) };
        let remedy = format!("give N or XxYxZ, each from {smallest} to 8192, at most 2^31 samples in all");
        let wrong = || invalid("option dims", text, &remedy);
        let numbers: Vec<usize> =
            text.split('x').map(|n| n.parse().map_err(|_| wrong())).collect::<Result<_, _>>()?;
        let dims = match numbers[..] {
            [n] => [n; 3],
            [x, y, z] => [x, y, z],
            _ => return Err(wrong()),
        };
        let each_fits = dims.iter().all(|n| (smallest..=8192).contains(n));
        if !each_fits || dims.iter().map(|&n| n as u128).product::<u128>() > MAX_SAMPLES {
            return Err(wrong());
        }
        Ok(dims)
    }

    /// The option `steps`: how many steps the run is divided into.
    pub fn steps(&self, default: usize) -> Result<usize, SourceError> {
        let Some(text) = self.value("steps") else { return Ok(default) };
        text.parse().ok().filter(|n| (1..=MAX_STEPS).contains(n)).ok_or_else(|| {
            invalid("option steps", text, format!("give a whole number from 1 to {MAX_STEPS}"))
        })
    }

    /// The option `seed`: any unsigned 64-bit number.
    pub fn seed(&self, default: u64) -> Result<u64, SourceError> {
        let Some(text) = self.value("seed") else { return Ok(default) };
        text.parse().map_err(|_| invalid("option seed", text, "give a whole number from 0 to 2^64 - 1"))
    }

    /// The option of a key as it was written, which must be there.
    pub fn needed(&self, key: &'static str, remedy: &str) -> Result<&str, SourceError> {
        let value = self.value(key).filter(|value| !value.is_empty());
        value.ok_or_else(|| invalid("simulation option", key, remedy))
    }

    /// A real option between two limits, both included.
    pub fn number(&self, key: &'static str, default: f64, limits: [f64; 2]) -> Result<f64, SourceError> {
        let Some(text) = self.value(key) else { return Ok(default) };
        text.parse().ok().filter(|x: &f64| *x >= limits[0] && *x <= limits[1]).ok_or_else(|| {
            invalid(
                "simulation option",
                format!("{key}={text}"),
                format!("give a number from {} to {}", limits[0], limits[1]),
            )
        })
    }

    fn value(&self, key: &str) -> Option<&str> {
        self.options.iter().find(|(k, _)| k == key).map(|(_, v)| v.as_str())
    }
}

/// An error of the caller's, shortened so that it stays on one line.
pub(super) fn invalid(argument: &'static str, value: impl ToString, remedy: impl ToString) -> SourceError {
    let shown: String =
        value.to_string().chars().take(80).map(|c| if c.is_control() { ' ' } else { c }).collect();
    SourceError::InvalidArgument { argument, value: format!("`{shown}`"), remedy: remedy.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dims_are_a_cube_or_three_numbers() {
        let dims = |tail: &str| Spec::parse(&format!("sim:plume?dims={tail}")).unwrap().dims([9; 3], 8);
        assert_eq!(dims("32").unwrap(), [32; 3]);
        assert_eq!(dims("160x64x32").unwrap(), [160, 64, 32]);
        assert_eq!(Spec::parse("sim:plume").unwrap().dims([9; 3], 8).unwrap(), [9; 3]);
        for wrong in ["", "7", "8x8", "8x8x8x8", "-8", "1e3", "8192", "99999999999999999999", "8xx8"] {
            assert!(dims(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn numbers_outside_their_limits_are_refused() {
        let spec = Spec::parse("sim:plume?steps=0&limit=nan&seed=-1").unwrap();
        assert!(spec.steps(3).is_err());
        assert!(spec.number("limit", 1.0, [0.0, 2.0]).is_err());
        assert!(spec.seed(1).is_err());
    }
}
