//! Bernardon, Callahan, Comba, Silva: Interactive Volume Rendering of Unstructured Grids with Time-Varying Scalar Fields (2006),
//! section 4: what values at the points of a mesh take and how close they are, and frame rates (table 1); level of detail by how
//! values change in time (figures 4 and 5); the same mesh as bricks and as cells.

mod cases;
mod detail;
mod speed;

use std::sync::Arc;

use chronoxel_codec::paper_ratio;
use chronoxel_core::{Camera, ColorMap, TransferFunction};
use chronoxel_ingest::{
    CellOptions as CodecOptions, CellReport, EncodeOptions, encode_cells, measure_cells,
    sources::SourceOptions,
};
use chronoxel_render::{CellMesh, CellOptions, CellRenderer, CellScene};
use chronoxel_store::CellStore;
use serde_json::{Map, Value, json};

use super::{BenchReport, Column, Plot, Row, Section, Size, Style, Workplace, machine, object};
use crate::interrupt;
use cases::Case;
use speed::Speed;

/// Table 1: points, tetrahedra, steps, megabytes of values and of their code, ratio, smallest and largest SNR, largest error,
/// frames per second of one step and of new ones, millions of tetrahedra per second.
const PAPER: [(&str, [f64; 12]); 6] = [
    ("SPX1", [36e3, 101e3, 64.0, 9.0, 0.504, 18.3, 39.5, 42.0, 0.0045, 32.2, 30.7, 3.1]),
    ("SPX2", [162e3, 808e3, 64.0, 40.5, 2.0, 20.6, 39.2, 42.0, 0.0091, 5.0, 4.7, 3.8]),
    ("SPXF", [19e3, 12e3, 192.0, 14.7, 2.0, 7.1, 20.8, 30.2, 0.0144, 125.0, 83.3, 1.0]),
    ("BLUNT", [40e3, 183e3, 64.0, 10.0, 0.552, 18.6, 41.7, 44.4, 0.0046, 23.1, 16.7, 3.0]),
    ("TORSO", [8e3, 50e3, 360.0, 11.2, 1.0, 11.4, 20.5, 28.1, 0.0017, 49.2, 48.9, 2.5]),
    ("TJET", [160e3, 1e6, 150.0, 93.8, 2.7, 34.7, 5.3, 17.9, 0.2042, 3.7, 3.6, 3.6]),
];

/// The meshes to measure: the user's, or a generated one. A turbulent field is always measured besides.
pub fn sources(users: &[String], size: Size) -> Vec<String> {
    let dims = match size {
        Size::Tiny => 9,
        Size::Small => 33,
        Size::Full => 57,
    };
    match users {
        [] => vec![format!("sim:twist?dims={dims}&steps=64")],
        users => users.to_vec(),
    }
}

/// Measures meshes. One in several files has their names joined by commas. `progress` is told what is done and what there is to do.
///
/// # Errors
/// If a source cannot be read or is no mesh, does not fit the memory, the workplace cannot be written, or Ctrl-C was pressed.
pub fn run(
    names: &[String],
    options: &SourceOptions,
    size: Size,
    place: &Workplace,
    memory_bytes: u64,
    progress: &mut dyn FnMut(u64, u64),
) -> anyhow::Result<BenchReport> {
    let mut found = Found { table: table_section(size), rates: rates_section(size), ..Found::empty() };
    let total = names.len() as u64 + 1;
    for (done, name) in names.iter().enumerate() {
        progress(done as u64, total);
        for case in cases::of_source(name, options, size)? {
            found.add(case, size, place, memory_bytes)?;
        }
    }
    progress(total - 1, total);
    found.add(cases::turbulent(size)?, size, place, memory_bytes)?;
    progress(total, total);
    let Found { table, rates, fractions, order, bricks, plots } = found;
    let sections = [table, rates, fractions, order, bricks].into_iter().filter(|s| !s.rows.is_empty());
    Ok(BenchReport { name: "bernardon2006", machine: machine(), sections: sections.collect(), plots })
}

/// What was found so far.
struct Found {
    table: Section,
    rates: Section,
    fractions: Section,
    order: Section,
    bricks: Section,
    plots: Vec<Plot>,
}

impl Found {
    fn empty() -> Self {
        Self {
            table: table_section(Size::Small),
            rates: rates_section(Size::Small),
            fractions: fractions_section(),
            order: order_section(),
            bricks: bricks_section(),
            plots: Vec::new(),
        }
    }

    fn add(
        &mut self,
        mut case: Case,
        size: Size,
        place: &Workplace,
        memory_bytes: u64,
    ) -> anyhow::Result<()> {
        interrupt::check()?;
        let label = case.label.clone();
        let path = place.path("cells.cxl");
        let options = EncodeOptions {
            variables: vec![case.mesh.variables()[case.variable].name.clone()],
            memory_bytes,
            ..EncodeOptions::default()
        };
        let codec = CodecOptions { entries: case.entries, nested: false };
        let report = encode_cells(case.mesh.as_mut(), &path, &options, &codec, &mut |_| {})?;
        let store = CellStore::open(&path)?;
        let paper = paper_row(case.paper);
        let here = table_row(&mut case, &report, &store)?;
        self.table.rows.push(Row { label: label.clone(), paper: paper.clone(), here });
        let geometry = store.read_geometry()?;
        let mesh = Arc::new(CellMesh::new(geometry.points, &geometry.tetrahedra)?);
        let scenes = scenes(&store, size)?;
        let mut renderer = CellRenderer::new(Arc::clone(&mesh), CellOptions::default())?;
        let num_frames = match size {
            Size::Tiny => 2,
            Size::Small => 10,
            Size::Full => 24,
        };
        let speed = speed::measure(&store, &mut renderer, &scenes, num_frames)?;
        drop(renderer);
        let here = rates_row(&speed, mesh.num_tetrahedra());
        self.rates.rows.push(Row { label: label.clone(), paper, here });
        self.order.rows.extend(detail::rows_of_k(&label, &store, &mesh, &scenes)?);
        if case.has_detail {
            self.fractions.rows.extend(detail::rows_of_fractions(&label, &store, &mesh, &scenes)?);
        }
        if case.has_bricks {
            let (store, mesh_of_case) = (&store, case.mesh.as_mut());
            let work = (size, place, memory_bytes);
            let (rows, mut plot) =
                detail::against_bricks(&label, (store, mesh_of_case), &mesh, &scenes[0], work)?;
            if !self.plots.is_empty() {
                plot.file += &format!("-{}", self.plots.len() + 1);
            }
            self.bricks.rows.extend(rows);
            self.plots.push(plot);
        }
        place.remove(&path)
    }
}

/// Two views of a mesh, in colours that show all of it.
fn scenes(store: &CellStore, size: Size) -> anyhow::Result<Vec<CellScene>> {
    let header = store.header();
    let variable = &header.variables[0];
    let value_range = [variable.min.unwrap_or(0.0), variable.max.unwrap_or(1.0)];
    let transfer = TransferFunction::built_in("ramp", ColorMap::Turbo)?.resolve(value_range)?;
    let edge = if size == Size::Tiny { 96 } else { 512 };
    [[30.0, 20.0], [120.0, -35.0]]
        .into_iter()
        .map(|[azimuth, elevation]| {
            Ok(CellScene {
                camera: Camera::orbit(header.bounds, azimuth, elevation, 1.0, Some(30.0), 1.0)?,
                transfer: transfer.clone(),
                size: [edge, edge],
                lighting: None,
                opacity_unit: header.opacity_unit(),
                value_range,
            })
        })
        .collect()
}

fn paper_row(name: Option<&str>) -> Map<String, Value> {
    let row = PAPER.iter().find(|(row, _)| Some(*row) == name);
    let Some((_, [points, tetrahedra, steps, raw, coded, ratio, low, high, error, still, moving, rate])) =
        row
    else {
        return Map::new();
    };
    object(json!({
        "points": points,
        "tetrahedra": tetrahedra,
        "steps": steps,
        "raw_megabytes": raw,
        "coded_megabytes": coded,
        "ratio": ratio,
        "snr_min_db": low,
        "snr_max_db": high,
        "max_error": error,
        "static_fps": still,
        "moving_fps": moving,
        "loss": 100.0 * (1.0 - moving / still),
        "tetrahedra_per_sec": 1e6 * rate,
    }))
}

/// As the paper counts megabytes.
const MEBI: f64 = (1 << 20) as f64;

fn table_row(case: &mut Case, report: &CellReport, store: &CellStore) -> anyhow::Result<Map<String, Value>> {
    let header = store.header();
    let num_steps = header.times.num_steps();
    let measured = measure_cells(store, case.mesh.as_mut(), 0..num_steps)?;
    let found = &measured.variables[0];
    let snr = || found.snr_db.iter().copied();
    // Where there is no error at all, there is no ratio to it.
    let finite = |snr: f64| Some(snr).filter(|snr| snr.is_finite());
    let ratio = paper_ratio(header.num_points as usize, num_steps, case.entries);
    let raw = report.raw_bytes as f64;
    Ok(object(json!({
        "points": header.num_points,
        "tetrahedra": header.num_tetrahedra,
        "steps": num_steps,
        "entries": case.entries,
        "raw_megabytes": raw / MEBI,
        "coded_megabytes": raw / MEBI / ratio,
        "ratio": ratio,
        "stored_megabytes": report.totals.data_bytes as f64 / MEBI,
        "stored_ratio": raw / report.totals.data_bytes as f64,
        "geometry_megabytes": report.totals.geometry_bytes as f64 / MEBI,
        "snr_min_db": finite(snr().fold(f64::INFINITY, f64::min)),
        "snr_max_db": finite(snr().fold(f64::NEG_INFINITY, f64::max)),
        "max_error": found.errors.max_abs_error,
        "encode_megabytes_per_sec": raw / MEBI / report.wall_secs,
    })))
}

fn rates_row(speed: &Speed, num_tetrahedra: usize) -> Map<String, Value> {
    object(json!({
        "static_fps": 1.0 / speed.still_secs,
        "moving_fps": 1.0 / speed.moving_secs,
        "loss": 100.0 * (1.0 - speed.still_secs / speed.moving_secs),
        "extra_cpu": speed.extra_cpu.map(|share| 100.0 * share),
        "decode_ms": 1e3 * speed.decode_secs,
        "tetrahedra_per_sec": num_tetrahedra as f64 / speed.moving_secs,
    }))
}

fn table_section(size: Size) -> Section {
    use Style::{Fixed, Scientific};
    let (paper, here) = (Column::paper, Column::here);
    let mut notes = vec![
        "ratios by the paper's formula have 4 bytes for every number and leave the mesh out; those stored are of all files of values".to_owned(),
        "errors in units of the range; SNR of blocks of 64 steps against their variance; megabytes of 2^20 bytes".to_owned(),
        "SPXF stand-in: forces on masses at the points of SPX1 with springs along its edges, pushed from above; TJET stand-in: turbulence in a periodic box on a lattice of tetrahedra".to_owned(),
    ];
    if size != Size::Full {
        notes.push("SPX2 and a million tetrahedra of turbulence: --size full".to_owned());
    }
    Section {
        title: "Table 1, compression".to_owned(),
        columns: vec![
            paper("points", "points, paper", Fixed(0)),
            here("points", "here", Fixed(0)),
            paper("tetrahedra", "tetrahedra, paper", Fixed(0)),
            here("tetrahedra", "here", Fixed(0)),
            here("steps", "steps", Fixed(0)),
            paper("raw_megabytes", "MB, paper", Fixed(1)),
            here("raw_megabytes", "here", Fixed(1)),
            paper("ratio", "ratio, paper", Fixed(1)),
            here("ratio", "by formula", Fixed(1)),
            here("stored_megabytes", "stored, MB", Fixed(3)),
            here("stored_ratio", "ratio", Fixed(1)),
            here("geometry_megabytes", "mesh, MB", Fixed(2)),
            paper("snr_min_db", "SNR min, paper", Fixed(1)),
            here("snr_min_db", "here", Fixed(1)),
            paper("snr_max_db", "max, paper", Fixed(1)),
            here("snr_max_db", "here", Fixed(1)),
            paper("max_error", "max error, paper", Fixed(4)),
            here("max_error", "here", Scientific),
            here("encode_megabytes_per_sec", "encode, MB/s", Fixed(1)),
        ],
        rows: Vec::new(),
        notes,
    }
}

fn rates_section(size: Size) -> Section {
    use Style::{Fixed, Scientific};
    let (paper, here) = (Column::paper, Column::here);
    let edge = if size == Size::Tiny { 96 } else { 512 };
    Section {
        title: format!("Table 1, frames per second at {edge} x {edge}, k = 6, on the CPU"),
        columns: vec![
            paper("static_fps", "one step, paper", Fixed(1)),
            here("static_fps", "here", Fixed(1)),
            paper("moving_fps", "new steps, paper", Fixed(1)),
            here("moving_fps", "here", Fixed(1)),
            paper("loss", "loss %, paper", Fixed(1)),
            here("loss", "here", Fixed(1)),
            here("extra_cpu", "more CPU time, %", Fixed(1)),
            here("decode_ms", "decode, ms", Fixed(2)),
            paper("tetrahedra_per_sec", "tetrahedra/s, paper", Scientific),
            here("tetrahedra_per_sec", "here", Scientific),
        ],
        rows: Vec::new(),
        notes: vec![
            "medians over frames of two views, still and moving frames by turns; a moving frame draws a step while the next is decoded".to_owned(),
        ],
    }
}

fn fractions_section() -> Section {
    use Style::Fixed;
    let here = Column::here;
    Section {
        title: "Figures 4 and 5, pictures with a part of the faces, L*u*v* distance to all of them".to_owned(),
        columns: vec![
            here("faces_share", "faces %", Fixed(1)),
            here("luv_spread", "by change in time", Fixed(2)),
            here("luv_largest", "largest change alone", Fixed(2)),
            here("luv_one_step", "by one step", Fixed(2)),
            here("psnr_spread", "PSNR, dB", Fixed(1)),
            here("psnr_largest", "largest", Fixed(1)),
            here("psnr_one_step", "one step", Fixed(1)),
        ],
        rows: Vec::new(),
        notes: vec![
            "means over three steps and two views; a part of the faces within, the boundary is always drawn; by change in time, spread over the mesh, is what --lod draws, the largest change alone is the paper's".to_owned(),
        ],
    }
}

fn order_section() -> Section {
    use Style::Fixed;
    let here = Column::here;
    Section {
        title: "Fragments out of order".to_owned(),
        columns: vec![
            here("fragments", "fragments", Fixed(0)),
            here("misordered", "out of order", Fixed(0)),
            here("psnr_db", "PSNR to k = 16, dB", Fixed(1)),
        ],
        rows: Vec::new(),
        notes: vec!["over two views; equal pictures are given 100 dB".to_owned()],
    }
}

fn bricks_section() -> Section {
    use Style::Fixed;
    let here = Column::here;
    Section {
        title: "The same mesh as bricks and as cells".to_owned(),
        columns: vec![
            here("luv", "L*u*v* distance", Fixed(2)),
            here("psnr_db", "PSNR, dB", Fixed(1)),
            here("ssim", "SSIM", Fixed(3)),
            here("luv_all", "L*u*v* to all cells", Fixed(2)),
        ],
        rows: Vec::new(),
        notes: vec![
            "bricks are cast with two samples per voxel; also as a plot (bricks-and-cells.svg in --out)"
                .to_owned(),
        ],
    }
}
