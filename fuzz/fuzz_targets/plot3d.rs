//! PLOT3D: a grid, and a solution for it.
#![no_main]

use chronoxel_fuzz::{read_mesh, write};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|files: (&[u8], &[u8])| read_mesh(&[write("a.xyz", files.0), write("a.q", files.1)]));
