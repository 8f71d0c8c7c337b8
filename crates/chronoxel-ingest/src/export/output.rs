//! Files and folders that get their name only when they are complete.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use super::ExportError;

/// A file under a temporary name beside the final one; removed unless it is finished.
pub(super) struct PendingFile {
    path: PathBuf,
    temporary: PathBuf,
    /// `None` once the file is finished.
    file: Option<BufWriter<File>>,
}

impl PendingFile {
    pub fn create(path: &Path) -> Result<Self, ExportError> {
        if path.is_dir() {
            return Err(ExportError::Exists { path: path.to_owned() });
        }
        let temporary = temporary_name(path);
        let file = File::create(&temporary).map_err(|e| ExportError::io(path, "create", e))?;
        Ok(Self { path: path.to_owned(), temporary, file: Some(BufWriter::with_capacity(1 << 20, file)) })
    }

    /// The final name.
    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn write(&mut self, bytes: &[u8]) -> Result<(), ExportError> {
        let file = self.file.as_mut().expect("not finished");
        file.write_all(bytes).map_err(|e| ExportError::io(&self.path, "write", e))
    }

    /// Syncs the file and renames it.
    pub fn finish(mut self) -> Result<(), ExportError> {
        let file = self.file.take().expect("not finished");
        let result = file
            .into_inner()
            .map_err(std::io::IntoInnerError::into_error)
            .and_then(|file| file.sync_all())
            .and_then(|()| fs::rename(&self.temporary, &self.path));
        result.map_err(|e| {
            // The write error is what the caller hears of.
            let _ = fs::remove_file(&self.temporary);
            ExportError::io(&self.path, "write", e)
        })
    }
}

impl Drop for PendingFile {
    fn drop(&mut self) {
        if self.file.take().is_some() {
            // Nothing can be done about a temporary file that cannot be removed.
            let _ = fs::remove_file(&self.temporary);
        }
    }
}

/// A folder under a temporary name beside the final one; removed unless it is finished.
pub(super) struct PendingFolder {
    path: PathBuf,
    temporary: PathBuf,
    finished: bool,
}

impl PendingFolder {
    /// Fails where the final name is taken: folders are not replaced.
    pub fn create(path: &Path) -> Result<Self, ExportError> {
        if fs::symlink_metadata(path).is_ok() {
            return Err(ExportError::Exists { path: path.to_owned() });
        }
        let temporary = temporary_name(path);
        fs::create_dir(&temporary).map_err(|e| ExportError::io(path, "create", e))?;
        Ok(Self { path: path.to_owned(), temporary, finished: false })
    }

    /// The folder while it is being filled.
    pub fn temporary(&self) -> &Path {
        &self.temporary
    }

    /// The final name.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes a file inside, with the folders on its way.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<(), ExportError> {
        let file = self.temporary.join(name);
        let folder = file.parent().expect("a file inside a folder");
        fs::create_dir_all(folder)
            .and_then(|()| fs::write(&file, bytes))
            .map_err(|e| ExportError::io(&self.path.join(name), "write", e))
    }

    pub fn finish(mut self) -> Result<(), ExportError> {
        fs::rename(&self.temporary, &self.path).map_err(|e| ExportError::io(&self.path, "create", e))?;
        self.finished = true;
        Ok(())
    }
}

impl Drop for PendingFolder {
    fn drop(&mut self) {
        if !self.finished {
            // As for files.
            let _ = fs::remove_dir_all(&self.temporary);
        }
    }
}

/// `.NAME.PID.partial` beside `NAME`.
fn temporary_name(path: &Path) -> PathBuf {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!(".{name}.{}.partial", std::process::id()))
}
