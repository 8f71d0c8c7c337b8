//! Reads files that other programs wrote, whole and broken, and compares every sample.

mod files;
mod fixtures;
mod hostile;
mod npy;
mod nrrd;
mod raw;
mod real_data;
mod series;
mod vti;
mod zarr;
