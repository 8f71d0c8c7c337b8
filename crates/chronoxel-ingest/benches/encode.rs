//! How many bytes of f32 samples per second are encoded from a warm file, by each codec.
//!
//! `CHRONOXEL_BENCH_THREADS` sets the number of threads, 2 by default.

#![allow(missing_docs, reason = "criterion's macros make public items")]

use std::fs::{self, File};
use std::hint::black_box;
use std::io::Read;
use std::path::PathBuf;

use chronoxel_core::{SampleType, Samples, TimeAxis, UniformGrid};
use chronoxel_ingest::{Codec, EncodeOptions, SourceError, StepReader, TimeSeries, Variable, encode};
use criterion::{Criterion, Throughput, criterion_group, criterion_main};

/// Steps of raw little-endian f32, one file each.
struct Files {
    grid: UniformGrid,
    times: TimeAxis,
    variables: Vec<Variable>,
    paths: Vec<PathBuf>,
}

impl Files {
    /// Writes waves with a little noise: the lowest bits do not compress, the highest do.
    fn new(folder: &std::path::Path, edge: usize, num_steps: usize) -> Self {
        let mut state = 1u32;
        let paths = (0..num_steps).map(|step| {
            let bytes: Vec<u8> = (0..edge.pow(3))
                .flat_map(|i| {
                    let [x, y, z] = [i % edge, i / edge % edge, i / edge / edge].map(|p| p as f32 * 0.05);
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    let noise = (state >> 16) as f32 / 65536.0;
                    ((x + step as f32).sin() * y.cos() + z.sin() + 0.01 * noise).to_le_bytes()
                })
                .collect();
            let path = folder.join(format!("{edge}-{step}.raw"));
            fs::write(&path, bytes).unwrap();
            path
        });
        let paths = paths.collect();
        let variable = Variable {
            name: "v".into(),
            units: String::new(),
            sample_type: SampleType::F32,
            fill_value: None,
        };
        Self {
            grid: UniformGrid::new([edge; 3], [0.0; 3], [1.0; 3]).unwrap(),
            times: TimeAxis::regular(num_steps, 1.0, "").unwrap(),
            variables: vec![variable],
            paths,
        }
    }
}

impl TimeSeries for Files {
    fn grid(&self) -> &UniformGrid {
        &self.grid
    }

    fn times(&self) -> &TimeAxis {
        &self.times
    }

    fn variables(&self) -> &[Variable] {
        &self.variables
    }

    fn open_step<'a>(&'a mut self, _: usize, step: usize) -> Result<Box<dyn StepReader + 'a>, SourceError> {
        let file = File::open(&self.paths[step]).unwrap();
        Ok(Box::new(RawReader { file, area: self.grid.dims[0] * self.grid.dims[1], bytes: Vec::new() }))
    }
}

struct RawReader {
    file: File,
    area: usize,
    bytes: Vec<u8>,
}

impl StepReader for RawReader {
    fn read_slices(&mut self, num_slices: usize) -> Result<Samples, SourceError> {
        self.bytes.resize(num_slices * self.area * 4, 0);
        self.file.read_exact(&mut self.bytes).unwrap();
        let (samples, _) = self.bytes.as_chunks::<4>();
        Ok(Samples::F32(samples.iter().map(|&b| f32::from_le_bytes(b)).collect()))
    }
}

fn encode_all(criterion: &mut Criterion) {
    let threads = std::env::var("CHRONOXEL_BENCH_THREADS").ok().and_then(|n| n.parse().ok()).unwrap_or(2);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("bench.cxl");
    let overwriting = EncodeOptions { overwrite: true, ..EncodeOptions::default() };
    let with = |codec| EncodeOptions { codec, ..overwriting.clone() };
    let cases = [
        ("raw", with(Codec::Raw), 128, 8),
        ("raw", with(Codec::Raw), 256, 2),
        ("palette, window 8", with(Codec::Palette), 128, 16),
        ("vq, window 8", with(Codec::Vq), 128, 16),
        ("auto, max error 0.001", EncodeOptions { max_error: Some(1e-3), ..overwriting.clone() }, 128, 16),
        ("auto, max error 0.01", EncodeOptions { max_error: Some(1e-2), ..overwriting.clone() }, 128, 16),
    ];
    let mut group = criterion.benchmark_group("encode_f32");
    group.sample_size(10);
    for (name, options, edge, num_steps) in cases {
        let mut files = Files::new(folder.path(), edge, num_steps);
        group.throughput(Throughput::Bytes((4 * edge.pow(3) * num_steps) as u64));
        group.bench_function(format!("{name}, {edge}^3 x {num_steps} steps"), |bencher| {
            bencher.iter(|| {
                let report = pool.install(|| encode(&mut files, &store, &options, &mut |_| {}));
                black_box(report.unwrap())
            });
        });
    }
    group.finish();
}

criterion_group!(benches, encode_all);
criterion_main!(benches);
