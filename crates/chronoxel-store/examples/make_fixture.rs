//! Makes the version-1 fixture: `cargo run -p chronoxel-store --example make_fixture -- PATH.cxl`.
//!
//! The committed one is never made anew: it shows that what version 1 wrote then can be read now.

#[path = "../tests/fixture/mod.rs"]
mod fixture;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).ok_or("usage: make_fixture PATH.cxl")?;
    Ok(fixture::write_store(path.as_ref(), fixture::NUM_STEPS)?)
}
