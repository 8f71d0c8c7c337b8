//! Zarr arrays, versions 2 and 3: `[z, y, x]` or `[t, z, y, x]`; a group of such arrays is a series with a variable each.
//!
//! Specifications: <https://zarr-specs.readthedocs.io>. Codecs blosc (all but snappy), gzip, lz4, zlib, zstd, crc32c,
//! transpose and shards. Chunks are read from the metadata and decoded here, within stated limits, because a chunk may
//! be hostile. Where dimensions have names (`dimension_names`, or `_ARRAY_DIMENSIONS` of xarray), arrays of those names
//! beside the array give times, origin and spacing; the attribute `units` gives units. `_FillValue` or `missing_value`
//! mean "no data".

mod blosc;
mod chunks;
mod codecs;
mod layers;
mod metadata;

use std::path::{Path, PathBuf};

use chronoxel_core::UniformGrid;

use self::chunks::ChunkReader;
use self::layers::{KeptLayers, LayerReader};
use self::metadata::{ArrayMetadata, Node};
use super::SourceOptions;
use super::volume_file::{FileHeader, FileTimes, VolumeFile, checked_grid, checked_steps};
use crate::{SourceError, StepReader, Variable};

/// The most bytes that the chunks of one layer of a volume may have, decoded.
const MAX_LAYER_BYTES: u64 = 4 << 30;

/// The most bytes of decoded samples that are kept for later steps, where chunks hold several.
const MAX_KEPT_BYTES: u64 = 512 << 20;

/// The longest array of coordinates that is read.
const MAX_COORDINATES: u64 = 1 << 24;

/// How far coordinates may be from even, relative to their spacing; single precision is common.
const EVEN_TOLERANCE: f64 = 1e-3;

/// Arrays of one shape.
struct ZarrGroup {
    header: FileHeader,
    arrays: Vec<ArrayMetadata>,
    /// Per array: decoded layers of a run of steps.
    kept: Vec<KeptLayers>,
    /// The most bytes that each array may keep.
    most_kept_bytes: u64,
}

/// Opens an array or a group.
pub(crate) fn open(path: &Path, options: &SourceOptions) -> Result<Box<dyn VolumeFile>, SourceError> {
    let (arrays, folder) = match Node::read(path)? {
        Node::Array(array) => (vec![(String::new(), *array)], path.parent().unwrap_or(Path::new(""))),
        Node::Group { path: metadata_path, attributes } => {
            if attributes.contains_key("chronoxel") {
                let remedy = "a store is not a source; render it, or export it first";
                return Err(SourceError::unsupported(
                    &metadata_path,
                    "attributes",
                    "those of a Chronoxel store",
                    remedy,
                ));
            }
            (arrays_of_group(path, options)?, path)
        }
        Node::Neither => {
            return Err(SourceError::corrupt(path, "folder", "without metadata", "it must be Zarr"));
        }
    };
    let (first_name, first) = &arrays[0];
    let has_steps = check_axes(first)?;
    let axes = Axes { folder, array: first, options };
    let grid = axes.grid(usize::from(has_steps))?;
    let num_steps = if has_steps { usize::try_from(first.shape[0]).unwrap_or(usize::MAX) } else { 1 };
    let num_steps = checked_steps(&first.path, "shape[0]", num_steps)?;
    let (times, time_units) =
        if has_steps { axes.times(num_steps)? } else { (FileTimes::Unknown, String::new()) };
    let mut variables = Vec::new();
    for (name, array) in &arrays {
        if array.shape != first.shape {
            let problem = format!(
                "{first_name:?} has {:?}; name the variables that agree with --variable",
                first.shape
            );
            return Err(SourceError::corrupt(&array.path, "shape", format!("{:?}", array.shape), problem));
        }
        array.check_not_packed()?;
        check_layer(array, &grid)?;
        variables.push(Variable {
            name: name.clone(),
            units: array.text_attribute("units").unwrap_or_default().to_owned(),
            sample_type: array.sample_type,
            fill_value: array.fill_value()?,
        });
    }
    let header = FileHeader { path: path.to_owned(), grid, variables, num_steps, times, time_units };
    let arrays: Vec<ArrayMetadata> = arrays.into_iter().map(|(_, array)| array).collect();
    let kept = arrays.iter().map(|_| KeptLayers::default()).collect();
    let most_kept_bytes = options.buffer_bytes(MAX_KEPT_BYTES) / arrays.len() as u64;
    Ok(Box::new(ZarrGroup { header, arrays, kept, most_kept_bytes }))
}

/// The arrays of three or four axes right inside a group, by name; only those wanted.
fn arrays_of_group(
    path: &Path,
    options: &SourceOptions,
) -> Result<Vec<(String, ArrayMetadata)>, SourceError> {
    let list_error = |e| SourceError::io(path, "list", e);
    let mut arrays = Vec::new();
    for entry in std::fs::read_dir(path).map_err(list_error)? {
        let entry = entry.map_err(list_error)?;
        let name = entry.file_name().to_string_lossy().into_owned();
        if !entry.path().is_dir() || !options.variables.is_empty() && !options.variables.contains(&name) {
            continue;
        }
        if let Node::Array(array) = Node::read(&entry.path())?
            && matches!(array.shape.len(), 3 | 4)
        {
            arrays.push((name, *array));
        }
    }
    arrays.sort_by(|a, b| a.0.cmp(&b.0));
    if arrays.is_empty() {
        let remedy = "groups with arrays [z, y, x] or [t, z, y, x] right inside are; name the array itself";
        let wanted = match options.variables.is_empty() {
            true => "none".to_owned(),
            false => format!("none named {}", options.variables.join(", ")),
        };
        return Err(SourceError::unsupported(path, "number of such arrays", wanted, remedy));
    }
    Ok(arrays)
}

/// Whether an array has a time axis; refuses what is not a volume.
fn check_axes(array: &ArrayMetadata) -> Result<bool, SourceError> {
    let shape = format!("{:?}", array.shape);
    let has_steps = match array.shape.len() {
        3 => false,
        4 => true,
        _ => {
            let remedy = "arrays [z, y, x] and [t, z, y, x] are; take a part of it, or give it an axis";
            return Err(SourceError::unsupported(&array.path, "shape", shape, remedy));
        }
    };
    let is_time = |name: &String| matches!(name.to_lowercase().as_str(), "t" | "time");
    let time_axis = array.dimension_names.iter().position(is_time);
    if time_axis.is_some_and(|axis| axis != 0 || !has_steps) {
        let remedy = "arrays [z, y, x] and [t, z, y, x] are; transpose it, or give it an axis";
        let names = array.dimension_names.join(", ");
        return Err(SourceError::unsupported(&array.path, "dimension names", names, remedy));
    }
    Ok(has_steps)
}

/// Refuses arrays whose chunks make a layer too large for memory.
fn check_layer(array: &ArrayMetadata, grid: &UniformGrid) -> Result<(), SourceError> {
    let layer_bytes = layers::layer_bytes(array, grid.dims);
    if layer_bytes > MAX_LAYER_BYTES {
        let remedy = format!(
            "layers of chunks of at most {MAX_LAYER_BYTES} bytes are; write chunks that are flatter in z"
        );
        return Err(SourceError::unsupported(&array.path, "bytes of a layer of chunks", layer_bytes, remedy));
    }
    Ok(())
}

/// What the dimensions of an array mean.
struct Axes<'a> {
    /// Where arrays of coordinates are.
    folder: &'a Path,
    array: &'a ArrayMetadata,
    options: &'a SourceOptions,
}

impl Axes<'_> {
    /// The grid, its three axes being those from `first_axis` on, slowest first.
    fn grid(&self, first_axis: usize) -> Result<UniformGrid, SourceError> {
        let (mut dims, mut origin, mut spacing) = ([0; 3], [0.0; 3], [1.0; 3]);
        for axis in 0..3 {
            let in_array = first_axis + 2 - axis;
            dims[axis] = usize::try_from(self.array.shape[in_array]).unwrap_or(usize::MAX);
            let Some((path, coordinates)) = self.coordinates(in_array)? else { continue };
            origin[axis] = coordinates.first().copied().unwrap_or(0.0);
            if self.options.spacing.is_none() && coordinates.len() > 1 {
                spacing[axis] = even_spacing(&path, &coordinates)?;
            }
        }
        checked_grid(&self.array.path, dims, origin, spacing)
    }

    /// Times and their units from the first axis.
    fn times(&self, num_steps: usize) -> Result<(FileTimes, String), SourceError> {
        match self.coordinates(0)? {
            Some((_, times)) if times.len() == num_steps => {
                let units = match Node::read(&self.folder.join(&self.array.dimension_names[0]))? {
                    Node::Array(array) => array.text_attribute("units").unwrap_or_default().to_owned(),
                    _ => String::new(),
                };
                Ok((FileTimes::Known(times), units))
            }
            _ => Ok((FileTimes::Unknown, String::new())),
        }
    }

    /// The coordinates along an axis, where an array of its name is beside this one.
    fn coordinates(&self, axis: usize) -> Result<Option<(PathBuf, Vec<f64>)>, SourceError> {
        let Some(name) = self.array.dimension_names.get(axis) else { return Ok(None) };
        let is_plain = !name.is_empty() && !name.contains(['/', '\\']) && name != ".." && name != ".";
        if !is_plain {
            return Ok(None);
        }
        let Node::Array(array) = Node::read(&self.folder.join(name))? else { return Ok(None) };
        if array.shape.len() != 1 {
            return Ok(None);
        }
        if array.shape[0] != self.array.shape[axis] || array.shape[0] > MAX_COORDINATES {
            let problem = format!("the dimension has {} entries", self.array.shape[axis]);
            return Err(SourceError::corrupt(&array.path, "shape", format!("{:?}", array.shape), problem));
        }
        Ok(Some((array.path.clone(), read_line(&array)?)))
    }
}

/// All samples of an array of one axis.
fn read_line(array: &ArrayMetadata) -> Result<Vec<f64>, SourceError> {
    let (length, per_chunk) = (array.shape[0] as usize, array.chunk[0] as usize);
    let mut reader = ChunkReader::new(array);
    let mut line = Vec::with_capacity(length);
    for chunk in 0..length.div_ceil(per_chunk) {
        let count = per_chunk.min(length - line.len());
        match reader.read(&[chunk as u64])? {
            Some(samples) => line.extend((0..count).map(|i| samples.get(i))),
            None => line.resize(line.len() + count, array.absent_value),
        }
    }
    Ok(line)
}

/// The distance between coordinates, which must be the same everywhere.
fn even_spacing(path: &Path, coordinates: &[f64]) -> Result<f64, SourceError> {
    let spacing = (coordinates[coordinates.len() - 1] - coordinates[0]) / (coordinates.len() - 1) as f64;
    let is_even = |i: usize| {
        let expected = coordinates[0] + i as f64 * spacing;
        (coordinates[i] - expected).abs() <= EVEN_TOLERANCE * spacing.abs()
    };
    if !(0..coordinates.len()).all(is_even) || spacing <= 0.0 {
        let shown: Vec<String> = coordinates.iter().take(4).map(f64::to_string).collect();
        let remedy = "coordinates that are even and increase are; resample the volume, or give --spacing";
        return Err(SourceError::unsupported(
            path,
            "coordinates",
            format!("{}, …", shown.join(", ")),
            remedy,
        ));
    }
    Ok(spacing)
}

impl VolumeFile for ZarrGroup {
    fn header(&self) -> &FileHeader {
        &self.header
    }

    fn working_bytes(&self) -> u64 {
        let dims = self.header.grid.dims;
        let kept =
            self.arrays.iter().filter_map(|array| layers::kept_bytes(array, dims, self.most_kept_bytes));
        // One array at a time is read, layer after layer.
        let read = self.arrays.iter().map(|array| {
            layers::layer_bytes(array, dims).saturating_add(ChunkReader::new(array).working_bytes())
        });
        kept.fold(read.max().unwrap_or(0), u64::saturating_add)
    }

    fn forget(&mut self) {
        self.kept.iter_mut().for_each(|kept| *kept = KeptLayers::default());
    }

    fn open_step<'a>(
        &'a mut self,
        variable: usize,
        step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError> {
        let (array, kept) = (&self.arrays[variable], &mut self.kept[variable]);
        Ok(Box::new(LayerReader::new(array, kept, self.most_kept_bytes, self.header.grid.dims, step)))
    }
}
