//! Lum, Ma, Clyne (2001), tables 2 to 4: frames per second at 1, 2, 4 and 8 steps in a byte, in memory and from disk.
//!
//! `sim:swirl` stands in for the data: textured everywhere and coherent in time, as turbulence is. What is played from disk is evicted from the system's
//! memory before, and the bytes that the device delivered are told beside those that were read.

use std::{path::Path, time::Instant};

use chronoxel_core::{ColorMap, TransferFunction};
use chronoxel_ingest::{Codec, EncodeOptions, encode};
use serde_json::{Value, json};

use super::{
    BenchReport, Column, Input, Row, Section, Size, Style, Workplace, machine, object,
    stepping::{STEP_VOXELS, camera_for_share},
};
use crate::{
    interrupt,
    player::{Player, PlayerOptions},
    process::{device_bytes_read, forget_cached_files},
    session::{Session, View},
};

/// Tables 2 to 4: compression ratio; quasi-geostrophic turbulence (256³, 1,492 steps) in memory and from disk, the shock-bubble flow
/// (640x256x256, 265 steps) in memory and from disk, the turbulent vortex (128³, 100 steps) in memory.
const TABLES: [(u32, [f64; 5]); 4] = [
    (1, [11.5, 2.0, 4.4, 0.9, 28.7]),
    (2, [17.3, 3.5, 6.3, 1.6, 51.6]),
    (4, [25.8, 6.8, 9.3, 3.1, 70.7]),
    (8, [31.6, 13.4, 11.7, 5.8, 76.1]),
];

/// The paper's disk array.
const DISK_BYTES_PER_SEC: f64 = 34e6;
/// Steps that are played in memory, at most.
const MOST_IN_CORE: usize = 16;
/// Memory of the playback from disk, against the bytes of the store without compression in time: far less than the store.
const OUT_OF_CORE_SHARE: f64 = 0.2;

/// The sources to measure: the user's, or the built-in one.
pub fn sources(users: &[String], size: Size) -> Vec<String> {
    let built_in = match size {
        Size::Tiny => "sim:swirl?dims=24&steps=16",
        Size::Small => "sim:swirl?dims=128&steps=32",
        Size::Full => "sim:swirl?dims=256&steps=128",
    };
    match users {
        [] => vec![built_in.to_owned()],
        users => users.to_vec(),
    }
}

/// Measures the sources. `progress` is told what is done and what there is to do.
///
/// # Errors
/// If a source cannot be read or drawn, the workplace cannot be written, or Ctrl-C was pressed.
pub fn run(
    inputs: Vec<Input>,
    place: &Workplace,
    memory_bytes: u64,
    progress: &mut dyn FnMut(u64, u64),
) -> anyhow::Result<BenchReport> {
    let total: usize =
        inputs.iter().map(|input| TABLES.len() * (3 * input.num_steps() + 2 * MOST_IN_CORE)).sum();
    let mut done = 0;
    let mut on_step = || {
        done += 1;
        progress(done, total as u64);
    };
    let mut sections = Vec::new();
    for mut input in inputs {
        sections.push(section_of(&mut input, place, memory_bytes, &mut on_step)?);
    }
    Ok(BenchReport { name: "lum2001-playback", machine: machine(), sections, plots: Vec::new() })
}

fn section_of(
    input: &mut Input,
    place: &Workplace,
    memory_bytes: u64,
    on_step: &mut dyn FnMut(),
) -> anyhow::Result<Section> {
    let mut rows = Vec::new();
    let out_of_core_bytes = ((input.num_samples() * input.num_steps()) as f64 * OUT_OF_CORE_SHARE) as u64;
    let out_of_core_bytes = out_of_core_bytes.clamp(LEAST_BYTES, memory_bytes);
    for (ratio, paper) in TABLES {
        let store = place.path("encoded.cxl");
        let options = EncodeOptions {
            memory_bytes,
            variables: vec![input.variable().name.clone()],
            ..match ratio {
                1 => EncodeOptions { codec: Codec::Raw, bits: Some(8.0), ..EncodeOptions::default() },
                _ => EncodeOptions { codec: Codec::Palette, window: Some(ratio), ..EncodeOptions::default() },
            }
        };
        let mut step = 0;
        encode(&mut input.series(), &store, &options, &mut |told| {
            (step..told.step).for_each(|_| on_step());
            step = told.step;
        })?;
        on_step();
        let in_core = play(&store, memory_bytes, Disk::InCore, on_step)?;
        let from_disk = play(&store, out_of_core_bytes, Disk::AsItIs, on_step)?;
        let throttled = play(&store, out_of_core_bytes, Disk::Throttled, on_step)?;
        place.remove(&store)?;
        rows.push(Row {
            label: format!("{ratio}x"),
            paper: object(json!({
                "fps_in_core": paper[0], "fps_from_disk": paper[1],
                "fps_in_core_shock_bubble": paper[2], "fps_from_disk_shock_bubble": paper[3],
                "fps_in_core_vortex": paper[4],
            })),
            here: object(json!({
                "fps_in_core": in_core.fps, "fps_unthrottled": from_disk.fps, "fps_from_disk": throttled.fps,
                "bytes_per_step": from_disk.bytes_per_step, "device_bytes_per_step": from_disk.device_bytes_per_step,
                "hit_rate": from_disk.hit_rate,
            })),
        });
    }
    add_gains(&mut rows);
    let columns = vec![
        Column::paper("fps_in_core", "paper: in memory", Style::Fixed(1)),
        Column::here("fps_in_core", "here", Style::Fixed(1)),
        Column::paper("fps_from_disk", "paper: from disk", Style::Fixed(1)),
        Column::here("fps_from_disk", "here, 34 MB/s", Style::Fixed(1)),
        Column::here("gain", "gain", Style::Fixed(2)),
        Column::here("fps_unthrottled", "here, as fast as it reads", Style::Fixed(1)),
        Column::here("bytes_per_step", "bytes read per step", Style::Fixed(0)),
        Column::here("bytes_gain", "1x / this", Style::Fixed(2)),
        Column::here("device_bytes_per_step", "by the device", Style::Fixed(0)),
        Column::here("hit_rate", "hit rate", Style::Fixed(3)),
    ];
    let notes = vec![
        "frames per second, another step each frame, 512x512, the box over a third of the picture, filled, unlit, a sample per voxel, on the CPU".to_owned(),
        format!(
            "from disk: with --memory {}, after the files were evicted from the system's memory; the device's bytes are those that the system \
             counts for this process (0 where it does not, or where the files lie in memory)",
            crate::bytes::ByteSize(out_of_core_bytes)
        ),
        "the paper's columns are its quasi-geostrophic data, 256^3, 1492 steps; the other two are in the JSON".to_owned(),
    ];
    Ok(Section { title: format!("Tables 2 to 4, playback: {}", input.name()), columns, rows, notes })
}

/// Below this, playback has not enough for a picture.
const LEAST_BYTES: u64 = 24 << 20;

/// How often more frames, and how many fewer bytes, than without compression in time.
fn add_gains(rows: &mut [Row]) {
    let figure = |row: &Row, key: &str| row.here.get(key).and_then(Value::as_f64).unwrap_or(f64::NAN);
    let [fps, bytes] = ["fps_from_disk", "bytes_per_step"].map(|key| figure(&rows[0], key));
    for row in rows {
        let gains = [
            ("gain", figure(row, "fps_from_disk") / fps),
            ("bytes_gain", bytes / figure(row, "bytes_per_step")),
        ];
        row.here.extend(gains.map(|(key, gain)| (key.to_owned(), Value::from(gain))));
    }
}

/// Where steps come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Disk {
    /// Memory, after a first round.
    InCore,
    AsItIs,
    Throttled,
}

/// What playing took.
struct Play {
    fps: f64,
    bytes_per_step: f64,
    device_bytes_per_step: f64,
    hit_rate: f64,
}

fn play(store: &Path, memory_bytes: u64, disk: Disk, on_step: &mut dyn FnMut()) -> anyhow::Result<Play> {
    if disk != Disk::InCore {
        forget_cached_files(store);
    }
    let session = Session::open(store, None, memory_bytes)?;
    let grid = session.store().header().grid;
    let num_finished = session.store().header().num_steps_finished;
    let num_steps = if disk == Disk::InCore { num_finished.min(MOST_IN_CORE as u32) } else { num_finished };
    let (camera, _) = camera_for_share(&grid)?;
    let view = View {
        camera,
        transfer: session.resolve(&TransferFunction::built_in("filled", ColorMap::Viridis)?)?,
        size: super::stepping::SIZE,
        step_voxels: STEP_VOXELS,
        lighting: None,
        opacity_unit: grid.smallest_spacing(),
        level: 0,
        coherence: None,
        level_borders: Default::default(),
    };
    let throttle = (disk == Disk::Throttled).then_some(DISK_BYTES_PER_SEC);
    let options = PlayerOptions { throttle, redraws: true, loops: false, ..PlayerOptions::default() };
    let mut player = Player::new(session, (0..num_steps).collect(), options)?;
    if disk == Disk::InCore {
        for _ in 0..num_steps {
            interrupt::check()?;
            player.next(&view)?;
            on_step();
        }
        player.rewind();
    }
    let (bytes_before, device_before) = (player.session().bytes_from_disk(), device_bytes_read());
    let (mut hits, mut misses) = (0, 0);
    let start = Instant::now();
    for _ in 0..num_steps {
        interrupt::check()?;
        let played = player.next(&view)?;
        (hits, misses) = (hits + played.hits, misses + played.misses);
        on_step();
    }
    let secs = start.elapsed().as_secs_f64();
    let per_step = |bytes: u64| bytes as f64 / f64::from(num_steps);
    Ok(Play {
        fps: f64::from(num_steps) / secs,
        bytes_per_step: per_step(player.session().bytes_from_disk() - bytes_before),
        device_bytes_per_step: per_step(device_bytes_read().saturating_sub(device_before)),
        hit_rate: hits as f64 / (hits + misses).max(1) as f64,
    })
}
