//! Which bytes are stored already, and where: found by 128-bit digest, compared byte for byte by the writer.

use std::collections::{HashMap, VecDeque};

use chronoxel_core::PayloadAddress;
use xxhash_rust::xxh3::Xxh3;

/// Digests remembered at most; the oldest is forgotten first. A constant, so that the same input gives
/// the same store whatever the memory.
pub const MAX_DIGESTS: usize = 1 << 20;

/// Bytes of one entry in the journal.
pub(crate) const ENTRY_BYTES: usize = 24;

/// The digest of parts that make one payload or mask, within a `scope` (variable, level, window, class) that no other
/// scope shares bytes with.
pub(crate) fn digest_of<'a>(scope: [u32; 4], parts: impl Iterator<Item = &'a [u8]>) -> u128 {
    let mut hasher = Xxh3::new();
    scope.iter().for_each(|number| hasher.update(&number.to_le_bytes()));
    parts.for_each(|part| hasher.update(part));
    hasher.digest128()
}

/// Where bytes of a digest were stored first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct DigestEntry {
    pub digest: u128,
    pub at: PayloadAddress,
}

impl DigestEntry {
    pub fn to_bytes(self) -> [u8; ENTRY_BYTES] {
        let mut bytes = [0; ENTRY_BYTES];
        bytes[..16].copy_from_slice(&self.digest.to_le_bytes());
        bytes[16..20].copy_from_slice(&self.at.row.to_le_bytes());
        bytes[20..].copy_from_slice(&self.at.node.to_le_bytes());
        bytes
    }

    pub fn from_bytes(bytes: &[u8; ENTRY_BYTES]) -> Self {
        let number = |at: usize| u32::from_le_bytes(std::array::from_fn(|i| bytes[at + i]));
        let digest = u128::from_le_bytes(std::array::from_fn(|i| bytes[i]));
        Self { digest, at: PayloadAddress { row: number(16), node: number(20) } }
    }
}

/// The digests of the payloads and masks stored last.
#[derive(Debug)]
pub(crate) struct DigestTable {
    most: usize,
    /// In the order of insertion; the first has the number `num_forgotten`.
    entries: VecDeque<DigestEntry>,
    num_forgotten: u64,
    number_of: HashMap<u128, u64>,
}

impl DigestTable {
    pub fn new(most: usize) -> Self {
        Self { most, entries: VecDeque::new(), num_forgotten: 0, number_of: HashMap::new() }
    }

    pub fn get(&self, digest: u128) -> Option<PayloadAddress> {
        let number = self.number_of.get(&digest)?;
        self.entries.get((number - self.num_forgotten) as usize).map(|entry| entry.at)
    }

    pub fn insert(&mut self, entry: DigestEntry) {
        let number = self.num_forgotten + self.entries.len() as u64;
        self.number_of.insert(entry.digest, number);
        self.entries.push_back(entry);
        if self.entries.len() > self.most
            && let Some(oldest) = self.entries.pop_front()
        {
            if self.number_of.get(&oldest.digest) == Some(&self.num_forgotten) {
                self.number_of.remove(&oldest.digest);
            }
            self.num_forgotten += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_digest_is_forgotten_first() {
        let at = |row| PayloadAddress { row, node: 0 };
        let mut table = DigestTable::new(2);
        table.insert(DigestEntry { digest: 1, at: at(1) });
        table.insert(DigestEntry { digest: 2, at: at(2) });
        table.insert(DigestEntry { digest: 1, at: at(3) });
        assert_eq!((table.get(1), table.get(2)), (Some(at(3)), Some(at(2))));
        table.insert(DigestEntry { digest: 4, at: at(4) });
        assert_eq!((table.get(1), table.get(2), table.get(4)), (Some(at(3)), None, Some(at(4))));
    }

    #[test]
    fn digests_differ_between_scopes_and_survive_the_journal() {
        let parts = || [b"ab".as_slice(), b"c"].into_iter();
        let digest = digest_of([0, 1, 2, 3], parts());
        assert_ne!(digest, digest_of([0, 1, 2, 4], parts()));
        let entry = DigestEntry { digest, at: PayloadAddress { row: 7, node: 1 << 20 } };
        assert_eq!(DigestEntry::from_bytes(&entry.to_bytes()), entry);
    }
}
