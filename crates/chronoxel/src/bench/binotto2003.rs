//! Binotto, Comba, Freitas: Real-Time Volume Rendering of Time-Varying Data Using a Fragment-Shader Compression Approach (2003),
//! section 7: how sparse the data are, and what an index and a refinement texture make of them.
//!
//! The paper's data are not to be had: discharges of drill cuttings, which `sim:plume` computes with limits of detection that leave as
//! many zeros.

use std::{collections::HashSet, time::Instant};

use chronoxel_ingest::{Codec, EncodeOptions, TimeSeries, encode};
use serde_json::{Map, Value, json};

use super::{BenchReport, Column, Input, Row, Section, Style, Workplace, machine, object};

/// Levels of subdivision: `2^level` blocks along each axis.
const LEVELS: [u32; 3] = [3, 4, 5];
/// Numbers of a cell: red, green, blue, alpha. The paper counts each as a cell.
const NUMBERS_PER_CELL: u64 = 4;

/// A data set of the paper: 128³ × 36.
struct PaperData {
    /// The simulation of the same size whose zeros are as many.
    source: &'static str,
    zeros_percent: f64,
    /// Refinement cells and compression ratio at each of [`LEVELS`].
    results: [(u64, f64); 3],
}

const ALL_DATA: [PaperData; 3] = [
    PaperData {
        source: "sim:plume?limit=22.5",
        zeros_percent: 99.92,
        results: [(5_160_960, 57.69), (1_374_208, 153.76), (452_864, 58.39)],
    },
    PaperData {
        source: "sim:plume?limit=2.23",
        zeros_percent: 99.65,
        results: [(22_396_928, 13.43), (5_451_776, 49.98), (2_472_704, 41.99)],
    },
    PaperData {
        source: "sim:plume?limit=1.47",
        zeros_percent: 99.51,
        results: [(42_336_256, 7.12), (7_036_928, 39.59), (3_265_536, 37.82)],
    },
];

/// Index cells of the paper at each of [`LEVELS`].
const INDEX_CELLS: [u64; 3] = [73_728, 589_824, 4_718_592];

/// The sources to measure: three plumes as sparse as the paper's data sets, and the user's; plumes of the user take the place of the former.
pub fn sources(users: &[String]) -> Vec<String> {
    let is_plume = |source: &String| source.starts_with("sim:plume");
    let built_in = ALL_DATA.iter().filter(|_| !users.iter().any(is_plume));
    let built_in = built_in.map(|data| data.source.to_owned());
    built_in.chain(users.iter().cloned()).collect()
}

/// Measures the sources. `progress` is told what is done and what there is to do.
///
/// # Errors
/// If a source cannot be read or its blocks do not fit the memory, the workplace cannot be written, or Ctrl-C was pressed.
pub fn run(
    inputs: Vec<Input>,
    place: &Workplace,
    memory_bytes: u64,
    progress: &mut dyn FnMut(u64, u64),
) -> anyhow::Result<BenchReport> {
    // Recorded, looked at twice, encoded.
    let total = inputs.iter().map(|input| 4 * input.num_steps() as u64).sum();
    let mut done = 0;
    let mut on_step = || {
        done += 1;
        progress(done, total);
    };
    let (mut sparseness, mut compression) = (sparseness_section(), compression_section());
    for mut input in inputs {
        let data = ALL_DATA.iter().find(|data| data.source == input.name());
        let label = input.name().to_owned();
        input.record(place, &mut on_step)?;
        let values = Values::of(&mut input.series(), &mut on_step)?;
        sparseness.rows.push(Row {
            label: label.clone(),
            paper: data.map_or(Map::new(), |d| object(json!({ "zeros_percent": d.zeros_percent }))),
            here: object(json!({ "zeros_percent": 100.0 * values.share_of_zeros })),
        });
        let found = subdivide(&mut input.series(), &values, memory_bytes, &mut on_step)?;
        let stored = Stored::make(&mut input, place, memory_bytes, &mut on_step)?;
        for (index, level) in LEVELS.into_iter().enumerate() {
            let paper = data.map_or(Map::new(), |data| paper_row(index, data.results[index]));
            let label = format!("{label}: level {level}");
            compression.rows.push(Row { label, paper, here: found[index].row(&stored) });
        }
    }
    Ok(BenchReport {
        name: "binotto2003",
        machine: machine(),
        sections: vec![sparseness, compression],
        plots: Vec::new(),
    })
}

fn paper_row(index: usize, (refinement_cells, ratio): (u64, f64)) -> Map<String, Value> {
    let index_cells = INDEX_CELLS[index];
    object(json!({ "index_cells": index_cells, "refinement_cells": refinement_cells, "ratio": ratio }))
}

/// What the values of a series are, as far as its textures need to know.
struct Values {
    range: [f64; 2],
    share_of_zeros: f64,
}

impl Values {
    fn of(series: &mut dyn TimeSeries, on_step: &mut dyn FnMut()) -> anyhow::Result<Self> {
        let mut range = [f64::INFINITY, f64::NEG_INFINITY];
        let (mut num_zeros, mut num_samples) = (0, 0);
        for step in 0..series.times().num_steps() {
            for value in read_step(series, step)? {
                num_samples += 1;
                num_zeros += usize::from(value == 0.0);
                range = [range[0].min(value), range[1].max(value)];
            }
            on_step();
        }
        anyhow::ensure!(range[0].is_finite() && range[1].is_finite(), "the source has no finite values");
        Ok(Self { range, share_of_zeros: num_zeros as f64 / num_samples as f64 })
    }

    /// The value as one of the 256 that a component of a texture has; 0 stands for the lowest alone, so that what is above the limit of
    /// detection stays apart from what is not.
    fn component(&self, value: f64) -> u8 {
        let [low, high] = self.range;
        match value > low {
            true => ((value - low) / (high - low) * 255.0).ceil().clamp(1.0, 255.0) as u8,
            false => 0,
        }
    }
}

fn read_step(series: &mut dyn TimeSeries, step: usize) -> anyhow::Result<Vec<f64>> {
    let num_slices = series.grid().dims[2];
    Ok(series.open_step(0, step)?.read_slices(num_slices)?.to_f64())
}

/// An index texture over all steps, and the blocks that it refers to.
struct Subdivision {
    level: u32,
    /// Samples of a block along each axis.
    block: [usize; 3],
    /// Samples of all steps.
    num_samples: u64,
    num_index_cells: u64,
    num_varied: u64,
    /// Blocks that differ from all others, looked up by a hash and compared where it is the same.
    blocks: HashSet<Box<[u8]>>,
}

/// The paper's scheme (section 5.1) at each level: a block whose samples are all the same is a colour in the index; of the others, equal ones
/// are kept once, wherever and whenever they occur.
fn subdivide(
    series: &mut dyn TimeSeries,
    values: &Values,
    memory_bytes: u64,
    on_step: &mut dyn FnMut(),
) -> anyhow::Result<Vec<Subdivision>> {
    let dims = series.grid().dims;
    let mut found: Vec<Subdivision> = LEVELS.iter().map(|&level| Subdivision::new(level, dims)).collect();
    for step in 0..series.times().num_steps() {
        let samples: Vec<u8> = read_step(series, step)?.into_iter().map(|v| values.component(v)).collect();
        found.iter_mut().for_each(|level| level.add(&samples, dims));
        let held: u64 = found.iter().map(Subdivision::num_bytes).sum();
        anyhow::ensure!(
            held <= memory_bytes,
            "{held} bytes of different blocks at step {step} are more than --memory allows; raise it"
        );
        on_step();
    }
    Ok(found)
}

impl Subdivision {
    fn new(level: u32, dims: [usize; 3]) -> Self {
        let block = dims.map(|n| n.div_ceil(1 << level));
        Self { level, block, num_samples: 0, num_index_cells: 0, num_varied: 0, blocks: HashSet::new() }
    }

    fn num_bytes(&self) -> u64 {
        (self.blocks.len() * self.block.iter().product::<usize>()) as u64
    }

    /// Adds the blocks of a step; the last along an axis are filled up with the nearest samples.
    fn add(&mut self, samples: &[u8], dims: [usize; 3]) {
        let along = 1usize << self.level;
        let [bx, by, bz] = self.block;
        let mut block = Vec::with_capacity(bx * by * bz);
        self.num_samples += samples.len() as u64;
        for cell in 0..along.pow(3) {
            let corner = [cell % along * bx, cell / along % along * by, cell / along / along * bz];
            block.clear();
            for z in corner[2]..corner[2] + bz {
                for y in corner[1]..corner[1] + by {
                    let row = dims[0] * (y.min(dims[1] - 1) + dims[1] * z.min(dims[2] - 1));
                    block.extend((corner[0]..corner[0] + bx).map(|x| samples[row + x.min(dims[0] - 1)]));
                }
            }
            self.num_index_cells += 1;
            if block.iter().any(|&v| v != block[0]) {
                self.num_varied += 1;
                if !self.blocks.contains(block.as_slice()) {
                    self.blocks.insert(block.as_slice().into());
                }
            }
        }
    }

    fn row(&self, stored: &Stored) -> Map<String, Value> {
        let index_cells = NUMBERS_PER_CELL * self.num_index_cells;
        let num_refined = (self.blocks.len() * self.block.iter().product::<usize>()) as u64;
        let refinement_cells = NUMBERS_PER_CELL * num_refined;
        let all_cells = NUMBERS_PER_CELL * self.num_samples;
        object(json!({
            "index_cells": index_cells,
            "refinement_cells": refinement_cells,
            "ratio": all_cells as f64 / (index_cells + refinement_cells) as f64,
            "varied_blocks": self.num_varied,
            "different_blocks": self.blocks.len(),
            "store_bytes": stored.bytes,
            "store_ratio": all_cells as f64 / stored.bytes as f64,
            "store_ratio_to_8_bits": self.num_samples as f64 / stored.bytes as f64,
            "store_secs": stored.wall_secs,
        }))
    }
}

/// Largest error of the store, in units of the variable's range: that of 8 bits.
const STORE_ERROR: f64 = 1.0 / 510.0;

/// What a store of the series takes, everything counted.
struct Stored {
    bytes: u64,
    wall_secs: f64,
}

impl Stored {
    fn make(
        input: &mut Input,
        place: &Workplace,
        memory_bytes: u64,
        on_step: &mut dyn FnMut(),
    ) -> anyhow::Result<Self> {
        let store = place.path("encoded.cxl");
        let variables = vec![input.variable().name.clone()];
        let options = EncodeOptions {
            codec: Codec::Auto,
            max_error: Some(STORE_ERROR),
            memory_bytes,
            variables,
            ..EncodeOptions::default()
        };
        let start = Instant::now();
        let mut num_told = 0;
        let report = encode(&mut input.series(), &store, &options, &mut |done| {
            (num_told..done.step).for_each(|_| on_step());
            num_told = num_told.max(done.step);
        })?;
        on_step();
        place.remove(&store)?;
        Ok(Self { bytes: report.stored_bytes, wall_secs: start.elapsed().as_secs_f64() })
    }
}

fn sparseness_section() -> Section {
    let columns = vec![
        Column::paper("zeros_percent", "paper: %", Style::Fixed(2)),
        Column::here("zeros_percent", "here: %", Style::Fixed(2)),
    ];
    let notes = ["samples that are exactly zero"];
    Section {
        title: "Table 1, spatial sparseness".to_owned(),
        columns,
        rows: Vec::new(),
        notes: notes.map(str::to_owned).into(),
    }
}

fn compression_section() -> Section {
    let columns = vec![
        Column::paper("index_cells", "paper: index", Style::Fixed(0)),
        Column::paper("refinement_cells", "refinement", Style::Fixed(0)),
        Column::paper("ratio", "ratio", Style::Fixed(2)),
        Column::here("index_cells", "here: index", Style::Fixed(0)),
        Column::here("refinement_cells", "refinement", Style::Fixed(0)),
        Column::here("ratio", "ratio", Style::Fixed(2)),
        Column::here("varied_blocks", "blocks, varied", Style::Fixed(0)),
        Column::here("different_blocks", "different", Style::Fixed(0)),
        Column::here("store_bytes", "store, bytes", Style::Fixed(0)),
        Column::here("store_ratio", "ratio", Style::Fixed(0)),
        Column::here("store_ratio_to_8_bits", "to 8 bits", Style::Fixed(0)),
    ];
    let notes = [
        "cells as the paper counts them: four numbers of each texel; ratio: 4 * samples * steps / (index + refinement); \
         components of textures have 256 values",
        "store: all files, all levels of the octree, aprons and statistics included, at most the error of 8 bits",
    ];
    Section {
        title: "Table 2, index and refinement textures".to_owned(),
        columns,
        rows: Vec::new(),
        notes: notes.map(str::to_owned).into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_ratios_follow_from_its_cells() {
        let all = 4 * 128u64.pow(3) * 36;
        for data in &ALL_DATA {
            for ((refinement, ratio), index) in data.results.into_iter().zip(INDEX_CELLS) {
                // Printed with two digits, cut or rounded.
                assert!((all as f64 / (index + refinement) as f64 - ratio).abs() < 0.01, "{ratio}");
            }
        }
    }

    #[test]
    fn equal_blocks_are_kept_once_and_homogeneous_ones_not_at_all() {
        // 16³ at level 3: blocks of 2³. Two steps with the same two varied blocks, one of them in another place as well.
        let dims = [16; 3];
        let at = |x: usize, y: usize, z: usize| x + 16 * (y + 16 * z);
        let mut first = vec![0u8; 4096];
        first[at(0, 0, 0)] = 7;
        first[at(4, 6, 8)] = 7;
        first[at(5, 1, 1)] = 9;
        for corner in 0..8 {
            first[at(14 + (corner & 1), 14 + (corner >> 1 & 1), 14 + (corner >> 2))] = 5;
        }
        let mut found = Subdivision::new(3, dims);
        found.add(&first, dims);
        found.add(&first, dims);
        assert_eq!((found.num_varied, found.blocks.len(), found.num_index_cells), (6, 2, 1024));
        let row = found.row(&Stored { bytes: 100, wall_secs: 1.0 });
        assert_eq!((&row["index_cells"], &row["refinement_cells"]), (&json!(4096), &json!(64)));
        assert_eq!(row["ratio"], json!(4.0 * 8192.0 / 4160.0));
    }

    #[test]
    fn only_the_lowest_value_is_0() {
        let values = Values { range: [0.0, 1000.0], share_of_zeros: 0.5 };
        assert_eq!([0.0, 0.001, 3.9, 4.0, 1000.0].map(|v| values.component(v)), [0, 1, 1, 2, 255]);
        let flat = Values { range: [3.0, 3.0], share_of_zeros: 0.0 };
        assert_eq!(flat.component(3.0), 0);
    }
}
