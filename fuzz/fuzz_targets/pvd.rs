//! ParaView collections over two good volumes.
#![no_main]

use chronoxel_fuzz::{read_source, write};
use chronoxel_ingest::sources::SourceOptions;
use libfuzzer_sys::fuzz_target;

const GOOD: &[u8] = include_bytes!("../../crates/chronoxel-ingest/tests/fixtures/series/step8.vti");

fuzz_target!(|bytes: &[u8]| {
    for name in ["step8.vti", "step9.vti", "step10.vti"] {
        write(name, GOOD);
    }
    read_source(&write("run.pvd", bytes), &SourceOptions::default());
});
