//! Whether an unfinished store can be continued: made from the same source with the same options.

use std::fmt::Debug;

use chronoxel_core::Octree;
use chronoxel_store::{Header, Store, StoreDescription};
use serde_json::{Map, Value};

use crate::EncodeError;

/// Whether every step of the series is in the store.
pub fn is_finished(store: &Store) -> bool {
    store.is_complete()
}

/// Compares what a store was made from with what is to be encoded now.
///
/// # Errors
/// [`EncodeError::ResumeDiffers`] naming the first difference.
pub fn compare(store: &Store, now: &StoreDescription) -> Result<(), EncodeError> {
    let was = store.header();
    let difference = of_axes(was, now)
        .or_else(|| of_variables(was, now))
        .or_else(|| of_options(&was.encoder, &now.encoder))
        .or_else(|| differ("mesh", &was.mesh, &now.mesh))
        .or_else(|| of_trees(store.tree(), &now.tree))
        .or_else(|| of_classes(was, now));
    match difference {
        None => Ok(()),
        Some(Difference { field, was, is }) => {
            Err(EncodeError::ResumeDiffers { path: store.path().to_owned(), field, was, is })
        }
    }
}

struct Difference {
    field: String,
    was: String,
    is: String,
}

/// The two values, shortened, where they differ.
fn differ<T: PartialEq + Debug>(field: impl Into<String>, was: &T, is: &T) -> Option<Difference> {
    let short = |value: &T| format!("{value:?}").chars().take(120).collect();
    (was != is).then(|| Difference { field: field.into(), was: short(was), is: short(is) })
}

fn of_axes(was: &Header, now: &StoreDescription) -> Option<Difference> {
    let time_of_step = || {
        let mut steps = was.times.times.iter().zip(&now.times.times).enumerate();
        steps.find_map(|(step, (was, is))| differ(format!("time of step {step}"), was, is))
    };
    differ("grid", &was.grid, &now.grid)
        .or_else(|| differ("--brick", &was.bricks.edge, &now.layout.edge))
        .or_else(|| differ("number of steps", &was.times.num_steps(), &now.times.num_steps()))
        .or_else(|| differ("time units", &was.times.units, &now.times.units))
        .or_else(time_of_step)
}

fn of_variables(was: &Header, now: &StoreDescription) -> Option<Difference> {
    let names_were: Vec<&str> = was.variables.iter().map(|v| v.name.as_str()).collect();
    let names_are: Vec<&str> = now.variables.iter().map(|v| v.name.as_str()).collect();
    differ("variables", &names_were, &names_are).or_else(|| {
        was.variables.iter().zip(&now.variables).find_map(|(was, now)| {
            let field = |field: &str| format!("{field} of variable {}", now.name);
            differ(field("units"), &was.units, &now.units)
                .or_else(|| differ(field("sample type"), &was.sample_type, &now.sample_type))
                .or_else(|| differ(field("fill value"), &was.fill_value, &now.fill_value))
        })
    })
}

/// The first recorded option that differs.
fn of_options(was: &Value, is: &Value) -> Option<Difference> {
    let (Value::Object(was), Value::Object(is)) = (was, is) else {
        return differ("options", was, is);
    };
    let of = |options: &Map<String, Value>, key: &String| options.get(key).cloned().unwrap_or(Value::Null);
    is.keys().chain(was.keys()).find_map(|key| differ(key, &of(was, key), &of(is, key)))
}

/// Nodes follow from the grid, or from the mesh and its values.
fn of_trees(was: &Octree, is: &Octree) -> Option<Difference> {
    let num_nodes =
        |tree: &Octree| (0..tree.num_levels() as u8).map(|level| tree.nodes(level).len()).sum::<usize>();
    differ("number of nodes", &num_nodes(was), &num_nodes(is)).or_else(|| {
        let differs = was != is;
        differs.then(|| Difference {
            field: "octree".into(),
            was: "another".into(),
            is: "that of the source".into(),
        })
    })
}

fn of_classes(was: &Header, now: &StoreDescription) -> Option<Difference> {
    was.variables.iter().zip(&now.variables).find_map(|(was, now)| {
        differ("payload classes", &was.classes, &now.classes)
            .or_else(|| differ("windows", &was.windows, &now.windows))
    })
}
