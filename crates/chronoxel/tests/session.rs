//! Drawing from a store: what memory, damage and missing nodes may and may not change.

use std::path::Path;

use chronoxel::session::{Session, View, orbit_camera};
use chronoxel_core::{ColorMap, Lighting, TransferFunction};
use chronoxel_ingest::{EncodeOptions, encode, sources};

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
