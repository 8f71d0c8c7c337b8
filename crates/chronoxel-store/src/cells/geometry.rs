//! Points and tetrahedra: two plain arrays in chunks.

use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::Xxh3;

use super::{
    CellHeader,
    arrays::{GEOMETRY_ZSTD_LEVEL, GeometryArray},
    header::GeometrySummary,
};
use crate::{StoreError, chunk, files};

/// The points of a mesh and its tetrahedra.
#[derive(Debug, Clone, PartialEq)]
pub struct CellGeometry {
    /// Positions in the world, all finite.
    pub points: Vec<[f64; 3]>,
    /// Corners of each tetrahedron, as indices of points.
    pub tetrahedra: Vec<[u32; 4]>,
}

impl CellGeometry {
    /// What the header says of it.
    pub(crate) fn summary(&self) -> Result<GeometrySummary, StoreError> {
        if let Some(point) = self.points.iter().position(|p| p.iter().any(|x| !x.is_finite())) {
            let value = format!("{:?}", self.points[point]);
            return Err(StoreError::invalid("point", value, "coordinates must be finite"));
        }
        let num_points = self.points.len() as u64;
        let outside = |t: &&[u32; 4]| t.iter().any(|&corner| u64::from(corner) >= num_points);
        if let Some(tetrahedron) = self.tetrahedra.iter().find(outside) {
            let remedy = format!("there are {num_points} points");
            return Err(StoreError::invalid("tetrahedron", format!("{tetrahedron:?}"), remedy));
        }
        Ok(GeometrySummary {
            num_points,
            num_tetrahedra: self.tetrahedra.len() as u64,
            bounds: bounds_of(&self.points),
            digest: self.digest(),
        })
    }

    /// XXH3-128 of all numbers as little-endian bytes, points first.
    pub fn digest(&self) -> String {
        let mut hasher = Xxh3::new();
        self.points.iter().flatten().for_each(|x| hasher.update(&x.to_le_bytes()));
        self.tetrahedra.iter().flatten().for_each(|i| hasher.update(&i.to_le_bytes()));
        format!("{:032x}", hasher.digest128())
    }
}

/// The lowest and the highest coordinates.
pub(crate) fn bounds_of(points: &[[f64; 3]]) -> [[f64; 3]; 2] {
    let ends = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
    points.iter().fold(ends, |[low, high], point| {
        [std::array::from_fn(|a| low[a].min(point[a])), std::array::from_fn(|a| high[a].max(point[a]))]
    })
}

/// Writes both arrays; gives their files and bytes.
pub(crate) fn write(
    root: &Path,
    header: &CellHeader,
    geometry: &CellGeometry,
) -> Result<(Vec<PathBuf>, u64), StoreError> {
    let mut written = (Vec::new(), 0);
    let [points, tetrahedra] = GeometryArray::ALL;
    write_array(root, header, points, &geometry.points, f64::to_le_bytes, &mut written)?;
    write_array(root, header, tetrahedra, &geometry.tetrahedra, u32::to_le_bytes, &mut written)?;
    Ok(written)
}

fn write_array<T: Copy, const N: usize, const B: usize>(
    root: &Path,
    header: &CellHeader,
    array: GeometryArray,
    rows: &[[T; N]],
    to_bytes: impl Fn(T) -> [u8; B],
    (paths, num_bytes): &mut (Vec<PathBuf>, u64),
) -> Result<(), StoreError> {
    let chunk_rows = array.chunk_rows(header) as usize;
    for (number, rows) in rows.chunks(chunk_rows).enumerate() {
        let mut bytes = vec![0; N * B * chunk_rows];
        for (column, bytes) in bytes.chunks_exact_mut(B * chunk_rows).enumerate() {
            for (row, bytes) in rows.iter().zip(bytes.chunks_exact_mut(B)) {
                bytes.copy_from_slice(&to_bytes(row[column]));
            }
        }
        let path = root.join(array.file(number as u64));
        let stored = chunk::encode_once(&bytes, GEOMETRY_ZSTD_LEVEL);
        let stored = stored.map_err(StoreError::io(&path, "compress"))?;
        files::write(&path, &stored)?;
        *num_bytes += stored.len() as u64;
        paths.push(path);
    }
    Ok(())
}

/// Reads both arrays, checked against each other and the header; also gives how many bytes were read.
pub(crate) fn read(root: &Path, header: &CellHeader) -> Result<(CellGeometry, u64), StoreError> {
    let mut num_bytes = 0;
    let [points, tetrahedra] = GeometryArray::ALL;
    let points = read_array(root, header, points, f64::from_le_bytes, &mut num_bytes)?;
    let tetrahedra = read_array(root, header, tetrahedra, u32::from_le_bytes, &mut num_bytes)?;
    let geometry = CellGeometry { points, tetrahedra };
    let path = root.join("zarr.json");
    let found = geometry.summary().map_err(|error| {
        let problem = "points must be finite and corners must be points";
        StoreError::corrupt(root, "geometry", error.without_path(), problem)
    })?;
    if found.digest != header.geometry {
        let problem = format!("points and tetrahedra give {}", found.digest);
        return Err(StoreError::corrupt(&path, "geometry", &header.geometry, problem));
    }
    if found.bounds != header.bounds {
        let (value, problem) =
            (format!("{:?}", header.bounds), format!("the points give {:?}", found.bounds));
        return Err(StoreError::corrupt(&path, "bounds", value, problem));
    }
    Ok((geometry, num_bytes))
}

/// Memory grows with the chunks that are found, not with what the header says.
fn read_array<T: Copy + Default + PartialEq, const N: usize, const B: usize>(
    root: &Path,
    header: &CellHeader,
    array: GeometryArray,
    from_bytes: impl Fn([u8; B]) -> T,
    num_bytes: &mut u64,
) -> Result<Vec<[T; N]>, StoreError> {
    let chunk_rows = array.chunk_rows(header) as usize;
    let num_rows = array.num_rows(header) as usize;
    let mut rows: Vec<[T; N]> = Vec::new();
    for number in 0..array.num_chunks(header) {
        let path = root.join(array.file(number));
        let len = N * B * chunk_rows;
        let Some(stored) = files::read_whole(&path, chunk::largest_stored(len) as u64)? else {
            return Err(StoreError::corrupt(&path, "file", "absent", "a part of the mesh is lost"));
        };
        *num_bytes += stored.len() as u64;
        let bytes = chunk::decode(&stored, len).map_err(|problem| {
            StoreError::corrupt(&path, "chunk", format!("{} bytes", stored.len()), problem)
        })?;
        let (values, _) = bytes.as_chunks::<B>();
        let row = |row: usize| std::array::from_fn(|column| from_bytes(values[column * chunk_rows + row]));
        let num_here = chunk_rows.min(num_rows - rows.len());
        if (num_here..chunk_rows).any(|at| row(at) != [T::default(); N]) {
            let problem = "rows after the last are not zero";
            return Err(StoreError::corrupt(&path, "chunk", number, problem));
        }
        rows.extend((0..num_here).map(row));
    }
    Ok(rows)
}
