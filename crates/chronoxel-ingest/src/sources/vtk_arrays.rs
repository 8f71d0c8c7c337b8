//! The arrays of a VTK XML file, whatever its type: where they are, what they are called, how they are written.

use std::io::Read;
use std::ops::Range;
use std::path::Path;
use std::str::FromStr;

use chronoxel_core::{SampleType, Samples};

use super::samples::{SampleFormat, SliceReader};
use super::volume_file::{FileTimes, checked_product};
use super::vtk_data::{Compressor, Encoding, Place};
use super::xml::{Document, Element};
use crate::{SourceError, StepReader, Variable};

/// More components than any array has.
const MAX_COMPONENTS: usize = 256;

/// How the arrays of a file of a type are written.
pub(crate) fn encoding(document: &Document, file_type: &str) -> Result<Encoding, SourceError> {
    let path = &document.path;
    let root = document.root(file_type)?;
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

/// The element that a file of a type describes, right below its root.
pub(crate) fn data_set<'a>(
    document: &'a Document,
    file_type: &'a str,
) -> Result<(usize, &'a Element), SourceError> {
    document.all(file_type).next().ok_or_else(|| {
        SourceError::corrupt(
            &document.path,
            file_type,
            "missing",
            "the file is truncated or not written by VTK",
        )
    })
}

/// The pieces of a data set of one time step.
pub(crate) fn pieces<'a>(
    document: &'a Document,
    (index, data_set): (usize, &Element),
) -> Result<Vec<(usize, &'a Element)>, SourceError> {
    if let Some(values) = data_set.get("TimeValues") {
        let remedy = "one time step per file is; write a .pvd collection";
        return Err(SourceError::unsupported(&document.path, "TimeValues", values, remedy));
    }
    Ok(document.children(index, "Piece").collect())
}

/// The one piece of a data set.
pub(crate) fn only_piece<'a>(
    document: &'a Document,
    data_set: (usize, &Element),
) -> Result<(usize, &'a Element), SourceError> {
    let path = &document.path;
    let [piece] = pieces(document, data_set)?[..] else {
        let pieces: Vec<_> = document.children(data_set.0, "Piece").collect();
        let remedy = "files with one piece are; append the pieces and write the file again";
        return Err(SourceError::unsupported(path, "number of pieces", pieces.len(), remedy));
    };
    Ok(piece)
}

/// The extent of a data set, which must be that of its one piece: first and last index along x, y, z.
pub(crate) fn extent(path: &Path, data_set: &Element, piece: &Element) -> Result<[i64; 6], SourceError> {
    let whole = numbers::<i64, 6>(path, data_set, "WholeExtent", None)?;
    let extent = numbers::<i64, 6>(path, piece, "Extent", Some(whole))?;
    if extent != whole {
        let remedy = format!("pieces that are the WholeExtent, {whole:?}, are; write it as a whole");
        return Err(SourceError::unsupported(path, "Piece Extent", format!("{extent:?}"), remedy));
    }
    Ok(whole)
}

/// Points along x, y, z of an extent.
pub(crate) fn dims_of(extent: [i64; 6]) -> [usize; 3] {
    std::array::from_fn(|axis| {
        let [low, high] = [extent[2 * axis], extent[2 * axis + 1]];
        let count = (i128::from(high) - i128::from(low) + 1).max(0);
        usize::try_from(count).unwrap_or(usize::MAX)
    })
}

/// The numbers of an attribute, or `default` where it is missing.
pub(crate) fn numbers<T: FromStr, const N: usize>(
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

/// The array of flags that says which points and cells are hidden; it is no data.
pub(crate) const GHOSTS: &str = "vtkGhostType";

/// Where the values of one component of an array are.
#[derive(Debug, Clone)]
pub(crate) struct Array {
    place: Place,
    encoding: Encoding,
    format: SampleFormat,
    /// Of the component alone.
    num_values: u64,
    /// For messages.
    field: String,
}

impl Array {
    /// All values of an array in a legacy file.
    pub fn in_legacy_file(place: Place, sample_type: SampleType, num_values: u64, field: String) -> Self {
        let encoding = Encoding { big_endian: true, header_width: 4, compressor: None };
        let format = SampleFormat::scalar(sample_type, !matches!(place, Place::Ascii(_)));
        Self { place, encoding, format, num_values, field }
    }

    /// One component of an array, where several lie side by side.
    pub fn component(&self, component: usize, num_components: usize) -> Self {
        let format = SampleFormat { num_components, component, ..self.format };
        Self { format, num_values: self.num_values / num_components as u64, ..self.clone() }
    }

    /// All values.
    pub fn read_all(&self, path: &Path) -> Result<Samples, SourceError> {
        self.open(path, 1)?.read_slices(self.num_values as usize)
    }

    /// How many values there are.
    pub fn num_values(&self) -> u64 {
        self.num_values
    }

    /// Opens the values, to be read in slices of a length.
    pub fn open(&self, path: &Path, slice_samples: usize) -> Result<ArraySlices, SourceError> {
        let num_bytes = self.num_values * self.format.point_bytes() as u64;
        Ok(SliceReader {
            input: self.place.open(path, self.encoding, self.format.sample_type, num_bytes)?,
            path: path.to_owned(),
            field: self.field.clone(),
            format: self.format,
            slice_samples,
        })
    }
}

/// The values of an array on their way.
pub(crate) type ArraySlices = SliceReader<Box<dyn Read + Send>>;

/// Finds the arrays of a file.
pub(crate) struct ArrayReader<'a> {
    pub document: &'a Document,
    pub encoding: Encoding,
}

impl ArrayReader<'_> {
    /// The variables of the piece, and where they are.
    pub fn point_data(
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
                if name == GHOSTS {
                    continue;
                }
                let Some(sample_type) = sample_type_of(element.get("type").unwrap_or_default()) else {
                    passed_over = Some(element);
                    continue;
                };
                let num_components = self.num_components(element)?;
                let array = self.array(element, name, sample_type, num_points * num_components as u64)?;
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
                    arrays.push(array.component(component, num_components));
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
        let mut arrays = in_cells
            .flat_map(|cells| self.document.children(cells, "DataArray"))
            .map(|(_, array)| array.get("Name").unwrap_or_default());
        if let Some(name) = arrays.find(|name| *name != GHOSTS) {
            let remedy =
                "point data are; convert it with vtkCellDataToPointData (ParaView: Cell Data to Point Data)";
            return SourceError::unsupported(path, format!("array {name:?}"), "of cells alone", remedy);
        }
        SourceError::corrupt(path, "PointData", "empty", "it must have at least one array")
    }

    /// An array of a number of values in all, which the file must be able to hold.
    pub fn array(
        &self,
        element: &Element,
        name: &str,
        sample_type: SampleType,
        num_values: u64,
    ) -> Result<Array, SourceError> {
        let path = &self.document.path;
        let place = self.place(element, name)?;
        let needed = checked_product(path, "size in bytes", [num_values, sample_type.num_bytes() as u64])?;
        let most = place.most_bytes(self.encoding, sample_type);
        let field = format!("array {name:?}");
        if needed > most {
            let problem =
                format!("the extent needs {needed} bytes where the file can hold {most}; it is truncated");
            return Err(SourceError::corrupt(path, field, "too short", problem));
        }
        let big_endian = self.encoding.big_endian && !matches!(place, Place::Ascii(_));
        let format = SampleFormat::scalar(sample_type, big_endian);
        Ok(Array { place, encoding: self.encoding, format, num_values, field })
    }

    /// The flags of the points (`PointData`) or cells (`CellData`) of a piece, where there are some.
    pub fn ghosts(&self, piece_index: usize, data: &str, count: u64) -> Result<Option<Array>, SourceError> {
        let data = self.document.children(piece_index, data).next();
        let has_ghosts = |(index, _): &(usize, &Element)| {
            self.document.children(*index, "DataArray").any(|(_, e)| e.get("Name") == Some(GHOSTS))
        };
        match data.filter(has_ghosts) {
            Some((index, _)) if count > 0 => self.named_array(index, GHOSTS, count).map(Some),
            _ => Ok(None),
        }
    }

    /// The one array with a name inside another element, of a number of values in all.
    pub fn named_array(&self, parent: usize, name: &str, num_values: u64) -> Result<Array, SourceError> {
        let found = self.document.children(parent, "DataArray").find(|(_, e)| e.get("Name") == Some(name));
        let (_, element) = found.ok_or_else(|| {
            SourceError::corrupt(
                &self.document.path,
                format!("array {name:?}"),
                "missing",
                "it must be there",
            )
        })?;
        self.array(element, name, self.number_type(element)?, num_values)
    }

    /// The type of an array, which must be one of numbers.
    pub fn number_type(&self, element: &Element) -> Result<SampleType, SourceError> {
        let name = element.get("type").unwrap_or("missing");
        sample_type_of(name).ok_or_else(|| {
            let remedy = "Int8 to UInt64, Float32 and Float64 are";
            SourceError::unsupported(&self.document.path, "array type", name, remedy)
        })
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
    pub fn times(&self, image_index: usize) -> Result<FileTimes, SourceError> {
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
                let mut reader = self.array(element, name, sample_type, 1)?.open(path, 1)?;
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
