//! A least-recently-used cache over a budget of bytes that holds at every instant.

use std::{
    collections::{BTreeMap, HashMap},
    hash::Hash,
};

/// What the cache did so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CacheCounts {
    /// Look-ups that found their entry.
    pub hits: u64,
    /// Look-ups that did not.
    pub misses: u64,
    /// Entries that had to go.
    pub evictions: u64,
    /// The most bytes ever held.
    pub peak_bytes: usize,
}

#[derive(Debug)]
struct Entry<V> {
    value: V,
    num_bytes: usize,
    last_use: u64,
}

/// Values by key, the least recently used ones leaving first when the budget is full.
#[derive(Debug)]
pub struct ByteLru<K, V> {
    budget_bytes: usize,
    most_entries: usize,
    held_bytes: usize,
    now: u64,
    entries: HashMap<K, Entry<V>>,
    /// Keys by last use; every use has its own number.
    by_use: BTreeMap<u64, K>,
    counts: CacheCounts,
}

impl<K: Copy + Eq + Hash, V: Clone> ByteLru<K, V> {
    /// An empty cache that never holds more than `budget_bytes`.
    pub fn new(budget_bytes: usize) -> Self {
        Self::with_most_entries(budget_bytes, usize::MAX)
    }

    /// An empty cache that never holds more than `budget_bytes`, nor more than `most_entries` (at least 1), for values that
    /// hold something else that is scarce, such as open files.
    pub fn with_most_entries(budget_bytes: usize, most_entries: usize) -> Self {
        Self {
            budget_bytes,
            most_entries: most_entries.max(1),
            held_bytes: 0,
            now: 0,
            entries: HashMap::new(),
            by_use: BTreeMap::new(),
            counts: CacheCounts::default(),
        }
    }

    /// The value of `key`, which becomes the most recently used.
    pub fn get(&mut self, key: &K) -> Option<V> {
        let Some(entry) = self.entries.get_mut(key) else {
            self.counts.misses += 1;
            return None;
        };
        self.counts.hits += 1;
        self.now += 1;
        self.by_use.remove(&entry.last_use);
        self.by_use.insert(self.now, *key);
        entry.last_use = self.now;
        Some(entry.value.clone())
    }

    /// Puts a value in, making room first; a value larger than the whole budget is not kept.
    pub fn insert(&mut self, key: K, value: V, num_bytes: usize) {
        self.remove(&key);
        if num_bytes > self.budget_bytes {
            return;
        }
        while self.held_bytes + num_bytes > self.budget_bytes || self.entries.len() >= self.most_entries {
            let (_, oldest) = self.by_use.pop_first().expect("bytes or entries are held, so an entry is");
            let entry = self.entries.remove(&oldest).expect("both maps hold the same keys");
            self.held_bytes -= entry.num_bytes;
            self.counts.evictions += 1;
        }
        self.now += 1;
        self.by_use.insert(self.now, key);
        self.entries.insert(key, Entry { value, num_bytes, last_use: self.now });
        self.held_bytes += num_bytes;
        self.counts.peak_bytes = self.counts.peak_bytes.max(self.held_bytes);
    }

    fn remove(&mut self, key: &K) {
        if let Some(entry) = self.entries.remove(key) {
            self.by_use.remove(&entry.last_use);
            self.held_bytes -= entry.num_bytes;
        }
    }

    /// Bytes that may be held.
    pub fn budget_bytes(&self) -> usize {
        self.budget_bytes
    }

    /// Bytes held now.
    pub fn held_bytes(&self) -> usize {
        self.held_bytes
    }

    /// What happened so far.
    pub fn counts(&self) -> CacheCounts {
        self.counts
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_recently_used_leaves_first() {
        let mut cache = ByteLru::new(10);
        cache.insert("a", 1, 4);
        cache.insert("b", 2, 4);
        assert_eq!(cache.get(&"a"), Some(1));
        cache.insert("c", 3, 4);
        assert_eq!(cache.get(&"b"), None);
        assert_eq!((cache.get(&"a"), cache.get(&"c")), (Some(1), Some(3)));
        assert_eq!(cache.counts(), CacheCounts { hits: 3, misses: 1, evictions: 1, peak_bytes: 8 });
    }

    #[test]
    fn the_number_of_entries_is_bounded_too() {
        let mut cache = ByteLru::with_most_entries(1000, 2);
        (0..5).for_each(|key| cache.insert(key, key, 1));
        assert_eq!((cache.get(&2), cache.get(&3), cache.get(&4)), (None, Some(3), Some(4)));
    }

    #[test]
    fn the_budget_holds_under_any_sizes() {
        let mut cache = ByteLru::new(1000);
        let mut random = 12345u64;
        for _ in 0..5000 {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            cache.insert(random >> 58, (), (random >> 40 & 0x3ff) as usize);
            let held: usize = cache.entries.values().map(|e| e.num_bytes).sum();
            assert_eq!(held, cache.held_bytes());
            assert!(held <= 1000 && cache.entries.len() == cache.by_use.len());
        }
    }
}
