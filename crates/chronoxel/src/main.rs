//! The `chronoxel` command.
fn main() {}
