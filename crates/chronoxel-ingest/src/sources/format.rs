//! Which format a path has: by its extension, held against its first bytes.

use std::io::Read;
use std::path::Path;

use super::SourceOptions;
use super::volume_file::open_regular;
use crate::SourceError;

/// Enough of a file to know its format.
const MAGIC_BYTES: u64 = 1024;

/// The formats that are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Format {
    Raw,
    Npy,
    Nrrd,
    Vti,
    Pvd,
    Zarr,
    Vts,
    Vtr,
    Vtu,
    Parallel,
    Vtk,
    Plot3d,
}

impl Format {
    /// The format as messages name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Raw => "raw binary",
            Self::Npy => "NumPy .npy",
            Self::Nrrd => "NRRD",
            Self::Vti => "VTK ImageData .vti",
            Self::Pvd => "ParaView collection .pvd",
            Self::Zarr => "Zarr",
            Self::Vts => "VTK StructuredGrid .vts",
            Self::Vtr => "VTK RectilinearGrid .vtr",
            Self::Vtu => "VTK UnstructuredGrid .vtu",
            Self::Parallel => "parallel VTK .pvtu, .pvts or .pvtr",
            Self::Vtk => "legacy VTK .vtk",
            Self::Plot3d => "PLOT3D",
        }
    }

    /// The format of a path.
    ///
    /// A folder is a Zarr group or array. A file is what its extension says; with one that says nothing it is
    /// raw if `dims` are given.
    pub fn of(path: &Path, options: &SourceOptions) -> Result<Self, SourceError> {
        let metadata = std::fs::metadata(path).map_err(|e| SourceError::io(path, "open", e))?;
        if metadata.is_dir() {
            return Self::of_folder(path);
        }
        let (file, _) = open_regular(path)?;
        let mut head = Vec::new();
        file.take(MAGIC_BYTES).read_to_end(&mut head).map_err(|e| SourceError::io(path, "read", e))?;
        let looks_like = Content::of(&head);
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        match Self::by_extension(&extension) {
            Some(format) if looks_like.fits(format) => Ok(format),
            Some(format) => Err(wrong_extension(path, &extension, format, looks_like)),
            None if looks_like == Content::Unknown && options.dims.is_some() => Ok(Self::Raw),
            None => Err(unknown_extension(path, &extension, looks_like)),
        }
    }

    /// The format that an extension stands for.
    fn by_extension(extension: &str) -> Option<Self> {
        match extension {
            "raw" | "bin" | "dat" => Some(Self::Raw),
            "npy" => Some(Self::Npy),
            "nrrd" | "nhdr" => Some(Self::Nrrd),
            "vti" => Some(Self::Vti),
            "pvd" => Some(Self::Pvd),
            "vts" => Some(Self::Vts),
            "vtr" => Some(Self::Vtr),
            "vtu" => Some(Self::Vtu),
            "pvtu" | "pvts" | "pvtr" => Some(Self::Parallel),
            "vtk" => Some(Self::Vtk),
            "x" | "xyz" | "g" | "grd" | "q" | "p3d" => Some(Self::Plot3d),
            _ => None,
        }
    }

    /// A folder is read if it is a Zarr group or array.
    fn of_folder(path: &Path) -> Result<Self, SourceError> {
        let has = |name: &str| path.join(name).exists();
        if ["zarr.json", ".zarray", ".zgroup"].iter().any(|name| has(name)) {
            return Ok(Self::Zarr);
        }
        let remedy = format!("name the files in it, such as '{}/*.vti'", path.display());
        Err(SourceError::unsupported(path, "path", "a folder without zarr.json, .zarray or .zgroup", remedy))
    }
}

/// What the first bytes of a file look like.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Content {
    Is(Format),
    /// Something known that is not read.
    Other(&'static str),
    /// Bytes without a signature.
    Unknown,
}

impl Content {
    /// Finds the signature of a file.
    fn of(head: &[u8]) -> Self {
        let signatures: [(&[u8], Self); 12] = [
            (b"\x93NUMPY", Self::Is(Format::Npy)),
            (b"NRRD0", Self::Is(Format::Nrrd)),
            (b"# vtk DataFile", Self::Is(Format::Vtk)),
            (b"\x89HDF\r\n\x1a\n", Self::Other("HDF5")),
            (b"CDF\x01", Self::Other("NetCDF")),
            (b"CDF\x02", Self::Other("NetCDF")),
            (b"CDF\x05", Self::Other("NetCDF")),
            (b"PK\x03\x04", Self::Other("a zip archive")),
            (b"\x28\xb5\x2f\xfd", Self::Other("zstd-compressed")),
            (b"\x1f\x8b\x08", Self::Other("gzip-compressed")),
            (b"BZh", Self::Other("bzip2-compressed")),
            (b"\xfd7zXZ\0", Self::Other("xz-compressed")),
        ];
        if let Some((_, content)) = signatures.iter().find(|(magic, _)| head.starts_with(magic)) {
            return *content;
        }
        Self::of_xml(head)
    }

    /// Finds the type of a VTK XML file.
    fn of_xml(head: &[u8]) -> Self {
        let text = String::from_utf8_lossy(head);
        let text = text.trim_start_matches('\u{feff}').trim_start();
        if !text.starts_with('<') {
            return Self::Unknown;
        }
        let Some(tag) = text.split_once("<VTKFile").and_then(|(_, rest)| rest.split('>').next()) else {
            return Self::Other("XML that is not a VTK file");
        };
        let tag = tag.replace('\'', "\"");
        match tag.split_once("type=\"").and_then(|(_, rest)| rest.split('"').next()) {
            Some("ImageData") => Self::Is(Format::Vti),
            Some("Collection") => Self::Is(Format::Pvd),
            Some("PImageData") => Self::Other("a parallel VTK .pvti file"),
            Some("StructuredGrid") => Self::Is(Format::Vts),
            Some("RectilinearGrid") => Self::Is(Format::Vtr),
            Some("UnstructuredGrid") => Self::Is(Format::Vtu),
            Some("PStructuredGrid" | "PRectilinearGrid" | "PUnstructuredGrid") => Self::Is(Format::Parallel),
            _ => Self::Other("a VTK file of another type"),
        }
    }

    /// Whether the content may be what an extension says. Raw bytes may begin like a compressed file by chance.
    fn fits(self, format: Format) -> bool {
        match self {
            Self::Is(found) => found == format,
            Self::Unknown => matches!(format, Format::Raw | Format::Plot3d),
            Self::Other(_) => false,
        }
    }

    /// The content as messages name it.
    fn name(self) -> &'static str {
        match self {
            Self::Is(format) => format.name(),
            Self::Other(name) => name,
            Self::Unknown => "none of the known formats",
        }
    }

    /// What to do with such a file.
    fn remedy(self) -> &'static str {
        match self {
            Self::Is(Format::Raw) | Self::Unknown => {
                "check that it was written completely, or give --dims and --dtype"
            }
            Self::Is(_) => "rename it to the extension of its format",
            Self::Other(_) => "convert it to .vti, .vts, .vtu, .nrrd, .npy, Zarr or raw",
        }
    }
}

/// The error for a file whose content is not what its extension says.
fn wrong_extension(path: &Path, extension: &str, format: Format, content: Content) -> SourceError {
    let problem = format!(
        "it stands for {}, but the content is {}; {}",
        format.name(),
        content.name(),
        content.remedy()
    );
    SourceError::corrupt(path, "extension", extension, problem)
}

/// The error for an extension that stands for nothing.
fn unknown_extension(path: &Path, extension: &str, content: Content) -> SourceError {
    let shown = if extension.is_empty() { "missing" } else { extension };
    let remedy = match content {
        Content::Unknown => {
            ".vti, .vts, .vtr, .vtu, .pvts, .pvtr, .pvtu, .vtk, .pvd, .nrrd, .nhdr, .npy, Zarr folders, PLOT3D (.xyz with .q) and raw files \
             with --dims and --dtype are"
                .to_owned()
        }
        known => format!("the content is {}; {}", known.name(), known.remedy()),
    };
    SourceError::unsupported(path, "extension", shown, remedy)
}
