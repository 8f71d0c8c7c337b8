//! Zarr arrays of versions 2 and 3, and what consolidated metadata says of them: the input is the metadata, up
//! to the first NUL byte, and a chunk, which is put where the first two chunks are looked for.
#![no_main]

use chronoxel_fuzz::{read_source, scratch, write};
use chronoxel_ingest::sources::SourceOptions;
use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| {
    let split = bytes.iter().position(|&b| b == 0).unwrap_or(bytes.len());
    let (metadata, chunk) = (&bytes[..split], bytes.get(split + 1..).unwrap_or_default());
    let is_second = metadata.windows(16).any(|window| window == b"\"zarr_format\": 2");
    let (used, unused) = if is_second { (".zarray", "zarr.json") } else { ("zarr.json", ".zarray") };
    let _ = std::fs::remove_file(scratch().join("a.zarr").join(unused));
    let path = write(&format!("a.zarr/{used}"), metadata);
    for name in ["0.0.0", "0.0.0.0", "1.0.0", "c/0/0/0", "c/1/0/0"] {
        write(&format!("a.zarr/{name}"), chunk);
    }
    if let Some(folder) = path.parent() {
        read_source(folder, &SourceOptions::default());
    }
});
