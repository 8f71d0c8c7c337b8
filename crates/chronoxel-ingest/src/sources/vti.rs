//! VTK ImageData files (`.vti`): the point data of one time step.
//!
//! Specification: <https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html>. Data ascii, base64 or
//! appended (raw or base64), plain or compressed by zlib or LZ4. Each component of an array with several is a variable
//! of its own, `NAME_x` after its component's name or `NAME_0`, `NAME_1`, …. The time is that of the field data array
//! `TimeValue`; where there is none, `TimeStep` gives the number of the step.

use std::ops::Range;
use std::path::Path;
use std::str::FromStr;

use chronoxel_core::{SampleType, UniformGrid};

use super::samples::{SampleFormat, SliceReader};
use super::volume_file::{FileHeader, FileTimes, VolumeFile, checked_grid, checked_product};
use super::vtk_data::{Compressor, Encoding, Place};
use super::xml::{Document, Element};
use crate::{SourceError, StepReader, Variable};

/// More components than any array has.
const MAX_COMPONENTS: usize = 256;

/// A `.vti` file whose arrays can be as long as its extent needs.
struct VtiFile {
    header: FileHeader,
    encoding: Encoding,
    /// Per variable: where it is.
    arrays: Vec<Array>,
}

/// Where a variable is.
#[derive(Clone)]
struct Array {
    place: Place,
    format: SampleFormat,
}

/// Opens a `.vti` file.
pub(crate) fn open(path: &Path) -> Result<Box<dyn VolumeFile>, SourceError> {
    let document = Document::read(path)?;
    let encoding = encoding(&document)?;
    let mut images = document.all("ImageData");
    let Some((image_index, image)) = images.next() else {
        return Err(SourceError::corrupt(
            path,
            "ImageData",
            "missing",
            "the file is truncated or not written by VTK",
        ));
    };
    let piece_index = only_piece(&document, image_index, image)?;
    let grid = grid(path, image)?;
    let reader = ArrayReader { document: &document, encoding };
    let (variables, arrays) = reader.point_data(piece_index, grid.num_samples() as u64)?;
    let times = reader.times(image_index)?;
    let header =
        FileHeader { path: path.to_owned(), grid, variables, num_steps: 1, times, time_units: String::new() };
    Ok(Box::new(VtiFile { header, encoding, arrays }))
}

/// How the arrays of a file are written.
fn encoding(document: &Document) -> Result<Encoding, SourceError> {
    let path = &document.path;
    let root = document.root("ImageData")?;
    let big_endian = match root.get("byte_order") {
        Some("LittleEndian") | None => false,
        Some("BigEndian") => true,
        Some(other) => {
            return Err(SourceError::corrupt(
                path,
                "byte_order",
                other,
                "LittleEndian or BigEndian are known",
            ));
        }
    };
    let header_width = match root.get("header_type") {
        Some("UInt32") | None => 4,
        Some("UInt64") => 8,
        Some(other) => {
            return Err(SourceError::corrupt(path, "header_type", other, "UInt32 or UInt64 are known"));
        }
    };
    let compressor = match root.get("compressor") {
        None | Some("") => None,
        Some("vtkZLibDataCompressor") => Some(Compressor::Zlib),
        Some("vtkLZ4DataCompressor") => Some(Compressor::Lz4),
        Some(other) => {
            let remedy = "vtkZLibDataCompressor and vtkLZ4DataCompressor are; write it with one of them";
            return Err(SourceError::unsupported(path, "compressor", other, remedy));
        }
    };
    Ok(Encoding { big_endian, header_width, compressor })
}

/// The one piece of an image, which must be the whole of it.
fn only_piece(document: &Document, image_index: usize, image: &Element) -> Result<usize, SourceError> {
    let path = &document.path;
    if let Some(values) = image.get("TimeValues") {
        let remedy = "one time step per file is; write a .pvd collection";
        return Err(SourceError::unsupported(path, "TimeValues", values, remedy));
    }
    let pieces: Vec<(usize, &Element)> = document.children(image_index, "Piece").collect();
    let [(index, piece)] = pieces[..] else {
        let remedy = "files with one piece are; append the pieces and write the image again";
        return Err(SourceError::unsupported(path, "number of pieces", pieces.len(), remedy));
    };
    let whole = numbers::<i64, 6>(path, image, "WholeExtent", None)?;
    let extent = numbers::<i64, 6>(path, piece, "Extent", Some(whole))?;
    if extent != whole {
        let remedy = format!("pieces that are the WholeExtent, {whole:?}, are; write the whole image");
        return Err(SourceError::unsupported(path, "Piece Extent", format!("{extent:?}"), remedy));
    }
    Ok(index)
}

/// The grid of an image.
fn grid(path: &Path, image: &Element) -> Result<UniformGrid, SourceError> {
    let extent = numbers::<i64, 6>(path, image, "WholeExtent", None)?;
    let mut dims = [0; 3];
    for axis in 0..3 {
        let [low, high] = [extent[2 * axis], extent[2 * axis + 1]];
        let count = (i128::from(high) - i128::from(low) + 1).max(0);
        dims[axis] = usize::try_from(count).unwrap_or(usize::MAX);
    }
    let origin = numbers::<f64, 3>(path, image, "Origin", Some([0.0; 3]))?;
    let spacing = numbers::<f64, 3>(path, image, "Spacing", Some([1.0; 3]))?;
    const IDENTITY: [f64; 9] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let direction = numbers::<f64, 9>(path, image, "Direction", Some(IDENTITY))?;
    if direction != IDENTITY {
        let remedy = "images along x, y and z are; resample it with vtkImageReslice";
        return Err(SourceError::unsupported(
            path,
            "Direction",
            image.get("Direction").unwrap_or_default(),
            remedy,
        ));
    }
    let first = |axis: usize| origin[axis] + extent[2 * axis] as f64 * spacing[axis];
    checked_grid(path, dims, [first(0), first(1), first(2)], spacing)
}

/// The numbers of an attribute, or `default` where it is missing.
fn numbers<T: FromStr, const N: usize>(
    path: &Path,
    element: &Element,
    attribute: &'static str,
    default: Option<[T; N]>,
) -> Result<[T; N], SourceError> {
    let Some(text) = element.get(attribute) else {
        return default.ok_or_else(|| {
            SourceError::corrupt(path, attribute, "missing", format!("it must have {N} numbers"))
        });
    };
    let parsed: Option<Vec<T>> = text.split_whitespace().map(|n| n.parse().ok()).collect();
    parsed
        .and_then(|numbers| numbers.try_into().ok())
        .ok_or_else(|| SourceError::corrupt(path, attribute, text, format!("it must have {N} numbers")))
}

/// Finds the arrays of a file.
struct ArrayReader<'a> {
    document: &'a Document,
    encoding: Encoding,
}

impl ArrayReader<'_> {
    /// The variables of the piece, and where they are.
    fn point_data(
        &self,
        piece_index: usize,
        num_points: u64,
    ) -> Result<(Vec<Variable>, Vec<Array>), SourceError> {
        let path = &self.document.path;
        let (mut variables, mut arrays): (Vec<Variable>, Vec<Array>) = (Vec::new(), Vec::new());
        let mut passed_over = None;
        for (point_data, _) in self.document.children(piece_index, "PointData") {
            for (_, element) in self.document.children(point_data, "DataArray") {
                let name = element.get("Name").unwrap_or_default();
                let Some(sample_type) = sample_type_of(element.get("type").unwrap_or_default()) else {
                    passed_over = Some(element);
                    continue;
                };
                let num_components = self.num_components(element)?;
                let place = self.place(element, name)?;
                let factors = [num_points, num_components as u64, sample_type.num_bytes() as u64];
                let needed = checked_product(path, "size in bytes", factors)?;
                let most = place.most_bytes(self.encoding, sample_type);
                if needed > most {
                    let problem = format!(
                        "the extent needs {needed} bytes where the file can hold {most}; it is truncated"
                    );
                    return Err(SourceError::corrupt(path, format!("array {name:?}"), "too short", problem));
                }
                for component in 0..num_components {
                    let name = component_name(element, name, component, num_components);
                    if variables.iter().any(|v| v.name == name) {
                        return Err(SourceError::corrupt(
                            path,
                            "array Name",
                            name,
                            "two arrays have it; rename one",
                        ));
                    }
                    variables.push(Variable { name, units: String::new(), sample_type, fill_value: None });
                    let big_endian = self.encoding.big_endian && !matches!(place, Place::Ascii(_));
                    let format = SampleFormat { sample_type, big_endian, num_components, component };
                    arrays.push(Array { place: place.clone(), format });
                }
            }
        }
        if variables.is_empty() {
            return Err(self.no_point_data(piece_index, passed_over));
        }
        Ok((variables, arrays))
    }

    /// The error for a piece without an array that can be read.
    fn no_point_data(&self, piece_index: usize, passed_over: Option<&Element>) -> SourceError {
        let path = &self.document.path;
        if let Some(array) = passed_over {
            let remedy = "Int8 to UInt64, Float32 and Float64 are";
            return SourceError::unsupported(
                path,
                "array type",
                array.get("type").unwrap_or("missing"),
                remedy,
            );
        }
        let in_cells = self.document.children(piece_index, "CellData").map(|(cells, _)| cells);
        let has_cell_data =
            in_cells.into_iter().any(|cells| self.document.children(cells, "DataArray").next().is_some());
        if has_cell_data {
            let remedy =
                "point data are; convert it with vtkCellDataToPointData (ParaView: Cell Data to Point Data)";
            return SourceError::unsupported(path, "data", "cell data only", remedy);
        }
        SourceError::corrupt(path, "PointData", "empty", "it must have at least one array")
    }

    /// `NumberOfComponents`.
    fn num_components(&self, element: &Element) -> Result<usize, SourceError> {
        let text = element.get("NumberOfComponents").unwrap_or("1");
        text.parse().ok().filter(|n| (1..=MAX_COMPONENTS).contains(n)).ok_or_else(|| {
            let problem = format!("it must be between 1 and {MAX_COMPONENTS}");
            SourceError::corrupt(&self.document.path, "NumberOfComponents", text, problem)
        })
    }

    /// Where the data of an array are.
    fn place(&self, element: &Element, name: &str) -> Result<Place, SourceError> {
        let path = &self.document.path;
        match element.get("format") {
            Some("ascii") => Ok(Place::Ascii(element.text.clone())),
            Some("binary") => Ok(Place::Base64(element.text.clone())),
            Some("appended") => self.appended_place(element, name),
            other => {
                let problem = "ascii, binary and appended are known";
                Err(SourceError::corrupt(
                    path,
                    format!("format of {name:?}"),
                    other.unwrap_or("missing"),
                    problem,
                ))
            }
        }
    }

    /// Where the appended data of an array are.
    fn appended_place(&self, element: &Element, name: &str) -> Result<Place, SourceError> {
        let path = &self.document.path;
        let Some(start) = self.document.appended_start else {
            return Err(SourceError::corrupt(path, "AppendedData", "missing", "the file is truncated"));
        };
        let text = element.get("offset").unwrap_or("missing");
        let position = text.parse::<u64>().ok().and_then(|offset| start.checked_add(offset));
        let position = position.filter(|p| *p < self.document.file_bytes).ok_or_else(|| {
            let problem =
                format!("the file has {} bytes, with the data from {start} on", self.document.file_bytes);
            SourceError::corrupt(path, format!("offset of {name:?}"), text, problem)
        })?;
        let range: Range<u64> = position..self.document.file_bytes;
        let appended = self.document.all("AppendedData").next().and_then(|(_, e)| e.get("encoding"));
        match appended {
            Some("raw") => Ok(Place::Raw(range)),
            Some("base64") | None => Ok(Place::Base64(range)),
            Some(other) => {
                Err(SourceError::unsupported(path, "AppendedData encoding", other, "raw and base64 are"))
            }
        }
    }

    /// The time in the field data.
    fn times(&self, image_index: usize) -> Result<FileTimes, SourceError> {
        if let Some(time) = self.field_number(image_index, "TimeValue")? {
            return Ok(FileTimes::Known(vec![time]));
        }
        Ok(self.field_number(image_index, "TimeStep")?.map_or(FileTimes::Unknown, FileTimes::StepNumber))
    }

    /// The one number of a field data array.
    fn field_number(&self, image_index: usize, name: &str) -> Result<Option<f64>, SourceError> {
        let path = &self.document.path;
        for (field_data, _) in self.document.children(image_index, "FieldData") {
            for (_, element) in self.document.children(field_data, "DataArray") {
                if element.get("Name") != Some(name) {
                    continue;
                }
                let Some(sample_type) = sample_type_of(element.get("type").unwrap_or_default()) else {
                    continue;
                };
                let tuples = element.get("NumberOfTuples").unwrap_or("1");
                if tuples != "1" || self.num_components(element)? != 1 {
                    let remedy = "one number per file is";
                    return Err(SourceError::unsupported(
                        path,
                        format!("NumberOfTuples of {name}"),
                        tuples,
                        remedy,
                    ));
                }
                let place = self.place(element, name)?;
                let big_endian = self.encoding.big_endian && !matches!(place, Place::Ascii(_));
                let input = place.open(path, self.encoding, sample_type, sample_type.num_bytes() as u64)?;
                let format = SampleFormat::scalar(sample_type, big_endian);
                let mut reader = SliceReader {
                    input,
                    path: path.clone(),
                    field: name.to_owned(),
                    format,
                    slice_samples: 1,
                };
                return Ok(Some(reader.read_slices(1)?.get(0)));
            }
        }
        Ok(None)
    }
}

/// The name of the variable that a component is.
fn component_name(element: &Element, name: &str, component: usize, num_components: usize) -> String {
    if num_components == 1 {
        return name.to_owned();
    }
    match element.get(&format!("ComponentName{component}")).filter(|n| !n.is_empty()) {
        Some(own) => format!("{name}_{own}"),
        None => format!("{name}_{component}"),
    }
}

/// The sample type that VTK names so.
fn sample_type_of(name: &str) -> Option<SampleType> {
    Some(match name {
        "Int8" => SampleType::I8,
        "UInt8" => SampleType::U8,
        "Int16" => SampleType::I16,
        "UInt16" => SampleType::U16,
        "Int32" => SampleType::I32,
        "UInt32" => SampleType::U32,
        "Int64" => SampleType::I64,
        "UInt64" => SampleType::U64,
        "Float32" => SampleType::F32,
        "Float64" => SampleType::F64,
        _ => return None,
    })
}

impl VolumeFile for VtiFile {
    fn header(&self) -> &FileHeader {
        &self.header
    }

    fn open_step<'a>(
        &'a mut self,
        variable: usize,
        _step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError> {
        let [nx, ny, nz] = self.header.grid.dims;
        let Array { place, format } = &self.arrays[variable];
        let num_bytes = (nx * ny * nz) as u64 * format.point_bytes() as u64;
        Ok(Box::new(SliceReader {
            input: place.open(&self.header.path, self.encoding, format.sample_type, num_bytes)?,
            path: self.header.path.clone(),
            field: format!("array {:?}", self.header.variables[variable].name),
            format: *format,
            slice_samples: nx * ny,
        }))
    }
}
