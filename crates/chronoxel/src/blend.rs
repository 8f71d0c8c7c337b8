//! Pictures between two steps: bricks whose samples are interpolated in time.

use chronoxel_codec::{Indices, Table, decode_f64, quantize_affine};
use chronoxel_core::{BitMask, BrickLayout, NodeId, ResidentBrick, SpanKind, SpanRecord, SpanStatistics};
use chronoxel_store::Store;

/// What two consecutive spans of a node come to between their steps, for selection: the union of what may be drawn.
///
/// * `weight`: of the later one, in (0, 1)
pub fn record_between([first, second]: [SpanRecord; 2], weight: f64) -> SpanRecord {
    let kind = match (first.kind, second.kind) {
        (SpanKind::Empty, _) | (_, SpanKind::Empty) => SpanKind::Empty,
        (SpanKind::Constant(a), SpanKind::Constant(b)) => SpanKind::Constant(between(a, b, weight)),
        (coded @ SpanKind::Coded { .. }, _) | (_, coded) => coded,
    };
    let [a, b] = [first.drawn_range, second.drawn_range];
    SpanRecord {
        kind,
        mask: first.mask.or(second.mask),
        drawn_range: [a[0].min(b[0]), a[1].max(b[1])],
        statistics: SpanStatistics { count: 0, min: f64::NAN, max: f64::NAN, mean: f64::NAN, std: f64::NAN },
        ..first
    }
}

fn between(a: f64, b: f64, weight: f64) -> f64 {
    a * (1.0 - weight) + b * weight
}

/// A brick between two steps. A sample that is masked in either is masked.
///
/// * `weight`: of the later step, in (0, 1)
///
/// # Errors
/// Of the store, or if the samples are too far apart to be interpolated.
pub fn brick_between(
    store: &Store,
    variable: usize,
    node: NodeId,
    records: [SpanRecord; 2],
    step: u32,
    weight: f64,
) -> anyhow::Result<ResidentBrick> {
    let layout = &store.header().bricks;
    let [first, second] = &records;
    let mut samples = samples_of(store, variable, node, first, step, layout)?;
    let later = samples_of(store, variable, node, second, step + 1, layout)?;
    samples.iter_mut().zip(later).for_each(|(a, b)| *a = between(*a, b, weight));
    let mut mask: Option<BitMask> = None;
    for record in &records {
        let Some(other) = store.read_mask(variable, node.level, record)? else { continue };
        match &mut mask {
            Some(mask) => mask.bytes.iter_mut().zip(other.bytes).for_each(|(a, b)| *a |= b),
            None => mask = Some(other),
        }
    }
    let stage = quantize_affine(&samples, false, 16)?;
    let (Indices::U16(samples), Table::Affine { offset, scale }) = (stage.indices, stage.table) else {
        anyhow::bail!("16 bits were asked for, and other indices came");
    };
    Ok(ResidentBrick { samples, offset, scale, mask })
}

fn samples_of(
    store: &Store,
    variable: usize,
    node: NodeId,
    record: &SpanRecord,
    step: u32,
    layout: &BrickLayout,
) -> anyhow::Result<Vec<f64>> {
    match record.kind {
        SpanKind::Coded { .. } => {
            let payload = store.read_payload(variable, node.level, record)?;
            Ok(decode_f64(&payload, layout, step - record.start)?)
        }
        SpanKind::Constant(value) => Ok(vec![value; layout.num_full()]),
        SpanKind::Empty => anyhow::bail!("an empty brick has no samples"),
    }
}
