//! Hash maps over nodes that live for a frame: hundreds of thousands of look-ups, so the hash is a multiplication.

use std::{
    collections::HashMap,
    hash::{BuildHasherDefault, Hasher},
};

use chronoxel_core::NodeId;

/// A map from nodes.
pub(super) type NodeMap<V> = HashMap<NodeId, V, BuildHasherDefault<NodeHasher>>;

/// Fibonacci hashing (Knuth, volume 3, section 6.4) of the few numbers of a node.
#[derive(Default)]
pub(super) struct NodeHasher(u64);

impl Hasher for NodeHasher {
    fn finish(&self) -> u64 {
        // A product's good bits are the high ones, and tables look at the low ones as well.
        self.0 ^ self.0 >> 32
    }

    fn write(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|byte| self.write_u64(u64::from(*byte)));
    }

    fn write_u8(&mut self, value: u8) {
        self.write_u64(u64::from(value));
    }

    fn write_u64(&mut self, value: u64) {
        self.0 = (self.0.rotate_left(5) ^ value).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    }
}
