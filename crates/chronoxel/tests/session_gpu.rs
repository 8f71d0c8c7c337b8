//! Drawing from a store on the GPU: between steps with masks, in parts, and in bytes.

use std::path::{Path, PathBuf};

use chronoxel::session::{Moment, Session, View, orbit_camera};
use chronoxel_core::{
    ColorMap, Image, Lighting, SampleType, Samples, TimeAxis, TransferFunction, UniformGrid,
};
use chronoxel_ingest::{Codec, EncodeOptions, SourceError, StepReader, TimeSeries, Variable, encode};
use chronoxel_render::{GpuError, GpuOptions};

/// Waves that move, with a hole in them that moves as well.
struct Moving {
    grid: UniformGrid,
    times: TimeAxis,
    variables: [Variable; 1],
}

struct MovingStep {
    dims: [usize; 3],
    step: usize,
    next_slice: usize,
}

impl TimeSeries for Moving {
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
        Ok(Box::new(MovingStep { dims: self.grid.dims, step, next_slice: 0 }))
    }
}

impl StepReader for MovingStep {
    fn read_slices(&mut self, num_slices: usize) -> Result<Samples, SourceError> {
        let [nx, ny, _] = self.dims;
        let t = self.step as f32;
        let first = self.next_slice;
        self.next_slice += num_slices;
        let sample = |i: usize| {
            let [x, y, z] = [i % nx, i / nx % ny, first + i / (nx * ny)].map(|n| n as f32);
            if (x - 8.0 - t).hypot(y - 12.0).hypot(z - 9.0) < 5.0 {
                return f32::NAN;
            }
            (0.3 * x + 0.5 * t).sin() + (0.25 * y - 0.2 * t).cos() * (0.2 * z).sin()
        };
        Ok(Samples::F32((0..nx * ny * num_slices).map(sample).collect()))
    }
}

/// Six steps in windows of two.
fn encoded(folder: &Path) -> PathBuf {
    let variable = Variable {
        name: "waves".into(),
        units: String::new(),
        sample_type: SampleType::F32,
        fill_value: None,
    };
    let mut series = Moving {
        grid: UniformGrid::new([30, 24, 20], [0.0; 3], [1.0; 3]).unwrap(),
        times: TimeAxis::new((0..6).map(f64::from).collect(), String::new()).unwrap(),
        variables: [variable],
    };
    let store = folder.join("waves.cxl");
    let options =
        EncodeOptions { codec: Codec::Vq, window: Some(2), brick_edge: 8, ..EncodeOptions::default() };
    encode(&mut series, &store, &options, &mut |_| {}).unwrap();
    store
}

fn view_of(session: &Session) -> View {
    let grid = session.store().header().grid;
    let size = [60, 45];
    let transfer = TransferFunction::built_in("filled", ColorMap::Viridis).unwrap();
    View {
        camera: orbit_camera(&grid, [35.0, 25.0], 1.2, Some(30.0), size).unwrap(),
        transfer: session.resolve(&transfer).unwrap(),
        size,
        step_voxels: 0.5,
        lighting: Some(Lighting::default()),
        opacity_unit: grid.smallest_spacing(),
        level: 0,
        coherence: None,
        level_borders: Default::default(),
    }
}

/// A session that draws on the GPU; none without an adapter.
fn on_gpu(store: &Path, memory_bytes: u64) -> Option<Session> {
    let mut session = Session::open(store, None, memory_bytes).unwrap();
    match session.use_gpu(&GpuOptions { memory_bytes: 64 << 20, ..GpuOptions::default() }) {
        Ok(_) => Some(session),
        Err(error) => {
            let is_none = matches!(error.downcast_ref(), Some(GpuError::NoAdapter { .. }));
            assert!(is_none && std::env::var_os("CHRONOXEL_REQUIRE_GPU").is_none(), "{error:#}");
            println!("skipped: {error:#}");
            None
        }
    }
}

fn largest_difference(a: &Image, b: &Image) -> f32 {
    let pairs = a.pixels.iter().flatten().zip(b.pixels.iter().flatten());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn moments_are_those_of_the_cpu_whatever_the_memory() {
    let folder = tempfile::tempdir().unwrap();
    let store = encoded(folder.path());
    let mut cpu = Session::open(&store, None, 1 << 30).unwrap();
    let view = view_of(&cpu);
    for memory_bytes in [1 << 30, 110_000] {
        let Some(mut gpu) = on_gpu(&store, memory_bytes) else { return };
        for (step, weight) in [(0, 0.0), (0, 0.5), (1, 0.25), (1, 0.75), (3, 0.0), (4, 0.9)] {
            let moment = Moment { step, weight };
            let expected = cpu.draw_moment(&view, moment).unwrap();
            let found = gpu.draw_moment(&view, moment).unwrap();
            assert!(expected.image.pixels.iter().any(|p| p[3] > 0.5));
            let largest = largest_difference(&found.image, &expected.image);
            assert!(largest < 2.0 / 255.0, "{moment:?}, {memory_bytes}: {largest}");
            assert_eq!(found.bricks.drawn(), expected.bricks.drawn());
            let stats = found.on_gpu.unwrap();
            // 48 bricks of 11^3 samples at full resolution.
            assert_eq!(stats.num_portions > 2, memory_bytes < 1 << 20, "{stats:?}");
        }
    }
}

#[test]
fn steps_between_windows_stay_in_memory() {
    let folder = tempfile::tempdir().unwrap();
    let store = encoded(folder.path());
    let Some(mut gpu) = on_gpu(&store, 1 << 30) else { return };
    let view = view_of(&gpu);
    gpu.draw_moment(&view, Moment { step: 1, weight: 0.25 }).unwrap();
    let bytes = gpu.bytes_from_disk();
    let again = gpu.draw_moment(&view, Moment { step: 1, weight: 0.5 }).unwrap();
    assert_eq!((gpu.bytes_from_disk(), again.bricks.new), (bytes, 0));
    assert_eq!(again.on_gpu.unwrap().payloads_uploaded, 0);
}

#[test]
fn bytes_are_those_of_the_picture() {
    let folder = tempfile::tempdir().unwrap();
    let store = encoded(folder.path());
    let moment = Moment { step: 2, weight: 0.5 };
    let mut cpu = Session::open(&store, None, 1 << 30).unwrap();
    let view = view_of(&cpu);
    let expected = cpu.draw_moment(&view, moment).unwrap().image.to_bytes();
    assert_eq!(cpu.draw_bytes(&view, moment).unwrap().image, expected);
    cpu.draw_unseen(&view, moment).unwrap();
    let Some(mut gpu) = on_gpu(&store, 1 << 30) else { return };
    let found = gpu.draw_bytes(&view, moment).unwrap();
    for (a, b) in found.image.pixels.iter().zip(&expected.pixels) {
        assert!((0..4).all(|i| a[i].abs_diff(b[i]) <= 2), "{a:?} {b:?}");
    }
    let unseen = gpu.draw_unseen(&view, moment).unwrap();
    assert_eq!(unseen.bricks.drawn(), found.bricks.drawn());
}
