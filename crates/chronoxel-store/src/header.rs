//! The header: everything a reader must know before it reads an array, in the group's `zarr.json`.

use std::path::Path;

use chronoxel_codec::PayloadClass;
use chronoxel_core::{
    BrickLayout, LevelGeometry, Octree, SampleType, TimeAxis, UniformGrid, octree::levels_of,
};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::{StoreError, header_text, layout};

/// The version of the format that is written, and the only one that is read.
pub const FORMAT_VERSION: u32 = 1;

/// The attribute of the group that holds the header.
pub(crate) const ATTRIBUTE: &str = "chronoxel";
/// Most bytes of a header: about ten million time steps.
pub(crate) const MAX_BYTES: u64 = 1 << 28;
pub(crate) const MAX_VARIABLES: usize = 1024;
const MAX_WINDOWS: usize = 16;
const MAX_CLASSES: usize = 64;
/// Names that are not those of variables.
const TAKEN: [&str; 2] = ["nodes", "zarr.json"];

/// A variable to be written.
#[derive(Debug, Clone, PartialEq)]
pub struct VariableDescription {
    /// Its name, unique in the store.
    pub name: String,
    /// Units; empty where the source does not say.
    pub units: String,
    /// Type of the source's samples.
    pub sample_type: SampleType,
    /// The source's "no data" value.
    pub fill_value: Option<f64>,
    /// Window lengths that spans may have, increasing, each 1 to 1,024.
    pub windows: Vec<u32>,
    /// Classes that payloads may have; `SpanKind::Coded` holds an index into them.
    pub classes: Vec<PayloadClass>,
}

/// A store to be written: everything that is known before the first step.
#[derive(Debug, Clone, PartialEq)]
pub struct StoreDescription {
    /// The grid.
    pub grid: UniformGrid,
    /// Times of all steps.
    pub times: TimeAxis,
    /// The shape of bricks.
    pub layout: BrickLayout,
    /// The nodes that exist; as many levels as [`levels_of`] gives.
    pub tree: Octree,
    /// The variables, at least one.
    pub variables: Vec<VariableDescription>,
    /// Level of zstd for payloads and masks, -7 to 22.
    pub zstd_level: i32,
    /// How the statistics of the time tree are made; `None` for a store without them.
    pub time_tree: Option<TimeTreeEntry>,
    /// What the grid was in the source, where it was a mesh.
    pub mesh: Option<MeshEntry>,
    /// Options of the encoder and the name of the source: kept as they are, and compared by a resume.
    pub encoder: Value,
}

/// The header of a store.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// Version of the format: 1.
    pub version: u32,
    /// The grid.
    pub grid: UniformGrid,
    /// Times of all steps, and their units.
    pub times: TimeAxis,
    /// The shape of bricks.
    pub bricks: BrickLayout,
    /// Whether payloads hold the apron; always so in version 1.
    pub apron_stored: bool,
    /// The levels of the tree, finest first.
    pub levels: Vec<LevelEntry>,
    /// The variables.
    pub variables: Vec<VariableEntry>,
    /// G: steps that a shard covers (a shard of window `w` has `max(1, G / w)` rows).
    pub steps_per_shard: u32,
    /// Whether what holds nothing is left out: folders of window lengths, classes and masks, chunks of spans. The first
    /// stores of version 1 do not have the field, and have everything.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sparse: bool,
    /// Level of zstd for payloads and masks.
    pub zstd_level: i32,
    /// How the statistics of the time tree were made; stores without them do not have the field.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_tree: Option<TimeTreeEntry>,
    /// What the grid was in the source; stores of uniform grids do not have the field.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mesh: Option<MeshEntry>,
    /// Steps `0 .. num_steps_finished` can be read.
    pub num_steps_finished: u32,
    /// What is stored.
    pub totals: Totals,
    /// Options of the encoder and the name of the source.
    pub encoder: Value,
}

/// One level of the tree.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LevelEntry {
    /// Samples inside the grid along x, y, z.
    pub dims: [usize; 3],
    /// Nodes that exist.
    pub num_nodes: usize,
}

/// How the statistics of the time tree are made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TimeTreeEntry {
    /// Every so many core samples along each axis take part in the temporal error: 1, 2 or 4.
    pub stride: u32,
}

/// A grid of the source that is not uniform, which was resampled to the grid of the store.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeshEntry {
    /// `rectilinear`, `curvilinear` or `tetrahedral`.
    pub kind: String,
    /// Its cells.
    pub num_cells: u64,
    /// Its points: the values of one step of a variable.
    pub num_points: u64,
}

/// The longest side of a mesh over the default unit of opacity: as of a volume of so many samples.
pub(crate) const MESH_UNITS: f64 = 128.0;

impl TimeTreeEntry {
    /// Of a grid: the smallest stride with which at most 2^20 samples take part in the temporal error, 4 where none is.
    pub fn of_grid(grid: &UniformGrid) -> Self {
        Self::of_samples(grid.num_samples() as u64)
    }

    /// Of so many finest samples.
    pub fn of_samples(num_samples: u64) -> Self {
        let is_enough = |stride: &u32| num_samples <= u64::from(stride.pow(3)) << 20;
        Self { stride: [1, 2].into_iter().find(is_enough).unwrap_or(4) }
    }
}

/// One variable of a store.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VariableEntry {
    /// Its name.
    pub name: String,
    /// Its folder in the store.
    pub folder: String,
    /// Units; empty where unknown.
    pub units: String,
    /// Type of the source's samples.
    pub sample_type: SampleType,
    /// The source's "no data" value.
    #[serde(with = "header_text::json_number")]
    pub fill_value: Option<f64>,
    /// Smallest source sample of the committed steps, `None` before the first.
    pub min: Option<f64>,
    /// Largest source sample of the committed steps.
    pub max: Option<f64>,
    /// Window lengths, increasing.
    pub windows: Vec<u32>,
    /// Payload classes.
    pub classes: Vec<PayloadClass>,
}

/// What a store holds, counted over all variables, levels and nodes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Totals {
    /// Spans without data.
    pub empty: u64,
    /// Spans of one value.
    pub constant: u64,
    /// Spans whose payload is stored at their own place.
    pub coded: u64,
    /// Spans whose payload is that of an earlier span.
    pub shared: u64,
    /// Spans with a mask.
    pub masked: u64,
    /// Masks that are stored, the others being shared.
    pub masks: u64,
    /// Bytes of stored payloads before zstd, without the apron's indices.
    pub core_bytes: u64,
    /// Bytes of the apron's indices in stored payloads before zstd.
    pub apron_bytes: u64,
    /// Bytes of stored payloads after zstd, checksums included.
    pub payload_bytes: u64,
    /// Bytes of stored masks after zstd, checksums included.
    pub mask_bytes: u64,
    /// Bytes of all shards and of all chunks of spans and statistics: the store less its metadata and nodes.
    pub data_bytes: u64,
}

impl Header {
    /// Number of steps of the series.
    pub fn num_steps(&self) -> u32 {
        self.times.num_steps() as u32
    }

    /// Bytes of the source's samples, over all variables and steps.
    pub fn raw_bytes(&self) -> u64 {
        let step: u64 = self.variables.iter().map(|v| v.sample_type.num_bytes() as u64).sum();
        self.num_values().saturating_mul(step).saturating_mul(u64::from(self.num_steps()))
    }

    /// Numbers that the source has for a step of a variable: samples of the grid, or points of the mesh.
    pub fn num_values(&self) -> u64 {
        self.mesh.as_ref().map_or(self.grid.num_samples() as u64, |mesh| mesh.num_points)
    }

    /// The length over which opacities of transfer functions are meant, where they do not say: the smallest spacing, or of a mesh, whose
    /// finest bricks may be few, a part of its longest side.
    pub fn opacity_unit(&self) -> f64 {
        match &self.mesh {
            None => self.grid.smallest_spacing(),
            Some(_) => {
                let [low, high] = self.grid.bounds();
                (0..3).map(|a| high[a] - low[a]).fold(0.0, f64::max) / MESH_UNITS
            }
        }
    }

    /// The index of a variable by name.
    pub fn variable(&self, name: &str) -> Option<usize> {
        self.variables.iter().position(|v| v.name == name)
    }

    /// Sizes of the levels.
    pub fn geometry(&self) -> Vec<LevelGeometry> {
        levels_of(&self.grid, &self.bricks)
    }

    /// The header of a store of which nothing is written yet.
    pub(crate) fn of_description(description: &StoreDescription) -> Result<Self, StoreError> {
        let StoreDescription { grid, times, layout, tree, variables, zstd_level, time_tree, mesh, encoder } =
            description;
        let geometry = levels_of(grid, layout);
        if tree.num_levels() != geometry.len() {
            let remedy = format!("the grid has {} levels of bricks", geometry.len());
            return Err(StoreError::invalid("number of octree levels", tree.num_levels(), remedy));
        }
        let levels = geometry
            .iter()
            .map(|g| LevelEntry { dims: g.dims, num_nodes: tree.nodes(g.level).len() })
            .collect();
        let mut entries: Vec<VariableEntry> = Vec::new();
        for (index, variable) in variables.iter().enumerate() {
            let earlier = entries.iter().map(|v| v.folder.as_str());
            entries.push(VariableEntry {
                folder: layout::variable_folder(index, &variable.name, &TAKEN, earlier),
                name: variable.name.clone(),
                units: variable.units.clone(),
                sample_type: variable.sample_type,
                fill_value: variable.fill_value,
                min: None,
                max: None,
                windows: variable.windows.clone(),
                classes: variable.classes.clone(),
            });
        }
        let header = Self {
            version: FORMAT_VERSION,
            grid: *grid,
            times: times.clone(),
            bricks: *layout,
            apron_stored: true,
            levels,
            variables: entries,
            steps_per_shard: layout::steps_per_shard(grid, layout),
            sparse: true,
            zstd_level: *zstd_level,
            time_tree: *time_tree,
            mesh: mesh.clone(),
            num_steps_finished: 0,
            totals: Totals::default(),
            encoder: encoder.clone(),
        };
        match header.problem() {
            None => Ok(header),
            Some((field, value, remedy)) => Err(StoreError::invalid(field, value, remedy)),
        }
    }

    /// What is wrong with a header, if anything is: field, value, what would be right.
    fn problem(&self) -> Option<(&'static str, String, String)> {
        let problem =
            |field, value: &dyn ToString, remedy: &str| Some((field, value.to_string(), remedy.to_owned()));
        if let Err(error) = UniformGrid::new(self.grid.dims, self.grid.origin, self.grid.spacing) {
            return problem("grid", &error, "the grid must be sound");
        }
        if let Err(error) = TimeAxis::new(self.times.times.clone(), "") {
            return problem("times", &error, "the time axis must be sound");
        }
        if self.times.num_steps() > u32::MAX as usize {
            return problem("number of steps", &self.times.num_steps(), "at most 2^32 - 1");
        }
        if BrickLayout::new(self.bricks.edge).as_ref() != Ok(&self.bricks) {
            return problem("bricks", &self.bricks.edge, "edge 8, 16, 32, 64 or 128, apron 1 and 2");
        }
        if !self.apron_stored {
            return problem("apron_stored", &false, "version 1 stores the apron");
        }
        let geometry = self.geometry();
        if geometry.iter().any(|g| g.bricks.iter().any(|&n| n > 1 << 21)) {
            return problem(
                "bricks along an axis",
                &geometry[0].bricks[0],
                "at most 2^21: use larger bricks",
            );
        }
        let fits = |(g, l): (&LevelGeometry, &LevelEntry)| {
            let most = g.bricks.iter().map(|&n| n as u128).product::<u128>();
            l.dims == g.dims && l.num_nodes >= 1 && l.num_nodes as u128 <= most && l.num_nodes <= 1 << 31
        };
        if self.levels.len() != geometry.len() || !geometry.iter().zip(&self.levels).all(fits) {
            return problem("levels", &self.levels.len(), "they must be those of the grid");
        }
        if self.steps_per_shard != layout::steps_per_shard(&self.grid, &self.bricks) {
            return problem("steps_per_shard", &self.steps_per_shard, "it follows from grid and bricks");
        }
        if self.num_steps_finished > self.num_steps() {
            return problem("num_steps_finished", &self.num_steps_finished, "more than there are steps");
        }
        if !(-7..=22).contains(&self.zstd_level) {
            return problem("zstd_level", &self.zstd_level, "use -7 to 22");
        }
        if let Some(TimeTreeEntry { stride }) = self.time_tree
            && ![1, 2, 4].contains(&stride)
        {
            return problem("time_tree.stride", &stride, "use 1, 2 or 4");
        }
        if let Some(MeshEntry { kind, .. }) = &self.mesh
            && !["rectilinear", "curvilinear", "tetrahedral"].contains(&kind.as_str())
        {
            return problem("mesh.kind", kind, "use rectilinear, curvilinear or tetrahedral");
        }
        if self.variables.is_empty() || self.variables.len() > MAX_VARIABLES {
            return problem("number of variables", &self.variables.len(), "use 1 to 1024");
        }
        (0..self.variables.len()).find_map(|index| self.variable_problem(index))
    }

    fn variable_problem(&self, index: usize) -> Option<(&'static str, String, String)> {
        let (earlier, variable) = (&self.variables[..index], &self.variables[index]);
        let problem = |field, value: &dyn ToString, remedy: &str| {
            Some((field, value.to_string(), format!("{remedy} (variable {:?})", variable.name)))
        };
        if variable.name.is_empty() || earlier.iter().any(|v| v.name == variable.name) {
            return problem("variable name", &variable.name, "names must differ and not be empty");
        }
        let folder =
            layout::variable_folder(index, &variable.name, &TAKEN, earlier.iter().map(|v| v.folder.as_str()));
        if folder != variable.folder {
            return problem("folder", &variable.folder, "it follows from the name");
        }
        if !layout::fill_value_is_sound(variable.sample_type, variable.fill_value) {
            return problem("fill_value", &"NaN", "integers have none");
        }
        let windows = &variable.windows;
        let sound = |&w: &u32| (1..=layout::MAX_WINDOW).contains(&w);
        if windows.is_empty()
            || windows.len() > MAX_WINDOWS
            || !windows.iter().all(sound)
            || !windows.is_sorted_by(|a, b| a < b)
        {
            return problem("windows", &format!("{windows:?}"), "1 to 16 increasing lengths of 1 to 1024");
        }
        if variable.classes.is_empty() || variable.classes.len() > MAX_CLASSES {
            return problem("number of classes", &variable.classes.len(), "use 1 to 64");
        }
        for class in &variable.classes {
            if let Err(error) = class.validate() {
                return problem("class", &error, "see the format");
            }
            if !windows.iter().any(|&w| class.fits_window(w)) {
                return problem("class", &format!("{class:?}"), "its rows fit no window");
            }
        }
        let bounds = [variable.min, variable.max];
        if bounds.iter().flatten().any(|b| !b.is_finite()) || variable.min > variable.max {
            return problem("min and max", &format!("{bounds:?}"), "they must be finite and in order");
        }
        None
    }

    /// The text of the group's `zarr.json`.
    pub(crate) fn to_text(&self) -> Result<String, StoreError> {
        header_text::to_text(ATTRIBUTE, self)
    }

    /// The header from the text of `zarr.json`, checked in itself.
    pub(crate) fn from_text(path: &Path, text: &str) -> Result<Self, StoreError> {
        let header: Self = header_text::from_text(path, text, ATTRIBUTE, FORMAT_VERSION)?;
        match header.problem() {
            None => Ok(header),
            Some((field, value, problem)) => Err(StoreError::corrupt(path, field, value, problem)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_with_and_without_a_time_tree_are_written_as_they_were_read() {
        let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures");
        for (name, has_time_tree) in [("v1_sparse.cxl", false), ("v1_time_tree.cxl", true)] {
            let path = fixtures.join(name).join("zarr.json");
            let text = std::fs::read_to_string(&path).unwrap();
            let header = Header::from_text(&path, &text).unwrap();
            assert_eq!(header.time_tree.is_some(), has_time_tree);
            assert_eq!(header.to_text().unwrap(), text);
        }
    }

    #[test]
    fn only_large_grids_have_a_stride() {
        let stride =
            |n| TimeTreeEntry::of_grid(&UniformGrid::new([n, n, n], [0.0; 3], [1.0; 3]).unwrap()).stride;
        // 2^20 samples are 101.6³; every other one of 203.2³.
        assert_eq!(
            [stride(64), stride(101), stride(102), stride(203), stride(204), stride(2048)],
            [1, 1, 2, 2, 4, 4]
        );
    }
}
