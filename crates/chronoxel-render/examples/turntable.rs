//! CPU time per frame while the camera turns around a volume, for comparison with other programs.
//!
//!     turntable SERIES.npy LOW HIGH [FOLDER]
//!     turntable ripples 256
//!
//! `SERIES.npy` is f32 `[t, z, y, x]`, of which the middle step is drawn, with transfer functions over LOW to HIGH.
//! Where FOLDER is given, the picture at azimuth 30 of each scene is left there. 24 azimuths, 15 degrees apart.

use std::io::Write;

use chronoxel_core::{Background, UniformGrid};
use chronoxel_render::{CpuOptions, render_with};

#[path = "../benches/peers/mod.rs"]
mod peers;

use peers::Field;
use peers::pictures::Quantise;

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let (field, domain, folder) = match args.iter().map(String::as_str).collect::<Vec<_>>().as_slice() {
        ["ripples", n] => (peers::ripples(n.parse().expect("edge")), [0.0, 255.0], None),
        [path, low, high, rest @ ..] => {
            let domain = [low, high].map(|v| v.parse().expect("a number"));
            (middle_step(path), domain, rest.first().copied())
        }
        _ => panic!("usage: turntable SERIES.npy LOW HIGH [FOLDER], or turntable ripples EDGE"),
    };
    let only = std::env::var("TURNTABLE_ONLY").ok();
    for lit in [false, true] {
        for function in ["sparse", "filled"] {
            let name = if lit { format!("{function}-lit") } else { function.to_owned() };
            if only.as_ref().is_some_and(|only| *only != name) {
                continue;
            }
            measure(&field, function, domain, lit, folder);
        }
    }
}

fn measure(field: &Field, function: &str, domain: [f64; 2], lit: bool, folder: Option<&str>) {
    let mut scene = peers::scene(field, function, domain, lit);
    let tile_edge = std::env::var("TURNTABLE_TILE").map_or(16, |n| n.parse().expect("an edge"));
    let options = CpuOptions { tile_edge, ..CpuOptions::default() };
    let start = cpu_ms();
    let bricks = field.draw_list(&scene, 0, Quantise::PerBrick);
    let prepare_ms = cpu_ms() - start;
    let (mut times, mut num_samples, mut stats) = (Vec::new(), 0, None);
    for k in 0..25 {
        let list = peers::turned(&mut scene, &bricks, 15.0 * f64::from(k));
        let start = cpu_ms();
        let (image, frame) = render_with(&scene, &list, &options).expect("the scene can be drawn");
        // The first frame warms up.
        if k > 0 {
            times.push(cpu_ms() - start);
            num_samples += frame.num_samples;
        }
        if let Some(folder) = folder.filter(|_| k == 2) {
            let path = format!("{folder}/{function}{}.png", if lit { "-lit" } else { "" });
            std::fs::write(path, image.to_png(Background::default())).expect("a folder to write to");
        }
        stats = Some(frame);
    }
    let total: f64 = times.iter().sum();
    times.sort_by(f64::total_cmp);
    let line = format!(
        "{function} lit={lit}: CPU ms per frame median {:.1} min {:.1} max {:.1}; {:.1} M samples per frame, {:.1} M \
         samples per CPU second; bricks cut and prepared in {prepare_ms:.0} ms; last frame {:?}",
        times[times.len() / 2],
        times[0],
        times[times.len() - 1],
        num_samples as f64 / 24e6,
        num_samples as f64 / 1e3 / total,
        stats.expect("25 frames"),
    );
    writeln!(std::io::stdout(), "{line}").expect("a place to print to");
}

/// CPU time of all threads so far.
fn cpu_ms() -> f64 {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `time` lives as long as the call.
    let failed = unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &mut time) };
    assert_eq!(failed, 0, "no clock of CPU time");
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 / 1e6
}

/// The middle step of an f32 series in numpy's format, version 1.
fn middle_step(path: &str) -> Field {
    let bytes = std::fs::read(path).expect("a .npy file");
    let start = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let header = std::str::from_utf8(&bytes[10..start]).expect("a version 1 header");
    assert!(header.contains("'<f4'") && header.contains("False"), "f32 in C order is needed: {header}");
    let shape = &header[header.find("'shape': (").expect("a shape") + 10..];
    let shape = &shape[..shape.find(')').expect("a closed shape")];
    let dims: Vec<usize> = shape.split(',').map(|n| n.trim().parse().expect("a number")).collect();
    let [t, z, y, x] = dims[..] else { panic!("four axes are needed: {shape}") };
    let step = x * y * z;
    let first = start + 4 * step * (t / 2);
    let samples = bytes[first..first + 4 * step]
        .chunks_exact(4)
        .map(|b| f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])));
    let grid = UniformGrid::new([x, y, z], [0.0; 3], [1.0; 3]).expect("a usable grid");
    Field { grid, samples: samples.collect(), mask: None }
}
