//! NRRD files, attached (`.nrrd`) and detached (`.nhdr` with data files beside it).
//!
//! Specification: <https://teem.sourceforge.net/nrrd/format.html>. Encodings raw, gzip and text; 3-D, or 4-D with
//! a further axis that is
//! - time, where its kind is `time` or `list`, or where it is the last one and the first has no kind of its own;
//! - components, each of them a variable `NAME_0`, `NAME_1`, …, where it is the first and its kind is another one
//!   (`vector`, `RGB-color`, …).
//!
//! The three other axes must lie along x, y and z, in this order and direction. Each of several data files holds an
//! equal share of the samples.

use std::path::Path;

use chronoxel_core::SampleType;

use super::nrrd_data::{DataPlace, Stream};
use super::nrrd_header::Fields;
use super::samples::{SampleFormat, SliceReader};
use super::volume_file::{FileHeader, FileTimes, VolumeFile, checked_grid, checked_product, checked_steps};
use crate::{SourceError, StepReader, Variable};

/// More components than any array has.
const MAX_COMPONENTS: usize = 256;

/// What the axis beside x, y and z is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum FourthAxis {
    None,
    /// The fastest axis: side by side at each point.
    Components,
    /// The fastest axis: side by side at each point.
    TimeFirst,
    TimeLast,
}

/// A NRRD whose files can hold what its header promises.
struct NrrdFile {
    header: FileHeader,
    place: DataPlace,
    format: SampleFormat,
    fourth_axis: FourthAxis,
    /// Where the last reader stopped, so that the next step need not decode from the start.
    stream: Option<Stream>,
}

/// Opens a NRRD.
pub(crate) fn open(path: &Path) -> Result<Box<dyn VolumeFile>, SourceError> {
    let fields = Fields::read(path)?;
    let sizes = fields.sizes()?;
    let fourth_axis = fourth_axis(&fields, &sizes)?;
    let sample_type = fields.sample_type()?;
    let big_endian = big_endian(&fields, sample_type)?;
    let first_axis = usize::from(matches!(fourth_axis, FourthAxis::Components | FourthAxis::TimeFirst));
    let dims = [sizes[first_axis], sizes[first_axis + 1], sizes[first_axis + 2]];
    let [origin, spacing] = fields.placement(sizes.len(), first_axis)?;
    let grid = checked_grid(path, dims, origin, spacing)?;
    let factors = sizes.iter().map(|&n| n as u64).chain([sample_type.num_bytes() as u64]);
    let place = DataPlace::find(&fields, sample_type, checked_product(path, "sizes", factors)?)?;
    let time_axis = match fourth_axis {
        FourthAxis::TimeFirst => Some(0),
        FourthAxis::TimeLast => Some(3),
        _ => None,
    };
    let num_steps = checked_steps(path, "sizes of the time axis", time_axis.map_or(1, |axis| sizes[axis]))?;
    let num_components = if first_axis == 1 { sizes[0] } else { 1 };
    let (times, time_units) = times(&fields, &sizes, time_axis, num_steps)?;
    let header = FileHeader {
        path: path.to_owned(),
        grid,
        variables: variables(&fields, fourth_axis, num_components, sample_type)?,
        num_steps,
        times,
        time_units,
    };
    let format = SampleFormat { sample_type, big_endian, num_components, component: 0 };
    Ok(Box::new(NrrdFile { header, place, format, fourth_axis, stream: None }))
}

/// What the fourth axis is, by the kinds of the axes.
fn fourth_axis(fields: &Fields, sizes: &[usize]) -> Result<FourthAxis, SourceError> {
    let kinds: Vec<String> = fields.words("kinds").iter().map(|kind| kind.to_lowercase()).collect();
    let kind = |axis: usize| kinds.get(axis).map_or("", String::as_str);
    let is_time = |axis: usize| matches!(kind(axis), "time" | "list");
    let is_plain = |axis: usize| matches!(kind(axis), "" | "???" | "none" | "domain" | "space");
    match sizes.len() {
        3 => Ok(FourthAxis::None),
        4 if is_time(3) => Ok(FourthAxis::TimeLast),
        4 if is_time(0) => Ok(FourthAxis::TimeFirst),
        4 if !is_plain(0) => Ok(FourthAxis::Components),
        4 => Ok(FourthAxis::TimeLast),
        n => Err(SourceError::unsupported(
            &fields.path,
            "dimension",
            n,
            "3-D and 4-D are; slice it or give it an axis",
        )),
    }
}

/// The byte order: needed unless samples are single bytes or text.
fn big_endian(fields: &Fields, sample_type: SampleType) -> Result<bool, SourceError> {
    let given = fields.big_endian()?;
    if super::nrrd_data::Encoding::of(fields)? == super::nrrd_data::Encoding::Text {
        return Ok(false);
    }
    match given {
        Some(big_endian) => Ok(big_endian),
        None if sample_type.num_bytes() == 1 => Ok(false),
        None => {
            Err(SourceError::corrupt(&fields.path, "endian", "missing", "add endian: little or endian: big"))
        }
    }
}

/// One variable, or one per component.
fn variables(
    fields: &Fields,
    fourth_axis: FourthAxis,
    num_components: usize,
    sample_type: SampleType,
) -> Result<Vec<Variable>, SourceError> {
    let units = fields.words("sample units").join(" ");
    let variable = |name: String| Variable { name, units: units.clone(), sample_type, fill_value: None };
    if fourth_axis != FourthAxis::Components {
        return Ok(vec![variable(String::new())]);
    }
    if num_components == 0 {
        return Err(SourceError::corrupt(
            &fields.path,
            "sizes[0]",
            0,
            "there must be at least one component",
        ));
    }
    if num_components > MAX_COMPONENTS {
        let remedy = format!("at most {MAX_COMPONENTS} components are");
        return Err(SourceError::unsupported(&fields.path, "sizes[0]", num_components, remedy));
    }
    Ok((0..num_components).map(|c| variable(format!("_{c}"))).collect())
}

/// Times, from a list of them or from the spacing and the start of the time axis, and their units.
fn times(
    fields: &Fields,
    sizes: &[usize],
    time_axis: Option<usize>,
    num_steps: usize,
) -> Result<(FileTimes, String), SourceError> {
    let listed = fields.listed_times(num_steps).map(FileTimes::Known);
    let Some(axis) = time_axis else { return Ok((listed.unwrap_or(FileTimes::Unknown), String::new())) };
    let units = fields.words("units").get(axis).filter(|u| *u != "???").cloned().unwrap_or_default();
    let number = |field| Ok(fields.per_axis(field, sizes.len())?.map_or(f64::NAN, |numbers| numbers[axis]));
    if let Some(times) = listed {
        return Ok((times, units));
    }
    let (dt, start) = (number("spacings")?, number("axis mins")?);
    let times = match (dt.is_nan(), start.is_nan()) {
        (true, _) => FileTimes::Unknown,
        (false, true) => FileTimes::Known((0..num_steps).map(|s| s as f64 * dt).collect()),
        (false, false) => FileTimes::Known((0..num_steps).map(|s| start + s as f64 * dt).collect()),
    };
    Ok((times, units))
}

impl VolumeFile for NrrdFile {
    fn header(&self) -> &FileHeader {
        &self.header
    }

    fn open_step<'a>(
        &'a mut self,
        variable: usize,
        step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError> {
        let [nx, ny, nz] = self.header.grid.dims;
        let mut format = self.format;
        let (position, keep_stream) = match self.fourth_axis {
            FourthAxis::None => (0, false),
            FourthAxis::Components => {
                format.component = variable;
                (0, false)
            }
            FourthAxis::TimeFirst => {
                format.component = step;
                (0, false)
            }
            FourthAxis::TimeLast => {
                let step_bytes = (nx * ny * nz) as u64 * format.point_bytes() as u64;
                (step as u64 * step_bytes, step + 1 < self.header.num_steps)
            }
        };
        Ok(Box::new(SliceReader {
            input: self.place.reader(&mut self.stream, position, keep_stream)?,
            path: self.header.path.clone(),
            field: "samples".to_owned(),
            format,
            slice_samples: nx * ny,
        }))
    }
}
