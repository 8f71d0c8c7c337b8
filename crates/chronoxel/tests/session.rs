//! Drawing from a store: what memory, damage and missing nodes may and may not change.

use std::path::Path;

use chronoxel::session::{Moment, Session, View, orbit_camera};
use chronoxel_core::{ColorMap, Lighting, TransferFunction};
use chronoxel_ingest::{Codec, EncodeOptions, encode, sources};

fn encoded(folder: &Path) -> std::path::PathBuf {
    let store = folder.join("plume.cxl");
    let source = ["sim:plume?dims=40&steps=3&limit=0.01".to_owned()];
    let mut series = sources::open(&source, &Default::default()).unwrap();
    let options = EncodeOptions { brick_edge: 8, ..EncodeOptions::default() };
    encode(series.as_mut(), &store, &options, &mut |_| {}).unwrap();
    store
}

fn view_of(session: &Session, lighting: Option<Lighting>) -> View {
    let grid = session.store().header().grid;
    let size = [60, 45];
    let transfer = TransferFunction::built_in("filled", ColorMap::Viridis).unwrap();
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

#[test]
fn pictures_do_not_depend_on_memory() {
    let folder = tempfile::tempdir().unwrap();
    let store = encoded(folder.path());
    for lighting in [None, Some(Lighting::default())] {
        let pictures = [1u64 << 30, 110_000].map(|memory_bytes| {
            let mut session = Session::open(&store, None, memory_bytes).unwrap();
            let view = view_of(&session, lighting);
            session.draw(&view, 2).unwrap()
        });
        assert!(pictures[0].bricks.new > 20, "{:?}", pictures[0].bricks);
        assert_eq!(pictures[0].image, pictures[1].image);
        assert!(pictures[0].image.pixels.iter().any(|p| p[3] > 0.1), "the picture is empty");
    }
}

#[test]
fn a_step_drawn_again_reads_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let mut session = Session::open(&encoded(folder.path()), None, 1 << 30).unwrap();
    let view = view_of(&session, None);
    let first = session.draw(&view, 1).unwrap();
    let bytes = session.bytes_from_disk();
    let again = session.draw(&view, 1).unwrap();
    assert_eq!(first.image, again.image);
    assert_eq!((again.bricks.new, session.bytes_from_disk()), (0, bytes));
    assert_eq!(again.bricks.reused, first.bricks.new);
}

#[test]
fn a_step_reads_its_own_bytes_only() {
    let folder = tempfile::tempdir().unwrap();
    let store = encoded(folder.path());
    let read = |steps: &[usize]| {
        let mut session = Session::open(&store, None, 1 << 30).unwrap();
        let view = view_of(&session, None);
        steps.iter().for_each(|&step| drop(session.draw(&view, step).unwrap()));
        session.bytes_from_disk()
    };
    assert!(read(&[0]) < read(&[0, 1]) && read(&[0, 1]) < read(&[0, 1, 2]));
}

#[test]
fn a_payload_of_several_steps_is_read_once() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("vortex.cxl");
    let mut series = sources::open(&["sim:vortex?dims=32&steps=8".to_owned()], &Default::default()).unwrap();
    let options =
        EncodeOptions { codec: Codec::Palette, window: Some(8), brick_edge: 8, ..EncodeOptions::default() };
    encode(series.as_mut(), &store, &options, &mut |_| {}).unwrap();
    let played = |memory_bytes: u64| {
        let mut session = Session::open(&store, None, memory_bytes).unwrap();
        let view = view_of(&session, None);
        let images: Vec<_> = (0..8).map(|step| session.draw(&view, step).unwrap().image).collect();
        (images, session.bytes_from_disk())
    };
    let (images, bytes) = played(1 << 30);
    // Too little memory to keep payloads: each step reads its own anew, and looks the same.
    let (images_again, bytes_again) = played(110_000);
    assert!(images == images_again);
    // The bricks' windows start at eight different steps, so over eight steps each brick has two of them at most.
    assert!(bytes_again > 3 * bytes, "{bytes} {bytes_again}");
}

#[test]
fn between_two_steps_values_are_interpolated() {
    // A uniform field that rises by 0.1 a step from 0.5: a quarter of the way on it is 0.525 everywhere.
    let folder = tempfile::tempdir().unwrap();
    let npy = |name: &str, values: &[f32]| {
        let mut header =
            format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({}, 12, 12, 12), }}", values.len());
        header.push_str(&" ".repeat(117 - header.len()));
        header.push('\n');
        let mut bytes = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
        bytes.extend(header.as_bytes());
        values.iter().for_each(|v| (0..1728).for_each(|_| bytes.extend(v.to_le_bytes())));
        std::fs::write(folder.path().join(name), bytes).unwrap();
        let store = folder.path().join(name).with_extension("cxl");
        let source = [folder.path().join(name).to_str().unwrap().to_owned()];
        let mut series = sources::open(&source, &Default::default()).unwrap();
        let options = EncodeOptions { brick_edge: 8, ..EncodeOptions::default() };
        encode(series.as_mut(), &store, &options, &mut |_| {}).unwrap();
        Session::open(&store, None, 1 << 30).unwrap()
    };
    let (mut moving, mut still) = (npy("moving.npy", &[0.5, 0.6, 0.9]), npy("still.npy", &[0.525, 0.7, 0.9]));
    let view = View {
        transfer: TransferFunction::built_in("filled", ColorMap::Viridis)
            .unwrap()
            .resolve([0.0, 1.0])
            .unwrap(),
        ..view_of(&still, None)
    };
    let between = moving.draw_moment(&view, Moment { step: 0, weight: 0.25 }).unwrap();
    let expected = still.draw(&view, 0).unwrap();
    let largest = between
        .image
        .pixels
        .iter()
        .zip(&expected.image.pixels)
        .flat_map(|(a, b)| (0..4).map(|c| (a[c] - b[c]).abs()));
    assert!(largest.fold(0.0, f32::max) < 1e-4);
    assert!(between.image.pixels.iter().any(|p| p[3] > 0.1), "the picture is empty");
    assert!(moving.draw_moment(&view, Moment { step: 2, weight: 0.5 }).is_err());
    assert_eq!(Moment::of_time(&[0.0, 1.0, 3.0], 1.5), Moment { step: 1, weight: 0.25 });
    assert_eq!(Moment::of_time(&[0.0, 1.0, 3.0], 9.0), Moment::at(2));
}

#[test]
fn a_moving_field_between_steps_lies_between_their_pictures() {
    let folder = tempfile::tempdir().unwrap();
    let mut session = Session::open(&encoded(folder.path()), None, 1 << 30).unwrap();
    let view = view_of(&session, None);
    let alpha = |picture: &chronoxel::session::Picture| {
        picture.image.pixels.iter().map(|p| f64::from(p[3])).sum::<f64>()
    };
    let [first, second] = [1, 2].map(|step| alpha(&session.draw(&view, step).unwrap()));
    let near = alpha(&session.draw_moment(&view, Moment { step: 1, weight: 1e-6 }).unwrap());
    assert!((near - first).abs() < 1e-3 * first, "{near} {first}");
    let half = alpha(&session.draw_moment(&view, Moment { step: 1, weight: 0.5 }).unwrap());
    assert!((first.min(second) * 0.99..=first.max(second) * 1.01).contains(&half), "{first} {half} {second}");
}
