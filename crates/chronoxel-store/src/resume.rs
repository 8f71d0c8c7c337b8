//! Going on with a store that was not finished, from the state of its last commit.

use std::{
    collections::{BTreeMap, HashSet},
    fs::{self, File},
    io::Read,
    path::Path,
};

use crate::{
    StoreDescription, StoreError,
    digest::{DigestEntry, ENTRY_BYTES},
    files,
    header::{Header, Totals},
    journal::{self, Numbers, StateSummary},
    layout,
    shard::OpenShard,
    spans::{NUM_FIELDS, OpenSpans},
    store::find_header,
    writer::{StoreWriter, partial_path},
};

impl StoreWriter {
    /// Goes on with a store that was interrupted, or starts it where there is none; also gives the first step
    /// that must be read again. Each node's spans go on at [`Self::covered_until`], which is that step or later.
    /// Statistics of the time tree that were put before the last commit ([`Self::steps_committed`]) are there; an encoder that
    /// must read steps before that one for its own sake may put theirs again, and commits none of those steps.
    /// Where the folder is absent and `NAME.partial.cxl` is there, that is taken. The finished store is
    /// byte for byte the one that an uninterrupted run makes.
    ///
    /// # Errors
    /// [`StoreError::InvalidArgument`] if the store was begun with another description or options,
    /// [`StoreError::Corrupt`] if its journal is damaged, [`StoreError::Io`] if the system refuses.
    pub fn resume(path: &Path, description: &StoreDescription) -> Result<(Self, u32), StoreError> {
        let header = Header::of_description(description)?;
        let partial = partial_path(path);
        if !path.exists() && partial.is_dir() {
            files::rename(&partial, path)?;
        }
        let description_crc = crc32c::crc32c(header.to_text()?.as_bytes());
        if let Some(found) = find_header(path)? {
            let found_crc = crc32c::crc32c(without_progress(&found).to_text()?.as_bytes());
            if found_crc != description_crc {
                let remedy =
                    "it was begun with another source or other options: use the same, or overwrite it";
                return Err(StoreError::invalid("store to resume", path.display(), remedy));
            }
            if found.num_steps_finished == found.num_steps() {
                return Self::resume_complete(path, found);
            }
        }
        match journal::read_state(&path.join(journal::FOLDER).join("state"))? {
            Some((summary, numbers)) => {
                if summary.description_crc != description_crc {
                    let remedy =
                        "it was begun with another source or other options: use the same, or overwrite it";
                    return Err(StoreError::invalid("store to resume", path.display(), remedy));
                }
                Self::resume_state(path, header, &summary, &numbers)
            }
            None => Ok((Self::create(path, description, path.join(journal::FOLDER).is_dir())?, 0)),
        }
    }

    fn resume_complete(path: &Path, header: Header) -> Result<(Self, u32), StoreError> {
        let journal = path.join(journal::FOLDER);
        files::remove_folder(&journal)?;
        fs::create_dir_all(&journal).map_err(StoreError::io(&journal, "create"))?;
        let num_steps = header.num_steps();
        let mut writer = Self::fresh(path, header)?;
        (writer.num_steps_put, writer.num_steps_committed) = (num_steps, num_steps);
        for (variable, time_level) in writer.header.each_time_level() {
            writer.statistics[usize::from(variable)][usize::from(time_level)].num_chunks_closed =
                writer.header.num_statistics_chunks(time_level);
        }
        writer.covered.iter_mut().flatten().flatten().for_each(|covered| *covered = num_steps);
        Ok((writer, num_steps))
    }

    fn resume_state(
        path: &Path,
        header: Header,
        summary: &StateSummary,
        numbers: &[u8],
    ) -> Result<(Self, u32), StoreError> {
        let mut writer = Self::fresh(path, header)?;
        let state = writer.journal_path("state");
        let wrong = |field: &str, value: usize| {
            StoreError::corrupt(&state, field, value, "it is not that of the header: encode the store anew")
        };
        if summary.windows.len() != writer.windows.len() {
            return Err(wrong("number of windows", summary.windows.len()));
        }
        if summary.ranges.len() != writer.header.variables.len() {
            return Err(wrong("number of variables", summary.ranges.len()));
        }
        writer.num_steps_committed = summary.num_steps_committed;
        writer.header.num_steps_finished = summary.num_steps_finished;
        writer.header.totals = summary.totals;
        writer.carry = summary.carry.clone();
        for (entry, range) in writer.header.variables.iter_mut().zip(&summary.ranges) {
            [entry.min, entry.max] = *range;
        }
        for (file, len) in &summary.unsynced {
            let path = path.join(file);
            let found = fs::metadata(&path).map(|metadata| metadata.len()).unwrap_or(0);
            if found != *len {
                let problem = format!("{len} were written before the machine stopped: encode the store anew");
                return Err(StoreError::corrupt(&path, "size in bytes", found, problem));
            }
            writer.unsynced.push((path, *len));
            writer.unsynced_bytes += len;
        }
        writer.restore_digests(summary)?;
        let mut numbers = Numbers { path: &state, rest: numbers };
        for covered in writer.covered.iter_mut().flatten() {
            let stored = numbers.take::<4>(covered.len())?;
            covered.iter_mut().zip(stored).for_each(|(to, from)| *to = u32::from_le_bytes(*from));
        }
        writer.restore_windows(summary, &mut numbers)?;
        writer.restore_statistics(summary, &mut numbers)?;
        writer.restore_kept(&summary.kept)?;
        writer.remove_leftovers()?;
        writer.write_header()?;
        let next = writer.covered.iter().flatten().flatten().copied().min().unwrap_or(0);
        writer.num_steps_put = next;
        Ok((writer, next))
    }

    fn restore_digests(&mut self, summary: &StateSummary) -> Result<(), StoreError> {
        let path = self.journal_path("digests");
        let mut file = File::open(&path).map_err(StoreError::io(&path, "open"))?;
        let len = summary.num_digests.saturating_mul(ENTRY_BYTES as u64);
        let mut left = len;
        let mut crc = 0;
        while left > 0 {
            let mut block = vec![0; left.min(ENTRY_BYTES as u64 * 4096) as usize];
            file.read_exact(&mut block).map_err(StoreError::io(&path, "read"))?;
            crc = crc32c::crc32c_append(crc, &block);
            left -= block.len() as u64;
            block.as_chunks().0.iter().for_each(|entry| self.digests.insert(DigestEntry::from_bytes(entry)));
        }
        if crc != summary.digests_crc {
            let problem = "the journal is damaged: encode the store anew";
            return Err(StoreError::corrupt(&path, "checksum", format!("{crc:08x}"), problem));
        }
        self.digest_file.set_len(len).map_err(StoreError::io(&path, "truncate"))?;
        (self.num_digests, self.digests_crc) = (summary.num_digests, crc);
        Ok(())
    }

    fn restore_windows(&mut self, summary: &StateSummary, numbers: &mut Numbers) -> Result<(), StoreError> {
        let keys: Vec<(u16, u8, u32)> = self.windows.keys().copied().collect();
        for (key, stored) in keys.into_iter().zip(&summary.windows) {
            let num_spans = self.header.rows_per_shard(key.2) as usize * self.header.num_nodes(key.1);
            let mut span_chunks = BTreeMap::new();
            for &(shard, num) in &stored.span_chunks {
                let spans = numbers.take::<{ 4 + 8 * NUM_FIELDS }>(num)?.iter().map(|bytes| {
                    let (place, fields) = bytes.split_at(4);
                    let (fields, _) = fields.as_chunks();
                    let place = u32::from_le_bytes(std::array::from_fn(|i| place[i]));
                    (place, std::array::from_fn(|field| f64::from_le_bytes(fields[field])))
                });
                let spans = OpenSpans(spans.collect());
                if let Some((place, _)) =
                    spans.0.last_key_value().filter(|(at, _)| **at as usize >= num_spans)
                {
                    let problem = "the level has fewer nodes: encode the store anew";
                    return Err(StoreError::corrupt(numbers.path, "place of a span", place, problem));
                }
                span_chunks.insert(shard, spans);
            }
            let mut shards = Vec::new();
            for shard in &stored.shards {
                let id = self.shard_id(key, shard.kind(), shard.shard);
                if !self.header.arrays_of(key.0, key.1, key.2).contains(&id.array) {
                    let problem = "the store has no such array: encode it anew";
                    return Err(StoreError::corrupt(numbers.path, "array", format!("{shard:?}"), problem));
                }
                let extents = numbers.take::<20>(shard.num_chunks)?.iter().map(|bytes| {
                    let number = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| bytes[at + i]));
                    (u32::from_le_bytes(std::array::from_fn(|i| bytes[i])), [number(4), number(12)])
                });
                let extents = extents.collect();
                let relative = self.header.shard_file(&id);
                let (temporary, path) = (self.journal_path(&relative), self.root.join(&relative));
                if !temporary.exists() && path.exists() {
                    // The commit that was interrupted had completed it already: take it back.
                    files::rename(&path, &temporary)?;
                }
                let chunk_bytes = self.header.chunk_bytes(&id.array);
                let num_slots = self.header.num_slots(&id.array);
                let open = OpenShard::reopen(temporary, num_slots, extents, shard.len, chunk_bytes)?;
                shards.push(((shard.kind(), shard.shard), open));
            }
            let window = self.windows.entry(key).or_default();
            window.num_shards_closed = stored.num_shards_closed;
            window.span_chunks.extend(span_chunks);
            window.shards.extend(shards);
        }
        Ok(())
    }

    /// Removes what a commit left that never came to its state: it will be written again.
    fn remove_leftovers(&mut self) -> Result<(), StoreError> {
        let mut kept = vec!["state".to_owned(), "digests".to_owned()];
        for (key, window) in &self.windows {
            let open = window.shards.keys().map(|&(kind, shard)| self.shard_id(*key, kind, shard));
            kept.extend(open.map(|id| self.header.shard_file(&id).replace('/', "!")));
        }
        kept.extend(self.kept.names_on_disk());
        let journal = self.root.join(journal::FOLDER);
        for name in files::names_in(&journal)?.iter().filter(|name| !kept.contains(name)) {
            files::remove_file(&journal.join(name))?;
        }
        self.remove_leftover_statistics()?;
        let keys: Vec<(u16, u8, u32)> = self.windows.keys().copied().collect();
        keys.into_iter().try_for_each(|key| self.remove_leftovers_of(key))
    }

    /// Removes the shards of a window length that are not complete, then the folders in which nothing is left.
    fn remove_leftovers_of(&mut self, key: (u16, u8, u32)) -> Result<(), StoreError> {
        let num_closed = self.windows.get(&key).map_or(0, |window| window.num_shards_closed);
        let (mut used, mut unused) = (HashSet::new(), Vec::new());
        for kind in self.header.data_kinds(key) {
            let folder = self.root.join(self.header.data_folder(key, kind));
            let mut num_kept = 0;
            for name in files::names_in(&folder)? {
                match layout::shard_of(&name) {
                    Some(shard) if shard >= num_closed => files::remove_file(&folder.join(&name))?,
                    Some(_) => num_kept += 1,
                    None => {}
                }
            }
            let children = self.header.data_children(key, kind)?.into_iter().map(|child| child.folder);
            if num_kept > 0 {
                self.described.insert((key, kind));
                used.extend(children);
            } else {
                unused.extend(children);
            }
        }
        for folder in unused.iter().filter(|folder| !used.contains(*folder)) {
            files::remove_folder(&self.root.join(folder))?;
        }
        Ok(())
    }
}

/// The header as it was before the first step.
fn without_progress(header: &Header) -> Header {
    let mut header = header.clone();
    header.num_steps_finished = 0;
    header.totals = Totals::default();
    header.variables.iter_mut().for_each(|v| [v.min, v.max] = [None; 2]);
    header
}
