//! Files that an encoder keeps in the journal between commits: what it carries that is too large for memory.
//!
//! Each time a file is made it gets a name of its own on disk, so that what the last state lists stays as it was until
//! the next state is written.

use std::{
    collections::BTreeMap,
    fs::{self, File, OpenOptions},
    path::PathBuf,
};

use crate::{
    StoreError, files,
    journal::{self, KeptSummary},
    writer::StoreWriter,
};

/// The files that are kept, and those that the last state lists but the next one will not.
#[derive(Debug, Default)]
pub(crate) struct KeptFiles {
    /// By name: which of all files made it is, and its length once a commit has seen it.
    current: BTreeMap<String, (u64, Option<u64>)>,
    /// Files made so far.
    num_made: u64,
    /// Names on disk.
    dropped: Vec<String>,
}

impl KeptFiles {
    /// Names on disk of the files that are kept.
    pub fn names_on_disk(&self) -> Vec<String> {
        self.current.iter().map(|(name, (number, _))| name_on_disk(name, *number)).collect()
    }
}

fn name_on_disk(name: &str, number: u64) -> String {
    format!("kept-{number}-{name}")
}

impl StoreWriter {
    /// Makes an empty file in the journal, open for reading and writing, in the place of the one of this name if there is
    /// one. The journal's state lists it from the next commit on, as it is then: after that commit it must not be changed. It is gone once the store is finished.
    ///
    /// * `name`: 1 to 64 characters of `a–z 0–9 _ - .`
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] for another name, [`StoreError::Io`] if the system refuses.
    pub fn keep_file(&mut self, name: &str) -> Result<File, StoreError> {
        let is_sound = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, '_' | '-' | '.');
        if name.is_empty() || name.len() > 64 || !name.chars().all(is_sound) {
            let remedy = "use 1 to 64 characters of a-z, 0-9, _, - and .";
            return Err(StoreError::invalid("name of a kept file", format!("{name:?}"), remedy));
        }
        self.drop_file(name);
        let number = self.kept.num_made;
        let path = self.journal_path(&name_on_disk(name, number));
        let file = OpenOptions::new().read(true).write(true).create(true).truncate(true).open(&path);
        let file = file.map_err(StoreError::io(&path, "create"))?;
        self.kept.num_made += 1;
        self.kept.current.insert(name.to_owned(), (number, None));
        Ok(file)
    }

    /// A file that [`Self::keep_file`] made, or that the state lists from which a resume goes on; `None` where there is none.
    ///
    /// # Errors
    /// [`StoreError::Io`] if the system refuses.
    pub fn kept_file(&self, name: &str) -> Result<Option<File>, StoreError> {
        let Some(&(number, _)) = self.kept.current.get(name) else { return Ok(None) };
        let path = self.journal_path(&name_on_disk(name, number));
        let file = OpenOptions::new().read(true).write(true).open(&path);
        file.map(Some).map_err(StoreError::io(&path, "open"))
    }

    /// Says that a file is needed no more. It is removed once the next commit's state, which does not list it, is written.
    pub fn drop_file(&mut self, name: &str) {
        if let Some((number, _)) = self.kept.current.remove(name) {
            self.kept.dropped.push(name_on_disk(name, number));
        }
    }

    /// What the state says of kept files. Those it lists for the first time count as written now.
    pub(crate) fn list_kept(&mut self) -> Result<Vec<KeptSummary>, StoreError> {
        for name in &self.kept.dropped {
            let path = self.journal_path(name);
            self.unsynced.retain(|(unsynced, _)| *unsynced != path);
        }
        let mut summary = Vec::new();
        for (name, (number, len)) in &mut self.kept.current {
            let path = self.root.join(journal::FOLDER).join(name_on_disk(name, *number));
            let len = match *len {
                Some(len) => len,
                None => {
                    let found = fs::metadata(&path).map_err(StoreError::io(&path, "read the size of"))?.len();
                    self.unsynced.push((path, found));
                    self.unsynced_bytes += found;
                    *len.insert(found)
                }
            };
            summary.push(KeptSummary { name: name.clone(), number: *number, len });
        }
        Ok(summary)
    }

    /// Removes the files that the state just written does not list any more.
    pub(crate) fn remove_dropped(&mut self) -> Result<(), StoreError> {
        let dropped = std::mem::take(&mut self.kept.dropped);
        let paths: Vec<PathBuf> = dropped.iter().map(|name| self.journal_path(name)).collect();
        paths.iter().try_for_each(|path| files::remove_file(path))
    }

    pub(crate) fn restore_kept(&mut self, summary: &[KeptSummary]) -> Result<(), StoreError> {
        for KeptSummary { name, number, len } in summary {
            let path = self.journal_path(&name_on_disk(name, *number));
            let found = fs::metadata(&path).map_err(StoreError::io(&path, "read the size of"))?.len();
            if found != *len {
                let problem = format!("the journal says {len}: the store cannot be resumed, encode it anew");
                return Err(StoreError::corrupt(&path, "size in bytes", found, problem));
            }
            self.kept.num_made = self.kept.num_made.max(number + 1);
            self.kept.current.insert(name.clone(), (*number, Some(*len)));
        }
        Ok(())
    }
}
