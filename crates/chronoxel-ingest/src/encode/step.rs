//! One step of one variable streaming past: each brick is cut, analysed and handed on, batch by batch.

use chronoxel_core::{LevelGeometry, NodeId, Octree};
use rayon::prelude::*;

use super::analyse::{Analysis, analyse};
use super::cut::cut;
use super::mark::Marks;
use super::real::Real;
use super::stream::{Layer, StreamPlan, stream};
use crate::{EncodeError, StepReader};

/// What does not change from step to step.
pub struct Stepper<'a> {
    /// Slabs and levels.
    pub plan: &'a StreamPlan,
    /// The nodes, for their ranks.
    pub tree: &'a Octree,
    /// Bricks cut at once.
    pub batch_bricks: usize,
}

/// A brick of the step that streams past.
pub struct CutBrick<'a, T> {
    /// Its level.
    pub geometry: &'a LevelGeometry,
    /// Its place, in bricks.
    pub brick: [usize; 3],
    /// Its rank among the nodes of its level.
    pub rank: u32,
    /// `[z, y, x]` over core and apron; masked ones are NaN. May be taken.
    pub samples: &'a mut Vec<T>,
    /// What is known of them.
    pub analysis: Analysis,
}

/// What becomes of a brick; called in parallel.
pub type OfBrick<'a, T, R> = dyn Fn(CutBrick<'_, T>) -> Result<R, EncodeError> + Sync + 'a;
/// Takes what became of a batch of bricks of one level.
pub type TakeBatch<'a, R> = dyn FnMut(u8, Vec<R>) -> Result<(), EncodeError> + Send + 'a;

impl Stepper<'_> {
    /// Reads a step from its first slice to its last and hands on its bricks: layer by layer as [`stream`] completes
    /// them, in Morton order within a layer.
    ///
    /// * `take`: takes batches one after the other, each while the next is under way
    /// * `on_bricks`: told how many bricks of which level were cut
    pub fn each_brick<T: Real, R: Send>(
        &self,
        reader: Box<dyn StepReader + '_>,
        fill_value: Option<f64>,
        of_brick: &OfBrick<'_, T, R>,
        take: &mut TakeBatch<'_, R>,
        on_bricks: &mut dyn FnMut(u8, usize),
    ) -> Result<Marks, EncodeError> {
        let mut done: Option<(u8, Vec<R>)> = None;
        let marks = stream::<T, EncodeError>(reader, self.plan, fill_value, &mut |layer| {
            let level = layer.window.geometry.level;
            let bricks = bricks_of(self.tree, &layer.window.geometry, layer.z);
            for batch in bricks.chunks(self.batch_bricks) {
                let before = done.take();
                let (results, taken) = rayon::join(
                    || self.batch(&layer, batch, of_brick),
                    || before.map_or(Ok(()), |(level, results)| take(level, results)),
                );
                taken?;
                done = Some((level, results?));
                on_bricks(level, batch.len());
            }
            Ok(())
        })?;
        done.map_or(Ok(()), |(level, results)| take(level, results))?;
        Ok(marks)
    }

    fn batch<T: Real, R: Send>(
        &self,
        layer: &Layer<'_, T>,
        batch: &[(u32, [usize; 3])],
        of_brick: &OfBrick<'_, T, R>,
    ) -> Result<Vec<R>, EncodeError> {
        let geometry = &layer.window.geometry;
        let results: Vec<Result<R, EncodeError>> = batch
            .par_iter()
            .map_init(Vec::new, |samples: &mut Vec<T>, &(rank, brick)| {
                let may_be_masked = cut(layer.window, brick, &self.plan.layout, samples);
                let analysis = analyse(samples, may_be_masked, brick, geometry, &self.plan.layout);
                of_brick(CutBrick { geometry, brick, rank, samples, analysis })
            })
            .collect();
        // In order, so that of several errors it is always the first.
        results.into_iter().collect()
    }
}

/// Ranks and places of the bricks of a layer, by rank.
pub fn bricks_of(tree: &Octree, geometry: &LevelGeometry, z: usize) -> Vec<(u32, [usize; 3])> {
    let [nx, ny, _] = geometry.bricks;
    let mut bricks: Vec<_> = (0..ny)
        .flat_map(|y| (0..nx).map(move |x| [x, y, z]))
        .filter_map(|brick| {
            let node = NodeId::new(geometry.level, brick.map(|b| b as u32));
            tree.rank(node).map(|rank| (rank as u32, brick))
        })
        .collect();
    bricks.sort_unstable();
    bricks
}
