//! VTK meshes in several pieces: in one file, or in files of their own named by a parallel one (`.pvtu`, `.pvts`, `.pvtr`).
//!
//! Pieces of a lattice lie where their extents say, and together must cover the whole one. Pieces with cells of any kind are put one after
//! the other; their cells share points that lie at the same place, so that faces between pieces are split alike. Ghost cells, which several pieces have,
//! are left out and counted as duplicates.

use std::collections::HashMap;
use std::path::Path;

use chronoxel_core::Samples;
use xxhash_rust::xxh3::Xxh3Builder;

use super::mesh_files::{MeshFile, MeshShape, Topology, checked_points};
use super::volume_file::{FileHeader, FileTimes};
use super::vtk_arrays::{data_set, dims_of, encoding, numbers, pieces};
use super::vts::lattice_shape;
use super::xml::Document;
use super::{vtr, vts, vtu};
use crate::SourceError;
use crate::mesh::{Blanked, Block, Blocks, CellList, GridType};

/// The most pieces of a mesh.
const MAX_PIECES: usize = 1 << 16;

/// A piece of a mesh.
pub(crate) struct Piece {
    pub file: Box<dyn MeshFile>,
    /// Of a lattice: first and last index along x, y, z.
    pub extent: Option<[i64; 6]>,
}

/// Pieces as one mesh.
struct Joined {
    header: FileHeader<MeshShape>,
    pieces: Vec<Piece>,
    /// Per piece: where each variable is in it.
    variable_in_piece: Vec<Vec<usize>>,
    /// Of a lattice.
    whole: Option<[i64; 6]>,
}

/// Joins the pieces of a mesh.
///
/// * `whole`: the extent of a lattice
/// * `times`: those of the file, if they are not those of its first piece
pub(crate) fn join(
    path: &Path,
    mut pieces: Vec<Piece>,
    whole: Option<[i64; 6]>,
    times: Option<FileTimes>,
) -> Result<Box<dyn MeshFile>, SourceError> {
    if pieces.len() > MAX_PIECES {
        let remedy = format!("at most {MAX_PIECES} are; append some of them");
        return Err(SourceError::unsupported(path, "number of pieces", pieces.len(), remedy));
    }
    let Some(first) = pieces.first() else {
        return Err(SourceError::corrupt(path, "number of pieces with points", 0, "a mesh needs points"));
    };
    if pieces.len() == 1 && times.is_none() && (whole.is_none() || whole == first.extent) {
        return Ok(pieces.remove(0).file);
    }
    let first = first.file.header();
    let num_points: u64 = pieces.iter().map(|piece| piece.file.header().grid.num_points as u64).sum();
    let grid_type = first.grid.grid_type;
    let grid = match whole {
        Some(whole) => {
            let shape = lattice_shape(path, grid_type, dims_of(whole))?;
            if num_points < shape.num_points as u64 {
                let problem = format!("its pieces have {num_points} points; they must cover all of it");
                return Err(SourceError::corrupt(path, "WholeExtent", format!("{whole:?}"), problem));
            }
            shape
        }
        None => {
            let num_points = checked_points(path, "number of points of all pieces", num_points)?;
            let num_cells = pieces.iter().map(|piece| piece.file.header().grid.num_cells).sum();
            checked_points(path, "number of cells of all pieces", num_cells)?;
            MeshShape { grid_type, dims: None, num_points, num_cells }
        }
    };
    let variable_in_piece =
        pieces.iter().map(|piece| same_variables(first, piece.file.header())).collect::<Result<_, _>>()?;
    let header = FileHeader {
        path: path.to_owned(),
        grid,
        variables: first.variables.clone(),
        num_steps: 1,
        times: times.unwrap_or_else(|| first.times.clone()),
        time_units: String::new(),
    };
    Ok(Box::new(Joined { header, pieces, variable_in_piece, whole }))
}

/// Where the variables of the first piece are in another.
fn same_variables(
    first: &FileHeader<MeshShape>,
    piece: &FileHeader<MeshShape>,
) -> Result<Vec<usize>, SourceError> {
    let place = |wanted: &crate::Variable| {
        let same = |v: &crate::Variable| v.name == wanted.name && v.sample_type == wanted.sample_type;
        piece.variables.iter().position(same).ok_or_else(|| {
            let field = format!("array {:?} of type {}", wanted.name, wanted.sample_type);
            let problem = format!(
                "the first piece, in {}, has it; all pieces must have the same arrays",
                first.path.display()
            );
            SourceError::corrupt(&piece.path, field, "missing in a piece", problem)
        })
    };
    first.variables.iter().map(place).collect()
}

/// Opens a file that names the files of its pieces.
pub(crate) fn open_parallel(path: &Path) -> Result<Box<dyn MeshFile>, SourceError> {
    let document = Document::read(path)?;
    let of_type = |name: &str| document.root(name).is_ok();
    let [parallel, grid_type] = [
        ["PUnstructuredGrid", "UnstructuredGrid"],
        ["PStructuredGrid", "StructuredGrid"],
        ["PRectilinearGrid", "RectilinearGrid"],
    ]
    .into_iter()
    .find(|[parallel, _]| of_type(parallel))
    .unwrap_or(["PUnstructuredGrid", ""]);
    document.root(parallel)?;
    let (index, element) = super::vtk_arrays::data_set(&document, parallel)?;
    let whole = match grid_type {
        "UnstructuredGrid" => None,
        _ => Some(numbers::<i64, 6>(path, element, "WholeExtent", None)?),
    };
    let mut pieces = Vec::new();
    for (_, piece) in document.children(index, "Piece") {
        let source = piece.get("Source").filter(|source| !source.is_empty()).ok_or_else(|| {
            SourceError::corrupt(path, "Source of a piece", "missing", "every piece must name its file")
        })?;
        let source = path.parent().unwrap_or(Path::new("")).join(source);
        pieces.extend(match grid_type {
            "UnstructuredGrid" => vtu::open_pieces(&source)?,
            "StructuredGrid" => vts::open_pieces(&source)?.0,
            _ => vtr::open_pieces(&source)?.0,
        });
        if pieces.len() > MAX_PIECES {
            break;
        }
    }
    join(path, pieces, whole, None)
}

/// Opens the pieces of a lattice in one file that have points; also gives the extent that they are of.
///
/// * `grid_type`: what the root and its child are called
/// * `open`: opens a piece, from the numbers of the elements of the data set and of the piece, and its extent
pub(crate) fn lattice_pieces<F: MeshFile + 'static>(
    path: &Path,
    grid_type: &str,
    open: impl Fn(&Document, usize, usize, [i64; 6]) -> Result<F, SourceError>,
) -> Result<(Vec<Piece>, [i64; 6]), SourceError> {
    let document = Document::read(path)?;
    encoding(&document, grid_type)?;
    let (index, element) = data_set(&document, grid_type)?;
    let whole = numbers::<i64, 6>(path, element, "WholeExtent", None)?;
    let mut opened = Vec::new();
    for (piece, of_piece) in pieces(&document, (index, element))? {
        let extent = numbers::<i64, 6>(path, of_piece, "Extent", Some(whole))?;
        if dims_of(extent).contains(&0) {
            continue;
        }
        if !(0..3).all(|a| whole[2 * a] <= extent[2 * a] && extent[2 * a + 1] <= whole[2 * a + 1]) {
            let problem = format!("it reaches beyond the WholeExtent, {whole:?}");
            return Err(SourceError::corrupt(path, "Extent of a piece", format!("{extent:?}"), problem));
        }
        let file = open(&document, index, piece, extent)?;
        opened.push(Piece { file: Box::new(file), extent: Some(extent) });
    }
    Ok((opened, whole))
}

/// Runs of a part of a lattice: the first element in it, the first in the whole, and how many there are along x.
fn runs(
    part: [i64; 6],
    whole: [i64; 6],
    size: impl Fn([i64; 6]) -> [usize; 3],
) -> impl Iterator<Item = (usize, usize, usize)> {
    let ([nx, ny, nz], [wx, wy, _]) = (size(part), size(whole));
    let shift = [0, 1, 2].map(|a| (part[2 * a] - whole[2 * a]) as usize);
    (0..nz).flat_map(move |k| {
        (0..ny).map(move |j| {
            let to = shift[0] + wx * (shift[1] + j + wy * (shift[2] + k));
            (nx * (j + ny * k), to, nx)
        })
    })
}

/// Cells along x, y, z of an extent.
fn cells_of(extent: [i64; 6]) -> [usize; 3] {
    dims_of(extent).map(|n| n.saturating_sub(1))
}

impl Joined {
    fn path(&self) -> &Path {
        &self.header.path
    }

    /// Puts what pieces have together.
    fn together<T: Copy>(
        &self,
        missing: T,
        of_piece: impl Fn(usize) -> Result<Vec<T>, SourceError>,
    ) -> Result<Vec<T>, SourceError> {
        let Some(whole) = self.whole else {
            let mut all = Vec::new();
            for piece in 0..self.pieces.len() {
                all.extend(of_piece(piece)?);
            }
            return Ok(all);
        };
        let mut all = vec![missing; self.header.grid.num_points];
        for (number, piece) in self.pieces.iter().enumerate() {
            let values = of_piece(number)?;
            let extent = self.extent_in(piece, whole)?;
            for (from, to, len) in runs(extent, whole, dims_of) {
                all[to..to + len].copy_from_slice(&values[from..from + len]);
            }
        }
        Ok(all)
    }

    /// The extent of a piece of a lattice, which must lie in the whole one.
    fn extent_in(&self, piece: &Piece, whole: [i64; 6]) -> Result<[i64; 6], SourceError> {
        let extent = piece.extent.unwrap_or(whole);
        match (0..3).all(|a| whole[2 * a] <= extent[2 * a] && extent[2 * a + 1] <= whole[2 * a + 1]) {
            true => Ok(extent),
            false => {
                let problem = format!("{} has a WholeExtent of {whole:?}", self.path().display());
                let path = &piece.file.header().path;
                Err(SourceError::corrupt(path, "Extent of a piece", format!("{extent:?}"), problem))
            }
        }
    }

    /// The lattice, with what pieces hide and no other shows.
    fn lattice(&self, whole: [i64; 6]) -> Result<Topology, SourceError> {
        let dims = dims_of(whole);
        let num_cells = cells_of(whole).iter().product::<usize>();
        let mut hidden = [vec![false; dims.iter().product()], vec![false; num_cells]];
        let mut shown = hidden.clone();
        for piece in &self.pieces {
            let Topology::Blocks(Blocks { blanked, .. }) = piece.file.topology()? else { continue };
            let extent = self.extent_in(piece, whole)?;
            for (which, flags) in [&blanked.points, &blanked.cells].into_iter().enumerate() {
                for (from, to, len) in runs(extent, whole, [dims_of, cells_of][which]) {
                    for i in 0..len {
                        match flags.get(from + i) {
                            Some(true) => hidden[which][to + i] = true,
                            _ => shown[which][to + i] = true,
                        }
                    }
                }
            }
        }
        let [points, cells] = [0, 1].map(|which| {
            hidden[which].iter().zip(&shown[which]).map(|(hidden, shown)| *hidden && !*shown).collect()
        });
        let blocks = vec![Block { dims, first_point: 0, is_exchanged: false }];
        Ok(Topology::Blocks(Blocks { blocks, blanked: Blanked::new(points, cells) }))
    }

    /// All cells, by the first of the points that lie at the same place in several pieces.
    fn cells(&self) -> Result<Topology, SourceError> {
        let mut all = CellList::default();
        // The first point at each place, of the pieces so far.
        let mut known: HashMap<[u64; 3], u32, Xxh3Builder> = HashMap::default();
        let mut first = 0u32;
        for (number, piece) in self.pieces.iter().enumerate() {
            let path = &piece.file.header().path;
            let Topology::Cells(cells) = piece.file.topology()? else { continue };
            // Zeros of both signs lie at one place.
            let key = |point: &[f64; 3]| point.map(|v| (v + 0.0).to_bits());
            let points = piece.file.points()?;
            let same: Vec<u32> = (first..)
                .zip(&points)
                .map(|(own, point)| known.get(&key(point)).copied().unwrap_or(own))
                .collect();
            all.append(path, &cells, &same)?;
            if number + 1 < self.pieces.len() {
                for (own, point) in (first..).zip(&points) {
                    known.entry(key(point)).or_insert(own);
                }
            }
            first += points.len() as u32;
        }
        Ok(Topology::Cells(all))
    }
}

impl MeshFile for Joined {
    fn header(&self) -> &FileHeader<MeshShape> {
        &self.header
    }

    fn points(&self) -> Result<Vec<[f64; 3]>, SourceError> {
        let points = self.together([f64::NAN; 3], |piece| self.pieces[piece].file.points())?;
        if let Some(whole) = self.whole {
            let mut is_covered = vec![false; points.len()];
            for piece in &self.pieces {
                for (_, to, len) in runs(self.extent_in(piece, whole)?, whole, dims_of) {
                    is_covered[to..to + len].fill(true);
                }
            }
            if let Some(point) = is_covered.iter().position(|is_covered| !is_covered) {
                let [nx, ny, _] = dims_of(whole);
                let place = [point % nx, point / nx % ny, point / (nx * ny)];
                let problem = "its pieces must cover all of its WholeExtent; some are missing";
                return Err(SourceError::corrupt(
                    self.path(),
                    format!("point {place:?}"),
                    "in no piece",
                    problem,
                ));
            }
        }
        Ok(points)
    }

    fn topology(&self) -> Result<Topology, SourceError> {
        match self.whole {
            Some(whole) => self.lattice(whole),
            None => self.cells(),
        }
    }

    fn read_values(&self, variable: usize) -> Result<Samples, SourceError> {
        let read =
            |piece: usize| self.pieces[piece].file.read_values(self.variable_in_piece[piece][variable]);
        let other = |piece: usize| {
            let path = &self.pieces[piece].file.header().path;
            SourceError::corrupt(path, "array type", "another", "all pieces must have the same arrays")
        };
        match read(0)? {
            Samples::F32(_) => {
                let of_piece = |piece| match read(piece)? {
                    Samples::F32(values) => Ok(values),
                    Samples::F64(_) => Err(other(piece)),
                };
                Ok(Samples::F32(self.together(f32::NAN, of_piece)?))
            }
            Samples::F64(_) => {
                let of_piece = |piece| match read(piece)? {
                    Samples::F64(values) => Ok(values),
                    Samples::F32(_) => Err(other(piece)),
                };
                Ok(Samples::F64(self.together(f64::NAN, of_piece)?))
            }
        }
    }

    fn notes(&self) -> Result<Vec<String>, SourceError> {
        let joined = match self.header.grid.grid_type {
            GridType::Unstructured => ", joined where their points lie at the same places",
            _ => "",
        };
        Ok(vec![format!("it has {} pieces{joined}", self.pieces.len())])
    }
}
