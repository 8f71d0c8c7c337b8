//! The command line, tested as a user runs it: the built binary, files in, files out, exit status and messages.

mod bad_input;
mod bad_stores;
mod bench;
mod cell_pictures;
mod cells;
mod coherence;
mod command;
mod damage;
mod encode;
mod files;
mod fixture_v1;
mod gpu;
mod interruption;
mod long_series;
mod memory;
mod meshes;
mod movies;
mod pictures;
mod playing;
mod usage;
mod voxels;
