//! `demo`: the main job, on a built-in simulation.

use std::path::{Path, PathBuf};

use clap::{Args, Parser, ValueEnum};
use serde::Serialize;

use chronoxel_ingest::{EncodeOptions, sources};
use chronoxel_store::Store;

use super::{Cli, Verb, args::Common, encode, output, verify};
use crate::bytes::ByteSize;

/// See the main job done on a built-in simulation: encode, verify, a picture, a movie
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  chronoxel demo
  chronoxel demo some/folder --size full")]
pub struct DemoArgs {
    /// Folder to write to
    #[arg(default_value = "chronoxel-demo")]
    folder: PathBuf,
    /// How large the simulation is
    #[arg(long, value_name = "SIZE", default_value = "small")]
    size: DemoSize,
}

/// Sizes of the demo.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum DemoSize {
    /// Done within seconds; coarse.
    Tiny,
    /// Done within a minute.
    Small,
    /// Twice as fine, and twice as many steps; several minutes.
    Full,
}

#[derive(Serialize)]
struct DemoReport {
    store: PathBuf,
    picture: PathBuf,
    movie: PathBuf,
    wall_secs: f64,
    ratio: f64,
    psnr_db: Option<f64>,
}

/// How the pictures are taken, in the words of the command line.
const LOOK: &str = "--elevation 18 --axes --colorbar --time-label";

/// Runs the verb.
pub fn run(common: &Common, args: &DemoArgs) -> anyhow::Result<()> {
    let start = std::time::Instant::now();
    let folder = &args.folder;
    std::fs::create_dir_all(folder)
        .map_err(|e| anyhow::anyhow!("{}: cannot make the folder: {e}", folder.display()))?;
    let (source, movie_size) = match args.size {
        DemoSize::Tiny => ("sim:shockbubble?dims=48x24x24&steps=10", "320x180"),
        DemoSize::Small => ("sim:shockbubble?dims=120x48x48&steps=48", "720x405"),
        DemoSize::Full => ("sim:shockbubble?dims=240x96x96&steps=96", "1280x720"),
    };
    let [store, picture, movie] =
        ["shockbubble.cxl", "shockbubble.png", "shockbubble.gif"].map(|n| folder.join(n));
    let say = |text: &str| if common.json || common.quiet { Ok(()) } else { output::line(text) };

    say(&format!("A shock wave runs over a bubble of light gas. Simulating and encoding {source}"))?;
    let mut series = sources::open(&[source.to_owned()], &Default::default())?;
    let options = EncodeOptions {
        overwrite: true,
        source_name: source.to_owned(),
        max_error: Some(0.002),
        ..encode::options_of(common)
    };
    let encoded = encode::encode_series(common, series.as_mut(), &store, &options)?;
    say(&format!("  {}", encoded.text()))?;

    let opened = Store::open(&store)?;
    let mut checked = verify::check(common, &opened)?;
    let steps: Vec<usize> = (0..opened.header().num_steps_finished as usize).collect();
    verify::measure_series(common, &opened, series.as_mut(), &steps, &mut checked)?;
    anyhow::ensure!(checked.ok, "{}: the store is not sound", store.display());
    let psnr_db = checked.psnr_db(&opened.header().variables[0].name);
    let quality = psnr_db.map_or("lossless".to_owned(), |psnr| format!("PSNR {psnr:.1} dB"));
    say(&format!(
        "  verified: every checksum and invariant holds; {quality} against the simulation run again"
    ))?;

    let transfer = folder.join("shockbubble-colors.json");
    std::fs::write(&transfer, TRANSFER_FUNCTION)?;
    let time_step = (steps.len() * 2 / 5).to_string();
    // Later the wave has left the box.
    let movie_steps = format!("0:{}", steps.len() * 3 / 4);
    let look: Vec<&str> = LOOK.split(' ').collect();
    let transfer = ["--tf", path(&transfer)?];
    let render = [
        "render",
        path(&store)?,
        "-o",
        path(&picture)?,
        "-t",
        &time_step,
        "--size",
        "1600x900",
        "--azimuth",
        "25",
        "--zoom",
        "1.5",
    ];
    perform(common, folder, &[&render[..], &transfer, &look].concat())?;
    let movie_look = ["--size", movie_size, "--steps", &movie_steps, "--azimuth", "5", "--orbit", "35"];
    let movie_words = ["movie", path(&store)?, "-o", path(&movie)?, "--fps", "12", "--zoom", "1.25"];
    perform(common, folder, &[&movie_words[..], &movie_look, &transfer, &look].concat())?;
    let report = DemoReport {
        store,
        picture,
        movie,
        wall_secs: start.elapsed().as_secs_f64(),
        ratio: encoded.ratio,
        psnr_db,
    };
    match common.json {
        true => output::json(&report),
        false if common.quiet => Ok(()),
        false => output::line(&report.text()),
    }
}

/// Colours of the demo: blue where the gas is light, orange in the shock and the mixed layers, red where waves meet.
const TRANSFER_FUNCTION: &str = r#"{"domain": [0.1, 2.4], "points": [
  {"x": 0.00, "color": [0.75, 0.95, 1.00], "opacity": 0.50},
  {"x": 0.15, "color": [0.35, 0.75, 1.00], "opacity": 0.30},
  {"x": 0.33, "color": [0.15, 0.35, 0.85], "opacity": 0.04},
  {"x": 0.37, "color": [0.15, 0.35, 0.85], "opacity": 0.00},
  {"x": 0.41, "color": [0.95, 0.60, 0.20], "opacity": 0.00},
  {"x": 0.46, "color": [0.95, 0.60, 0.20], "opacity": 0.10},
  {"x": 0.70, "color": [1.00, 0.70, 0.25], "opacity": 0.16},
  {"x": 0.85, "color": [0.95, 0.45, 0.15], "opacity": 0.05},
  {"x": 0.89, "color": [0.80, 0.25, 0.15], "opacity": 0.00},
  {"x": 0.94, "color": [0.80, 0.15, 0.15], "opacity": 0.00},
  {"x": 1.00, "color": [1.00, 0.20, 0.30], "opacity": 0.20}
]}
"#;

fn path(path: &Path) -> anyhow::Result<&str> {
    path.to_str().ok_or_else(|| anyhow::anyhow!("{}: the path is not valid Unicode", path.display()))
}

/// Does what a command line says, after showing it.
fn perform(common: &Common, folder: &Path, words: &[&str]) -> anyhow::Result<()> {
    if !common.json && !common.quiet {
        let shown: Vec<&str> = words.iter().map(|w| if w.is_empty() { "''" } else { w }).collect();
        output::line(&format!("\nchronoxel {}", shown.join(" ")))?;
    }
    let cli = Cli::try_parse_from(std::iter::once("chronoxel").chain(words.iter().copied()))
        .map_err(|e| anyhow::anyhow!("{}: cannot be drawn: {e}", folder.display()))?;
    match &cli.verb {
        Verb::Render(args) => args.make(common).map(|_| ()),
        Verb::Movie(args) => args.make(common).map(|_| ()),
        _ => unreachable!("the demo draws pictures and movies"),
    }
}

impl DemoReport {
    fn text(&self) -> String {
        let size = |path: &Path| {
            std::fs::metadata(path).map_or(String::new(), |m| format!("  {}", ByteSize(m.len())))
        };
        format!(
            "\nMade in {:.0} s:\n  picture  {}{}\n  movie    {}{}\n  store    {} ({:.1} : 1)\n\
             Next: chronoxel encode YOUR-FILES -o run.cxl, then render, movie or play it; every verb has --help.",
            self.wall_secs,
            self.picture.display(),
            size(&self.picture),
            self.movie.display(),
            size(&self.movie),
            self.store.display(),
            self.ratio
        )
    }
}
