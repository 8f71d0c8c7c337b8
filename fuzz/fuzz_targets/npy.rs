//! NumPy files.
#![no_main]

use chronoxel_fuzz::{read_source, write};
use chronoxel_ingest::sources::SourceOptions;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| read_source(&write("a.npy", bytes), &SourceOptions::default()));
