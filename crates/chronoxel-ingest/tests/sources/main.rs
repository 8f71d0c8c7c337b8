//! Reads files that other programs wrote, whole and broken, and compares every sample.

mod files;
mod fixtures;
mod npy;
mod nrrd;
mod raw;
mod series;
mod vti;
mod zarr;
