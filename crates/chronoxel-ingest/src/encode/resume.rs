//! Whether an unfinished store can be continued: made from the same source with the same options.

use std::fmt::Debug;

use chronoxel_store::{Store, StoreDescription};
use serde_json::Value;

use crate::EncodeError;

/// Whether every step of the series is in the store.
pub fn is_finished(store: &Store) -> bool {
    store.header().num_steps_finished == store.header().num_steps()
}

/// Compares what a store was made from with what is to be encoded now.
///
/// # Errors
/// [`EncodeError::ResumeDiffers`] naming the first difference.
pub fn compare(store: &Store, now: &StoreDescription) -> Result<(), EncodeError> {
    let was = store.header();
    let differs = |field: &str, was: &dyn Debug, is: &dyn Debug| {
        let short = |value: &dyn Debug| format!("{value:?}").chars().take(120).collect();
        Err(EncodeError::ResumeDiffers {
            path: store.path().to_owned(),
            field: field.to_owned(),
            was: short(was),
            is: short(is),
        })
    };
    if was.grid != now.grid {
        return differs("grid", &was.grid, &now.grid);
    }
    if was.bricks != now.layout {
        return differs("--brick", &was.bricks.edge, &now.layout.edge);
    }
    if was.times.num_steps() != now.times.num_steps() {
        return differs("number of steps", &was.times.num_steps(), &now.times.num_steps());
    }
    if was.times.units != now.times.units {
        return differs("time units", &was.times.units, &now.times.units);
    }
    if let Some(step) = (0..now.times.num_steps()).find(|&s| was.times.times[s] != now.times.times[s]) {
        return differs(&format!("time of step {step}"), &was.times.times[step], &now.times.times[step]);
    }
    let names = |names: Vec<&String>| names.into_iter().cloned().collect::<Vec<_>>();
    let (names_were, names_are) = (
        names(was.variables.iter().map(|v| &v.name).collect()),
        names(now.variables.iter().map(|v| &v.name).collect()),
    );
    if names_were != names_are {
        return differs("variables", &names_were, &names_are);
    }
    for (was, now) in was.variables.iter().zip(&now.variables) {
        let field = |field: &str| format!("{field} of variable {}", now.name);
        if was.units != now.units {
            return differs(&field("units"), &was.units, &now.units);
        }
        if was.sample_type != now.sample_type {
            return differs(&field("sample type"), &was.sample_type, &now.sample_type);
        }
        if was.fill_value != now.fill_value {
            return differs(&field("fill value"), &was.fill_value, &now.fill_value);
        }
    }
    compare_options(&was.encoder, &now.encoder)
        .map_or(Ok(()), |(field, was, is)| differs(&field, &was, &is))?;
    for (was, now) in was.variables.iter().zip(&now.variables) {
        if was.windows != now.windows || was.classes != now.classes {
            return differs("payload classes", &was.classes, &now.classes);
        }
    }
    Ok(())
}

/// The first recorded option that differs, with both values.
fn compare_options(was: &Value, is: &Value) -> Option<(String, Value, Value)> {
    let (Value::Object(was), Value::Object(is)) = (was, is) else {
        return (was != is).then(|| ("options".into(), was.clone(), is.clone()));
    };
    let of = |options: &serde_json::Map<String, Value>, key: &str| {
        options.get(key).cloned().unwrap_or(Value::Null)
    };
    is.keys()
        .chain(was.keys())
        .find(|key| of(was, key) != of(is, key))
        .map(|key| (key.clone(), of(was, key), of(is, key)))
}
