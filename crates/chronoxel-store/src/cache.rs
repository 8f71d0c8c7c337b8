//! A cache bounded in bytes, least recently used out first.

use std::{
    collections::HashMap,
    hash::Hash,
    sync::{Arc, Mutex, PoisonError},
};

/// Values by key, at most so many bytes and entries of them; a single larger value is not kept.
#[derive(Debug)]
pub(crate) struct ByteCache<K, V> {
    most_bytes: usize,
    most_entries: usize,
    inner: Mutex<Inner<K, V>>,
}

#[derive(Debug)]
struct Inner<K, V> {
    entries: HashMap<K, Entry<V>>,
    bytes: usize,
    clock: u64,
}

#[derive(Debug)]
struct Entry<V> {
    value: Arc<V>,
    bytes: usize,
    used: u64,
}

impl<K: Copy + Eq + Hash, V> ByteCache<K, V> {
    pub fn new(most_bytes: usize, most_entries: usize) -> Self {
        let inner = Inner { entries: HashMap::new(), bytes: 0, clock: 0 };
        Self { most_bytes, most_entries, inner: Mutex::new(inner) }
    }

    pub fn get(&self, key: &K) -> Option<Arc<V>> {
        let mut inner = self.inner.lock().unwrap_or_else(PoisonError::into_inner);
        inner.clock += 1;
        let now = inner.clock;
        inner.entries.get_mut(key).map(|entry| {
            entry.used = now;
            entry.value.clone()
        })
    }

    pub fn insert(&self, key: K, value: Arc<V>, bytes: usize) {
        if bytes > self.most_bytes {
            return;
        }
        let mut inner = self.inner.lock().unwrap_or_else(PoisonError::into_inner);
        inner.clock += 1;
        let entry = Entry { value, bytes, used: inner.clock };
        inner.bytes += bytes;
        if let Some(replaced) = inner.entries.insert(key, entry) {
            inner.bytes -= replaced.bytes;
        }
        while inner.bytes > self.most_bytes || inner.entries.len() > self.most_entries {
            let oldest = inner.entries.iter().min_by_key(|(_, entry)| entry.used).map(|(key, _)| *key);
            let Some(removed) = oldest.and_then(|key| inner.entries.remove(&key)) else { return };
            inner.bytes -= removed.bytes;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_recently_used_goes_first_and_bytes_are_bounded() {
        let cache = ByteCache::new(100, 10);
        (0..3).for_each(|key| cache.insert(key, Arc::new(key), 40));
        assert!(cache.get(&0).is_none());
        assert_eq!(cache.get(&1).as_deref(), Some(&1));
        cache.insert(3, Arc::new(3), 40);
        assert!(cache.get(&2).is_none() && cache.get(&1).is_some());
        cache.insert(4, Arc::new(4), 101);
        assert!(cache.get(&4).is_none());
    }
}
