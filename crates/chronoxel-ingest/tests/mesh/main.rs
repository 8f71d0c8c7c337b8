//! Meshes: what their cells become, and the files that they come from.

mod conformity;
mod files;
mod pieces;
mod plot3d;
mod real_data;
mod refused;
mod split;
