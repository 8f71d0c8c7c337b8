//! Where the store lies while it is written, and what becomes of it after an error.

use std::fs;
use std::path::{Path, PathBuf};

use chronoxel_store::{CellStore, Store, StoreDescription, StoreError, StoreWriter};

use super::options::EncodeOptions;
use super::resume;
use crate::EncodeError;

/// A store that is being written, of bricks or of cells.
pub trait Begun: Sized {
    /// Everything that is known before the first step.
    type Description;

    /// Starts a store in a folder that does not exist.
    fn create(path: &Path, description: &Self::Description) -> Result<Self, StoreError>;

    /// Goes on with one, or starts it where nothing but its journal is there; also gives the first step to read.
    fn resume(path: &Path, description: &Self::Description) -> Result<(Self, u32), StoreError>;

    /// Says how a store that is there differs from what is to be written.
    fn compare(path: &Path, description: &Self::Description) -> Result<(), EncodeError>;

    /// Steps that can be read.
    fn num_steps_finished(&self) -> usize;

    /// Gives up: where what was finished is kept.
    fn abandon(self) -> Result<Option<PathBuf>, StoreError>;
}

impl Begun for StoreWriter {
    type Description = StoreDescription;

    fn create(path: &Path, description: &StoreDescription) -> Result<Self, StoreError> {
        Self::create(path, description, false)
    }

    fn resume(path: &Path, description: &StoreDescription) -> Result<(Self, u32), StoreError> {
        Self::resume(path, description)
    }

    fn compare(path: &Path, description: &StoreDescription) -> Result<(), EncodeError> {
        resume::compare(&Store::open(path)?, description)
    }

    fn num_steps_finished(&self) -> usize {
        self.header().num_steps_finished as usize
    }

    fn abandon(self) -> Result<Option<PathBuf>, StoreError> {
        Self::abandon(self)
    }
}

/// Whether a path is a store, of bricks or of cells, that a resume can go on with.
fn is_unfinished(path: &Path) -> bool {
    match CellStore::open(path).ok().filter(|cells| cells.path() == path) {
        Some(cells) => !cells.is_complete(),
        None => Store::open(path).is_ok_and(|store| !resume::is_finished(&store)),
    }
}

/// The folder being written.
pub struct Output {
    path: PathBuf,
    /// The store that is being replaced, out of the way until the new one is complete.
    replaced: Option<PathBuf>,
}

impl Output {
    /// Creates the store, or opens it to continue; also gives the first step to read.
    pub fn open<W: Begun>(
        path: &Path,
        description: &W::Description,
        options: &EncodeOptions,
    ) -> Result<(Self, W, u32), EncodeError> {
        let stem = path.file_stem().filter(|_| path.extension().is_some_and(|e| e == "cxl"));
        let Some(stem) = stem.and_then(|s| s.to_str()) else {
            return Err(EncodeError::InvalidArgument {
                argument: "output",
                value: path.display().to_string(),
                remedy: "the name of a store ends in .cxl".into(),
            });
        };
        let kept = path.with_file_name(format!("{stem}.partial.cxl"));
        // What an error left behind is newer than what it was to replace.
        let found = [&kept, path].into_iter().find(|p| exists(p));
        match found {
            Some(found) if options.resume => Self::resume(found, path, stem, description),
            Some(found) if !options.overwrite => {
                Err(EncodeError::OutputExists { path: found.to_owned(), is_unfinished: is_unfinished(found) })
            }
            _ => Self::create(path, &kept, stem, description),
        }
    }

    fn resume<W: Begun>(
        found: &Path,
        path: &Path,
        stem: &str,
        description: &W::Description,
    ) -> Result<(Self, W, u32), EncodeError> {
        // A replacement that was killed: the store it replaces still lies aside.
        let aside = aside_of(path, stem);
        let mut replaced = (exists(&aside) && check_is_store(&aside).is_ok()).then_some(aside);
        // A store killed while it was created has no header yet: the writer starts it again.
        if exists(&found.join("zarr.json")) {
            W::compare(found, description)?;
        }
        if found != path {
            replaced = set_aside(path, stem)?.or(replaced);
            rename(found, path)?;
        }
        let output = Self { path: path.to_owned(), replaced };
        let (writer, first) = W::resume(path, description)?;
        Ok((output, writer, first))
    }

    fn create<W: Begun>(
        path: &Path,
        kept: &Path,
        stem: &str,
        description: &W::Description,
    ) -> Result<(Self, W, u32), EncodeError> {
        let replaced = set_aside(path, stem)?;
        if exists(kept) {
            remove(kept)?;
        }
        let output = Self { path: path.to_owned(), replaced };
        match W::create(path, description) {
            Ok(writer) => Ok((output, writer, 0)),
            Err(error) => {
                let _ = fs::remove_dir_all(path);
                output.restore();
                Err(error.into())
            }
        }
    }

    /// The store is complete: what it replaced can go.
    pub fn keep(self) -> Result<(), EncodeError> {
        self.replaced.as_deref().map_or(Ok(()), remove)
    }

    /// After an error: nothing is left under the final name but what was there before.
    ///
    /// Returns the error, with what became of the finished steps.
    pub fn abandon<W: Begun>(self, writer: W, error: EncodeError) -> EncodeError {
        let num_steps = writer.num_steps_finished();
        let kept = match error {
            // A resume would fail the same way.
            EncodeError::NoData { .. } => {
                drop(writer);
                let _ = fs::remove_dir_all(&self.path);
                None
            }
            _ => match writer.abandon() {
                Ok(kept) => kept,
                // The first error is the one to report; the store is where it was.
                Err(_) => Some(self.path.clone()),
            },
        };
        self.restore();
        match kept {
            Some(path) if num_steps > 0 => {
                EncodeError::Interrupted { path, num_steps, source: Box::new(error) }
            }
            _ => error,
        }
    }

    /// Puts what was to be replaced back.
    fn restore(&self) {
        if let Some(replaced) = &self.replaced {
            // What fails here leaves the old store under its other name, complete.
            let _ = fs::rename(replaced, &self.path);
        }
    }
}

fn exists(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok()
}

/// Where a store lies that is being replaced.
fn aside_of(path: &Path, stem: &str) -> PathBuf {
    path.with_file_name(format!(".{stem}.replaced.cxl"))
}

/// Renames a store that is in the way, so that it can come back after an error.
fn set_aside(path: &Path, stem: &str) -> Result<Option<PathBuf>, EncodeError> {
    if !exists(path) {
        return Ok(None);
    }
    check_is_store(path)?;
    let aside = aside_of(path, stem);
    if exists(&aside) {
        remove(&aside)?;
    }
    rename(path, &aside)?;
    Ok(Some(aside))
}

/// Only stores are ever removed: a folder of anything else is the user's.
fn check_is_store(path: &Path) -> Result<(), EncodeError> {
    let header = path.join("zarr.json");
    let is_store = fs::read_to_string(&header)
        .is_ok_and(|text| text.contains("\"chronoxel\"") || text.contains("\"chronoxel_cells\""));
    let is_empty = fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_none());
    if is_store || is_empty {
        return Ok(());
    }
    Err(EncodeError::InvalidArgument {
        argument: "--overwrite",
        value: path.display().to_string(),
        remedy: "this is not a Chronoxel store: remove it yourself, or choose another name".into(),
    })
}

fn remove(path: &Path) -> Result<(), EncodeError> {
    check_is_store(path)?;
    fs::remove_dir_all(path).map_err(|source| io(path, "remove", source))
}

fn rename(from: &Path, to: &Path) -> Result<(), EncodeError> {
    fs::rename(from, to).map_err(|source| io(from, "rename", source))
}

fn io(path: &Path, action: &'static str, source: std::io::Error) -> EncodeError {
    StoreError::Io { path: path.to_owned(), action, source }.into()
}
