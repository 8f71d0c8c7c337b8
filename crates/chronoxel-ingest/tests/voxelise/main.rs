//! Meshes as bricks: what is sampled, what a store of them holds.

mod blocks;
mod blunt_fin;
#[path = "../common/files.rs"]
mod files;
mod linear;
mod meshes;
mod store;
mod tree;
