//! ParaView collections (`.pvd`): a list of files with the time of each.

use std::path::{Path, PathBuf};

use chronoxel_core::Samples;

use super::format::Format;
use super::mesh_files::{MeshFile, MeshShape, Topology};
use super::volume_file::{FileHeader, FileTimes, VolumeFile};
use super::xml::{Document, Element};
use super::{OpenedFile, SourceOptions};
use crate::{SourceError, StepReader};

/// A file of a collection, at the time that the collection gives.
struct TimedFile<H, F: ?Sized> {
    header: H,
    file: Box<F>,
}

/// Opens the files of a collection, in its order.
pub(crate) fn open(path: &Path, options: &SourceOptions) -> Result<Vec<OpenedFile>, SourceError> {
    let document = Document::read(path)?;
    document.root("Collection")?;
    let mut files = Vec::new();
    let mut last_time = None;
    for (_, element) in document.all("DataSet") {
        let (time, file_path) = entry(path, element)?;
        if let Some(last) = last_time.filter(|last| time <= *last) {
            let problem =
                format!("the entry before it has {last}; times must increase, and each have one file");
            return Err(SourceError::corrupt(path, "timestep", time, problem));
        }
        last_time = Some(time);
        let format = Format::of(&file_path, options)?;
        let file = super::open_file(&file_path, format, options)?;
        files.push(match file {
            OpenedFile::Volume(file) => {
                let header = timed(path, file.header(), time)?;
                OpenedFile::Volume(Box::new(TimedFile { header, file }))
            }
            OpenedFile::Mesh(file) => {
                let header = timed(path, file.header(), time)?;
                OpenedFile::Mesh(Box::new(TimedFile { header, file }))
            }
        });
    }
    if files.is_empty() {
        return Err(SourceError::corrupt(path, "Collection", "empty", "it must have at least one DataSet"));
    }
    Ok(files)
}

/// The header of a file of a collection, with the time that it gives; it must have one step.
fn timed<G: Clone>(
    collection: &Path,
    header: &FileHeader<G>,
    time: f64,
) -> Result<FileHeader<G>, SourceError> {
    if header.num_steps != 1 {
        let problem = format!("{} gives it one time", collection.display());
        return Err(SourceError::corrupt(&header.path, "number of time steps", header.num_steps, problem));
    }
    Ok(FileHeader { times: FileTimes::Known(vec![time]), ..header.clone() })
}

/// Time and path of one entry.
fn entry(path: &Path, element: &Element) -> Result<(f64, PathBuf), SourceError> {
    let time_text = element.get("timestep").unwrap_or("missing");
    let time = time_text.parse::<f64>().ok().filter(|t| t.is_finite()).ok_or_else(|| {
        SourceError::corrupt(path, "timestep", time_text, "every DataSet must have a finite number")
    })?;
    if let Some(part) = element.get("part").filter(|part| !matches!(*part, "" | "0")) {
        let remedy = "collections of one part are; append the parts to one image per time";
        return Err(SourceError::unsupported(path, "part", part, remedy));
    }
    let file = element
        .get("file")
        .filter(|file| !file.is_empty())
        .ok_or_else(|| SourceError::corrupt(path, "file", "missing", "every DataSet must name its file"))?;
    Ok((time, path.parent().unwrap_or(Path::new("")).join(file)))
}

impl VolumeFile for TimedFile<FileHeader, dyn VolumeFile> {
    fn header(&self) -> &FileHeader {
        &self.header
    }

    fn working_bytes(&self) -> u64 {
        self.file.working_bytes()
    }

    fn forget(&mut self) {
        self.file.forget();
    }

    fn open_step<'a>(
        &'a mut self,
        variable: usize,
        step: usize,
    ) -> Result<Box<dyn StepReader + 'a>, SourceError> {
        self.file.open_step(variable, step)
    }
}

impl MeshFile for TimedFile<FileHeader<MeshShape>, dyn MeshFile> {
    fn header(&self) -> &FileHeader<MeshShape> {
        &self.header
    }

    fn points(&self) -> Result<Vec<[f64; 3]>, SourceError> {
        self.file.points()
    }

    fn topology(&self) -> Result<Topology, SourceError> {
        self.file.topology()
    }

    fn read_values(&self, variable: usize) -> Result<Samples, SourceError> {
        self.file.read_values(variable)
    }

    fn notes(&self) -> Result<Vec<String>, SourceError> {
        self.file.notes()
    }
}
