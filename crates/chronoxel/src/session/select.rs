//! From a view and a step to a draw list: records and statistics of nodes, and the errors that the view's metric sees in them.

use std::sync::Arc;

use anyhow::Context;
use chronoxel_core::{
    NodeId, NodeStatistics, Octree, ResolvedTransfer, SpanRecord, TimeNode,
    metrics::{ColorSpace, ColorTable},
    time_tree::num_time_levels,
};
use chronoxel_store::StoreError;
use chronoxel_stream::{
    ActiveCut, Appearance, ApproximateErrors, Coherence, DrawItem, Estimates, NodeErrors, ReferenceErrors,
    ScalarErrors, Selector, StepStatistics, Tolerances, ViewVolume,
};

use super::{Faults, Session, View, reference};
use crate::blend::record_between;

/// Which errors decide what is coherent (ellsworth2000, section 5).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Metric {
    /// Variation of the values.
    Scalar,
    /// Variation of the colours, voxel by voxel: every step is read once for each transfer function. For measuring.
    ColorReference(ColorSpace),
    /// Variation of the colours, estimated from the statistics of the values.
    ColorApproximate(ColorSpace),
}

/// What of a series' coherence is used to draw it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CoherenceView {
    /// By which metric.
    pub metric: Metric,
    /// How much error is allowed.
    pub tolerances: Tolerances,
    /// Whether what is transparent is left out by its smallest and largest value, as it should be: for measuring.
    pub skips_transparent: bool,
}

/// Entries of the table that colours of nodes are estimated from.
const NUM_ENTRIES: usize = 256;

/// What is known of colours under the transfer function drawn with last.
#[derive(Default)]
pub(super) struct Colors {
    estimates: Option<(ColorSpace, Estimates)>,
    reference: Option<(ColorSpace, ResolvedTransfer, Arc<ReferenceErrors>)>,
}

impl Session {
    /// The draw list of a step. Damaged records of a level make the next coarser one stand in.
    ///
    /// * `cut`: where to stop, if not at the view's level
    pub(crate) fn select(
        &mut self,
        view: &View,
        step: u32,
        weight: f64,
        faults: &mut Faults,
        cut: Option<&ActiveCut>,
    ) -> anyhow::Result<Vec<DrawItem>> {
        let num_levels = self.store.tree().num_levels() as u8;
        let mut level = view.level.min(num_levels - 1);
        let prepared = match view.coherence.filter(|_| weight == 0.0) {
            Some(coherence) => Some(self.prepare_coherence(view, &coherence, step, faults)?),
            None => None,
        };
        loop {
            match self.draw_list(view, step, weight, (level, cut), prepared.as_ref()) {
                Ok(items) => return Ok(items),
                Err(error) if level + 1 < num_levels => {
                    faults.warn(format!("{error}; drawing level {} instead of {level}", level + 1));
                    level += 1;
                }
                Err(error) => return Err(error).context("no level of the store can be drawn"),
            }
        }
    }

    fn draw_list(
        &mut self,
        view: &View,
        step: u32,
        weight: f64,
        (level, cut): (u8, Option<&ActiveCut>),
        prepared: Option<&Prepared>,
    ) -> Result<Vec<DrawItem>, StoreError> {
        let header = self.store.header();
        let (grid, layout, num_steps) = (header.grid, header.bricks, header.num_steps());
        let volume = self.view_volume(view);
        let tree = Arc::clone(&self.tree);
        let range = self.variable_range();
        let selector = Selector {
            tree: &tree,
            layout: &layout,
            grid: &grid,
            num_steps,
            step,
            level,
            cut,
            view: &volume,
            skips_transparent: prepared.is_none_or(|p| p.choice.skips_transparent),
        };
        let appearance = |range: [f64; 2]| appearance(view, range);
        let mut estimates = self.colors.estimates.take();
        let mut errors = prepared
            .zip(estimates.as_mut())
            .map(|(prepared, (_, estimates))| prepared.errors(estimates, range[1] - range[0]));
        let coherence = prepared.zip(errors.as_mut()).map(|(prepared, errors)| Coherence {
            tolerances: prepared.choice.tolerances,
            statistics: &prepared.statistics,
            errors: errors.as_mut(),
        });
        let mut record = |node, step| match weight > 0.0 {
            false => self.record(&tree, node, step),
            true => Ok(record_between(self.records_around(&tree, node, step)?, weight)),
        };
        let items = selector.draw_list(coherence, &mut record, &appearance);
        drop(errors);
        self.colors.estimates = estimates;
        items
    }

    /// What a view sees.
    pub(crate) fn view_volume(&self, view: &View) -> ViewVolume {
        let aspect = view.size[0] as f64 / view.size[1] as f64;
        ViewVolume::of_camera(&view.camera, aspect, &self.store.header().grid)
    }

    /// Reads the statistics of a step, and makes ready what the metric needs.
    fn prepare_coherence(
        &mut self,
        view: &View,
        choice: &CoherenceView,
        step: u32,
        faults: &mut Faults,
    ) -> anyhow::Result<Prepared> {
        anyhow::ensure!(
            self.store.has_time_tree(),
            "{}: the store has no statistics of its time tree, which metrics and tolerances need: encode it again",
            self.store.path().display()
        );
        let num_levels = num_time_levels(self.store.header().num_steps());
        let holding = (0..num_levels).map(|level| TimeNode::holding(step, level));
        let known: Vec<TimeNode> = holding.take_while(|at| self.store.has_statistics(*at)).collect();
        if known.is_empty() {
            faults.warn(format!(
                "the statistics of step {step} are not finished: it is drawn without tolerances"
            ));
        }
        let rows = known.into_iter().map(|at| self.statistics(at));
        let statistics = StepStatistics { of_time_levels: rows.collect::<Result<_, _>>()? };
        let (Metric::ColorReference(space) | Metric::ColorApproximate(space)) = choice.metric else {
            self.update_estimates(view, ColorSpace::Rgb);
            return Ok(Prepared { choice: *choice, statistics, reference: None });
        };
        self.update_estimates(view, space);
        let reference = match choice.metric {
            Metric::ColorReference(_) => Some(self.reference_errors(view, space)?),
            _ => None,
        };
        Ok(Prepared { choice: *choice, statistics, reference })
    }

    /// Forgets estimates that were made under another transfer function.
    fn update_estimates(&mut self, view: &View, space: ColorSpace) {
        let is_current = |(of, estimates): &(ColorSpace, Estimates)| {
            *of == space && *estimates.transfer() == view.transfer
        };
        if !self.colors.estimates.as_ref().is_some_and(is_current) {
            let table = ColorTable::new(&view.transfer, self.variable_range(), NUM_ENTRIES, space);
            self.colors.estimates = Some((space, Estimates::new(view.transfer.clone(), table)));
        }
    }

    /// The reference errors under the view's transfer function; computing them reads every step.
    pub(crate) fn reference_errors(
        &mut self,
        view: &View,
        space: ColorSpace,
    ) -> anyhow::Result<Arc<ReferenceErrors>> {
        if let Some((of, transfer, errors)) = &self.colors.reference
            && *of == space
            && *transfer == view.transfer
        {
            return Ok(Arc::clone(errors));
        }
        let errors = Arc::new(reference::compute(&self.store, self.variable, &view.transfer, space)?);
        self.colors.reference = Some((space, view.transfer.clone(), Arc::clone(&errors)));
        Ok(errors)
    }

    /// Statistics of all nodes over a time node.
    fn statistics(&mut self, at: TimeNode) -> Result<Arc<Vec<NodeStatistics>>, StoreError> {
        if let Some(statistics) = self.statistics.get(&at) {
            return Ok(statistics);
        }
        let statistics = Arc::new(self.store.statistics(self.variable, at)?);
        let num_bytes = size_of_val(statistics.as_slice());
        self.statistics.insert(at, Arc::clone(&statistics), num_bytes);
        Ok(statistics)
    }

    /// The record of a node at a step.
    pub(crate) fn record(
        &mut self,
        tree: &Octree,
        node: NodeId,
        step: u32,
    ) -> Result<SpanRecord, StoreError> {
        let rank = tree.rank(node).expect("only nodes of the tree are asked for");
        let key = (node.level, step);
        let spans = match self.spans.get(&key) {
            Some(spans) => spans,
            None => {
                let spans = Arc::new(self.store.spans(self.variable, node.level, step)?);
                let num_bytes = spans.len() * size_of::<SpanRecord>();
                self.spans.insert(key, Arc::clone(&spans), num_bytes);
                spans
            }
        };
        Ok(spans[rank])
    }

    /// The records of a node at a step and the next.
    pub(super) fn records_around(
        &mut self,
        tree: &Octree,
        node: NodeId,
        step: u32,
    ) -> Result<[SpanRecord; 2], StoreError> {
        Ok([self.record(tree, node, step)?, self.record(tree, node, step + 1)?])
    }
}

/// What the choice of a step's nodes needs of its coherence.
struct Prepared {
    choice: CoherenceView,
    statistics: StepStatistics,
    reference: Option<Arc<ReferenceErrors>>,
}

impl Prepared {
    fn errors<'a>(&'a self, estimates: &'a mut Estimates, value_range: f64) -> Box<dyn NodeErrors + 'a> {
        let statistics = &self.statistics;
        match (&self.reference, self.choice.metric) {
            (Some(reference), _) => Box::new(reference.as_ref()),
            (None, Metric::Scalar) => Box::new(ScalarErrors { statistics, estimates, value_range }),
            (None, _) => Box::new(ApproximateErrors { statistics, estimates }),
        }
    }
}

/// What a range of values looks like in a view.
fn appearance(view: &View, range: [f64; 2]) -> Appearance {
    if view.transfer.is_transparent_over(range) {
        return Appearance::Transparent;
    }
    // Light shows differences of values that have the same colour.
    match view.lighting.is_none() && view.transfer.is_constant_over(range) {
        true => Appearance::Uniform(view.transfer.evaluate(range[0]).map(|v| v as f32)),
        false => Appearance::Varied,
    }
}
