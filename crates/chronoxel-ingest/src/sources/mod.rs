//! Sources: one file per format, each opened by [`open_any`] as a [`TimeSeries`] or, where the grid is not uniform, as a
//! [`MeshSeries`].
//!
//! A format is chosen by the file's extension and held against its first bytes. Headers are read when a
//! series is opened, samples only when a step is; both are treated as hostile.

mod file_series;
mod format;
mod mesh_files;
mod natural_order;
mod npy;
mod nrrd;
mod nrrd_data;
mod nrrd_header;
mod number_text;
mod plot3d;
mod plot3d_layout;
mod pvd;
mod raw;
mod samples;
mod volume_file;
mod vti;
mod vtk_arrays;
mod vtk_cells;
mod vtk_data;
mod vtk_legacy;
mod vtk_legacy_scan;
mod vtk_pieces;
mod vtr;
mod vts;
mod vtu;
mod xml;
mod zarr;

use std::path::{Path, PathBuf};

use chronoxel_core::SampleType;

use self::file_series::{FileSeries, select_variables};
use self::format::Format;
use self::mesh_files::{FileMesh, MeshFile};
use self::natural_order::natural_order;
use self::volume_file::VolumeFile;
use crate::mesh::{MeshSeries, Opened, SelectedMesh};
use crate::{SourceError, TimeSeries};

/// What a caller may say about a source beyond what its files do.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SourceOptions {
    /// Samples along x, y, z of raw files.
    pub dims: Option<[usize; 3]>,
    /// Type of the samples of raw files.
    pub sample_type: Option<SampleType>,
    /// Whether raw files have the most significant byte first.
    pub big_endian: bool,
    /// Bytes before the samples of raw files.
    pub header_bytes: u64,
    /// Distance between samples, in place of the files' own.
    pub spacing: Option<[f64; 3]>,
    /// Position of the first sample, in place of the files' own.
    pub origin: Option<[f64; 3]>,
    /// Time between steps; the files' own times are then not used.
    pub dt: Option<f64>,
    /// The variables wanted, in this order; empty for all.
    pub variables: Vec<String>,
    /// The value that means "no data", in place of the files' own.
    pub fill_value: Option<f64>,
    /// Tetrahedra of a mesh whose volume is at most this share of their cubed longest edge are left out as flat, in place of
    /// [`DEFAULT_FLAT_THRESHOLD`](crate::mesh::DEFAULT_FLAT_THRESHOLD).
    pub flat_threshold: Option<f64>,
    /// Memory of the whole run. Buffers that only save time take at most a quarter of it; what is read stays the same.
    pub memory_bytes: Option<u64>,
}

impl SourceOptions {
    /// The most bytes of a buffer that only saves time, and that has at most `most_bytes`.
    fn buffer_bytes(&self, most_bytes: u64) -> u64 {
        self.memory_bytes.map_or(most_bytes, |memory| most_bytes.min(memory / 4))
    }

    /// Refuses the options that describe raw files, for a file that describes itself.
    fn check_describes_itself(&self, path: &Path, format: &str) -> Result<(), SourceError> {
        let given = [
            (self.dims.is_some(), "--dims"),
            (self.sample_type.is_some(), "--dtype"),
            (self.big_endian, "--big-endian"),
            (self.header_bytes > 0, "--header-bytes"),
        ];
        match given.iter().find(|(is_given, _)| *is_given) {
            Some((_, option)) => {
                let remedy =
                    format!("{} is {format} and says this itself; leave the option out", path.display());
                Err(SourceError::argument(option, "is given", remedy))
            }
            None => Ok(()),
        }
    }
}

/// Opens a source: files in the order given, those that globs match in natural order, or a built-in simulation.
///
/// Each file may hold one step or several; all must have the same grid and variables. Times are the files' own
/// where all have them, else the step's number times `dt`.
///
/// * `inputs`: paths and globs, or one `sim:NAME?key=value&…`
///
/// # Errors
/// [`SourceError`] naming the file, the field and the value if one cannot be opened or they do not agree.
pub fn open(inputs: &[String], options: &SourceOptions) -> Result<Box<dyn TimeSeries>, SourceError> {
    match open_any(inputs, options)? {
        Opened::Volume(series) => Ok(series),
        Opened::Mesh(mesh) => {
            let remedy = format!("it is a {} grid where a uniform one is needed", mesh.grid_type().name());
            Err(SourceError::argument("SOURCE", &inputs[0], remedy))
        }
    }
}

/// Opens a source that is a mesh: a grid that is not uniform.
///
/// # Errors
/// As [`open`]; also if the source is a uniform volume.
pub fn open_mesh(inputs: &[String], options: &SourceOptions) -> Result<Box<dyn MeshSeries>, SourceError> {
    match open_any(inputs, options)? {
        Opened::Mesh(mesh) => Ok(mesh),
        Opened::Volume(_) => {
            let remedy = "it is a uniform grid where a mesh is needed";
            Err(SourceError::argument("SOURCE", &inputs[0], remedy))
        }
    }
}

/// Opens a source, whether it is a uniform volume or a mesh.
///
/// A mesh has one step per file. PLOT3D takes one grid and its solutions, in any order; the geometry of other meshes is that of the first
/// file, and a later step that differs is an error when it is read.
///
/// # Errors
/// As [`open`].
pub fn open_any(inputs: &[String], options: &SourceOptions) -> Result<Opened, SourceError> {
    if let Some(spec) = inputs.iter().find(|input| input.starts_with("sim:")) {
        return open_simulation(spec, inputs.len(), options);
    }
    let paths = expand(inputs)?;
    if plot3d::is_plot3d(&paths, options) {
        return Ok(Opened::Mesh(Box::new(FileMesh::new(plot3d::open(&paths, options)?, options)?)));
    }
    let mut files = Vec::new();
    for path in paths {
        files.extend(open_files(&path, options)?);
    }
    join(files, options)
}

/// One file, opened.
pub(crate) enum OpenedFile {
    /// Samples on a uniform grid.
    Volume(Box<dyn VolumeFile>),
    /// Values at the points of a mesh.
    Mesh(Box<dyn MeshFile>),
}

impl OpenedFile {
    /// Its path.
    fn path(&self) -> &Path {
        match self {
            Self::Volume(file) => &file.header().path,
            Self::Mesh(file) => &file.header().path,
        }
    }
}

/// Joins files, at least one, to a series of volumes or of meshes.
fn join(files: Vec<OpenedFile>, options: &SourceOptions) -> Result<Opened, SourceError> {
    let kind = |file: &OpenedFile| match file {
        OpenedFile::Volume(_) => "a uniform grid",
        OpenedFile::Mesh(_) => "a mesh",
    };
    let first = kind(&files[0]);
    if let Some(other) = files.iter().find(|file| kind(file) != first) {
        let problem = format!("{} has {first}; all files of a series must agree", files[0].path().display());
        return Err(SourceError::corrupt(other.path(), "grid", kind(other), problem));
    }
    let (mut volumes, mut meshes) = (Vec::new(), Vec::new());
    for file in files {
        match file {
            OpenedFile::Volume(file) => volumes.push(file),
            OpenedFile::Mesh(file) => meshes.push(file),
        }
    }
    match meshes.is_empty() {
        true => Ok(Opened::Volume(Box::new(FileSeries::new(volumes, options)?))),
        false => Ok(Opened::Mesh(Box::new(FileMesh::new(meshes, options)?))),
    }
}

/// Opens a built-in simulation, which takes its settings in its name.
fn open_simulation(spec: &str, num_inputs: usize, options: &SourceOptions) -> Result<Opened, SourceError> {
    if num_inputs > 1 {
        return Err(SourceError::argument("SOURCE", spec, "a simulation cannot be joined with other inputs"));
    }
    let about_files = SourceOptions { variables: Vec::new(), memory_bytes: None, ..options.clone() };
    if about_files != SourceOptions::default() {
        let remedy = "a simulation takes its settings after its name, as in sim:plume?dims=64; leave out --dims, \
                      --dtype, --spacing and --dt";
        return Err(SourceError::argument("SOURCE", spec, remedy));
    }
    match crate::sim::open_any(spec)? {
        // A simulation that solves something has one variable.
        Opened::Volume(series) => {
            select_variables(series.variables(), &options.variables)?;
            Ok(Opened::Volume(series))
        }
        Opened::Mesh(mesh) => {
            let wanted = select_variables(mesh.variables(), &options.variables)?;
            Ok(Opened::Mesh(Box::new(SelectedMesh::new(mesh, wanted))))
        }
    }
}

/// Opens one path: a collection gives several files.
fn open_files(path: &Path, options: &SourceOptions) -> Result<Vec<OpenedFile>, SourceError> {
    match Format::of(path, options)? {
        Format::Pvd => pvd::open(path, options),
        other => Ok(vec![open_file(path, other, options)?]),
    }
}

/// Opens one file of a format that holds samples.
fn open_file(path: &Path, format: Format, options: &SourceOptions) -> Result<OpenedFile, SourceError> {
    if format != Format::Raw {
        options.check_describes_itself(path, format.name())?;
    }
    let volume = match format {
        Format::Raw => raw::open(path, options),
        Format::Npy => npy::open(path, options),
        Format::Nrrd => nrrd::open(path),
        Format::Vti => vti::open(path),
        Format::Zarr => zarr::open(path, options),
        Format::Vts => return vts::open(path).map(OpenedFile::Mesh),
        Format::Vtr => return vtr::open(path).map(OpenedFile::Mesh),
        Format::Vtu => return vtu::open(path).map(OpenedFile::Mesh),
        Format::Parallel => return vtk_pieces::open_parallel(path).map(OpenedFile::Mesh),
        Format::Vtk => return vtk_legacy::open(path),
        Format::Plot3d => {
            let remedy = "it takes its grid from another; name the grid and its solutions together, as in grid.xyz \
                          step1.q step2.q";
            Err(SourceError::unsupported(path, "a PLOT3D file", "alone", remedy))
        }
        Format::Pvd => {
            let remedy = "a collection cannot hold collections; name the files themselves";
            Err(SourceError::unsupported(path, "format", format.name(), remedy))
        }
    };
    volume.map(OpenedFile::Volume)
}

/// The paths that the inputs name.
fn expand(inputs: &[String]) -> Result<Vec<PathBuf>, SourceError> {
    let mut paths = Vec::new();
    for input in inputs {
        let path = Path::new(input);
        if input.contains(['*', '?', '[']) && std::fs::symlink_metadata(path).is_err() {
            paths.extend(matches(input)?);
        } else {
            paths.push(path.to_owned());
        }
    }
    if paths.is_empty() {
        return Err(SourceError::argument("SOURCE", "is missing", "name at least one file"));
    }
    Ok(paths)
}

/// The paths that a glob matches, in natural order.
fn matches(pattern: &str) -> Result<Vec<PathBuf>, SourceError> {
    let found = glob::glob(pattern)
        .map_err(|e| SourceError::argument("SOURCE", pattern, format!("the glob is wrong: {}", e.msg)))?;
    let mut paths = Vec::new();
    for path in found {
        paths.push(path.map_err(|e| SourceError::io(&PathBuf::from(e.path()), "list", e.into()))?);
    }
    if paths.is_empty() {
        return Err(SourceError::argument(
            "SOURCE",
            pattern,
            "no file matches; check the folder and the name",
        ));
    }
    paths.sort_by(|a, b| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
    Ok(paths)
}
