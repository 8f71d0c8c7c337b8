//! `compare`: how far two pictures are apart.

use std::path::PathBuf;

use clap::Args;

use super::args::Common;

/// Say how far two pictures are apart: PSNR, SSIM, L*u*v* distance
#[derive(Debug, Args)]
#[command(after_help = "Example:
  chronoxel compare expected.png actual.png -o difference.png")]
pub struct CompareArgs {
    /// The first picture
    a: PathBuf,
    /// The second, of the same size
    b: PathBuf,
    /// Write a picture of the differences
    #[arg(short, long, value_name = "DIFF.png")]
    output: Option<PathBuf>,
}

#[derive(Serialize)]
struct CompareReport {
    psnr_db: Option<f64>,
    ssim: f64,
    luv_mean: f64,
    luv_max: f64,
    differing_pixels: u64,
    num_pixels: u64,
}
