//! Errors of nodes by the three metrics of ellsworth2000, section 5, and what they are computed from.

use std::{collections::HashMap, sync::Arc};

use chronoxel_core::{
    NodeStatistics, ResolvedTransfer, TimeNode,
    metrics::{ColorEstimate, ColorTable, approximate_spatial, approximate_temporal},
};

/// An octree node over a time node.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Place {
    /// The octree node, counted through all levels, finest first, by rank within a level.
    pub node: usize,
    /// The steps.
    pub time: TimeNode,
}

/// How coherent a node is in space and in time, by some metric.
pub trait NodeErrors {
    /// Temporal error: 0 exactly where nothing changes that the metric sees.
    fn temporal(&mut self, at: Place) -> f64;
    /// Spatial error: 0 exactly where all is alike that the metric sees.
    fn spatial(&mut self, at: Place) -> f64;
    /// The colour (sRGB) and opacity per unit length to draw in place of the node's samples.
    fn mean_color(&mut self, at: Place) -> [f32; 4];
}

/// Statistics of all octree nodes over the time nodes that hold one step: of that step alone first, of the whole series last, as far as
/// the series is stored.
#[derive(Debug, Clone)]
pub struct StepStatistics {
    /// `[time level][octree node]`.
    pub of_time_levels: Vec<Arc<Vec<NodeStatistics>>>,
}

impl StepStatistics {
    /// Of one place; its time node must hold the step.
    pub fn at(&self, place: Place) -> &NodeStatistics {
        &self.of_time_levels[usize::from(place.time.level)][place.node]
    }
}

/// Colours of nodes as estimated so far under one transfer function.
///
/// Nothing is computed before it is asked for, so that the estimates of the step drawn come first, and a new transfer function costs
/// nothing but the nodes that are visited.
#[derive(Debug, Clone)]
pub struct Estimates {
    transfer: ResolvedTransfer,
    table: ColorTable,
    known: HashMap<Place, ColorEstimate>,
}

/// Estimates that are kept: some 40 MiB of them.
const MOST_ESTIMATES: usize = 1 << 19;

impl Estimates {
    /// None yet.
    ///
    /// * `table`: of `transfer`
    pub fn new(transfer: ResolvedTransfer, table: ColorTable) -> Self {
        Self { transfer, table, known: HashMap::new() }
    }

    /// The transfer function they are made under.
    pub fn transfer(&self) -> &ResolvedTransfer {
        &self.transfer
    }

    fn spatial(&mut self, at: Place, statistics: &NodeStatistics) -> ColorEstimate {
        if let Some(known) = self.known.get(&at) {
            return *known;
        }
        if self.known.len() >= MOST_ESTIMATES {
            self.known.clear();
        }
        let estimate = approximate_spatial(&self.table, &self.transfer, statistics);
        self.known.insert(at, estimate);
        estimate
    }
}

/// The scalar metric (eq. 1–6): of values, whatever their colours.
pub struct ScalarErrors<'a> {
    /// Of the step.
    pub statistics: &'a StepStatistics,
    /// For mean colours.
    pub estimates: &'a mut Estimates,
    /// Largest minus smallest value of the variable.
    pub value_range: f64,
}

impl NodeErrors for ScalarErrors<'_> {
    fn temporal(&mut self, at: Place) -> f64 {
        self.statistics.at(at).temporal_error
    }

    fn spatial(&mut self, at: Place) -> f64 {
        self.statistics.at(at).spatial_error(self.value_range)
    }

    fn mean_color(&mut self, at: Place) -> [f32; 4] {
        self.estimates.spatial(at, self.statistics.at(at)).mean
    }
}

/// The approximate colour metric (eq. 14–20): of colours, estimated from the statistics of the values.
pub struct ApproximateErrors<'a> {
    /// Of the step.
    pub statistics: &'a StepStatistics,
    /// Made so far.
    pub estimates: &'a mut Estimates,
}

impl NodeErrors for ApproximateErrors<'_> {
    fn temporal(&mut self, at: Place) -> f64 {
        approximate_temporal(&self.estimates.table, self.statistics.at(at))
    }

    fn spatial(&mut self, at: Place) -> f64 {
        self.estimates.spatial(at, self.statistics.at(at)).error
    }

    fn mean_color(&mut self, at: Place) -> [f32; 4] {
        self.estimates.spatial(at, self.statistics.at(at)).mean
    }
}

/// What the reference metric says of one place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReferenceError {
    /// e_rcs and the mean colour.
    pub spatial: ColorEstimate,
    /// e_rct.
    pub temporal: f64,
}

/// The reference colour metric (eq. 7–13) of a whole series, computed voxel by voxel: `[time node][octree node]`.
#[derive(Debug, Clone, Default)]
pub struct ReferenceErrors {
    /// Of every octree node, for each time node.
    pub of_time_nodes: HashMap<TimeNode, Vec<ReferenceError>>,
}

impl ReferenceErrors {
    fn at(&self, at: Place) -> &ReferenceError {
        &self.of_time_nodes[&at.time][at.node]
    }
}

impl NodeErrors for &ReferenceErrors {
    fn temporal(&mut self, at: Place) -> f64 {
        ReferenceErrors::at(self, at).temporal
    }

    fn spatial(&mut self, at: Place) -> f64 {
        ReferenceErrors::at(self, at).spatial.error
    }

    fn mean_color(&mut self, at: Place) -> [f32; 4] {
        ReferenceErrors::at(self, at).spatial.mean
    }
}
