//! Ellsworth, Chiang, Shen: Accelerating Time-Varying Hardware Volume Rendering Using TSP Trees and Color-Based Error Metrics (2000),
//! section 6: time to compute the metrics, time per frame, and what part of the volume is drawn in which way.
//!
//! The paper's data are not to be had. Its shock is a simulation of the kind of `sim:shockbubble`; the others are printed alone.
//! What the paper calls textures are decoded bricks here: *not cached* is a pass over the steps that starts without any, *cached* the pass after it.

mod paper;
mod search;

use std::{path::Path, time::Instant};

use chronoxel_core::{
    ColorMap, Image8, TimeNode, TransferFunction,
    compare::luv_distance,
    metrics::{ColorSpace, ColorTable, approximate_spatial, approximate_temporal},
    time_tree::{num_time_levels, num_time_nodes},
};
use chronoxel_ingest::{Codec, EncodeOptions, encode};
use chronoxel_stream::{Shares, Tolerances};
use serde_json::{Map, Value, json};

use super::{BenchReport, Column, Input, Row, Section, Size, Style, Workplace, machine, object};
use crate::{
    interrupt,
    session::{CoherenceView, Metric, Picture, Session, View, orbit_camera},
};
use paper::{CASES, PaperCase, TOLERANCES};

/// Edges of bricks: the question of section 4.4.
const BRICK_EDGES: [usize; 3] = [16, 32, 64];
/// The paper's own edge.
const PAPER_EDGE: usize = 32;
/// Transfer functions.
const TRANSFERS: [&str; 2] = ["sparse", "filled"];
/// Distance of samples, in voxels, as in the paper.
const STEP_VOXELS: f64 = 0.5;
/// Steps whose pictures are looked at in a search, at most.
const SEARCH_STEPS: usize = 6;
/// Mean L*u*v* distances from the pictures without tolerance that the tolerances *slight* and *moderate* are searched for, as shares of
/// the mean distance of those pictures from black: what sparse pictures show is little.
const DISTANCE_SHARES: [f64; 2] = [0.015, 0.06];

/// The metrics: the paper's three, and the two of them that see colours with distances in L*u*v*.
const METRICS: [(&str, Metric); 5] = [
    ("scalar", Metric::Scalar),
    ("reference", Metric::ColorReference(ColorSpace::Rgb)),
    ("approximate", Metric::ColorApproximate(ColorSpace::Rgb)),
    ("reference luv", Metric::ColorReference(ColorSpace::Luv)),
    ("approximate luv", Metric::ColorApproximate(ColorSpace::Luv)),
];

const SHOCK: [&str; 2] =
    ["sim:shockbubble?dims=96x48x48&steps=24", "sim:shockbubble?dims=512x64x64&steps=25"];

/// Sizes of pictures.
#[derive(Debug, Clone, Copy)]
struct PictureSizes {
    picture: [usize; 2],
    /// Of those by which tolerances are searched.
    search: [usize; 2],
}

impl PictureSizes {
    /// As in the paper, but for tests.
    fn of(size: Size) -> Self {
        match size {
            Size::Tiny => Self { picture: [64, 48], search: [32, 24] },
            Size::Small | Size::Full => Self { picture: [640, 480], search: [320, 240] },
        }
    }
}

/// The sources to measure: the simulation, Hurricane Isabel where the folder that `CHRONOXEL_DATA` names has `isabel/*.vti`, and the user's; what
/// the user names takes the place of its like.
pub fn sources(users: &[String], size: Size) -> Vec<String> {
    let named = |part: &str| users.iter().any(|source| source.contains(part));
    let shock = SHOCK[usize::from(size == Size::Full)].to_owned();
    let built_in = [(!named("sim:shockbubble")).then_some(shock), hurricane().filter(|_| !named("isabel"))];
    built_in.into_iter().flatten().chain(users.iter().cloned()).collect()
}

fn hurricane() -> Option<String> {
    let folder = Path::new(&std::env::var_os("CHRONOXEL_DATA")?).join("isabel");
    folder.is_dir().then(|| folder.join("*.vti").to_string_lossy().into_owned())
}

/// Measures the sources. `progress` is told what is done and what there is to do.
///
/// # Errors
/// If a source cannot be read or drawn, the workplace cannot be written, or Ctrl-C was pressed.
pub fn run(
    inputs: Vec<Input>,
    size: Size,
    place: &Workplace,
    memory_bytes: u64,
    progress: &mut dyn FnMut(u64, u64),
) -> anyhow::Result<BenchReport> {
    let cases = BRICK_EDGES.len() * TRANSFERS.len() * (METRICS.len() + 1);
    let total = inputs.iter().map(|input| (input.num_steps() + cases) as u64).sum();
    let mut done = 0;
    let mut on_part = || {
        done += 1;
        progress(done.min(total), total);
    };
    let mut sections = Vec::new();
    for mut input in inputs {
        input.record(place, &mut on_part)?;
        sections.extend(sections_of(&mut input, PictureSizes::of(size), place, memory_bytes, &mut on_part)?);
    }
    sections.extend(paper_sections());
    Ok(BenchReport { name: "ellsworth2000", machine: machine(), sections, plots: Vec::new() })
}

/// The tables of a source.
struct Tables {
    builds: Section,
    times: Section,
    shares: Section,
}

fn sections_of(
    input: &mut Input,
    sizes: PictureSizes,
    place: &Workplace,
    memory_bytes: u64,
    on_part: &mut dyn FnMut(),
) -> anyhow::Result<Vec<Section>> {
    let mut tables = Tables::new(input.name());
    let is_shock = input.is_simulation("shockbubble");
    for edge in BRICK_EDGES {
        let store = place.path("encoded.cxl");
        let variables = vec![input.variable().name.clone()];
        let options = EncodeOptions {
            codec: Codec::Raw,
            bits: Some(8.0),
            brick_edge: edge,
            memory_bytes,
            variables,
            ..EncodeOptions::default()
        };
        let start = Instant::now();
        encode(&mut input.series(), &store, &options, &mut |_| ())?;
        let encode_secs = start.elapsed().as_secs_f64();
        for transfer in TRANSFERS {
            let is_papers = |case: &&PaperCase| {
                is_shock && edge == PAPER_EDGE && case.data.starts_with("shock") && case.transfer == transfer
            };
            let label = format!("brick {edge}, {transfer}");
            let paper = CASES.iter().find(is_papers);
            let mut case = Case::open(&store, transfer, sizes, memory_bytes)?;
            tables.builds.rows.push(case.build_row(&label, encode_secs, paper)?);
            case.measure(&label, paper, &mut tables, on_part)?;
        }
        place.remove(&store)?;
    }
    let Tables { builds, times, shares } = tables;
    Ok(vec![builds, times, shares])
}

/// A store drawn under a transfer function.
struct Case {
    session: Session,
    view: View,
    sizes: PictureSizes,
    num_steps: usize,
}

/// What a pass over all steps took.
struct Pass {
    frame_ms: f64,
    shares: Shares,
    /// Mean over the steps of the mean distance to the picture without tolerance.
    distance: f64,
}

impl Case {
    fn open(store: &Path, transfer: &str, sizes: PictureSizes, memory_bytes: u64) -> anyhow::Result<Self> {
        let session = Session::open(store, None, memory_bytes)?;
        let header = session.store().header();
        let view = View {
            camera: orbit_camera(&header.grid, [30.0, 20.0], 1.0, Some(30.0), sizes.picture)?,
            transfer: session.resolve(&TransferFunction::built_in(transfer, ColorMap::Viridis)?)?,
            size: sizes.picture,
            step_voxels: STEP_VOXELS,
            lighting: None,
            opacity_unit: header.grid.smallest_spacing(),
            level: 0,
            coherence: None,
            level_borders: Default::default(),
        };
        let num_steps = header.num_steps_finished as usize;
        Ok(Self { session, view, sizes, num_steps })
    }

    fn draw(&mut self, step: usize) -> anyhow::Result<Picture> {
        interrupt::check()?;
        self.session.draw(&self.view, step)
    }

    fn pictures(&mut self, steps: impl IntoIterator<Item = usize>) -> anyhow::Result<Vec<Image8>> {
        steps.into_iter().map(|step| Ok(shown(&self.draw(step)?))).collect()
    }

    /// Draws every step.
    ///
    /// * `exact`: the pictures without tolerance
    fn pass(&mut self, exact: Option<&[Image8]>) -> anyhow::Result<Pass> {
        let mut pass = Pass { frame_ms: 0.0, shares: Shares::default(), distance: 0.0 };
        for step in 0..self.num_steps {
            let start = Instant::now();
            let picture = self.draw(step)?;
            pass.frame_ms += start.elapsed().as_secs_f64() * 1e3 / self.num_steps as f64;
            pass.shares = pass.shares.with(&picture.shares);
            if let Some(exact) = exact {
                pass.distance += luv_distance(&exact[step], &shown(&picture))?.0 / self.num_steps as f64;
            }
        }
        Ok(pass)
    }

    fn measure(
        &mut self,
        label: &str,
        paper: Option<&PaperCase>,
        tables: &mut Tables,
        on_part: &mut dyn FnMut(),
    ) -> anyhow::Result<()> {
        self.view.coherence = None;
        self.session.forget_bricks();
        let plain = [self.pass(None)?.frame_ms, self.pass(None)?.frame_ms];
        let exact = self.pictures(0..self.num_steps)?;
        self.view.size = self.sizes.search;
        let exact_small = self.pictures(self.search_steps())?;
        self.view.size = self.sizes.picture;
        let visible = mean_visible(&exact_small)?;
        on_part();
        let mut times: [Map<String, Value>; 3] = std::array::from_fn(|_| times_of("plain", plain));
        for (metric_index, (name, metric)) in METRICS.into_iter().enumerate() {
            for (tolerance_index, tolerance_name) in TOLERANCES.into_iter().enumerate() {
                let tolerances = match tolerance_index {
                    0 => Tolerances::default(),
                    i => self.tolerances(metric, DISTANCE_SHARES[i - 1] * visible, &exact_small)?,
                };
                self.set_tolerances(metric, tolerances);
                self.session.forget_bricks();
                let first = self.pass(None)?;
                let again = self.pass(Some(&exact))?;
                // The distance is taken between the frames, not within them.
                times[tolerance_index].extend(times_of(name, [first.frame_ms, again.frame_ms]));
                let label = format!("{label}, {tolerance_name}, {name}");
                let paper =
                    paper.filter(|_| metric_index < 3).map(|p| p.shares[tolerance_index][metric_index]);
                tables.shares.rows.push(share_row(label, paper, &again, tolerances));
            }
            on_part();
        }
        for (index, here) in times.into_iter().enumerate() {
            let paper = paper.map_or(Map::new(), |case| paper_times(case, index));
            tables.times.rows.push(Row { label: format!("{label}, {}", TOLERANCES[index]), paper, here });
        }
        Ok(())
    }

    /// Tolerances whose pictures differ by a distance: half of it from what is coherent in space, the rest from what is in time.
    fn tolerances(&mut self, metric: Metric, wanted: f64, exact: &[Image8]) -> anyhow::Result<Tolerances> {
        self.view.size = self.sizes.search;
        let spatial = search::tolerance(0.5 * wanted, |spatial| {
            self.distance(metric, Tolerances { spatial, temporal: 0.0 }, exact)
        })?;
        let temporal = search::tolerance(wanted, |temporal| {
            self.distance(metric, Tolerances { spatial, temporal }, exact)
        })?;
        self.view.size = self.sizes.picture;
        Ok(Tolerances { spatial, temporal })
    }

    fn set_tolerances(&mut self, metric: Metric, tolerances: Tolerances) {
        self.view.coherence = Some(CoherenceView {
            metric,
            tolerances,
            // As in the paper, where only colours tell what is transparent.
            skips_transparent: metric != Metric::Scalar,
        });
    }

    /// A few steps between the ends of the longer time nodes.
    fn search_steps(&self) -> Vec<usize> {
        let num = self.num_steps.min(SEARCH_STEPS);
        (0..num).map(|i| (2 * i + 1) * self.num_steps / (2 * num)).collect()
    }

    /// Mean distance to the pictures without tolerance of [`Self::search_steps`].
    fn distance(&mut self, metric: Metric, tolerances: Tolerances, exact: &[Image8]) -> anyhow::Result<f64> {
        self.set_tolerances(metric, tolerances);
        let (mut sum, num_steps) = (0.0, exact.len() as f64);
        for (step, exact) in self.search_steps().into_iter().zip(exact) {
            sum += luv_distance(exact, &shown(&self.draw(step)?))?.0 / num_steps;
        }
        Ok(sum)
    }

    /// Seconds to compute each metric for all nodes and all steps.
    fn build_row(&mut self, label: &str, encode_secs: f64, paper: Option<&PaperCase>) -> anyhow::Result<Row> {
        let mut here = object(json!({ "scalar": encode_secs }));
        for (space, reference, approximate, step) in [
            (ColorSpace::Rgb, "reference", "approximate", "approximate_step_ms"),
            (ColorSpace::Luv, "reference luv", "approximate luv", "approximate_luv_step_ms"),
        ] {
            let start = Instant::now();
            self.session.reference_errors(&self.view, space)?;
            here.insert(reference.into(), start.elapsed().as_secs_f64().into());
            let [all_secs, step_secs] = self.approximate_secs(space)?;
            here.insert(approximate.into(), all_secs.into());
            here.insert(step.into(), (1e3 * step_secs).into());
        }
        let tree = self.session.store().tree();
        here.insert("leaves".into(), tree.nodes(0).len().into());
        here.insert("nodes".into(), num_nodes(tree).into());
        let paper = paper.map_or(Map::new(), |case| {
            paper::METRICS
                .iter()
                .zip(case.build_secs)
                .map(|(name, secs)| (name.to_string(), secs.into()))
                .collect()
        });
        Ok(Row { label: label.to_owned(), paper, here })
    }

    /// Seconds to estimate all nodes over all time nodes, and over those that hold one step.
    fn approximate_secs(&self, space: ColorSpace) -> anyhow::Result<[f64; 2]> {
        let (store, variable) = (self.session.store(), self.session.variable());
        let num_steps = store.header().num_steps();
        let step = num_steps / 2;
        let mut secs = [0.0; 2];
        for level in 0..num_time_levels(num_steps) {
            for index in 0..num_time_nodes(num_steps, level) {
                let at = TimeNode { level, index };
                let statistics = store.statistics(variable, at)?;
                let start = Instant::now();
                let table = ColorTable::new(&self.view.transfer, self.session.variable_range(), 256, space);
                let sum: f64 = statistics
                    .iter()
                    .map(|node| {
                        let spatial = approximate_spatial(&table, &self.view.transfer, node).error;
                        spatial + approximate_temporal(&table, node)
                    })
                    .sum();
                std::hint::black_box(sum);
                let taken = start.elapsed().as_secs_f64();
                secs[0] += taken;
                secs[1] += if at == TimeNode::holding(step, level) { taken } else { 0.0 };
            }
        }
        Ok(secs)
    }
}

fn num_nodes(tree: &chronoxel_core::Octree) -> usize {
    (0..tree.num_levels() as u8).map(|level| tree.nodes(level).len()).sum()
}

/// Mean L*u*v* distance of pictures from black.
fn mean_visible(pictures: &[Image8]) -> anyhow::Result<f64> {
    let mut sum = 0.0;
    for picture in pictures {
        let black = Image8::filled(picture.width, picture.height, [0, 0, 0, 255]);
        sum += luv_distance(picture, &black)?.0 / pictures.len() as f64;
    }
    Ok(sum)
}

/// A picture over black, as it is compared.
fn shown(picture: &Picture) -> Image8 {
    Image8::from_image(&picture.image, chronoxel_core::Background::Color([0.0; 3]))
}

fn times_of(name: &str, [not_cached, cached]: [f64; 2]) -> Map<String, Value> {
    let keyed = |kind: &str, ms: f64| (format!("{name}, {kind}"), Value::from(ms));
    [keyed("not cached", not_cached), keyed("cached", cached)].into_iter().collect()
}

fn paper_times(case: &PaperCase, tolerance: usize) -> Map<String, Value> {
    let plain = if tolerance == 0 { times_of("plain", case.plain_ms) } else { Map::new() };
    let of_metrics = paper::METRICS.iter().zip(case.frame_ms[tolerance]);
    plain.into_iter().chain(of_metrics.flat_map(|(name, ms)| times_of(name, ms))).collect()
}

/// Names of the shares, in the order of the paper's table 5.
const SHARES: [&str; 4] = ["not_rendered", "constant", "reused", "new"];

fn shares_of(percent: [f64; 4]) -> Map<String, Value> {
    SHARES.iter().zip(percent).map(|(name, percent)| (name.to_string(), percent.into())).collect()
}

fn share_row(label: String, paper: Option<[f64; 4]>, pass: &Pass, tolerances: Tolerances) -> Row {
    let Shares { skipped, constant, reused, new } = pass.shares;
    let total = pass.shares.total().max(1) as f64;
    let mut here = shares_of([skipped, constant, reused, new].map(|n| 100.0 * n as f64 / total));
    here.insert("spatial_tolerance".into(), tolerances.spatial.into());
    here.insert("temporal_tolerance".into(), tolerances.temporal.into());
    here.insert("luv_distance".into(), pass.distance.into());
    Row { label, paper: paper.map_or(Map::new(), shares_of), here }
}

/// The paper's figures of data that cannot be measured.
fn paper_sections() -> Vec<Section> {
    let mut tables = Tables::new("the paper's data, not measured here");
    for case in &CASES {
        let label = format!("{}, {}", case.data, case.transfer);
        for (tolerance, name) in TOLERANCES.into_iter().enumerate() {
            let paper = paper_times(case, tolerance);
            tables.times.rows.push(Row { label: format!("{label}, {name}"), paper, here: Map::new() });
            for (metric, shares) in paper::METRICS.iter().zip(case.shares[tolerance]) {
                let label = format!("{label}, {name}, {metric}");
                tables.shares.rows.push(Row { label, paper: shares_of(shares), here: Map::new() });
            }
        }
        let secs = paper::METRICS.iter().zip(case.build_secs);
        let paper = secs.map(|(name, secs)| (name.to_string(), secs.into())).collect();
        tables.builds.rows.push(Row { label, paper, here: Map::new() });
    }
    let sections = [tables.builds, tables.times, tables.shares];
    let only_papers = |mut section: Section| {
        section.notes.clear();
        section.columns.retain(|column| column.side == super::Side::Paper);
        section
    };
    sections.map(only_papers).into()
}

impl Tables {
    fn new(name: &str) -> Self {
        Self {
            builds: build_section(format!("Table 2, seconds to compute the metrics: {name}")),
            times: time_section(format!("Tables 3 and 4, ms per frame: {name}")),
            shares: share_section(format!("Table 5, % of samples by how they are drawn: {name}")),
        }
    }
}

fn build_section(title: String) -> Section {
    let columns = vec![
        Column::paper("scalar", "paper: scalar", Style::Fixed(0)),
        Column::paper("reference", "reference", Style::Fixed(0)),
        Column::paper("approximate", "approximate", Style::Fixed(2)),
        Column::here("scalar", "here: scalar", Style::Fixed(3)),
        Column::here("reference", "reference", Style::Fixed(2)),
        Column::here("approximate", "approximate", Style::Fixed(4)),
        Column::here("approximate_step_ms", "of one step, ms", Style::Fixed(3)),
        Column::here("reference luv", "reference luv", Style::Fixed(2)),
        Column::here("approximate luv", "approximate luv", Style::Fixed(4)),
        Column::here("leaves", "bricks", Style::Fixed(0)),
        Column::here("nodes", "nodes", Style::Fixed(0)),
    ];
    let notes = [
        "scalar: the whole encoding, which computes the statistics in passing; reference: every sample of every step, all threads; \
         approximate: 256 entries, one thread, all nodes over all time nodes, and over those that hold one step",
    ];
    Section { title, columns, rows: Vec::new(), notes: notes.map(str::to_owned).into() }
}

fn time_section(title: String) -> Section {
    let mut columns = Vec::new();
    columns.extend(["plain", "scalar", "reference", "approximate"].into_iter().flat_map(papers_times));
    let mut heres = [
        ("plain, not cached", "here: plain"),
        ("plain, cached", "cached"),
        ("scalar, not cached", "scalar"),
        ("scalar, cached", "cached"),
        ("reference, not cached", "reference"),
        ("reference, cached", "cached"),
        ("approximate, not cached", "approximate"),
        ("approximate, cached", "cached"),
        ("approximate luv, not cached", "approx. luv"),
        ("approximate luv, cached", "cached"),
    ]
    .map(|(key, heading)| Column::here(key, heading, Style::Fixed(1)))
    .to_vec();
    columns.append(&mut heres);
    let notes = [
        "640x480, a sample per half voxel, unlit, on the processor; plain: without the tree's errors; not cached: a pass over the steps \
         that starts with no brick in memory; cached: the next pass",
    ];
    Section { title, columns, rows: Vec::new(), notes: notes.map(str::to_owned).into() }
}

fn papers_times(metric: &str) -> [Column; 2] {
    match metric {
        "plain" => [("plain, not cached", "paper: plain"), ("plain, cached", "cached")],
        "scalar" => [("scalar, not cached", "scalar"), ("scalar, cached", "cached")],
        "reference" => [("reference, not cached", "reference"), ("reference, cached", "cached")],
        _ => [("approximate, not cached", "approximate"), ("approximate, cached", "cached")],
    }
    .map(|(key, heading)| Column::paper(key, heading, Style::Fixed(0)))
}

fn share_section(title: String) -> Section {
    let columns = vec![
        Column::paper("not_rendered", "paper: not rendered", Style::Fixed(0)),
        Column::paper("constant", "constant", Style::Fixed(0)),
        Column::paper("reused", "reused", Style::Fixed(0)),
        Column::paper("new", "new", Style::Fixed(0)),
        Column::here("not_rendered", "here: not rendered", Style::Fixed(1)),
        Column::here("constant", "constant", Style::Fixed(1)),
        Column::here("reused", "reused", Style::Fixed(1)),
        Column::here("new", "new", Style::Fixed(1)),
        Column::here("spatial_tolerance", "tolerance in space", Style::Scientific),
        Column::here("temporal_tolerance", "in time", Style::Scientific),
        Column::here("luv_distance", "L*u*v* distance", Style::Fixed(3)),
    ];
    let notes = [
        "mean over the steps; reused: drawn from an earlier step; scalar: nothing is skipped for being transparent, as in the paper; \
         tolerances: searched for the same mean L*u*v* distance (D65) to the pictures without, half of it from coherence in space: slight 1.5 %, moderate 6 % of those \
         pictures' distance from black",
        "the paper, sparse, without tolerance: 66 % of its large Delta and 61 % of its F18 are not rendered",
    ];
    Section { title, columns, rows: Vec::new(), notes: notes.map(str::to_owned).into() }
}
