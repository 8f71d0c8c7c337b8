//! Files that appear under their name only when they are whole.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

use crate::interrupt::CleanUp;

/// A file that is written beside its target under a temporary name. [`Self::publish`] renames it;
/// dropped before that, it is removed, with the folders that were made for it.
#[derive(Debug)]
pub(super) struct PendingFile {
    temporary: PathBuf,
    target: PathBuf,
    /// Folders that did not exist before, outermost first.
    made_folders: Vec<PathBuf>,
    published: bool,
    /// Until the file has its name or is gone, Ctrl-C waits.
    _clean_up: CleanUp,
}

impl PendingFile {
    /// Makes the folders that lead to `target`; the caller creates the file at [`Self::path`].
    pub(super) fn new(target: &Path) -> Result<Self> {
        let Some(name) = target.file_name() else {
            bail!("output '{}' is not a file name: give a name like movie.gif", target.display());
        };
        if target.is_dir() {
            bail!("output '{}' is a folder: give a file name in it", target.display());
        }
        let mut hidden = OsString::from(".");
        hidden.push(name);
        hidden.push(format!(".{}.partial", std::process::id()));
        let mut pending = Self {
            temporary: target.with_file_name(hidden),
            target: target.to_owned(),
            made_folders: Vec::new(),
            published: false,
            _clean_up: CleanUp::begin(),
        };
        pending.make_folders()?;
        Ok(pending)
    }

    fn make_folders(&mut self) -> Result<()> {
        let folder = self.target.parent().filter(|folder| !folder.as_os_str().is_empty());
        let missing: Vec<&Path> = folder
            .into_iter()
            .flat_map(Path::ancestors)
            .take_while(|a| !a.as_os_str().is_empty() && !a.exists())
            .collect();
        for folder in missing.into_iter().rev() {
            fs::create_dir(folder)
                .with_context(|| format!("cannot make the folder '{}' for the output", folder.display()))?;
            self.made_folders.push(folder.to_owned());
        }
        Ok(())
    }

    /// Where to write.
    pub(super) fn path(&self) -> &Path {
        &self.temporary
    }

    /// Where it will be found.
    pub(super) fn target(&self) -> &Path {
        &self.target
    }

    /// Creates the file.
    pub(super) fn create(&self) -> Result<fs::File> {
        fs::File::create(&self.temporary)
            .with_context(|| format!("cannot write '{}': is its folder writable?", self.target.display()))
    }

    /// Gives the file its name, replacing what had it before.
    pub(super) fn publish(mut self) -> Result<()> {
        let synced =
            fs::OpenOptions::new().write(true).open(&self.temporary).and_then(|file| file.sync_all());
        synced
            .and_then(|()| fs::rename(&self.temporary, &self.target))
            .with_context(|| format!("cannot finish '{}'", self.target.display()))?;
        self.published = true;
        Ok(())
    }
}

impl Drop for PendingFile {
    fn drop(&mut self) {
        if self.published {
            return;
        }
        // Nothing can be done about a failure here, and the first error is already on its way.
        let _ = fs::remove_file(&self.temporary);
        for folder in self.made_folders.iter().rev() {
            let _ = fs::remove_dir(folder);
        }
    }
}
