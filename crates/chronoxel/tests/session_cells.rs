//! Drawing and playing stores of cells: what decoding ahead, standing still and leaving out faces may and may not change.

use std::path::{Path, PathBuf};

use chronoxel::player::{CellPlayer, CellPlayerOptions, Late};
use chronoxel::session::{CellPicture, CellSession, CellShot, Importance, orbit_camera_of};
use chronoxel_core::{ColorMap, Image, TransferFunction};
use chronoxel_ingest::{CellOptions, EncodeOptions, encode_cells, sources};
use chronoxel_render::GpuPicture;

const NUM_STEPS: usize = 70;

fn encoded(folder: &Path) -> PathBuf {
    let store = folder.join("twist.cxl");
    let source = [format!("sim:twist?dims=9&steps={NUM_STEPS}")];
    let mut mesh = sources::open_mesh(&source, &Default::default()).unwrap();
    let (options, cells) = (EncodeOptions::default(), CellOptions::default());
    encode_cells(mesh.as_mut(), &store, &options, &cells, &mut |_| {}).unwrap();
    store
}

fn session(store: &Path) -> (CellSession, CellShot) {
    let session = CellSession::open(store, Some("pulse"), 1 << 28, 6).unwrap();
    let size = [48, 40];
    let transfer = TransferFunction::built_in("filled", ColorMap::Viridis).unwrap();
    let shot = CellShot {
        camera: orbit_camera_of(session.bounds(), [35.0, 25.0], 1.2, Some(30.0), size).unwrap(),
        transfer: session.resolve(&transfer).unwrap(),
        size,
        lighting: None,
        opacity_unit: session.opacity_unit(),
    };
    (session, shot)
}

fn image(picture: CellPicture<GpuPicture>) -> Image {
    match picture.image {
        GpuPicture::Floats(image) => image,
        _ => panic!("floats were asked for"),
    }
}

#[test]
fn what_is_played_is_what_is_drawn() {
    let folder = tempfile::tempdir().unwrap();
    let store = encoded(folder.path());
    let (mut drawing, shot) = session(&store);
    let orders: [Vec<u32>; 3] = [
        (0..NUM_STEPS as u32).collect(),
        (0..NUM_STEPS as u32).rev().collect(),
        vec![3, 69, 3, 0, 64, 63, 1],
    ];
    for order in orders {
        let options = CellPlayerOptions { redraws: true, ..CellPlayerOptions::default() };
        let mut player = CellPlayer::new(session(&store).0, order.clone(), options).unwrap();
        // Once round, and a little further.
        for place in 0..order.len() + 3 {
            let played = player.next(&shot).unwrap();
            assert_eq!(played.place, place);
            let step = order[place % order.len()] as usize;
            let expected = drawing.draw(&shot, step).unwrap();
            assert_eq!(image(played.picture.unwrap()), expected.image, "step {step}");
        }
    }
}

#[test]
fn each_span_is_read_once_and_memory_is_bounded() {
    let folder = tempfile::tempdir().unwrap();
    let store = encoded(folder.path());
    let (playing, shot) = session(&store);
    let options = CellPlayerOptions { redraws: true, ..CellPlayerOptions::default() };
    let mut player = CellPlayer::new(playing, (0..NUM_STEPS as u32).collect(), options).unwrap();
    let mut after_first_round = 0;
    for frame in 0..3 * NUM_STEPS {
        player.next(&shot).unwrap();
        if frame == NUM_STEPS {
            after_first_round = player.session().bytes_from_disk();
        }
    }
    // Both spans of the series stay in memory.
    assert_eq!(player.session().bytes_from_disk(), after_first_round);
    assert!(player.bytes_ahead_peak() <= player.bytes_ahead_budget());
    // Six arrays of values at most, and two payloads.
    assert!(player.bytes_ahead_peak() < 6 * 4 * 729 + 2 * 8 * 729 + 200_000, "{}", player.bytes_ahead_peak());
}

#[test]
fn late_steps_are_dropped_and_a_step_that_rests_is_not_drawn_again() {
    let folder = tempfile::tempdir().unwrap();
    let store = encoded(folder.path());
    let (playing, shot) = session(&store);
    let options = CellPlayerOptions { late: Late::Drop, redraws: true, ..CellPlayerOptions::default() };
    let mut player = CellPlayer::new(playing, (0..NUM_STEPS as u32).collect(), options).unwrap();
    let mut shown = 0;
    for _ in 0..40 {
        let played = player.next(&shot).unwrap();
        shown += usize::from(!played.is_late);
        assert!(played.picture.is_some());
    }
    assert!(shown > 1);
    let mut player = CellPlayer::new(session(&store).0, vec![4, 5], CellPlayerOptions::default()).unwrap();
    assert!(player.frame(&shot, 0).unwrap().picture.is_some());
    let again = player.frame(&shot, 0).unwrap();
    assert!(again.picture.is_none() && again.is_settled);
    assert!(player.frame(&shot, 1).unwrap().picture.is_some());
}

#[test]
fn with_a_target_what_rests_is_refined_to_all_faces() {
    let folder = tempfile::tempdir().unwrap();
    let store = encoded(folder.path());
    let (mut playing, shot) = session(&store);
    assert!(playing.set_detail(0.5).is_err(), "nobody knows which faces matter");
    playing.measure_importance(&Importance::Variation((0..NUM_STEPS).collect()), &mut || Ok(())).unwrap();
    let options = CellPlayerOptions { target_fps: Some(1000.0), ..CellPlayerOptions::default() };
    let mut player = CellPlayer::new(playing, (0..NUM_STEPS as u32).collect(), options).unwrap();
    (0..5).for_each(|_| drop(player.next(&shot).unwrap()));
    let place = player.next(&shot).unwrap().place;
    let mut last = None;
    for _ in 0..8 {
        let played = player.frame(&shot, place).unwrap();
        if let Some(picture) = played.picture {
            last = Some(picture);
        } else {
            assert!(played.is_settled && played.fraction == 1.0);
        }
    }
    let step = place % NUM_STEPS;
    let whole = session(&store).0.draw(&shot, step).unwrap();
    assert_eq!(image(last.unwrap()), whole.image);
}

#[test]
fn importance_does_not_depend_on_threads_and_steps_count() {
    let folder = tempfile::tempdir().unwrap();
    let store = encoded(folder.path());
    let order = |num_threads: usize, importance: Importance| {
        let (mut session, _) = session(&store);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(num_threads).build().unwrap();
        pool.install(|| session.measure_importance(&importance, &mut || Ok(()))).unwrap();
        session.face_order().unwrap().clone()
    };
    let all = Importance::Variation((0..NUM_STEPS).collect());
    assert_eq!(order(1, all.clone()), order(3, all.clone()));
    assert_ne!(order(1, all.clone()), order(1, Importance::Variation((0..8).collect())));
    assert_ne!(order(1, all), order(1, Importance::Static(0)));
    let (mut session, _) = session(&store);
    assert!(session.measure_importance(&Importance::Variation(vec![NUM_STEPS]), &mut || Ok(())).is_err());
}
