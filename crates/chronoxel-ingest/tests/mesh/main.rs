//! Meshes: what their cells become, and the files that they come from.

mod conformity;
mod split;
