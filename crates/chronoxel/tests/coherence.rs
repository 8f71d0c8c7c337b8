//! Drawing with the errors of the time-space partitioning tree, and with partial images: what may and may not change.

use std::path::{Path, PathBuf};

use chronoxel::session::{CoherenceView, Metric, Picture, Session, View, orbit_camera};
use chronoxel_core::{
    Background, ColorMap, Image8, Lighting, TransferFunction, compare::luv_distance, metrics::ColorSpace,
};
use chronoxel_ingest::{Codec, EncodeOptions, encode, sources};
use chronoxel_stream::Tolerances;

const DIMS: [usize; 3] = [44, 20, 24];
const NUM_STEPS: usize = 12;
const METRICS: [Metric; 5] = [
    Metric::Scalar,
    Metric::ColorReference(ColorSpace::Rgb),
    Metric::ColorApproximate(ColorSpace::Rgb),
    Metric::ColorReference(ColorSpace::Luv),
    Metric::ColorApproximate(ColorSpace::Luv),
];

/// A drop that moves along x through what is still: a sphere, a wall of one value, and a corner without data. From step 8 on nothing moves.
fn samples() -> Vec<f32> {
    let mut samples = Vec::new();
    for t in 0..NUM_STEPS {
        for z in 0..DIMS[2] {
            for y in 0..DIMS[1] {
                for x in 0..DIMS[0] {
                    let near = |centre: [f64; 3], width: f64| {
                        let at = [x, y, z].map(|c| c as f64);
                        let squared: f64 = (0..3).map(|a| (at[a] - centre[a]).powi(2)).sum();
                        (-squared / width).exp()
                    };
                    let drop = near([4.0 + t.min(8) as f64, 10.0, 6.0], 12.0);
                    let value = match (x > 36, x + y + z < 8) {
                        (_, true) => f64::NAN,
                        (true, _) => 0.55,
                        _ => drop + 0.9 * near([28.0, 9.0, 15.0], 20.0),
                    };
                    samples.push(value as f32);
                }
            }
        }
    }
    samples
}

fn encoded(folder: &Path, options: EncodeOptions) -> PathBuf {
    let [nx, ny, nz] = DIMS;
    let header =
        format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({NUM_STEPS}, {nz}, {ny}, {nx}), }}");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((118u16).to_le_bytes());
    bytes.extend(format!("{header:<117}\n").as_bytes());
    bytes.extend(samples().iter().flat_map(|v| v.to_le_bytes()));
    let source = folder.join("drop.npy");
    std::fs::write(&source, bytes).unwrap();
    let store = folder.join("drop.cxl");
    let mut series = sources::open(&[source.to_string_lossy().into_owned()], &Default::default()).unwrap();
    encode(series.as_mut(), &store, &EncodeOptions { brick_edge: 8, ..options }, &mut |_| {}).unwrap();
    store
}

fn raw() -> EncodeOptions {
    EncodeOptions { codec: Codec::Raw, ..EncodeOptions::default() }
}

fn palette() -> EncodeOptions {
    EncodeOptions { codec: Codec::Palette, window: Some(4), ..EncodeOptions::default() }
}

fn view_of(session: &Session, transfer: &str, lighting: Option<Lighting>) -> View {
    let grid = session.store().header().grid;
    let size = [80, 60];
    let transfer = TransferFunction::built_in(transfer, ColorMap::Viridis).unwrap();
    View {
        camera: orbit_camera(&grid, [35.0, 25.0], 1.2, Some(30.0), size).unwrap(),
        transfer: session.resolve(&transfer).unwrap(),
        size,
        step_voxels: 0.5,
        lighting,
        opacity_unit: grid.smallest_spacing(),
        level: 0,
        coherence: None,
        level_borders: Default::default(),
    }
}

fn with(metric: Metric, spatial: f64, temporal: f64) -> Option<CoherenceView> {
    Some(CoherenceView { metric, tolerances: Tolerances { spatial, temporal }, skips_transparent: true })
}

fn distance(a: &Picture, b: &Picture) -> f64 {
    let [a, b] = [a, b].map(|p| Image8::from_image(&p.image, Background::Color([0.0; 3])));
    luv_distance(&a, &b).unwrap().0
}

#[test]
fn without_tolerance_the_picture_is_the_same_to_the_bit() {
    let folder = tempfile::tempdir().unwrap();
    for options in [raw(), palette()] {
        let store = encoded(folder.path(), options);
        for (transfer, lighting) in [("sparse", None), ("filled", Some(Lighting::default()))] {
            let mut session = Session::open(&store, None, 1 << 30).unwrap();
            let plain = view_of(&session, transfer, lighting);
            for step in [0, 3, 7, 11] {
                let expected = session.draw(&plain, step).unwrap();
                for metric in METRICS {
                    let view = View { coherence: with(metric, 0.0, 0.0), ..plain.clone() };
                    let found = session.draw(&view, step).unwrap();
                    assert_eq!(found.image, expected.image, "{metric:?}, step {step}");
                    assert_eq!(found.shares.total(), expected.shares.total());
                }
            }
        }
        std::fs::remove_dir_all(store).unwrap();
    }
}

#[test]
fn what_is_not_skipped_for_being_transparent_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let mut session = Session::open(&encoded(folder.path(), raw()), None, 1 << 30).unwrap();
    let plain = view_of(&session, "sparse", None);
    let expected = session.draw(&plain, 4).unwrap();
    let all = CoherenceView { skips_transparent: false, ..with(Metric::Scalar, 0.0, 0.0).unwrap() };
    let found = session.draw(&View { coherence: Some(all), ..plain }, 4).unwrap();
    assert_eq!(found.image, expected.image);
    let total = (DIMS[0] * DIMS[1] * DIMS[2]) as u64;
    assert_eq!((found.shares.total(), expected.shares.total()), (total, total));
    assert!(expected.shares.skipped > total / 4 && found.shares.skipped < expected.shares.skipped);
}

#[test]
fn tolerances_trade_error_for_work() {
    let folder = tempfile::tempdir().unwrap();
    let mut session = Session::open(&encoded(folder.path(), raw()), None, 1 << 30).unwrap();
    let plain = view_of(&session, "filled", None);
    let expected = session.draw(&plain, 7).unwrap();
    for metric in METRICS {
        let mut at = |spatial, temporal| {
            let view = View { coherence: with(metric, spatial, temporal), ..plain.clone() };
            session.draw(&view, 7).unwrap()
        };
        // Coherent in time: bricks of earlier steps, the newest of them read for the first.
        let in_time = at(0.0, 1e6);
        assert!(in_time.shares.reused > 0 && in_time.shares.new < expected.shares.new, "{metric:?}");
        // Coherent in space: constants.
        let in_space = at(0.3, 0.0);
        assert!(in_space.shares.constant > expected.shares.constant, "{metric:?}");
        assert!(in_space.samples < expected.samples, "{metric:?}");
        // The distance grows with the tolerance, up to one colour for what is not masked.
        let distances = [0.0, 0.3, 1e6].map(|e| distance(&at(e, 0.0), &expected));
        assert!(distances[0] == 0.0 && distances[1] < distances[2], "{metric:?} {distances:?}");
        let nothing_left = at(1e6, 1e6);
        // What is masked has no mean colour: the corner's brick, and three that have it in their apron.
        assert_eq!(nothing_left.shares.new + nothing_left.shares.reused, 4 * 512, "{metric:?}");
    }
}

#[test]
fn stepping_within_a_coherent_span_decodes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let mut session = Session::open(&encoded(folder.path(), palette()), None, 1 << 30).unwrap();
    let plain = view_of(&session, "filled", None);
    let coherent = View { coherence: with(Metric::Scalar, 0.0, 1e6), ..plain.clone() };
    session.draw(&coherent, 0).unwrap();
    let bytes = session.bytes_from_disk();
    let next = session.draw(&coherent, 5).unwrap();
    // The mask does not change, so all steps are one span, which starts at 0. Only records of the step are read.
    assert_eq!(next.bricks.new, 0, "{:?}", next.bricks);
    assert!(session.bytes_from_disk() - bytes < 10_000);
    assert_eq!(next.shares.new, 0);
}

/// The largest difference of a component.
fn largest_difference(a: &Picture, b: &Picture) -> f32 {
    let components = |picture: &Picture| picture.image.pixels.clone().into_flattened();
    components(a).iter().zip(components(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn partial_images_show_what_is_drawn_without_them() {
    let folder = tempfile::tempdir().unwrap();
    for (options, transfer, lighting, budget) in [
        (raw(), "filled", None, 1 << 30),
        (raw(), "sparse", Some(Lighting::default()), 1 << 30),
        (palette(), "filled", Some(Lighting::default()), 1 << 30),
        (raw(), "filled", None, 50_000),
    ] {
        let store = encoded(folder.path(), options);
        let [mut plain, mut keeping] = [0, 1].map(|_| Session::open(&store, None, 1 << 30).unwrap());
        keeping.keep_images(budget);
        let view = view_of(&plain, transfer, lighting);
        let mut num_composited = Vec::new();
        for step in (0..NUM_STEPS).chain((0..NUM_STEPS).rev()) {
            let [expected, found] = [&mut plain, &mut keeping].map(|s| s.draw(&view, step).unwrap());
            let off = largest_difference(&found, &expected);
            assert!(off <= 1.0 / 255.0, "step {step}: {off}");
            assert_eq!(found.shares, expected.shares);
            assert_eq!(found.bricks.skipped, expected.bricks.skipped);
            assert_eq!(found.bricks.drawn(), expected.bricks.drawn(), "step {step}");
            num_composited.push(found.bricks.composited);
            assert!(keeping.image_bytes_peak() as u64 <= budget);
        }
        assert_eq!(num_composited[..2], [0, 0], "nothing is known to stay before it has stayed");
        let most = *num_composited.iter().max().unwrap();
        assert!(most > if budget > 50_000 { 8 } else { 0 }, "{num_composited:?}");
        // Another view is another picture.
        let turned = View {
            camera: orbit_camera(&plain.store().header().grid, [80.0, 10.0], 1.0, None, view.size).unwrap(),
            ..view
        };
        let [expected, found] = [&mut plain, &mut keeping].map(|s| s.draw(&turned, 3).unwrap());
        assert_eq!((found.image, found.bricks.composited), (expected.image, 0));
        std::fs::remove_dir_all(store).unwrap();
    }
}

#[test]
fn spans_within_the_tolerance_are_composited_from_the_second_picture_on() {
    let folder = tempfile::tempdir().unwrap();
    let mut session = Session::open(&encoded(folder.path(), raw()), None, 1 << 30).unwrap();
    session.keep_images(1 << 30);
    let coherence = with(Metric::ColorApproximate(ColorSpace::Rgb), 0.0, 1e6);
    let view = View { coherence, ..view_of(&session, "filled", None) };
    let first = session.draw(&view, 0).unwrap();
    assert_eq!(first.bricks.composited, 0);
    let second = session.draw(&view, 1).unwrap();
    assert_eq!(second.bricks.composited, first.bricks.drawn());
    assert_eq!(second.samples, 0);
    let mut alone = Session::open(session.store().path(), None, 1 << 30).unwrap();
    let expected = alone.draw(&view, 1).unwrap();
    assert!(largest_difference(&second, &expected) <= 1.0 / 255.0);
}

#[test]
fn another_transfer_function_makes_other_estimates() {
    let folder = tempfile::tempdir().unwrap();
    let mut session = Session::open(&encoded(folder.path(), raw()), None, 1 << 30).unwrap();
    let coherence = with(Metric::ColorApproximate(ColorSpace::Rgb), 0.3, 0.1);
    let [sparse, filled] =
        ["sparse", "filled"].map(|name| View { coherence, ..view_of(&session, name, None) });
    let first = session.draw(&sparse, 5).unwrap();
    let between = session.draw(&filled, 5).unwrap();
    let again = session.draw(&sparse, 5).unwrap();
    assert_eq!(first.image, again.image);
    assert_ne!(first.image, between.image);
}

#[test]
fn stores_without_statistics_say_so() {
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("../chronoxel-store/tests/fixtures/v1.cxl");
    let mut session = Session::open(&fixture, None, 1 << 30).unwrap();
    let view = View { coherence: with(Metric::Scalar, 0.0, 0.0), ..view_of(&session, "filled", None) };
    let message = session.draw(&view, 0).unwrap_err().to_string();
    assert!(message.contains("v1.cxl") && message.contains("encode it again"), "{message}");
    assert!(session.draw(&View { coherence: None, ..view }, 0).is_ok());
}
