//! Where a bench works: a folder of its own that is gone afterwards, also when it is interrupted.

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::Context;

use crate::interrupt::CleanUp;

/// A folder of a bench. Dropped, it is removed with all that lies in it.
#[derive(Debug)]
pub struct Workplace {
    folder: PathBuf,
    /// Until the folder is gone, Ctrl-C waits.
    _clean_up: CleanUp,
}

impl Workplace {
    /// A new folder within `parent`, which exists.
    ///
    /// # Errors
    /// If it cannot be made.
    pub fn within(parent: &Path) -> anyhow::Result<Self> {
        let clean_up = CleanUp::begin();
        let folder = parent.join(format!("chronoxel-bench-{}", std::process::id()));
        fs::create_dir(&folder)
            .with_context(|| format!("{}: cannot make the folder to work in", folder.display()))?;
        Ok(Self { folder, _clean_up: clean_up })
    }

    /// The path of something in the folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// Removes a file or a folder that is no longer needed.
    ///
    /// # Errors
    /// If it cannot be removed.
    pub fn remove(&self, path: &Path) -> anyhow::Result<()> {
        let removed = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
        removed.with_context(|| format!("{}: cannot remove it", path.display()))
    }
}

impl Drop for Workplace {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_dir_all(&self.folder) {
            eprintln!("chronoxel: warning: {}: cannot remove it: {error}", self.folder.display());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_left() {
        let parent = tempfile::tempdir().unwrap();
        let place = Workplace::within(parent.path()).unwrap();
        let (file, folder) = (place.path("a"), place.path("b"));
        fs::write(&file, "1").unwrap();
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("c"), "2").unwrap();
        place.remove(&file).unwrap();
        assert!(!file.exists() && folder.exists());
        drop(place);
        assert_eq!(fs::read_dir(parent.path()).unwrap().count(), 0);
    }
}
