//! Leven, Corso, Cohen, Kumar: Interactive Visualization of Unstructured Grids Using Hierarchical 3D Textures (2002), section 6:
//! what an adaptive octree of a mesh takes (figure 13), how that falls with the threshold on the field (figure 14), and a flight over it
//! at a target frame rate (figure 15).

use std::path::Path;

use chronoxel_core::BrickLayout;
use chronoxel_ingest::{
    Codec, EncodeOptions, MeshSeries, Opened, VoxelOptions, encode_mesh,
    sources::{self, SourceOptions},
    voxelise::{Room, Voxels},
};
use serde_json::{Map, Value, json};

use super::{
    BenchReport, Column, Row, Section, Size, Style, Workplace,
    flight::{FINE_ENOUGH, Flight, TARGET_FPS},
    machine, object,
};
use crate::interrupt;

/// Samples along the edge of a brick, as the paper has them.
const EDGE: usize = 32;

/// A row of figure 13, whose data set is known by a part of its file's name.
struct PaperModel {
    name: &'static str,
    figures: [f64; 5],
}

const PAPER: [PaperModel; 2] = [
    PaperModel { name: "bluntfin", figures: [187_223.0, 8.22, 10.0, 22_208.0, 3002.0] },
    PaperModel { name: "post", figures: [513_375.0, 9.03, 11.0, 65_324.0, 8830.0] },
];

/// Thresholds of figure 14, as shares of the range.
const THRESHOLDS: [f64; 7] = [0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2];

/// The meshes to measure: the user's, or a generated one.
pub fn sources(users: &[String], size: Size) -> Vec<String> {
    let dims = match size {
        Size::Tiny => 9,
        Size::Small => 33,
        Size::Full => 97,
    };
    match users {
        [] => vec![format!("sim:twist?dims={dims}&steps=1")],
        users => users.to_vec(),
    }
}

/// Measures meshes. Of each the first variable counts, over all steps; one in several files has their names joined by commas.
/// `progress` is told what is done and what there is to do.
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
    let max_depth = match size {
        Size::Tiny => 2,
        Size::Small => 6,
        Size::Full => 10,
    };
    let total = (names.len() * (THRESHOLDS.len() + 2)) as u64;
    let mut done = 0;
    let mut on_part = || {
        done += 1;
        progress(done, total);
        interrupt::check()
    };
    let (mut trees, mut thresholds) = (tree_section(max_depth), threshold_section(max_depth));
    let (mut flights, mut plots) = (flight_section(), Vec::new());
    for name in names {
        let mut mesh = open(name, options)?;
        let label = label_of(name);
        let mut whole = None;
        for threshold in THRESHOLDS {
            let options = VoxelOptions { field_threshold: threshold, max_depth };
            let found = Found::of(mesh.as_mut(), &options, place, memory_bytes)?;
            let all = *whole.get_or_insert(found.num_nodes);
            thresholds.rows.push(Row {
                label: format!("{label}: {:.1} %", 100.0 * threshold),
                paper: Map::new(),
                here: object(json!({
                    "nodes": found.num_nodes,
                    "relative_size": found.num_nodes as f64 / all as f64,
                    "mean_depth": found.mean_depth,
                })),
            });
            if threshold == 0.0 {
                let store = place.path("leven2002.cxl");
                let stored = encode(mesh.as_mut(), &store, &options, memory_bytes)?;
                trees.rows.push(Row {
                    label: label.clone(),
                    paper: paper_row(name),
                    here: found.row(stored),
                });
                on_part()?;
                let flight = Flight::over(&store, bounds_of(mesh.as_mut())?, size, memory_bytes)?;
                place.remove(&store)?;
                flights.rows.extend(flight.rows(&label));
                let number = if plots.is_empty() { String::new() } else { format!("-{}", plots.len() + 1) };
                plots.push(flight.plot(format!("figure-15{number}"), &label));
                on_part()?;
            }
            on_part()?;
        }
    }
    Ok(BenchReport {
        name: "leven2002",
        machine: machine(),
        sections: vec![trees, thresholds, flights],
        plots,
    })
}

/// What the octree of a mesh is.
struct Found {
    num_tetrahedra: u64,
    mean_depth: f64,
    max_depth: u8,
    num_nodes: u64,
    num_cut_off: u64,
    tests_per_sec: f64,
    samples_per_sec: f64,
}

impl Found {
    fn of(
        mesh: &mut dyn MeshSeries,
        options: &VoxelOptions,
        place: &Workplace,
        memory_bytes: u64,
    ) -> anyhow::Result<Self> {
        let folder = place.path("");
        let room = Room { folder: &folder, list_bytes: memory_bytes / 4, map_bytes: memory_bytes / 4 };
        let voxels = Voxels::new(mesh, &[(0, None)], &BrickLayout::new(EDGE)?, options, room)?;
        let (tree, report) = (voxels.tree(), voxels.report());
        Ok(Self {
            num_tetrahedra: report.census.num_tetrahedra,
            mean_depth: report.mean_depth,
            max_depth: report.max_depth,
            num_nodes: (0..tree.num_levels() as u8).map(|level| tree.nodes(level).len() as u64).sum(),
            num_cut_off: report.num_cut_off,
            tests_per_sec: report.num_tests as f64 / report.secs[1],
            samples_per_sec: report.num_samples as f64 / report.secs[1],
        })
    }

    fn row(&self, stored_bytes: u64) -> Map<String, Value> {
        // The paper's sizes are 135 kB for each node: a gradient and a value, a byte each, of 32³ samples, and little more.
        let raw = self.num_nodes as f64 * (4 * EDGE.pow(3)) as f64;
        object(json!({
            "tetrahedra": self.num_tetrahedra,
            "mean_depth": self.mean_depth,
            "max_depth": self.max_depth,
            "nodes": self.num_nodes,
            "megabytes": raw / 1e6,
            "stored_megabytes": stored_bytes as f64 / 1e6,
            "cut_off": self.num_cut_off,
            "tests_per_sec": self.tests_per_sec,
            "samples_per_sec": self.samples_per_sec,
        }))
    }
}

/// Encodes a variable of a mesh; gives the bytes of a step.
fn encode(
    mesh: &mut dyn MeshSeries,
    store: &Path,
    voxels: &VoxelOptions,
    memory_bytes: u64,
) -> anyhow::Result<u64> {
    let options = EncodeOptions {
        codec: Codec::Auto,
        max_error: Some(0.001),
        variables: vec![mesh.variables()[0].name.clone()],
        brick_edge: EDGE,
        memory_bytes,
        voxels: *voxels,
        ..EncodeOptions::default()
    };
    let report = encode_mesh(mesh, store, &options, &mut |_| {})?;
    Ok(report.stored_bytes / mesh.times().num_steps() as u64)
}

/// The box around the points of a mesh.
fn bounds_of(mesh: &mut dyn MeshSeries) -> anyhow::Result<[[f64; 3]; 2]> {
    let nothing = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
    Ok(mesh.points()?.iter().fold(nothing, |[low, high], p| {
        [std::array::from_fn(|a| low[a].min(p[a])), std::array::from_fn(|a| high[a].max(p[a]))]
    }))
}

fn open(name: &str, options: &SourceOptions) -> anyhow::Result<Box<dyn MeshSeries>> {
    let inputs: Vec<String> = name.split(',').map(str::to_owned).collect();
    let simulated = SourceOptions { memory_bytes: options.memory_bytes, ..SourceOptions::default() };
    let options = if name.starts_with("sim:") { &simulated } else { options };
    match sources::open_any(&inputs, options)? {
        Opened::Mesh(mesh) => Ok(mesh),
        Opened::Volume(_) => anyhow::bail!("--source {name}: a uniform grid: leven2002 measures meshes"),
    }
}

/// The name of the first file without its folder.
fn label_of(name: &str) -> String {
    let first = name.split(',').next().unwrap_or(name);
    if first.starts_with("sim:") {
        first.to_owned()
    } else {
        first.rsplit('/').next().unwrap_or(first).to_owned()
    }
}

fn paper_row(name: &str) -> Map<String, Value> {
    let file = label_of(name).to_lowercase().replace(['_', '-', ' '], "");
    let model = PAPER.iter().find(|model| file.contains(model.name));
    model.map_or(Map::new(), |PaperModel { figures: [tetrahedra, mean, max, nodes, megabytes], .. }| {
        object(json!({
            "tetrahedra": tetrahedra,
            "mean_depth": mean,
            "max_depth": max,
            "nodes": nodes,
            "megabytes": megabytes,
        }))
    })
}

fn tree_section(max_depth: u8) -> Section {
    use Style::Fixed;
    Section {
        title: "Figure 13, octrees at a threshold of 0".to_owned(),
        columns: vec![
            Column::paper("tetrahedra", "tetrahedra: paper", Fixed(0)),
            Column::here("tetrahedra", "here", Fixed(0)),
            Column::paper("mean_depth", "mean depth: paper", Fixed(2)),
            Column::here("mean_depth", "here", Fixed(2)),
            Column::paper("max_depth", "max: paper", Fixed(0)),
            Column::here("max_depth", "here", Fixed(0)),
            Column::paper("nodes", "nodes: paper", Fixed(0)),
            Column::here("nodes", "here", Fixed(0)),
            Column::paper("megabytes", "MB: paper", Fixed(0)),
            Column::here("megabytes", "here", Fixed(0)),
            Column::here("stored_megabytes", "MB stored", Fixed(1)),
            Column::here("cut_off", "leaves cut off", Fixed(0)),
            Column::here("tests_per_sec", "tests/s", Style::Scientific),
            Column::here("samples_per_sec", "samples/s", Style::Scientific),
        ],
        rows: Vec::new(),
        notes: vec![
            format!("depth at most {max_depth}: of leaves that are cut off, points still share a voxel"),
            "MB as the paper counts: 4 bytes for each of the 32³ samples of a node; stored: one step of one variable, bricks of 35³, \
             largest error 0.001 of the range"
                .to_owned(),
            "tests and samples per second each over the time for both".to_owned(),
        ],
    }
}

fn threshold_section(max_depth: u8) -> Section {
    Section {
        title: "Figure 14, size against the threshold on the field".to_owned(),
        columns: vec![
            Column::here("relative_size", "relative size", Style::Fixed(3)),
            Column::here("nodes", "nodes", Style::Fixed(0)),
            Column::here("mean_depth", "mean depth", Style::Fixed(2)),
        ],
        rows: Vec::new(),
        notes: vec![format!("depth at most {max_depth}; the paper shows this as a graph without figures")],
    }
}

fn flight_section() -> Section {
    let figure = |key, heading| Column::here(key, heading, Style::Fixed(2));
    Section {
        title: "Figure 15, a flight at a target frame rate".to_owned(),
        columns: vec![
            Column::paper("aim", "paper aims at", Style::Fixed(0)),
            figure("mean", "mean"),
            figure("median", "median"),
            figure("min", "smallest"),
            figure("max", "largest"),
            Column::here("share_met", "% of frames that meet it", Style::Fixed(0)),
        ],
        rows: Vec::new(),
        notes: vec![
            format!(
                "from afar to where the shock meets the fin, along the fin and away, on the CPU, unlit, at a target of {TARGET_FPS} frames per second; \
                 frames that are ready early are not held back; the mean frame rate is frames over time"
            ),
            "pixels per voxel of a node where it is nearest: of one around the eye, as large as a voxel that touches it; leaves of the tree, \
             which have nothing finer, count"
                .to_owned(),
            format!(
                "the paper shows graphs: 10 frames per second on a GeForce3 in 640x480, well above that for some periods, during which the \
                 largest error is usually below {FINE_ENOUGH} pixel per voxel; --out has the plot of this flight"
            ),
        ],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_models_are_known_by_their_files() {
        assert_eq!(paper_row("/data/plot3d/bluntfinxyz.bin,/data/plot3d/bluntfinq.bin")["nodes"], 22_208.0);
        assert_eq!(paper_row("Post_xyz.bin")["max_depth"], 11.0);
        assert!(paper_row("/post/wing.vtu").is_empty());
        assert_eq!(label_of("/data/a.vtu,/data/b.vtu"), "a.vtu");
    }
}
