//! Writing the statistics of the time tree: rows are held until all of their chunk are there.

use std::{collections::BTreeMap, path::PathBuf};

use chronoxel_core::{NodeStatistics, TimeNode};

use crate::{
    Header, StoreError,
    arrays::STATISTICS_ZSTD_LEVEL,
    chunk, files,
    journal::{Numbers, StateSummary, StatisticsSummary},
    layout,
    statistics::{Fields, NUM_FIELDS, StatisticsChunkId, fields_of},
    writer::StoreWriter,
};

/// The rows of one level of the time tree of one variable that are not in a file yet.
#[derive(Debug, Clone, Default)]
pub(crate) struct OpenStatistics {
    /// Chunks below this one are complete.
    pub num_chunks_closed: u32,
    /// All nodes, by index of the time node.
    pub rows: BTreeMap<u32, Vec<Fields>>,
}

/// A chunk on its way to its file.
pub(crate) struct ClosingStatistics {
    id: StatisticsChunkId,
    rows: Vec<Vec<Fields>>,
    pub temporary: PathBuf,
    pub path: PathBuf,
}

impl StoreWriter {
    /// Puts what is known of all nodes of the octree over the steps of a time node: levels finest first, by rank
    /// within a level. Time nodes come in any order, each before the commit of the step that closes it. Numbers are rounded to single
    /// precision, ranges outward.
    ///
    /// One may be put again, as a resume does that reads steps anew: what is in a file already stays as it is.
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if the store has no time tree or the time node or the statistics are not sound.
    pub fn put_statistics(
        &mut self,
        variable: usize,
        at: TimeNode,
        of_nodes: &[NodeStatistics],
    ) -> Result<(), StoreError> {
        self.begin()?;
        self.header.check_time_node(variable, at)?;
        let num_nodes = self.header.num_tree_nodes();
        if of_nodes.len() != num_nodes {
            let remedy = format!("the octree has {num_nodes}");
            return Err(StoreError::invalid("number of nodes with statistics", of_nodes.len(), remedy));
        }
        let fields: Result<Vec<Fields>, (usize, String)> = of_nodes
            .iter()
            .enumerate()
            .map(|(node, statistics)| fields_of(statistics).map_err(|problem| (node, problem)))
            .collect();
        let fields = fields.map_err(|(node, problem)| {
            let name = &self.header.variables[variable].name;
            let value = format!("those of {name}, node {node}, {at:?}: {problem}");
            StoreError::invalid("statistics", value, "see the format")
        })?;
        let rows = self.header.statistics_rows_per_chunk(at.level);
        let open = &mut self.statistics[variable][usize::from(at.level)];
        if at.index / rows >= open.num_chunks_closed {
            open.rows.insert(at.index, fields);
        }
        self.failed = false;
        Ok(())
    }

    /// Checks that the statistics are there of every time node that is over.
    pub(crate) fn check_statistics(&self, num_put: u32) -> Result<(), StoreError> {
        for (variable, time_level) in self.header.each_time_level() {
            let open = &self.statistics[usize::from(variable)][usize::from(time_level)];
            let first = open.num_chunks_closed * self.header.statistics_rows_per_chunk(time_level);
            let mut due = first..self.header.num_statistics_rows_over(time_level, num_put);
            if let Some(index) = due.find(|index| !open.rows.contains_key(index)) {
                let name = &self.header.variables[usize::from(variable)].name;
                let steps = TimeNode { level: time_level, index }.steps(self.header.num_steps());
                let remedy = format!("the statistics of {name} over the steps {steps:?} are missing");
                return Err(StoreError::invalid("number of steps to commit", num_put, remedy));
            }
        }
        Ok(())
    }

    /// Takes the chunks out all of whose rows are over.
    pub(crate) fn take_statistics(&mut self, num_put: u32) -> Vec<ClosingStatistics> {
        let mut closing = Vec::new();
        for (variable, time_level) in self.header.each_time_level() {
            let open = &mut self.statistics[usize::from(variable)][usize::from(time_level)];
            let rows = self.header.statistics_rows_per_chunk(time_level);
            let num_over = self.header.num_statistics_chunks_over(time_level, num_put);
            let first = std::mem::replace(&mut open.num_chunks_closed, num_over);
            for chunk in first..num_over {
                let id = StatisticsChunkId { variable, time_level, chunk };
                let after = open.rows.split_off(&((chunk + 1) * rows));
                let taken = std::mem::replace(&mut open.rows, after);
                let relative = self.header.statistics_file(&id);
                let (rows, path) = (taken.into_values().collect(), self.root.join(&relative));
                let temporary = self.root.join(crate::journal::FOLDER).join(relative.replace('/', "!"));
                closing.push(ClosingStatistics { id, rows, temporary, path });
            }
        }
        closing
    }

    /// What the state says of open rows; their numbers follow in the same order.
    pub(crate) fn statistics_summary(&self, numbers: &mut Vec<u8>) -> Vec<StatisticsSummary> {
        let levels = self.statistics.iter().flatten();
        let summary = levels.map(|open| {
            for value in open.rows.values().flatten().flatten() {
                numbers.extend_from_slice(&value.to_le_bytes());
            }
            let rows = open.rows.keys().copied().collect();
            StatisticsSummary { num_chunks_closed: open.num_chunks_closed, rows }
        });
        summary.collect()
    }

    pub(crate) fn restore_statistics(
        &mut self,
        summary: &StateSummary,
        numbers: &mut Numbers,
    ) -> Result<(), StoreError> {
        let num_nodes = self.header.num_tree_nodes();
        let wrong = |field: &str, value: usize| {
            let problem = "it is not that of the header: encode the store anew";
            StoreError::corrupt(numbers.path, field, value, problem)
        };
        if summary.statistics.len() != self.statistics.iter().flatten().count() {
            return Err(wrong("number of time levels", summary.statistics.len()));
        }
        let keys: Vec<(u16, u8)> = self.header.each_time_level().collect();
        for ((variable, time_level), stored) in keys.into_iter().zip(&summary.statistics) {
            if stored.num_chunks_closed > self.header.num_statistics_chunks(time_level) {
                return Err(wrong("number of chunks of statistics", stored.num_chunks_closed as usize));
            }
            let mut rows = BTreeMap::new();
            for &index in &stored.rows {
                if index >= self.header.num_statistics_rows(time_level) {
                    return Err(wrong("row of statistics", index as usize));
                }
                let values = numbers.take::<{ 8 * NUM_FIELDS }>(num_nodes)?.iter().map(|bytes| {
                    let (values, _) = bytes.as_chunks();
                    std::array::from_fn(|field| f64::from_le_bytes(values[field]))
                });
                rows.insert(index, values.collect());
            }
            let num_chunks_closed = stored.num_chunks_closed;
            self.statistics[usize::from(variable)][usize::from(time_level)] =
                OpenStatistics { num_chunks_closed, rows };
        }
        Ok(())
    }

    /// Removes the chunks that the state does not know.
    pub(crate) fn remove_leftover_statistics(&self) -> Result<(), StoreError> {
        for (variable, time_level) in self.header.each_time_level() {
            let num_closed =
                self.statistics[usize::from(variable)][usize::from(time_level)].num_chunks_closed;
            let folder = self.root.join(self.header.statistics_folder(variable, time_level));
            for name in files::names_in(&folder)? {
                if layout::shard_of(&name).is_some_and(|chunk| chunk >= num_closed) {
                    files::remove_file(&folder.join(&name))?;
                }
            }
        }
        Ok(())
    }
}

impl ClosingStatistics {
    /// Completes the file under its temporary name; gives its length.
    pub fn close(&self, header: &Header) -> Result<u64, StoreError> {
        let mut places: Vec<Fields> = self.rows.iter().flatten().copied().collect();
        places.resize(header.num_statistics_places(self.id.time_level), [f64::NAN; NUM_FIELDS]);
        let stored = chunk::encode_by_field(&places, STATISTICS_ZSTD_LEVEL);
        let stored = stored.map_err(StoreError::io(&self.path, "compress"))?;
        files::write(&self.temporary, &stored)?;
        Ok(stored.len() as u64)
    }
}
