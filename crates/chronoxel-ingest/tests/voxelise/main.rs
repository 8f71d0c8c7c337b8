//! Meshes as bricks: what is sampled, what a store of them holds.

mod linear;
