//! The header of a store of cells, in the group's `zarr.json`.

use std::path::Path;

use chronoxel_codec::StageClass;
use chronoxel_core::{SampleType, TimeAxis};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::BLOCK_STEPS;
use crate::{
    StoreError, files,
    header::{MAX_BYTES, MAX_VARIABLES},
    header_text, layout,
};

/// The attribute of the group that holds the header.
pub(crate) const ATTRIBUTE: &str = "chronoxel_cells";
/// The version of the format that is written, and the only one that is read.
const VERSION: u32 = 1;
/// Most classes of a variable.
const MAX_CLASSES: usize = 255;
/// Most points and most tetrahedra: both are numbered with 32 bits.
const MAX_ITEMS: u64 = u32::MAX as u64;
/// Names that are not those of variables.
const TAKEN: [&str; 3] = ["points", "tetrahedra", "zarr.json"];

/// A variable to be written.
#[derive(Debug, Clone, PartialEq)]
pub struct CellVariableDescription {
    /// Its name, unique in the store.
    pub name: String,
    /// Units; empty where the source does not say.
    pub units: String,
    /// Type of the source's values.
    pub sample_type: SampleType,
    /// The source's "no data" value.
    pub fill_value: Option<f64>,
}

/// A store to be written: everything that is known before the first step, but for the geometry.
#[derive(Debug, Clone, PartialEq)]
pub struct CellDescription {
    /// What the grid was in the source: `rectilinear`, `curvilinear` or `tetrahedral`, or `uniform`.
    pub kind: String,
    /// Times of all steps.
    pub times: TimeAxis,
    /// The variables, at least one.
    pub variables: Vec<CellVariableDescription>,
    /// Level of zstd for stages and masks, -7 to 22.
    pub zstd_level: i32,
    /// Options of the encoder and the name of the source: kept as they are, and compared by a resume.
    pub encoder: Value,
}

/// The header of a store of cells.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellHeader {
    /// Version of the format: 1.
    pub version: u32,
    /// What the grid was in the source: `uniform`, `rectilinear`, `curvilinear` or `tetrahedral`.
    pub kind: String,
    /// Points of the mesh: the values of a step of a variable.
    pub num_points: u64,
    /// Its tetrahedra.
    pub num_tetrahedra: u64,
    /// The lowest and the highest coordinates of its points.
    pub bounds: [[f64; 3]; 2],
    /// XXH3-128 of the bytes of all points and tetrahedra, in hexadecimal: the geometry that a resume must find again.
    pub geometry: String,
    /// Times of all steps, and their units.
    pub times: TimeAxis,
    /// The variables.
    pub variables: Vec<CellVariable>,
    /// Level of zstd for stages and masks.
    pub zstd_level: i32,
    /// Steps `0 .. num_steps_finished` can be read.
    pub num_steps_finished: u32,
    /// What is stored.
    pub totals: CellTotals,
    /// Options of the encoder and the name of the source.
    pub encoder: Value,
}

/// One variable of a store of cells.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellVariable {
    /// Its name.
    pub name: String,
    /// Its folder in the store.
    pub folder: String,
    /// Units; empty where unknown.
    pub units: String,
    /// Type of the source's values.
    pub sample_type: SampleType,
    /// The source's "no data" value.
    #[serde(with = "header_text::json_number")]
    pub fill_value: Option<f64>,
    /// Smallest value of the source in the finished steps, `None` before the first or where there is none.
    pub min: Option<f64>,
    /// Largest.
    pub max: Option<f64>,
    /// What spans are made of, in the order in which they were first used.
    pub classes: Vec<CellClass>,
}

/// The form of a span: what fixes the number of bytes of each of its stages.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellClass {
    /// Steps of a span: a power of two, at most 64. A span begins at a multiple of it, and ends before only with the series.
    pub window: u32,
    /// The stages, in order.
    pub stages: Vec<StageClass>,
}

/// What a store of cells holds, over all variables.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CellTotals {
    /// Spans.
    pub spans: u64,
    /// Spans with missing values.
    pub masked: u64,
    /// Masks that are stored, the others being shared.
    pub masks: u64,
    /// Bytes of stages before zstd.
    pub stage_bytes: u64,
    /// Bytes of stages after zstd, checksums included.
    pub payload_bytes: u64,
    /// Bytes of masks after zstd, checksums included.
    pub mask_bytes: u64,
    /// Bytes of all files of values: shards of stages and masks, and chunks of spans.
    pub data_bytes: u64,
    /// Bytes of the files of points and tetrahedra.
    pub geometry_bytes: u64,
}

/// What is known of the geometry in the header.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct GeometrySummary {
    pub num_points: u64,
    pub num_tetrahedra: u64,
    pub bounds: [[f64; 3]; 2],
    pub digest: String,
}

impl CellHeader {
    /// Number of steps of the series.
    pub fn num_steps(&self) -> u32 {
        self.times.num_steps() as u32
    }

    /// Bytes of the source's values, over all variables and steps.
    pub fn raw_bytes(&self) -> u64 {
        let step: u64 = self.variables.iter().map(|v| v.sample_type.num_bytes() as u64).sum();
        self.num_points.saturating_mul(step).saturating_mul(u64::from(self.num_steps()))
    }

    /// The index of a variable by name.
    pub fn variable(&self, name: &str) -> Option<usize> {
        self.variables.iter().position(|v| v.name == name)
    }

    /// The length over which opacities of transfer functions are meant, where they do not say: that of a store of bricks made
    /// of the same mesh.
    pub fn opacity_unit(&self) -> f64 {
        let [low, high] = self.bounds;
        (0..3).map(|a| high[a] - low[a]).fold(0.0, f64::max) / crate::header::MESH_UNITS
    }

    /// Steps of a span that begins at `start`, of a class of length `window`.
    pub(crate) fn span_len(&self, start: u32, window: u32) -> u32 {
        window.min(self.num_steps() - start)
    }

    /// The header of a store of which nothing is written yet.
    pub(crate) fn of_description(
        description: &CellDescription,
        geometry: &GeometrySummary,
    ) -> Result<Self, StoreError> {
        let CellDescription { kind, times, variables, zstd_level, encoder } = description;
        let mut entries: Vec<CellVariable> = Vec::new();
        for (index, variable) in variables.iter().enumerate() {
            let earlier = entries.iter().map(|v| v.folder.as_str());
            entries.push(CellVariable {
                folder: layout::variable_folder(index, &variable.name, &TAKEN, earlier),
                name: variable.name.clone(),
                units: variable.units.clone(),
                sample_type: variable.sample_type,
                fill_value: variable.fill_value,
                min: None,
                max: None,
                classes: Vec::new(),
            });
        }
        let header = Self {
            version: VERSION,
            kind: kind.clone(),
            num_points: geometry.num_points,
            num_tetrahedra: geometry.num_tetrahedra,
            bounds: geometry.bounds,
            geometry: geometry.digest.clone(),
            times: times.clone(),
            variables: entries,
            zstd_level: *zstd_level,
            num_steps_finished: 0,
            totals: CellTotals::default(),
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
        if !["uniform", "rectilinear", "curvilinear", "tetrahedral"].contains(&self.kind.as_str()) {
            return problem("kind", &self.kind, "use uniform, rectilinear, curvilinear or tetrahedral");
        }
        if !(1..=MAX_ITEMS).contains(&self.num_points) {
            return problem("num_points", &self.num_points, "a mesh has 1 to 2^32 - 1");
        }
        if !(1..=MAX_ITEMS).contains(&self.num_tetrahedra) {
            return problem("num_tetrahedra", &self.num_tetrahedra, "a mesh has 1 to 2^32 - 1");
        }
        let [low, high] = self.bounds;
        if !(0..3).all(|a| low[a].is_finite() && high[a].is_finite() && low[a] <= high[a]) {
            return problem("bounds", &format!("{:?}", self.bounds), "they must be finite and in order");
        }
        if self.geometry.len() != 32 || !self.geometry.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
        {
            return problem("geometry", &self.geometry, "it is a digest of 32 hexadecimal digits");
        }
        if let Err(error) = TimeAxis::new(self.times.times.clone(), "") {
            return problem("times", &error, "the time axis must be sound");
        }
        if self.times.num_steps() > u32::MAX as usize {
            return problem("number of steps", &self.times.num_steps(), "at most 2^32 - 1");
        }
        let finished = self.num_steps_finished;
        if finished > self.num_steps()
            || (finished < self.num_steps() && !finished.is_multiple_of(BLOCK_STEPS))
        {
            return problem("num_steps_finished", &finished, "whole blocks of 64 steps are finished");
        }
        if !(-7..=22).contains(&self.zstd_level) {
            return problem("zstd_level", &self.zstd_level, "use -7 to 22");
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
        let folders = earlier.iter().map(|v| v.folder.as_str());
        if layout::variable_folder(index, &variable.name, &TAKEN, folders) != variable.folder {
            return problem("folder", &variable.folder, "it follows from the name");
        }
        if !layout::fill_value_is_sound(variable.sample_type, variable.fill_value) {
            return problem("fill_value", &"NaN", "integers have none");
        }
        if variable.classes.len() > MAX_CLASSES {
            return problem("number of classes", &variable.classes.len(), "use at most 255");
        }
        for (at, class) in variable.classes.iter().enumerate() {
            if let Some(wrong) = class.problem(self.num_steps()) {
                return problem("class", &format!("{class:?}"), &wrong);
            }
            if variable.classes[..at].contains(class) {
                return problem("class", &format!("{class:?}"), "classes must differ");
            }
        }
        let bounds = [variable.min, variable.max];
        if bounds.iter().flatten().any(|b| !b.is_finite())
            || variable.min.is_some() != variable.max.is_some()
            || variable.min > variable.max
        {
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
        let header: Self = header_text::from_text(path, text, ATTRIBUTE, VERSION)?;
        match header.problem() {
            None => Ok(header),
            Some((field, value, problem)) => Err(StoreError::corrupt(path, field, value, problem)),
        }
    }
}

impl CellClass {
    /// Whether a span of so many steps can be of this class: a listed table has one row for every `2^shift` steps.
    pub(crate) fn fits(&self, len: u32) -> bool {
        self.stages.iter().all(|stage| stage.fits_window(len))
    }

    fn problem(&self, num_steps: u32) -> Option<String> {
        if !self.window.is_power_of_two() || self.window > BLOCK_STEPS {
            return Some("its window must be a power of two, at most 64".into());
        }
        let stages = chronoxel_codec::PayloadClass { stages: self.stages.clone() };
        if let Err(error) = stages.validate() {
            return Some(error.to_string());
        }
        // The last span of the series may be shorter.
        let last = num_steps % self.window;
        let fits = self.fits(self.window) || (last > 0 && self.fits(last));
        (!fits).then(|| "its rows fit no span".into())
    }
}

/// The text of a folder's `zarr.json`, if there is one.
pub(crate) fn group_text(root: &Path) -> Result<Option<String>, StoreError> {
    let file = root.join("zarr.json");
    let Some(bytes) = files::read_whole(&file, MAX_BYTES)? else { return Ok(None) };
    String::from_utf8(bytes)
        .map(Some)
        .map_err(|_| StoreError::corrupt(&file, "text", "not UTF-8", "this is not a Chronoxel store"))
}

/// Whether the text of a group is the header of a store of cells.
pub(crate) fn is_of_cells(text: &str) -> bool {
    text.contains(&format!("\"{ATTRIBUTE}\""))
}

/// Whether a folder is a store of cells.
pub(crate) fn is_cell_store(root: &Path) -> Result<bool, StoreError> {
    Ok(group_text(root)?.is_some_and(|text| is_of_cells(&text)))
}
