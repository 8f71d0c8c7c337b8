//! PLOT3D: a grid file with positions, and solution files with the flow at them, one time step each.
//!
//! Specification: Walatka et al., "PLOT3D User's Manual", NASA TM 101067, 1990, chapter 8; binary, 3-D, whole format, one block or several
//! (see [`super::plot3d_layout`] for the forms). The grid is named together with its solutions, in any place:
//! `grid.xyz step1.q step2.q`. Files are known to be PLOT3D by the extensions `.x`, `.xyz`, `.g`, `.grd`, `.p3d` and `.q`; under `.bin`, `.dat` and `.raw` they
//! are where `--dims` is not given and one of them is a grid.
//!
//! Variables are `density`, `momentum_x`, `momentum_y`, `momentum_z`, `momentum_magnitude` and `energy` (stagnation energy per volume). The time of a step is that
//! in the header of its file. Points with an IBLANK of 0 are blanked; other values are not (a negative one names another block, 2 is a wall). Blocks become one set of points, one
//! after the other; where two of them touch or overlap, each has cells of its own.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use chronoxel_core::{SampleType, Samples};

use super::SourceOptions;
use super::mesh_files::{MeshFile, MeshShape, Topology};
use super::plot3d_layout::{Content, Layout, NUM_CONDITIONS};
use super::samples::{SampleFormat, SliceReader};
use super::volume_file::{FileHeader, FileTimes, dims_text, open_at};
use crate::mesh::{Blanked, Block, Blocks, GridType};
use crate::{SourceError, StepReader, Variable};

/// Extensions that stand for PLOT3D alone.
const OWN_EXTENSIONS: [&str; 6] = ["x", "xyz", "g", "grd", "p3d", "q"];

/// Extensions of any raw bytes, PLOT3D files among them.
const RAW_EXTENSIONS: [&str; 3] = ["bin", "dat", "raw"];

/// The variables, in the order of their names here.
const VARIABLES: [(&str, Flow); 6] = [
    ("density", Flow::Component(0)),
    ("momentum_x", Flow::Component(1)),
    ("momentum_y", Flow::Component(2)),
    ("momentum_z", Flow::Component(3)),
    ("momentum_magnitude", Flow::MomentumMagnitude),
    ("energy", Flow::Component(4)),
];

/// How a variable comes from the numbers of a file.
#[derive(Clone, Copy)]
enum Flow {
    Component(u64),
    MomentumMagnitude,
}

/// One solution file, and the grid that all solutions share.
struct SolutionFile {
    header: FileHeader<MeshShape>,
    grid: Arc<Layout>,
    layout: Layout,
}

/// Whether files are PLOT3D, by their extensions and what one of them holds.
pub(crate) fn is_plot3d(paths: &[PathBuf], options: &SourceOptions) -> bool {
    let is_one_of = |path: &PathBuf, extensions: &[&str]| {
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        extensions.contains(&extension.as_str())
    };
    if options.dims.is_some()
        || !paths.iter().all(|p| is_one_of(p, &OWN_EXTENSIONS) || is_one_of(p, &RAW_EXTENSIONS))
    {
        return false;
    }
    paths.iter().any(|p| is_one_of(p, &OWN_EXTENSIONS))
        || paths.iter().any(|p| Layout::find(p, Content::Grid, options).is_ok())
}

/// Opens a grid and its solutions.
pub(crate) fn open(
    paths: &[PathBuf],
    options: &SourceOptions,
) -> Result<Vec<Box<dyn MeshFile>>, SourceError> {
    if options.header_bytes > 0 {
        let remedy = "PLOT3D files begin with their dimensions; leave it out";
        return Err(SourceError::argument("--header-bytes", options.header_bytes, remedy));
    }
    let (grid_path, grid) = find_grid(paths, options)?;
    let grid = Arc::new(grid);
    let solutions: Vec<&PathBuf> = paths.iter().filter(|path| *path != grid_path).collect();
    if solutions.is_empty() {
        let remedy = "it holds positions alone; name its solution files too, as in grid.xyz step1.q step2.q";
        return Err(SourceError::unsupported(grid_path, "a PLOT3D grid", "alone", remedy));
    }
    solutions.into_iter().map(|path| open_solution(path, &grid, options)).collect()
}

/// The one grid among the files.
fn find_grid<'a>(
    paths: &'a [PathBuf],
    options: &SourceOptions,
) -> Result<(&'a PathBuf, Layout), SourceError> {
    let mut found: Option<(&PathBuf, Layout)> = None;
    let mut first_error = None;
    for path in paths {
        match Layout::find(path, Content::Grid, options) {
            Ok(layout) => {
                if let Some((other, _)) = &found {
                    let remedy =
                        format!("{} is one too; name one grid, which stays the same", other.display());
                    return Err(SourceError::unsupported(path, "a second PLOT3D grid", "given", remedy));
                }
                found = Some((path, layout));
            }
            Err(error) => first_error = first_error.or(Some(error)),
        }
    }
    match (found, first_error) {
        (Some(found), _) => Ok(found),
        (None, Some(error)) => Err(error),
        (None, None) => Err(SourceError::argument("SOURCE", "is missing", "name at least one file")),
    }
}

/// Opens a solution, which must be for the points of the grid.
fn open_solution(
    path: &Path,
    grid: &Arc<Layout>,
    options: &SourceOptions,
) -> Result<Box<dyn MeshFile>, SourceError> {
    let layout = Layout::find(path, Content::Solution, options)?;
    if layout.blocks != grid.blocks {
        let differs =
            (0..layout.blocks.len().min(grid.blocks.len())).find(|&b| layout.blocks[b] != grid.blocks[b]);
        let problem = |theirs: String| format!("the grid {} has {theirs}", grid.path.display());
        return Err(match differs {
            Some(block) => SourceError::corrupt(
                path,
                format!("dimensions of block {block}"),
                dims_text(layout.blocks[block]),
                problem(dims_text(grid.blocks[block])),
            ),
            None => SourceError::corrupt(
                path,
                "number of blocks",
                layout.blocks.len(),
                problem(grid.blocks.len().to_string()),
            ),
        });
    }
    let num_points: u64 = (0..grid.blocks.len()).map(|block| grid.num_points(block)).sum();
    let num_cells = grid.blocks.iter().map(|dims| dims.iter().map(|n| n - 1).product::<usize>() as u64).sum();
    let shape = MeshShape {
        grid_type: GridType::Curvilinear,
        dims: (grid.blocks.len() == 1).then(|| grid.blocks[0]),
        num_points: num_points as usize,
        num_cells,
    };
    let variable = |(name, _): &(&str, Flow)| Variable {
        name: (*name).to_owned(),
        units: String::new(),
        sample_type: layout.sample_type,
        fill_value: None,
    };
    let time = time_of(&layout)?;
    let header = FileHeader {
        path: path.to_owned(),
        grid: shape,
        variables: VARIABLES.iter().map(variable).collect(),
        num_steps: 1,
        times: FileTimes::Known(vec![time]),
        time_units: String::new(),
    };
    Ok(Box::new(SolutionFile { header, grid: grid.clone(), layout }))
}

/// The time in the header of a solution's first block.
fn time_of(layout: &Layout) -> Result<f64, SourceError> {
    let width = layout.sample_type.num_bytes() as u64;
    let marks = if layout.has_records { 8 } else { 0 };
    let start = layout.starts[0] - marks - NUM_CONDITIONS * width;
    let time = read_run(layout, "time", layout.sample_type, start + 3 * width, 1)?;
    Ok(time.get(0))
}

/// Numbers that lie side by side in a file.
fn read_run(
    layout: &Layout,
    field: &str,
    sample_type: SampleType,
    start: u64,
    count: u64,
) -> Result<Samples, SourceError> {
    let mut reader = SliceReader {
        input: open_at(&layout.path, start)?,
        path: layout.path.clone(),
        field: field.to_owned(),
        format: SampleFormat::scalar(sample_type, layout.big_endian),
        slice_samples: 1,
    };
    reader.read_slices(count as usize)
}

/// One number of every point of all blocks, the numbers of a block lying one after the other.
fn read_component(layout: &Layout, field: &str, component: u64) -> Result<Samples, SourceError> {
    let width = layout.sample_type.num_bytes() as u64;
    let mut all: Option<Samples> = None;
    for (block, start) in layout.starts.iter().enumerate() {
        let count = layout.num_points(block);
        let run = read_run(layout, field, layout.sample_type, start + component * count * width, count)?;
        all = Some(match (all, run) {
            (Some(Samples::F32(mut all)), Samples::F32(run)) => {
                all.extend(run);
                Samples::F32(all)
            }
            (Some(Samples::F64(mut all)), Samples::F64(run)) => {
                all.extend(run);
                Samples::F64(all)
            }
            (_, run) => run,
        });
    }
    Ok(all.expect("a grid has blocks"))
}

impl MeshFile for SolutionFile {
    fn header(&self) -> &FileHeader<MeshShape> {
        &self.header
    }

    fn shares_geometry(&self) -> bool {
        true
    }

    fn points(&self) -> Result<Vec<[f64; 3]>, SourceError> {
        let mut points = vec![[0.0; 3]; self.header.grid.num_points];
        for (axis, name) in ["x", "y", "z"].into_iter().enumerate() {
            let values = read_component(&self.grid, name, axis as u64)?;
            points.iter_mut().enumerate().for_each(|(index, point)| point[axis] = values.get(index));
        }
        Ok(points)
    }

    fn topology(&self) -> Result<Topology, SourceError> {
        let grid = &self.grid;
        let mut blocks = Vec::with_capacity(grid.blocks.len());
        let mut blanked = Vec::new();
        let mut first_point = 0;
        for (block, &dims) in grid.blocks.iter().enumerate() {
            blocks.push(Block { dims, first_point, is_exchanged: false });
            let count = grid.num_points(block);
            first_point += count as usize;
            if grid.has_iblank {
                let start = grid.starts[block] + 3 * count * grid.sample_type.num_bytes() as u64;
                let flags = read_run(grid, "IBLANK", SampleType::I32, start, count)?;
                blanked.extend((0..flags.len()).map(|index| flags.get(index) == 0.0));
            }
        }
        let blanked = Blanked::new(blanked, Vec::new());
        Ok(Topology::Blocks(Blocks { blocks, blanked }))
    }

    fn read_values(&self, variable: usize) -> Result<Samples, SourceError> {
        let component = |index| read_component(&self.layout, VARIABLES[variable].0, index);
        let momentum = match VARIABLES[variable].1 {
            Flow::Component(index) => return component(index),
            Flow::MomentumMagnitude => [component(1)?, component(2)?, component(3)?],
        };
        let [x, y, z] = &momentum;
        let magnitude = |index| {
            let [x, y, z] = [x, y, z].map(|samples| samples.get(index));
            (x * x + y * y + z * z).sqrt()
        };
        Ok(match self.layout.sample_type.fits_f32() {
            true => Samples::F32((0..x.len()).map(|index| magnitude(index) as f32).collect()),
            false => Samples::F64((0..x.len()).map(magnitude).collect()),
        })
    }

    fn notes(&self) -> Result<Vec<String>, SourceError> {
        Ok(match self.grid.blocks.len() {
            1 => Vec::new(),
            n => vec![format!("{n} blocks; where they touch or overlap, each has cells of its own")],
        })
    }
}
