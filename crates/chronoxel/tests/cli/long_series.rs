//! A thousand steps: one is drawn from its own bytes.

use std::time::Instant;

use chronoxel_store::Store;
use tempfile::tempdir;

use crate::{
    command::{at, done, json, number},
    files::{noise, write_u8_steps},
};

#[test]
fn one_step_of_a_thousand_is_drawn_from_its_own_bytes() {
    let folder = tempdir().unwrap();
    let folder = folder.path();
    write_u8_steps(&folder.join("long.npy"), 1000, [12, 12, 12], |step, [x, y, z]| {
        noise((step * 1728 + z * 144 + y * 12 + x) as u64) as u8
    });
    done(folder, "encode long.npy -o long.cxl --brick 16 -q");
    let start = Instant::now();
    let store = Store::open(&folder.join("long.cxl")).unwrap();
    println!("a store of {} steps opened in {:?}", store.header().num_steps(), start.elapsed());
    let stored = number(&json(folder, "info long.cxl"), "stored_bytes");
    assert!(stored > 1728.0 * 1000.0, "noise is not compressed: {stored}");
    for step in [0, 512, 999] {
        let report = json(folder, &format!("play long.cxl --steps {step} --warm off --size 16x16"));
        let read = number(&report, "bytes_from_disk");
        // A payload of 19³ bytes at most, and what finds it: spans and an index of up to 64 steps.
        assert!((1728.0..20_000.0).contains(&read), "step {step} took {read} of {stored} bytes");
    }
    let played = json(folder, "play long.cxl --steps 100:200 --warm off --size 16x16");
    assert_eq!(at(&played, "frames"), 100);
    assert!(number(&played, "bytes_from_disk") < 0.2 * stored);
}
