//! Raw binary files under whatever the caller says of them.
#![no_main]

use chronoxel_core::SampleType;
use chronoxel_fuzz::{read_source, write};
use chronoxel_ingest::sources::SourceOptions;
use libfuzzer_sys::fuzz_target;

const TYPES: [&str; 10] = ["i8", "u8", "i16", "u16", "i32", "u32", "i64", "u64", "f32", "f64"];

fuzz_target!(|input: ([u64; 3], u8, bool, u64, [f64; 3], [f64; 3], Option<f64>, Option<f64>, &[u8])| {
    let (dims, sample_type, big_endian, header_bytes, spacing, origin, dt, fill_value, bytes) = input;
    // Small dimensions half of the time: those fit the file now and then.
    let dims = if sample_type & 0x80 == 0 { dims.map(|n| n % 9) } else { dims };
    let options = SourceOptions {
        dims: Some(dims.map(|n| n as usize)),
        sample_type: TYPES[usize::from(sample_type & 0x7f) % TYPES.len()].parse::<SampleType>().ok(),
        big_endian,
        header_bytes,
        spacing: Some(spacing),
        origin: Some(origin),
        dt,
        fill_value,
        ..SourceOptions::default()
    };
    read_source(&write("a.raw", bytes), &options);
    // The same with a header of what the samples leave over, so that the length is right.
    let product = dims.iter().try_fold(1u64, |product, &n| product.checked_mul(n));
    let num_bytes = options.sample_type.map_or(1, |t| t.num_bytes() as u64);
    let rest =
        product.and_then(|n| n.checked_mul(num_bytes)).and_then(|n| (bytes.len() as u64).checked_sub(n));
    if let Some(header_bytes) = rest {
        read_source(&scratch_raw(), &SourceOptions { header_bytes, spacing: None, origin: None, ..options });
    }
});

fn scratch_raw() -> std::path::PathBuf {
    chronoxel_fuzz::scratch().join("a.raw")
}
