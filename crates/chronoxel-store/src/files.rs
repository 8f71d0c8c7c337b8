//! The few file operations a store needs, with errors that name the file.

use std::{
    fs::{self, File},
    io::{ErrorKind, Read},
    panic::resume_unwind,
    path::{Path, PathBuf},
    sync::atomic::{AtomicUsize, Ordering},
};

use crate::StoreError;

/// Reads `buffer.len()` bytes at `offset` without moving a cursor.
pub(crate) fn read_at(file: &File, buffer: &mut [u8], offset: u64) -> std::io::Result<()> {
    #[cfg(unix)]
    return std::os::unix::fs::FileExt::read_exact_at(file, buffer, offset);
    #[cfg(windows)]
    {
        let mut done = 0;
        while done < buffer.len() {
            let at = offset + done as u64;
            match std::os::windows::fs::FileExt::seek_read(file, &mut buffer[done..], at)? {
                0 => return Err(ErrorKind::UnexpectedEof.into()),
                n => done += n,
            }
        }
        Ok(())
    }
}

/// A whole file of at most `most` bytes; `None` where there is none.
pub(crate) fn read_whole(path: &Path, most: u64) -> Result<Option<Vec<u8>>, StoreError> {
    let file = match File::open(path) {
        Ok(file) => file,
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(StoreError::io(path, "open")(e)),
    };
    let len = file.metadata().map_err(StoreError::io(path, "read the size of"))?.len();
    if len > most {
        return Err(StoreError::corrupt(path, "size in bytes", len, format!("at most {most} can be right")));
    }
    let mut bytes = Vec::with_capacity(len as usize);
    file.take(most).read_to_end(&mut bytes).map_err(StoreError::io(path, "read"))?;
    Ok(Some(bytes))
}

/// Waits until the bytes of files are on disk, many at a time: a disk takes them together.
pub(crate) fn sync_all(paths: &[PathBuf]) -> Result<(), StoreError> {
    const NUM_THREADS: usize = 16;
    let sync = |path: &PathBuf| {
        File::open(path).and_then(|file| file.sync_data()).map_err(StoreError::io(path, "sync"))
    };
    let next = AtomicUsize::new(0);
    let work = || std::iter::from_fn(|| paths.get(next.fetch_add(1, Ordering::Relaxed))).try_for_each(sync);
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..NUM_THREADS.min(paths.len())).map(|_| scope.spawn(work)).collect();
        threads.into_iter().try_for_each(|thread| thread.join().unwrap_or_else(|panic| resume_unwind(panic)))
    })
}

/// Writes a file whole.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> Result<(), StoreError> {
    fs::write(path, bytes).map_err(StoreError::io(path, "write"))
}

/// Renames a file over another.
pub(crate) fn rename(from: &Path, to: &Path) -> Result<(), StoreError> {
    fs::rename(from, to).map_err(StoreError::io(to, "rename a finished file to"))
}

/// Waits until the names in a folder are on disk, where the system can do that.
pub(crate) fn sync_folder(path: &Path) -> Result<(), StoreError> {
    #[cfg(unix)]
    File::open(path).and_then(|folder| folder.sync_all()).map_err(StoreError::io(path, "sync"))?;
    #[cfg(not(unix))]
    let _ = path;
    Ok(())
}

/// Removes a file if it is there.
pub(crate) fn remove_file(path: &Path) -> Result<(), StoreError> {
    match fs::remove_file(path) {
        Err(e) if e.kind() != ErrorKind::NotFound => Err(StoreError::io(path, "remove")(e)),
        _ => Ok(()),
    }
}

/// Removes a folder with everything in it if it is there.
pub(crate) fn remove_folder(path: &Path) -> Result<(), StoreError> {
    match fs::remove_dir_all(path) {
        Err(e) if e.kind() != ErrorKind::NotFound => Err(StoreError::io(path, "remove")(e)),
        _ => Ok(()),
    }
}

/// The names in a folder, sorted; empty where there is no folder.
pub(crate) fn names_in(path: &Path) -> Result<Vec<String>, StoreError> {
    let entries = match fs::read_dir(path) {
        Ok(entries) => entries,
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        Err(e) => return Err(StoreError::io(path, "list")(e)),
    };
    let mut names = Vec::new();
    for entry in entries {
        let entry = entry.map_err(StoreError::io(path, "list"))?;
        names.push(entry.file_name().to_string_lossy().into_owned());
    }
    names.sort();
    Ok(names)
}

/// What lies below a folder, sorted by path.
#[derive(Debug, Default)]
pub(crate) struct Listing {
    /// Every file with its length.
    pub files: Vec<(PathBuf, u64)>,
    /// Folders with nothing in them.
    pub empty_folders: Vec<PathBuf>,
}

impl Listing {
    /// What does not lie in a folder.
    pub fn without(mut self, folder: &Path) -> Self {
        self.files.retain(|(path, _)| !path.starts_with(folder));
        self.empty_folders.retain(|path| !path.starts_with(folder));
        self
    }
}

/// Everything below a folder.
pub(crate) fn list(root: &Path) -> Result<Listing, StoreError> {
    let (mut listing, mut folders) = (Listing::default(), vec![root.to_owned()]);
    while let Some(folder) = folders.pop() {
        let mut is_empty = true;
        for entry in fs::read_dir(&folder).map_err(StoreError::io(&folder, "list"))? {
            is_empty = false;
            let entry = entry.map_err(StoreError::io(&folder, "list"))?;
            let metadata = entry.metadata().map_err(StoreError::io(&folder, "list"))?;
            match metadata.is_dir() {
                true => folders.push(entry.path()),
                false => listing.files.push((entry.path(), metadata.len())),
            }
        }
        if is_empty {
            listing.empty_folders.push(folder);
        }
    }
    listing.files.sort();
    listing.empty_folders.sort();
    Ok(listing)
}
