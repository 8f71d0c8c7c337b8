//! One step of one variable: each brick is cut or made, analysed and handed on, batch by batch.

use chronoxel_core::{LevelGeometry, NodeId, Octree, Samples};
use rayon::prelude::*;

use super::analyse::{Analysis, analyse};
use super::cut::cut;
use super::mark::Marks;
use super::real::Real;
use super::stream::{Layer, StreamPlan, stream};
use crate::voxelise::{MeshStep, Voxels};
use crate::{EncodeError, StepReader};

/// Where the bricks of a step come from.
pub enum Feed<'a> {
    /// They are cut from slices that stream past.
    Slices(Box<dyn StepReader + 'a>),
    /// They are made from values at the points of a mesh.
    Mesh {
        /// The values.
        values: Samples,
        /// The mesh.
        voxels: &'a Voxels,
    },
}

/// What does not change from step to step.
pub struct Stepper<'a> {
    /// Slabs and levels.
    pub plan: &'a StreamPlan,
    /// The nodes, for their ranks.
    pub tree: &'a Octree,
    /// Bricks cut at once.
    pub batch_bricks: usize,
    /// What the cores of nodes above the finest may take in memory, while the bricks of a mesh are made.
    pub core_bytes: u64,
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
    /// Hands on the bricks of a step. Of slices: layer by layer as [`stream`] completes them, in Morton order within a layer.
    /// Of a mesh: level by level, finest first, in Morton order.
    ///
    /// * `take`: takes batches one after the other, each while the next is under way
    /// * `on_bricks`: told how many bricks of which level were cut
    pub fn each_brick<T: Real, R: Send>(
        &self,
        feed: Feed<'_>,
        fill_value: Option<f64>,
        of_brick: &OfBrick<'_, T, R>,
        take: &mut TakeBatch<'_, R>,
        on_bricks: &mut dyn FnMut(u8, usize),
    ) -> Result<Marks, EncodeError> {
        let reader = match feed {
            Feed::Slices(reader) => reader,
            Feed::Mesh { values, voxels } => {
                let scratch = voxels.core_scratch::<T>(self.core_bytes)?;
                let values = T::from_samples(values).expect("the kind of samples follows from their type");
                let step = MeshStep::new(voxels, values, fill_value, scratch);
                return self.each_of_mesh(voxels, step, of_brick, take, on_bricks);
            }
        };
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

    fn each_of_mesh<T: Real, R: Send>(
        &self,
        voxels: &Voxels,
        mut step: MeshStep<'_, T>,
        of_brick: &OfBrick<'_, T, R>,
        take: &mut TakeBatch<'_, R>,
        on_bricks: &mut dyn FnMut(u8, usize),
    ) -> Result<Marks, EncodeError> {
        let mut done: Option<(u8, Vec<R>)> = None;
        let mut marks = step.marks();
        for batch in MeshStep::<T>::batches(voxels, self.batch_bricks) {
            let geometry = &self.plan.levels[usize::from(batch.level)];
            let before = done.take();
            let make = |rank: u32, brick: [usize; 3], samples: &mut Vec<T>| {
                let analysis = analyse(samples, true, brick, geometry, &self.plan.layout);
                let is_leaf = voxels.is_leaf(batch.level, rank as usize);
                let range =
                    if is_leaf { [analysis.statistics.min, analysis.statistics.max] } else { [f64::NAN; 2] };
                Ok((of_brick(CutBrick { geometry, brick, rank, samples, analysis })?, range))
            };
            let (made, taken) = rayon::join(
                || step.make(&batch, &make),
                || before.map_or(Ok(()), |(level, results)| take(level, results)),
            );
            taken?;
            let (results, ranges): (Vec<R>, Vec<[f64; 2]>) = made?.into_iter().unzip();
            // NaN, where there is no sample, changes nothing.
            let range = |r: [f64; 2], v: &[f64; 2]| [r[0].min(v[0]), r[1].max(v[1])];
            marks.range = ranges.iter().fold(marks.range, range);
            done = Some((batch.level, results));
            on_bricks(batch.level, batch.ranks.len());
        }
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
