//! Lum, Ma, Clyne: Texture Hardware Assisted Rendering of Time-Varying Volume Data (Visualization 2001), section 4: errors, time to
//! encode and frame rates at 2, 4 and 8 steps of 8 bits in one byte.
//!
//! The paper's data are not to be had. Its turbulent vortex and its shock bubble stand beside simulations of the same kind; its
//! quasi-geostrophic turbulence is printed alone; any other source is measured alone.

use std::cell::RefCell;

use chronoxel_ingest::{Codec, EncodeOptions, encode, measure};
use chronoxel_store::Store;
use serde_json::{Map, Value, json};

use super::{BenchReport, Column, Input, Row, Section, Size, Stepping, Style, Workplace, machine, object};
use crate::process::resource_usage;

/// Steps in one byte: the paper's compression ratios.
const RATIOS: [u32; 3] = [2, 4, 8];

/// What is encoded at each ratio.
const CODECS: [(Codec, &str); 3] = [
    (Codec::Palette, "product palette"),
    (Codec::PaletteSlice, "product palette per slice"),
    (Codec::Vq, "vector palette"),
];

/// A data set of the paper, with what the paper says of it.
struct PaperData {
    name: &'static str,
    /// The built-in simulation of the same kind, and at which sizes it is run.
    simulation: Option<Simulation>,
    error_table: u32,
    /// Mean square error on [0, 1] over the steps, at each of [`RATIOS`]: smallest, largest, average.
    mse: [[f64; 3]; 3],
    fps_table: u32,
    /// Frames per second at 1, 2, 4 and 8 steps in a byte: in-core and, where it is told, out-of-core.
    fps: [(f64, Option<f64>); 4],
}

struct Simulation {
    name: &'static str,
    small: &'static str,
    full: &'static str,
}

const VORTEX: PaperData = PaperData {
    name: "turbulent vortex flow, 128^3, 100 steps",
    simulation: Some(Simulation {
        name: "vortex",
        small: "sim:vortex?dims=64&steps=32",
        full: "sim:vortex?dims=128&steps=100",
    }),
    error_table: 6,
    mse: [
        [0.000_061, 0.000_199, 0.000_136],
        [0.000_169, 0.000_423, 0.000_304],
        [0.000_510, 0.001_147, 0.000_856],
    ],
    fps_table: 4,
    fps: [(28.7, None), (51.6, None), (70.7, None), (76.1, None)],
};

const SHOCK_BUBBLE: PaperData = PaperData {
    name: "shock-bubble flow, 640x256x256, 265 steps",
    simulation: Some(Simulation {
        name: "shockbubble",
        small: "sim:shockbubble?dims=96x48x48&steps=64",
        full: "sim:shockbubble?dims=320x128x128&steps=100",
    }),
    error_table: 7,
    mse: [
        [0.000_009, 0.000_017, 0.000_013],
        [0.000_023, 0.000_040, 0.000_032],
        [0.000_046, 0.000_082, 0.000_065],
    ],
    fps_table: 3,
    fps: [(4.4, Some(0.9)), (6.3, Some(1.6)), (9.3, Some(3.1)), (11.7, Some(5.8))],
};

const QUASI_GEOSTROPHIC: PaperData = PaperData {
    name: "quasi-geostrophic turbulent flow, 256^3, 1492 steps",
    simulation: None,
    error_table: 5,
    mse: [
        [0.000_005, 0.000_109, 0.000_015],
        [0.000_009, 0.000_369, 0.000_037],
        [0.000_012, 0.000_875, 0.000_075],
    ],
    fps_table: 2,
    fps: [(11.5, Some(2.0)), (17.3, Some(3.5)), (25.8, Some(6.8)), (31.6, Some(13.4))],
};

/// The paper's data, in the order of its tables of errors.
const ALL_DATA: [PaperData; 3] = [QUASI_GEOSTROPHIC, VORTEX, SHOCK_BUBBLE];

/// Seconds that the paper's encoder takes for a step of 256³, depending on the ratio.
const ENCODE_SECS: [f64; 2] = [5.0, 15.0];
const ENCODE_SAMPLES: f64 = (256 * 256 * 256) as f64;

/// The sources to measure: the simulations, and the user's; a simulation of the same name takes the place of one of the former.
pub fn sources(users: &[String], size: Size) -> Vec<String> {
    let is_of = |source: &str, simulation: &Simulation| {
        source.strip_prefix("sim:").and_then(|spec| spec.split('?').next()) == Some(simulation.name)
    };
    let simulations = ALL_DATA.iter().filter_map(|data| data.simulation.as_ref());
    let missing = simulations.filter(|simulation| !users.iter().any(|source| is_of(source, simulation)));
    let of_size = missing.map(|simulation| match size {
        Size::Tiny | Size::Small => simulation.small.to_owned(),
        Size::Full => simulation.full.to_owned(),
    });
    of_size.chain(users.iter().cloned()).collect()
}

/// Measures the sources. `progress` is told what is done and what there is to do.
///
/// # Errors
/// If a source cannot be read, the workplace cannot be written, or Ctrl-C was pressed.
pub fn run(
    inputs: Vec<Input>,
    place: &Workplace,
    memory_bytes: u64,
    progress: &mut dyn FnMut(u64, u64),
) -> anyhow::Result<BenchReport> {
    let total = inputs.iter().map(num_parts).sum();
    let mut done = 0;
    let mut on_part = |num_parts: u64| {
        done += num_parts;
        progress(done.min(total), total);
    };
    let mut sections = paper_sections(&QUASI_GEOSTROPHIC);
    for mut input in inputs {
        input.record(place, &mut || on_part(1))?;
        sections.extend(sections_of(&mut input, place, memory_bytes, &mut on_part)?);
    }
    Ok(BenchReport { name: "lum2001", machine: machine(), sections, plots: Vec::new() })
}

/// Parts of the work on a source, for progress: steps recorded, encoded and measured, frames.
fn num_parts(input: &Input) -> u64 {
    let num_steps = input.num_steps() as u64;
    let num_measured = (CODECS.len() * RATIOS.len()) as u64;
    let recorded = if input.is_simulated() { num_steps } else { 0 };
    recorded + num_steps * (1 + 2 * num_measured) + 4 * Stepping::num_frames(input.num_steps())
}

/// What the paper says of data that cannot be measured.
fn paper_sections(data: &PaperData) -> Vec<Section> {
    let title = |table: u32, what: &str| format!("Table {table}, {what}: {}, not measured here", data.name);
    let mut errors = error_section(title(data.error_table, "mean square error"));
    let mut rates = rate_section(title(data.fps_table, "frames per second"));
    errors.notes.clear();
    rates.notes.clear();
    for (index, ratio) in RATIOS.into_iter().enumerate() {
        let paper = paper_errors(data, index);
        errors.rows.push(Row { label: format!("{ratio}x"), paper, here: Map::new() });
    }
    for (ratio, rate) in [1, 2, 4, 8].into_iter().zip(data.fps) {
        rates.rows.push(Row { label: format!("{ratio}x"), paper: paper_rates(rate), here: Map::new() });
    }
    vec![errors, rates]
}

/// Everything measured on one source: errors, time to encode, frame rates.
fn sections_of(
    input: &mut Input,
    place: &Workplace,
    memory_bytes: u64,
    on_part: &mut dyn FnMut(u64),
) -> anyhow::Result<Vec<Section>> {
    let data = ALL_DATA.iter().find(|data| match &data.simulation {
        Some(simulation) => input.is_simulation(simulation.name),
        None => false,
    });
    let title = |table: Option<u32>, what: &str| match table {
        Some(table) => format!("Table {table}, {what}: {}", input.name()),
        None => format!("{what}: {}", input.name()),
    };
    let mut errors = error_section(title(data.map(|d| d.error_table), "mean square error"));
    let mut times = time_section(title(None, "seconds to encode a step of 256^3"));
    let mut rates = rate_section(title(data.map(|d| d.fps_table), "frames per second"));

    let raw = EncodeOptions { codec: Codec::Raw, bits: Some(8.0), ..EncodeOptions::default() };
    let encoded = Encoded::make(input, raw, place, memory_bytes, on_part)?;
    rates.rows.push(encoded.rate_row(1, data.map(|d| d.fps[0]), memory_bytes, on_part)?);
    encoded.remove(place)?;
    for (index, ratio) in RATIOS.into_iter().enumerate() {
        for (codec, codec_name) in CODECS {
            let options = EncodeOptions { codec, window: Some(ratio), ..EncodeOptions::default() };
            let encoded = Encoded::make(input, options, place, memory_bytes, on_part)?;
            let label = format!("{ratio}x, {codec_name}");
            times.rows.push(encoded.time_row(label.clone()));
            let paper = data.map_or(Map::new(), |data| paper_errors(data, index));
            errors.rows.push(Row { label, paper, here: encoded.errors(input, on_part)? });
            if codec == Codec::Palette {
                let paper = data.map(|data| data.fps[index + 1]);
                rates.rows.push(encoded.rate_row(ratio, paper, memory_bytes, on_part)?);
            }
            encoded.remove(place)?;
        }
    }
    Ok(vec![errors, times, rates])
}

/// A source encoded in one way, and what that took.
struct Encoded {
    store: std::path::PathBuf,
    num_steps: usize,
    num_samples: usize,
    raw_bytes: u64,
    wall_secs: f64,
    cpu_secs: f64,
}

impl Encoded {
    fn make(
        input: &mut Input,
        options: EncodeOptions,
        place: &Workplace,
        memory_bytes: u64,
        on_part: &mut dyn FnMut(u64),
    ) -> anyhow::Result<Self> {
        let store = place.path("encoded.cxl");
        let variable = input.variable().name.clone();
        let options = EncodeOptions { memory_bytes, variables: vec![variable], ..options };
        let (num_steps, num_samples) = (input.num_steps(), input.num_samples());
        let cpu_secs = || resource_usage().map_or(0.0, |usage| usage.cpu_secs);
        let cpu_before = cpu_secs();
        let mut num_told = 0;
        let report = encode(&mut input.series(), &store, &options, &mut |done| {
            if done.step as u64 > num_told {
                on_part(done.step as u64 - num_told);
                num_told = done.step as u64;
            }
        })?;
        on_part(num_steps as u64 - num_told);
        Ok(Self {
            store,
            num_steps,
            num_samples,
            raw_bytes: report.raw_bytes,
            wall_secs: report.wall_secs,
            cpu_secs: cpu_secs() - cpu_before,
        })
    }

    fn time_row(&self, label: String) -> Row {
        let scale = ENCODE_SAMPLES / (self.num_samples as f64 * self.num_steps as f64);
        let [min, max] = ENCODE_SECS;
        Row {
            label,
            paper: object(json!({ "secs_per_step_min": min, "secs_per_step_max": max })),
            here: object(json!({
                "secs_per_step": self.wall_secs * scale,
                "cpu_secs_per_step": self.cpu_secs * scale,
                "bytes_per_sec": self.raw_bytes as f64 / self.wall_secs,
            })),
        }
    }

    fn errors(&self, input: &mut Input, on_part: &mut dyn FnMut(u64)) -> anyhow::Result<Map<String, Value>> {
        let store = Store::open(&self.store)?;
        let on_part = RefCell::new(on_part);
        let steps = (0..self.num_steps).inspect(|_| on_part.borrow_mut()(1));
        let found = measure(&store, &mut input.series(), steps)?;
        let errors = &found.variables[0];
        let [min, max, avg] = errors.mse_range();
        let (all, core) = bits_per_sample(&store)?;
        Ok(object(json!({
            "mse_min": min,
            "mse_max": max,
            "mse_avg": avg,
            "psnr_db": Some(errors.psnr_db()).filter(|psnr| psnr.is_finite()),
            "max_abs_error": errors.max_abs_error,
            "bits_per_sample": all,
            "bits_per_sample_without_apron": core,
        })))
    }

    fn rate_row(
        &self,
        ratio: u32,
        paper: Option<(f64, Option<f64>)>,
        memory_bytes: u64,
        on_part: &mut dyn FnMut(u64),
    ) -> anyhow::Result<Row> {
        let found = Stepping::measure(&self.store, memory_bytes, &mut || on_part(1))?;
        Ok(Row {
            label: if ratio == 1 { "1x, 8 bits".to_owned() } else { format!("{ratio}x, product palette") },
            paper: paper.map_or(Map::new(), paper_rates),
            here: object(json!({
                "fps_in_core": found.fps_in_core,
                "fps_out_of_core": found.fps_out_of_core,
                "bytes_per_step": found.bytes_per_step,
                "ms_per_step": found.fetch_ms_per_step,
                "steps_in_core": found.num_steps_in_core,
                "steps": self.num_steps,
                "window_share": found.window_share,
            })),
        })
    }

    fn remove(self, place: &Workplace) -> anyhow::Result<()> {
        place.remove(&self.store)
    }
}

/// Stored bits per sample and step, everything counted, and without the share of the apron.
///
/// Without the apron: `stored - payload * apron / (core + apron)`, where `stored` are the bytes of all files of the store, `payload` those of
/// its payloads after zstd, `core` and `apron` those before zstd: as if the indices of the apron shrank as much as the others.
fn bits_per_sample(store: &Store) -> anyhow::Result<(f64, f64)> {
    let header = store.header();
    let totals = &header.totals;
    let stored = store.stored_bytes()? as f64;
    let indices = (totals.core_bytes + totals.apron_bytes).max(1) as f64;
    let apron = totals.payload_bytes as f64 * totals.apron_bytes as f64 / indices;
    let per_sample = 8.0 / (header.grid.num_samples() as f64 * f64::from(header.num_steps()));
    Ok((stored * per_sample, (stored - apron) * per_sample))
}

fn paper_errors(data: &PaperData, ratio: usize) -> Map<String, Value> {
    let [min, max, avg] = data.mse[ratio];
    object(json!({ "mse_min": min, "mse_max": max, "mse_avg": avg }))
}

fn paper_rates((in_core, out_of_core): (f64, Option<f64>)) -> Map<String, Value> {
    let mut rates = object(json!({ "fps_in_core": in_core }));
    rates.extend(out_of_core.map(|fps| ("fps_out_of_core".to_owned(), fps.into())));
    rates
}

fn error_section(title: String) -> Section {
    let columns = vec![
        Column::paper("mse_min", "paper: min", Style::Scientific),
        Column::paper("mse_max", "max", Style::Scientific),
        Column::paper("mse_avg", "avg", Style::Scientific),
        Column::here("mse_min", "here: min", Style::Scientific),
        Column::here("mse_max", "max", Style::Scientific),
        Column::here("mse_avg", "avg", Style::Scientific),
        Column::here("psnr_db", "PSNR dB", Style::Fixed(2)),
        Column::here("bits_per_sample", "bits/sample", Style::Fixed(3)),
        Column::here("bits_per_sample_without_apron", "without apron", Style::Fixed(3)),
    ];
    let notes = [
        "values scaled to [0, 1] by the variable's range; min, max and avg over steps",
        "bits per sample and step: all files of the store; without apron: stored - payload * apron / (core + apron), \
         bytes of payloads after zstd times the apron's share before it",
    ];
    Section { title, columns, rows: Vec::new(), notes: notes.map(str::to_owned).into() }
}

fn time_section(title: String) -> Section {
    let columns = vec![
        Column::paper("secs_per_step_min", "paper: from", Style::Fixed(0)),
        Column::paper("secs_per_step_max", "to", Style::Fixed(0)),
        Column::here("secs_per_step", "here: wall", Style::Fixed(3)),
        Column::here("cpu_secs_per_step", "CPU", Style::Fixed(3)),
    ];
    let notes =
        ["all levels and their aprons, reading and writing included; scaled by the number of samples"];
    Section { title, columns, rows: Vec::new(), notes: notes.map(str::to_owned).into() }
}

fn rate_section(title: String) -> Section {
    let columns = vec![
        Column::paper("fps_in_core", "paper: in-core", Style::Fixed(1)),
        Column::paper("fps_out_of_core", "out-of-core", Style::Fixed(1)),
        Column::here("fps_in_core", "here: in-core", Style::Fixed(1)),
        Column::here("fps_out_of_core", "out-of-core", Style::Fixed(1)),
        Column::here("bytes_per_step", "bytes/new step", Style::Fixed(0)),
        Column::here("ms_per_step", "ms/new step", Style::Fixed(2)),
        Column::here("steps_in_core", "steps in core", Style::Fixed(0)),
    ];
    let notes = [
        "512x512 pixels, the box on a third of them or all of it in view, a sample per voxel along a ray, unlit, ramp; \
         a new step each frame, on the processor",
        "in-core: decoded bricks in memory; out-of-core: read from the store, which the system was told to forget, and decoded; \
         new step: what is read, and the time to select, read and decode",
    ];
    Section { title, columns, rows: Vec::new(), notes: notes.map(str::to_owned).into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_simulation_of_the_user_takes_the_place_of_the_built_in_one() {
        assert_eq!(
            sources(&[], Size::Small),
            ["sim:vortex?dims=64&steps=32", "sim:shockbubble?dims=96x48x48&steps=64"]
        );
        let users = ["run.npy", "sim:vortex?dims=16"].map(str::to_owned);
        assert_eq!(
            sources(&users, Size::Full),
            ["sim:shockbubble?dims=320x128x128&steps=100", "run.npy", "sim:vortex?dims=16"]
        );
    }

    #[test]
    fn the_papers_figures_are_in_order() {
        for data in ALL_DATA {
            for [min, max, avg] in data.mse {
                assert!(min < avg && avg < max, "{}", data.name);
            }
            for pair in data.mse.windows(2) {
                assert!((0..3).all(|i| pair[0][i] < pair[1][i]), "{}", data.name);
            }
            for pair in data.fps.windows(2) {
                assert!(pair[0].0 < pair[1].0 && pair[0].1 <= pair[1].1, "{}", data.name);
            }
        }
    }
}
