//! Makes the version-1 fixture: `cargo run -p chronoxel-store --example make_fixture -- PATH.cxl`.
//!
//! The committed ones are never made anew: they show that what version 1 wrote then can be read now.

#[path = "../tests/fixture/mod.rs"]
mod fixture;
#[path = "../tests/known/mod.rs"]
mod known;

use chronoxel_store::TimeTreeEntry;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).ok_or("usage: make_fixture PATH.cxl")?;
    Ok(fixture::write_store(path.as_ref(), fixture::NUM_STEPS, Some(TimeTreeEntry { stride: 1 }))?)
}
