//! Chronoxel.
