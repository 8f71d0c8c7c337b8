//! Statistics of the time tree on disk: six numbers for each node of the octree over each node of the time tree,
//! `[index, node, field]`, one array for each level of the time tree.

use std::ops::Range;

use chronoxel_core::{
    NodeFacts, NodeStatistics,
    time_tree::{num_time_levels, num_time_nodes},
};

use crate::Header;

/// Names of the fields, in order.
pub(crate) const FIELDS: [&str; NUM_FIELDS] = ["min", "max", "mean", "std", "temporal_error", "facts"];
/// Number of fields of a node's statistics.
pub(crate) const NUM_FIELDS: usize = 6;
/// The fields of one node over one time node.
pub(crate) type Fields = [f64; NUM_FIELDS];

/// Most rows of a chunk,
const MAX_ROWS: u32 = 64;
/// and most nodes in its rows together, where it has several.
const MAX_PLACES: usize = 4096;

/// A chunk of the statistics of one level of the time tree of one variable.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct StatisticsChunkId {
    pub variable: u16,
    pub time_level: u8,
    pub chunk: u32,
}

impl Header {
    /// Number of nodes of the octree, those of all levels.
    pub fn num_tree_nodes(&self) -> usize {
        self.levels.iter().map(|level| level.num_nodes).sum()
    }

    /// Levels of the time tree; none where there are no statistics.
    pub(crate) fn time_levels(&self) -> Range<u8> {
        0..self.time_tree.map_or(0, |_| num_time_levels(self.num_steps()))
    }

    pub(crate) fn num_statistics_rows(&self, time_level: u8) -> u32 {
        num_time_nodes(self.num_steps(), time_level)
    }

    /// Rows of a chunk: a power of two, no more than the level needs.
    pub(crate) fn statistics_rows_per_chunk(&self, time_level: u8) -> u32 {
        let most = self.num_statistics_rows(time_level).next_power_of_two().min(MAX_ROWS);
        let fit = (MAX_PLACES / self.num_tree_nodes().max(1)).max(1).ilog2();
        most.min(1 << fit)
    }

    pub(crate) fn num_statistics_chunks(&self, time_level: u8) -> u32 {
        self.num_statistics_rows(time_level).div_ceil(self.statistics_rows_per_chunk(time_level))
    }

    /// Rows of a level whose steps are over once `num_steps` steps were read.
    pub(crate) fn num_statistics_rows_over(&self, time_level: u8, num_steps: u32) -> u32 {
        match num_steps >= self.num_steps() {
            true => self.num_statistics_rows(time_level),
            false => num_steps >> time_level,
        }
    }

    /// Chunks of a level all of whose rows are over.
    pub(crate) fn num_statistics_chunks_over(&self, time_level: u8, num_steps: u32) -> u32 {
        match num_steps >= self.num_steps() {
            true => self.num_statistics_chunks(time_level),
            false => (num_steps >> time_level) / self.statistics_rows_per_chunk(time_level),
        }
    }

    /// Nodes in all rows of a chunk.
    pub(crate) fn num_statistics_places(&self, time_level: u8) -> usize {
        self.statistics_rows_per_chunk(time_level) as usize * self.num_tree_nodes()
    }

    /// The folder of the statistics of one level of the time tree.
    pub(crate) fn statistics_folder(&self, variable: u16, time_level: u8) -> String {
        format!("{}/time/T{time_level}", self.variables[usize::from(variable)].folder)
    }

    /// The file of a chunk, relative to the store.
    pub(crate) fn statistics_file(&self, id: &StatisticsChunkId) -> String {
        format!("{}/c.{}.0.0", self.statistics_folder(id.variable, id.time_level), id.chunk)
    }

    /// All (variable, time level) of the store.
    pub(crate) fn each_time_level(&self) -> impl Iterator<Item = (u16, u8)> + '_ {
        let variables = 0..self.variables.len() as u16;
        variables.flat_map(|variable| self.time_levels().map(move |time_level| (variable, time_level)))
    }
}

/// The largest single-precision number that is not above a value; the value where it is beyond them all.
pub(crate) fn rounded_down(value: f64) -> f64 {
    let nearest = value as f32;
    let rounded = if f64::from(nearest) > value { nearest.next_down() } else { nearest };
    if nearest.is_finite() && rounded.is_finite() { rounded.into() } else { value }
}

/// The smallest single-precision number that is not below a value; the value where it is beyond them all.
pub(crate) fn rounded_up(value: f64) -> f64 {
    -rounded_down(-value)
}

/// The nearest single-precision number, but 0 for 0 alone; the value where it is beyond them all.
fn rounded(value: f64) -> f64 {
    let nearest = value as f32;
    match nearest {
        0.0 if value != 0.0 => f64::from(f32::from_bits(1)).copysign(value),
        _ if nearest.is_finite() => nearest.into(),
        _ => value,
    }
}

/// The fields of a node's statistics as they are stored; what is wrong with them if they are not sound.
pub(crate) fn fields_of(statistics: &NodeStatistics) -> Result<Fields, String> {
    let NodeStatistics { min, max, mean, std, temporal_error, facts } = *statistics;
    let NodeFacts { is_uniform, is_static, is_masked, mask_changes } = facts;
    let bits = [is_uniform, is_static, is_masked, mask_changes].into_iter().enumerate();
    let facts: u8 = bits.map(|(bit, holds)| u8::from(holds) << bit).sum();
    let numbers = [rounded_down(min), rounded_up(max), rounded(mean), rounded(std), rounded(temporal_error)];
    // One NaN of the many, so that equal statistics have equal bytes.
    let [min, max, mean, std, temporal_error] = numbers.map(|v| if v.is_nan() { f64::NAN } else { v });
    let fields = [min, max, mean, std, temporal_error, facts.into()];
    statistics_of(&fields).map(|_| fields)
}

/// The statistics in a node's fields, else what is wrong.
pub(crate) fn statistics_of(fields: &Fields) -> Result<NodeStatistics, String> {
    let [min, max, mean, std, temporal_error, facts] = *fields;
    if !(0.0..16.0).contains(&facts) || facts.fract() != 0.0 {
        return Err(format!("facts are {facts}, not 0 to 15"));
    }
    let numbers = &fields[..NUM_FIELDS - 1];
    let is_empty = numbers.iter().all(|v| v.is_nan());
    let is_finite = numbers.iter().all(|v| v.is_finite());
    let is_sound = is_finite && min <= mean && mean <= max && std >= 0.0 && temporal_error >= 0.0;
    if !is_empty && !is_sound {
        return Err(format!("statistics are {numbers:?}"));
    }
    let bit = |bit: u8| facts as u8 >> bit & 1 == 1;
    let facts = NodeFacts { is_uniform: bit(0), is_static: bit(1), is_masked: bit(2), mask_changes: bit(3) };
    Ok(NodeStatistics { min, max, mean, std, temporal_error, facts })
}
