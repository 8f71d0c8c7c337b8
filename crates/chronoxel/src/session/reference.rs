//! The reference colour metric of a whole store: every brick of the finest level at every step, voxel by voxel.

use std::collections::HashMap;

use chronoxel_codec::{Payload, decode_f64};
use chronoxel_core::{
    LevelGeometry, NodeId, ResolvedTransfer, SpanKind, SpanRecord, TimeNode,
    metrics::{BrickColors, ColorEstimate, ColorSpace, ColorSums, VoxelColors},
};
use chronoxel_store::Store;
use chronoxel_stream::{ReferenceError, ReferenceErrors};
use rayon::prelude::*;

use crate::interrupt;

/// Sums of nodes over the time nodes that are stored: `[time node][node of the level]`.
type Sums = HashMap<TimeNode, Vec<ColorSums>>;

/// Computes the errors of all nodes over all time nodes, as far as the series is stored.
///
/// Holds all steps of one brick for each thread, and a few numbers for each node and time node.
///
/// # Errors
/// If a brick cannot be read, or Ctrl-C was pressed.
pub fn compute(
    store: &Store,
    variable: usize,
    transfer: &ResolvedTransfer,
    space: ColorSpace,
) -> anyhow::Result<ReferenceErrors> {
    let is_adaptive = (1..store.tree().num_levels() as u8).any(|level| {
        let mut nodes = store.tree().nodes(level).iter().map(|&morton| NodeId { level, morton });
        nodes.any(|node| store.tree().is_leaf(node))
    });
    anyhow::ensure!(
        !is_adaptive,
        "{}: the reference metric looks at voxels of level 0, which this tree does not have everywhere: use another metric",
        store.path().display()
    );
    let colors = VoxelColors::new(transfer, space);
    let geometry = store.header().geometry()[0];
    // [step][rank]
    let num_finished = store.header().num_steps_finished;
    let records: Vec<Vec<SpanRecord>> =
        (0..num_finished).map(|step| store.spans(variable, 0, step)).collect::<Result<_, _>>()?;
    let of_brick = |(rank, &morton): (usize, &u64)| {
        interrupt::check()?;
        let brick = Brick { store, variable, geometry: &geometry, node: NodeId { level: 0, morton } };
        brick.sums(&colors, records.iter().map(|of_step| &of_step[rank]))
    };
    let of_bricks: Vec<Vec<(TimeNode, ColorSums)>> =
        store.tree().nodes(0).par_iter().enumerate().map(of_brick).collect::<anyhow::Result<_>>()?;
    let mut finest = Sums::new();
    for (rank, sums) in of_bricks.iter().enumerate() {
        for (at, sums) in sums {
            let nodes = finest.entry(*at).or_insert_with(|| vec![ColorSums::default(); of_bricks.len()]);
            nodes[rank] = *sums;
        }
    }
    let of_time_nodes = finest.into_iter().map(|(at, sums)| (at, errors_of_tree(store, sums)));
    Ok(ReferenceErrors { of_time_nodes: of_time_nodes.collect() })
}

/// Errors of all nodes, finest level first, from the sums of the finest.
fn errors_of_tree(store: &Store, finest: Vec<ColorSums>) -> Vec<ReferenceError> {
    let tree = store.tree();
    let mut errors = Vec::new();
    let mut sums = finest;
    for level in 0..tree.num_levels() as u8 {
        if level > 0 {
            let mut merged = vec![ColorSums::default(); tree.nodes(level).len()];
            for (morton, sums) in tree.nodes(level - 1).iter().zip(&sums) {
                let parent = NodeId { level: level - 1, morton: *morton }.parent();
                let rank = tree.rank(parent).expect("every node has its parent");
                merged[rank] = merged[rank].merged(sums);
            }
            sums = merged;
        }
        errors.extend(sums.iter().map(|sums| ReferenceError {
            spatial: ColorEstimate { error: sums.spatial_error(), mean: sums.mean() },
            temporal: sums.temporal_error(),
        }));
    }
    errors
}

/// A brick of the finest level.
struct Brick<'a> {
    store: &'a Store,
    variable: usize,
    geometry: &'a LevelGeometry,
    node: NodeId,
}

impl Brick<'_> {
    /// What the metric needs of its steps.
    fn sums<'a>(
        &self,
        colors: &VoxelColors,
        records: impl Iterator<Item = &'a SpanRecord>,
    ) -> anyhow::Result<Vec<(TimeNode, ColorSums)>> {
        let core = self.geometry.core_inside(self.node.brick().map(|b| b as usize), self.store.layout());
        let mut brick = BrickColors::new(core.len(), self.store.header().num_steps());
        let mut sums = Vec::new();
        let mut held: Option<(u32, SpanKind, Payload)> = None;
        for (step, record) in records.enumerate() {
            let mut samples = self.samples(record, step as u32, &mut held)?;
            if let Some(mask) = self.store.read_mask(self.variable, 0, record)? {
                (0..samples.len()).filter(|&i| mask.get(i)).for_each(|i| samples[i] = f64::NAN);
            }
            sums.extend(brick.push(colors, core.iter().map(|&i| samples[i as usize])));
        }
        Ok(sums)
    }

    /// The samples of a step, core and apron; the payload read last is held.
    fn samples(
        &self,
        record: &SpanRecord,
        step: u32,
        held: &mut Option<(u32, SpanKind, Payload)>,
    ) -> anyhow::Result<Vec<f64>> {
        let layout = self.store.layout();
        match record.kind {
            SpanKind::Empty => return Ok(vec![f64::NAN; layout.num_full()]),
            SpanKind::Constant(value) => return Ok(vec![value; layout.num_full()]),
            SpanKind::Coded { .. } => {}
        }
        let payload = match held.take() {
            Some((window, kind, payload)) if (window, kind) == (record.window, record.kind) => payload,
            _ => self.store.read_payload(self.variable, 0, record)?,
        };
        let samples = decode_f64(&payload, layout, step - record.start)?;
        *held = Some((record.window, record.kind, payload));
        Ok(samples)
    }
}
