//! A cache bounded in bytes and entries that several threads share.

use std::{
    hash::Hash,
    sync::{Arc, Mutex, PoisonError},
};

use chronoxel_core::ByteLru;

/// Values by key, at most so many bytes and entries of them; a single larger value is not kept.
#[derive(Debug)]
pub(crate) struct ByteCache<K, V>(Mutex<ByteLru<K, Arc<V>>>);

impl<K: Copy + Eq + Hash, V> ByteCache<K, V> {
    pub fn new(most_bytes: usize, most_entries: usize) -> Self {
        Self(Mutex::new(ByteLru::with_most_entries(most_bytes, most_entries)))
    }

    pub fn get(&self, key: &K) -> Option<Arc<V>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).get(key)
    }

    pub fn insert(&self, key: K, value: Arc<V>, bytes: usize) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).insert(key, value, bytes);
    }
}
