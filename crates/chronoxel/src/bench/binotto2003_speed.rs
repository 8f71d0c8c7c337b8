//! Binotto, Comba, Freitas (2003), table 3: frames per second of their third data set by number of slices and size of the picture.
//!
//! `sim:plume` with as many zeros stands in for the data; each frame is another step, all of them resident after a first round. The number of slices becomes the
//! distance of samples: that of so many planes through the box, along the view.

use std::{path::Path, time::Instant};

use chronoxel_core::{Camera, ColorMap, TransferFunction, UniformGrid};
use chronoxel_ingest::{Codec, EncodeOptions, encode};
use chronoxel_render::{GpuOptions, GpuRenderer, Method};
use serde_json::{Map, Value, json};

use super::{BenchReport, Column, Input, Row, Section, Size, Style, Workplace, machine, object};
use crate::{
    interrupt,
    session::{Session, View, orbit_camera},
};

/// Table 3: slices, edge of the picture in pixels, frames per second.
const TABLE_3: [(u32, usize, f64); 6] = [
    (200, 128, 33.76),
    (200, 256, 8.65),
    (200, 512, 4.23),
    (500, 128, 14.66),
    (500, 256, 4.00),
    (500, 512, 1.30),
];

const SOURCES: [&str; 2] = ["sim:plume?dims=64&steps=12", "sim:plume?limit=1.47"];

/// The sources to measure: the plume, and the user's; plumes of the user take its place.
pub fn sources(users: &[String], size: Size) -> Vec<String> {
    let is_plume = |source: &String| source.starts_with("sim:plume");
    let built_in =
        if users.iter().any(is_plume) { None } else { Some(SOURCES[usize::from(size != Size::Tiny)]) };
    built_in.map(str::to_owned).into_iter().chain(users.iter().cloned()).collect()
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
    let total = inputs.iter().map(|input| (input.num_steps() + TABLE_3.len() * 3) as u64).sum();
    let mut done = 0;
    let mut on_part = || {
        done += 1;
        progress(done, total);
    };
    let mut sections = Vec::new();
    for mut input in inputs {
        let store = place.path("encoded.cxl");
        let variables = vec![input.variable().name.clone()];
        let options = EncodeOptions {
            codec: Codec::Auto,
            max_error: Some(1.0 / 510.0),
            memory_bytes,
            variables,
            ..EncodeOptions::default()
        };
        encode(&mut input.series(), &store, &options, &mut |_| ())?;
        (0..input.num_steps()).for_each(|_| on_part());
        let is_papers = input.is_simulation("plume");
        sections.push(section_of(input.name(), is_papers, &store, memory_bytes, &mut on_part)?);
        place.remove(&store)?;
    }
    Ok(BenchReport { name: "binotto2003-speed", machine: machine(), sections, plots: Vec::new() })
}

fn section_of(
    name: &str,
    is_papers: bool,
    store: &Path,
    memory_bytes: u64,
    on_part: &mut dyn FnMut(),
) -> anyhow::Result<Section> {
    let mut rows: Vec<Row> = TABLE_3
        .iter()
        .map(|(slices, edge, fps)| Row {
            label: format!("{slices} slices, {edge}x{edge}"),
            paper: if is_papers { object(json!({ "fps": fps })) } else { Map::new() },
            here: Map::new(),
        })
        .collect();
    let on_cpu = Session::open(store, None, memory_bytes)?;
    measure(on_cpu, "fps_cpu", &mut rows, on_part)?;
    let mut notes = vec![
        "frames per second, another step each frame, all resident, unlit, ramp; slices: the distance of samples is that of so many planes".to_owned(),
    ];
    let options = GpuOptions::default();
    match GpuRenderer::adapter(&options) {
        Ok(info) => {
            notes.push(format!("GPU: {} ({})", info.name, info.kind));
            for (method, key) in [(Method::Raycast, "fps_gpu"), (Method::Slices, "fps_gpu_slices")] {
                let mut on_gpu = Session::open(store, None, memory_bytes)?;
                on_gpu.use_gpu(&GpuOptions { method, ..options.clone() })?;
                measure(on_gpu, key, &mut rows, on_part)?;
            }
        }
        Err(error) => notes.push(error.to_string()),
    }
    let columns = vec![
        Column::paper("fps", "paper", Style::Fixed(2)),
        Column::here("fps_cpu", "here: CPU", Style::Fixed(2)),
        Column::here("fps_gpu", "GPU, rays", Style::Fixed(2)),
        Column::here("fps_gpu_slices", "GPU, slices", Style::Fixed(2)),
    ];
    Ok(Section { title: format!("Table 3, frames per second: {name}"), columns, rows, notes })
}

/// Adds the frame rates of a session to the rows, under a key.
fn measure(
    mut session: Session,
    key: &str,
    rows: &mut [Row],
    on_part: &mut dyn FnMut(),
) -> anyhow::Result<()> {
    for ((slices, edge, _), row) in TABLE_3.into_iter().zip(rows) {
        let view = view_of(&session, slices, edge)?;
        let num_steps = session.store().header().num_steps_finished as usize;
        for step in 0..num_steps {
            interrupt::check()?;
            session.draw(&view, step)?;
        }
        let start = Instant::now();
        for step in 0..num_steps {
            interrupt::check()?;
            session.draw(&view, step)?;
        }
        let fps = num_steps as f64 / start.elapsed().as_secs_f64();
        row.here.insert(key.to_owned(), Value::from(fps));
        on_part();
    }
    Ok(())
}

fn view_of(session: &Session, slices: u32, edge: usize) -> anyhow::Result<View> {
    let grid = session.store().header().grid;
    let size = [edge, edge];
    let camera = orbit_camera(&grid, [30.0, 20.0], 1.0, Some(30.0), size)?;
    Ok(View {
        camera,
        transfer: session.resolve(&TransferFunction::built_in("ramp", ColorMap::Viridis)?)?,
        size,
        step_voxels: (depth(&camera, &grid) / f64::from(slices) / grid.smallest_spacing()).clamp(0.01, 2.0),
        lighting: None,
        opacity_unit: grid.smallest_spacing(),
        level: 0,
        coherence: None,
        level_borders: Default::default(),
    })
}

/// Extent of a grid's box along the view, world units.
fn depth(camera: &Camera, grid: &UniformGrid) -> f64 {
    let [low, high] = grid.bounds();
    (0..3).map(|a| (camera.axes()[2][a] * (high[a] - low[a])).abs()).sum()
}
