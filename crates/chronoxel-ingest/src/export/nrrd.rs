//! NRRD with its header attached: <https://teem.sourceforge.net/nrrd/format.html>.
//!
//! Steps at even distances have the spacing and start of the time axis; uneven times cannot be said in the header's
//! fields and stand in the key `times`.

use std::fmt::Write as _;
use std::path::Path;

use chronoxel_core::{SampleType, TimeAxis};

use super::npy::PlainWriter;
use super::{ExportDescription, ExportError};

/// Starts a `.nrrd` file.
pub(super) fn create(path: &Path, description: &ExportDescription) -> Result<PlainWriter, ExportError> {
    PlainWriter::create(path, description, header(description).as_bytes())
}

fn header(description: &ExportDescription) -> String {
    let ExportDescription { grid, times, .. } = description;
    let ([nx, ny, nz], [dx, dy, dz], [x, y, z]) = (grid.dims, grid.spacing, grid.origin);
    let num_steps = times.num_steps();
    // What each field says of the time axis; nothing where there is one step.
    let timed = |text: String| if num_steps > 1 { format!(" {text}") } else { String::new() };
    let mut header = String::from("NRRD0005\n# Complete NRRD file format specification at:\n");
    header += "# http://teem.sourceforge.net/nrrd/formats.html\n";
    let mut field = |name: &str, value: String| {
        writeln!(header, "{name}: {value}").expect("writing to a string");
    };
    field("content", one_line(&description.name));
    field("type", type_name(description.sample_type).to_owned());
    field("dimension", if num_steps > 1 { "4" } else { "3" }.to_owned());
    field("space dimension", "3".to_owned());
    field("sizes", format!("{nx} {ny} {nz}{}", timed(num_steps.to_string())));
    field("space directions", format!("({dx:?},0,0) (0,{dy:?},0) (0,0,{dz:?}){}", timed("none".to_owned())));
    field("space origin", format!("({x:?},{y:?},{z:?})"));
    if let (true, Some(dt)) = (num_steps > 1, even_distance(times)) {
        field("spacings", format!("NaN NaN NaN {dt:?}"));
        field("axis mins", format!("NaN NaN NaN {:?}", times.times[0]));
    }
    field("kinds", format!("domain domain domain{}", timed("time".to_owned())));
    if num_steps > 1 {
        field("units", format!("\"\" \"\" \"\" \"{}\"", one_line(&times.units)));
    }
    if !description.units.is_empty() {
        field("sample units", format!("\"{}\"", one_line(&description.units)));
    }
    field("endian", "little".to_owned());
    field("encoding", "raw".to_owned());
    let listed: Vec<String> = times.times.iter().map(|t| format!("{t:?}")).collect();
    header + "times:=" + &listed.join(" ") + "\n\n"
}

/// The distance between steps where it is the same all along, to rounding.
fn even_distance(times: &TimeAxis) -> Option<f64> {
    let (first, last) = (times.times[0], times.times[times.num_steps() - 1]);
    let dt = (last - first) / (times.num_steps() - 1) as f64;
    let is_even = times
        .times
        .iter()
        .enumerate()
        .all(|(s, t)| (first + s as f64 * dt - t).abs() <= 1e-9 * (last - first));
    is_even.then_some(dt)
}

fn type_name(sample_type: SampleType) -> &'static str {
    match sample_type {
        SampleType::U8 => "uint8",
        SampleType::I8 => "int8",
        SampleType::U16 => "uint16",
        SampleType::I16 => "int16",
        SampleType::U32 => "uint32",
        SampleType::I32 => "int32",
        SampleType::U64 => "uint64",
        SampleType::I64 => "int64",
        SampleType::F32 => "float",
        SampleType::F64 => "double",
    }
}

/// Text that a header line can hold.
fn one_line(text: &str) -> String {
    text.chars().map(|c| if c.is_control() || c == '"' || c == '\\' { ' ' } else { c }).collect()
}
