//! One mesh series from one or many files: the same geometry and variables in all, times in increasing order.

use std::path::Path;

use chronoxel_core::{Samples, TimeAxis};
use xxhash_rust::xxh3::Xxh3;

use super::SourceOptions;
use super::file_series::{check_same_variables, named_variables, select_variables, time_axis};
use super::volume_file::{FileHeader, checked_steps, dims_text};
use super::vtk_arrays::Array;
use crate::mesh::{
    Blanked, Block, Blocks, CellList, CheckedCells, DEFAULT_FLAT_THRESHOLD, GridType, MAX_POINTS, MeshCensus,
    MeshSeries, VisitTetrahedron, check_points,
};
use crate::{SourceError, Variable};

/// What the header of a file says about its grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct MeshShape {
    pub grid_type: GridType,
    /// Of one structured block.
    pub dims: Option<[usize; 3]>,
    pub num_points: usize,
    /// Cells as the header counts them.
    pub num_cells: u64,
}

/// What lies between the points of a file.
pub(crate) enum Topology {
    Blocks(Blocks),
    /// Not compared with the points or with each other yet.
    Cells(CellList),
}

/// One file with the values of one step, and with the geometry or the way to it.
pub(crate) trait MeshFile: Send {
    /// What its header says; it has one step.
    fn header(&self) -> &FileHeader<MeshShape>;

    /// Whether the geometry is not this file's own, but one that all files of the series share.
    fn shares_geometry(&self) -> bool {
        false
    }

    /// Positions of the points, as they are in the file.
    fn points(&self) -> Result<Vec<[f64; 3]>, SourceError>;

    /// What lies between them.
    fn topology(&self) -> Result<Topology, SourceError>;

    /// The values of a variable.
    fn read_values(&self, variable: usize) -> Result<Samples, SourceError>;

    /// As [`MeshSeries::notes`].
    fn notes(&self) -> Result<Vec<String>, SourceError> {
        Ok(Vec::new())
    }
}

/// A number that is another one for another geometry.
fn digest(points: &[[f64; 3]], topology: &Topology) -> u128 {
    let mut hash = Xxh3::new();
    hash.update(bytemuck::cast_slice(points));
    match topology {
        Topology::Blocks(blocks) => {
            for block in &blocks.blocks {
                block.dims.iter().for_each(|n| hash.update(&n.to_le_bytes()));
            }
            let blanked = blocks.blanked.points.iter().chain(&blocks.blanked.cells);
            blanked.for_each(|is_blanked| hash.update(&[u8::from(*is_blanked)]));
        }
        Topology::Cells(cells) => {
            for (kind, corners) in cells.iter() {
                hash.update(&[kind as u8]);
                hash.update(bytemuck::cast_slice(corners));
            }
        }
    }
    hash.digest128()
}

/// What is different in a later step's points.
fn difference(first: &[[f64; 3]], later: &[[f64; 3]]) -> String {
    match first.iter().zip(later).position(|(a, b)| a != b) {
        Some(point) => {
            let ([x, y, z], [a, b, c]) = (later[point], first[point]);
            format!("point {point} lies at ({x}, {y}, {z}) where it was at ({a}, {b}, {c})")
        }
        None => "the points are the same, but not the cells".to_owned(),
    }
}

/// Points and what lies between them, ready to be walked.
struct Geometry {
    points: Vec<[f64; 3]>,
    cells: Walkable,
}

/// What lies between points, compared with them.
enum Walkable {
    Blocks(Blocks),
    Cells(CheckedCells),
}

impl Geometry {
    /// Reads the geometry of a file.
    fn read(file: &dyn MeshFile) -> Result<Self, SourceError> {
        let path = &file.header().path;
        let points = file.points()?;
        check_points(path, 0, &points)?;
        let cells = match file.topology()? {
            Topology::Blocks(mut blocks) => {
                blocks.match_colours(&points);
                Walkable::Blocks(blocks)
            }
            Topology::Cells(list) => Walkable::Cells(CheckedCells::new(path, list, points.len())?),
        };
        Ok(Self { points, cells })
    }

    /// The most bytes held while it is read and afterwards.
    fn most_bytes(&self) -> u64 {
        let topology = match &self.cells {
            Walkable::Blocks(blocks) => (blocks.blanked.points.len() + blocks.blanked.cells.len()) as u64,
            Walkable::Cells(cells) => cells.most_bytes(self.points.len()),
        };
        // While points are read, their numbers lie beside them as the file has them.
        let point_bytes = (size_of::<[f64; 3]>() * self.points.len()) as u64;
        point_bytes + topology.max(point_bytes)
    }
}

/// Files one after the other in time.
pub(crate) struct FileMesh {
    files: Vec<Box<dyn MeshFile>>,
    times: TimeAxis,
    variables: Vec<Variable>,
    /// Per file: where each variable of the series is in it.
    variable_in_file: Vec<Vec<usize>>,
    flat_threshold: f64,
    /// The geometry of the first file, from when it is read until values are.
    geometry: Option<Geometry>,
    /// Its digest, known when the geometry of a second file was compared with it.
    digest: Option<u128>,
    /// Per file: whether its geometry is known to be that of the first.
    is_compared: Vec<bool>,
    geometry_bytes: u64,
    notes: Vec<String>,
}

impl FileMesh {
    /// Joins files whose headers were read; there is at least one.
    ///
    /// The geometry of the first is read, so that what is wrong with it is known before anything else is done.
    pub fn new(files: Vec<Box<dyn MeshFile>>, options: &SourceOptions) -> Result<Self, SourceError> {
        refuse_placement(options)?;
        let first = files[0].header();
        let all_variables = named_variables(first, files.len() > 1);
        let wanted = select_variables(&all_variables, &options.variables)?;
        let mut variable_in_file = Vec::with_capacity(files.len());
        for file in &files {
            check_same_shape(first, file.header())?;
            let places = check_same_variables(first, file.header())?;
            variable_in_file.push(wanted.iter().map(|&v| places[v]).collect());
        }
        checked_steps(&first.path, "number of time steps", files.len())?;
        let mut variables: Vec<Variable> = wanted.iter().map(|&v| all_variables[v].clone()).collect();
        if let Some(fill) = options.fill_value {
            variables.iter_mut().for_each(|v| v.fill_value = Some(fill));
        }
        let headers: Vec<&FileHeader<MeshShape>> = files.iter().map(|file| file.header()).collect();
        let times = time_axis(&headers, options)?;
        let flat_threshold = options.flat_threshold.unwrap_or(DEFAULT_FLAT_THRESHOLD);
        if !(0.0..1.0).contains(&flat_threshold) {
            let remedy = "give a share of the cubed longest edge, from 0 to below 1";
            return Err(SourceError::argument("--flat-threshold", flat_threshold, remedy));
        }
        let geometry = Geometry::read(files[0].as_ref())?;
        let geometry_bytes = geometry.most_bytes();
        let is_compared =
            files.iter().enumerate().map(|(i, file)| i == 0 || file.shares_geometry()).collect();
        let notes = files[0].notes()?;
        let (geometry, digest) = (Some(geometry), None);
        Ok(Self {
            files,
            times,
            variables,
            variable_in_file,
            flat_threshold,
            geometry,
            digest,
            is_compared,
            geometry_bytes,
            notes,
        })
    }

    /// The geometry of the first file.
    fn geometry(&mut self) -> Result<&Geometry, SourceError> {
        if self.geometry.is_none() {
            self.geometry = Some(Geometry::read(self.files[0].as_ref())?);
        }
        Ok(self.geometry.as_ref().expect("it was read"))
    }

    /// Holds the geometry of a file against that of the first, once.
    fn compare_geometry(&mut self, step: usize) -> Result<(), SourceError> {
        if self.is_compared[step] {
            return Ok(());
        }
        let of_file = |file: &dyn MeshFile| Ok::<_, SourceError>(digest(&file.points()?, &file.topology()?));
        let expected = match self.digest {
            Some(digest) => digest,
            None => *self.digest.insert(of_file(self.files[0].as_ref())?),
        };
        if of_file(self.files[step].as_ref())? == expected {
            self.is_compared[step] = true;
            return Ok(());
        }
        let problem = format!(
            "{}, by step 0 in {}; meshes that stay the same over all steps are read",
            difference(&self.files[0].points()?, &self.files[step].points()?),
            self.files[0].header().path.display()
        );
        Err(SourceError::corrupt(
            &self.files[step].header().path,
            format!("geometry of step {step}"),
            "another",
            problem,
        ))
    }
}

/// Refuses options that place a uniform grid, for a mesh that lies where it is.
fn refuse_placement(options: &SourceOptions) -> Result<(), SourceError> {
    let given = [(options.spacing.is_some(), "--spacing"), (options.origin.is_some(), "--origin")];
    match given.into_iter().find(|(is_given, _)| *is_given) {
        Some((_, option)) => Err(SourceError::argument(
            option,
            "is given",
            "the points of a mesh have positions; leave it out",
        )),
        None => Ok(()),
    }
}

/// Every file of a series has as many points and cells as the first.
fn check_same_shape(
    first: &FileHeader<MeshShape>,
    header: &FileHeader<MeshShape>,
) -> Result<(), SourceError> {
    let shown = |shape: &MeshShape| match shape.dims {
        Some(dims) => format!("{} {}", shape.grid_type.name(), dims_text(dims)),
        None => {
            format!("{}, {} points, {} cells", shape.grid_type.name(), shape.num_points, shape.num_cells)
        }
    };
    if header.grid == first.grid {
        return Ok(());
    }
    let problem = format!(
        "{} has {}; meshes that stay the same over all steps are read",
        first.path.display(),
        shown(&first.grid)
    );
    Err(SourceError::corrupt(&header.path, "grid", shown(&header.grid), problem))
}

/// A number of points from a file, where they can be numbered with 32 bits.
pub(crate) fn checked_points(path: &Path, field: &str, num_points: u64) -> Result<usize, SourceError> {
    match num_points {
        0 => Err(SourceError::corrupt(path, field, 0, "a mesh needs points")),
        n if n > MAX_POINTS => {
            Err(SourceError::unsupported(path, field, n, format!("at most {MAX_POINTS} points are")))
        }
        n => Ok(n as usize),
    }
}

/// One structured block; what its flags of points and cells hide is left out.
pub(crate) fn lattice(
    path: &Path,
    dims: [usize; 3],
    [points, cells]: [Option<&Array>; 2],
) -> Result<Topology, SourceError> {
    let hidden = |flags: Option<&Array>, bit: u32| match flags {
        Some(flags) => {
            let read = flags.read_all(path)?;
            Ok((0..read.len()).map(|index| read.get(index) as u32 & bit != 0).collect())
        }
        None => Ok(Vec::new()),
    };
    let blanked = Blanked::new(hidden(points, HIDDEN_POINT)?, hidden(cells, HIDDEN_CELL)?);
    Ok(Topology::Blocks(Blocks {
        blocks: vec![Block { dims, first_point: 0, is_exchanged: false }],
        blanked,
    }))
}

/// The flag of points without data in VTK's array of ghosts.
const HIDDEN_POINT: u32 = 2;

/// The flag of cells without data there.
const HIDDEN_CELL: u32 = 32;

/// Triples of numbers as points.
pub(crate) fn points_of(numbers: &Samples) -> Vec<[f64; 3]> {
    match numbers {
        Samples::F32(v) => v.chunks_exact(3).map(|p| [p[0], p[1], p[2]].map(f64::from)).collect(),
        Samples::F64(v) => v.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect(),
    }
}

impl MeshSeries for FileMesh {
    fn grid_type(&self) -> GridType {
        self.files[0].header().grid.grid_type
    }

    fn dims(&self) -> Option<[usize; 3]> {
        self.files[0].header().grid.dims
    }

    fn num_points(&self) -> usize {
        self.files[0].header().grid.num_points
    }

    fn times(&self) -> &TimeAxis {
        &self.times
    }

    fn variables(&self) -> &[Variable] {
        &self.variables
    }

    fn points(&mut self) -> Result<Vec<[f64; 3]>, SourceError> {
        Ok(self.geometry()?.points.clone())
    }

    fn for_each_tetrahedron(&mut self, visit: &mut VisitTetrahedron<'_>) -> Result<MeshCensus, SourceError> {
        let flat_threshold = self.flat_threshold;
        self.geometry()?;
        let Geometry { points, cells } = self.geometry.as_ref().expect("it was read");
        let path = &self.files[0].header().path;
        match cells {
            Walkable::Blocks(blocks) => blocks.for_each_tetrahedron(path, points, flat_threshold, visit),
            Walkable::Cells(cells) => cells.for_each_tetrahedron(path, points, flat_threshold, visit),
        }
    }

    fn read_values(&mut self, variable: usize, step: usize) -> Result<Samples, SourceError> {
        // Whoever reads values is done with the geometry; it is read again otherwise.
        self.geometry = None;
        self.compare_geometry(step)?;
        let mut values = self.files[step].read_values(self.variable_in_file[step][variable])?;
        if let Some(fill) = self.variables[variable].fill_value {
            match &mut values {
                Samples::F32(v) => {
                    v.iter_mut().filter(|x| f64::from(**x) == fill).for_each(|x| *x = f32::NAN)
                }
                Samples::F64(v) => v.iter_mut().filter(|x| **x == fill).for_each(|x| *x = f64::NAN),
            }
        }
        Ok(values)
    }

    fn working_bytes(&self) -> u64 {
        self.geometry_bytes
    }

    fn notes(&self) -> Vec<String> {
        self.notes.clone()
    }
}
