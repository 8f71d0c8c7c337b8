//! Meshes in the formats of VTK: what the bytes begin with says which.
#![no_main]

use chronoxel_fuzz::{read_mesh, write};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    for name in ["a.vtk", "a.vts", "a.vtr", "a.vtu", "a.pvts", "a.pvtr", "a.pvtu"] {
        read_mesh(&[write(name, bytes)]);
    }
});
