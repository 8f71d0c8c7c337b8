//! Prints decoded samples of a store as JSON, for a check by another program:
//! `cargo run -p chronoxel-store --example print_samples -- STORE > samples.json`.
//!
//! `[{"variable", "level", "step", "node", "samples": [[index in the full brick, value or null where masked], …]}, …]`

use chronoxel_codec::decode_f64;
use chronoxel_core::SpanKind;
use chronoxel_store::Store;
use serde_json::{Value, json};

/// About this many samples of a brick are printed.
const NUM_PRINTED: usize = 50;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).ok_or("usage: print_samples STORE")?;
    let store = Store::open(path.as_ref())?;
    let header = store.header();
    let last = header.num_steps_finished.saturating_sub(1);
    let mut steps = vec![0, last / 2, last];
    steps.dedup();
    let mut entries = Vec::new();
    for variable in 0..header.variables.len() {
        for level in 0..header.levels.len() as u8 {
            for &step in &steps {
                for node in 0..store.tree().nodes(level).len() {
                    let samples = samples(&store, variable, level, step, node)?;
                    entries.push(json!({
                        "variable": variable, "level": level, "step": step, "node": node, "samples": samples
                    }));
                }
            }
        }
    }
    println!("{}", Value::Array(entries));
    Ok(())
}

fn samples(
    store: &Store,
    variable: usize,
    level: u8,
    step: u32,
    node: usize,
) -> Result<Value, Box<dyn std::error::Error>> {
    let span = store.spans(variable, level, step)?[node];
    let mask = store.read_mask(variable, level, &span)?;
    let num = store.layout().num_full();
    let values = match span.kind {
        SpanKind::Empty => vec![f64::NAN; num],
        SpanKind::Constant(value) => vec![value; num],
        SpanKind::Coded { .. } => {
            let payload = store.read_payload(variable, level, &span)?;
            decode_f64(&payload, store.layout(), step - span.start)?
        }
    };
    let sample = |i: usize| -> (usize, Option<f64>) {
        let masked = values[i].is_nan() || mask.as_ref().is_some_and(|mask| mask.get(i));
        (i, (!masked).then(|| values[i]))
    };
    let printed: Vec<_> = (0..num).step_by((num / NUM_PRINTED).max(1)).map(sample).collect();
    Ok(json!(printed))
}
