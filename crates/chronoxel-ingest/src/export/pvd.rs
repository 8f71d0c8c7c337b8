//! ParaView collections (`.pvd`): `NAME.pvd` lists `NAME/NAME_0000.vti`, … with their times.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use super::output::{PendingFile, PendingFolder};
use super::sample_bytes::sample_bytes;
use super::vti::{escaped, write_image};
use super::{ExportDescription, ExportError, StepWriter, check_step};

/// The collection, and the folder of its steps.
pub(super) struct PvdWriter {
    description: ExportDescription,
    collection: PendingFile,
    folder: PendingFolder,
    next_step: usize,
}

impl PvdWriter {
    pub fn create(path: &Path, description: &ExportDescription) -> Result<Self, ExportError> {
        let folder = PendingFolder::create(&path.with_extension(""))?;
        let collection = PendingFile::create(path)?;
        Ok(Self { description: description.clone(), collection, folder, next_step: 0 })
    }

    /// Path of a step's file relative to the collection.
    fn step_path(&self, step: usize) -> PathBuf {
        step_path(&self.folder, step, self.description.times.num_steps(), "vti")
    }
}

/// Path of a step's file relative to a collection whose steps lie in `folder`.
pub(super) fn step_path(folder: &PendingFolder, step: usize, num_steps: usize, extension: &str) -> PathBuf {
    let stem = folder.path().file_name().unwrap_or_default();
    let width = num_steps.saturating_sub(1).to_string().len().max(4);
    Path::new(stem).join(format!("{}_{step:0width$}.{extension}", stem.to_string_lossy()))
}

/// The text of a collection.
///
/// * `path_of`: the file of a step, relative to the collection
pub(super) fn collection_text(times: &[f64], path_of: impl Fn(usize) -> PathBuf) -> String {
    let mut text = String::from("<?xml version=\"1.0\"?>\n");
    text += "<VTKFile type=\"Collection\" version=\"1.0\" byte_order=\"LittleEndian\">\n  <Collection>\n";
    for (step, time) in times.iter().enumerate() {
        let file = escaped(&path_of(step).to_string_lossy());
        writeln!(text, "    <DataSet timestep=\"{time:?}\" part=\"0\" file=\"{file}\"/>")
            .expect("writing to a string");
    }
    text + "  </Collection>\n</VTKFile>\n"
}

impl StepWriter for PvdWriter {
    fn write_step(&mut self, step: usize, samples: &[f64]) -> Result<(), ExportError> {
        check_step(&self.description, self.next_step, step, samples);
        let path = self.step_path(step);
        let bytes = sample_bytes(&path, &self.description, step, samples)?;
        let inside = path.file_name().expect("a file in a folder");
        let mut file = PendingFile::create(&self.folder.temporary().join(inside))?;
        write_image(&mut file, &self.description, self.description.times.times[step], &bytes)?;
        self.next_step += 1;
        file.finish()
    }

    fn finish(mut self: Box<Self>) -> Result<(), ExportError> {
        assert_eq!(self.next_step, self.description.times.num_steps(), "steps written");
        let text = collection_text(&self.description.times.times, |step| self.step_path(step));
        self.collection.write(text.as_bytes())?;
        // The collection comes last: once it is there, everything that it names is.
        self.folder.finish()?;
        self.collection.finish()
    }
}
