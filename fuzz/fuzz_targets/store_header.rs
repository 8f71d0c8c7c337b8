//! The header of a store: any text in place of the fixture's, its checksum put right.
#![no_main]

use chronoxel_fuzz::fixture;
use libfuzzer_sys::fuzz_target;

const KEY: &str = "\"z_crc32c\": \"";

fuzz_target!(|text: &str| {
    let mut text = text.to_owned();
    if let Some(at) = text.rfind(KEY).map(|at| at + KEY.len()).filter(|at| text.get(*at..at + 8).is_some()) {
        text.replace_range(at..at + 8, "00000000");
        let crc = format!("{:08x}", crc32c::crc32c(text.as_bytes()));
        text.replace_range(at..at + 8, &crc);
    }
    fixture::with_file("zarr.json", text.as_bytes(), fixture::read_all);
});
