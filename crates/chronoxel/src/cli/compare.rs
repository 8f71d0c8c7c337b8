//! `compare`: how far two pictures are apart.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use chronoxel_core::compare::{compare, difference_picture};

use super::{args::Common, output};
use crate::movie::{read_png, write_png};

/// Say how far two pictures are apart: PSNR, SSIM, L*u*v* distance
#[derive(Debug, Args)]
#[command(after_help = "Example:
  chronoxel compare expected.png actual.png -o difference.png")]
pub struct CompareArgs {
    /// The first picture
    a: PathBuf,
    /// The second, of the same size
    b: PathBuf,
    /// Write a picture of the differences, eight times enlarged
    #[arg(short, long, value_name = "DIFF.png")]
    output: Option<PathBuf>,
}

#[derive(Serialize)]
struct CompareReport {
    /// Null where the pictures are equal.
    psnr_db: Option<f64>,
    /// Null where a side is shorter than 11 pixels.
    ssim: Option<f64>,
    luv_mean: f64,
    luv_max: f64,
    differing_pixels: usize,
    num_pixels: usize,
}

/// How much differences are enlarged in the picture of them.
const GAIN: u8 = 8;

/// Runs the verb.
pub fn run(common: &Common, args: &CompareArgs) -> anyhow::Result<()> {
    let (a, b) = (read_png(&args.a)?, read_png(&args.b)?);
    let difference = compare(&a, &b)?;
    if let Some(path) = &args.output {
        write_png(path, &difference_picture(&a, &b, GAIN)?)?;
    }
    let report = CompareReport {
        psnr_db: Some(difference.psnr_db).filter(|psnr| psnr.is_finite()),
        ssim: difference.ssim,
        luv_mean: difference.luv_mean,
        luv_max: difference.luv_max,
        differing_pixels: difference.differing_pixels,
        num_pixels: a.width * a.height,
    };
    match common.json {
        true => output::json(&report),
        false => output::line(&report.text()),
    }
}

impl CompareReport {
    fn text(&self) -> String {
        let psnr = self.psnr_db.map_or("infinite (equal)".to_owned(), |psnr| format!("{psnr:.2} dB"));
        let ssim = self.ssim.map_or("none (too small)".to_owned(), |ssim| format!("{ssim:.5}"));
        format!(
            "PSNR {psnr}, SSIM {ssim}, L*u*v* distance {:.4} mean, {:.2} largest; {} of {} pixels differ",
            self.luv_mean, self.luv_max, self.differing_pixels, self.num_pixels
        )
    }
}
