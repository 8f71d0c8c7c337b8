//! Reading the statistics of the time tree: a row of all nodes at a time.

use std::sync::Arc;

use chronoxel_core::{NodeId, NodeStatistics, TimeNode};

use crate::{
    Header, Store, StoreError, TimeTreeEntry, chunk, files,
    statistics::{Fields, NUM_FIELDS, StatisticsChunkId, statistics_of},
};

impl Header {
    /// Checks that a time node is one of the store's.
    pub(crate) fn check_time_node(&self, variable: usize, at: TimeNode) -> Result<(), StoreError> {
        if variable >= self.variables.len() {
            let remedy = format!("the store has {}", self.variables.len());
            return Err(StoreError::invalid("variable", variable, remedy));
        }
        let wrong = |remedy: &str| Err(StoreError::invalid("time node", format!("{at:?}"), remedy));
        if self.time_tree.is_none() {
            return wrong("the store has no statistics: encode it anew");
        }
        match self.time_levels().contains(&at.level) && at.index < self.num_statistics_rows(at.level) {
            true => Ok(()),
            false => wrong(&format!("the series has {} steps", self.num_steps())),
        }
    }
}

impl Store {
    /// How the statistics of the time tree were made; `None` where the store has none.
    pub fn time_tree(&self) -> Option<TimeTreeEntry> {
        self.header().time_tree
    }

    /// Whether the store has statistics of the time tree.
    pub fn has_time_tree(&self) -> bool {
        self.time_tree().is_some()
    }

    /// Whether the statistics over the steps of a time node can be read. Of a complete store with a time tree all can; of one that is
    /// not, those can whose chunk lies in the finished steps as a whole.
    pub fn has_statistics(&self, at: TimeNode) -> bool {
        let header = self.header();
        header.check_time_node(0, at).is_ok()
            && at.index / header.statistics_rows_per_chunk(at.level)
                < header.num_statistics_chunks_over(at.level, header.num_steps_finished)
    }

    /// The place of a node among all nodes of the octree: levels finest first, by rank within a level.
    pub fn node_index(&self, node: NodeId) -> Option<usize> {
        let finer = self.header().levels.iter().take(node.level.into());
        Some(finer.map(|level| level.num_nodes).sum::<usize>() + self.tree().rank(node)?)
    }

    /// What is known of every node of the octree over the steps of a time node, in the order of [`Self::node_index`].
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if there are none of this variable and time node ([`Self::has_statistics`]),
    /// [`StoreError::Corrupt`] and [`StoreError::CorruptBrick`] for what is damaged.
    pub fn statistics(&self, variable: usize, at: TimeNode) -> Result<Vec<NodeStatistics>, StoreError> {
        self.header().check_time_node(variable, at)?;
        if !self.has_statistics(at) {
            let remedy = format!("the store has {} finished steps", self.header().num_steps_finished);
            return Err(StoreError::invalid("time node", format!("{at:?}"), remedy));
        }
        let rows = self.header().statistics_rows_per_chunk(at.level);
        let (variable, time_level) = (variable as u16, at.level);
        let id = StatisticsChunkId { variable, time_level, chunk: at.index / rows };
        let chunk = self.statistics_chunk(&id)?;
        let num_nodes = self.header().num_tree_nodes();
        let row = chunk.iter().skip((at.index % rows) as usize * num_nodes).take(num_nodes);
        let nodes = row.enumerate().map(|(index, fields)| {
            statistics_of(fields).map_err(|problem| self.statistics_error(&id, at, index, problem))
        });
        nodes.collect()
    }

    /// A chunk of statistics, which must be there.
    pub(crate) fn statistics_chunk(&self, id: &StatisticsChunkId) -> Result<Arc<Vec<Fields>>, StoreError> {
        if let Some(chunk) = self.statistics.get(id) {
            return Ok(chunk);
        }
        let path = self.root.join(self.header().statistics_file(id));
        let num_places = self.header().num_statistics_places(id.time_level);
        let num_bytes = 8 * NUM_FIELDS * num_places;
        let Some(stored) = files::read_whole(&path, chunk::largest_stored(num_bytes) as u64)? else {
            return Err(StoreError::corrupt(&path, "file", "absent", "the statistics of its rows are lost"));
        };
        self.count_read(stored.len() as u64);
        let chunk = chunk::decode_by_field(&stored, num_places).map_err(|problem| {
            StoreError::corrupt(&path, "statistics", format!("{} bytes", stored.len()), problem)
        })?;
        let chunk = Arc::new(chunk);
        self.statistics.insert(*id, chunk.clone(), num_bytes);
        Ok(chunk)
    }

    /// An error in the statistics of the node at a place of [`Self::node_index`].
    pub(crate) fn statistics_error(
        &self,
        id: &StatisticsChunkId,
        at: TimeNode,
        index: usize,
        problem: String,
    ) -> StoreError {
        let (mut level, mut rank) = (0, index);
        while let Some(left) = rank.checked_sub(self.header().num_nodes(level)) {
            (level, rank) = (level + 1, left);
        }
        let path = self.root.join(self.header().statistics_file(id));
        let steps = at.steps(self.header().num_steps());
        let problem = format!("over {} steps {problem}", steps.len());
        self.brick_error(&path, id.variable.into(), level, rank as u32, steps.start, problem)
    }
}
