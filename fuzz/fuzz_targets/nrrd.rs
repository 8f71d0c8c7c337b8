//! NRRD files, whole and with data of their own beside them.
#![no_main]

use chronoxel_fuzz::{read_source, write};
use chronoxel_ingest::sources::SourceOptions;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    // What detached headers of the seeds name: three slices, one file, or what the fuzzer makes of it.
    for name in ["slice0.raw", "slice1.raw", "one.raw", "part01.raw"] {
        write(name, &[7; 480]);
    }
    read_source(&write("a.nrrd", bytes), &SourceOptions::default());
    read_source(&write("a.nhdr", bytes), &SourceOptions::default());
});
