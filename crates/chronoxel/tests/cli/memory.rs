//! `encode --memory`: what a series larger than the budget takes.

use tempfile::tempdir;

use crate::{
    command::{json, number},
    files::{noise, npy_bytes},
};

/// The program's code, its threads' stacks, and what the allocator keeps.
const BASE_BYTES: f64 = 10.0 * 1048576.0;

#[test]
fn a_series_is_encoded_within_its_budget() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    // 24 steps of 80³: 47 MiB of noise, which neither repeats nor shrinks.
    let samples: Vec<u8> =
        (0..24 * 80 * 80 * 80).flat_map(|i| ((noise(i) >> 40) as f32 + 1.0).to_le_bytes()).collect();
    std::fs::write(folder.join("large.npy"), npy_bytes("<f4", "24, 80, 80, 80", &samples)).unwrap();
    for budget_mib in [18.0, 28.0] {
        let line = format!("encode large.npy -o large.cxl --overwrite --memory {budget_mib}MiB --threads 2");
        let peak = number(&json(folder, &line), "peak_rss_bytes");
        println!("--memory {budget_mib} MiB: {:.1} MiB resident at most", peak / 1048576.0);
        assert!(peak < budget_mib * 1048576.0 + BASE_BYTES, "{peak} bytes at {budget_mib} MiB");
    }
}
