//! Verification of the statistics of the time tree: each in itself, against those it is merged from, and against the spans.

use std::ops::Range;

use chronoxel_core::{NodeId, NodeStatistics, SpanRecord, TimeNode};

use crate::{
    Store, StoreError,
    statistics::{Fields, StatisticsChunkId, rounded_down, rounded_up},
    verify::VerifyReport,
};

/// What rounding to single precision, and sums in another order, may make of a number, as a share of it.
const ROUNDING: f64 = 1e-6;
/// The smallest positive number that is stored.
const LEAST: f64 = f32::from_bits(1) as f64;

/// The children of every node of the octree, by their places in a row of statistics.
pub(crate) struct Families(Vec<Family>);

struct Family {
    children: Range<usize>,
    /// Whether every child is there that has a brick in the grid.
    is_complete: bool,
}

impl Families {
    pub fn of(store: &Store) -> Self {
        let geometry = store.header().geometry();
        let (mut families, mut first) = (Vec::new(), 0);
        for level in 0..geometry.len() as u8 {
            let finer = level.checked_sub(1).map(|level| (store.tree().nodes(level), usize::from(level)));
            for &morton in store.tree().nodes(level) {
                let Some((finer, below)) = finer else {
                    families.push(Family { children: 0..0, is_complete: false });
                    continue;
                };
                let [from, to] = [morton, morton + 1].map(|m| finer.partition_point(|child| child >> 3 < m));
                let in_grid = |octant: &u8| {
                    let child = NodeId { level, morton }.child(*octant).map(NodeId::brick);
                    child.is_some_and(|brick| (0..3).all(|a| (brick[a] as usize) < geometry[below].bricks[a]))
                };
                let is_complete = (0..8).filter(in_grid).count() == to - from;
                families.push(Family { children: first + from..first + to, is_complete });
            }
            first += finer.map_or(0, |(nodes, _)| nodes.len());
        }
        Self(families)
    }
}

/// The statistics of one level of the time tree of one variable.
pub(crate) struct StatisticsCheck<'a> {
    pub store: &'a Store,
    pub families: &'a Families,
    pub variable: u16,
    pub time_level: u8,
}

impl StatisticsCheck<'_> {
    /// Checks one chunk of the finished steps.
    pub fn run(&self, chunk: u32, report: &mut VerifyReport) {
        let header = self.store.header();
        let id = StatisticsChunkId { variable: self.variable, time_level: self.time_level, chunk };
        let fields = match self.store.statistics_chunk(&id) {
            Ok(fields) => fields,
            Err(error) => return report.add(error),
        };
        let rows = header.statistics_rows_per_chunk(self.time_level);
        let first = chunk * rows;
        let num_rows = rows.min(header.num_statistics_rows(self.time_level) - first);
        if !self.is_blank(&fields, num_rows) {
            let path = self.store.root.join(header.statistics_file(&id));
            report.add(StoreError::corrupt(&path, "statistics", "unexpected", "they lie after the series"));
        }
        for index in first..first + num_rows {
            let at = TimeNode { level: self.time_level, index };
            if let Err(error) = self.check_row(&id, at, report) {
                report.add(error);
            }
        }
    }

    /// Whether nothing follows the rows of a chunk that belong to the series.
    fn is_blank(&self, fields: &[Fields], num_rows: u32) -> bool {
        let num_places = num_rows as usize * self.store.header().num_tree_nodes();
        fields[num_places..].iter().flatten().all(|v| v.is_nan())
    }

    fn check_row(
        &self,
        id: &StatisticsChunkId,
        at: TimeNode,
        report: &mut VerifyReport,
    ) -> Result<(), StoreError> {
        let row_of = |at| self.store.statistics(self.variable.into(), at);
        let row = row_of(at)?;
        report.num_statistics += row.len() as u64;
        let num_steps = self.store.header().num_steps();
        let mut halves = Vec::new();
        if at.level > 0 {
            let is_there = |half: &TimeNode| !half.steps(num_steps).is_empty();
            // A half that cannot be read is reported where its own chunk is checked.
            halves = at.halves().into_iter().filter(is_there).flat_map(row_of).collect();
            if halves.len() < at.halves().iter().filter(|half| is_there(half)).count() {
                halves.clear();
            }
        }
        for (index, node) in row.iter().enumerate() {
            let of_halves: Vec<NodeStatistics> = halves.iter().map(|half| half[index]).collect();
            let Family { children, is_complete } = &self.families.0[index];
            let problem = own_problem(node, at.level == 0)
                .or_else(|| halves_problem(node, &of_halves))
                .or_else(|| children_problem(node, &row[children.clone()], *is_complete));
            if let Some(problem) = problem {
                report.add(self.store.statistics_error(id, at, index, problem));
            }
        }
        Ok(())
    }
}

/// What is wrong with the statistics of a node in themselves.
fn own_problem(node: &NodeStatistics, is_single_step: bool) -> Option<String> {
    let NodeStatistics { min, max, std, temporal_error, facts, .. } = *node;
    let is_one_value = min == max || f64::from((min as f32).next_up()) == max;
    let problems = [
        (std > (0.5 * max - 0.5 * min) * (1.0 + ROUNDING) + LEAST, "std is more than half the range"),
        (node.is_empty() && !facts.is_masked, "nothing is masked, but no sample has data"),
        (facts.is_uniform && (facts.is_masked || !facts.is_static), "facts contradict each other"),
        (facts.is_uniform && !(is_one_value && std == 0.0), "they are uniform, but samples differ"),
        (facts.mask_changes && (facts.is_static || !facts.is_masked), "facts contradict each other"),
        (is_single_step && !facts.is_static, "a single step changes"),
        (
            !node.is_empty() && facts.is_static != (temporal_error == 0.0),
            "temporal_error is not that of facts",
        ),
    ];
    let problem = problems.into_iter().find(|(is_so, _)| *is_so)?;
    Some(format!("{}: {node:?}", problem.1))
}

/// What is wrong with the statistics of a node given those of the halves of its steps.
fn halves_problem(node: &NodeStatistics, halves: &[NodeStatistics]) -> Option<String> {
    let [first, ..] = halves else { return None };
    let alike = halves.iter().all(|half| half.facts.is_masked == first.facts.is_masked);
    let facts = node.facts;
    let contradicts = !alike && !facts.mask_changes
        || facts.is_masked != halves.iter().any(|half| half.facts.is_masked)
        || (halves.len() == 1 && facts != first.facts);
    if contradicts {
        return Some(format!("facts {facts:?} are not those of the halves of the steps"));
    }
    parts_problem(node, halves, true).map(|problem| format!("{problem} of the halves of the steps"))
}

/// What is wrong with the statistics of a node given those of its children.
fn children_problem(node: &NodeStatistics, children: &[NodeStatistics], is_complete: bool) -> Option<String> {
    if children.is_empty() {
        return None;
    }
    let facts = node.facts;
    let of_all = [
        (facts.is_static, children.iter().all(|child| child.facts.is_static)),
        (facts.is_masked, children.iter().any(|child| child.facts.is_masked)),
        (facts.mask_changes, children.iter().any(|child| child.facts.mask_changes)),
    ];
    if is_complete && of_all.iter().any(|(found, due)| found != due) {
        return Some(format!("facts {facts:?} are not those of the node's children"));
    }
    parts_problem(node, children, is_complete).map(|problem| format!("{problem} of the node's children"))
}

/// What is wrong with the statistics of a node given those of some of its parts, or of all.
fn parts_problem(node: &NodeStatistics, parts: &[NodeStatistics], are_all: bool) -> Option<String> {
    let fold = |value: fn(&NodeStatistics) -> f64, pick: fn(f64, f64) -> f64| {
        parts.iter().map(value).fold(f64::NAN, pick)
    };
    let range = [fold(|part| part.min, f64::min), fold(|part| part.max, f64::max)];
    let is_range = |found: f64, due: f64| found == due || found.is_nan() && due.is_nan();
    let holds = match are_all {
        true => is_range(node.min, range[0]) && is_range(node.max, range[1]),
        false => range[0].is_nan() || node.min <= range[0] && node.max >= range[1],
    };
    if !holds {
        return Some(format!("min {} and max {} are not {range:?}", node.min, node.max));
    }
    let facts = |holds: fn(&NodeStatistics) -> bool| (holds(node), parts.iter().all(holds));
    let implied = [facts(|node| node.facts.is_uniform), facts(|node| node.facts.is_static)];
    let any = |holds: fn(&NodeStatistics) -> bool| (holds(node), parts.iter().any(holds));
    let implies = [any(|node| node.facts.is_masked), any(|node| node.facts.mask_changes)];
    if implied.iter().any(|(whole, all)| *whole && !all) || implies.iter().any(|(whole, any)| *any && !whole)
    {
        return Some(format!("facts {:?} do not follow from those", node.facts));
    }
    let slack = ROUNDING * node.min.abs().max(node.max.abs()) + LEAST;
    let means = [fold(|part| part.mean, f64::min) - slack, fold(|part| part.mean, f64::max) + slack];
    if are_all && (node.mean < means[0] || node.mean > means[1]) {
        return Some(format!("mean {} is not within {means:?}", node.mean));
    }
    let std = fold(|part| part.std, f64::min);
    if are_all && node.std < std - slack {
        return Some(format!("std {} is less than {std}", node.std));
    }
    None
}

/// The ranges of single steps, gathered over the span of each node that holds the last of them.
pub(crate) struct GatheredRanges(Vec<Option<[f64; 2]>>);

impl GatheredRanges {
    pub fn new(num_nodes: usize) -> Self {
        Self(vec![None; num_nodes])
    }

    /// Adds a step: its spans and its statistics, if they can be read. Where a span ends, both must say the same.
    pub fn add(
        &mut self,
        step: u32,
        spans: &[SpanRecord],
        row: Option<&[NodeStatistics]>,
    ) -> Vec<(usize, String)> {
        let mut problems = Vec::new();
        for (node, (gathered, span)) in self.0.iter_mut().zip(spans).enumerate() {
            if span.start == step {
                *gathered = Some([f64::NAN; 2]);
            }
            *gathered =
                gathered.zip(row).map(|([min, max], row)| [min.min(row[node].min), max.max(row[node].max)]);
            if span.start + span.len != step + 1 {
                continue;
            }
            // NaN where no sample is counted.
            let due = [rounded_down(span.statistics.min), rounded_up(span.statistics.max)];
            if let Some(found) = gathered.take()
                && found
                    .iter()
                    .zip(due)
                    .any(|(&found, due)| found != due && !(found.is_nan() && due.is_nan()))
            {
                let problem = format!(
                    "the range of its steps is {found:?}, that of the span from step {} is {due:?}",
                    span.start
                );
                problems.push((node, problem));
            }
        }
        problems
    }
}
